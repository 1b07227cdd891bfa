"""What the room's trackers share: their shape, the sensors they look through, the time that a value belongs to.

A front end's value belongs to the middle of its window, not to its stamp (room.md row 9). So a tracker lives in the
past: it stands at the time of the last value, and what it says of now is predicted from there.
"""

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Vector2 = tuple[float, float]
Area = tuple[float, float, float, float]  # xmin, xmax, ymin, ymax, m

HALF_POWER_AZIMUTH = math.radians(60.0)  # one way, -3 dB: the paper's patch antennas
# cos^2p of the azimuth, there and back; p = 1 for 60 degrees
PATTERN_EXPONENT = 2.0 * math.log(0.5) / math.log(math.cos(HALF_POWER_AZIMUTH))
LEAST_COSINE = 0.2  # the pattern's tail is not trusted: no more than 14 dB are taken off
LEAST_DISTANCE = 0.3  # m; nobody stands in a sensor
DECIBEL = 10.0 / math.log(10.0)  # dB per unit of a natural logarithm
HISTORY = 256  # headings: 2.5 s at 100 Hz


@dataclass(frozen=True, kw_only=True)
class StaticSensor:
    """One Doppler module on its wall."""

    position: Vector2  # m, R0
    azimuth: float  # rad, of its boresight
    k: float | None = None  # m^4: squared amplitude = k / R^4; None: its strength says nothing


@dataclass(frozen=True, kw_only=True)
class Echo:
    """What one sensor saw of the person, at the time that it belongs to."""

    stamp_ns: int  # the middle of the window
    valid: bool
    range_rate: float = 0.0  # m/s, positive away; the magnitude when not signed
    signed: bool = True
    strength: float | None = None  # dB, squared amplitude
    range: float | None = None  # m, of a sensor that measures it


@dataclass(frozen=True, kw_only=True)
class RoomStart:
    """Where the person may be at first: about a guess, or anywhere."""

    area: Area | None = None  # m: xmin, xmax, ymin, ymax
    guess: Vector2 | None = None  # m
    error: float = 0.5  # m, sd of the guess

    def drawn(self, count: int, random: np.random.Generator) -> NDArray[np.float64]:
        """Positions, shape (2, count)."""
        if self.guess is not None:
            return np.array(self.guess)[:, None] + self.error * random.standard_normal((2, count))
        if self.area is None:
            raise ValueError("neither a guess of the start nor the area is known")
        west, east, south, north = self.area
        return np.array([[west], [south]]) + np.array([[east - west], [north - south]]) * random.random((2, count))

    def moments(self) -> tuple[Vector2, Vector2]:
        """Mean and sd, m."""
        if self.guess is not None:
            return self.guess, (self.error, self.error)
        if self.area is None:
            raise ValueError("neither a guess of the start nor the area is known")
        west, east, south, north = self.area
        return (0.5 * (west + east), 0.5 * (south + north)), ((east - west) / 12**0.5, (north - south) / 12**0.5)


class RoomEstimate(NamedTuple):
    """Where the person is and how they move, R0."""

    position: Vector2  # m
    velocity: Vector2  # m/s
    covariance: NDArray[np.float64]  # (4, 4) of position and velocity


class RoomTracker(Protocol):
    """The shape of every method: headings and echoes in, an estimate whenever one is asked for."""

    @property
    def moving(self) -> bool:
        """Whether the person moves: no, if all sensors are below their thresholds, or an IMU feels no steps."""

    @property
    def discarded(self) -> int:
        """How many measurements were inconsistent and left out."""

    def heading(self, stamp_ns: int, yaw: float, standing: bool | None = None) -> None:
        """Take the direction that the person faces, rad in R0, and whether they stand, where it is known.

        In the order of time.
        """

    def echo(self, sensor: str, echo: Echo) -> None:
        """Take what a sensor saw."""

    def estimate(self, stamp_ns: int) -> RoomEstimate:
        """The estimate at a time that is not before anything taken; changes nothing."""


class Travel(NamedTuple):
    """What a second's walk of 1 m/s along the heading would have come to between two times."""

    east: float  # m per m/s
    north: float  # m per m/s
    turned: float  # rad, heading at the end less that at the start
    yaw: float  # rad, heading at the end


