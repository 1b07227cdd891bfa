"""How a person walks through a room: trunk and limbs at 200 Hz, and the points that a radar sees of them.

Gait: R. Boulic, N. Magnenat Thalmann, D. Thalmann, "A global human walking model with real-time kinematic
personification", The Visual Computer 6 (1990) 344-358, the model of most simulated micro-Doppler. Letters as there:
RV relative velocity = speed / leg length. All of it fades as the speed does, so that who stands, stands.
Proportions of the body: D. A. Winter, Biomechanics and Motor Control of Human Movement, fractions of the height.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Gt
from numpy.random import Generator

from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.room_course import RATE, Trajectory
from caneflow.simulation.smooth_noise import slow

NotNegative = Annotated[float, Ge(0)]
Positive = Annotated[float, Gt(0)]


@dataclass(frozen=True, kw_only=True)
class PersonSettings:
    """One person; spreads between persons are chosen."""

    height: Positive = 1.72  # m
    height_spread: NotNegative = 0.08  # m, sd
    gait_spread: NotNegative = 0.12  # sd of each of the gait's amplitudes, relative
    # The trunk is not quite along the travel: it leads into a bend and looks about (both chosen; with the belt's own
    # sd of 4 deg, belt_imu.py, and the indoor field this makes the 7 deg of room.md, row 18)
    trunk_lead: NotNegative = 0.15  # s
    trunk_wander: NotNegative = 4.0 * DEGREE  # rad, sd
    trunk_wander_scale: Positive = 2.0  # s
    # A person at rest sways by some millimetres within seconds (posturography; chosen)
    standing_sway: NotNegative = 0.004  # m, sd per axis

    # Radar cross-sections at 24 GHz, m^2, mean over the aspects. The trunk's is room.md's. The limbs' are in the
    # ratio of the body's surface, as J. L. Geisheimer et al. have it ("A high-resolution Doppler model of human
    # gait", SPIE 4744, 2002: Lund and Browder's chart), at `limb_share` of it: the trunk is the one large smooth face
    trunk: Positive = 0.6
    trunk_spread: NotNegative = 0.8  # dB, sd between persons
    limb_share: NotNegative = 0.4  # chosen
    # Trunk by aspect a from the chest: trunk (1 + aspect cos 2 a), 3 dB between chest and side (chosen)
    aspect: Annotated[float, Ge(0), Gt(-1)] = 0.33
    specular_share: Annotated[float, Ge(0)] = 0.6  # of the trunk's power in one point that glides over it (chosen)
    trunk_points: Annotated[int, Ge(1)] = 10  # that share the rest and make the speckle
    # Slow fluctuation of the trunk's cross-section as one sensor sees it (room.md: 1.5 dB)
    fluctuation: NotNegative = 1.5  # dB, sd
    fluctuation_scale: Positive = 2.0  # s, chosen


class Person(NamedTuple):
    """Someone with a body of their own."""

    height: float  # m
    trunk: float  # m^2
    amplitudes: Floats  # (7,) factors: bob, sway, surge, torsion, tilt, arms, feet
    patch_angle: Floats  # (k,) rad from the chest, counter-clockwise: the trunk's fixed points ...
    patch_height: Floats  # (k,) m above the floor
    starts: float  # stride at which every walk begins, 0..1


class Gait(NamedTuple):
    """A walk of the trunk at RATE, n samples."""

    trajectory: Trajectory
    strides: Floats  # (n,) strides made
    stride_length: Floats  # (n,) m
    support: Floats  # (n,) part of a stride that a foot is on the floor
    relative: Floats  # (n,) RV
    trunk_heading: Floats  # (n,) rad, of the trunk as a whole
    centre: Floats  # (n, 3) m, between the hips
    pelvis: Floats  # (n, 3) rad: yaw, pitch (forwards), roll (to the right), of the pelvis
    thorax_yaw: Floats  # (n,) rad


class Body(NamedTuple):
    """What there is of a person to reflect: p points and a trunk, n samples at RATE."""

    limbs: Floats  # (p, n, 3) m
    limb_sections: Floats  # (p,) m^2
    axis: Floats  # (n, 3) m, of the trunk, at the height of its middle
    facing: Floats  # (n,) rad, of the chest
    patches: Floats  # (k, n, 3) m, points that are fixed on the trunk
    patch_facing: Floats  # (k, n) rad, of the skin there
    trunk: float  # m^2


class Seen(NamedTuple):
    """A person as one sensor sees it: q points, n samples at RATE."""

    points: Floats  # (q, n, 3) m
    amplitudes: Floats  # (q, n) m, square roots of cross-sections


def person(settings: PersonSettings, rng: Generator) -> Person:
    """Someone."""
    height = float(np.clip(rng.normal(settings.height, settings.height_spread), 1.5, 1.95))
    trunk = settings.trunk * 10.0 ** (0.1 * rng.normal(0.0, settings.trunk_spread))
    amplitudes = np.clip(1.0 + settings.gait_spread * rng.normal(0.0, 1.0, 7), 0.5, 1.5)
    # evenly around, each somewhere within its share
    count = settings.trunk_points
    angle = 2.0 * np.pi * (np.arange(count) + rng.uniform(0.0, 1.0, count)) / count
    return Person(
        height=height,
        trunk=float(trunk),
        amplitudes=amplitudes,
        patch_angle=angle,
        patch_height=height * rng.uniform(_HIP, _SHOULDER, count),
        starts=float(rng.uniform()),
    )


def gait(way: Trajectory, who: Person, settings: PersonSettings, rng: Generator) -> Gait:
    """Someone walks a trajectory."""
    leg = who.height * _LEG
    speed = np.hypot(way.velocity[:, 0], way.velocity[:, 1])
    relative = speed / leg
    stride_length = 1.346 * np.sqrt(relative) * leg
    # speed / stride length, written so that it is 0 at rest; the phase is that of the right leg
    strides = who.starts + np.cumsum(np.sqrt(relative) / 1.346) / RATE
    per_stride = 1.346 / np.sqrt(np.maximum(relative, 1e-3))  # s
    support = np.clip(0.752 - 0.143 / per_stride, 0.55, 0.7)
    ease = 4.0 * np.minimum(relative, 0.5) * (1.0 - np.minimum(relative, 0.5))  # 0 at rest, 1 from RV = 0.5 on
    bob, sway, surge, torsion, tilt, _, _ = who.amplitudes
    turn = 2.0 * np.pi * strides

    trunk_heading = _led(way.heading, settings.trunk_lead)
    trunk_heading = trunk_heading + slow(rng, settings.trunk_wander, settings.trunk_wander_scale)(way.time)
    # a speed that swings by the part _SURGE over a step is an offset that swings by its integral
    ahead = surge * _SURGE / (4.0 * np.pi) * stride_length * np.sin(2.0 * turn)
    aside = -sway * 0.032 * leg * ease * np.sin(turn - 0.2 * np.pi)
    bobbing = np.sin(2.0 * turn - 0.7 * np.pi) + _HEEL_STRIKE * np.sin(4.0 * turn - 1.4 * np.pi)
    height = who.height * _HIP + bob * 0.015 * leg * relative * (bobbing - 1.0)
    cos, sin = np.cos(way.heading), np.sin(way.heading)
    centre = np.column_stack(
        [
            way.position[:, 0] + cos * ahead - sin * aside,
            way.position[:, 1] + sin * ahead + cos * aside,
            height,
        ]
    )
    for axis in (0, 1):
        centre[:, axis] += slow(rng, settings.standing_sway, 2.0)(way.time)
    pelvis = np.column_stack(
        [
            trunk_heading - torsion * 4.0 * DEGREE * relative * np.cos(turn),
            tilt * 2.0 * DEGREE * ease * np.sin(2.0 * turn - 0.2 * np.pi),
            # hips: 0.01 RV of the leg's length up and down, half a hip's width from the middle
            tilt * 0.01 * relative * leg / (_HIP_WIDTH * who.height) * np.sin(turn - 0.3 * np.pi),
        ]
    )
    thorax_yaw = trunk_heading + torsion * 1.5 * DEGREE * relative * np.cos(turn - 0.5 * np.pi)
    return Gait(way, strides, stride_length, support, relative, trunk_heading, centre, pelvis, thorax_yaw)


def body(walk: Gait, who: Person, settings: PersonSettings) -> Body:
    """The points of someone who walks: trunk, head, and three on each limb."""
    limbs, sections = [_head(walk, who)], [_SURFACE["head"]]
    for side in (1.0, -1.0):  # left, right
        limbs += _arm(walk, who, side)
        limbs += _leg(walk, who, side)
        sections += [_SURFACE[part] for part in ("upper arm", "forearm", "hand", "thigh", "shank", "foot")]
    share = settings.limb_share * settings.trunk / _SURFACE["trunk"]
    axis = walk.centre.copy()
    axis[:, 2] += who.height * (0.5 * (_HIP + _SHOULDER) - _HIP)
    return Body(
        limbs=np.stack(limbs),
        limb_sections=share * np.array(sections),
        axis=axis,
        facing=walk.thorax_yaw,
        patches=np.stack([_patch(walk, who, i) for i in range(len(who.patch_angle))]),
        patch_facing=walk.thorax_yaw + np.array([_normal(angle) for angle in who.patch_angle])[:, None],
        trunk=who.trunk,
    )


def seen_from(someone: Body, sensor: Floats, settings: PersonSettings, rng: Generator) -> Seen:
    """What a sensor at `sensor` (3,) m has before it: points, and which way they are turned.

    The trunk is an upright elliptic cylinder. Its specular point is where the skin faces the sensor, so it glides
    around the trunk as a person turns; points fixed on the skin are seen as far as they face the sensor.
    """
    time = np.arange(len(someone.facing)) / RATE
    fluctuation = 10.0 ** (0.05 * slow(rng, settings.fluctuation, settings.fluctuation_scale)(time))
    direction = np.arctan2(sensor[1] - someone.axis[:, 1], sensor[0] - someone.axis[:, 0])
    aspect = direction - someone.facing
    section = someone.trunk * (1.0 + settings.aspect * np.cos(2.0 * aspect))
    specular = someone.axis + _on_skin(aspect, someone.facing)
    towards = np.cos(direction - someone.patch_facing)
    # the mean square of 2 max(0, cos) over all aspects is 1
    patches = np.sqrt((1.0 - settings.specular_share) / len(towards) * section) * 2.0 * np.maximum(towards, 0.0)
    limbs = np.sqrt(someone.limb_sections)[:, None] * np.ones_like(aspect)
    return Seen(
        points=np.concatenate([specular[None], someone.patches, someone.limbs]),
        amplitudes=np.concatenate(
            [
                (fluctuation * np.sqrt(settings.specular_share * section))[None],
                fluctuation * patches,
                limbs,
            ]
        ),
    )


_SURGE = 0.12  # of the speed, amplitude over a step, as in walk.py; the model's 0.021 leg lengths would be twice that
_HEEL_STRIKE = 0.12  # second harmonic of the bob: half as much again in acceleration, a soft impact (chosen)

# Fractions of the height (Winter)
_HIP, _SHOULDER, _HEAD = 0.53, 0.818, 0.936
_HIP_WIDTH, _SHOULDER_WIDTH = 0.0955, 0.1295  # half
_LEG, _UPPER_ARM, _FOREARM = 0.491, 0.188, 0.152
_ANKLE = 0.039
_HALF_BREADTH, _HALF_DEPTH = 0.17, 0.11  # m, of the trunk (chosen: 34 by 22 cm)

# Parts of the body's surface (Lund and Browder's chart for adults; one of a pair, the trunk with the buttocks)
_SURFACE = {
    "trunk": 0.32,
    "head": 0.09,
    "upper arm": 0.04,
    "forearm": 0.03,
    "hand": 0.025,
    "thigh": 0.095,
    "shank": 0.07,
    "foot": 0.035,
}


def _led(heading: Floats, lead: float) -> Floats:
    """The heading that will be travelled `lead` s later."""
    ahead = np.minimum(np.arange(len(heading)) + round(lead * RATE), len(heading) - 1)
    led: Floats = heading[ahead]
    return led


def _on_skin(aspect: Floats, facing: Floats) -> Floats:
    """From the trunk's axis to where its skin faces `aspect` (n,), rad from the chest: (n, 3) m."""
    reach = np.sqrt((_HALF_DEPTH * np.cos(aspect)) ** 2 + (_HALF_BREADTH * np.sin(aspect)) ** 2)
    ahead, left = _HALF_DEPTH**2 * np.cos(aspect) / reach, _HALF_BREADTH**2 * np.sin(aspect) / reach
    return _turned(ahead, left, np.zeros_like(ahead), facing)


