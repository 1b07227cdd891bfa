"""The paper's observer in whole numbers: what a microcontroller without floating point computes, bit for bit.

A number is an `int` that fits into 32 bits, its value n / 2**fraction; Qm.f has m bits before and f behind the point
besides the sign. Products have 64 bits. docs/methods/luenberger_fixed.md gives the reason for each format;
mcu/observer.c does the same in C, line by line, and tests hold the two equal in every bit.

Rounding: a number that comes in, half away from zero; a product, half up (add half, shift right, which is floor); a
quotient, half away from zero. The position loses nothing: what does not fit is carried over to the next sample.
Saturation: whatever would leave its 32 bits stays at the end of them, and the sample is flagged.
"""

import math
import struct
from binascii import crc32
from collections import deque
from typing import Final, NamedTuple, TypeAlias

from caneflow.algorithms.cane.dead_reckoning import DeadReckoning, PoseEstimate
from caneflow.algorithms.cane.luenberger import LuenbergerSettings
from caneflow.algorithms.cane.speed_gate import LONGEST_GAP
from caneflow.algorithms.glitches import JumpGate
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.imu_sample import required_acceleration, required_orientation
from caneflow.algorithms.rotations import Quaternion, Vector
from caneflow.physics import GRAVITY

METHOD: Final = "luenberger_fixed"

# Bits behind the point.
UNIT = 30  # Q1.30: quaternion, boresight, cos and sin of the heading
ACCELERATION = 22  # Q9.22, m/s^2: up to 512
VELOCITY = 25  # Q6.25, m/s: up to 64
POSITION = 20  # Q11.20, m: up to 2048
GAIN = 29  # Q2.29: L, up to 4
STEP = 31  # Q0.31, s: an interval up to LONGEST_INTERVAL_NS
GAP = 16  # Q15.16, s: a longer one
DELAY = 28  # Q3.28, s
CARRIED = 16  # bits of a position's remainder, behind its own

LARGEST = 2**31 - 1  # states stay within +-this
LARGEST_INPUT = 2**30  # accelerations (256 m/s^2) and speeds (32 m/s): leaves room for sums of products
LONGEST_INTERVAL_NS = 500_000_000  # dead_reckoning.LONGEST_INTERVAL
LONGEST_GAP_NS = 2**44  # 4.9 h
NS_TO_STEP = round(2**63 / 10**9)  # ns in Q0.31 s, times 2**32
NANOSECONDS = 10**9
HISTORY = 64  # headings that a late speed may reach back: 0.64 s at 100 Hz
WAITING = 16  # speeds that may wait for an IMU sample later than theirs
SHORTEST_HEADING = 2**10  # 1e-6, Q1.30: a boresight with less horizontal part points straight up or down
UNIT_TOLERANCE = 2 ** (2 * UNIT - 8)  # of a quaternion's squared norm, Q3.60: twice what messages are held to
GRAVITY_FIXED = round(GRAVITY * 2**ACCELERATION)

# What counts as wild: the defaults of CaneGlitchSettings, and like those held for three samples at most.
LARGEST_JUMP = 10 * 2**ACCELERATION  # m/s^2, of the acceleration without gravity, in R0
LEAST_COSINE = round(math.cos(math.radians(5.0)) * 2 ** (2 * UNIT))  # of half of 10 degrees, between two attitudes
SPEED_JUMP, UNSEEN_SPEED = 1 * 2**VELOCITY, 3 * 2**VELOCITY  # m/s
DELAY_JUMP, UNSEEN_DELAY = 100_000_000, 1_000_000_000  # ns
RULES = 2  # raised when the firmware is to compute something else from the same constants

Integers: TypeAlias = tuple[int, int, int]


class ObserverConstants(NamedTuple):
    """All that the settings and the rig amount to: what is compiled into the firmware."""

    gain_aa: int  # Q2.29, rows and columns a, v as in LuenbergerSettings.gain
    gain_av: int  # Q2.29, (m/s^2) / (m/s)
    gain_va: int  # Q2.29, (m/s) / (m/s^2); of no use when it follows the interval
    gain_vv: int  # Q2.29
    follows_interval: int  # 1: L_va is the interval, so that the poles stay where they were placed
    boresight: Integers  # Q1.30
    heading_at_delay: int  # 1: a speed takes the heading at its stamp less its delay

    @property
    def digest(self) -> int:
        """32 bits that tell these constants from others: a host asks the firmware for them."""
        values = (*self[:5], *self.boresight, self.heading_at_delay, RULES)
        return crc32(struct.pack(">10i", *values))


