"""What a launcher says of its own accord about nodes that are well and yet of no use: their samples are old."""

import pytest

from caneflow.messages.control import Counters, Delays
from caneflow.runtime.hosts.launcher.node_statistics import OLD, OTHER_CLOCK, NodeStatistics


def told(age: float | None) -> Counters:
    return Counters(node="fusion", inputs={}, outputs={}, delays={"imu": Delays(handled=age)})


def test_samples_that_have_become_old_are_said_once_and_when_they_no_longer_are() -> None:
    statistics = NodeStatistics()
    ages = [0.01, 0.9 * OLD, 3.2, 9.0, 0.9 * OLD, 0.01, 0.01, 2.0]
    lines = [list(statistics.grown_old(told(age))) for age in ages]
    assert [len(each) for each in lines] == [0, 0, 1, 0, 0, 1, 0, 1]
    assert lines[2][0].startswith("imu: samples are 3.2 s old when they are handled")
    assert lines[5] == ["imu: samples are 0.0 s old, as they should be"]


@pytest.mark.parametrize("age", [None, 1.1 * OTHER_CLOCK, -5.0])
def test_stamps_of_another_clock_and_none_say_nothing(age: float | None) -> None:
    assert not list(NodeStatistics().grown_old(told(age)))
