"""How often a walker bobs: once per step, whatever the sensor swings with.

A phone in a trouser pocket swings with one leg, so its turn rate shows strides; its vertical acceleration shows every
step of either leg. A hand or a cane swings once per step.
"""

import math

SMOOTHING = 0.05  # s, of each of two low passes: a heel's impact is not a bob of its own
LEVEL_TIME = 1.0  # s over which what is level is averaged
POWER_TIME = 2.0  # s, likewise of the bob's mean square
LEAST_BOB = 0.3  # m/s^2: half of what a bob of 12 mm at 1.1 steps per second is
HYSTERESIS = 0.5  # times the RMS, on both sides of level
MEMORY = 6.0  # swings over which cycles are averaged
STRIDE = 1.5  # cycles per swing, on average, from which on a swing is a stride


class StepBob:
    """Counts cycles of the vertical acceleration, and how many there are to a swing."""

    def __init__(self) -> None:
        self._level = self._once = self._twice = 0.0  # m/s^2
        self._power = 0.0  # m^2/s^4
        self._up = False
        self._cycles = 0  # since the last swing ended
        self._per_swing = 1.0  # mean

    @property
    def is_stride(self) -> bool:
        """Whether a swing has lately been two steps."""
        return self._per_swing > STRIDE

    def update(self, interval: float, vertical: float) -> None:
        """Take a vertical acceleration (m/s^2, any constant with it) `interval` s after the one before."""
        self._level += interval / (LEVEL_TIME + interval) * (vertical - self._level)
        share = interval / (SMOOTHING + interval)
        self._once += share * (vertical - self._level - self._once)
        self._twice += share * (self._once - self._twice)
        self._power += interval / (POWER_TIME + interval) * (self._twice**2 - self._power)
        far = max(HYSTERESIS * math.sqrt(self._power), LEAST_BOB)
        if self._up and self._twice < -far:
            self._up = False
        elif not self._up and self._twice > far:
            self._up = True
            self._cycles += 1

    def end_swing(self) -> None:
        """A swing has ended. One within which nobody bobs tells nothing."""
        if self._cycles:
            self._per_swing += (min(self._cycles, 2) - self._per_swing) / MEMORY
        self._cycles = 0
