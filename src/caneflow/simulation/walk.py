"""How a person walks and moves a white cane: pose of the sensors at 1 kHz, with exact derivatives.

The body follows a course, bobs and sways with each step; the hand goes ahead of it; the cane turns about the hand.
Numbers that nobody has measured for a cane are marked "chosen"; none of them is fitted to an estimator's result.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Gt
from numpy.random import Generator
from scipy.interpolate import CubicSpline

from caneflow.simulation import attitude
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.course import Course, Shape, course
from caneflow.simulation.smooth_noise import slow, tremulous

RATE = 1000  # Hz, of the motion

Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]


@dataclass(frozen=True, kw_only=True)
class Rig:
    """What is bolted on, as `rig:` in the yaml and a recording (wire.md). The boresight is the body's y axis."""

    hand_height: Positive = 0.95  # m, nominal (wire.md, design.md)
    aperture: Positive = 50.0 * DEGREE  # rad, full -3 dB angle, one way (design.md: 0.87)
    pivot: tuple[float, float, float] = (0.0, -0.3, 0.0)  # m, sensors to hand, body (cane.md: 0.3 m)
    antenna: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, IMU to antenna, body
    step_length: Positive = 0.42  # m, nominal (design.md); for step counting only

    def as_map(self) -> dict[str, object]:
        """The rig as a plain map, keys as in wire.md."""
        return {
            "boresight": [0.0, 1.0, 0.0],
            "hand_height": self.hand_height,
            "aperture": float(self.aperture),
            "pivot": list(self.pivot),
            "antenna": list(self.antenna),
            "step_length": self.step_length,
        }


@dataclass(frozen=True, kw_only=True)
class Pause:
    """The walker stands still, and may first step back."""

    at: NotNegative  # m along the course
    duration: Positive  # s of standing; with a step back, half of it before and half after
    back: NotNegative = 0.0  # m stepped backwards


@dataclass(frozen=True, kw_only=True)
class MotionSettings:
    """One person, one way of walking, one course."""

    # The course: the paper's loop of 8 x 3 m, 22 m (section VI.A)
    shape: Shape = "loop"
    length: Positive = 8.0  # m
    width: Positive = 3.0  # m
    corner_radius: Positive = 0.5  # m, chosen: about one step
    laps: Annotated[int, Ge(1)] = 1
    clockwise: bool = False

    # The walk. 22 m in about 50 s with corners and starts (section VI.C) is a cruise of 0.465 m/s
    speed: Positive = 0.465  # m/s on the straight
    speed_variation: NotNegative = 0.05  # of the speed, sd, chosen
    corner_slowing: NotNegative = 0.125  # m: speed / (1 + slowing |curvature|), 0.8 in the corners, chosen
    step_length: Positive = 0.42  # m at `speed`; goes with the square root of the speed
    step_variation: NotNegative = 0.04  # of the step, sd, chosen
    surge: NotNegative = 0.12  # of the speed, amplitude over one step, chosen
    # Inverted pendulum with a leg of 0.9 m and a step of 0.42 m: 0.9 - sqrt(0.9^2 - 0.21^2) = 25 mm peak to peak
    bob: NotNegative = 0.012  # m, amplitude
    sway: NotNegative = 0.02  # m, amplitude over two steps, chosen
    rest_before: NotNegative = 2.0  # s (cane.md, row 15)
    rest_after: NotNegative = 1.0  # s
    pauses: Sequence[Pause] = ()

    # The hand and the cane
    hand_ahead: float = 0.35  # m in front of the body, chosen: forearm forward
    hand_aside: float = 0.0  # m to the left of the body's middle
    hand_height_error: NotNegative = 0.01  # m, sd of the person's hand about the rig's nominal height, chosen
    swing: NotNegative = 20.0 * DEGREE  # rad, amplitude (cane.md: about +-20 deg)
    swing_variation: NotNegative = 0.08  # of the swing, sd, chosen
    swing_until: NotNegative | None = None  # fraction of the course after which the cane is held still
    pitch: Positive = 42.0 * DEGREE  # rad (cane.md: about 42 deg)
    pitch_spread: NotNegative = 2.0 * DEGREE  # rad, sd between walks, chosen
    tip_lift: NotNegative = 0.03  # m, the tip clears the ground in the middle of its arc, chosen
    wander: NotNegative = 1.5 * DEGREE  # rad, sd of each angle over some steps while walking, chosen

    # A hand-held rest is not still: about 0.4 deg of drift (cane.md), which is what a wander of 0.4 deg with a
    # correlation of 2 s does in 2 s; the hand by 3 mm (chosen). `restlessness` scales both.
    restlessness: NotNegative = 1.0
    # Postural tremor of the hand: modal peak 0.01 g at 7 Hz, bandwidth about 2.5 Hz (97 normal subjects, Arch.
    # Neurol. 39(6):358, 1982), that is 0.05 mm; the cane turns by 0.05 mm over the 0.3 m from hand to sensors
    tremor: NotNegative = 0.035e-3  # m, sd


