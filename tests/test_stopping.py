"""The end of a run: in which order processes end, and what the sources of a group say while they end."""

import logging
import threading
from collections.abc import Mapping
from pathlib import Path

import pytest

from caneflow.messages import Imu, Sample
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.deployment import deploy
from caneflow.runtime.hosts.launcher.stopping import Turns, turns_of
from caneflow.runtime.hosts.process.source_threads import SourceThreads
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.program import Brought, Encoded, Source
from tests.test_groups import grouped


def turns(path: Path, processes: Mapping[str, str]) -> Turns:
    plans = deploy(load(grouped(path / "flow.yaml", processes)), record=path / "out.mcap").plans
    by_process: dict[str, list[NodePlan]] = {}
    for plan in plans.values():
        by_process.setdefault(plan.runs_in, []).append(plan)
    return turns_of({members[0].node: members for members in by_process.values()})


@pytest.mark.parametrize(
    ("processes", "expected"),
    [
        ({}, Turns(["imu", "radar"], [["ground_speed"], ["fusion"]], [], ["recorder"], [])),
        # One process ends its own sources first.
        (dict.fromkeys(("imu", "radar", "ground_speed", "fusion"), "a"), Turns([], [["imu"]], [], ["recorder"], [])),
        ({"imu": "recorder"}, Turns(["radar"], [["ground_speed"], ["fusion"]], [], ["imu"], ["imu"])),
        ({"imu": "a", "fusion": "a"}, Turns(["radar"], [["ground_speed"], ["imu"]], [], ["recorder"], ["imu"])),
        # Two that read each other: ground_speed is done when its own process has ended.
        (
            {"imu": "a", "ground_speed": "a", "radar": "b", "fusion": "b"},
            Turns([], [["imu"], ["radar"]], [], ["recorder"], ["radar"]),
        ),
    ],
)
def test_processes_end_behind_those_whose_samples_they_take(
    tmp_path: Path, processes: Mapping[str, str], expected: Turns
) -> None:
    assert turns(tmp_path, processes) == expected


class Torn(Source):
    """A device that cannot be closed."""

    outputs = {"imu": Imu}

    def __init__(self) -> None: ...

    def samples(self) -> Brought:
        try:
            yield "imu", Imu(stamp=1, gyro=(0.0, 0.0, 0.0))
            yield "imu", Imu(stamp=2, gyro=(0.0, 0.0, 0.0))
        finally:
            raise OSError("the port is gone")


class Kept:
    """Takes one sample and waits for it to be the last."""

    def __init__(self) -> None:
        self.brought, self.stopping = threading.Event(), threading.Event()
        self.broken: list[BaseException] = []

    def bring(self, node: str, port: str, sample: Sample | Encoded) -> None:
        self.brought.set()
        self.stopping.wait(10.0)

    def nothing_until(self, node: str, stamp: int) -> None: ...

    def has_room(self, node: str) -> bool:
        return True

    def source_ended(self, node: str) -> None: ...

    def break_down(self, error: BaseException) -> None:
        self.broken.append(error)


def test_what_a_source_raises_while_it_is_ended_is_said(caplog: pytest.LogCaptureFixture) -> None:
    taker, lock, ended = Kept(), threading.RLock(), threading.Event()
    threads = SourceThreads({"imu": Torn()}, taker, lock, replay=False)
    threads.begin()
    with lock:
        threads.start()
    assert taker.brought.wait(10.0)
    with caplog.at_level(logging.ERROR):
        threads.stop_and(ended.set)
        while not threads.stopping:
            pass
        taker.stopping.set()
        assert ended.wait(10.0)
    assert "at its end: OSError: the port is gone" in caplog.text
    assert taker.broken == [], "the process ends anyway"
