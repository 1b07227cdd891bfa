"""The same bytes on every processor: what is pinned says so itself, and what runs beside it cannot change it."""

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from caneflow import dispatch
from caneflow.messages import Pose, decode, numbered
from caneflow.recording import Platform, Recording, RecordingWriter
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.replays.verification import verify
from tests.flows import CANEFLOW, write_walk

FLOW = """
flow: cane
nodes:
  imu: {run: drivers.bno055}
  radar: {run: drivers.p440}
  ground_speed: {run: operators.ground_speed, inputs: {frame: radar/frame, imu: imu/imu}}
  fusion: {run: operators.fusion, inputs: {imu: imu/imu, speed: ground_speed/speed}, settings: {method: best}}
results: [fusion/pose]
"""
# Where glibc 2.36 gives another last digit with fused multiply-add than without: sin(x), atan(x), exp(x).
FUSED_DIFFERS = (13.28657857527871, 5.2453534640237365, 0.5375711128369929, -5.0290571179207575, -14.586160904181881)

x86_64 = pytest.mark.skipif(platform.machine() != "x86_64", reason="only x86-64 has mathematics with and without FMA")


@pytest.fixture(scope="module")
def unpinned() -> dict[str, str]:
    """An environment in which nothing is pinned."""
    ours = {"NPY_DISABLE_CPU_FEATURES", "OPENBLAS_CORETYPE", "GLIBC_TUNABLES"}
    return {name: value for name, value in os.environ.items() if name not in ours}


def said(program: str, environment: dict[str, str]) -> str:
    """What a fresh interpreter prints."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_numpy_and_blas_say_themselves_that_they_are_pinned(unpinned: dict[str, str]) -> None:
    program = "from caneflow import dispatch; import numpy, scipy.linalg; print(*dispatch.pinned())"
    assert {"numpy", "blas"} <= set(said(program, unpinned).split())


def test_what_was_imported_before_us_does_not_count_as_pinned(unpinned: dict[str, str]) -> None:
    features = "numpy._core._multiarray_umath"
    program = f"""