class Motion(NamedTuple):
    """A walk at 1 kHz: n samples, in R0 unless said otherwise."""

    time: Floats  # (n,) s
    position: Floats  # (n, 3) m, of the IMU's origin
    velocity: Floats  # (n, 3) m/s
    acceleration: Floats  # (n, 3) m/s^2
    orientation: Floats  # (n, 4)
    rate: Floats  # (n, 3) rad/s, body
    hand: Floats  # (n, 3) m
    distance: Floats  # (n,) m along the course
    steps: Floats  # (n,) steps made; whole numbers are heel strikes


class _Pace(NamedTuple):
    """Where the walker would be without ever standing still."""

    elapsed: Floats  # (m,) s of cruise time
    distance: Floats  # (m,) m


class _Leg(NamedTuple):
    """A stretch between two rests, forwards or backwards."""

    start: float  # s
    end: float  # s
    change: float  # s of cruise time, negative for a step back


_RAMP = 1.0  # s from standing to cruising: about two steps, chosen
_BACKWARD_PACE = 0.5  # of the forward one, chosen
_PACE_SCALE = 3.0  # m over which speed and step length wander, chosen
_WANDER_SCALE = 3.0  # steps over which the cane's angles wander, chosen
_DRIFT = (0.4 * DEGREE, 0.003)  # rad and m (see MotionSettings.restlessness)
_DRIFT_SCALE = 2.0  # s
_TREMOR = (7.0, 1.0)  # Hz, centre and width (see MotionSettings.tremor)


def course_of(settings: MotionSettings) -> Course:
    """The course that a walk with these settings follows."""
    return course(
        settings.shape,
        settings.length,
        settings.width,
        settings.corner_radius,
        settings.laps,
        settings.clockwise,
    )


def walk(
    settings: MotionSettings, rig: Rig, rng: Generator, duration: float | None = None, track: Course | None = None
) -> Motion:
    """A walk of `duration` s, by default until it has been walked to its end, along `track` or the settings' course.

    A shorter walk is the beginning of the longer one; a longer one ends in standing. `rng` makes the person.
    Raises ValueError when a pause does not lie on the course.
    """
    track = track or course_of(settings)
    pace = _pace(track, settings, rng)
    legs = _legs(pace, settings)
    ends = legs[-1].end + settings.rest_after
    duration = ends if duration is None else duration
    # one sample more at each end, for central differences
    time = (np.arange(round(max(duration, ends) * RATE) + 3) - 1) / RATE
    distance = _distance(pace, legs, time)
    steps = _steps(distance, legs, time, settings, rng)
    until = np.inf if settings.swing_until is None else settings.swing_until * track.length
    swing_ends = np.min(steps[distance >= until], initial=np.inf)
    n = round(duration * RATE) + 3
    time, distance, steps = time[:n], distance[:n], steps[:n]
    heading = track.heading(distance)
    hand = _hand(track.position(distance), heading, steps, time, settings, rig, rng)
    orientation = _orientation(heading, steps, time, swing_ends, settings, rig, rng)
    return _differentiated(time, hand, orientation, distance, steps, rig)


