"""The ground seen by a weak, fast radar (A121): the speed where it is seen, rest where ground stands, else nothing."""

import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest

from caneflow.algorithms.radar.matched_velocity import Doubts, lag_sums, matched_speed
from caneflow.messages import GroundSpeed, Sample
from caneflow.testing import run_operator
from operators.ground_speed import GroundSpeedOperator
from tests.weak_radar import RIG, weak_walk

SETTLED = 30  # frames, after which the background of the start is forgotten


@cache
def steady(snr: float, speed: float, points: int = 30) -> tuple[Mapping[str, list[Sample]], np.ndarray]:
    start = 0.7 if points > 4 else 1.0
    return weak_walk(snr, lambda _: speed, seed=7, seconds=0.9, start=start, points=points)


def said_of(inputs: Mapping[str, list[Sample]], **settings: Any) -> list[GroundSpeed]:
    return run_operator(GroundSpeedOperator, inputs, rig=RIG, settings=settings)["speed"]  # type: ignore[return-value]


def seen_of(said: list[GroundSpeed]) -> np.ndarray:
    """Velocity and its standard deviation where it was observed, from frame SETTLED on, (n, 2)."""
    found = [
        (each.velocity[0], math.sqrt(each.velocity_cov[0]))
        for each in said[SETTLED:]
        if each.velocity is not None and each.velocity_cov is not None and each.velocity_cov[0] < 1e3
    ]
    return np.array(found).reshape(-1, 2)


def test_one_speed_turns_all_cells() -> None:
    """Without noise the sum's top is the true speed, and the prior on the vertical speed leaves it there."""
    per_forward, per_vertical = np.linspace(0.4, 0.8, 20), -np.linspace(0.7, 0.3, 20)
    phase = per_forward * 0.7 + per_vertical * 0.1
    sweeps = np.exp(1j * phase * np.arange(100)[:, None]).astype(np.complex64)
    doubts = Doubts(rise=0.02, least=0.01, speckle=0.02)
    found = matched_speed(lag_sums(sweeps), per_forward, per_vertical, 0.0 * per_forward, 0.1, doubts)
    assert found is not None
    assert found.forward == pytest.approx(0.7, abs=1e-3)
    assert found.significance > 10.0


def test_noise_alone_has_no_significance() -> None:
    random = np.random.default_rng(2)
    doubts = Doubts(rise=0.02, least=0.01, speckle=0.02)
    slopes = np.linspace(0.4, 0.8, 20)
    highest = 0.0
    for _ in range(300):
        noise = (random.normal(size=(100, 20)) + 1j * random.normal(size=(100, 20))).astype(np.complex64)
        found = matched_speed(lag_sums(noise), slopes, -slopes, 0.0 * slopes, 0.0, doubts)
        highest = max(highest, found.significance if found is not None else 0.0)
    assert 1.5 < highest < 6.0


@pytest.mark.parametrize(("snr", "speed", "spread"), [(6.0, 1.0, 0.045), (0.0, 1.0, 0.05)])
def test_a_steady_walk(snr: float, speed: float, spread: float) -> None:
    seen = seen_of(said_of(steady(snr, speed)[0]))
    assert len(seen) >= 11  # of 12
    error = seen[:, 0] - speed
    assert abs(error.mean()) < 0.01 + 0.04 * speed + 2.0 * spread / math.sqrt(len(seen) / 2)
    assert error.std() < 1.3 * spread
    assert np.all(np.abs(error) < 4.0 * seen[:, 1] + 0.01)
    assert 0.1 < np.mean((error / seen[:, 1]) ** 2) < 3.0


def test_where_nothing_is_seen_nothing_is_claimed() -> None:
    """The worst fault of a weak radar: it walks at 1 m/s and says that it stands."""
    said = said_of(steady(-12.0, 1.0)[0])[SETTLED:]
    assert not [each for each in said if each.valid and each.speed == 0.0]
    assert not [each for each in said if each.velocity == (0.0, 0.0) and each.velocity_cov[0] < 1e3]  # type: ignore[index]


def test_ground_that_is_seen_to_stand_is_rest() -> None:
    said = said_of(steady(6.0, 0.0)[0])[SETTLED:]
    assert {(each.valid, each.speed) for each in said} == {(True, 0.0)}
    assert {each.velocity for each in said if each.velocity is not None} == {(0.0, 0.0)}


@pytest.mark.parametrize("points", [1, 4])
def test_few_points_are_enough(points: int) -> None:
    seen = seen_of(said_of(steady(10.0, 1.0, points)[0]))
    assert len(seen) >= 10
    assert abs(np.median(seen[:, 0]) - 1.0) < 0.15


def test_a_lost_frame_costs_no_more_than_itself() -> None:
    inputs, _ = steady(6.0, 1.0)
    frames = [each for index, each in enumerate(inputs["frame"]) if index != 60]
    seen = seen_of(said_of({**inputs, "frame": frames}))
    assert len(seen) >= 11
    assert abs(seen[:, 0] - 1.0).max() < 0.15


def test_an_imu_that_is_behind_a_little_is_no_hindrance() -> None:
    """The window's middle may be younger than the newest attitude."""
    seen = seen_of(said_of(steady(6.0, 1.0)[0], ground_velocity={"window": 0.016}))
    assert len(seen) >= 11


def test_faster_than_unambiguous_is_refused() -> None:
    """2 kHz end at 2.5 m/s of radial speed: 3.9 m/s over ground at 42 deg is refused, not wrapped."""
    walk: Callable[[float], float] = lambda _: 4.2  # noqa: E731
    inputs, _ = weak_walk(6.0, walk, seed=3, seconds=0.6)
    seen = seen_of(said_of(inputs))
    assert not len(seen)
