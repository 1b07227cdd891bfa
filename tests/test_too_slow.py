"""A flow that cannot keep up loses nothing and is of no use: it says so by itself."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from caneflow.runtime.hosts.observations import OLD
from tests.flows import Launched, launchers

FLOW = """
flow: slow_cane
nodes:
  ticker: {run: ./ticker.py}
  thinker: {run: ./thinker.py, inputs: {tick: ticker/tick}}
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
def slow_cane(tmp_path: Path) -> Iterator[Launched]:
    for name, text in {"slow_cane.yaml": FLOW, "ticker.py": TICKER, "thinker.py": THINKER}.items():
        (tmp_path / name).write_text(text)
    with launchers() as launch:
        yield launch("run", tmp_path / "slow_cane.yaml", log=tmp_path / "log")


def test_a_node_that_is_too_slow_is_named_with_how_old_its_samples_are(slow_cane: Launched) -> None:
    slow_cane.wait_for("tick: samples are")
    (line,) = (line for line in slow_cane.said.splitlines() if "samples are" in line)
    assert line.startswith("thinker")
    assert float(line.split("samples are ")[1].split()[0]) >= OLD