def _normal(angle: float) -> float:
    """Where the skin faces at the point of the ellipse with parameter `angle`, rad from the chest."""
    return float(np.arctan2(np.sin(angle) / _HALF_BREADTH, np.cos(angle) / _HALF_DEPTH))


def _turned(ahead: Floats, left: Floats, up: Floats, heading: Floats) -> Floats:
    """Offsets (n, 3) m in the room of a body that faces `heading`."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.column_stack([cos * ahead - sin * left, sin * ahead + cos * left, up])


def _patch(walk: Gait, who: Person, index: int) -> Floats:
    """Where a fixed point of the trunk is, (n, 3) m; it leans with the pelvis."""
    angle, height = who.patch_angle[index], who.patch_height[index] - who.height * _HIP
    ahead = _HALF_DEPTH * np.cos(angle) + height * np.sin(walk.pelvis[:, 1])
    left = _HALF_BREADTH * np.sin(angle) + height * np.sin(walk.pelvis[:, 2])
    return walk.centre + _turned(ahead, left, np.full_like(ahead, height), walk.thorax_yaw)


def _head(walk: Gait, who: Person) -> Floats:
    up = np.full_like(walk.strides, who.height * (_HEAD - _HIP))
    return walk.centre + _turned(np.full_like(up, 0.06), np.zeros_like(up), up, walk.trunk_heading)


def _arm(walk: Gait, who: Person, side: float) -> list[Floats]:
    """Middle of the upper arm, middle of the forearm, and hand; an arm goes back while its side's leg goes ahead."""
    turn = 2.0 * np.pi * (walk.strides + (0.5 if side > 0.0 else 0.0))
    swing = who.amplitudes[5] * 9.88 * DEGREE * walk.relative
    shoulder = -swing * np.cos(turn) + 3.0 * DEGREE - 0.5 * swing
    elbow = shoulder + 12.0 * DEGREE + np.minimum(walk.relative, 1.3) * 12.0 * DEGREE * (1.0 - np.cos(turn))
    points = []
    upper, fore = _UPPER_ARM * who.height, _FOREARM * who.height
    for along_upper, along_fore in ((0.5, 0.0), (1.0, 0.5), (1.0, 1.0)):
        ahead = along_upper * upper * np.sin(shoulder) + along_fore * fore * np.sin(elbow)
        down = along_upper * upper * np.cos(shoulder) + along_fore * fore * np.cos(elbow)
        left = np.full_like(ahead, side * _SHOULDER_WIDTH * who.height)
        points.append(walk.centre + _turned(ahead, left, who.height * (_SHOULDER - _HIP) - down, walk.thorax_yaw))
    return points


