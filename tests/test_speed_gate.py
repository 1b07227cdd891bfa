"""Single wild ground speeds are left out, single wild variances held; what lasts passes."""

import math
from collections.abc import Sequence

from caneflow.algorithms.cane.speed_gate import CaneGlitchSettings, SpeedGate, StatedVariance

PERIOD_NS = 50_000_000


def passed(speeds: Sequence[tuple[float, float, float | None]]) -> list[bool]:
    gate = SpeedGate(CaneGlitchSettings())
    return [gate.passes(index * PERIOD_NS, *each) for index, each in enumerate(speeds)]


def test_a_speed_that_leaps_is_left_out() -> None:
    walked = [(0.5, 0.0, 0.3)] * 3
    assert passed([*walked, (30.0, 0.0, 0.3), (0.6, 0.0, 0.3)]) == [True] * 3 + [False, True]
    assert passed([*walked, (0.5, -20.0, 0.3), (0.6, 0.0, 0.3)]) == [True] * 3 + [False, True]


def test_so_is_one_whose_delay_leaps() -> None:
    assert passed([(0.5, 0.0, None)] * 2 + [(0.5, 0.0, 60.0), (0.5, 0.0, None)]) == [True, True, False, True]


def test_nobody_begins_at_thirty_metres_per_second() -> None:
    assert passed([(30.0, 0.0, 0.0), (0.5, 0.0, 0.0)]) == [False, True]


def test_what_lasts_passes() -> None:
    assert passed([(0.5, 0.0, 0.0)] * 3 + [(8.0, 0.0, 0.0)] * 5) == [True] * 3 + [False] * 3 + [True] * 2


def believed(stated: Sequence[float], usual: float) -> list[float]:
    gate = StatedVariance(usual)
    return [gate.believed(each) for each in stated]


def test_a_variance_of_next_to_nothing_counts_as_the_usual_one() -> None:
    walked = [0.004, 0.003, 0.005, 0.004]
    for absurd in (0.0, 1e-300, 1e-9):
        assert believed([*walked, absurd, absurd, absurd], 0.004)[4:] == [0.004] * 3


def test_a_sensor_that_goes_on_saying_so_is_believed_from_the_fourth_on() -> None:
    assert believed([0.004] * 7 + [1e-5] * 5, 0.25)[7:] == [0.004] * 4 + [1e-5]


def test_larger_variances_are_believed_at_once_and_so_are_somewhat_smaller_ones() -> None:
    stated = [0.004, 0.4, 1e6, 0.0005, 0.004]
    assert believed(stated, 0.004) == stated


def test_what_was_never_seen_is_seen_when_it_lasts() -> None:
    assert believed([0.01] * 5, math.inf) == [math.inf] * 4 + [0.01]
