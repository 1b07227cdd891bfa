"""Track errors on tracks whose errors are known, and against the outside check's own formula."""

import importlib.util
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from caneflow.algorithms.judging.track_errors import Track, boresight_yaws, relative_error, track_errors

Floats = NDArray[np.float64]
CHECKS = Path(__file__).parents[1].parent / "shared" / "checks"
START_NS = 1_700_000_000_000_000_000
QUARTER = math.pi / 2


def facing(yaws: Floats, pitch: float = 0.7) -> Floats:
    """Orientations (n, 4) whose body y has these yaws and points `pitch` below the horizontal."""
    half = 0.5 * (np.asarray(yaws) - QUARTER)
    w, z = np.cos(half), np.sin(half)
    c, s = math.cos(-0.5 * pitch), math.sin(-0.5 * pitch)
    # first down about the body's x, then about the world's z
    return np.stack([w * c, w * s, z * s, z * c], axis=1)


def track(positions: Floats, yaws: Floats | float = 0.0, step_ns: int = 10_000_000, first_ns: int = START_NS) -> Track:
    positions = np.asarray(positions, dtype=np.float64)
    if positions.shape[1] == 2:
        positions = np.column_stack([positions, np.zeros(len(positions))])
    count = len(positions)
    stamps = first_ns + step_ns * np.arange(count, dtype=np.int64)
    return Track(
        stamps=stamps, positions=positions, orientations=facing(np.broadcast_to(yaws, count).astype(np.float64))
    )


def straight(length: float = 10.0, count: int = 1001) -> Floats:
    return np.column_stack([np.linspace(0.0, length, count), np.zeros(count)])


def loop(count: int = 2001) -> Floats:
    """A circle of 4 m radius from the origin, counter-clockwise, along x at first."""
    angle = np.linspace(0.0, 2 * math.pi, count)
    return 4.0 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])


def turned(positions: Floats, angle: float) -> Floats:
    c, s = math.cos(angle), math.sin(angle)
    rotated: Floats = positions @ np.array([[c, s], [-s, c]])
    return rotated


def test_facing_is_what_it_says() -> None:
    yaws = np.linspace(-3.0, 3.0, 13)
    assert boresight_yaws(facing(yaws), (0.0, 1.0, 0.0)) == pytest.approx(yaws)


def test_a_perfect_track_has_no_error() -> None:
    errors = track_errors(track(loop()), track(loop()))
    assert errors.final_error == errors.ate == errors.rpe == errors.drift_percent == 0.0
    assert errors.path_length_ratio == errors.extent == 1.0
    assert errors.final_distance == pytest.approx(0.0, abs=1e-12)
    assert errors.length == pytest.approx(2 * math.pi * 4.0, rel=1e-5)
    assert errors.poses == 2001
    assert errors.duration == pytest.approx(20.0)


def test_a_scale_error_on_a_straight_path() -> None:
    errors = track_errors(track(1.1 * straight()), track(straight()))
    assert errors.final_error == pytest.approx(1.0)
    assert errors.drift_percent == pytest.approx(10.0)
    assert errors.ate == pytest.approx(1.0 / math.sqrt(3.0), rel=1e-3)  # of a ramp from 0 to 1
    assert errors.rpe == pytest.approx(0.1, rel=1e-3)
    assert errors.path_length_ratio == pytest.approx(1.1)
    assert errors.extent == pytest.approx(1.1)
    assert errors.final_distance == pytest.approx(11.0)
    assert errors.growth_rate == pytest.approx(1.1)


def test_a_closed_loop_hides_a_scale_error_from_the_papers_figure_only() -> None:
    errors = track_errors(track(0.5 * loop()), track(loop()))
    assert errors.final_distance == pytest.approx(0.0, abs=1e-9)
    assert errors.final_error == pytest.approx(0.0, abs=1e-9)
    assert errors.path_length_ratio == pytest.approx(0.5)
    assert errors.extent == pytest.approx(0.5)
    # half of the distance 8 sin(angle / 2) from the start, squared, on average
    assert errors.ate == pytest.approx(4.0 / math.sqrt(2.0), rel=1e-3)


