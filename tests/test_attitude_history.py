"""Attitudes of the recent past: interpolated, bounded, and honest about what they do not cover."""

import math

import pytest
from scipy.spatial.transform import Rotation, Slerp

from caneflow.algorithms.inertial.attitude_history import AttitudeHistory
from caneflow.algorithms.rotations import IDENTITY, Quaternion, from_yaw

MS = 1_000_000  # ns


def as_scipy(q: Quaternion) -> Rotation:
    return Rotation.from_quat([q[1], q[2], q[3], q[0]])


def test_between_samples_agrees_with_spherical_interpolation() -> None:
    history = AttitudeHistory()
    for k in range(5):
        w, x, y, z = from_yaw(0.05 * k)
        sign = -1.0 if k % 2 else 1.0  # the same turn, written the other way
        history.add(k * 10 * MS, (sign * w, sign * x, sign * y, sign * z), (0.0, 0.0, 5.0))
    slerp = Slerp([0, 10, 20, 30, 40], Rotation.from_rotvec([[0, 0, 0.05 * k] for k in range(5)]))
    for ms in (0, 3, 10, 17.5, 40):
        got = history.at(round(ms * MS))
        assert got is not None
        assert (as_scipy(got).inv() * slerp([ms])[0]).magnitude() < 1e-5


def test_what_is_not_covered_is_none() -> None:
    history = AttitudeHistory()
    assert history.at(0) is None
    for ms in (100, 110, 300, 310):
        history.add(ms * MS, IDENTITY, (0.0, 0.0, 0.0))
    assert history.at(99 * MS) is None, "before the first"
    assert history.at(311 * MS) is None, "after the last"
    assert history.at(200 * MS) is None, "in a gap of 0.19 s"
    assert history.at(300 * MS) == IDENTITY


def test_mean_turn_rate_is_path_over_time() -> None:
    history = AttitudeHistory()
    for k in range(11):
        history.add(k * 10 * MS, IDENTITY, (0.0, 0.3 if k <= 5 else 0.0, 0.4 if k <= 5 else 0.0))
    assert history.mean_turn_rate(0, 50 * MS) == pytest.approx(0.5)
    assert history.mean_turn_rate(0, 100 * MS) == pytest.approx(0.25)
    assert history.mean_turn_rate(60 * MS, 100 * MS) == pytest.approx(0.0)
    assert history.mean_turn_rate(41 * MS, 49 * MS) is None


def test_remembers_the_newest_only() -> None:
    history = AttitudeHistory(samples=100)
    for k in range(1000):
        history.add(k * 10 * MS, from_yaw(0.001 * k), (0.0, 0.0, 0.1))
    assert history.at(999 * 10 * MS) == from_yaw(0.999)
    assert history.at(905 * 10 * MS) == from_yaw(0.905)
    assert history.at(700 * 10 * MS) is None
    assert len(history._stamps) < 200
    assert history.mean_turn_rate(910 * 10 * MS, 990 * 10 * MS) == pytest.approx(0.1)


def test_a_sample_that_goes_back_in_time_is_refused() -> None:
    history = AttitudeHistory()
    history.add(5, IDENTITY, (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"attitude at 5 ns is not newer than the last, 5 ns"):
        history.add(5, IDENTITY, (0.0, 0.0, math.pi))