def _pace(track: Course, settings: MotionSettings, rng: Generator) -> _Pace:
    """Slower in the corners, and never quite the same."""
    wander = slow(rng, settings.speed_variation, _PACE_SCALE)
    distance = np.linspace(0.0, track.length, max(2, round(track.length / 0.02)))
    bend = np.abs(track.curvature(distance))
    slowness = (1.0 + settings.corner_slowing * bend) / settings.speed * np.exp(-wander(distance))
    elapsed = np.concatenate([[0.0], np.cumsum(0.5 * (slowness[1:] + slowness[:-1])) * distance[1]])
    return _Pace(elapsed, distance)


def _legs(pace: _Pace, settings: MotionSettings) -> list[_Leg]:
    """The stretches between the rests, in order."""
    # (stand for, s), (go to, m), (at this part of the pace)
    plan, stood, here, end = [], settings.rest_before, 0.0, float(pace.distance[-1])
    for pause in sorted(settings.pauses, key=lambda pause: pause.at):
        if not here < pause.at < end or pause.back > pause.at:
            raise ValueError(
                f"a pause at {pause.at} m, back {pause.back} m; it must lie between {here:.2f} and {end:.2f} m"
            )
        plan.append((stood, pause.at, 1.0))
        stood, here = pause.duration, pause.at
        if pause.back > 0.0:
            plan.append((0.5 * pause.duration, pause.at - pause.back, _BACKWARD_PACE))
            stood = 0.5 * pause.duration
    plan.append((stood, end, 1.0))

    legs: list[_Leg] = []
    now, cruise = 0.0, 0.0
    for stands, there, part in plan:
        change = float(np.interp(there, pace.distance, pace.elapsed)) - cruise
        lasts = abs(change) / part
        # to start and stop costs a ramp; on a leg shorter than that the walker never reaches the cruise
        start = now + stands
        now, cruise = start + lasts + min(_RAMP, lasts), cruise + change
        legs.append(_Leg(start, now, change))
    return legs


def _distance(pace: _Pace, legs: Sequence[_Leg], time: Floats) -> Floats:
    """Distance along the course (m) at `time` (s): every leg starts and ends gently."""
    cruise = np.zeros_like(time)
    for leg in legs:
        lasts = leg.end - leg.start
        ramp = min(_RAMP, 0.5 * lasts)
        t = np.clip(time - leg.start, 0.0, lasts)
        gone = np.where(t < ramp, ramp * _eased_integral(t / ramp), t - 0.5 * ramp)
        left = lasts - t
        gone = np.where(left < ramp, lasts - ramp - ramp * _eased_integral(left / ramp), gone)
        cruise += leg.change / (lasts - ramp) * gone
    return np.asarray(CubicSpline(pace.elapsed, pace.distance)(cruise), dtype=np.float64)


