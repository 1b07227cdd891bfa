"""Whether the cane is at rest: the radar sees nothing move and the gyro does not turn (cane.md row 9).

At rest an edge detector finds an edge in noise, and a metre of walk per stop. Both thresholds are made to need no
rest before them: the gyro's lies far above its bias, and the radar's is relative to a noise floor that is read off
the very spectrum it judges.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Gt
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class RestSettings:
    """When the cane counts as being at rest."""

    enabled: bool = True
    # White noise gives 1.3 in the mean; ground at 15 dB that passes at 0.1 m/s gives 1.6, at 0.5 m/s 9.
    largest_difference: Annotated[float, Gt(0)] = 1.7  # of difference energy to the noise floor
    # A gyro's bias is below 2 deg/s, a still hand turns by 0.5; walking turns the cane by 5 deg/s or more.
    largest_turn_rate: Annotated[float, Gt(0)] = math.radians(5.0)  # rad/s, mean norm over the window


def difference_weights(transform: int) -> NDArray[np.float32]:
    """What each Doppler bin adds to the energy of scan-to-scan differences, |1 - exp(-2 pi i k / L)|^2, in sum 1."""
    weights = np.sin(np.pi * np.arange(transform) / transform) ** 2
    return (weights / weights.sum()).astype(np.float32)


def difference_and_floor(power: NDArray[np.floating], weights: NDArray[np.float32]) -> tuple[float, float]:
    """Energy of the scan-to-scan differences, and the noise floor to hold it against; white noise gives 1.3 of it.

    Args:
        power: shape (L,), slow-time power spectrum of a window of scans, in sum over ranges, in FFT order.
        weights: `difference_weights(L)`.

    By Parseval the weighted sum is the energy of the window's differences. The floor is the spectrum's lower quartile:
    moving ground fills Doppler on one side of zero only, so that at least a quarter of the axis holds noise alone.
    What stands still, or drifts by less than a resolution cell, has next to no weight in the differences.
    """
    quartile = len(power) // 4
    return float((power * weights).sum()), float(np.partition(power, quartile)[quartile])


def is_at_rest(difference: float, floor: float, turn_rate: float, settings: RestSettings) -> bool:
    """Whether `difference` is small beside `floor` and so is the gyro's mean norm `turn_rate` (rad/s)."""
    return (
        settings.enabled
        and difference <= settings.largest_difference * floor
        and turn_rate <= settings.largest_turn_rate
    )
