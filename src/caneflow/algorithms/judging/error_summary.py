"""Errors of several walks in a few figures: the rows of the paper's Table I, and how honest a covariance is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

HORIZONTAL = 2  # degrees of freedom of a position on the ground


@dataclass(frozen=True, kw_only=True)
class ErrorSummary:
    """One error over several walks, as in Table I."""

    largest: float  # m
    sd: float | None  # m, with n - 1; None for a single walk
    mean: float  # m
    growth_rate: float  # m/s, the mean error over the mean duration


# Barra et al., ECC 2019, Table I: distance between the end and the start of the estimate over ten walks of 22 m in
# 50 s on average. Its growth rates are the means over these 50 s.
TABLE_I: Mapping[str, ErrorSummary] = MappingProxyType(
    {
        "luenberger": ErrorSummary(largest=2.7, sd=0.5, mean=1.3, growth_rate=0.026),
        "kalman": ErrorSummary(largest=2.7, sd=0.4, mean=1.3, growth_rate=0.026),
        "shs": ErrorSummary(largest=3.9, sd=0.9, mean=1.9, growth_rate=0.038),
        "naive_ins": ErrorSummary(largest=246.0, sd=74.0, mean=132.0, growth_rate=2.64),
    }
)


def summarized(errors: Sequence[float], durations: Sequence[float]) -> ErrorSummary:
    """Errors (m) of walks with these durations (s, first to last pose); raises ValueError when there are none."""
    if not errors or len(errors) != len(durations):
        raise ValueError(f"{len(errors)} errors, {len(durations)} durations; expected as many of both, at least 1")
    mean = float(np.mean(errors))
    return ErrorSummary(
        largest=max(errors),
        sd=float(np.std(errors, ddof=1)) if len(errors) > 1 else None,
        mean=mean,
        growth_rate=mean / float(np.mean(durations)),
    )


def normalized_error_squared(error: Floats, covariance: Floats) -> float | None:
    """NEES: e' P^-1 e for an error, shape (n,), and its covariance, shape (n, n); None for a P that is singular.

    On average n, when the covariance is right (Bar-Shalom, Li and Kirubarajan, Estimation, 2001, 5.4.2).
    """
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return None
    whitened = np.linalg.solve(root, error)
    return float(whitened @ whitened)


def consistent_mean(walks: int, *, degrees: int = HORIZONTAL, probability: float = 0.95) -> tuple[float, float]:
    """The interval in which the mean NEES of so many independent walks lies, when their covariances are right."""
    from scipy.special import gammaincinv  # here: it takes a third of a second to import; scipy.stats, a second

    tail = 0.5 * (1.0 - probability)
    low, high = (2.0 * float(gammaincinv(0.5 * walks * degrees, part)) for part in (tail, 1.0 - tail))
    return low / walks, high / walks
