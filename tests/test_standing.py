"""Standing still against walking, by gyro and accelerometer."""

import math

from caneflow.algorithms.inertial.standing import StandingDetector, StandingSettings

START_NS = 1_700_000_000_000_000_000


def standing(bob: float, turn_rate: float, *, swing: float = 0.0, seconds: float = 3.0) -> list[bool]:
    """Detections for a hand that bobs at 1.1 Hz (m/s^2) and a shaft that turns (rad/s) or swings at 0.55 Hz."""
    detector = StandingDetector(StandingSettings())
    found = []
    for index in range(round(seconds * 100)):
        t = index / 100
        rate = turn_rate + swing * math.cos(2 * math.pi * 0.55 * t)
        up = bob * math.sin(2 * math.pi * 1.1 * t)
        found.append(detector.update(START_NS + index * 10_000_000, (0.0, 0.0, rate), (0.03, -0.05, up)))
    return found


def test_a_still_hand_stands_once_the_window_is_full() -> None:
    found = standing(0.02, math.radians(1.0))
    assert not any(found[:60])
    assert all(found[60:])


def test_a_walker_without_swing_does_not_stand_nor_does_a_swinging_cane_at_the_height_of_its_turn() -> None:
    assert not any(standing(0.5, math.radians(1.0)))
    assert not any(standing(0.02, 0.0, swing=1.0))


def test_after_a_gap_it_waits() -> None:
    detector = StandingDetector(StandingSettings())
    for index in range(100):
        detector.update(START_NS + index * 10_000_000, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert not detector.update(START_NS + 10_000_000_000, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_what_has_left_the_window_has_left_nothing_behind() -> None:
    """One reading of 1e10 m/s^2 squared is 1e20: a float sum keeps some 1e4 of it, and a still hand never stands."""
    detector, fresh = StandingDetector(StandingSettings()), StandingDetector(StandingSettings())
    detector.update(START_NS - 10_000_000_000, (1e10, 0.0, 0.0), (1e10, -1e10, 1e10))
    for index in range(300):
        t = index / 100
        rate, up = (0.0, 0.0, 0.02), (0.03, -0.05, (0.1 if t < 1.5 else 0.4) * math.sin(2 * math.pi * 1.1 * t))
        stamp_ns = START_NS + index * 10_000_000
        stands = detector.update(stamp_ns, rate, up)
        assert stands == fresh.update(stamp_ns, rate, up) or index < 62, "the full window comes sooner after a gap"
    assert not stands
