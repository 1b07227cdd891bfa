"""Weighted particles: what any particle filter does between its prediction and its estimate.

States and likelihoods have 32 bits, which tell a micrometre in a room and take half the time; sums have 64.
"""

import math
from dataclasses import dataclass
from typing import Annotated, TypeVar

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Fraction, Zero
from caneflow.algorithms.room.resampling import effective_number, systematic

Array = NDArray[np.float64]
Narrow = NDArray[np.float32]
Real = TypeVar("Real", np.float32, np.float64)


@dataclass(frozen=True, kw_only=True)
class ParticleSettings:
    """How many particles, when they are resampled and which are removed (room.md row 14)."""

    # The paper has 1000. What one lost sample may move is the filter's own randomness: of an error of 0.26 m (two
    # modules, the last 5 s of 15, eight seeds) its sd is 0.05 m with 4000, 0.02 with 16000, 0.01 with 50000.
    count: Annotated[int, Ge(10), Le(100_000)] = 16000
    resample_below: Fraction = 0.5  # of the count, effective number
    smallest: Fraction | Zero = 1e-3  # of the mean weight; lighter particles are removed


class Particles:
    """States, shape (D, N), and their weights, shape (N,), which sum to 1."""

    def __init__(self, states: Array, settings: ParticleSettings) -> None:
        self.states: Narrow = states.astype(np.float32)
        self.weights: Array = np.full(states.shape[1], 1.0 / states.shape[1])
        self._settings = settings

    def weigh(self, log_likelihood: Narrow) -> None:
        """Multiply the weights by a likelihood, given as logarithms up to a constant, shape (N,)."""
        weights = self.weights * np.exp(log_likelihood - log_likelihood.max())
        total = float(weights.sum())
        if not total > 0.0:  # the particles that had any weight left are the very ones that do not fit
            return
        weights /= total
        self.weights = weights

    def renew(self, random: np.random.Generator) -> bool:
        """When few particles are effective, remove the small ones and resample; whether it did."""
        count = len(self.weights)
        if effective_number(self.weights) >= self._settings.resample_below * count:
            return False
        weights = np.where(self.weights < self._settings.smallest / count, 0.0, self.weights)
        self.states = self.states.take(systematic(weights, random), axis=1)  # much faster than by []
        self.weights = np.full(count, 1.0 / count)
        return True

    def mean(self) -> Array:
        """Weighted mean, shape (D,)."""
        return np.asarray(self.states @ self.weights, dtype=np.float64)


def noise(random: np.random.Generator, *shape: int) -> Narrow:
    """Standard normal numbers of that shape."""
    return random.standard_normal(shape, dtype=np.float32)


def weighted_covariance(values: Narrow, weights: Array) -> Array:
    """Covariance, shape (D, D), of `values`, shape (D, N), with weights that sum to 1."""
    off = values - (values @ weights)[:, None]
    return np.asarray((off * weights) @ off.T, dtype=np.float64)


def normal_with_outliers(residuals: NDArray[Real], error: float, outliers: float, width: float) -> NDArray[Real]:
    """Logarithm of a Gaussian's density mixed with a uniform one over `width`; residuals and errors in one unit."""
    peak = (1.0 - outliers) / (error * math.sqrt(math.tau))
    density: NDArray[Real] = np.log(peak * np.exp(-0.5 * (residuals / error) ** 2) + outliers / width)
    return density


def student_t(residuals: NDArray[Real], error: float, degrees: float) -> NDArray[Real]:
    """Logarithm of Student's t density, up to a constant."""
    density: NDArray[Real] = -0.5 * (degrees + 1.0) * np.log1p((residuals / error) ** 2 / degrees)
    return density