def test_a_quarter_turn_between_heading_and_track_shows_on_an_open_path() -> None:
    errors = track_errors(track(turned(straight(), QUARTER)), track(straight()))
    assert errors.final_error == pytest.approx(10.0 * math.sqrt(2.0))


def test_another_origin_and_another_north_are_no_error() -> None:
    angle = 2.3
    elsewhere = turned(loop(), angle) + np.array([30.0, -7.0])
    errors = track_errors(track(elsewhere, 0.2 + angle), track(loop(), 0.2))
    assert errors.ate == pytest.approx(0.0, abs=1e-9)
    assert errors.rpe == pytest.approx(0.0, abs=1e-9)


def test_a_heading_that_passes_half_a_turn_between_two_stamps_is_no_error() -> None:
    """Truth every 20 ms, estimate every 10 ms: half of its headings lie between two of the truth's."""
    yaws = np.linspace(0.0, 2 * math.pi, 2001)
    errors = track_errors(track(loop(), yaws), track(loop()[::2], yaws[::2], step_ns=20_000_000))
    assert errors.rpe == pytest.approx(0.0, abs=1e-3)


def test_an_old_heading_error_counts_in_ate_but_once_in_rpe() -> None:
    """Truth goes straight on; the estimate's heading jumps by 90 degrees half way, and it follows it."""
    bent = straight()
    bent[501:, 1] = bent[501:, 0] - 5.0
    bent[501:, 0] = 5.0
    yaws = np.where(np.arange(1001) > 500, QUARTER, 0.0)
    errors = track_errors(track(bent, yaws), track(straight()))
    assert errors.final_error == pytest.approx(5.0 * math.sqrt(2.0))
    # only the starts in the metre before the bend err: sqrt(2) times what lies behind it, of 9 m of starts
    assert errors.rpe == pytest.approx(math.sqrt(2.0 / 3.0 / 9.0), rel=0.02)


def test_relative_error_is_none_for_a_path_shorter_than_its_length() -> None:
    path = straight(0.9, 91)
    assert relative_error(path, path, np.zeros(91), 1.0) is None


def test_a_truth_that_does_not_move_has_no_ratios() -> None:
    errors = track_errors(track(straight(1.0, 101)), track(np.zeros((101, 2))))
    assert errors.drift_percent is errors.path_length_ratio is errors.extent is errors.rpe is None
    assert errors.final_error == pytest.approx(1.0)


def test_other_rates_and_late_starts_are_met_in_time() -> None:
    """Truth at 1 kHz, estimate at 40 Hz and 0.3 s late: compared at the estimate's own stamps."""
    truth = track(straight(10.0, 10_001), step_ns=1_000_000)
    late = START_NS + 300_000_000
    estimate = track(straight(9.7, 389), step_ns=25_000_000, first_ns=late)
    errors = track_errors(estimate, truth)
    assert errors.ate == pytest.approx(0.0, abs=1e-6)
    assert errors.length == pytest.approx(9.7)


def test_a_track_that_misses_an_end_is_refused() -> None:
    truth = track(straight())
    half = track(straight(5.0, 501))
    with pytest.raises(ValueError, match=r"ends 5\.00 s before it; at most 1 s may be missing"):
        track_errors(half, truth)
    with pytest.raises(ValueError, match=r"starts 5\.00 s after the truth"):
        track_errors(track(straight(5.0, 501), first_ns=START_NS + 5_000_000_000), truth)


def test_a_track_that_fits_not_together_is_refused() -> None:
    with pytest.raises(ValueError, match="1 poses; at least 2"):
        track(np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"positions \(3, 2\)"):
        Track(stamps=np.arange(3), positions=np.zeros((3, 2)), orientations=np.ones((3, 4)))


