"""The clock fit: simulated clocks with known truth, a linear program as the slow obvious line, wraps and reboots."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linprog

from caneflow.algorithms.clocks.clock_fit import ClockFit, ClockFitSettings, LineBelow

SECOND = 1_000_000_000  # ns
HOST = 1_000_000 * SECOND  # some reading of the host's clock
LEAST_DELAY = 500_000  # ns


class Simulated:
    """Scans of a device: when they were taken, what its clock showed, when they arrived."""

    def __init__(
        self, *, period_ms: float, drift: float, jitter_ms: float, loss: float = 0.0, count: int = 4000, seed: int = 1
    ) -> None:
        rng = np.random.default_rng(seed)
        device_ms = 1234.37 + period_ms * np.arange(count)
        taken = HOST + device_ms * 1e6 * (1 + drift)
        late = LEAST_DELAY + rng.exponential(jitter_ms, count) * 1e6
        stalled = rng.random(count) < 0.005
        late[stalled] += rng.uniform(0, 300e6, stalled.sum())
        kept = rng.random(count) >= loss
        kept[[0, -1]] = True
        self.lost = int((~kept).sum())
        self.device_ms = device_ms[kept]
        self.taken = taken[kept]
        self.arrivals = np.maximum.accumulate(taken + late)[kept].astype(np.int64)

    def stamps(self, fit: ClockFit, *, boot_ms: int = 0) -> NDArray[np.int64]:
        readings = ((self.device_ms + boot_ms) % 2**32).astype(np.int64)
        return np.array([fit.update(int(r), int(a)) for r, a in zip(readings, self.arrivals, strict=True)])


@pytest.mark.parametrize(
    ("period_ms", "asked_ms", "drift", "jitter_ms", "loss", "spread_ms"),
    [
        (10.0, 10.0, 30e-6, 0.1, 0.0, 0.01),  # the cane at 100 Hz
        (10.0, 10.0, -100e-6, 2.0, 0.1, 0.05),
        (21.5, 10.0, 50e-6, 0.3, 0.0, 0.05),  # more samples than fit into what was asked
        (17.28, None, 50e-6, 0.3, 0.0, 0.1),  # back to back
        (17.28, None, 50e-6, 0.3, 0.5, 0.3),
        (2.5, None, -20e-6, 0.3, 0.02, 0.05),
    ],
)
def test_stamps_follow_the_device_closer_than_its_clock_shows(
    period_ms: float, asked_ms: float | None, drift: float, jitter_ms: float, loss: float, spread_ms: float
) -> None:
    sim = Simulated(period_ms=period_ms, drift=drift, jitter_ms=jitter_ms, loss=loss)
    fit = ClockFit(period=asked_ms)
    stamps = sim.stamps(fit)
    errors = (stamps - sim.taken)[len(stamps) // 4 :] / 1e6  # ms
    assert errors.std() < spread_ms
    assert np.abs(errors - LEAST_DELAY / 1e6).max() < 1.0, "a tick; the least delay cannot be seen"
    assert fit.period == pytest.approx(period_ms, rel=3e-3)
    assert fit.missed == pytest.approx(sim.lost, abs=0.02 * len(stamps)), "exact but for gaps that are a guess"
    assert fit.restarts == 0


def test_missing_scans_are_counted() -> None:
    sim = Simulated(period_ms=10.0, drift=20e-6, jitter_ms=0.2, loss=0.05)
    fit = ClockFit(period=10.0)
    sim.stamps(fit)
    assert fit.missed == sim.lost > 0


def test_a_period_that_the_device_cannot_keep_is_found_and_the_count_put_right() -> None:
    sim = Simulated(period_ms=21.5, drift=0.0, jitter_ms=0.2, loss=0.02)
    fit = ClockFit(period=10.0)
    sim.stamps(fit)
    assert fit.missed == sim.lost


def test_the_period_stays_the_same_to_the_last_bit_while_it_is_right() -> None:
    sim = Simulated(period_ms=17.28, drift=0.0, jitter_ms=0.2, loss=0.02)
    fit = ClockFit()
    periods = []
    for reading, arrival in zip(sim.device_ms.astype(int), sim.arrivals, strict=True):
        fit.update(int(reading), int(arrival))
        periods.append(fit.period)
    assert periods[:32] == [None] * 32
    assert len(set(periods[100:])) == 1


def test_the_wrap_of_the_devices_clock_does_not_show() -> None:
    sim = Simulated(period_ms=10.0, drift=20e-6, jitter_ms=0.2, count=500)
    wrapping = sim.stamps(ClockFit(period=10.0), boot_ms=2**32 - 3000)
    assert np.array_equal(wrapping, sim.stamps(ClockFit(period=10.0), boot_ms=2**31))


def test_a_reboot_of_the_device_goes_on_with_later_stamps() -> None:
    fit = ClockFit(period=10.0)
    before = [fit.update(1_000_000 + 10 * i, HOST + 10_000_000 * i) for i in range(100)]
    after = [fit.update(500 + 10 * i, HOST + 4 * SECOND + 10_000_000 * i) for i in range(100)]
    assert fit.restarts == 1
    assert after[0] - before[-1] == 4 * SECOND - 99 * 10_000_000
    assert {b - a for a, b in itertools.pairwise(after)} == {10_000_000}


def test_a_jump_of_the_devices_clock_is_found() -> None:
    fit = ClockFit(period=10.0)
    for i in range(100):
        fit.update(10 * i, HOST + 10_000_000 * i)
    stamp = fit.update(3_600_000 + 1000, HOST + 10_000_000 * 100)  # an hour later, it says
    assert stamp == HOST + 10_000_000 * 100
    assert fit.restarts == 1


def test_late_arrivals_do_not_move_the_stamps() -> None:
    on_time, late = ClockFit(period=10.0), ClockFit(period=10.0)
    for i in range(300):
        arrival = HOST + 10_000_000 * i
        stalled = HOST + 10_000_000 * 250 if 200 <= i < 250 else arrival  # half a second held back, then all at once
        assert late.update(10 * i, stalled) == on_time.update(10 * i, arrival)


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 10**12)), max_size=100),
    st.one_of(st.none(), st.floats(0.1, 1e4)),
)
def test_stamps_increase_whatever_the_clock_says(steps: list[tuple[int, int]], period: float | None) -> None:
    fit = ClockFit(period=period)
    arrival, stamps, arrivals = HOST, [], []
    for reading, wait in steps:
        arrival += wait
        stamps.append(fit.update(reading, arrival))
        arrivals.append(arrival)
    assert all(b > a for a, b in itertools.pairwise(stamps))
    assert all(s <= a + i for i, (s, a) in enumerate(zip(stamps, arrivals, strict=True)))


@pytest.mark.parametrize("seed", range(5))
def test_the_line_is_that_of_the_linear_program(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = np.arange(40) * 1e9 + rng.uniform(0, 0.5e9, 40)
    delays = rng.exponential(2e6, 40) + 80e-6 * x
    line = LineBelow(ClockFitSettings())
    for device, delay in zip(x, delays, strict=True):
        line.add(device, HOST + round(device + delay))
    # Moon, Skelly & Towsley (1999): maximise the sum of a * x + b, subject to a * x + b <= delay. The last bucket is
    # not finished: it may push the line down, but has no say in its slope.
    scaled = x[:-1] / 1e9
    solved = linprog(
        [-scaled.sum(), -39.0], A_ub=np.stack([scaled, np.ones(39)], 1), b_ub=delays[:-1], bounds=(None, None)
    )
    assert solved.x is not None
    slope = float(solved.x[0]) / 1e9
    expected = slope * x + (delays - slope * x).min()
    found = np.array([line.at(device) for device in x]) - HOST - x
    assert found == pytest.approx(expected, abs=1e3)  # 1 us, of 3 ms
