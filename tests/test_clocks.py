"""The other machine's clock: offset and drift from round trips, through delays that are never the same twice."""

import queue
import time
from collections.abc import Iterator

import numpy as np
import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.algorithms.clocks.clock_offset import ClockEstimate, ClockOffset, ClockOffsetSettings
from caneflow.messages import Imu, control_key, decode
from caneflow.messages.control import Clock
from caneflow.runtime.hosts.launcher.clocks import Answer, Clocks
from caneflow.runtime.hosts.links.session import Ports, open_session
from caneflow.runtime.plan import InputPlan
from caneflow.runtime.stages.streams import Arrivals

SECOND = 1_000_000_000  # ns
START = 1_700_000_000 * SECOND


class Pair:
    """Two clocks and the way between them."""

    def __init__(self, *, offset: float, drift: float, there: float, back: float, jitter: float, seed: int) -> None:
        self.offset, self.drift, self.there, self.back, self.jitter = offset, drift, there, back, jitter
        self.random = np.random.default_rng(seed)
        self.clock = ClockOffset(ClockOffsetSettings())

    def truth(self, now: int) -> float:
        """Their clock less this one (s), at `now` (ns, this clock)."""
        return self.offset + self.drift * (now - START) / 1e9

    def exchange(self, now: int) -> ClockEstimate:
        came_at = now + round((self.there + self.random.exponential(self.jitter)) * 1e9)
        left_at = came_at + 50_000
        back_at = left_at + round((self.back + self.random.exponential(self.jitter)) * 1e9)
        theirs = [at + round(self.truth(at) * 1e9) for at in (came_at, left_at)]
        return self.clock.update(now, theirs[0], theirs[1], back_at)

    def run(self, seconds: float, since: int = START) -> ClockEstimate:
        for i in range(int(seconds)):
            estimate = self.exchange(since + i * SECOND)
        return estimate


def test_one_exchange_is_ntps_formula() -> None:
    # RFC 5905, section 8: theta = ((t2 - t1) + (t3 - t4)) / 2, delta = (t4 - t1) - (t3 - t2).
    estimate = ClockOffset(ClockOffsetSettings()).update(100, 1_250, 1_260, 310)

    assert estimate.offset == pytest.approx(((1250 - 100) + (1260 - 310)) / 2 / 1e9)
    assert estimate.delay == pytest.approx(200e-9)
    assert estimate.drift == 0


@given(
    offset=st.floats(-1e4, 1e4),
    there=st.floats(0, 0.2),
    back=st.floats(0, 0.2),
    jitter=st.floats(0, 0.05),
    seed=st.integers(0, 99),
)
@settings(max_examples=30, deadline=None)
def test_the_truth_is_within_the_uncertainty(
    offset: float, there: float, back: float, jitter: float, seed: int
) -> None:
    pair = Pair(offset=offset, drift=0.0, there=there, back=back, jitter=jitter, seed=seed)

    estimate = pair.run(60)

    assert abs(estimate.offset - offset) <= estimate.uncertainty
    # The last span may have begun 8 s ago, and in that time a clock of 500 ppm goes 4 ms.
    assert estimate.uncertainty <= 0.5 * (there + back) + 3 * jitter + 8 * 5e-4 + 1e-5


@pytest.mark.parametrize("drift", [0.0, 20e-6, -80e-6])
def test_drift_is_found_through_a_radio_link(drift: float) -> None:
    pair = Pair(offset=0.35, drift=drift, there=0.004, back=0.004, jitter=0.01, seed=4)

    estimate = pair.run(96)
    now = START + 96 * SECOND

    assert estimate.drift == pytest.approx(drift, abs=15e-6)
    assert estimate.offset_at(now) == pytest.approx(pair.truth(now), abs=1e-3)  # of delays of 28 ms on average


def test_the_least_delay_counts_and_not_the_mean() -> None:
    # One way is slow now and then: the mean of all offsets would be wrong by half of that.
    pair = Pair(offset=0.0, drift=0.0, there=0.001, back=0.001, jitter=0.0, seed=1)
    for i in range(64):
        pair.there = 0.101 if i % 4 else 0.001
        estimate = pair.exchange(START + i * SECOND)

    assert abs(estimate.offset) < 1e-5