def observer_constants(settings: LuenbergerSettings, boresight: Vector) -> ObserverConstants:
    """The constants of the fixed-point observer.

    Raises ValueError for a gain of 4 or more and for `compensate_delay: motion`, which it does not have.
    """
    if settings.compensate_delay == "motion":
        raise ValueError("compensate_delay is motion; in fixed point there are none and heading")
    poles = settings.pole_acceleration, settings.pole_velocity
    gain = settings.gain or ((1.0 - poles[0], 0.0), (0.0, 1.0 - poles[1]))
    largest = LARGEST / 2**GAIN
    if any(abs(entry) > largest for row in gain for entry in row):
        raise ValueError(f"gain is {gain}; in fixed point each entry is below 4")
    (aa, av), (va, vv) = gain
    x, y, z = boresight
    return ObserverConstants(
        gain_aa=fixed(aa, GAIN)[0],
        gain_av=fixed(av, GAIN)[0],
        gain_va=fixed(va, GAIN)[0],
        gain_vv=fixed(vv, GAIN)[0],
        follows_interval=int(settings.gain is None),
        boresight=(fixed(x, UNIT)[0], fixed(y, UNIT)[0], fixed(z, UNIT)[0]),
        heading_at_delay=int(settings.compensate_delay == "heading"),
    )


# --- numbers --------------------------------------------------------------------------------------------------------


def fixed(value: float, fraction: int, largest: int = LARGEST) -> tuple[int, bool]:
    """(`value` * 2**`fraction` rounded half away from zero, whether it had to be cut to +-`largest`).

    From the bits of the IEEE 754 double: sign, 11 bits of exponent, 52 of the mantissa. `value` is finite.
    """
    (bits,) = struct.unpack(">Q", struct.pack(">d", value))
    exponent = bits >> 52 & 0x7FF
    mantissa = bits & (1 << 52) - 1
    if exponent:
        mantissa |= 1 << 52
    else:
        exponent = 1  # subnormal
    shift = exponent - 1075 + fraction  # value = mantissa * 2**(exponent - 1075)
    if shift >= 0:  # at least 2**52
        magnitude = largest + 1
    elif shift >= -62:
        magnitude = mantissa + (1 << -shift - 1) >> -shift
    else:
        magnitude = 0
    cut = magnitude > largest
    magnitude = min(magnitude, largest)
    return (-magnitude if bits >> 63 else magnitude), cut


def product(a: int, b: int, shift: int) -> int:
    """The product a * b / 2**shift, rounded half up."""
    return a * b + (1 << shift - 1) >> shift


def quotient(a: int, b: int) -> int:
    """The quotient a / b for b > 0, rounded half away from zero."""
    magnitude = (abs(a) + (b >> 1)) // b
    return -magnitude if a < 0 else magnitude


def rotated(unit: tuple[int, int, int, int], vector: Integers) -> Integers:
    """The world vector for a body `vector` in any format, by a quaternion in Q1.30; see rotations.rotate."""
    w, x, y, z = unit
    a, b, c = vector
    half = 1 << UNIT - 2  # t = 2 (q_vec x v): one bit less to shift
    tx = y * c - z * b + half >> UNIT - 1
    ty = z * a - x * c + half >> UNIT - 1
    tz = x * b - y * a + half >> UNIT - 1
    half = 1 << UNIT - 1
    return (
        a + (w * tx + y * tz - z * ty + half >> UNIT),
        b + (w * ty + z * tx - x * tz + half >> UNIT),
        c + (w * tz + x * ty - y * tx + half >> UNIT),
    )


_Attitude: TypeAlias = tuple[tuple[int, int, int, int], Quaternion]  # in Q1.30, and as it came


# --- the observer ---------------------------------------------------------------------------------------------------


class _Speed(NamedTuple):
    stamp_ns: int
    speed: int  # Q6.25, m/s
    delay_ns: int


class _Heading(NamedTuple):
    stamp_ns: int
    cos: int  # Q1.30
    sin: int  # Q1.30


