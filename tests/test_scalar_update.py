"""One scalar update against the textbook's matrices, and against what a measurement can and cannot do."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from caneflow.algorithms.scalar_update import Covariance, update, updated

NUMBERS = st.floats(-10.0, 10.0)
ROOTS = st.lists(NUMBERS, min_size=9, max_size=9).map(lambda each: np.array(each).reshape(3, 3))
ROWS = st.lists(NUMBERS, min_size=3, max_size=3).map(np.array)
NOISES = st.floats(1e-3, 1e3)


def six(p: NDArray[np.float64]) -> Covariance:
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = p.tolist()
    return xx, xy, xz, yy, yz, zz


def textbook(
    p: NDArray[np.float64], h: NDArray[np.float64], noise: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gain and covariance in Joseph form, which holds for any gain."""
    gain = p @ h / (h @ p @ h + noise)
    kept = np.eye(3) - np.outer(gain, h)
    return gain, kept @ p @ kept.T + noise * np.outer(gain, gain)


@given(ROOTS, ROWS, NOISES)
def test_both_forms_are_the_textbooks(root: NDArray[np.float64], h: NDArray[np.float64], noise: float) -> None:
    p = root @ root.T + 0.1 * np.eye(3)
    across, spread = p @ h, float(h @ p @ h) + noise
    expected_gain, expected = textbook(p, h, noise)
    a, b, c = across.tolist()
    gain, covariance = updated(six(p), (a, b, c), spread)
    np.testing.assert_allclose(gain, expected_gain, rtol=1e-9)
    np.testing.assert_allclose(covariance, six(expected), rtol=1e-9, atol=1e-9 * float(np.trace(p)))
    in_place = p.copy()
    np.testing.assert_array_equal(update(in_place, across, spread), gain, "to the last bit")
    np.testing.assert_array_equal(six(in_place), covariance, "to the last bit")


@given(ROOTS, st.integers(0, 2), NOISES)
def test_of_two_independent_estimates_of_a_state_the_variances_add_by_their_inverses(
    root: NDArray[np.float64], seen: int, noise: float
) -> None:
    p = root @ root.T + 0.1 * np.eye(3)
    a, b, c = p[seen].tolist()
    _, covariance = updated(six(p), (a, b, c), float(p[seen, seen]) + noise)
    variance = (covariance[0], covariance[3], covariance[5])[seen]
    assert variance == pytest.approx(1.0 / (1.0 / p[seen, seen] + 1.0 / noise), rel=1e-6)


def test_what_is_not_correlated_with_the_measurement_is_not_touched() -> None:
    covariance = (4.0, 0.0, 0.0, 9.0, 2.0, 5.0)
    gain, after = updated(covariance, (4.0, 0.0, 0.0), 8.0)
    assert gain == (0.5, 0.0, 0.0)
    assert after == (2.0, 0.0, 0.0, 9.0, 2.0, 5.0)
