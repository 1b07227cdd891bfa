"""The velocity filter against the textbook's matrices, bias told from tilt by turning, outliers and gaps."""

import cmath
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from caneflow.algorithms.cane.walk_motion import STATES, Axes, WalkMotion, WalkMotionSettings

Floats = NDArray[np.float64]


def level(yaw: float, pitch: float = 0.0) -> Axes:
    """Horizontal parts of the axes of a body with x at `yaw`, y to its left, pitched about x."""
    along = cmath.rect(1.0, yaw)
    return along, 1j * along * math.cos(pitch), -1j * along * math.sin(pitch)


def test_agrees_with_full_matrices() -> None:
    settings = s = WalkMotionSettings(outlier=1e6)
    motion = WalkMotion(settings)
    rng = np.random.default_rng(1)
    x = np.zeros(STATES)
    p = np.diag(np.square([1e-6, 1e-6, *[s.velocity] * 2, *[s.bias] * 3, *[s.tilt] * 2, s.pointing, *[1e-6] * 4]))
    marked = np.eye(STATES)
    marked[10:12, 10:12], marked[10:12, 0:2] = 0.0, np.eye(2)
    marked[12:14, 12:14], marked[12:14, 10:12] = 0.0, np.eye(2)
    for index in range(200):
        t, yaw = rng.uniform(0.005, 0.03), rng.uniform(-3, 3)
        ax, ay = rng.normal(0, 2, 2)
        axes = level(yaw, -0.7)
        motion.predict(t, complex(ax, ay), axes)
        felt = np.array([[*(a.real for a in axes), 1.0, 0.0], [*(a.imag for a in axes), 0.0, 1.0]])
        f = np.eye(STATES)
        f[0:2, 2:4] = t * np.eye(2)
        f[2:4, 4:9] = -t * felt
        f[7:9, 7:9] *= math.exp(-t / s.tilt_time)
        gained = t * (np.array([ax, ay]) - felt @ x[4:9])
        x = f @ x
        x[:4] += np.concatenate([0.5 * t * gained, t * np.array([ax, ay])])
        tilts = 2.0 * s.tilt**2 / s.tilt_time
        rates = [
            0,
            0,
            *[s.acceleration_noise**2] * 2,
            *[s.bias_walk**2] * 3,
            tilts,
            tilts,
            s.pointing_walk**2,
            *[0] * 4,
        ]
        p = f @ p @ f.T + np.diag(rates) * t
        direction, value, variance, slope = rng.uniform(-3, 3), rng.normal(), rng.uniform(0.01, 1), rng.normal()
        along = (math.cos(direction), math.sin(direction))
        if index % 10 == 9:
            motion.observe_way(along, value, variance, per_pointing=slope)
            h = np.array([*along, *[0] * 7, slope, 0, 0, -along[0], -along[1]])
        else:
            motion.observe_velocity(along, value, variance, per_pointing=slope)
            h = np.array([0, 0, *along, *[0] * 5, slope, *[0] * 4])
        gain = p @ h / (h @ p @ h + variance)
        x = x + gain * (value - h @ x)
        keep = np.eye(STATES) - np.outer(gain, h)
        p = keep @ p @ keep.T + np.outer(gain, gain) * variance
        if index % 10 == 9:
            assert motion.way == pytest.approx(complex(*(x[0:2] - x[12:14])), abs=1e-9)
            motion.mark()
            x, p = marked @ x, marked @ p @ marked.T
    np.testing.assert_allclose((*motion.position, *motion.velocity), x[:4], atol=1e-9)
    np.testing.assert_allclose(motion.covariance, p[:4, :4], rtol=1e-6, atol=1e-12)
    assert motion.pointing == pytest.approx(x[9])


def test_corners_tell_the_bias_of_the_body_from_the_tilt_of_the_world() -> None:
    """A step in the world's acceleration at the end is tilt, not bias: it is not taken round the next corner."""
    bias, tilt = (0.05, -0.08), complex(0.03, 0.02)  # m/s^2 in body axes; in the gyro's frame
    motion = WalkMotion(WalkMotionSettings())
    yaw = 0.0
    for index in range(4000):
        if index % 1000 >= 900:  # a quarter turn in a second
            yaw += math.radians(90.0) * 0.01
        axes = level(yaw)
        motion.predict(0.01, bias[0] * axes[0] + bias[1] * axes[1] + tilt, axes)
        for along in ((1.0, 0.0), (0.0, 1.0)):
            motion.observe_velocity(along, 0.0, 0.02**2)
        if index == 899:  # before the first corner: only their sum is known
            before, felt = motion.bias, motion.bias[0] * axes[0] + motion.bias[1] * axes[1] + motion.tilt
            assert felt == pytest.approx(bias[0] * axes[0] + bias[1] * axes[1] + tilt, abs=0.01)
            assert abs(before[1] - bias[1]) > 0.015
    assert motion.bias[:2] == pytest.approx(bias, abs=0.01)
    assert motion.tilt == pytest.approx(tilt, abs=0.015)


def test_an_outlier_moves_the_velocity_by_a_few_of_its_sd_at_most() -> None:
    moved = []
    for value in (0.1, 50.0):
        motion = WalkMotion(WalkMotionSettings())
        for _ in range(100):
            motion.predict(0.01, 0j, level(0.0))
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
