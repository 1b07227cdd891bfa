"""By how much a magnetometer lags behind the gyro beside it, learnt while the body turns, and taken off.

A magnetometer measures for 5 to 10 ms and is read after that; at 400 degrees/s a reading 10 ms late is 4 degrees off.
Turned into the world by the gyro's attitude, such a reading is off the field by lag * (turn rate x reading): the lag is
what that product explains of the readings' deviations from their own mean. Nothing has to be known of the field.

In BROAD's trial 21 (hand-moved, 420 degrees/s RMS) the readings are 15 ms behind the cameras, and the deviations of
their headings fall from 9.8 to 4.1 degrees with that taken off.
"""

from caneflow.algorithms.rotations import Vector, from_rotation_vector, rotate

LARGEST_LAG = 0.05  # s, either way; a magnetometer that is read once in a while is another matter
USUAL_LAG = 0.01  # s, sd before anything was seen
# of the field's strength, what deviates for other reasons (iron in the walls, noise), and s over which it stays
DEVIATION, DEVIATION_TIME = 0.05, 0.3
MEMORY = 5.0  # s, over which field and product are averaged: what changes more slowly is not the lag's
FORGETTING = 300.0  # s


class MagnetometerLag:
    """A least-squares fit of one number, which begins at 0."""

    def __init__(self) -> None:
        self.lag = 0.0  # s
        self._field: Vector | None = None  # of strength 1, mean in the gyro's world
        self._moved: Vector = (0.0, 0.0, 0.0)  # 1/s, mean of the product
        self._explained = self._explaining = 0.0
        self._prior = 2.0 * DEVIATION_TIME * (DEVIATION / USUAL_LAG) ** 2

    def restart(self) -> None:
        """The world has been turned: after a gap."""
        self._field = None

    def taken_off(self, mag: Vector, gyro: Vector) -> Vector:
        """The reading (any unit, body) as it would be without the lag; gyro in rad/s."""
        if self.lag == 0.0:
            return mag
        x, y, z = gyro
        return rotate(from_rotation_vector((-self.lag * x, -self.lag * y, -self.lag * z)), mag)

    def learn(self, field: Vector, turn_rate: Vector, interval: float) -> None:
        """Take a reading as it came, and the turn rate (rad/s), both turned into the world of the gyro's attitude."""
        a, b, c = field
        squared = a * a + b * b + c * c
        if not squared > 0.0:
            return
        scale = squared**-0.5
        a, b, c = scale * a, scale * b, scale * c
        p, q, r = turn_rate
        x, y, z = q * c - r * b, r * a - p * c, p * b - q * a
        if self._field is None:
            self._field, self._moved = (a, b, c), (x, y, z)
            return
        share = interval / (MEMORY + interval)
        (fa, fb, fc), (mx, my, mz) = self._field, self._moved
        a, b, c, x, y, z = a - fa, b - fb, c - fc, x - mx, y - my, z - mz
        self._field = fa + share * a, fb + share * b, fc + share * c
        self._moved = mx + share * x, my + share * y, mz + share * z
        kept = 1.0 - interval / FORGETTING if interval < FORGETTING else 0.0
        self._explained = kept * self._explained + interval * (a * x + b * y + c * z)
        self._explaining = kept * self._explaining + interval * (x * x + y * y + z * z)
        lag = self._explained / (self._explaining + self._prior)
        self.lag = max(-LARGEST_LAG, min(LARGEST_LAG, lag))
