"""Pulse pairs on a real P440 that rolls along a rail past two corner reflectors, against optical tracking.

A pulse pair is the mean Doppler of all that is in its range cell, weighed by power. The rail's antenna sees all round,
so beside a reflector there is a ring of room that closes at every rate from -v to v: an eighth to a fifth of the power
lies near zero Doppler, and the slope at lag 1 is 0.8 to 0.9. The ring falls out of step within three scans, the
reflector does not: lags 1 to 6 together have the slope 1.00 of the strongest line (test_rail_recording.py). Clock
shift, range bias and carrier are those that come with the recording, not fitted here.
"""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from caneflow.algorithms.radar.moving_returns import MovingReturnsFilter, MovingReturnsSettings, RadarParameters
from caneflow.algorithms.radar.pulse_pairs import PulsePairWindow, line_phase
from caneflow.physics import SPEED_OF_LIGHT
from caneflow.protocols.mrm_logs import parse_log
from caneflow.protocols.mrm_scans import Scan

Floats = NDArray[np.float64]
RAIL = Path(__file__).parents[1].parent / "shared" / "data" / "p440-rail-mocap"
REFLECTORS = ((2.204, 0.038, -3.874), (2.329, 0.040, 1.038))  # m, x y z of the optical frame, y up
CLOCK_SHIFT = 9.18  # s, optical time less radar time, both from their first sample
RANGE_BIAS = 0.46  # m, beyond the 10 ns of the antenna path
CARRIER = 4.07e9  # Hz, the centre of the band as received
PAIRS, STRIDE = 31, 4  # in a sum, and scans from one sum to the next: 32 scans, as the tracking's own comparison
MOVING = 0.1  # m/s of range rate
COHERENT = 0.85  # below, a gate holds more room than reflector


def recorded() -> tuple[Scan, ...]:
    path = RAIL / "scan_2105627.txt"
    if not path.exists():
        pytest.skip("the rail recording is not here")
    return parse_log(path.read_bytes()).scans


def tracked_ranges(times: Floats) -> Floats:
    """Optical ranges (m) of the reflectors at radar `times`, shape (2, len(times))."""
    with (RAIL / "group6_trial_008.csv").open(newline="") as file:
        rows = [row for row in csv.reader(file) if row and row[0].isdigit() and all(row[5:9])]
    optical = np.array([[float(row[1]), *map(float, row[6:9])] for row in rows])
    at = times + CLOCK_SHIFT
    radar = np.stack([np.interp(at, optical[:, 0], optical[:, 1 + axis]) for axis in range(3)], axis=1)
    return np.stack([np.linalg.norm(radar - reflector, axis=1) for reflector in REFLECTORS])


def measured_and_expected(lags: int, coherent: float) -> tuple[Floats, Floats]:
    """Range rates (m/s) by pulse pairs at lags 1 to `lags`, and by optics; the reflector's gate moves with it."""
    scans = recorded()
    times = np.array([s.timestamp_ms - scans[0].timestamp_ms for s in scans]) / 1e3
    period = float(np.median(np.diff(times)))
    parameters = RadarParameters(
        scan_period=period,
        range_start=scans[0].range_start(),
        range_step=scans[0].range_step,
        carrier=4.3e9,  # nominal: where the band is cut out
        bandwidth=1.7e9,
    )
    moving = MovingReturnsFilter(MovingReturnsSettings())
    windows = [PulsePairWindow(window=1, cell=0.02, lag=lag) for lag in range(1, lags + 1)]
    ranges = tracked_ranges(times)
    pairs, power = np.zeros((2, len(scans), lags), np.complex128), np.zeros((2, len(scans)))
    for last, scan in enumerate(scans):
        returns = moving.update(round(times[last] * 1e9) + 1, np.array(scan.samples)[None], parameters)
        for window in windows:
            window.push(returns)
        for reflector, lag in np.ndindex(2, lags):
            gate = ranges[reflector, max(last - lag - 1, 0) : last + 1].mean() + RANGE_BIAS
            sums = windows[lag].sums(gate - 0.03, gate + 0.03)
            pairs[reflector, last, lag] = sums.pairs.sum()
            if lag == 0:
                power[reflector, last] = sums.power.sum()
    measured, expected = [], []
    for start in range(0, len(scans) - PAIRS, STRIDE):
        inside, used = slice(start, start + PAIRS + 1), slice(start + lags, start + PAIRS + 1)
        period = float(np.ptp(times[inside])) / PAIRS
        for reflector in range(2):
            approach = -float(np.polyfit(times[inside], ranges[reflector, inside], 1)[0])
            totals = pairs[reflector, used].sum(axis=0)
            if abs(approach) > MOVING and abs(totals[0]) > coherent * power[reflector, used].sum():
                measured.append(line_phase(totals) / period * SPEED_OF_LIGHT / (4 * math.pi * CARRIER))
                expected.append(approach)
    return np.array(measured), np.array(expected)


def test_lags_one_to_six_have_the_range_rates_of_the_reflectors() -> None:
    """The criterion of test_rail_recording.py, by pulse pairs, in all windows, whatever else is in the gate."""
    y, x = measured_and_expected(6, coherent=0.0)
    errors = y - x
    assert len(errors) >= 100
    assert abs(np.median(errors)) < 0.03
    assert 1.4826 * np.median(np.abs(errors - np.median(errors))) < 0.06
    inliers = np.abs(errors) < 0.2  # a gate may hold something stronger than the reflector
    assert inliers.mean() > 0.9
    x, y = x[inliers], y[inliers]
    assert (x @ y) / (x @ x) == pytest.approx(1.0, abs=0.03)


def test_lag_one_alone_is_drawn_to_zero_by_the_room_beside_the_reflector() -> None:
    y, x = measured_and_expected(1, coherent=COHERENT)
    errors = y - x
    assert len(errors) >= 50
    assert abs(np.median(errors)) < 0.03
    assert 1.4826 * np.median(np.abs(errors - np.median(errors))) < 0.06
    assert 0.8 < (x @ y) / (x @ x) < 0.97


@pytest.mark.parametrize("phase", [-1.2, -0.3, 0.0, 0.4, 1.6])
def test_a_line_is_told_from_a_ring_that_is_as_strong(phase: float) -> None:
    """A ring at all azimuths has the correlation J0(k phase): Jakes' spectrum, symmetric about zero."""
    lags = np.arange(1, 13)
    azimuths = np.linspace(0.0, math.pi, 2001)
    ring = np.cos(np.outer(lags, phase * np.cos(azimuths))).mean(axis=1)
    pairs = np.exp(1j * phase * lags) + ring
    assert line_phase(pairs) == pytest.approx(phase, abs=0.06)
    if abs(phase) > 0.2:
        assert abs(float(np.angle(pairs[0]))) < abs(phase) - 0.09, "by lag 1 alone"
    assert line_phase(np.exp(1j * phase * lags)) == pytest.approx(phase, abs=1e-3)
