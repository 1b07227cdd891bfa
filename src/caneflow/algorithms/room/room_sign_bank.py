"""A bank of Kalman filters over the signs that a Doppler module with one mixer does not tell.

Such a module tells |dR/dt| only. Every member of the bank holds one history of signs. At an echo without sign each
member goes on as two, one per sign; each is weighed by how likely it found what was measured since (speeds, strengths,
the area's edge), members that have come to say the same are merged, and the likeliest `members` are kept. The estimate
is the mean of the mixture, and its covariance has the spread between the members.

Source: the Gaussian sum filter, D. L. Alspach, H. W. Sorenson, IEEE Trans. Automatic Control 17 (1972) 439-448;
merging by moments, D. J. Salmond, SPIE 1305 (1990).
"""

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Factor, Fraction
from caneflow.algorithms.room.room_ekf import RoomEkf, RoomEkfSettings
from caneflow.algorithms.room.room_tracking import Echo, RoomEstimate, RoomStart, StaticSensor

Array = NDArray[np.float64]
PLANE = 4  # position and velocity, the first of the state: what tells members apart


@dataclass(frozen=True, kw_only=True)
class SignBankSettings:
    """How many histories of signs are kept, and which."""

    members: Annotated[int, Ge(1), Le(256)] = 8
    smallest: Fraction = 1e-4  # of the likeliest member's weight; a lighter one is left out
    alike: Factor = 1.0  # sd apart, below which two members are merged


class RoomSignBank:
    """Takes headings and echoes as they come, as `RoomEkf` does; all members share what the IMU tells."""

    def __init__(
        self,
        settings: RoomEkfSettings,
        sensors: Mapping[str, StaticSensor],
        start: RoomStart,
        bank: SignBankSettings | None = None,
    ) -> None:
        self._bank = bank or SignBankSettings()
        self._members = [RoomEkf(settings, sensors, start)]
        self.discarded = 0

    @property
    def moving(self) -> bool:
        """Whether some sensor has seen something move not long before."""
        return self._members[0].moving

    def heading(self, stamp_ns: int, yaw: float, standing: bool | None = None) -> None:
        """Take the direction that the person faces, rad in R0, and whether they stand, where it is known."""
        self._members[0].heading(stamp_ns, yaw, standing)

    def walked(self, stamp_ns: int, place: tuple[float, float]) -> None:
        """Take where the person is by dead reckoning of their own, m, axes as R0, origin anywhere."""
        self._members[0].walked(stamp_ns, place)

    def echo(self, sensor: str, echo: Echo) -> None:
        """Take what a sensor saw."""
        self._members[0].count(echo)
        found: list[RoomEkf] = []
        for member in self._members:
            if not member.take_place(sensor, echo):
                found.append(member)
                continue
            rates = (echo.range_rate,) if echo.signed else (abs(echo.range_rate), -abs(echo.range_rate))
            for rate in rates:
                branch = copy(member)
                branch.take_speed(sensor, replace(echo, range_rate=rate, signed=True))
                found.append(branch)
        if len(found) > 1:
            found = self._kept(found)
        self._members = found
        self._count_discarded()

    def _count_discarded(self) -> None:
        """What no member could use was left out."""
        self.discarded += min(member.discarded for member in self._members)
        for member in self._members:
            member.discarded = 0

    def estimate(self, stamp_ns: int) -> RoomEstimate:
        """The mixture's mean and covariance, predicted to `stamp_ns`."""
        each = [member.estimate(stamp_ns) for member in self._members]
        if len(each) == 1:
            return each[0]
        means = np.array([(*found.position, *found.velocity) for found in each])
        mean, covariance = mixed(self._weights(self._members), means, np.array([found.covariance for found in each]))
        x, y, u, v = mean.tolist()
        return RoomEstimate((x, y), (u, v), covariance)

    @staticmethod
    def _weights(members: list[RoomEkf]) -> Array:
        logs = np.array([member.log_likelihood for member in members])
        weights: Array = np.exp(logs - logs.max())
        weights /= weights.sum()
        return weights

    def _kept(self, members: list[RoomEkf]) -> list[RoomEkf]:
        """The members that count, likeliest first, those that are alike as one; the likeliest has logarithm 0."""
        members.sort(key=lambda member: -member.log_likelihood)  # stable: the same samples keep the same members
        top = members[0].log_likelihood
        members = [each for each in members if each.log_likelihood > top + math.log(self._bank.smallest)]
        for member in members:
            member.log_likelihood -= top
        kept: list[RoomEkf] = []
        states = np.array([member.state[:PLANE] for member in members])
        variances = np.array([np.diagonal(member.covariance)[:PLANE] for member in members])
        weights = np.exp([member.log_likelihood for member in members])
        left = np.ones(len(members), dtype=np.bool_)
        for index in range(len(members)):
            if len(kept) == self._bank.members:
                break
            if not left[index]:
                continue
            apart = ((states - states[index]) ** 2 / (variances[index] + variances)).sum(axis=1)
            alike = np.flatnonzero(left & (apart < self._bank.alike**2))
            left[alike] = False
            kept.append(self._merged([members[each] for each in alike], weights[alike]))
        return kept

    @staticmethod
    def _merged(members: list[RoomEkf], weights: Array) -> RoomEkf:
        """One member that says what several say; the first is the likeliest."""
        first = members[0]
        if len(members) > 1:
            total = float(weights.sum())
            states = np.array([member.state for member in members])
            covariances = np.array([member.covariance for member in members])
            first.state, first.covariance = mixed(weights / total, states, covariances)
            first.log_likelihood = math.log(total)
        return first


def mixed(weights: Array, means: Array, covariances: Array) -> tuple[Array, Array]:
    """Mean (D,) and covariance (D, D) of a mixture: weights (M,) that sum to 1, means (M, D), covariances (M, D, D)."""
    mean = weights @ means
    off = means - mean
    return mean, np.tensordot(weights, covariances, axes=1) + (off.T * weights) @ off
