"""mcu/grid.c: every cell is that of the numpy grid, after hundreds of readings, on a steady way and on a wild one."""

import ctypes
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from caneflow.algorithms.surroundings.occupancy_grid import CELLS, GridSettings, OccupancyGrid, Rays, world_coordinate

MCU = Path(__file__).parents[1] / "mcu"
SLICES = 8
WARNINGS = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Wstrict-prototypes", "-Werror"]


class Ray(ctypes.Structure):
    _fields_ = [("direction", ctypes.c_int16 * 3), ("range", ctypes.c_int32), ("says", ctypes.c_uint8)]


class Grid(ctypes.Structure):
    _fields_ = [
        ("row", ctypes.c_int32),
        ("column", ctypes.c_int32),
        ("occupancy", ctypes.c_int8 * (SLICES * CELLS * CELLS)),
        ("floor_missing", ctypes.c_int8 * (CELLS * CELLS)),
        ("marks", ctypes.c_uint32 * (SLICES * CELLS * CELLS // 32)),
    ]


def need(program: str) -> str:
    found = shutil.which(program)
    if found is None:
        pytest.skip(f"{program} is not installed here")
    return found


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    output = tmp_path_factory.mktemp("grid") / "grid.so"
    command = [need("cc"), *WARNINGS, "-O2", "-shared", "-fPIC", str(MCU / "grid.c"), "-o", str(output)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return ctypes.CDLL(str(output))


def readings(seed: int, count: int, wander: float) -> Iterator[tuple[float, float, Rays]]:
    """Rays in all directions from a place that moves: floor, things, holes, nothing."""
    dice = np.random.default_rng(seed)
    x, y = dice.uniform(-20, 20, 2)
    for _ in range(count):
        x, y = x + dice.normal(0, wander), y + dice.normal(0, wander)
        height = dice.uniform(0.3, 1.2)
        vectors = dice.normal(0, 1, (64, 3)) - np.array([0.0, 0.0, 0.5])
        pointing = np.rint(vectors / np.linalg.norm(vectors, axis=1, keepdims=True) * 16384).astype(np.int32)
        to_floor = height / np.maximum(-pointing[:, 2] / 16384, 0.05)
        distance = np.where(dice.random(64) < 0.5, to_floor * dice.normal(1, 0.1, 64), dice.uniform(0.05, 6, 64))
        yield (
            x,
            y,
            Rays(
                origin=(world_coordinate(x + 0.2), world_coordinate(y - 0.1), round(height * 65536)),
                directions=pointing,
                ranges=np.rint(np.clip(distance, 0.02, 16) * 4096).astype(np.int32),
                says=dice.integers(0, 3, 64).astype(np.uint8),
                floor_reach=round(dice.choice([0.0, 1.9, 3.5]) * 4096),
            ),
        )


@pytest.mark.parametrize(("seed", "wander"), [(1, 0.05), (2, 0.4), (3, 5.0)])
def test_every_cell_is_that_of_numpy(library: ctypes.CDLL, seed: int, wander: float) -> None:
    fast, mine = OccupancyGrid(GridSettings(), SLICES), Grid()
    for number, (x, y, rays) in enumerate(readings(seed, 300, wander)):
        fast.centre_on(x, y)
        fast.take(rays)
        library.grid_move(ctypes.byref(mine), *fast.origin)
        packed = (Ray * len(rays.says))(
            *(
                Ray((ctypes.c_int16 * 3)(*d), r, s)
                for d, r, s in zip(rays.directions.tolist(), rays.ranges.tolist(), rays.says.tolist(), strict=True)
            )
        )
        origin = ctypes.c_int64(rays.origin[0]), ctypes.c_int64(rays.origin[1]), ctypes.c_int32(rays.origin[2])
        library.grid_take(ctypes.byref(mine), *origin, packed, len(packed), rays.floor_reach)
        if number % 4 == 3:
            fast.forget()
            library.grid_forget(ctypes.byref(mine))
    occupancy = np.array(mine.occupancy, np.int8).reshape(SLICES, CELLS, CELLS)
    np.testing.assert_array_equal(occupancy, fast.occupancy)
    np.testing.assert_array_equal(np.array(mine.floor_missing, np.int8).reshape(CELLS, CELLS), fast.floor_missing)
    assert np.count_nonzero(fast.occupancy) > 500


def test_the_grid_needs_no_division_and_no_floats_on_a_cortex_m4(tmp_path: Path) -> None:
    output = tmp_path / "grid.o"
    command = [need("arm-none-eabi-gcc"), *WARNINGS, "-O2", "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=soft", "-c"]
    subprocess.run([*command, str(MCU / "grid.c"), "-o", str(output)], check=True, capture_output=True, text=True)
    said = subprocess.run([need("arm-none-eabi-objdump"), "-d", output], check=True, capture_output=True, text=True)
    assert "sdiv" not in said.stdout
    assert "udiv" not in said.stdout
    names = subprocess.run([need("arm-none-eabi-nm"), "-u", output], check=True, capture_output=True, text=True)
    assert [line for line in names.stdout.split() if "aeabi" in line] == []


def test_the_grid_fits_into_42_kilobytes() -> None:
    assert ctypes.sizeof(Grid) <= 42 * 1024
