"""Velocity of a radar from the Doppler of the points that it sees: those that stand still all tell the same one.

A standing point in direction d (unit vector, radar frame) closes at d . v, v the antenna's velocity. Three points give
v; what moves by itself, and ghosts, do not agree. So: many threes drawn from a seeded generator, the velocity that most
points agree with, and weighted least squares over those (Kellner et al., "Instantaneous ego-motion estimation using
Doppler radar", ITSC 2013; Doer and Trommer, "An EKF based approach to radar inertial odometry", MFI 2020).
"""

import math
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

import numpy as np
from annotated_types import Ge, Le, Lt
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Angle, Factor, Length, OpenFraction, Speed, Zero

Floats = NDArray[np.float64]

_SINGULAR: Final = 1e-3  # determinant of three directions below which they say nothing: within half a degree of a plane
_REWEIGHTED: Final = 3  # times
_UNKNOWNS: Final = 3
PRIOR_POINTS: Final = 3.0  # points that what is known beforehand counts for: as many as a guess rests on
PRIOR_DEVIATIONS: Final = 3.0  # beyond which a guess is no worse than one that is far off


@dataclass(frozen=True, kw_only=True)
class EgoVelocitySettings:
    """Which points are looked at, what agrees, and what is refused."""

    nearest: Length = 0.25  # m; the vendor's points nearer than that are the casing's
    least_snr: Annotated[float, Ge(-100), Le(100)] = 5.0  # dB
    widest: Annotated[float, Ge(1e-3), Lt(math.pi / 2)] = math.radians(60.0)  # rad, azimuth and elevation off boresight
    rounds: Annotated[int, Ge(1), Le(10_000)] = (
        60  # threes: one without an outlier is among them (p = 1 - 1e-6 at 40 %)
    )
    inlier: Speed = 0.15  # m/s from the fit
    # rad, sd of a point's direction: off the axis it lets Doppler err with the speed. A vendor's 3 x 4 antennas
    # tell azimuth to 2 and elevation to 5 deg.
    direction_error: Angle | Zero = math.radians(4.0)
    fewest: Annotated[int, Ge(4), Le(1000)] = 8  # points that agree
    least_share: OpenFraction = 0.35  # of the points looked at
    most_condition: Annotated[float, Ge(1), Le(1e6)] = 1000.0  # of the normal equations: directions that differ
    alias_share: OpenFraction = 0.95  # of the unambiguous Doppler up to which a speed counts
    mounting_error: Angle | Zero = math.radians(1.0)  # rad, sd: how well the radar's frame is known in the body
    floor: Speed | Zero = 0.01  # m/s, sd below which no velocity is claimed
    inflation: Factor = 1.0  # of the stated standard deviation


class Prior(NamedTuple):
    """What is known of the velocity before the points are looked at, radar frame."""

    velocity: Floats  # (3,) m/s
    covariance: Floats  # (3, 3)


class EgoVelocity(NamedTuple):
    """The antenna's velocity in the radar frame, and what it rests on."""

    velocity: Floats  # (3,) m/s
    covariance: Floats  # (3, 3)
    agreeing: int  # points
    looked_at: int  # points


def usable(position: Floats, snr: Floats | None, settings: EgoVelocitySettings) -> NDArray[np.bool_]:
    """Which points, shape (n, 3) in m (x boresight, y left, z up), are worth looking at; `snr` in dB where known."""
    ranges = np.sqrt(np.einsum("ij,ij->i", position, position))
    across = math.tan(settings.widest) * position[:, 0]
    kept = (ranges > settings.nearest) & (np.abs(position[:, 1]) <= across) & (np.abs(position[:, 2]) <= across)
    if snr is not None:
        kept &= snr > settings.least_snr
    return np.asarray(kept)


