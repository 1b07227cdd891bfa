"""A source that is silent, as with its device unplugged, still answers: nothing that it has sent is lost by a kill."""

import os
import queue
import re
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest
import zenoh

from caneflow.messages import Imu, decode
from caneflow.messages.control import Again, PortMark
from caneflow.recording import Recording
from caneflow.runtime import Brought, Quiet, Source
from caneflow.runtime.hosts.process.events import Confirmed, Event, HistoryAsked, Started
from caneflow.runtime.hosts.process.sources import SourceProcess
from caneflow.runtime.plan import NodePlan, OutputPlan, ProcessPlan
from tests.flows import caneflow_here, launchers, node_processes, wait_for

OUTPUT = OutputPlan(key="f/imu/imu", schema="caneflow.Imu/1", readers=("reader",))
PLAN = ProcessPlan.of(NodePlan(flow="f", node="imu", outputs={"imu": OUTPUT}))
PATIENCE = 30.0  # s that a test waits for another thread


class Bus:
    """What a source needs of a bus, without Zenoh."""

    def __init__(self) -> None:
        self.inbox: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self.sent: list[bytes] = []
        self.answers: queue.SimpleQueue[tuple[list[int], Again]] = queue.SimpleQueue()
        self.put = self.inbox.put

    def events(self, timeout: float | None) -> Iterator[Event]:
        yield self.inbox.get(timeout=timeout)

    def answer(self, asked: HistoryAsked, payloads: list[bytes], end: Again) -> None:
        self.answers.put(([decode(each, Imu).seq for each in payloads], end))

    def send(self, node: str, port: str, payload: bytes) -> None:
        self.sent.append(payload)

    def declare_ready(self) -> None:
        self.put(Started())

    def send_progress(self, progress: object) -> None: ...

    def send_counters(self, counters: object) -> None: ...


class Device(Source):
    """Three samples, then a read that does not return until what was asked meanwhile is answered."""

    outputs = {"imu": Imu}

    def __init__(self, bus: Bus, *, says_quiet: bool) -> None:
        self.bus, self.says_quiet = bus, says_quiet
        self.answers: list[tuple[list[int], Again]] = []

    def ask(self, first: int) -> None:
        self.bus.put(HistoryAsked("imu", "imu", first, query=cast("zenoh.Query", None)))
        self.answers.append(self.bus.answers.get(timeout=PATIENCE))

    def samples(self) -> Brought:
        for stamp in (10, 20, 30):
            yield "imu", Imu(stamp=stamp, gyro=(0.0, 0.0, 0.0))
        if self.says_quiet:
            yield Quiet(until=40)
        self.ask(1)
        self.bus.put(Confirmed("imu", "imu", "reader", 1))
        self.ask(0)
        os.kill(os.getpid(), signal.SIGTERM)
        threading.Event().wait(PATIENCE)  # blocked in its read
        raise AssertionError("SIGTERM has not ended it")


@pytest.mark.parametrize("says_quiet", [False, True])
def test_what_is_asked_while_it_reads_its_device_is_answered(says_quiet: bool) -> None:
    bus: Any = Bus()
    device = Device(bus, says_quiet=says_quiet)
    SourceProcess(PLAN, bus, device).run()
    mark = PortMark(2, 40 if says_quiet else 30)
    assert device.answers == [([1, 2], Again(0, mark)), ([2], Again(2, mark))]


def test_an_error_while_it_answers_ends_it_out_of_its_read() -> None:
    bus: Any = Bus()
    device = Device(bus, says_quiet=False)

    def fail(*_: object) -> None:
        raise ZeroDivisionError("a bug of ours")

    bus.answer = fail

    def ask(first: int) -> None:
        bus.put(HistoryAsked("imu", "imu", first, query=cast("zenoh.Query", None)))
        threading.Event().wait(PATIENCE)

    device.ask = ask  # type: ignore[method-assign]  # nobody answers
    with pytest.raises(ZeroDivisionError, match="a bug of ours"):
        SourceProcess(PLAN, bus, device).run()


UNPLUGGED = """
import time
from pathlib import Path
from caneflow.messages import Imu
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Unplugged(Source):
    outputs = {"imu": Imu}

    def __init__(self, settings, context): ...

    def samples(self):
        for k in range(300):
            if k == 100:
                Path(__file__).with_suffix(".silent").touch()
                time.sleep(3)  # a read of the device that does not return
            time.sleep(0.005)
            yield "imu", Imu(stamp=time.time_ns(), gyro=(0.0, 0.0, 0.0))

if __name__ == "__main__":
    run(Unplugged)
"""
COUNT = """
from caneflow.messages import Imu
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class Count(Operator):
    inputs = {"imu": Imu}
    outputs = {"imu": Imu}

    def __init__(self, settings, context):
        self.count = 0

    def handle(self, port, message):
        self.count += 1
        yield "imu", Imu(stamp=message.stamp, gyro=(float(self.count), 0.0, 0.0))

if __name__ == "__main__":
    run(Count)
"""


def test_an_operator_that_is_killed_in_the_silence_of_its_source_loses_nothing(tmp_path: Path) -> None:
    (tmp_path / "unplugged.py").write_text(UNPLUGGED)
    (tmp_path / "count.py").write_text(COUNT)
    file, out = tmp_path / "silent.yaml", tmp_path / "out.mcap"
    flow = re.sub(r"\W", "_", tmp_path.name)
    file.write_text(
        f"flow: {flow}\nnodes:\n  imu: {{run: ./unplugged.py}}\n"
        "  count: {run: ./count.py, inputs: {imu: imu/imu}}\nresults: [count/imu]\n"
    )
    with launchers() as launch:
        running = launch("run", file, "--record", out, log=tmp_path / "log")
        wait_for((tmp_path / "unplugged.silent").exists, "the silence")
        node_processes(running.process.pid)["count"].kill()
        assert running.ends() == 0, running.said
    with Recording(out) as recording:
        counted = [decode(sample.payload, Imu).gyro[0] for sample in recording.samples([("count", "imu")])]
    assert counted == [float(number) for number in range(1, 301)]
    verified = caneflow_here("verify", file, out)
    assert verified.returncode == 0, verified.stdout + verified.stderr
