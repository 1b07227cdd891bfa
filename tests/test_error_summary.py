"""Table I's rows on errors whose figures are known; NEES on errors drawn from the covariance itself."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from caneflow.algorithms.judging.error_summary import consistent_mean, normalized_error_squared, summarized
from caneflow.algorithms.judging.track_errors import Track, final_offset, track_errors

Floats = NDArray[np.float64]


def track(positions: Floats, yaws: Floats | float) -> Track:
    """Poses every 10 ms with the boresight, body y, level at these yaws."""
    half = 0.5 * (np.broadcast_to(np.asarray(yaws, dtype=np.float64), len(positions)) - 0.5 * math.pi)
    nothing = np.zeros(len(positions))
    return Track(
        stamps=10_000_000 * np.arange(len(positions), dtype=np.int64),
        positions=np.column_stack([positions, nothing]),
        orientations=np.stack([np.cos(half), nothing, nothing, np.sin(half)], axis=1),
    )


def straight(count: int = 501) -> Floats:
    return np.column_stack([np.linspace(0.0, 10.0, count), np.zeros(count)])


def turned(positions: Floats, angle: float) -> Floats:
    c, s = math.cos(angle), math.sin(angle)
    rotated: Floats = positions @ np.array([[c, s], [-s, c]])
    return rotated


def test_the_rows_of_table_one() -> None:
    summary = summarized([1.0, 2.0, 6.0], [40.0, 50.0, 60.0])
    assert summary.largest == 6.0
    assert summary.mean == pytest.approx(3.0)
    assert summary.sd == pytest.approx(math.sqrt(7.0))  # (4 + 1 + 9) / 2
    assert summary.growth_rate == pytest.approx(3.0 / 50.0)


def test_one_walk_has_no_spread() -> None:
    assert summarized([1.3], [50.0]).sd is None


def test_no_walk_has_no_rows() -> None:
    with pytest.raises(ValueError, match="0 errors"):
        summarized([], [])


def test_nees_of_independent_axes_is_the_sum_of_squares() -> None:
    assert normalized_error_squared(np.array([3.0, 1.0]), np.diag([9.0, 0.25])) == pytest.approx(1.0 + 4.0)


def test_nees_does_not_depend_on_the_frame() -> None:
    error, covariance = np.array([0.4, -0.2]), np.array([[0.3, 0.1], [0.1, 0.2]])
    rotation = np.array([[0.6, -0.8], [0.8, 0.6]])
    elsewhere = normalized_error_squared(rotation @ error, rotation @ covariance @ rotation.T)
    assert elsewhere == pytest.approx(normalized_error_squared(error, covariance))


def test_a_covariance_that_is_none_gives_no_nees() -> None:
    assert normalized_error_squared(np.array([1.0, 0.0]), np.zeros((2, 2))) is None


def test_the_interval_is_that_of_the_chi_square_tables() -> None:
    low, high = consistent_mean(20)  # 40 degrees of freedom: 24.433 and 59.342
    assert low == pytest.approx(24.433 / 20, abs=1e-4)
    assert high == pytest.approx(59.342 / 20, abs=1e-4)


def test_the_mean_nees_of_an_honest_covariance_lies_in_the_interval_19_times_in_20() -> None:
    rng = np.random.default_rng(7)
    covariance = np.array([[0.5, -0.2], [-0.2, 0.3]])
    low, high = consistent_mean(20)
    means = []
    for _ in range(500):
        errors = rng.multivariate_normal(np.zeros(2), covariance, 20)
        means.append(np.mean([normalized_error_squared(error, covariance) for error in errors]))
    inside = np.mean([low < mean < high for mean in means])
    assert inside == pytest.approx(0.95, abs=0.03)  # three standard deviations of a share of 500


def test_the_final_offset_is_the_final_error_as_a_vector_in_the_estimates_frame() -> None:
    """The estimate's world is turned by 50 degrees against the truth's, and its end lies 0.5 m to the left."""
    angle, missed = math.radians(50.0), straight()
    missed[-1, 1] += 0.5
    estimate = track(turned(missed, angle) + np.array([3.0, -8.0]), angle)
    truth = track(straight(), 0.0)
    offset = final_offset(estimate, truth)
    assert offset == pytest.approx([-0.5 * math.sin(angle), 0.5 * math.cos(angle)])
    assert np.linalg.norm(offset) == pytest.approx(track_errors(estimate, truth).final_error)


def test_the_final_offset_takes_the_truth_at_the_estimates_own_times() -> None:
    """Every stream begins and ends when it likes: this one 0.5 s after the truth, and 0.5 s before its end."""
    whole = track(straight(), 0.0)
    part = Track(
        stamps=whole.stamps[50:-50], positions=whole.positions[50:-50], orientations=whole.orientations[50:-50]
    )
    assert final_offset(part, whole) == pytest.approx([0.0, 0.0], abs=1e-12)