def ego_velocity(
    position: Floats,
    doppler: Floats,
    *,
    doppler_step: float,
    doppler_limit: float,
    settings: EgoVelocitySettings,
    random: np.random.Generator,
    prior: Prior | None = None,
) -> EgoVelocity | None:
    """The velocity that most of the usable points agree with; None where too few do, or they cannot tell.

    Args:
        position: shape (n, 3) m, radar frame.
        doppler: shape (n,) m/s, positive for approaching.
        doppler_step: m/s, width of a Doppler bin.
        doppler_limit: m/s, unambiguous to either side.
        settings: which points count, and what is refused.
        random: draws the threes; the same one gives the same velocity, bit by bit.
        prior: where the velocity should be; it only chooses between guesses, and is not a measurement.
    """
    count = len(doppler)
    if count < settings.fewest:
        return None
    directions = position / np.sqrt(np.einsum("ij,ij->i", position, position))[:, None]
    guesses = _guesses(directions, doppler, settings.rounds, random)
    if prior is not None:
        guesses = np.concatenate([guesses, prior.velocity[None]])
    if not len(guesses):
        return None
    velocity = guesses[int(_costs(guesses, directions, doppler, settings, prior).argmin())]
    for _ in range(_REWEIGHTED):
        weights = _weights(directions, doppler, velocity, settings)
        normal = (directions * weights[:, None]).T @ directions
        if np.linalg.cond(normal) > settings.most_condition:
            return None
        velocity = np.linalg.solve(normal, directions.T @ (weights * doppler))
    residual = doppler - directions @ velocity
    tolerance = _tolerance(directions, velocity, settings)
    agrees = np.abs(residual) < tolerance
    agreeing = int(np.count_nonzero(agrees))
    if agreeing < max(settings.fewest, settings.least_share * count):
        return None
    if float(np.abs(directions[agrees] @ velocity).max()) > settings.alias_share * doppler_limit:
        return None
    covariance = _covariance(directions[agrees], residual[agrees], velocity, doppler_step, count, settings)
    return EgoVelocity(velocity, covariance, agreeing, count)


def _guesses(directions: Floats, doppler: Floats, rounds: int, random: np.random.Generator) -> Floats:
    """The velocities, shape (k, 3), of threes of points that lie in no plane with the radar."""
    threes = random.random((rounds, len(doppler))).argpartition(_UNKNOWNS - 1, axis=1)[:, :_UNKNOWNS]
    matrices = directions[threes]
    sound = np.abs(np.linalg.det(matrices)) > _SINGULAR
    found: Floats = np.linalg.solve(matrices[sound], doppler[threes[sound]][:, :, None])[:, :, 0]
    return found


def _costs(
    guesses: Floats, directions: Floats, doppler: Floats, settings: EgoVelocitySettings, prior: Prior | None
) -> Floats:
    """For each of the guesses, shape (k, 3), how far the points are from it; those that do not agree count 1."""
    speeds = np.sqrt(np.einsum("ij,ij->i", guesses, guesses))
    off = guesses @ directions.T - doppler
    tolerance = settings.inlier**2 + (settings.direction_error * speeds) ** 2
    costs: Floats = np.minimum(off * off / tolerance[:, None], 1.0).sum(axis=1)
    if prior is not None:
        apart = guesses - prior.velocity
        squares = np.einsum("ij,ij->i", apart, np.linalg.solve(prior.covariance, apart.T).T)
        costs += PRIOR_POINTS * np.minimum(squares / PRIOR_DEVIATIONS**2, 1.0)
    return costs


def _tolerance(directions: Floats, velocity: Floats, settings: EgoVelocitySettings) -> Floats:
    """By how much (m/s) the Doppler of each point may be off: also as its direction is, at right angles to it."""
    along = directions @ velocity
    across = np.maximum(velocity @ velocity - along * along, 0.0)
    found: Floats = np.sqrt(settings.inlier**2 + settings.direction_error**2 * across)
    return found


def _weights(directions: Floats, doppler: Floats, velocity: Floats, settings: EgoVelocitySettings) -> Floats:
    """Tukey's: nothing beyond twice the tolerance, smooth in between, so that no point jumps in and out."""
    relative = (doppler - directions @ velocity) / (2.0 * _tolerance(directions, velocity, settings))
    inside = np.maximum(1.0 - relative * relative, 0.0)
    found: Floats = inside * inside
    return found


def _covariance(
    directions: Floats,
    residual: Floats,
    velocity: Floats,
    doppler_step: float,
    looked_at: int,
    settings: EgoVelocitySettings,
) -> Floats:
    """What the fit over the m points that agree is worth, (3, 3).

    Least squares' own, with no less scatter than a Doppler bin has; more where few points are left, and where many do
    not agree, because then some agree by chance. Below one bin per frame all points err alike. And what no number of
    points helps against: the radar sits askew by `mounting_error`.
    """
    agreeing = len(residual)
    least = doppler_step * doppler_step / 12.0
    scatter = max(float(residual @ residual) / (agreeing - _UNKNOWNS), least)
    chance = (looked_at / agreeing) ** 2 * agreeing / max(agreeing - 2 * _UNKNOWNS, 1)
    square = float(velocity @ velocity)
    alike = least if square < doppler_step * doppler_step else 0.0
    in_common = settings.floor**2 + alike + settings.mounting_error**2 * square
    covariance = scatter * chance * np.linalg.inv(directions.T @ directions) + in_common * np.eye(_UNKNOWNS)
    found: Floats = covariance * settings.inflation**2
    return found
