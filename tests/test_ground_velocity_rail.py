"""Pulse pairs on a real P440 that rolls along a rail past two corner reflectors, against optical tracking.

A pulse pair is the mean Doppler of all that is in its range cell, weighed by power. The rail's antenna sees all round,
so beside a reflector there is a ring of room that closes more slowly: the slope is below the 1.00 that the strongest
line has (test_rail_recording.py), by the tenth and more that is measured here. Clock shift, range bias and carrier are
those that come with the recording, not fitted here.
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
    window = PulsePairWindow(window=1, cell=0.02)
    ranges = tracked_ranges(times)
    pairs, power = np.zeros((2, len(scans)), np.complex128), np.zeros((2, len(scans)))
    for last, scan in enumerate(scans):
        window.push(moving.update(round(times[last] * 1e9) + 1, np.array(scan.samples)[None], parameters))
        for reflector in range(2):
            gate = ranges[reflector, max(last - 1, 0) : last + 1].mean() + RANGE_BIAS  # in 32 scans it moves 0.3 m
            sums = window.sums(gate - 0.03, gate + 0.03)
            pairs[reflector, last], power[reflector, last] = sums.pairs.sum(), sums.power.sum()
    measured, expected = [], []
    for start in range(0, len(scans) - PAIRS, STRIDE):
        inside, used = slice(start, start + PAIRS + 1), slice(start + 1, start + PAIRS + 1)
        period = float(np.ptp(times[inside])) / PAIRS
        for reflector in range(2):
            approach = -float(np.polyfit(times[inside], ranges[reflector, inside], 1)[0])
            total = pairs[reflector, used].sum()
            if abs(approach) > MOVING and abs(total) > COHERENT * power[reflector, used].sum():
                measured.append(float(np.angle(total)) / period * SPEED_OF_LIGHT / (4 * math.pi * CARRIER))
                expected.append(approach)
    errors = np.subtract(measured, expected)
    assert len(errors) >= 50
    assert abs(np.median(errors)) < 0.03
    assert 1.4826 * np.median(np.abs(errors - np.median(errors))) < 0.06
    assert (np.abs(errors) < 0.2).all()
    x, y = np.array(expected), np.array(measured)
    assert 0.8 < (x @ y) / (x @ x) < 1.03
