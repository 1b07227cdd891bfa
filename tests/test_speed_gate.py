"""Single wild ground speeds are left out; what lasts passes."""

from collections.abc import Sequence

from caneflow.algorithms.cane.speed_gate import CaneGlitchSettings, SpeedGate

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