class FixedLuenbergerObserver(DeadReckoning):
    """The observer of algorithms.luenberger in 32-bit states: for each axis of R0 a, v, p and p's remainder.

    Takes and gives SI floats, as the other methods do: rounded to the format on the way in, exact on the way out.
    `saturated`: whether something was cut to its format in the last estimate or in a speed since the one before.
    `held`: what of the last sample, and of the speeds before it, was wild and held back (glitches.py).
    `gaps`: how many intervals were longer than LONGEST_INTERVAL_NS.
    """

    has_gates = True

    def __init__(self, settings: LuenbergerSettings, *, boresight: Vector) -> None:
        """Raises ValueError for settings that fixed point does not have, see `observer_constants`."""
        self._constants = observer_constants(settings, boresight)
        self._last_ns: int | None = None
        self._waiting: deque[_Speed] = deque(maxlen=WAITING)
        self._headings: deque[_Heading] = deque(maxlen=HISTORY)
        self._measured: Integers = (0, 0, 0)  # y_a of the last sample
        self._acceleration: Integers = (0, 0, 0)
        self._velocity: Integers = (0, 0, 0)
        self._position: Integers = (0, 0, 0)
        self._remainder: Integers = (0, 0, 0)  # of the position, 2**-36 m
        self._flagged = False  # something was cut since the last estimate
        self.saturated = False  # likewise, until the last estimate
        self._orientations: JumpGate[_Attitude] = JumpGate(-LEAST_COSINE, _unlikeness)
        self._accelerations: JumpGate[Integers] = JumpGate(
            LARGEST_JUMP**2, _apart, start=(0, 0, 0), unseen_limit=LARGEST_JUMP**2
        )
        self._speeds: JumpGate[int] = JumpGate(
            SPEED_JUMP, _difference, longest_gap=LONGEST_GAP, start=0, unseen_limit=UNSEEN_SPEED
        )
        self._delays: JumpGate[int] = JumpGate(
            DELAY_JUMP, _difference, longest_gap=LONGEST_GAP, start=0, unseen_limit=UNSEEN_DELAY
        )
        self._held_speed = False  # since the last estimate
        self.held = ()
        self._gaps = 0  # intervals longer than LONGEST_INTERVAL_NS

    @property
    def states(self) -> tuple[Integers, Integers, Integers]:
        """Acceleration (Q9.22), velocity (Q6.25) and position (Q11.20) in R0."""
        return self._acceleration, self._velocity, self._position

    @property
    def gaps(self) -> int:
        """How many intervals between IMU samples were longer than LONGEST_INTERVAL."""
        return self._gaps

    def speed(self, stamp_ns: int, speed: float, quality: float, valid: bool, delay: float | None) -> None:
        """Take a new ground speed (m/s); the observer has no use for its quality (m/s)."""
        if not valid:
            return
        delay_ns = product(self._taken(delay or 0.0, DELAY, LARGEST), NANOSECONDS, DELAY)
        taken = self._taken(speed, VELOCITY, LARGEST_INPUT)
        self._speeds.update(stamp_ns, taken)
        self._delays.update(stamp_ns, delay_ns)
        if self._speeds.holding or self._delays.holding:
            self._held_speed = True
        else:
            self._waiting.append(_Speed(stamp_ns, taken, delay_ns))

    def imu(self, stamp_ns: int, reading: ImuReading) -> PoseEstimate:
        """The estimate at `stamp_ns`; no covariance, an observer has none.

        Raises ValueError without an orientation, without any acceleration, or when time does not go on.
        """
        orientation = required_orientation(reading.orientation, METHOD)
        unit = _unit(orientation)
        body, without_gravity = required_acceleration(reading, METHOD), reading.linear_accel is not None
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            raise ValueError(f"imu: stamp {stamp_ns} ns is not after the one before, {self._last_ns} ns")
        unit, orientation = self._orientations.update(stamp_ns, (unit, orientation))
        x, y, z = rotated(unit, self._taken_vector(body))
        measured = self._accelerations.update(stamp_ns, (x, y, z if without_gravity else z - GRAVITY_FIXED))
        self._note_held("linear_accel" if without_gravity else "accel")
        if self._last_ns is not None:
            self._advance(stamp_ns, stamp_ns - self._last_ns)
        self._last_ns = stamp_ns
        self._headings.append(_Heading(stamp_ns, *self._heading(unit)))
        self._measured = measured
        self.saturated, self._flagged = self._flagged, False
        position, velocity = _floats(self._position, POSITION), _floats(self._velocity, VELOCITY)
        return PoseEstimate(position, velocity, orientation, None)

    def _note_held(self, acceleration: str) -> None:
        held = (
            (self._orientations.holding, "orientation"),
            (self._accelerations.holding, acceleration),
            (self._held_speed, "speed"),
        )
        self.held = tuple(name for is_held, name in held if is_held)
        self._held_speed = False

    def _advance(self, stamp_ns: int, interval_ns: int) -> None:
        is_gap = interval_ns > LONGEST_INTERVAL_NS
        self._gaps += is_gap
        step = 0 if is_gap else product(interval_ns, NS_TO_STEP, 32)
        ground = self._take(stamp_ns)
        axes = [self._advance_axis(i, step, None if ground is None else ground[i]) for i in range(3)]
        self._acceleration = axes[0][0], axes[1][0], axes[2][0]
        self._velocity = axes[0][1], axes[1][1], axes[2][1]
        positions = [self._advance_position(i, step, interval_ns) for i in range(3)]
        self._position = positions[0][0], positions[1][0], positions[2][0]
        self._remainder = positions[0][1], positions[1][1], positions[2][1]

    def _advance_axis(self, axis: int, step: int, ground: int | None) -> tuple[int, int]:
        """(a, v) of one axis a sample later: A x + L (y - x), the velocity row without L where v is not measured."""
        gains = self._constants
        a, v = self._acceleration[axis], self._velocity[axis]
        innovation_a = self._cut(self._measured[axis] - a)
        next_a = a + product(gains.gain_aa, innovation_a, GAIN)
        next_v = v + product(step, a, STEP + ACCELERATION - VELOCITY)
        if ground is not None:
            innovation_v = self._cut(ground - v)
            next_a += product(gains.gain_av, innovation_v, GAIN + VELOCITY - ACCELERATION)
            if gains.follows_interval:
                next_v += product(step, innovation_a, STEP + ACCELERATION - VELOCITY)
            else:
                next_v += product(gains.gain_va, innovation_a, GAIN + ACCELERATION - VELOCITY)
            next_v += product(gains.gain_vv, innovation_v, GAIN)
        return self._cut(next_a), self._cut(next_v)

    def _advance_position(self, axis: int, step: int, interval_ns: int) -> tuple[int, int]:
        """(p, its remainder) of one axis a sample later; over a gap the velocity holds."""
        v = self._velocity[axis]
        if interval_ns <= LONGEST_INTERVAL_NS:
            moved = product(v, step, VELOCITY + STEP - POSITION - CARRIED)
        else:
            gap = (min(interval_ns, LONGEST_GAP_NS) << GAP) // NANOSECONDS
            moved = product(v, gap, VELOCITY + GAP - POSITION - CARRIED)
        moved += self._remainder[axis]
        position = self._position[axis] + (moved >> CARRIED)
        if abs(position) > LARGEST:
            return self._cut(position), 0
        return position, moved & (1 << CARRIED) - 1

    def _take(self, before_ns: int) -> Integers | None:
        """The newest speed whose stamp lies before `before_ns`, as a velocity in R0 (eq. 5); None: none has come."""
        newest = None
        while self._waiting and self._waiting[0].stamp_ns < before_ns:
            newest = self._waiting.popleft()
        if newest is None:
            return None
        at = newest.stamp_ns - (newest.delay_ns if self._constants.heading_at_delay else 0)
        heading = next((each for each in reversed(self._headings) if each.stamp_ns <= at), self._headings[0])
        return product(newest.speed, heading.cos, UNIT), product(newest.speed, heading.sin, UNIT), 0

    def _heading(self, unit: tuple[int, int, int, int]) -> tuple[int, int]:
        """(cos psi, sin psi) of the boresight's yaw; (1, 0) for a boresight that points straight up or down."""
        x, y, _ = rotated(unit, self._constants.boresight)
        norm = math.isqrt(x * x + y * y)
        if norm < SHORTEST_HEADING:
            return 1 << UNIT, 0
        return quotient(x << UNIT, norm), quotient(y << UNIT, norm)

    def _taken_vector(self, values: Vector) -> Integers:
        x, y, z = values
        return (
            self._taken(x, ACCELERATION, LARGEST_INPUT),
            self._taken(y, ACCELERATION, LARGEST_INPUT),
            self._taken(z, ACCELERATION, LARGEST_INPUT),
        )

    def _taken(self, value: float, fraction: int, largest: int) -> int:
        taken, cut = fixed(value, fraction, largest)
        self._flagged |= cut
        return taken

    def _cut(self, value: int) -> int:
        """`value`, or the end of the 32 bits that it would leave."""
        if -LARGEST <= value <= LARGEST:
            return value
        self._flagged = True
        return LARGEST if value > 0 else -LARGEST


def _unit(orientation: Quaternion) -> tuple[int, int, int, int]:
    """A quaternion in Q1.30; raises ValueError when its length is not 1, within twice what messages are held to."""
    w, x, y, z = (fixed(each, UNIT)[0] for each in orientation)
    if abs(w * w + x * x + y * y + z * z - (1 << 2 * UNIT)) > UNIT_TOLERANCE:
        raise ValueError(f"{METHOD}: orientation {orientation} is not a rotation; its norm is not 1")
    return w, x, y, z


def _unlikeness(a: _Attitude, b: _Attitude) -> int:
    """The less, the smaller the turn from one attitude to the other: less the cosine of half of it, Q3.60."""
    return -abs(sum(one * other for one, other in zip(a[0], b[0], strict=True)))


def _apart(a: Integers, b: Integers) -> int:
    """The square of the distance."""
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


def _difference(a: int, b: int) -> int:
    return abs(a - b)


def _floats(values: Integers, fraction: int) -> Vector:
    """The same numbers as doubles, exactly: 31 bits fit into 53."""
    x, y, z = values
    return math.ldexp(x, -fraction), math.ldexp(y, -fraction), math.ldexp(z, -fraction)
