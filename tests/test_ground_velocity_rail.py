"""Pulse pairs on a real P440 that rolls along a rail past two corner reflectors, against optical tracking.

Clock shift, range bias and carrier are those that come with the recording, not fitted here.
"""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from caneflow.algorithms.moving_returns import MovingReturnsFilter, MovingReturnsSettings, RadarParameters
from caneflow.algorithms.pulse_pairs import PulsePairWindow
from caneflow.algorithms.range_doppler import SPEED_OF_LIGHT
from caneflow.protocols.mrm_scans import Scan, parse_log

Floats = NDArray[np.float64]
RAIL = Path(__file__).parents[1].parent / "shared" / "data" / "p440-rail-mocap"
REFLECTORS = ((2.204, 0.038, -3.874), (2.329, 0.040, 1.038))  # m, x y z of the optical frame, y up
CLOCK_SHIFT = 9.18  # s, optical time less radar time, both from their first sample
RANGE_BIAS = 0.46  # m, beyond the 10 ns of the antenna path
CARRIER = 4.07e9  # Hz, the centre of the band as received
PAIRS, STRIDE = 31, 8  # in a sum, and scans from one sum to the next: 32 scans, as the tracking's own comparison
MOVING = 0.1  # m/s of range rate


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


def test_range_gated_pulse_pairs_are_the_range_rates() -> None:
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
    window = PulsePairWindow(window=PAIRS, cell=0.05)
    ranges = tracked_ranges(times)
    measured, expected = [], []
    for last, scan in enumerate(scans):
        window.push(moving.update(round(times[last] * 1e9) + 1, np.array(scan.samples)[None], parameters))
        if last % STRIDE or window.interval_ns() is None:
            continue
        oldest_ns, newest_ns = window.interval_ns() or (0, 0)
        inside = slice(last - PAIRS, last + 1)
        for tracked in ranges[:, inside]:
            approach = -float(np.polyfit(times[inside], tracked, 1)[0])
            gate = tracked.mean() + RANGE_BIAS
            sums = window.sums(gate - 0.05, gate + 0.05)
            if len(sums.ranges) == 0 or abs(approach) < MOVING:
                continue
            turn = np.angle(sums.pairs.sum()) / ((newest_ns - oldest_ns) * 1e-9 / PAIRS)
            measured.append(float(turn) * SPEED_OF_LIGHT / (4 * math.pi * CARRIER))
            expected.append(approach)
    errors = np.subtract(measured, expected)
    sigma = 1.4826 * np.median(np.abs(errors - np.median(errors)))
    assert len(errors) >= 50
    assert abs(np.median(errors)) < 0.03
    assert sigma < 0.06
    inliers = np.abs(errors) < 0.2  # a gate may hold something stronger than the reflector
    assert inliers.mean() > 0.9
    x, y = np.array(expected)[inliers], np.array(measured)[inliers]
    assert (x @ y) / (x @ x) == pytest.approx(1.0, abs=0.03)