def _eased(x: Floats) -> Floats:
    """0 below 0, 1 above 1, and two continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0))


def _eased_integral(x: Floats) -> Floats:
    """Integral of `_eased` from 0 to x, for x in 0..1."""
    return x**4 * (2.5 + x * (x - 3.0))


def _steps(distance: Floats, legs: Sequence[_Leg], time: Floats, settings: MotionSettings, rng: Generator) -> Floats:
    """Steps made at `time`: the cadence, like the step length, goes with the square root of the speed.

    Every leg is a whole number of steps, because a walker stops with both feet down; all of them together are an
    even number, so that the cane ends on the side on which it began.
    """
    wander = slow(rng, settings.step_variation, _PACE_SCALE)
    speed = np.abs(np.gradient(distance, 1.0 / RATE))
    cadence = np.sqrt(speed * settings.speed) / settings.step_length * np.exp(-wander(distance))
    made = np.cumsum(cadence) / RATE
    begun = [float(np.interp(leg.start, time, made)) for leg in legs]
    ended = [float(np.interp(leg.end, time, made)) for leg in legs]
    whole = [max(1, round(end - begin)) for begin, end in zip(begun, ended, strict=True)]
    odd = sum(whole[:-1]) % 2
    whole[-1] = max(2 - odd, odd + 2 * round(0.5 * (ended[-1] - begun[-1] - odd)))
    steps = np.zeros_like(made)
    for begin, end, count in zip(begun, ended, whole, strict=True):
        steps += count * (np.clip(made, begin, end) - begin) / (end - begin)
    return steps


def _hand(
    body: Floats,
    heading: Floats,
    steps: Floats,
    time: Floats,
    settings: MotionSettings,
    rig: Rig,
    rng: Generator,
) -> Floats:
    """Position of the hand, (n, 3) m: ahead of the body, carried along by its gait.

    Phases of an inverted pendulum: at a heel strike (whole step) the body is lowest and fastest, in between it is
    highest and farthest over the standing leg.
    """
    # a speed that swings by the part `surge` over a step is an offset that swings by its integral
    surge = settings.surge * settings.step_length / (2.0 * np.pi) * np.sin(2.0 * np.pi * steps)
    ahead = settings.hand_ahead + surge
    aside = settings.hand_aside + settings.sway * np.sin(np.pi * steps)
    height = rig.hand_height + rng.normal(0.0, 1.0) * settings.hand_height_error
    cos, sin = np.cos(heading), np.sin(heading)
    hand = np.stack(
        [
            body[:, 0] + cos * ahead - sin * aside,
            body[:, 1] + sin * ahead + cos * aside,
            height - settings.bob * np.cos(2.0 * np.pi * steps),
        ],
        axis=1,
    )
    for axis in range(3):
        hand[:, axis] += slow(rng, settings.restlessness * _DRIFT[1], _DRIFT_SCALE)(time)
        hand[:, axis] += tremulous(rng, settings.tremor, *_TREMOR)(time)
    return hand


def _orientation(
    heading: Floats,
    steps: Floats,
    time: Floats,
    swing_ends: float,
    settings: MotionSettings,
    rig: Rig,
    rng: Generator,
) -> Floats:
    """Orientation of the cane, (n, 4).

    Two-point touch: at each heel strike the tip touches the ground on one side, in between it passes the middle
    and is lifted. When the cane swings no more it is held straight ahead.
    """
    side = rng.choice([-1.0, 1.0])
    held = _eased(0.5 * (steps - swing_ends))  # 0 while swinging, 1 two steps after the last one
    size = settings.swing * (1.0 + slow(rng, settings.swing_variation, _WANDER_SCALE)(steps)) * (1.0 - held)
    swing = side * size * np.cos(np.pi * steps)
    cane_length = rig.hand_height / np.sin(settings.pitch)
    lift = settings.tip_lift / cane_length * np.sin(np.pi * steps) ** 2 * (1.0 - held)
    base = settings.pitch + rng.normal(0.0, 1.0) * settings.pitch_spread
    yaw, pitch, roll = heading + swing, base - lift, np.zeros_like(heading)
    lever = float(np.linalg.norm(rig.pivot))
    for angle in (yaw, pitch, roll):
        angle += slow(rng, settings.wander, _WANDER_SCALE)(steps)
        angle += slow(rng, settings.restlessness * _DRIFT[0], _DRIFT_SCALE)(time)
        angle += tremulous(rng, settings.tremor / lever, *_TREMOR)(time)
    return attitude.from_angles(yaw, pitch, roll)


def _differentiated(
    time: Floats, hand: Floats, orientation: Floats, distance: Floats, steps: Floats, rig: Rig
) -> Motion:
    """The motion of the IMU's origin by central differences; the first and the last sample go."""
    position = hand - attitude.rotate(orientation, rig.pivot)
    turned = attitude.multiply(attitude.conjugate(orientation[:-2]), orientation[2:])
    return Motion(
        time=time[1:-1],
        position=position[1:-1],
        velocity=0.5 * RATE * (position[2:] - position[:-2]),
        acceleration=RATE**2 * (position[2:] - 2.0 * position[1:-1] + position[:-2]),
        orientation=orientation[1:-1],
        rate=0.5 * RATE * attitude.to_rotation_vector(turned),
        hand=hand[1:-1],
        distance=distance[1:-1],
        steps=steps[1:-1],
    )
