"""Hypotheses of the gyro's errors: their weights against the textbook's Gaussian process, and what a loop teaches."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from caneflow.algorithms.cane.heading_hypotheses import Heading, HeadingHypotheses, HeadingSettings

DEGREE = math.pi / 180.0
Floats = NDArray[np.float64]


class Anomaly:
    """A smooth field of directions, rad: cosines over the plane; sd 10 deg over 2 m, as indoors."""

    def __init__(self, seed: int, *, deviation: float = 10.0 * DEGREE, scale: float = 2.0) -> None:
        rng = np.random.default_rng(seed)
        self._waves = rng.normal(0.0, 1.0 / scale, (64, 2))
        self._phases = rng.uniform(0.0, 2.0 * math.pi, 64)
        self._size = deviation * math.sqrt(2.0 / 64)

    def __call__(self, x: float, y: float) -> float:
        return float(self._size * np.cos(self._waves @ (x, y) + self._phases).sum())


def loop_walk(
    seed: int, *, bias: float, scale: float = 0.0, field: bool = True, settings: HeadingSettings | None = None
) -> tuple[HeadingHypotheses, Heading, complex]:
    """Once round 8 x 3 m at 0.45 m/s with a gyro that errs; returns the estimate and the true end, in true axes."""
    hypotheses = HeadingHypotheses(settings or HeadingSettings())
    anomaly, rng = Anomaly(seed), np.random.default_rng(seed)
    corners = [0j, 8 + 0j, 8 + 3j, 3j, 0j]
    place, yaw, gyro_yaw = 0j, 0.0, 0.0
    for begin, end in pairwise(corners):
        goal = math.atan2((end - begin).imag, (end - begin).real)
        steps = [(0.0, math.remainder(goal - yaw, 2 * math.pi) / 15)] * 15  # turn for 1.5 s, then walk
        steps += [(abs(end - begin) / round(abs(end - begin) / 0.045), 0.0)] * round(abs(end - begin) / 0.045)
        for stride, turn in steps:
            yaw += turn
            moved = complex(stride * math.cos(yaw), stride * math.sin(yaw))
            place += moved
            measured = turn * (1.0 + scale) + bias * 0.1
            gyro_yaw += measured
            drift = gyro_yaw - yaw
            in_gyros = moved * complex(math.cos(drift), math.sin(drift))
            hypotheses.move(0.1, measured, in_gyros.real, in_gyros.imag)
            if field:
                seen = anomaly(place.real, place.imag) + drift + rng.normal(0.0, 2.0 * DEGREE)
                hypotheses.field(seen, from_chip=False)
            hypotheses.advance(0.0)
    return hypotheses, hypotheses.heading(), place


def test_weights_are_those_of_a_gaussian_process_worked_out_at_once() -> None:
    settings = HeadingSettings(biases=5, knots=16, knot_interval=1.0)
    hypotheses = HeadingHypotheses(settings)
    rng = np.random.default_rng(3)
    fields = rng.normal(0.0, 0.2, 6)
    variances = 0.01 * np.arange(6)
    moves = rng.normal(0.0, 0.4, (6, 2))
    for (dx, dy), field, variance in zip(moves, fields, variances, strict=True):
        hypotheses.move(1.0, 0.3, dx, dy)
        hypotheses.field(field, from_chip=False)
        hypotheses.advance(variance)

    log = []
    spreads = np.array(settings.bias_spreads)
    grid = settings.largest_bias * np.sinh(np.linspace(-2, 2, 5)) / math.sinh(2)
    for bias, cell in zip(grid, np.gradient(grid), strict=True):
        for scale, mass in zip(settings.scale_error * math.sqrt(3) * np.array([-1, 0, 1]), (1, 4, 1), strict=True):
            times = np.arange(1.0, 7.0)
            yaw = -(bias * times + scale * 0.3 * times)
            places = np.cumsum((moves[:, 0] + 1j * moves[:, 1]) * np.exp(1j * yaw))
            square = np.abs(places[:, None] - places) ** 2
            wide = settings.field_scale**2 + np.abs(variances[:, None] - variances)
            covariance = (settings.field_error * settings.field_scale) ** 2 / wide * np.exp(-square / (2 * wide))
            covariance += settings.rough_error**2 * np.exp(-np.sqrt(square) / settings.rough_scale) + 1.0
            covariance += settings.field_noise**2 * np.eye(6)
            prior = np.mean(np.exp(-0.5 * (bias / spreads) ** 2) / spreads) * cell * mass
            likelihood = multivariate_normal(np.zeros(6), covariance).logpdf(fields - fields[0] + yaw)
            log.append(math.log(prior) + likelihood)
    weights = np.exp(np.array(log) - max(log))
    weights /= weights.sum()
    assert hypotheses.bias == pytest.approx(float(weights @ np.repeat(grid, 3)), rel=1e-6)


def test_loops_over_fields_that_nobody_knows_show_the_bias() -> None:
    """Six fields: what is left of a bias of 0.2 deg/s, and of the error at the end that it makes."""
    left, ends, blind_ends = [], [], []
    for seed in range(6):
        hypotheses, heading, end = loop_walk(seed, bias=0.2 * DEGREE)
        blind, lost, _ = loop_walk(seed, bias=0.2 * DEGREE, field=False)
        assert blind.bias == pytest.approx(0.0, abs=1e-9)
        left.append(hypotheses.bias / DEGREE - 0.2)
        ends.append(abs(heading.position - end))
        blind_ends.append(abs(lost.position - end))
    assert np.sqrt(np.mean(np.square(left))) < 0.1
    assert np.mean(ends) < 0.6 * np.mean(blind_ends)


def test_the_spread_is_what_the_errors_are() -> None:
    """Squared errors of the final position in units of the covariance over 24 loops: 2 is expected of two axes."""
    squares = []
    for seed in range(24):
        rng = np.random.default_rng(100 + seed)
        spread = rng.choice([0.025, 0.05, 0.1, 0.2, 0.4]) * DEGREE
        scale = rng.normal(0.0, 0.007)
        _, heading, end = loop_walk(seed, bias=rng.normal(0.0, spread), scale=scale)
        off = heading.position - end
        covariance = np.array([[heading.xx, heading.xy], [heading.xy, heading.yy]])
        error = np.array([off.real, off.imag])
        squares.append(error @ np.linalg.solve(covariance + 1e-4 * np.eye(2), error))
    assert 0.3 < np.mean(squares) < 3.0


def test_good_level_axes_make_a_bias_less_likely() -> None:
    def spread(level: float) -> float:
        hypotheses = HeadingHypotheses(HeadingSettings())
        hypotheses.level_biases(level, 0.02 * DEGREE, level, 0.05 * DEGREE)
        hypotheses.move(10.0, 0.0, 10.0, 0.0)
        hypotheses.field(0.0, from_chip=False)
        hypotheses.advance(0.0)
        return math.sqrt(hypotheses.heading().yaw_variance)

    assert spread(0.0) < 0.5 * spread(0.2 * DEGREE)


def test_thinning_and_refining_keep_what_was_learnt() -> None:
    settings = HeadingSettings()
    _, whole, end = loop_walk(5, bias=0.2 * DEGREE, settings=settings)
    hypotheses, thinned, _ = loop_walk(5, bias=0.2 * DEGREE, settings=replace(settings, knots=32))
    assert abs(thinned.position - whole.position) < 0.15
    assert hypotheses.bias == pytest.approx(0.2 * DEGREE, abs=0.12 * DEGREE)
    assert abs(whole.position - end) < 0.6


def test_the_same_walk_gives_the_same_numbers() -> None:
    _, first, _ = loop_walk(6, bias=0.1 * DEGREE)
    _, second, _ = loop_walk(6, bias=0.1 * DEGREE)
    assert first == second