def wander(seed: int, count: int = 400) -> Track:
    """A rough random walk with a random, drifting heading."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0.02, 0.05, (count, 3))
    yaws = rng.uniform(-3.0, 3.0) + np.cumsum(rng.normal(0.0, 0.05, count))
    return track(rng.uniform(-5, 5, 3) + np.cumsum(steps, axis=0), yaws)


def slow_errors(estimate: Track, truth: Track) -> tuple[float, float, float]:
    """Final distance, final error and RMS by the definition, pose by pose."""
    turn = sum(
        complex(math.cos(b - a), math.sin(b - a))
        for a, b in zip(
            boresight_yaws(estimate.orientations, (0.0, 1.0, 0.0))[:50].tolist(),
            boresight_yaws(truth.orientations, (0.0, 1.0, 0.0))[:50].tolist(),
            strict=True,
        )
    )
    turn /= abs(turn)
    squares = 0.0
    for here, there in zip(estimate.positions, truth.positions, strict=True):
        moved = turn * complex(*(here - estimate.positions[0])[:2])
        error = abs(moved - complex(*(there - truth.positions[0])[:2]))
        squares += error**2
    return abs(moved), error, math.sqrt(squares / len(truth.stamps))


@given(seeds=st.tuples(st.integers(0, 10**6), st.integers(0, 10**6)))
def test_agrees_with_the_definition_pose_by_pose(seeds: tuple[int, int]) -> None:
    estimate, truth = wander(seeds[0]), wander(seeds[1])
    errors = track_errors(estimate, truth)
    assert (errors.final_distance, errors.final_error, errors.ate) == pytest.approx(slow_errors(estimate, truth))


@pytest.fixture
def outside_check(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The outside check's own module."""
    if not (CHECKS / "score.py").exists():
        pytest.skip("the outside checks are not here: ../shared/checks/score.py")
    monkeypatch.syspath_prepend(str(CHECKS))
    spec = importlib.util.spec_from_file_location("outside_score", CHECKS / "score.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("cut", [(0, 400, 1), (7, 380, 1), (0, 399, 2)])
def test_agrees_with_the_outside_check_to_its_rounding(
    outside_check: ModuleType, monkeypatch: pytest.MonkeyPatch, seed: int, cut: tuple[int, int, int]
) -> None:
    truth, whole = wander(seed), wander(seed + 1000)
    part = slice(*cut)
    estimate = Track(stamps=whole.stamps[part], positions=whole.positions[part], orientations=whole.orientations[part])

    def poses(path: str, want_truth: bool) -> tuple[object, object, object]:
        of = truth if want_truth else estimate
        return of.stamps, of.positions, of.orientations

    monkeypatch.setattr(outside_check, "poses", poses)
    expected = outside_check.score("walk", "given", "recorded")
    errors = track_errors(estimate, truth)
    assert expected["poses"] == errors.poses
    for name in ("final_distance", "final_error", "ate", "extent"):
        assert getattr(errors, name) == pytest.approx(expected[name], abs=0.00051), name
    assert errors.drift_percent == pytest.approx(expected["drift_percent"], abs=0.0051)


def test_a_scale_of_two_per_cent_draws_a_fixed_point_two_per_cent_of_the_way_off() -> None:
    true = straight(20.0, 2001)  # 1 m/s, straight
    errors = track_errors(track(true * 1.02), track(true))
    assert errors.local_1s == pytest.approx(0.02, abs=1e-3)
    assert errors.local_5s == pytest.approx(0.10, abs=1e-3)


def test_a_drift_of_the_heading_turns_the_point_about_the_walker() -> None:
    still = np.zeros((2001, 2))
    drift = np.linspace(0.0, 0.2, 2001)  # rad, 0.01 rad/s at rest
    errors = track_errors(track(still, drift), track(still))
    assert errors.local_1s == pytest.approx(2.0 * 0.01, rel=1e-3)
    assert errors.local_5s == pytest.approx(2.0 * 2.0 * math.sin(0.025), rel=1e-3)


def test_what_is_only_turned_or_shifted_draws_every_point_in_one_place() -> None:
    true = loop()
    errors = track_errors(track(turned(true, 0.7) + 3.0, 0.7), track(true))
    assert errors.local_1s == pytest.approx(0.0, abs=1e-9)
    assert errors.local_5s == pytest.approx(0.0, abs=1e-9)
    assert track_errors(track(straight(1.0, 101)), track(straight(1.0, 101))).local_5s is None
