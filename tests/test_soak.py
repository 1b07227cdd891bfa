"""Minutes, not seconds: `make soak`. A recording gives the same bytes at any speed and under load, every time."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WALKS = ROOT.parent / "shared" / "data" / "walks"
CANEFLOW = [sys.executable, "-m", "caneflow.command"]

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """Keep as many processes spinning."""
    spinning = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in spinning:
            process.kill()
            process.wait()


@pytest.mark.parametrize("load", [0, 4], ids=["calm", "loaded"])
@pytest.mark.parametrize("speed", ["1", "max"])
@pytest.mark.parametrize("walk", sorted(WALKS.glob("*.mcap")) or [None], ids=lambda w: w.stem if w else "no walks here")
def test_every_run_of_a_walk_gives_the_bytes_of_one_process(
    walk: Path | None, speed: str, load: int, tmp_path: Path
) -> None:
    if walk is None:
        pytest.skip("the shared walks are not here")
    out = tmp_path / "out.mcap"
    run = [*CANEFLOW, "run", "dataflow.yaml", "--replay", str(walk), "--speed", speed, "--record", str(out)]
    with busy(load):
        done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr
    verify = [*CANEFLOW, "verify", "dataflow.yaml", str(out)]
    held = subprocess.run(verify, cwd=ROOT, capture_output=True, text=True, timeout=500, check=False)
    assert held.returncode == 0, held.stdout + held.stderr
