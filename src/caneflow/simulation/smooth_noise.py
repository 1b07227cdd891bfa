"""Smooth random functions of time, distance or steps: what in a walk is neither constant nor periodic.

A sum of cosines with random phases and frequencies drawn from the wanted spectrum. Unlike filtered noise it is
defined everywhere, so a shorter walk is the beginning of the longer one, and it can be differentiated.
"""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from caneflow.simulation.attitude import Floats

TERMS = 32  # cosines per function: near enough to Gaussian (excess kurtosis -1.5 / TERMS)


@dataclass(frozen=True, kw_only=True)
class Wander:
    """A zero-mean function of one variable with a given standard deviation."""

    frequencies: Floats  # (TERMS,) rad per unit of the argument
    phases: Floats  # (TERMS,) rad
    deviation: float  # standard deviation, unit of the value

    def __call__(self, argument: Floats) -> Floats:
        """Values at `argument`, shape (n,) to (n,)."""
        total: Floats = np.zeros_like(argument)
        if self.deviation == 0.0:
            return total
        for frequency, phase in zip(self.frequencies, self.phases, strict=True):
            total += np.cos(frequency * argument + phase)
        total *= self.deviation * np.sqrt(2.0 / TERMS)
        return total


def slow(rng: Generator, deviation: float, scale: float) -> Wander:
    """Correlation exp(-d^2 / (2 scale^2)) over a distance d in the argument (Gaussian spectrum about zero)."""
    return _wander(rng.normal(0.0, 1.0 / scale, TERMS), rng, deviation)


def tremulous(rng: Generator, deviation: float, frequency: float, width: float) -> Wander:
    """Narrow-band oscillation about `frequency`, Gaussian spectrum of standard deviation `width`, both Hz."""
    return _wander(2.0 * np.pi * rng.normal(frequency, width, TERMS), rng, deviation)


def _wander(frequencies: Floats, rng: Generator, deviation: float) -> Wander:
    return Wander(frequencies=frequencies, phases=rng.uniform(0.0, 2.0 * np.pi, TERMS), deviation=deviation)
