"""Frames into moving returns: even steps of time, gaps, changes, every kind of sample."""

from dataclasses import replace

import numpy as np
import pytest

from caneflow.algorithms.radar.analytic_signal import AnalyticSignal
from caneflow.algorithms.radar.background import Background
from caneflow.algorithms.radar.moving_returns import (
    MOST_HELD,
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
    assert not any(r.stand_ins for r in many)


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
    assert [r.stand_ins for r in got if r.stand_ins] == [(stamps[10],), tuple(stamps[20:23])]
    for returns in got:
        assert not returns.scans[: len(returns.stand_ins)].any()
        assert returns.scans[len(returns.stand_ins) :].any() or returns.restarted


def test_a_jittering_clock_loses_nothing() -> None:
    jitter = np.random.default_rng(2).integers(-3_000_000, 3_000_000, 30)
    got = fed(SCANS, [s + int(j) for s, j in zip(even(30), jitter, strict=True)])
    assert not any(r.stand_ins for r in got)
    assert sum(r.restarted for r in got) == 1


@pytest.mark.parametrize(("missing", "restarted"), [(5, False), (6, True), (5000, True)])
def test_a_longer_gap_starts_anew(missing: int, restarted: bool) -> None:
    stamps = even(10) + [START + (10 + missing + i) * PERIOD for i in range(3)]
    got = fed(SCANS[:13], stamps)
    assert [r.restarted for r in got[1:]] == [False] * 9 + [restarted] + [False] * 2
    assert len(got[10].stand_ins) == (0 if restarted else missing)


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


# --- what cannot be a scan --------------------------------------------------------------------------------------


def ground(count: int = 120, level: float = 30_000.0) -> np.ndarray:
    """Scans of coupling that stands, and noise; shape (count, BINS)."""
    rng = np.random.default_rng(5)
    wave = np.cos(4 * np.pi * 4.3e9 / 299_792_458.0 * 0.009149 * np.arange(BINS)) * np.exp(-np.arange(BINS) / 15.0)
    return np.asarray(np.rint(level * wave + rng.normal(0.0, 200.0, (count, BINS))), dtype=np.int32)


def without(missing: list[int], scans: np.ndarray) -> list[MovingReturns]:
    """As if frames had not come."""
    kept = [i for i in range(len(scans)) if i not in missing]
    return fed(scans[kept], [even(len(scans))[i] for i in kept])


WILD = {
    "full scale": np.full(BINS, 2**31 - 1),
    "noise": np.random.default_rng(6).integers(-(2**31), 2**31, BINS),
    "noise as strong as the coupling": np.random.default_rng(7).normal(0.0, 6000.0, BINS),
    "nothing": np.zeros(BINS),
    "the other way round": -ground()[0],
    "one bin": np.where(np.arange(BINS) == 50, -(2**31), ground()[0]),
}


@pytest.mark.parametrize("dtype", [np.int32, np.float32])
@pytest.mark.parametrize("wild", WILD)
def test_a_wild_scan_counts_as_lost_and_leaves_no_trace(wild: str, dtype: type) -> None:
    scans: np.ndarray = ground().astype(dtype)
    scans[[40, 80]] = WILD[wild].astype(dtype)
    got, expected = fed(scans, even(120)), without([40, 80], scans)
    assert [r.stand_ins for r in got if r.stand_ins] == [(even(120)[40],), (even(120)[80],)]
    assert len(got) == 120, "time goes on all the same"
    assert not got[40].scans.any()
    assert got[-1].scans == pytest.approx(expected[-1].scans, rel=1e-3, abs=1.0)
    assert [r.restarted for r in got] == [True] + [False] * 119


def test_what_is_wild_for_long_is_believed() -> None:
    scans = ground()
    scans[60:] *= 7
    got = fed(scans, even(120))
    assert [bool(r.stand_ins) for r in got] == [60 <= k < 60 + MOST_HELD for k in range(120)]


@pytest.mark.parametrize("wild", ["full scale", "noise", "nothing"])
def test_a_wild_first_scan_is_forgotten_by_the_second(wild: str) -> None:
    scans = ground(40)
    scans[0] = WILD[wild]
    got, expected = fed(scans, even(40)), fed(scans[1:], even(40)[1:])
    assert got[1].restarted
    for a, b in zip(got[1:], expected, strict=True):
        assert np.array_equal(a.scans, b.scans)


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.float32, np.complex64])
def test_a_radar_that_hangs_is_lost_until_it_goes_on(dtype: type) -> None:
    """No receiver is without noise: the same scan a third time over is not a measurement."""
    scans: np.ndarray = ground(60).astype(dtype)
    scans[30:50] = scans[30]
    got = fed(scans, even(60))
    assert [bool(r.stand_ins) for r in got] == [33 <= k < 50 for k in range(60)]