def _leg(walk: Gait, who: Person, side: float) -> list[Floats]:
    """Middle of the thigh, middle of the shank, and foot.

    A foot stands still on the floor for `support` of a stride, then overtakes the body.
    """
    phase = (walk.strides + (0.5 if side > 0.0 else 0.0)) % 1.0
    ahead, lift = _foot(phase, walk.support)
    left = np.full_like(phase, side * _HIP_WIDTH * who.height)
    way = walk.trajectory
    floor = np.column_stack([way.position, np.zeros_like(phase)])
    foot = floor + _turned(
        ahead * walk.stride_length,
        left,
        _ANKLE * who.height + who.amplitudes[6] * 0.12 * np.minimum(walk.relative, 1.0) * lift,
        way.heading,
    )
    hip = walk.centre + _turned(np.zeros_like(left), left, np.zeros_like(left), walk.pelvis[:, 0])
    # the knee goes ahead of the line from hip to foot, most while the foot is lifted (chosen)
    bend = (0.02 + 0.14 * np.minimum(walk.relative, 1.0) * lift) * who.height
    knee = 0.5 * (hip + foot) + _turned(bend, np.zeros_like(bend), np.zeros_like(bend), way.heading)
    return [0.5 * (hip + knee), 0.5 * (knee + foot), foot]


def _foot(phase: Floats, support: Floats) -> tuple[Floats, Floats]:
    """Where a foot is ahead of the body, in strides, and how far it is lifted, 0..1.

    On the floor it falls back by as much as the body goes on; in the air a cubic takes it ahead without a jerk.
    """
    half = 0.5 * support
    swing = 1.0 - support
    x = np.clip((phase - support) / swing, 0.0, 1.0)
    # Hermite from -half to half, both ends with the slope -1 per stride that the foot has on the floor
    forward = half * (-1.0 + x * x * (6.0 - 4.0 * x)) - swing * x * (1.0 - x) * (1.0 - 2.0 * x)
    ahead = np.where(phase < support, half - phase, forward)
    return ahead, np.sin(np.pi * x) ** 2