@pytest.mark.parametrize("step", [0.2, -0.2, 3600.0])
def test_a_clock_that_is_set_is_noticed(step: float) -> None:
    pair = Pair(offset=0.1, drift=0.0, there=0.005, back=0.005, jitter=0.002, seed=2)
    pair.run(60)
    assert pair.clock.stepped == 0
    pair.offset += step

    estimate = pair.run(5, since=START + 60 * SECOND)

    assert pair.clock.stepped == 1
    assert estimate.offset == pytest.approx(0.1 + step, abs=estimate.uncertainty)


def test_this_clock_set_back_is_noticed() -> None:
    pair = Pair(offset=0.1, drift=0.0, there=0.005, back=0.005, jitter=0.002, seed=2)
    pair.run(60)
    pair.offset += 3600.0  # theirs goes on

    estimate = pair.run(5, since=START - 3540 * SECOND)

    assert pair.clock.stepped == 1
    assert estimate.offset == pytest.approx(3600.1, abs=estimate.uncertainty)


def test_one_odd_answer_is_no_step() -> None:
    pair = Pair(offset=0.1, drift=0.0, there=0.005, back=0.005, jitter=0.002, seed=2)
    before = pair.run(60)
    pair.offset += 5.0

    assert pair.exchange(START + 60 * SECOND) == before
    assert pair.clock.stepped == 0


def test_stamps_of_no_round_trip_are_refused() -> None:
    with pytest.raises(ValueError, match="no round trip"):
        ClockOffset(ClockOffsetSettings()).update(100, 0, 500, 200)


# --- over Zenoh, with a clock that is shifted --------------------------------------------------------------------


class Machine:
    """One machine's part of the clocks, on a clock of its own."""

    def __init__(self, flow: str, here: str, there: str, shift: int, listen: list[str], connect: list[str]) -> None:
        self.answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self.session = open_session(mode="router", listen=listen, connect=connect)
        self.clocks = Clocks(flow, here, [there], now=lambda: time.time_ns() + shift)
        self.clocks.open(self.session, self.answers.put)

    def listen(self, exchanges: int) -> list[str]:
        """What there is to warn of in so many round trips."""
        said = []
        end = time.monotonic() + 60
        while exchanges:
            assert time.monotonic() < end, "no answer"
            self.clocks.look()
            try:
                said.append(self.clocks.take(self.answers.get(timeout=0.05)))
            except queue.Empty:
                continue
            exchanges -= 1
        return [each for each in said if each is not None]


@pytest.fixture
def endpoint() -> Iterator[str]:
    ports = Ports()
    yield ports.endpoint()
    ports.release()


def test_a_shifted_clock_is_measured_told_and_warned_about_once(endpoint: str) -> None:
    shift = 350_000_000  # ns
    gateway = Machine("demo", "gateway", "phone", 0, [endpoint], [])
    phone = Machine("demo", "phone", "gateway", shift, [], [endpoint])
    told: list[Clock] = []

    def note(sample: zenoh.Sample) -> None:
        told.append(decode(sample.payload.to_bytes(), Clock))

    handler = zenoh.handlers.Callback(note, indirect=False)
    with gateway.session, phone.session:
        held = gateway.session.declare_subscriber(control_key("demo", "clock", "gateway", "*"), handler)
        warned = gateway.listen(12)
        other = phone.listen(12)
        del held

    assert len(told) == 12
    assert abs(told[-1].offset - 0.35) <= told[-1].uncertainty
    assert told[-1].uncertainty < 0.02
    assert len(warned) == len(other) == 1
    assert warned[0].startswith("the clock of phone is 0.35")
    assert "ahead of this one's" in warned[0]
    assert "the clock of gateway is 0.35" in other[0]
    assert "behind this one's" in other[0]


def test_the_age_of_a_sample_is_taken_on_its_writers_clock() -> None:
    plan = InputPlan(key="demo/imu/imu", schema="caneflow.Imu/1", writer="imu", max_age_ms=100.0, clock="phone")
    arrivals = Arrivals("fusion", "imu", plan)
    now = START
    fresh = Imu(stamp=now - 3 * SECOND - SECOND // 20, gyro=(0.0, 0.0, 0.0))  # 50 ms old, on a clock 3 s behind
    stale = Imu(stamp=now - 3 * SECOND - SECOND // 5, gyro=(0.0, 0.0, 0.0))

    arrivals.clock_offset = None
    assert not arrivals.too_old(stale, now), "a clock that is not known yet says nothing"
    arrivals.clock_offset = -3 * SECOND
    assert not arrivals.too_old(fresh, now)
    assert arrivals.too_old(stale, now)