class HeadingHistory:
    """The last headings, and the way that goes along them."""

    def __init__(self) -> None:
        self._stamps: deque[int] = deque(maxlen=HISTORY)
        self._yaws: deque[float] = deque(maxlen=HISTORY)  # rad, unwrapped
        self._east: deque[float] = deque(maxlen=HISTORY)  # m per m/s, integral of the cosine
        self._north: deque[float] = deque(maxlen=HISTORY)

    def __bool__(self) -> bool:
        return bool(self._stamps)

    def add(self, stamp_ns: int, yaw: float) -> None:
        """Append a heading; raises ValueError when time does not go on."""
        if not self._stamps:
            self._append(stamp_ns, yaw, 0.0, 0.0)
            return
        if stamp_ns <= self._stamps[-1]:
            raise ValueError(f"heading at {stamp_ns} ns is not after the one before, {self._stamps[-1]} ns")
        before = self._yaws[-1]
        yaw = before + math.remainder(yaw - before, math.tau)
        elapsed = (stamp_ns - self._stamps[-1]) * 1e-9
        middle = 0.5 * (before + yaw)
        self._append(
            stamp_ns, yaw, self._east[-1] + elapsed * math.cos(middle), self._north[-1] + elapsed * math.sin(middle)
        )

    def travel(self, start_ns: int, end_ns: int) -> Travel:
        """Between two times; before the first and after the last heading it holds."""
        e0, n0, yaw0 = self._at(start_ns)
        e1, n1, yaw1 = self._at(end_ns)
        return Travel(e1 - e0, n1 - n0, yaw1 - yaw0, yaw1)

    def age(self, stamp_ns: int) -> float:
        """Seconds since the last heading; infinite when there is none."""
        return (stamp_ns - self._stamps[-1]) * 1e-9 if self._stamps else math.inf

    def _append(self, stamp_ns: int, yaw: float, east: float, north: float) -> None:
        self._stamps.append(stamp_ns)
        self._yaws.append(yaw)
        self._east.append(east)
        self._north.append(north)

    def _at(self, stamp_ns: int) -> tuple[float, float, float]:
        after = bisect_right(self._stamps, stamp_ns)
        at = max(after - 1, 0)
        elapsed = (stamp_ns - self._stamps[at]) * 1e-9
        yaw = self._yaws[at]
        if 0 < after < len(self._stamps):
            rate = (self._yaws[after] - yaw) / (self._stamps[after] - self._stamps[at]) * 1e9
            middle, yaw = yaw + 0.5 * rate * elapsed, yaw + rate * elapsed
        else:
            middle = yaw
        return self._east[at] + elapsed * math.cos(middle), self._north[at] + elapsed * math.sin(middle), yaw


class WayHistory:
    """The last positions by dead reckoning, in a frame whose origin is anywhere.

    A step that nobody walks is a leap of the frame, as when a track is laid again: no way is gone by it.
    """

    FASTEST = 10.0  # m/s, a sprinter's
    LEAST_LEAP = 0.5  # m

    def __init__(self) -> None:
        self._origin: Vector2 = (0.0, 0.0)  # m, what the frame has leapt
        self._stamps: deque[int] = deque(maxlen=HISTORY)
        self._places: deque[Vector2] = deque(maxlen=HISTORY)

    def add(self, stamp_ns: int, place: Vector2) -> None:
        """Append a position, m; raises ValueError when time does not go on."""
        if self._stamps and stamp_ns <= self._stamps[-1]:
            raise ValueError(f"position at {stamp_ns} ns is not after the one before, {self._stamps[-1]} ns")
        x, y = place[0] - self._origin[0], place[1] - self._origin[1]
        if self._stamps:
            before = self._places[-1]
            farthest = self.LEAST_LEAP + self.FASTEST * (stamp_ns - self._stamps[-1]) * 1e-9
            if math.dist((x, y), before) > farthest:
                self._origin = place[0] - before[0], place[1] - before[1]
                x, y = before
        self._stamps.append(stamp_ns)
        self._places.append((x, y))

    def between(self, start_ns: int, end_ns: int) -> Vector2:
        """The way from one time to another, m; before the first and after the last position one stands."""
        x0, y0 = self._at(start_ns)
        x1, y1 = self._at(end_ns)
        return x1 - x0, y1 - y0

    def velocity(self, stamp_ns: int, span_ns: int) -> Vector2:
        """m/s, the mean from `span_ns` before a time to the last position."""
        start = max(stamp_ns - span_ns, self._stamps[0])
        elapsed = (self._stamps[-1] - start) * 1e-9
        if elapsed <= 0.0:
            return 0.0, 0.0
        x, y = self.between(start, self._stamps[-1])
        return x / elapsed, y / elapsed

    def age(self, stamp_ns: int) -> float:
        """Seconds since the last position; infinite when there is none."""
        return (stamp_ns - self._stamps[-1]) * 1e-9 if self._stamps else math.inf

    def _at(self, stamp_ns: int) -> Vector2:
        after = bisect_right(self._stamps, stamp_ns)
        if after == 0 or after == len(self._stamps):
            return self._places[max(after - 1, 0)]
        before = self._stamps[after - 1]
        share = (stamp_ns - before) / (self._stamps[after] - before)
        (x0, y0), (x1, y1) = self._places[after - 1], self._places[after]
        return x0 + share * (x1 - x0), y0 + share * (y1 - y0)


