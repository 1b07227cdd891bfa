"""After a hole the attitude is found again within seconds, by what the readings since then have told."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.algorithms.inertial.attitude_filter import AttitudeFilter, AttitudeFilterSettings
from caneflow.algorithms.inertial.attitude_recovery import RECOVERY, Holes, Recovery, UndisturbedField, alike
from caneflow.algorithms.inertial.initial_attitude import AttitudeMethod
from caneflow.algorithms.inertial.madgwick import Madgwick, MadgwickSettings
from caneflow.algorithms.inertial.mean_force import TiltError
from caneflow.algorithms.inertial.unseen_turn import UnseenTurn
from caneflow.algorithms.rotations import (
    IDENTITY,
    Quaternion,
    Vector,
    conjugate,
    from_rotation_vector,
    multiply,
    rotate,
    wrapped,
)
from caneflow.physics import GRAVITY
from tests.test_gated_attitude import DEGREE, FIELD, METHODS, bare, between, readings, swung

UP: Vector = (0.0, 0.0, GRAVITY)
STRENGTH = math.hypot(*FIELD)
UNDISTURBED = UndisturbedField(
    direction=(0.0, FIELD[1] / STRENGTH, FIELD[2] / STRENGTH), strength=STRENGTH, tolerance=0.1
)
STILL: Vector = (0.0, 0.0, 0.0)


def heading_error(estimate: Quaternion, truth: Quaternion) -> float:
    w, _, _, z = multiply(estimate, conjugate(truth))
    return wrapped(2.0 * math.atan2(z, w))


def errors(method: AttitudeMethod, begin: float, hole: float) -> dict[float, float]:
    """rad, whole angle, by the s since the end of a hole in a swing."""
    found = {}
    for stamp, gyro, accel, mag in readings(begin + hole + 6.0):
        t = (stamp - 1_700_000_000_000_000_000) * 1e-9
        if begin <= t < begin + hole - 1e-6:
            continue
        error = between(method.update(stamp, gyro, accel, mag).orientation, swung(t))
        if t >= begin + hole - 1e-6:
            found[round(t - begin - hole, 2)] = error
    return found


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("hole", [0.1, 0.2, 0.4, 0.6, 1.0])
@pytest.mark.parametrize("begin", [12.1, 13.4, 15.0])
def test_a_hole_in_a_swing_is_forgotten_in_seconds(method: str, hole: float, begin: float) -> None:
    """A swing of 220 degrees/s. Measured: at most 4.1 degrees after 1 s and 3.0 after 3 s."""
    error = errors(bare(method), begin, hole)
    assert error[1.0] < 5.0 * DEGREE
    assert error[3.0] < 4.0 * DEGREE
    assert error[5.5] < 3.0 * DEGREE


@pytest.mark.parametrize("method", METHODS)
def test_the_turn_in_a_hole_of_a_swing_is_known_from_the_seconds_before(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """0.2 s after a hole of 0.4 s, when five bins of 20 ms tell how it went on; without that the turn is a guess."""
    learnt = [errors(bare(method), begin, 0.4)[0.2] for begin in (12.1, 13.4, 15.0)]
    monkeypatch.setattr(UnseenTurn, "found", lambda _: None)
    guessed = [errors(bare(method), begin, 0.4)[0.2] for begin in (12.1, 13.4, 15.0)]
    assert max(learnt) < 3.0 * DEGREE
    assert max(guessed) > 3.0 * max(learnt)


def test_without_the_recovery_it_stays_wrong_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the test above would say if nothing were done: a hole of 0.4 s in the middle of a swing."""
    monkeypatch.setattr(Holes, "spread", lambda *_: 0.0)
    for method in METHODS:
        assert max(errors(bare(method), begin, 0.4)[3.0] for begin in (12.1, 13.4, 15.0)) > 10.0 * DEGREE


def test_at_rest_a_hole_changes_nothing() -> None:
    attitude = AttitudeFilter(AttitudeFilterSettings())
    held = from_rotation_vector((0.3, -0.2, 0.7))
    force, field = rotate(conjugate(held), UP), rotate(conjugate(held), FIELD)
    for k in range(2000):
        if not 1000 <= k < 1030:
            estimate = attitude.update(k * 10_000_000, STILL, force, field)
            assert k < 800 or between(estimate.orientation, held) < 0.01 * DEGREE


def test_what_happened_in_a_long_hole_at_rest_is_found() -> None:
    """The body was turned by 60 degrees in 1 s without samples, and stands again."""
    for attitude in (AttitudeFilter(AttitudeFilterSettings()), Madgwick(MadgwickSettings())):
        for k in range(3000):
            held = from_rotation_vector((0.3, 0.0, 0.0) if k < 2000 else (0.3, 0.0, 1.05))
            if not 2000 <= k < 2100:
                force, field = rotate(conjugate(held), UP), rotate(conjugate(held), FIELD)
                estimate = attitude.update(k * 10_000_000, STILL, force, field)
            if k == 2250:
                assert between(estimate.orientation, held) < 10.0 * DEGREE
        assert between(estimate.orientation, held) < 3.0 * DEGREE


