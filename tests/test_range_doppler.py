"""The range-Doppler map against the DFT by definition, a single scatterer, and the limits of physics."""

import math

import numpy as np
import pytest

from caneflow.algorithms.radar import range_doppler as rd
from caneflow.physics import SPEED_OF_LIGHT

PERIOD, CARRIER = 0.01, 4.3e9  # s, Hz


def test_map_agrees_with_the_transform_by_definition() -> None:
    rng = np.random.default_rng(3)
    scans = (rng.normal(size=(4, 12)) + 1j * rng.normal(size=(4, 12))).astype(np.complex64)
    weights = rd.hann(12)
    got = rd.range_doppler_map(scans, weights, 32)
    for k in range(32):
        line = np.exp(-2j * math.pi * k * np.arange(12) / 32)
        assert np.abs(got[:, k] - (scans * weights * line).sum(axis=1)).max() < 1e-4


@pytest.mark.parametrize("speed", [-1.2, -0.05, 0.3, 1.6])
def test_a_scatterer_shows_at_its_speed_positive_when_approaching(speed: float) -> None:
    times = np.arange(64) * PERIOD
    distance = 1.5 - speed * times
    echo = np.exp(-4j * math.pi * CARRIER / SPEED_OF_LIGHT * distance).astype(np.complex64)
    peak = np.abs(rd.range_doppler_map(echo[None, :], rd.hann(64), 256))[0].argmax()
    grid = rd.speed_per_bin(scan_period=PERIOD, carrier=CARRIER, transform=256)
    assert rd.speed_of_bin(peak, scan_period=PERIOD, carrier=CARRIER, transform=256) == pytest.approx(
        speed, abs=grid / 2 + 1e-6
    )


def test_speed_limit_is_that_of_the_paper_s_radar() -> None:
    assert rd.speed_limit(scan_period=PERIOD, carrier=CARRIER) == pytest.approx(1.74, abs=5e-3)  # cane.md row 1
    half = rd.speed_of_bin(128, scan_period=PERIOD, carrier=CARRIER, transform=256)
    assert abs(half) == pytest.approx(rd.speed_limit(scan_period=PERIOD, carrier=CARRIER))


def test_speeds_are_in_fft_order() -> None:
    got = rd.speed_of_bin(np.arange(8), scan_period=PERIOD, carrier=CARRIER, transform=8)
    expected = np.fft.fftfreq(8, PERIOD) * SPEED_OF_LIGHT / (2 * CARRIER)
    assert got == pytest.approx(expected)


def test_bins_and_ranges_are_inverse() -> None:
    bins = np.arange(-3, 300)
    assert np.array_equal(
        rd.bin_of_range(rd.range_of_bin(bins, start=0.3, step=0.00915), start=0.3, step=0.00915), bins
    )


@pytest.mark.parametrize("length", [32, 64])
def test_hann_is_symmetric_and_has_the_spectrum_of_its_formula(length: int) -> None:
    window = rd.hann(length)
    assert window == pytest.approx(window[::-1])
    assert window.min() > 0
    cells = np.linspace(0.05, 3.95, 79)  # but for 1, where the formula is 0 / 0
    cells = cells[np.abs(cells - 1) > 1e-3]
    n = np.arange(length)
    spectrum = np.abs(np.exp(-2j * math.pi * np.outer(cells, n) / length) @ window) / window.sum()
    assert spectrum == pytest.approx(np.abs(np.sinc(cells) / (1 - cells**2)), abs=2e-3)


def test_window_is_the_newest_scans_in_order() -> None:
    window = rd.SlowTimeWindow(length=5, bins=3)
    for k in range(1, 14):
        window.push(np.full(3, k, dtype=np.complex64))
        expected = [max(i, 0) for i in range(k - 4, k + 1)]
        assert window.view().tolist() == [expected] * 3


def test_window_gives_some_bins_to_be_kept() -> None:
    rng = np.random.default_rng(6)
    window = rd.SlowTimeWindow(length=5, bins=7)
    bins = np.array([0, 2, 2, 6])
    for _ in range(8):
        window.push((rng.normal(size=7) + 1j * rng.normal(size=7)).astype(np.complex64))
        before = window.view().copy()
        kept = window.of(bins)
        assert np.array_equal(kept, before[bins].T)
        kept[:] = 0
        assert np.array_equal(window.view(), before)
