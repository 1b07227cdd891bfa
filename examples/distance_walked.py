"""An operator of one's own: the distance walked, out of the radar's speed over ground.

in   speed : GroundSpeed
out  distance : Distance
"""

from distance import Distance

from caneflow.messages import GroundSpeed, Sample
from caneflow.runtime import Context, Emitted, Operator
from caneflow.runtime.node import run


class DistanceWalked(Operator):
    """Sums speed times time by the trapezoidal rule, and says how long there was nothing to sum."""

    inputs = {"speed": GroundSpeed}
    outputs = {"distance": Distance}

    def __init__(self, settings: object, context: Context) -> None:
        self._distance = self._unseen = 0.0
        self._last: GroundSpeed | None = None

    def handle(self, port: str, message: Sample) -> Emitted:
        """Yield the distance so far. What is not valid is not a speed of zero: it is time that nobody saw."""
        assert isinstance(message, GroundSpeed)
        last, self._last = self._last, message
        if last is not None:
            elapsed = (message.stamp - last.stamp) / 1e9  # s
            if message.valid and last.valid:
                self._distance += elapsed * (abs(message.speed) + abs(last.speed)) / 2
            else:
                self._unseen += elapsed
        yield "distance", Distance(stamp=message.stamp, distance=self._distance, unseen=self._unseen)


if __name__ == "__main__":
    run(DistanceWalked)
