"""What a setting may be, by what it measures: from the least that makes a difference to the most that makes sense.

So a slip of the keyboard (1e300 for 1.0) is found by `caneflow check`, and nothing that passes it makes arithmetic
overflow. The ends are far apart on purpose: they say what a quantity of this kind can be for a person with a cane in a
room, not what works well. `X | Zero`: 0 turns it off; between 0 and the least value it is a slip.
"""

import math
from typing import Annotated, TypeAlias

from annotated_types import Ge, Gt, Le, Lt

Zero: TypeAlias = Annotated[float, Ge(0), Le(0)]

Time: TypeAlias = Annotated[
    float, Ge(1e-4), Le(3600)
]  # s: ten samples of the fastest IMU in a ms; no walk takes an hour
Milliseconds: TypeAlias = Annotated[float, Ge(0.1), Le(3.6e6)]  # ms: as Time
Length: TypeAlias = Annotated[float, Ge(1e-4), Le(1000)]  # m: no ruler reads less, no building is longer
Angle: TypeAlias = Annotated[float, Ge(1e-6), Le(2 * math.pi)]  # rad: 0.2 seconds of arc; all the way round
Elevation: TypeAlias = Annotated[float, Ge(1e-6), Lt(math.pi / 2)]  # rad below the horizontal; straight down is none
TurnRate: TypeAlias = Annotated[float, Ge(1e-7), Le(100)]  # rad/s: 0.02 deg/h, a good fibre gyro; no gyro reads more
Speed: TypeAlias = Annotated[float, Ge(1e-4), Le(100)]  # m/s: nobody tells 0.1 mm/s from rest; 360 km/h
Acceleration: TypeAlias = Annotated[float, Ge(1e-5), Le(4000)]  # m/s^2: 1 ug; 400 g
MagneticField: TypeAlias = Annotated[float, Ge(-1e4), Le(1e4)]  # uT, with its sign: no compass reads more
Offset: TypeAlias = Annotated[float, Ge(-1000), Le(1000)]  # m, with its sign: as Length
# A noise density or a walk, in SI units per root Hz or root s: a millionth is below the best sensor of any kind here
# (2e-6 rad/s/sqrt(Hz), 3e-5 m/s^2/sqrt(Hz)); a thousand is not knowledge at all.
Density: TypeAlias = Annotated[float, Ge(1e-7), Le(1000)]
Factor: TypeAlias = Annotated[float, Ge(1e-3), Le(1000)]  # a ratio, a number of standard deviations: no more than that
Fraction: TypeAlias = Annotated[float, Ge(1e-6), Le(1)]  # of something, e.g. an error of its scale
Probability: TypeAlias = Annotated[float, Ge(0), Le(1)]
OpenFraction: TypeAlias = Annotated[float, Ge(1e-6), Lt(1)]  # of something, never all of it
Decibels: TypeAlias = Annotated[float, Ge(0.01), Le(400)]  # the quietest sound is no 400 dB below the loudest number
Frequency: TypeAlias = Annotated[float, Ge(1e-3), Le(1e8)]  # Hz: once in 17 min; no converter behind a module is faster
RangeCalibration: TypeAlias = Annotated[float, Ge(1e-12), Le(1e12)]  # m^4: 1 mm to 1 km where the amplitude is 1
DegreesOfFreedom: TypeAlias = Annotated[float, Gt(2), Le(1000)]  # up to 2 a t distribution has no variance
Component: TypeAlias = Annotated[float, Ge(-1000), Le(1000)]  # of a direction; its length does not matter
