"""Single wild readings are held at the value before; what lasts, and what comes after a gap, is believed."""

import math

import pytest

from caneflow.algorithms.glitches import GlitchGate, GlitchSettings, JumpGate
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.rotations import Vector, from_yaw

PERIOD_NS = 10_000_000
REST: Vector = (0.0, 0.0, 0.0)
WILD: Vector = (-327.68, 0.0, 0.0)


def passed(values: list[Vector], *, period_ns: int = PERIOD_NS) -> list[Vector]:
    gate: JumpGate[Vector] = JumpGate(10.0, math.dist)
    return [gate.update(index * period_ns, value) for index, value in enumerate(values)]


@pytest.mark.parametrize("length", [1, 2, 3])
def test_up_to_three_wild_readings_in_a_row_are_held(length: int) -> None:
    assert passed([REST] * 5 + [WILD] * length + [REST] * 5) == [REST] * (10 + length)


def test_what_lasts_longer_is_believed() -> None:
    assert passed([REST] * 5 + [WILD] * 6) == [REST] * 8 + [WILD] * 3


def test_the_good_value_is_that_before_and_not_the_one_held() -> None:
    ramp: list[Vector] = [(float(9 * index), 0.0, 0.0) for index in range(20)]
    assert passed(ramp) == ramp
    spoilt = [*ramp[:7], WILD, *ramp[8:]]
    assert passed(spoilt)[7] == ramp[6]
    assert passed(spoilt)[8] == ramp[6], "18 from the last good one: still held"


def test_nothing_is_held_across_a_gap() -> None:
    values = [REST] * 5 + [WILD] * 3
    assert passed(values, period_ns=60_000_000) == values


@pytest.mark.parametrize("at", [0, 1])
def test_a_wild_reading_at_the_start_holds_up_none_of_the_good_ones(at: int) -> None:
    values = [REST] * 10
    values[at] = WILD
    assert passed(values) == values


def test_each_part_of_a_sample_has_its_own_gate() -> None:
    gate = GlitchGate(GlitchSettings())
    good = ImuReading((0.1, 0.0, 0.0), (0.0, 0.0, 9.8), (20.0, 0.0, -40.0), from_yaw(0.5), (0.0, 0.1, 0.0))
    wild = ImuReading((35.7, 0.0, 0.0), (0.0, 0.0, -327.68), (20.0, 900.0, -40.0), from_yaw(0.9), (0.0, 99.0, 0.0))
    for index in range(3):
        assert gate.update(index * PERIOD_NS, good) == good
    for index, part in enumerate(ImuReading._fields, 3):
        spoilt = good._replace(**{part: getattr(wild, part)})
        assert gate.update(2 * index * PERIOD_NS, spoilt) == good
        assert list(gate.held) == [part]
        assert gate.update((2 * index + 1) * PERIOD_NS, good) == good
        assert not gate.held


def test_an_attitude_and_its_negative_are_the_same() -> None:
    gate = GlitchGate(GlitchSettings())
    one = from_yaw(0.5)
    other = tuple(-each for each in one)
    for index, orientation in enumerate((one, one, other, one)):
        gate.update(index * PERIOD_NS, ImuReading(REST, orientation=orientation))  # type: ignore[arg-type] # four
        assert not gate.held


def test_a_sensor_without_a_part_keeps_being_without() -> None:
    gate = GlitchGate(GlitchSettings())
    bare = ImuReading(REST)
    assert [gate.update(index * PERIOD_NS, bare) for index in range(3)] == [bare] * 3


def test_where_nothing_was_seen_yet_a_wider_limit_holds() -> None:
    gate: JumpGate[float] = JumpGate(1.0, lambda a, b: abs(a - b), start=0.0, unseen_limit=4.0)
    assert [gate.update(index * PERIOD_NS, value) for index, value in enumerate((90.0, 3.0, 3.1))] == [0.0, 3.0, 3.1]
    after_gap = 1_000_000_000
    assert gate.update(after_gap, 7.5) == 3.1, "4.4 from the last good one"
    assert gate.update(after_gap + PERIOD_NS, 6.5) == 6.5, "3.4: across a gap that may be"
    assert gate.update(2 * after_gap, 2.6) == 2.6


def test_the_second_of_two_that_differ_says_so_while_neither_is_confirmed() -> None:
    gate: JumpGate[float] = JumpGate(1.0, lambda a, b: abs(a - b))
    said = []
    for index, value in enumerate((9.0, 0.0, 0.1, 9.0, 0.0)):
        gate.update(index * PERIOD_NS, value)
        said.append(gate.contradicted)
    assert said == [False, True, False, False, False]


def test_a_sensor_that_begins_with_its_full_scale_is_held_at_rest() -> None:
    gate = GlitchGate(GlitchSettings())
    first = ImuReading((35.7, 0.0, 0.0), WILD, linear_accel=WILD)
    assert gate.update(0, first) == ImuReading(REST, (0.0, 0.0, 9.80665), linear_accel=REST)
    turned = ImuReading((0.1, 0.0, 0.0), (9.8, 0.0, 0.0), linear_accel=REST)
    assert gate.update(PERIOD_NS, turned) == turned
    assert not gate.held
