"""Up and down against the textbook's matrices and a bobbing hand."""

import math

import numpy as np

from caneflow.algorithms.inertial.heave import HeaveObserver, HeaveSettings


def test_agrees_with_full_matrices() -> None:
    settings = HeaveSettings()
    heave = HeaveObserver(settings)
    rng = np.random.default_rng(1)
    x = np.array([0.75, 0.0, 0.0])
    p = np.diag([0.02**2, 0.05**2, settings.bias**2])
    for _ in range(300):
        t, acceleration = rng.uniform(0.005, 0.02), rng.normal(0.0, 1.0)
        heave.update(t, acceleration, 0.75)
        f = np.array([[1, t, 0], [0, 1, -t], [0, 0, 1]])
        gained = acceleration - x[2]
        x = np.array([x[0] + t * (x[1] + 0.5 * t * gained), x[1] + t * gained, x[2]])
        p = f @ p @ f.T + np.diag([0, settings.acceleration_noise**2 * t, settings.bias_walk**2 * t])
        gain = p[:, 0] / (p[0, 0] + settings.height_noise**2)
        x = x + gain * (0.75 - x[0])
        p = p - np.outer(gain, p[0])
    np.testing.assert_allclose((heave.height, heave.rate), x[:2], rtol=1e-9)
    np.testing.assert_allclose((heave.height_variance, heave.rate_variance), (p[0, 0], p[1, 1]), rtol=1e-9)


def test_follows_a_bob_of_12_mm_to_a_centimetre_per_second_despite_a_biased_accelerometer() -> None:
    heave = HeaveObserver(HeaveSettings())
    time = np.arange(0.0, 30.0, 0.01)
    phase = 2 * math.pi * 1.1 * time
    height, rate = 0.75 + 0.012 * np.cos(phase), -0.012 * 2 * math.pi * 1.1 * np.sin(phase)
    acceleration = -0.012 * (2 * math.pi * 1.1) ** 2 * np.cos(phase) + 0.1
    errors = []
    for index in range(len(time)):
        heave.update(0.01, float(acceleration[index]), 0.75)
        errors.append((heave.height - height[index], heave.rate - rate[index]))
    late = np.array(errors[1000:])
    assert np.std(late[:, 1]) < 0.01 < np.std(rate)
    assert np.std(late[:, 0]) < 0.004
