"""The velocity filter against the textbook's matrices, and what it does with outliers and gaps."""

import math

import numpy as np
import pytest

from caneflow.algorithms.cane.walk_motion import WalkMotion, WalkMotionSettings


def test_agrees_with_full_matrices() -> None:
    settings = WalkMotionSettings(outlier=1e6)
    motion = WalkMotion(settings)
    rng = np.random.default_rng(1)
    x = np.zeros(7)
    s = settings
    p = np.diag(np.square([1e-6, 1e-6, s.velocity, s.velocity, s.bias, s.bias, s.pointing]))
    for _ in range(200):
        t, yaw = rng.uniform(0.005, 0.03), rng.uniform(-3, 3)
        ax, ay = rng.normal(0, 2, 2)
        cos, sin = math.cos(yaw), math.sin(yaw)
        motion.predict(t, (ax, ay), cos, sin)
        turn = np.array([[cos, -sin], [sin, cos]])
        f = np.eye(7)
        f[0:2, 2:4] = t * np.eye(2)
        f[2:4, 4:6] = -t * turn
        gained = t * (np.array([ax, ay]) - turn @ x[4:6])
        x = x + np.concatenate([t * (x[2:4] + 0.5 * gained), gained, np.zeros(3)])
        q = np.diag([0, 0, *[s.acceleration_noise**2] * 2, *[s.bias_walk**2] * 2, s.pointing_walk**2]) * t
        p = f @ p @ f.T + q
        direction, value, variance, slope = rng.uniform(-3, 3), rng.normal(), rng.uniform(0.01, 1), rng.normal()
        along = (math.cos(direction), math.sin(direction))
        motion.observe_velocity(along, value, variance, per_pointing=slope)
        h = np.array([0, 0, *along, 0, 0, slope])
        gain = p @ h / (h @ p @ h + variance)
        x = x + gain * (value - h @ x)
        keep = np.eye(7) - np.outer(gain, h)
        p = keep @ p @ keep.T + np.outer(gain, gain) * variance
    np.testing.assert_allclose((*motion.position, *motion.velocity), x[:4], atol=1e-9)
    np.testing.assert_allclose(motion.covariance, p[:4, :4], rtol=1e-6, atol=1e-12)
    assert motion.pointing == pytest.approx(x[6])


def test_an_outlier_moves_the_velocity_by_a_few_of_its_sd_at_most() -> None:
    moved = []
    for value in (0.1, 50.0):
        motion = WalkMotion(WalkMotionSettings())
        for _ in range(100):
            motion.predict(0.01, (0.0, 0.0), 1.0, 0.0)
            motion.observe_velocity((1.0, 0.0), 0.0, 0.01)
        before = math.sqrt(motion.covariance[2, 2])
        motion.observe_velocity((1.0, 0.0), value, 0.01)
        moved.append(abs(motion.velocity[0]) / before)
    assert moved[1] < 3.0


def test_over_a_gap_the_velocity_holds_and_is_unknown() -> None:
    motion = WalkMotion(WalkMotionSettings())
    for _ in range(200):
        motion.observe_velocity((1.0, 0.0), 0.5, 0.01)
        motion.observe_velocity((0.0, 1.0), 0.0, 0.01)
    motion.coast(2.0)
    assert motion.position == pytest.approx((1.0, 0.0), abs=0.01)
    assert motion.velocity == pytest.approx((0.5, 0.0), abs=0.01)
    assert motion.covariance[2, 2] == pytest.approx(1.0)
    assert motion.covariance[0, 0] > 4.0
    assert np.linalg.eigvalsh(motion.covariance).min() > -1e-12
