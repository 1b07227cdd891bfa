"""Weighted particles: what any particle filter does between its prediction and its estimate."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Fraction, Zero
from caneflow.algorithms.room.resampling import effective_number, systematic

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ParticleSettings:
    """How many particles, when they are resampled and which are removed (room.md row 14)."""

    # The paper has 1000: then the filter ends elsewhere by a third of its error when one sample of a walk is lost.
    count: Annotated[int, Ge(10), Le(100_000)] = 4000
    resample_below: Fraction = 0.5  # of the count, effective number
    smallest: Fraction | Zero = 1e-3  # of the mean weight; lighter particles are removed


class Particles:
    """States, shape (D, N), and their weights, shape (N,), which sum to 1."""

    def __init__(self, states: Array, settings: ParticleSettings) -> None:
        self.states = states
        self.weights = np.full(states.shape[1], 1.0 / states.shape[1])
        self._settings = settings

    def weigh(self, log_likelihood: Array) -> None:
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


def weighted_covariance(values: Array, weights: Array) -> Array:
    """Covariance, shape (D, D), of `values`, shape (D, N), with weights that sum to 1."""
    off = values - (values @ weights)[:, None]
    return np.asarray((off * weights) @ off.T, dtype=np.float64)


def normal_with_outliers(residuals: Array, error: float, outliers: float, width: float) -> Array:
    """Logarithm of a Gaussian's density mixed with a uniform one over `width`; residuals and errors in one unit."""
    peak = (1.0 - outliers) / (error * math.sqrt(math.tau))
    return np.log(peak * np.exp(-0.5 * (residuals / error) ** 2) + outliers / width)


def student_t(residuals: Array, error: float, degrees: float) -> Array:
    """Logarithm of Student's t density, up to a constant."""
    return -0.5 * (degrees + 1.0) * np.log1p((residuals / error) ** 2 / degrees)
