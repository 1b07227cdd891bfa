"""The analytic signal against the transform by definition, and against an echo whose phase is known."""

import math

import numpy as np
import pytest

from caneflow.algorithms.radar.analytic_signal import AnalyticSignal, fast_time_frequencies
from caneflow.physics import SPEED_OF_LIGHT

STEP = 0.009149  # m
CARRIER, BANDWIDTH = 4.3e9, 1.7e9  # Hz


def analytic_by_definition(scan: np.ndarray) -> np.ndarray:
    """Sum over the positive lines of the pulse's band, each by its own sum over the samples."""
    bins = len(scan)
    n = np.arange(bins)
    signal = np.zeros(bins, dtype=np.complex128)
    for line in range(bins // 2):
        frequency = line * SPEED_OF_LIGHT / (2 * STEP * bins)
        if abs(frequency - CARRIER) <= BANDWIDTH / 2:
            coefficient = (scan * np.exp(-2j * math.pi * line * n / bins)).sum()
            signal += 2 * coefficient * np.exp(2j * math.pi * line * n / bins) / bins
    return signal


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.float32])
@pytest.mark.parametrize("bins", [96, 97])
def test_agrees_with_the_transform_by_definition(dtype: type, bins: int) -> None:
    scans: np.ndarray = np.random.default_rng(1).integers(-30_000, 30_000, (3, bins)).astype(dtype)
    got = AnalyticSignal(bins=bins, range_step=STEP, carrier=CARRIER, bandwidth=BANDWIDTH)(scans)
    assert got.dtype == np.complex64
    for scan, signal in zip(scans, got, strict=True):
        assert np.abs(signal - analytic_by_definition(scan.astype(np.float64))).max() < 0.05


def test_phase_of_an_echo_grows_as_its_range_shrinks() -> None:
    bins = 288
    ranges = np.arange(bins) * STEP
    pulse = AnalyticSignal(bins=bins, range_step=STEP, carrier=CARRIER, bandwidth=BANDWIDTH)
    wave_number = 4 * math.pi * CARRIER / SPEED_OF_LIGHT  # rad of echo phase per metre of range

    def echo(distance: float) -> np.ndarray:
        away = ranges - distance
        return np.asarray(1e4 * np.exp(-0.5 * (away / 0.0426) ** 2) * np.cos(wave_number * away))

    near, far = pulse(np.stack([echo(1.300), echo(1.305)]))
    at = round(1.30 / STEP)
    # 3 %: the band is centred on the carrier, but the pulse's own centre is a line of the spectrum off.
    assert np.angle(near[at] * far[at].conj()) == pytest.approx(wave_number * 0.005, rel=0.03)
    # The envelope, less what a Gaussian spectrum has outside of its -10 dB points.
    assert np.abs(near[at]) == pytest.approx(1e4 * math.erf(math.sqrt(math.log(10) / 2)), rel=0.01)


def test_frequencies_are_those_of_the_samples() -> None:
    frequencies = fast_time_frequencies(288, STEP)
    assert frequencies.shape == (145,)
    assert frequencies[-1] == pytest.approx(SPEED_OF_LIGHT / (4 * STEP)), "Nyquist: two samples a period"


@pytest.mark.parametrize(("step", "carrier"), [(0.02, 4.3e9), (STEP, 24e9)])
def test_a_pulse_that_the_samples_cannot_hold_is_refused(step: float, carrier: float) -> None:
    with pytest.raises(ValueError, match=r"does not show in 96 samples every"):
        AnalyticSignal(bins=96, range_step=step, carrier=carrier, bandwidth=1e9)


def test_a_carrier_beyond_what_the_samples_hold_is_refused_though_the_band_reaches_in() -> None:
    highest = float(fast_time_frequencies(96, STEP)[-1])
    AnalyticSignal(bins=96, range_step=STEP, carrier=0.99 * highest, bandwidth=BANDWIDTH)
    with pytest.raises(ValueError, match="does not show in 96 samples"):
        AnalyticSignal(bins=96, range_step=STEP, carrier=highest, bandwidth=BANDWIDTH)


def test_with_soft_ends_a_strong_echo_does_not_ring() -> None:
    """Half a metre off the sharp band rings at -35 dB or more; softened it is 30 dB below that."""
    bins = 288
    offset = STEP * (np.arange(bins) - 60)
    scan = np.exp(-0.5 * (offset / 0.02) ** 2) * np.cos(4 * math.pi * CARRIER / SPEED_OF_LIGHT * offset)
    signal = AnalyticSignal(bins=bins, range_step=STEP, carrier=CARRIER, bandwidth=BANDWIDTH)
    sharp = signal(scan[None].astype(np.float32))[0]
    soft = signal.softened(sharp)
    far = slice(115, 230)
    ringing = 20 * np.log10(np.abs(sharp[far]).max() / np.abs(sharp).max())
    softened = 20 * np.log10(np.abs(soft[far]).max() / np.abs(soft).max())
    assert ringing > -45
    assert softened < ringing - 20
    assert 0.3 < np.abs(soft).max() / np.abs(sharp).max() < 0.8


def test_a_scan_that_no_gateway_holds_is_refused() -> None:
    with pytest.raises(ValueError, match="is too long"):
        AnalyticSignal(bins=200_000, range_step=STEP, carrier=CARRIER, bandwidth=BANDWIDTH)
