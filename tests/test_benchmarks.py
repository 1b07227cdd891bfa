"""What a sample costs, part by part: `make bench` measures, all other runs only check that each part does its work."""

import json
import math
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from caneflow.messages import GroundSpeed, Imu, RadarFrame, Sample, decode, numbered
from caneflow.messages.rig import read_rig
from caneflow.runtime import Context, Emitted, Operator
from caneflow.runtime.plan import InputPlan, OutputPlan
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.simulation.scenario import Walk, simulate_walk
from operators.fusion import Fusion, FusionSettings
from operators.ground_speed import GroundSpeedOperator, GroundSpeedSettings
from tests.flows import caneflow_here

ROOT = Path(__file__).parents[1]
WARM = 400  # samples before what is measured: the windows are full and the walker walks
PERIOD = 10_000_000  # ns


@cache
def walk() -> Walk:
    """8 s of a straight walk, the first 2 at rest."""
    return simulate_walk("straight", seed=3, duration=8.0)


@cache
def readings() -> list[Imu]:
    made, imu = walk(), walk().imu
    return [
        Imu(
            stamp=stamp,
            gyro=tuple(imu.gyro[i].tolist()),
            accel=tuple(imu.accel[i].tolist()),
            mag=tuple(imu.mag[i].tolist()),
            orientation=tuple(imu.orientation[i].tolist()),
            linear_accel=tuple(imu.linear_accel[i].tolist()),
        )
        for i, stamp in enumerate(made.stamps_ns.tolist())
    ]


@cache
def frames() -> list[RadarFrame]:
    made = walk()
    return [
        RadarFrame(
            stamp=stamp,
            scans=made.scans[i : i + 1],
            scan_period=made.scan_period,
            range_start=made.range_start,
            range_step=made.range_step,
            carrier=made.carrier,
            bandwidth=made.bandwidth,
        )
        for i, stamp in enumerate(made.stamps_ns.tolist())
    ]


def context() -> Context:
    return Context(node="test", rig=read_rig(walk().rig), ports={}, random=np.random.default_rng(0))


def each_in_turn(benchmark: Any, step: Callable[..., Any], arguments: list[tuple[Any, ...]]) -> Any:
    """Call `step` with one of `arguments` after the other, WARM of them beforehand; what the last call gave."""
    coming: Iterator[tuple[Any, ...]] = iter(arguments)
    for _ in range(WARM):
        step(*next(coming))
    return benchmark.pedantic(step, setup=lambda: (next(coming), {}), rounds=len(arguments) - WARM)


@pytest.mark.parametrize(
    ("with_speed", "with_velocity"), [(True, False), (False, True)], ids=["paper's front end", "pulse pairs"]
)
def test_frame(benchmark: Any, with_speed: bool, with_velocity: bool) -> None:
    """10 ms of data through `ground_speed`: one IMU sample, one frame of 288 bins."""
    operator = GroundSpeedOperator(GroundSpeedSettings(with_speed=with_speed, with_velocity=with_velocity), context())

    velocities = []

    def step(imu: Imu, frame: RadarFrame) -> Sample:
        list(operator.handle("imu", imu))
        ((_, speed),) = operator.handle("frame", frame)
        if isinstance(speed, GroundSpeed) and speed.velocity is not None:  # not in every frame
            velocities.append(speed.velocity[0])
        return speed

    speed = each_in_turn(benchmark, step, list(zip(readings(), frames(), strict=True)))
    assert isinstance(speed, GroundSpeed)
    assert speed.valid == with_speed
    assert bool(velocities) == with_velocity
    assert 0.2 < (velocities[-1] if with_velocity else speed.speed) < 1.2, "a walking pace"


@pytest.mark.parametrize("method", ["luenberger", "kalman"])
def test_step_of_the_fusion(benchmark: Any, method: Any) -> None:
    """10 ms of data through `fusion`: one speed, one IMU sample."""
    operator = Fusion(FusionSettings(method=method), context())
    speeds = [GroundSpeed(stamp=s.stamp, speed=0.8, quality=0.05, rays=16, valid=True, delay=0.3) for s in readings()]

    def step(speed: GroundSpeed, imu: Imu) -> Sample:
        list(operator.handle("speed", speed))
        ((_, pose),) = operator.handle("imu", imu)
        return pose

    pose = each_in_turn(benchmark, step, list(zip(speeds, readings(), strict=True)))
    assert math.hypot(*pose.velocity[:2]) == pytest.approx(0.8, abs=0.15)


@pytest.mark.parametrize("kind", [Imu, RadarFrame], ids=["Imu", "RadarFrame"])
def test_decoding(benchmark: Any, kind: type[Sample]) -> None:
    sample = readings()[0] if kind is Imu else frames()[0]
    payload = numbered(sample, 7)
    found = benchmark(decode, payload, kind)
    assert type(found) is kind
    assert found.seq == 7
    assert numbered(found, 7) == payload


class Echo(Operator):
    """Says something at every sample of one port, and costs nothing itself."""

    inputs = {"a": Imu, "b": Imu}
    outputs = {"out": Imu}

    def __init__(self, settings: object = None, context: Context | None = None) -> None: ...

    def handle(self, port: str, message: Sample) -> Emitted:
        return (("out", message),) if port == "a" else ()


def test_stage(benchmark: Any) -> None:
    """Two samples with one stamp through a stage: checked, merged, handled, numbered."""
    inputs = {port: InputPlan(key=f"f/{port}/imu", schema=Imu.schema, writer=port) for port in ("a", "b")}
    stage = Stage("echo", Echo(), inputs, {"out": OutputPlan(key="f/echo/out", schema=Imu.schema)})
    numbers = count()

    def setup() -> tuple[tuple[Imu, Imu], dict[str, Any]]:
        seq = next(numbers)
        again = msgspec.structs.replace(readings()[0], stamp=(seq + 1) * PERIOD, seq=seq)
        return (again, msgspec.structs.replace(again)), {}

    def step(a: Imu, b: Imu) -> list[int]:
        stage.offer("a", a)
        stage.offer("b", b)
        out = []
        while (emitted := stage.step()) is not None:
            out += [seq for _, _, seq in emitted]
        return out

    for _ in range(WARM):
        step(*setup()[0])
    # An earlier port may still bring the same stamp, so the second sample waits for the next pair.
    assert benchmark.pedantic(step, setup=setup, rounds=2000) == [stage.outputs["out"].sent - 1]
    assert stage.input_counts()["a"].handled == stage.outputs["out"].sent


def test_the_command_says_where_the_time_goes(tmp_path: Path) -> None:
    recording = tmp_path / "walk.mcap"
    caneflow = [sys.executable, "-m", "caneflow.command"]
    assert caneflow_here("simulate", "walk", "--duration", 3, "-o", recording).returncode == 0
    done = subprocess.run(
        [*caneflow, "bench", str(recording), "--flow", str(ROOT / "dataflow.yaml"), "--repeat", "1", "--json"],
        check=True, timeout=60, capture_output=True, text=True,
    )  # fmt: skip
    said = json.loads(done.stdout)
    assert said["duration"] == pytest.approx(3.0, abs=0.05)
    assert said["times_real_time"] == pytest.approx(said["duration"] / said["cpu"])
    assert list(said["stages"]) == ["reading", "decoding", "ground_speed", "fusion", "merging"]
    assert min(said["stages"].values()) >= 0.0
    assert said["stages"]["ground_speed"] == max(said["stages"].values())
    assert said["reference"] > 0.0