import numpy, sys
core = sys.modules["{features}"]
beyond = [name for name in core.__cpu_dispatch__ if core.__cpu_features__[name]]
from caneflow import dispatch
from caneflow.messages import Pose, decode, numbered
print(bool(beyond), "numpy" in dispatch.pinned())
"""
    beyond, pinned = said(program, unpinned).split()
    assert (beyond == "True") != (pinned == "True")


def test_a_variable_that_is_set_too_late_pins_nothing(unpinned: dict[str, str]) -> None:
    program = 'import os; os.environ["GLIBC_TUNABLES"] = "glibc.cpu.hwcaps=-FMA,-FMA4,-FMA_Usable,-FMA4_Usable"\n'
    program += "from caneflow import dispatch; print(*dispatch.pinned())"
    assert ("mathematics" in said(program, unpinned).split()) == (platform.machine() == "aarch64")


@x86_64
def test_the_tunable_changes_the_mathematics_and_is_what_pins_them(unpinned: dict[str, str]) -> None:
    program = f"import math; print([(math.sin(x), math.atan(x), math.exp(x)) for x in {FUSED_DIFFERS}])"
    pinned = {**unpinned, "GLIBC_TUNABLES": f"{dispatch.TUNABLE}={','.join(dispatch.NO_FUSED)}"}
    fused = "fma" in Path("/proc/cpuinfo").read_text(encoding="utf-8").split()
    if not (fused and dispatch.glibc() == "glibc 2.36"):
        pytest.skip("the numbers that tell are known for glibc 2.36 on a processor with fused multiply-add")
    assert said(program, unpinned) != said(program, pinned)


def test_there_is_no_third_start(unpinned: dict[str, str]) -> None:
    program = "import os\nfrom caneflow import dispatch\ndispatch.restart_with_pinned_mathematics()\n"
    program += "print(dispatch.RESTARTED in os.environ)"
    assert said(program, {**unpinned, dispatch.RESTARTED: "1"}) == "False", "nor does the mark go on to others"
    assert said(program, unpinned) == "False"


def test_tunables_of_the_user_stay(unpinned: dict[str, str]) -> None:
    ours = ",".join(dispatch.NO_FUSED)
    together = dispatch._pinned_tunables
    assert together("") == f"glibc.cpu.hwcaps={ours}"
    assert together("glibc.malloc.check=3") == f"glibc.cpu.hwcaps={ours}:glibc.malloc.check=3"
    assert together("glibc.malloc.check=3:glibc.cpu.hwcaps=-ERMS") == (
        f"glibc.cpu.hwcaps=-ERMS,{ours}:glibc.malloc.check=3"
    )
    assert together(together("glibc.cpu.hwcaps=-FMA")) == together("glibc.cpu.hwcaps=-FMA")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, unpinned: dict[str, str]) -> tuple[Path, Path]:
    """A flow, and a recording of a run of it by the command."""
    folder = tmp_path_factory.mktemp("dispatch")
    flow, out = folder / "cane.yaml", folder / "out.mcap"
    flow.write_text(FLOW)
    walk = write_walk(folder / "walk.mcap", samples=300)
    command = [*CANEFLOW, "run", str(flow), "--replay", str(walk), "--in-process", "--record", str(out)]
    subprocess.run(command, env=unpinned, check=True, capture_output=True)
    return flow, out


def verified(flow: Path, recording: Path, environment: dict[str, str]) -> tuple[int, dict[str, object]]:
    done = subprocess.run(
        [*CANEFLOW, "verify", str(flow), str(recording), "--json"],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stderr
    return done.returncode, json.loads(done.stdout)


def test_a_recording_says_on_what_it_was_computed(recorded: tuple[Path, Path]) -> None:
    with Recording(recorded[1]) as recording:
        found = recording.platform
    assert found == msgspec.structs.replace(Platform.here(), pinned=("numpy", "blas", "mathematics"))


@pytest.mark.parametrize(
    "other",
    [
        {"NPY_DISABLE_CPU_FEATURES": "X86_V3", "OPENBLAS_CORETYPE": "Prescott"},
        {"NPY_ENABLE_CPU_FEATURES": "X86_V3", "OPENBLAS_CORETYPE": "Haswell"},
        {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-AVX,-FMA"},
    ],
    ids=lambda other: " ".join(f"{key}={value}" for key, value in other.items()),
)
@x86_64
def test_another_processor_gives_the_same_bytes(
    other: dict[str, str], recorded: tuple[Path, Path], unpinned: dict[str, str]
) -> None:
    status, about = verified(*recorded, {**unpinned, **other})
    assert status == 0
    assert about["tolerance"] == 0
    assert about["platform_differences"] == []


def copied(recording: Path, to: Path, computed_on: Platform, x_off: float, patch: pytest.MonkeyPatch) -> Path:
    """A copy that says it was `computed_on`, with poses that lie `x_off` m further on."""
    patch.setattr(Platform, "here", lambda: computed_on)
    with (
        Recording(recording) as source,
        RecordingWriter(to, flow=source.flow, source="replayed", rig=source.rig) as writer,
    ):
        for sample in source.samples():
            payload = sample.payload
            if sample.kind is Pose:
                pose = decode(payload, Pose)
                x, y, z = pose.position
                payload = numbered(msgspec.structs.replace(pose, position=(x + x_off, y, z)), sample.seq)
            assert sample.kind is not None
            writer.write(sample.key, sample.kind, payload, stamp=sample.stamp, seq=sample.seq, log_time=sample.stamp)
    return to


@pytest.mark.parametrize(
    ("other", "x_off", "tolerance", "holds"),
    [
        ({"machine": "riscv64"}, 1e-7, None, True),  # within what is stated for another platform
        ({"numpy": "1.26.4"}, 1e-7, None, True),
        ({"pinned": ("blas", "mathematics")}, 1e-7, None, True),
        ({"machine": "riscv64"}, 1e-3, None, False),  # beyond it
        ({"machine": "riscv64"}, 1e-7, 0.0, False),  # what is asked for goes before what is stated
        ({"machine": "riscv64"}, 1e-3, 0.01, True),
        ({}, 1e-7, None, False),  # the same platform: equal bytes
    ],
)
def test_another_platform_is_named_and_compared_within_the_stated_tolerance(
    other: dict[str, str | tuple[str, ...]],
    x_off: float,
    tolerance: float | None,
    holds: bool,
    recorded: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flow, recording = recorded
    with Recording(recording) as source:
        here = source.platform
    assert here is not None
    there = msgspec.structs.replace(here, **other)
    changed = copied(recording, tmp_path / "changed.mcap", there, x_off, monkeypatch)
    monkeypatch.setattr(Platform, "here", lambda: here)
    verification = verify(load(flow), changed, tolerance=tolerance)
    assert verification.holds == holds
    named = verification.differences
    assert len(named) == len(other)
    assert all(any(name in line or "kernels" in line for line in named) for name in other)


def test_a_recording_that_does_not_say_is_compared_within_the_stated_tolerance(
    recorded: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flow, recording = recorded
    with Recording(recording) as source:
        here = source.platform
    assert here is not None
    unsaid = msgspec.structs.replace(here, machine="\x1b")  # which nobody believes
    verification = verify(load(flow), copied(recording, tmp_path / "old.mcap", unsaid, 1e-7, monkeypatch))
    assert verification.holds
    assert verification.differences == ["the recording does not say on what it was computed"]


@pytest.mark.parametrize(
    "text", ["", "{", '{"machine": "x"}', json.dumps({**msgspec.to_builtins(Platform.here()), "numpy": "2\x1b[2J"})]
)
def test_a_platform_that_cannot_be_believed_is_none(text: str) -> None:
    assert Platform.read({"platform": text}) is None
    assert Platform.read({}) is None


def test_a_platform_reads_as_it_was_written() -> None:
    here = Platform.here()
    assert Platform.read({"platform": here.as_json()}) == here
    assert str(here).isprintable()
