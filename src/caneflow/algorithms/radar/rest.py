"""Whether the cane is at rest: the radar sees ground, and nothing move, and the gyro does not turn (cane.md row 9).

At rest an edge detector finds an edge in noise, and a metre of walk per stop. Both thresholds are made to need no
rest before them: the gyro's lies far above its bias, and the radar's is relative to a noise floor that is read off
the very spectrum it judges.

The radar's measure is the highest peak of the window's Doppler spectrum, away from zero. The energy of
scan-to-scan differences would be simpler, but buries the few cells that ground fills under the noise of the whole
Doppler axis: at 5 dB, walking then differs from rest by a factor of 1.0 to 2.0, here by 4 to 50.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
from annotated_types import Gt, Le
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Factor, TurnRate

# The main lobe of the Hann window reaches 2 cells from zero; half a cell more for the drift of a hand at rest.
STANDING_CELLS = 2.5  # resolution cells of the window to either side of zero Doppler that count as standing

NOISE_MARGIN = 3.0  # times the mean power of noise that the median of a few independent cells may reach


@dataclass(frozen=True, kw_only=True)
class RestSettings:
    """When the cane counts as being at rest."""

    enabled: bool = True
    # White noise gives 2 to 2.5, at times 3.5; ground at 5 dB that passes at 0.25 m/s gives 14 or more.
    largest_peak: Annotated[float, Gt(1), Le(1e6)] = 7.0  # of the noise floor
    # A gyro's bias is below 2 deg/s, a still hand turns by 0.5; walking turns the cane by 5 deg/s or more.
    largest_turn_rate: TurnRate = math.radians(5.0)  # rad/s, mean norm over the window
    least_standing: Factor = 0.02  # of a scan's noise, power of the ground that stands; more makes faint ground no rest


def peaks_and_floor(power: NDArray[np.floating], cell: float) -> tuple[float, float, float]:
    """The highest Doppler power, approaching and receding, outside of the standing cells; and the noise floor.

    Args:
        power: shape (L,), slow-time power spectrum of a window of scans, in sum over ranges, in FFT order.
        cell: the window's resolution cell in Doppler bins.

    The floor is the spectrum's lower quartile, a little below the mean noise power: moving ground fills Doppler on
    one side of zero only, so that at least a quarter of the axis holds noise alone.
    """
    approaching, receding, _ = np.maximum.reduceat(power, _sides(len(power), cell)).tolist()
    ordered = power.copy()
    ordered.sort()
    return approaching, receding, float(ordered[len(power) // 4])


@cache
def _sides(length: int, cell: float) -> NDArray[np.intp]:
    """Where in a spectrum what approaches begins, what recedes, and what stands again."""
    standing = math.ceil(STANDING_CELLS * cell)
    return np.array([standing, length // 2, length + 1 - standing])


def is_at_rest(peak: float, floor: float, turn_rate: float, settings: RestSettings) -> bool:
    """Whether `peak` is low beside `floor` and the gyro's mean norm `turn_rate` (rad/s) is small.

    Nothing moves then, that is seen; whether anything is: `ground_stands`.
    """
    return settings.enabled and peak <= settings.largest_peak * floor and turn_rate <= settings.largest_turn_rate


def ground_stands(standing: NDArray[np.floating], rest: float, noise_share: float, least: float) -> bool:
    """Whether ground is seen to stand: rest is that, and not that nothing is seen.

    Args:
        standing: shape (K,), power of the standing picture, the running mean of the scans, in each of K cells.
        rest: mean power per cell of what is left of a scan without that picture, mostly noise; 0 is not a receiver's.
        noise_share: part of the scans' noise power that is in the standing picture's.
        least: how many times `rest` the ground must have in half of the cells.

    Half of them: the cane's own tip stands still in the radar's frame while it walks, but fills few cells. Ground that
    passes is not in the mean: at 0.1 m/s it has 2 % of its power there, at 1 m/s nothing.
    """
    return rest > 0.0 and median(standing) > (least + NOISE_MARGIN * noise_share) * rest


def median(values: NDArray[np.floating]) -> float:
    """The median of `values`, shape (K,), K >= 1; NaN when one of them is.

    np.median's to the last bit, at a tenth of its cost (4 against 55 us for 18 of them); and that one imports numpy.ma
    at its first call.
    """
    ordered = np.sort(values)
    if ordered[-1] != ordered[-1]:  # NaN goes last
        return math.nan
    count = len(ordered)
    if count % 2:
        return float(ordered[count // 2])
    return float((ordered[count // 2 - 1] + ordered[count // 2]) / 2)  # in their own type, as numpy does
