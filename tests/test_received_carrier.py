"""The carrier of radar scans, measured: pulses of known spectrum that move, noise, and a real P440 on a rail."""

import math
from pathlib import Path

import numpy as np
import pytest

from caneflow.algorithms.radar.received_carrier import BAND, CarrierMeter, ReceivedCarrier, received_carrier
from caneflow.physics import SPEED_OF_LIGHT
from caneflow.protocols.mrm_logs import parse_log

RAIL = Path(__file__).parents[1].parent / "shared" / "data" / "p440-rail-mocap" / "scan_2105627.txt"
STEP, BINS, PERIOD = 9.149e-3, 480, 0.0173  # m, samples, s


def scans_of(carrier: float, speed: float, count: int, noise: float = 0.03, seed: int = 1) -> np.ndarray:
    """A reflector that comes nearer at `speed` m/s, seen by a pulse around `carrier` (Hz), 1.4 GHz wide at -10 dB."""
    width = 0.7e9 / math.sqrt(math.log(10.0))
    ranges = STEP * np.arange(BINS) - (3.0 - speed * PERIOD * np.arange(count))[:, None]
    envelope = np.exp(-((2.0 * math.pi * width * ranges / SPEED_OF_LIGHT) ** 2))
    echo = envelope * np.cos(4.0 * math.pi * carrier * ranges / SPEED_OF_LIGHT)
    return np.asarray(echo + noise * np.random.default_rng(seed).standard_normal(echo.shape))


def times_of(count: int) -> np.ndarray:
    return np.asarray(PERIOD * np.arange(count), dtype=np.float64)


@pytest.mark.parametrize("carrier", [3.9e9, 4.05e9, 4.3e9])
@pytest.mark.parametrize("speed", [0.3, -0.5])
def test_the_carrier_is_that_of_the_pulse(carrier: float, speed: float) -> None:
    count = 150
    found = received_carrier(scans_of(carrier, speed, count), times_of(count), STEP)
    assert found is not None
    assert found.carrier == pytest.approx(carrier, rel=0.01)
    assert found.error < 0.02 * carrier


@pytest.mark.parametrize("speed", [0.0, 0.02])
def test_what_does_not_move_says_nothing(speed: float) -> None:
    assert received_carrier(scans_of(4.1e9, speed, 100), times_of(100), STEP) is None


def test_noise_and_few_scans_say_nothing() -> None:
    noise = np.random.default_rng(2).standard_normal((100, BINS))
    assert received_carrier(noise, times_of(100), STEP) is None
    assert received_carrier(noise[:10], times_of(10), STEP) is None
    assert received_carrier(noise[:, :8], times_of(100), STEP) is None
    assert BAND[0] < 4.1e9 < BAND[1]


def test_a_radar_that_runs_is_told_once() -> None:
    meter = CarrierMeter()
    scans = scans_of(4.05e9, 0.18, 950)
    found = [one for index, scan in enumerate(scans) if (one := meter.update(PERIOD * index, scan, STEP))]
    assert found
    assert found[0].carrier == pytest.approx(4.05e9, rel=0.01)
    assert found[0].settled


def test_the_error_is_that_of_half_as_many_echoes() -> None:
    assert ReceivedCarrier(carrier=4e9, spread=6e7, echoes=50).error == pytest.approx(1.2e7)


def test_a_real_p440_receives_lower_than_it_is_said_to_send() -> None:
    """On the rail: optical tracking says 4.07 GHz (data of the recording), the middle of the band is 4.3."""
    if not RAIL.exists():
        pytest.skip("the rail recording is not here")
    scans = parse_log(RAIL.read_bytes()).scans
    times = np.array([scan.timestamp_ms for scan in scans]) / 1e3
    found = received_carrier(np.stack([scan.samples for scan in scans]).astype(float), times, scans[0].range_step)
    assert found is not None
    assert found.carrier == pytest.approx(4.07e9, rel=0.02)
    assert found.spread < 0.03 * found.carrier
