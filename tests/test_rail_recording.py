"""A real P440 on a rail past two corner reflectors, against optical tracking: packets to Doppler, end to end.

The recording shows that packets, range axis, analytic signal, range-Doppler map and carrier are right on the exact
radar. Its clocks are not synchronised; shift and range bias are the best fit that comes with it, not fitted here.
"""

import csv
from pathlib import Path

import numpy as np
import pytest

from caneflow.algorithms.radar.analytic_signal import AnalyticSignal
from caneflow.algorithms.radar.background import Background
from caneflow.algorithms.radar.range_doppler import bin_of_range, hann, range_doppler_map, speed_of_bin
from caneflow.protocols.mrm_logs import parse_log
from caneflow.protocols.mrm_scans import Scan

RAIL = Path(__file__).parents[1].parent / "shared" / "data" / "p440-rail-mocap"
REFLECTORS = ((2.204, 0.038, -3.874), (2.329, 0.040, 1.038))  # m, x y z of the optical frame, y up
CLOCK_SHIFT = 9.18  # s, optical time less radar time, both from their first sample
RANGE_BIAS = 0.46  # m, beyond the 10 ns of the antenna path
CARRIER = 4.07e9  # Hz, the centre of the band as received
WINDOW, STRIDE, TRANSFORM = 32, 8, 512  # scans, scans, Doppler bins
MOVING = 0.1  # m/s of range rate


@pytest.fixture(scope="module")
def scans() -> tuple[Scan, ...]:
    path = RAIL / "scan_2105627.txt"
    if not path.exists():
        pytest.skip("the rail recording is not here")
    return parse_log(path.read_bytes()).scans


@pytest.fixture(scope="module")
def moving(scans: tuple[Scan, ...]) -> np.ndarray:
    """Analytic scans without their background, shape (scans, bins)."""
    first = scans[0]
    analytic = AnalyticSignal(bins=len(first.samples), range_step=first.range_step, carrier=4.3e9, bandwidth=1.7e9)
    returns = analytic(np.stack([s.samples for s in scans]))
    background = Background(0.5)
    for scan, elapsed in zip(returns, np.diff(times_of(scans), prepend=0.0), strict=True):
        background.remove(scan, elapsed)
    return returns


def times_of(scans: tuple[Scan, ...]) -> np.ndarray:
    """Seconds since the first scan."""
    return np.array([s.timestamp_ms - scans[0].timestamp_ms for s in scans]) / 1e3


def tracked_places(at: np.ndarray) -> np.ndarray:
    """Places (m, optical frame) of the radar at optical times `at` (s), shape (len(at), 3)."""
    with (RAIL / "group6_trial_008.csv").open(newline="") as file:
        rows = [row for row in csv.reader(file) if row and row[0].isdigit() and all(row[5:9])]
    optical = np.array([[float(row[1]), *map(float, row[6:9])] for row in rows])
    return np.stack([np.interp(at, optical[:, 0], optical[:, 1 + axis]) for axis in range(3)], axis=1)


def tracked_ranges(times: np.ndarray) -> np.ndarray:
    """Optical ranges (m) of the reflectors at radar `times`, shape (reflectors, len(times))."""
    radar = tracked_places(times + CLOCK_SHIFT)
    return np.stack([np.linalg.norm(radar - reflector, axis=1) for reflector in REFLECTORS])


def test_doppler_of_the_reflectors_is_their_range_rate(scans: tuple[Scan, ...], moving: np.ndarray) -> None:
    times = times_of(scans)
    measured, expected = [], []
    for ranges in tracked_ranges(times):
        for start in range(0, len(scans) - WINDOW, STRIDE):
            window = slice(start, start + WINDOW)
            approach = -np.polyfit(times[window], ranges[window], 1)[0]
            gate = int(
                bin_of_range(
                    ranges[window].mean() + RANGE_BIAS,
                    start=scans[0].range_start(),
                    step=scans[0].range_step,
                )
            )
            if not 0 <= gate < moving.shape[1] or abs(approach) < MOVING:
                continue
            spectrum = np.abs(range_doppler_map(moving[None, window, gate], hann(WINDOW), TRANSFORM))[0]
            period = float(np.ptp(times[window])) / (WINDOW - 1)
            peak = int(spectrum.argmax())
            measured.append(float(speed_of_bin(peak, scan_period=period, carrier=CARRIER, transform=TRANSFORM)))
            expected.append(float(approach))
    errors = np.subtract(measured, expected)
    sigma = 1.4826 * np.median(np.abs(errors - np.median(errors)))
    assert len(errors) >= 50
    assert abs(np.median(errors)) < 0.03
    assert sigma < 0.06
    inliers = np.abs(errors) < 0.2  # a gate may hold something stronger than the reflector
    assert inliers.mean() > 0.9
    x, y = np.array(expected)[inliers], np.array(measured)[inliers]
    assert (x @ y) / (x @ x) == pytest.approx(1.0, abs=0.03), "speed scale, so carrier and scan period"


def test_the_wrong_sign_of_doppler_would_be_seen(scans: tuple[Scan, ...]) -> None:
    """Both reflectors come and go: the recording can tell approaching from receding."""
    rates = np.gradient(tracked_ranges(times_of(scans)), times_of(scans), axis=1)
    assert rates.min() < -MOVING
    assert rates.max() > MOVING
