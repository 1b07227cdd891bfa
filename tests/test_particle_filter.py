"""Particles: resampling by its expectation, a filter against the exact answer of a linear problem, likelihoods."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.algorithms.room.particle_filter import (
    Particles,
    ParticleSettings,
    normal_with_outliers,
    student_t,
    weighted_covariance,
)
from caneflow.algorithms.room.resampling import effective_number, systematic


def test_the_mean_number_of_copies_is_the_weight_times_the_count() -> None:
    """A resampler's test is its expectation; light particles live on as often as they should."""
    weights = np.array([0.45, 0.35, 0.15, 0.05])
    random = np.random.default_rng(0)
    copies = np.mean([np.bincount(systematic(weights, random), minlength=4) for _ in range(20_000)], axis=0)
    np.testing.assert_allclose(copies, 4 * weights, atol=0.02)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(0.0, 1.0), min_size=2, max_size=50).filter(lambda weights: sum(weights) > 1e-3))
def test_no_particle_gets_a_copy_more_or_less_than_its_share(raw: list[float]) -> None:
    weights = np.array(raw) / sum(raw)
    indices = systematic(weights, np.random.default_rng(1))
    copies = np.bincount(indices, minlength=len(weights))
    assert copies.sum() == len(weights)
    assert (np.diff(indices) >= 0).all()
    assert (copies >= np.floor(len(weights) * weights - 1e-9)).all()
    assert (copies <= np.ceil(len(weights) * weights + 1e-9)).all()


def test_a_particle_without_weight_is_never_copied() -> None:
    weights = np.array([0.0, 1.0, 0.0])
    random = np.random.default_rng(2)
    assert all((systematic(weights, random) == 1).all() for _ in range(100))


def test_the_effective_number() -> None:
    assert effective_number(np.full(8, 0.125)) == pytest.approx(8.0)
    assert effective_number(np.array([1.0, 0.0, 0.0])) == pytest.approx(1.0)


def test_it_finds_what_the_kalman_filter_finds() -> None:
    """A random walk seen in Gaussian noise: mean and variance of the exact filter, within what chance allows."""
    random = np.random.default_rng(3)
    q, r, mean, variance = 0.1, 0.5, 0.0, 1.0
    particles = Particles(random.standard_normal((1, 20_000)), ParticleSettings(count=20_000))
    truth, off = 0.3, []
    for _ in range(60):
        truth += q * random.standard_normal()
        seen = truth + r * random.standard_normal()
        variance += q * q
        gain = variance / (variance + r * r)
        mean, variance = mean + gain * (seen - mean), (1.0 - gain) * variance
        particles.states += (q * random.standard_normal(particles.states.shape)).astype(np.float32)
        particles.weigh(-0.5 * ((seen - particles.states[0]) / r) ** 2)
        found = weighted_covariance(particles.states, particles.weights)[0, 0]
        off.append((float(particles.mean()[0]) - mean) / math.sqrt(variance))
        particles.renew(random)
    assert np.sqrt(np.mean(np.square(off))) < 0.1
    assert found == pytest.approx(variance, rel=0.1)


def test_resampling_waits_until_few_particles_are_effective() -> None:
    random = np.random.default_rng(4)
    particles = Particles(np.arange(100.0)[None], ParticleSettings(count=100))
    assert not particles.renew(random)
    particles.weigh(np.where(np.arange(100) < 30, 0.0, -20.0))
    assert particles.renew(random)
    assert particles.states.max() < 30.0
    np.testing.assert_allclose(particles.weights, 0.01)


def test_a_measurement_that_nothing_fits_changes_nothing() -> None:
    particles = Particles(np.zeros((1, 3)), ParticleSettings(count=10))
    particles.weights = np.array([1.0, 0.0, 0.0])
    particles.weigh(np.array([-1e6, 0.0, 0.0]))
    np.testing.assert_allclose(particles.weights, [1.0, 0.0, 0.0])


def test_likelihoods_are_densities() -> None:
    at = np.linspace(-40.0, 40.0, 400_001)
    step = at[1] - at[0]
    inside = np.abs(at) <= 2.0
    density = np.exp(normal_with_outliers(at, 0.12, 0.1, 4.0))
    assert density[inside].sum() * step == pytest.approx(1.0, abs=1e-3)
    # Student's t with 4 degrees of freedom: variance 2, up to the tails that are cut off
    heavy = np.exp(student_t(at, 1.0, 4.0))
    assert (at**2 * heavy).sum() / heavy.sum() == pytest.approx(2.0, rel=0.02)


def test_small_particles_are_removed_before_the_others_are_resampled() -> None:
    """Half of them at 0.4 of the mean weight, the limit at 0.5: a fifth would live on without it."""
    states = np.repeat([[1.0, 2.0]], 500, axis=0).T.reshape(1, -1)  # 500 of 1, then 500 of 2
    particles = Particles(states, ParticleSettings(count=1000, smallest=0.5, resample_below=1.0))
    particles.weights = np.repeat([1.6, 0.4], 500) / 1000
    assert particles.renew(np.random.default_rng(4))
    assert set(particles.states[0].tolist()) == {1.0}
