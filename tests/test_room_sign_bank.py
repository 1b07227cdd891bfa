"""The bank over signs: the mixture's moments, what it keeps, and that it finds signs that a module does not tell."""

import math

import numpy as np
import pytest

from caneflow.algorithms.room.room_ekf import RoomEkf, RoomEkfSettings
from caneflow.algorithms.room.room_sign_bank import RoomSignBank, SignBankSettings, mixed
from caneflow.algorithms.room.room_tracking import Echo, RoomStart, RoomTracker, StaticSensor
from caneflow.runtime.stages.snapshot import pack, unpack

SENSORS = {
    "south": StaticSensor(position=(4.0, -2.5), azimuth=math.pi / 2),
    "west": StaticSensor(position=(-2.5, 4.0), azimuth=0.0),
}
START = RoomStart(guess=(4.0, 2.0), error=0.3, area=(0.0, 8.0, 0.0, 8.0))
SETTINGS = RoomEkfSettings(use_heading=False)
RADIUS, SPEED = 2.0, 0.9  # m, m/s, around (4, 4)


def place(seconds: float) -> tuple[float, float]:
    """On a circle, counter-clockwise from its lowest point."""
    angle = SPEED / RADIUS * seconds - math.pi / 2
    return 4.0 + RADIUS * math.cos(angle), 4.0 + RADIUS * math.sin(angle)


def seen(sensor: StaticSensor, seconds: float, *, signed: bool) -> Echo:
    """What a perfect module would tell, and a range, which is the truth."""
    before, at, after = (math.dist(place(seconds + step), sensor.position) for step in (-0.01, 0.0, 0.01))
    rate = (after - before) / 0.02
    return Echo(
        stamp_ns=round(seconds * 1e9), valid=True, range_rate=rate if signed else abs(rate), signed=signed, range=at
    )


def walk(tracker: RoomTracker, until: float, *, signed: bool, ranges: bool = False, begin: float = 0.0) -> None:
    for step in range(round(begin * 20), round(until * 20)):
        for name, sensor in SENSORS.items():
            echo = seen(sensor, 0.05 * step, signed=signed)
            if not ranges:
                echo = Echo(stamp_ns=echo.stamp_ns, valid=True, range_rate=echo.range_rate, signed=signed)
            tracker.echo(name, echo)


def test_a_mixture_has_the_moments_of_its_parts() -> None:
    mean, covariance = mixed(np.array([0.25, 0.75]), np.array([[0.0], [4.0]]), np.array([[[1.0]], [[2.0]]]))
    assert mean.tolist() == [3.0]
    # within: 0.25 * 1 + 0.75 * 2; between: 0.25 * 9 + 0.75 * 1
    assert covariance.tolist() == [[1.75 + 3.0]]


def test_with_signs_the_bank_is_the_filter() -> None:
    bank, single = RoomSignBank(SETTINGS, SENSORS, START), RoomEkf(SETTINGS, SENSORS, START)
    for tracker in (bank, single):
        walk(tracker, 3.0, signed=True)
    ours, theirs = bank.estimate(3_000_000_000), single.estimate(3_000_000_000)
    assert (ours.position, ours.velocity) == (theirs.position, theirs.velocity)
    assert ours.covariance.tolist() == theirs.covariance.tolist()


def test_ranges_tell_the_signs_of_speeds_that_have_none() -> None:
    """Every sign changes several times on the way round."""
    bank = RoomSignBank(SETTINGS, SENSORS, START)
    walk(bank, 14.0, signed=False, ranges=True)
    estimate = bank.estimate(13_950_000_000)
    assert math.dist(estimate.position, place(13.95)) < 0.1
    ahead = [(b - a) / 0.01 for a, b in zip(place(13.95), place(13.96), strict=True)]
    assert math.dist(estimate.velocity, ahead) < 0.2


@pytest.mark.parametrize("members", [1, 5])
def test_no_more_members_are_kept_than_asked_for(members: int) -> None:
    bank = RoomSignBank(SETTINGS, SENSORS, START, SignBankSettings(members=members, alike=0.1))
    walk(bank, 2.0, signed=False)
    assert len(bank._members) == members


def test_a_bank_goes_on_from_its_snapshot_as_it_would_have() -> None:
    bank = RoomSignBank(SETTINGS, SENSORS, START)
    walk(bank, 2.0, signed=False)
    again = unpack(pack(bank, __name__), __name__)
    for tracker in (bank, again):
        walk(tracker, 3.0, signed=False, begin=2.0)
    ours, theirs = bank.estimate(3_000_000_000), again.estimate(3_000_000_000)
    assert ours.position == theirs.position
    assert ours.covariance.tolist() == theirs.covariance.tolist()


@pytest.mark.parametrize("rate", [40.0, 1e300])
def test_a_wild_speed_that_fits_no_member_is_left_out_and_counted(rate: float) -> None:
    bank = RoomSignBank(SETTINGS, SENSORS, START)
    walk(bank, 2.0, signed=False)
    before = bank.estimate(1_950_000_000)
    bank.echo("west", Echo(stamp_ns=1_950_000_000, valid=True, range_rate=rate, signed=False))
    after = bank.estimate(1_950_000_000)
    assert bank.discarded == 1
    assert math.dist(before.position, after.position) < 0.05