class SilenceWatch:
    """Whether the sensors see something move (room.md row 11): a single echo may be noise, a share of them is not."""

    LEAST_SHARE = 0.06  # of all sensors' echoes; noise alone makes 0.01 to 0.05 of them valid
    LONGEST_COAST = 2.0  # s without any echo, valid or not, for which whoever walked is taken to walk on

    def __init__(self, memory: float) -> None:
        self._memory_ns = round(memory * 1e9)
        self._echoes: deque[tuple[int, bool]] = deque()
        self._valid = 0  # of them
        self._begin_ns: int | None = None  # of echoes that tell, at the start and after a hole in them
        self._newest_ns = 0

    def update(self, stamp_ns: int, valid: bool) -> None:
        """Take whether a sensor sees something move."""
        if self._begin_ns is None or stamp_ns - self._newest_ns > self._memory_ns:
            self._begin_ns = stamp_ns
        self._newest_ns = max(self._newest_ns, stamp_ns)
        self._echoes.append((stamp_ns, valid))
        self._valid += valid
        while self._echoes[0][0] < stamp_ns - self._memory_ns:
            self._valid -= self._echoes.popleft()[1]

    def moving(self, stamp_ns: int) -> bool:
        """Whether enough of the last echoes were valid; true until there has been time to tell.

        Echoes that are missing tell nothing: for a while it is true then, too.
        """
        if self._begin_ns is None or stamp_ns - self._begin_ns < self._memory_ns:
            return True
        silent_ns = stamp_ns - self._newest_ns
        if silent_ns > self._memory_ns:
            return silent_ns < self.LONGEST_COAST * 1e9
        return self._valid > self.LEAST_SHARE * len(self._echoes)


class MotionWatch:
    """Whether the person moves: not if an IMU feels no steps, and not if the sensors see nothing move.

    Who stands and who is out of range look the same to the sensors (room.md row 11), and they tell late.
    """

    def __init__(self, memory: float, timeout: float) -> None:
        self._silence = SilenceWatch(memory)
        self._timeout_ns = round(timeout * 1e9)
        self._standing = False
        self._felt_ns = 0

    def echo(self, stamp_ns: int, valid: bool) -> None:
        """Take whether a sensor sees something move."""
        self._silence.update(stamp_ns, valid)

    def steps(self, stamp_ns: int, standing: bool | None) -> None:
        """Take whether the IMU feels its wearer stand; None: it cannot tell."""
        self._standing, self._felt_ns = standing is True, stamp_ns

    def standing(self, stamp_ns: int) -> bool:
        """Whether the person is felt to stand."""
        return self._standing and stamp_ns - self._felt_ns < self._timeout_ns

    def moving(self, stamp_ns: int) -> bool:
        """Whether the position changes, as far as anybody can tell."""
        return not self.standing(stamp_ns) and self._silence.moving(stamp_ns)


def pattern_loss(azimuth_off: float) -> float:
    """What the antenna takes off an echo, dB, at an angle (rad) off its boresight; 6 dB at 60 degrees."""
    return -10.0 * PATTERN_EXPONENT * math.log10(max(math.cos(azimuth_off), LEAST_COSINE))
