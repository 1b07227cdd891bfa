"""A source before its streams: what cannot be sent is counted and named once for each cause."""

import time

import pytest

from caneflow.messages import Imu, decode
from caneflow.messages.control import PortMark
from caneflow.runtime.hosts.process import present
from caneflow.runtime.hosts.process.present import Present
from caneflow.runtime.plan import OutputPlan
from caneflow.runtime.stages.source_stage import Feed
from caneflow.runtime.stages.streams import FAR_AHEAD

NOW = 10**18
SECOND = 10**9


def feed(*, ordered: bool = False) -> Feed:
    return Feed("imu", {"imu": OutputPlan(key="f/imu/imu", schema="caneflow.Imu/1")}, ordered=ordered)


def imu(stamp: int) -> Imu:
    return Imu(stamp=stamp, gyro=(0.0, 0.0, 0.0))


@pytest.mark.parametrize("ordered", [False, True])
@pytest.mark.parametrize("ahead", [5 * SECOND, 3600 * SECOND, 2**63 - 2 - NOW])
def test_what_is_stamped_in_the_future_is_not_sent_and_nothing_follows_from_it(
    caplog: pytest.LogCaptureFixture, ordered: bool, ahead: int
) -> None:
    source = feed(ordered=ordered)
    assert source.take("imu", imu(NOW), NOW)
    assert source.take("imu", imu(NOW + ahead), NOW) is None
    assert source.take("imu", imu(NOW + ahead), NOW) is None
    source.nothing_until(NOW + ahead, NOW)
    assert source.take("imu", imu(NOW + 1), NOW)
    assert source.progress().ports["imu"] == PortMark(1, NOW + 1)
    assert source.unsent == {"imu": 2}
    sample, silence = (record.message for record in caplog.records)
    assert sample.startswith(
        f"f/imu/imu: not sent, a sample is stamped {ahead / 1e9:.1f} s ahead of the clock; at most 1 s"
    )
    assert silence.startswith("imu: its silence is stamped")


def test_each_cause_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    source = feed()
    for stamp in (NOW + FAR_AHEAD, 5, 5, NOW + 2 * FAR_AHEAD, NOW + 2 * FAR_AHEAD):
        source.take("imu", imu(stamp), NOW)
    assert source.refused == 4
    assert len(caplog.records) == 2


def test_in_a_replay_there_is_no_future() -> None:
    source = feed()
    assert source.take("imu", imu(NOW + 3600 * SECOND))
    source.nothing_until(NOW + 7200 * SECOND)
    assert source.progress().ports["imu"] == PortMark(0, NOW + 7200 * SECOND)


class Set:
    """The machine's clocks, of which one may be set."""

    monotonic, wall = 0, NOW

    def monotonic_ns(self) -> int:
        return self.monotonic

    def time_ns(self) -> int:
        return self.wall


def test_what_was_present_is_not_future_when_the_clock_is_set_back(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, here = Set(), Present()
    monkeypatch.setattr(present, "time", clock)
    assert here.now() == NOW
    clock.monotonic, clock.wall = SECOND, NOW - 3600 * SECOND
    assert here.now() == NOW + SECOND
    clock.monotonic, clock.wall = 2 * SECOND, NOW + 3600 * SECOND
    assert here.now() == NOW + 3600 * SECOND


def test_the_present_is_the_machines_clock() -> None:
    here = Present()
    before = time.time_ns()
    assert before <= here.now() <= time.time_ns() + SECOND


def test_after_a_resume_outputs_go_on_in_number_and_time() -> None:
    before, after = feed(), feed()
    before.take("imu", imu(NOW))
    after.resume(before.state())
    assert after.take("imu", imu(NOW)) is None
    assert after.unsent == {"imu": 1}
    payload = after.take("imu", imu(NOW + 1))
    assert payload is not None
    assert decode(payload, Imu).seq == 1