def test_usual_intervals_are_no_holes() -> None:
    for period in (0.0025, 0.01, 0.05, 0.2):
        holes = Holes()
        for k in range(100):
            jitter = 1.0 + 0.4 * math.sin(k)
            assert holes.spread(jitter * period, (2.0, 0.0, 0.0), UP) == 0.0


def test_where_samples_come_less_often_from_now_on_that_is_usual_soon() -> None:
    holes = Holes()
    for _ in range(100):
        holes.spread(0.01, (2.0, 0.0, 0.0), UP)
    told = [holes.spread(0.1, (2.0, 0.0, 0.0), UP) > 0.0 for _ in range(30)]
    assert told[0]
    assert not any(told[20:])


def spread_of(hole: float, swing: float) -> float:
    """After 5 s of a swing at 1 Hz with an amplitude of `swing` rad/s."""
    holes = Holes()
    for k in range(500):
        holes.spread(0.01, (0.0, 0.0, swing * math.sin(math.tau * 0.01 * k)), UP)
    return holes.spread(hole, (0.0, 0.0, 0.5 * swing), UP)


def test_the_spread_grows_with_the_hole_and_with_the_motion() -> None:
    """It covers what the trapezium rule errs by in a swing: up to a T (w T)^2 / 12 in a short hole."""
    holes = (0.05, 0.1, 0.2, 0.4, 0.6, 1.0)
    calm, quick = [spread_of(hole, 0.2) for hole in holes], [spread_of(hole, 3.0) for hole in holes]
    assert calm == sorted(calm)
    assert quick == sorted(quick)
    assert all(a < b for a, b in zip(calm, quick, strict=True))
    for hole, spread in zip(holes[:3], quick[:3], strict=True):
        worst = 3.0 * hole * (math.tau * hole) ** 2 / 12.0
        assert 0.5 * worst < spread < 2.0 * worst + math.radians(40.0) * hole**2
    assert spread_of(3.0, 3.0) == math.inf


@given(turn=st.tuples(*[st.floats(-1.5, 1.5)] * 3))
@settings(max_examples=50, deadline=None)
def test_where_nothing_was_known_field_and_force_tell_the_whole_rotation(turn: Vector) -> None:
    truth = from_rotation_vector(turn)
    recovery = Recovery(None, TiltError(0.5), UNDISTURBED)
    for _ in range(3):
        recovery.update(IDENTITY, rotate(conjugate(truth), UP), rotate(conjugate(truth), FIELD), 0.01)
    assert between(recovery.turn, truth) < 0.1 * DEGREE
    assert recovery.force == pytest.approx(UP, abs=0.02)


def test_a_force_alone_is_followed_by_its_weight() -> None:
    """A tilt of 0.1 rad seen for 1 s by a body whose speed changes by 1 m/s: sd 1 / 9.8 rad, as much as is unknown."""
    spread, tilt = 1.0 / GRAVITY, 0.1
    recovery = Recovery(alike(spread), TiltError(1.0), None)
    seen = rotate(from_rotation_vector((-tilt, 0.0, 0.0)), UP)
    for _ in range(101):
        recovery.update(IDENTITY, seen, None, 0.01)
    assert recovery.elapsed == pytest.approx(1.0)
    assert between(recovery.turn, from_rotation_vector((0.5 * tilt, 0.0, 0.0))) < 0.002
    assert recovery.spread == pytest.approx(spread / math.sqrt(2.0), rel=0.01)
    assert not recovery.over
    for _ in range(round(100 * RECOVERY)):
        recovery.update(IDENTITY, seen, None, 0.01)
    assert recovery.over


def test_a_field_of_another_strength_is_not_believed() -> None:
    recovery = Recovery(alike(0.5), TiltError(0.5), UNDISTURBED)
    turned = rotate(from_rotation_vector((0.0, 0.0, 0.8)), FIELD)
    recovery.update(IDENTITY, UP, (1.3 * turned[0], 1.3 * turned[1], 1.3 * turned[2]), 0.01)
    assert not recovery.has_field
    assert between(recovery.turn, IDENTITY) < 1e-9


def test_free_fall_and_no_readings_tell_nothing() -> None:
    recovery = Recovery(None, TiltError(0.5), None)
    recovery.update(IDENTITY, None, None, 0.01)
    recovery.update(IDENTITY, STILL, None, 0.01)
    assert recovery.turn == IDENTITY
    assert heading_error(recovery.turn, IDENTITY) == 0.0
