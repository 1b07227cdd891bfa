"""Frames into moving returns: even steps of time, gaps, changes, every kind of sample."""

from dataclasses import replace

import numpy as np
import pytest

from caneflow.algorithms.analytic_signal import AnalyticSignal
from caneflow.algorithms.background import Background
from caneflow.algorithms.moving_returns import (
    MovingReturns,
    MovingReturnsFilter,
    MovingReturnsSettings,
    RadarParameters,
)

PARAMETERS = RadarParameters(scan_period=0.01, range_start=0.3, range_step=0.009149, carrier=4.3e9, bandwidth=1.7e9)
BINS = 96
PERIOD = 10_000_000  # ns
START = 1_700_000_000_000_000_000  # ns
SCANS = np.random.default_rng(1).integers(-20_000, 20_000, (30, BINS)).astype(np.int32)


def fed(scans: np.ndarray, stamps: list[int], *, block: int = 1) -> list[MovingReturns]:
    """Frames of `block` scans each, with the stamp of their last."""
    filtering = MovingReturnsFilter(MovingReturnsSettings())
    frames = range(0, len(scans), block)
    return [filtering.update(stamps[i + block - 1], scans[i : i + block], PARAMETERS) for i in frames]


def even(count: int) -> list[int]:
    return [START + i * PERIOD for i in range(count)]


def test_is_the_analytic_signal_without_the_background() -> None:
    got = fed(SCANS, even(30))
    expected = AnalyticSignal(bins=BINS, range_step=0.009149, carrier=4.3e9, bandwidth=1.7e9)(SCANS)
    background = Background(0.5)
    for scan in expected:
        background.remove(scan, 0.01)
    assert np.concatenate([r.scans for r in got]) == pytest.approx(expected, abs=0.01)
    assert [r.restarted for r in got] == [True] + [False] * 29
    assert [r.stamps_ns for r in got] == [(s,) for s in even(30)]


@pytest.mark.parametrize("block", [2, 3, 10, 30])
def test_frames_of_many_scans_are_the_same_scans(block: int) -> None:
    one, many = fed(SCANS, even(30)), fed(SCANS, even(30), block=block)
    assert np.concatenate([r.scans for r in many]) == pytest.approx(np.concatenate([r.scans for r in one]), abs=0.01)
    assert [s for r in many for s in r.stamps_ns] == even(30)
    assert not any(r.lost for r in many)


@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_the_kind_of_real_sample_does_not_matter(dtype: type) -> None:
    for a, b in zip(fed(SCANS, even(30)), fed(SCANS.astype(dtype), even(30)), strict=True):
        assert np.array_equal(a.scans, b.scans)


def test_complex_frames_are_analytic_already() -> None:
    scans = (SCANS[:5] * (1 + 2j)).astype(np.complex64)
    given = scans.copy()
    got = fed(scans, even(5))
    assert np.array_equal(scans, given), "the caller's array is left alone"
    background = Background(0.5)
    for scan, returns in zip(scans, got, strict=True):
        background.remove(scan, 0.01)
        assert returns.scans[0] == pytest.approx(scan, abs=0.01)


def test_lost_scans_leave_zeros_and_stamps_in_even_steps() -> None:
    stamps = even(30)
    kept = [i for i in range(30) if i not in (10, 20, 21, 22)]
    got = fed(SCANS[kept], [stamps[i] for i in kept])
    assert [s for r in got for s in r.stamps_ns] == stamps
    assert [r.lost for r in got if r.lost] == [1, 3]
    for returns in got:
        assert not returns.scans[: returns.lost].any()
        assert returns.scans[returns.lost :].any() or returns.restarted


def test_a_jittering_clock_loses_nothing() -> None:
    jitter = np.random.default_rng(2).integers(-3_000_000, 3_000_000, 30)
    got = fed(SCANS, [s + int(j) for s, j in zip(even(30), jitter, strict=True)])
    assert not any(r.lost for r in got)
    assert sum(r.restarted for r in got) == 1


@pytest.mark.parametrize(("missing", "restarted"), [(5, False), (6, True), (5000, True)])
def test_a_longer_gap_starts_anew(missing: int, restarted: bool) -> None:
    stamps = even(10) + [START + (10 + missing + i) * PERIOD for i in range(3)]
    got = fed(SCANS[:13], stamps)
    assert [r.restarted for r in got[1:]] == [False] * 9 + [restarted] + [False] * 2
    assert got[10].lost == (0 if restarted else missing)


@pytest.mark.parametrize(
    ("change", "bins"),
    [({}, 97), ({"range_start": 0.4}, BINS), ({"carrier": 4.07e9}, BINS), ({"scan_period": 0.02}, BINS)],
)
def test_a_frame_of_another_make_starts_anew(change: dict[str, float], bins: int) -> None:
    filtering = MovingReturnsFilter(MovingReturnsSettings())
    filtering.update(START, SCANS[:1], PARAMETERS)
    other = replace(PARAMETERS, **change)
    scan = np.ones((1, bins), np.int32)
    got = filtering.update(START + PERIOD, scan, other)
    assert got.restarted
    assert not got.scans.any(), "a first scan is its own background"
    assert not filtering.update(START + 3 * PERIOD, scan, other).restarted


def test_what_cannot_be_a_frame_is_refused_and_the_next_one_is_not() -> None:
    filtering = MovingReturnsFilter(MovingReturnsSettings())
    filtering.update(START, SCANS[:1].astype(np.float32), PARAMETERS)
    with pytest.raises(ValueError, match=r"is not newer than the last"):
        filtering.update(START, SCANS[:1].astype(np.float32), PARAMETERS)
    with pytest.raises(ValueError, match=r"0 scans of 96 bins"):
        filtering.update(START + PERIOD, SCANS[:0], PARAMETERS)
    for bad in (np.nan, np.inf, 1e30):
        scan = SCANS[1:2].astype(np.float32)
        scan[0, 7] = bad
        with pytest.raises(ValueError, match=r"samples that are not finite or above"):
            filtering.update(START + PERIOD, scan, PARAMETERS)
    after = filtering.update(START + PERIOD, SCANS[1:2].astype(np.float32), PARAMETERS)
    assert np.array_equal(after.scans, fed(SCANS[:2], even(2))[1].scans)
