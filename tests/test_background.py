"""The running mean against the weighted mean written out."""

import math

import numpy as np
import pytest

from caneflow.algorithms.radar.background import Background


def removed(scans: np.ndarray, elapsed: np.ndarray, time_constant: float) -> np.ndarray:
    background = Background(time_constant)
    out = scans.copy()
    for scan, dt in zip(out, elapsed, strict=True):
        background.remove(scan, dt)
    return out


def test_is_the_weighted_mean_of_the_past_at_any_spacing() -> None:
    rng = np.random.default_rng(2)
    scans = (rng.normal(size=(40, 5)) + 1j * rng.normal(size=(40, 5)) + 3).astype(np.complex64)
    elapsed = rng.uniform(0.001, 0.4, 40)
    times = np.cumsum(elapsed)
    got = removed(scans, elapsed, 0.5)
    for k in range(40):
        weights = np.exp(-(times[k] - times[: k + 1]) / 0.5)
        mean = (weights[:, None] * scans[: k + 1]).sum(axis=0) / weights.sum()
        assert np.abs(got[k] - (scans[k] - mean)).max() < 1e-5


def test_what_stands_still_leaves_nothing_from_the_first_scan_on() -> None:
    scans = np.full((50, 4), 20_000 - 7_000j, dtype=np.complex64)
    assert np.abs(removed(scans, np.full(50, 0.01), 0.5)).max() < 0.01


@pytest.mark.parametrize("rate", [50, 100, 400])  # Hz
def test_forgets_by_time_and_not_by_count(rate: int) -> None:
    """A step fades by 1/e in one time constant, whatever the rate (the past reaches back far)."""
    past, after = 20 * rate // 10, rate // 2
    scans = np.ones((past + after, 1), dtype=np.complex64)
    scans[past:] = 3
    left = removed(scans, np.full(past + after, 1 / rate), 0.5)[-1, 0]
    # 2 s of past are 4 time constants: the step is left to exp(-1) less what is missing of an infinite past
    assert left.real == pytest.approx(2 * math.exp(-1) * (1 - math.exp(-4)) / (1 - math.exp(-5)), rel=0.02)
