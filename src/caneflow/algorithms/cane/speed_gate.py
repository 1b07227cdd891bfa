"""Single wild ground speeds: left out, so that no filter ever sees them. Single wild statements of their error: held.

A radar gives a speed every 10 ms and a velocity every 50 ms. From one to the next they change by 0.6 m/s at most on the
walks at hand, noise included; a person with a cane does not go faster than 3 m/s.
"""

import math
from collections import deque
from dataclasses import dataclass

from caneflow.algorithms.glitches import GlitchSettings, JumpGate
from caneflow.algorithms.quantities import Speed, Time

LONGEST_GAP = 0.5  # s between two speeds; across a longer one anything may have happened
LONGEST_DELAY = 1.0  # s by which a first speed may lag; twice the longest window that the front ends have by default
REMEMBERED = 7  # statements, of which the median is the usual one: three in a row do not move it
# of the usual variance, the least that is believed: 0.3 of its standard deviation. On six walks of another simulator
# 29 of 6909 statements were below, all in the moment after a rest.
LEAST_SHARE = 0.1


@dataclass(frozen=True, kw_only=True)
class CaneGlitchSettings(GlitchSettings):
    """What counts as wild of the IMU, and of a ground speed."""

    speed: Speed = 1.0  # m/s, from the last good one
    unseen_speed: Speed = 3.0  # m/s, likewise at the start and across a gap
    delay: Time = 0.1  # s, between the delays of two speeds


class SpeedGate:
    """Passes speeds (m/s, one component or more) with their delays, but for wild ones."""

    def __init__(self, settings: CaneGlitchSettings) -> None:
        s = settings
        self._speed: JumpGate[tuple[float, float]] = JumpGate(
            s.speed,
            math.dist,
            most_held=s.most_held,
            longest_gap=LONGEST_GAP,
            start=(0.0, 0.0),
            unseen_limit=s.unseen_speed,
        )
        self._delay: JumpGate[float] = JumpGate(
            s.delay, _difference, most_held=s.most_held, longest_gap=LONGEST_GAP, start=0.0, unseen_limit=LONGEST_DELAY
        )

    def passes(self, stamp_ns: int, forward: float, left: float, delay: float | None) -> bool:
        """Whether neither the speed (m/s, along the boresight and to its left) nor its delay (s) is wild."""
        self._speed.update(stamp_ns, (forward, left))
        self._delay.update(stamp_ns, delay or 0.0)
        return not (self._speed.holding or self._delay.holding)


class StatedVariance:
    """What a sensor states of its own error, held at the usual where it suddenly states next to none.

    A filter that believed one such statement would forget for a second what all the others said. Larger variances are
    believed at once, smaller ones when they last.
    """

    def __init__(self, usual: float) -> None:
        """`usual`: variance that holds until there are statements."""
        self._last = deque([usual] * REMEMBERED, maxlen=REMEMBERED)

    def believed(self, stated: float) -> float:
        """The variance to use for a statement; same unit."""
        usual = sorted(self._last)[REMEMBERED // 2]
        self._last.append(stated)
        return usual if stated < LEAST_SHARE * usual else stated


def _difference(a: float, b: float) -> float:
    return abs(a - b)