@pytest.mark.parametrize("block", [4, 20])
def test_a_wild_scan_within_a_frame_costs_that_scan(block: int) -> None:
    scans = ground()
    scans[50] = 2**31 - 1
    got = fed(scans, even(120), block=block)
    assert [stamp for r in got for stamp in r.stand_ins] == [even(120)[50]]
    one = np.concatenate([r.scans for r in fed(scans, even(120))])
    assert np.concatenate([r.scans for r in got]) == pytest.approx(one, abs=1.0)


@pytest.mark.parametrize(
    "change",
    [
        {"range_start": 5.0},
        {"range_step": 0.02},
        {"carrier": 60e9},
        {"carrier": 3e9},
        {"bandwidth": 1.0},
        {"scan_period": 1.0},
        {"scan_period": 1e-6},
    ],
)
def test_a_frame_of_another_make_counts_as_lost_once_and_is_believed_when_it_lasts(change: dict[str, float]) -> None:
    scans, stamps, other = ground(80), even(80), replace(PARAMETERS, **change)
    filtering, got = MovingReturnsFilter(MovingReturnsSettings()), list[MovingReturns]()
    for k in range(80):
        got.append(filtering.update(stamps[k], scans[k, None], other if k in (20, 50) else PARAMETERS))
    assert [r.stand_ins for r in got if r.stand_ins] == [(stamps[20],), (stamps[50],)]
    assert {r.parameters for r in got} == {PARAMETERS}
    assert got[-1].scans == pytest.approx(without([20, 50], scans)[-1].scans, rel=1e-3, abs=1.0)
    lasting = replace(PARAMETERS, range_start=0.4)
    after = [filtering.update(stamps[-1] + (k + 1) * PERIOD, scans[k, None], lasting) for k in range(5)]
    assert [r.restarted for r in after] == [False] * MOST_HELD + [True, False]
    assert [r.parameters for r in after] == [PARAMETERS] * MOST_HELD + [lasting] * 2


@pytest.mark.parametrize("scan", [ground()[0, :40], ground()[0] * (1 + 1j)])
def test_a_frame_of_another_length_or_kind_counts_as_lost(scan: np.ndarray) -> None:
    filtering = MovingReturnsFilter(MovingReturnsSettings())
    scans, stamps = ground(30), even(30)
    for k in range(20):
        filtering.update(stamps[k], scans[k, None], PARAMETERS)
    strange = scan.astype(np.complex64) if scan.dtype.kind == "c" else scan
    returns = filtering.update(stamps[20], strange[None], PARAMETERS)
    assert returns.scans.shape == (1, BINS)
    assert returns.stand_ins == (stamps[20],)
    assert not filtering.update(stamps[21], scans[21, None], PARAMETERS).restarted


def test_a_pulse_that_no_scan_can_hold_is_refused_and_changes_nothing() -> None:
    filtering = MovingReturnsFilter(MovingReturnsSettings())
    impossible = replace(PARAMETERS, carrier=60e9)
    for _ in range(2):
        with pytest.raises(ValueError, match="does not show"):
            filtering.update(START, SCANS[:1], impossible)
    scans, stamps = ground(12), even(12)
    got = [filtering.update(stamp, scan[None], PARAMETERS) for stamp, scan in zip(stamps, scans, strict=True)]
    assert np.array_equal(got[-1].scans, fed(scans, stamps)[-1].scans)
    for k in range(MOST_HELD):
        lost = filtering.update(stamps[-1] + (k + 1) * PERIOD, scans[:1], impossible)
        assert lost.stand_ins == (stamps[-1] + (k + 1) * PERIOD,)
    with pytest.raises(ValueError, match="does not show"):
        filtering.update(stamps[-1] + 4 * PERIOD, scans[:1], impossible)
    assert not filtering.update(stamps[-1] + 5 * PERIOD, scans[:1], PARAMETERS).restarted
