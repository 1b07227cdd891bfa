"""A flow that cannot keep up loses nothing and is of no use: it says so by itself; it may leave out what is too old."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from caneflow.messages.control import EdgeStatus
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.attached.attach import attached
from caneflow.runtime.hosts.launcher.node_statistics import OLD
from tests.flows import Launched, launchers, wait_for

FLOW = """
flow: NAME
nodes:
  ticker: {run: ./ticker.py}
  thinker: {run: ./thinker.py, inputs: {tick: INPUT}}
results: [thinker/thought]
"""
TICKER = """
import time
from caneflow.messages import Imu
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Ticker(Source):
    outputs = {"tick": Imu}

    def __init__(self, settings, context):
        pass

    def samples(self):
        while True:
            time.sleep(0.01)
            yield "tick", Imu(stamp=time.time_ns(), gyro=(0.0, 0.0, 0.5))

if __name__ == "__main__":
    run(Ticker)
"""
THINKER = """
import time
from caneflow.messages import Imu
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class Thinker(Operator):
    inputs = {"tick": Imu}
    outputs = {"thought": Imu}

    def __init__(self, settings, context):
        pass

    def handle(self, port, message):
        time.sleep(0.1)  # ten times as long as it has
        yield "thought", message

if __name__ == "__main__":
    run(Thinker)
"""


@pytest.fixture
def flow(tmp_path: Path) -> str:
    """A name that no other test's flow has."""
    return tmp_path.name.replace("-", "_")


@pytest.fixture
def slow_cane(tmp_path: Path, flow: str) -> Iterator[Callable[[str], Launched]]:
    """Starts it, with what the thinker's input is."""
    with launchers() as launch:

        def start(tick: str) -> Launched:
            text = FLOW.replace("NAME", flow).replace("INPUT", tick)
            files = {"slow_cane.yaml": text, "ticker.py": TICKER, "thinker.py": THINKER}
            for name, text in files.items():
                (tmp_path / name).write_text(text)
            return launch("run", tmp_path / "slow_cane.yaml", log=tmp_path / "log")

        yield start


def test_a_node_that_is_too_slow_is_named_with_how_old_its_samples_are(
    slow_cane: Callable[[str], Launched],
) -> None:
    running = slow_cane("ticker/tick")
    running.wait_for("tick: samples are")
    (line,) = (line for line in running.said.splitlines() if "samples are" in line)
    assert line.startswith("thinker")
    assert float(line.split("samples are ")[1].split()[0]) >= OLD


def test_what_is_too_old_is_left_out_and_counted_and_what_is_handled_is_young(
    slow_cane: Callable[[str], Launched], flow: str
) -> None:
    running = slow_cane("{from: ticker/tick, max_age_ms: 300}")
    found: list[EdgeStatus] = []

    def left_out() -> bool:
        try:
            with attached(flow) as here:
                found[:] = here.status().edges
        except DataflowError:
            return False
        return found[0].queue > 100  # more than a second of what it has no time for

    wait_for(left_out, "samples to be left out")
    assert found[0].delays.handled is not None
    assert found[0].delays.handled < OLD
    assert "samples are" not in running.said
