"""The width of the Doppler: a beam that goes sideways, noise, and what a filter makes of it that learns as it goes."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from caneflow.algorithms.cane.sideways_spread import SidewaysSpread, SidewaysSpreadSettings
from caneflow.algorithms.radar.doppler_spread import doppler_spread

PER_SPEED = 4 * math.pi * 4.3e9 * 0.01 / 299_792_458.0  # rad per m/s, from scan to scan
CELL, CELLS = 8, 20
APERTURE = math.radians(50)
COSINES = np.linspace(0.6, 0.9, CELLS)
MEAN_SQUARE = APERTURE**2 / (16 * math.log(2) * COSINES * math.cos(math.radians(42)))  # of the azimuth's sine
PER_SIDEWAYS = PER_SPEED**2 * COSINES**2 * MEAN_SQUARE


def passing(left: float, *, noise: float = 0.0, seed: int = 0, scans: int = 28) -> NDArray[np.complex64]:
    """Many echoes in each bin, at azimuths as the beam lights them, seen from an antenna that goes to the left."""
    rng = np.random.default_rng(seed)
    shape = (CELLS * CELL, 150)
    sines = rng.normal(0.0, 1.0, shape) * np.sqrt(np.repeat(MEAN_SQUARE, CELL))[:, None]
    rates = PER_SPEED * np.repeat(COSINES, CELL)[:, None] * (left * sines + 0.5)
    echoes = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    made = np.array([(echoes * np.exp(1j * rates * index)).sum(axis=1) for index in range(scans)])
    made += noise * math.sqrt(150) * (rng.normal(size=made.shape) + 1j * rng.normal(size=made.shape))
    return made.astype(np.complex64)


@pytest.mark.parametrize("noise", [0.0, 0.5])
@pytest.mark.parametrize("left", [0.2, 0.4, -0.6])
def test_the_width_is_that_of_the_sideways_speed_with_and_without_noise(left: float, noise: float) -> None:
    found = [doppler_spread(passing(left, noise=noise, seed=s), CELL, 3, PER_SIDEWAYS, least_fit=0.3) for s in range(4)]
    assert all(each is not None for each in found)
    assert np.sqrt(np.mean(np.square(np.array(found, float)))) == pytest.approx(abs(left), rel=0.15)


def test_ground_that_does_not_go_sideways_has_no_width_and_noise_tells_nothing() -> None:
    still = doppler_spread(passing(0.0), CELL, 3, PER_SIDEWAYS, least_fit=0.3)
    assert still is not None
    assert still < 0.02
    rng = np.random.default_rng(1)
    shape = (28, CELLS * CELL)
    noise = (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)
    assert doppler_spread(noise, CELL, 3, PER_SIDEWAYS, least_fit=0.3) is None
    assert doppler_spread(np.zeros(shape, np.complex64), CELL, 3, PER_SIDEWAYS, least_fit=0.3) is None


def learnt(a: float, b: float, error: float) -> tuple[SidewaysSpread, list[tuple[float, float, float]]]:
    """A minute of swinging at 0.5 m/s; (true speed to the left, what was said of it, its variance)."""
    rng = np.random.default_rng(2)
    spread, said = SidewaysSpread(SidewaysSpreadSettings()), []
    for index in range(240):
        yaw = math.radians(25) * math.sin(2 * math.pi * 0.55 * 0.25 * index)
        forward, left = 0.5 * math.cos(yaw) + 0.3 * math.sin(0.1 * index), -0.5 * math.sin(yaw) * 1.8
        seen = math.sqrt(max(a * left**2 + b * forward**2 + error * rng.normal(), 0.0))
        believed = left + 0.03 * float(rng.normal())  # the filter's
        found = spread.update(1_000_000_000 + 250_000_000 * index, seen, forward, believed)
        if found is not None:
            said.append((left, *found))
    return spread, said


@pytest.mark.parametrize(("a", "b"), [(0.9, 0.2), (0.6, 0.1)])
def test_the_coefficients_are_learnt_and_the_speed_has_the_filters_sign(a: float, b: float) -> None:
    spread, said = learnt(a, b, 0.02)
    assert spread.coefficients == pytest.approx((a, b), abs=0.07)
    true, speed, variance = np.array(said).T
    assert len(said) > 60
    assert np.all(true * speed >= 0.0)
    assert np.abs(np.mean(np.abs(speed) - np.abs(true))) < 0.02
    assert 0.2 < np.mean((speed - true) ** 2 / variance) < 1.2


@pytest.mark.parametrize(("a", "error"), [(0.2, 0.01), (0.9, 0.4)])
def test_sparse_ground_and_clutter_say_nothing(a: float, error: float) -> None:
    """Little of the width is the speed's, or much of it is something else's."""
    _, said = learnt(a, 0.1, error)
    assert len(said) < 10
