"""Rotations against scipy's, which were written by others."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caneflow.algorithms import rotations


def random_quaternions(count: int) -> list[rotations.Quaternion]:
    rng = np.random.default_rng(7)
    raw = rng.normal(size=(count, 4))
    return [rotations.normalized((q[0], q[1], q[2], q[3])) for q in raw.tolist()]


def scipy_of(q: rotations.Quaternion) -> Rotation:
    return Rotation.from_quat([q[1], q[2], q[3], q[0]])


@pytest.mark.parametrize("q", random_quaternions(5))
def test_rotate_and_conjugate_agree_with_scipy(q: rotations.Quaternion) -> None:
    v = (0.3, -1.2, 2.5)
    assert rotations.rotate(q, v) == pytest.approx(scipy_of(q).apply(v).tolist())
    assert rotations.rotate(rotations.conjugate(q), rotations.rotate(q, v)) == pytest.approx(v)


def test_multiply_is_composition() -> None:
    a, b = random_quaternions(2)
    expected = (scipy_of(a) * scipy_of(b)).as_matrix()
    assert scipy_of(rotations.multiply(a, b)).as_matrix() == pytest.approx(expected)


@pytest.mark.parametrize("scale", [1e-9, 1e-5, 0.1, 3.0])
def test_rotation_vector_agrees_with_scipy(scale: float) -> None:
    v = (0.3 * scale, -0.8 * scale, 0.5 * scale)
    expected = Rotation.from_rotvec(v).as_quat()
    got = rotations.from_rotation_vector(v)
    assert (got[1], got[2], got[3], got[0]) == pytest.approx(expected.tolist(), abs=1e-15)


def test_yaw_turns_counter_clockwise_and_depression_is_positive_down() -> None:
    turned = rotations.rotate(rotations.from_yaw(math.radians(30)), (1.0, 0.0, 0.0))
    assert rotations.yaw_of(turned) == pytest.approx(math.radians(30))
    assert rotations.depression_of((1.0, 0.0, -1.0)) == pytest.approx(math.radians(45))


def test_no_rotation_is_refused() -> None:
    with pytest.raises(ValueError, match="norm 0 is not a rotation"):
        rotations.normalized((0.0, 0.0, 0.0, 0.0))


def test_wrapped_is_the_same_direction() -> None:
    for angle in np.linspace(-20, 20, 97).tolist():
        assert math.cos(rotations.wrapped(angle)) == pytest.approx(math.cos(angle))
        assert -math.pi <= rotations.wrapped(angle) < math.pi
