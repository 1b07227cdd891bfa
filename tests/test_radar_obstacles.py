"""What a radar that moves sees besides the floor: a post ahead, nobody, someone who walks away."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from caneflow.messages import Pose, RadarFrame, RadarTargets, Sample
from caneflow.messages.rig import read_rig
from caneflow.physics import SPEED_OF_LIGHT
from caneflow.runtime import Context, Refused
from operators.radar_obstacles import RadarObstaclesOperator, RadarTargetSettings

CARRIER, BANDWIDTH, PERIOD = 4.3e9, 2.0e9, 0.01
START, STEP, BINS = 0.3, 0.02, 200  # m, m
HEIGHT, SPEED = 0.95, 1.0  # m of the antenna, m/s
EYE = 0.5**0.5
RIG = {"hand_height": HEIGHT, "aperture": 0.87, "pivot": [0, -0.3, 0], "boresight": [0, 1, 0]}
PORTS: dict[str, type[Sample]] = {"frame": RadarFrame, "pose": Pose}
Distance = Callable[[float], float]  # m, of a scatterer at a time in s


def floor(seed: int = 1) -> list[Distance]:
    """Points on the floor, 2.5 to 6 m ahead at the start, within 1 m to the sides: none is ever behind the antenna."""
    dice = np.random.default_rng(seed)
    places = zip(dice.uniform(2.5, 6.0, 60).tolist(), dice.uniform(-1.0, 1.0, 60).tolist(), strict=True)

    def at(x: float, y: float) -> Distance:
        return lambda t: float(np.sqrt((x - SPEED * t) ** 2 + y**2 + HEIGHT**2))

    return [at(x, y) for x, y in places]


def scan(t: float, scatterers: list[tuple[Distance, float]], dice: np.random.Generator) -> NDArray[np.complex64]:
    """A pulse of 1 / BANDWIDTH from each scatterer, with the carrier's phase, and noise."""
    ranges = START + STEP * np.arange(BINS)
    echo = dice.normal(0, 0.03, BINS) + 1j * dice.normal(0, 0.03, BINS)
    for distance, amplitude in scatterers:
        away = distance(t)
        envelope = np.exp(-0.5 * ((ranges - away) / (SPEED_OF_LIGHT / (4 * BANDWIDTH))) ** 2)
        echo = echo + amplitude * envelope * np.exp(-4j * np.pi * CARRIER * away / SPEED_OF_LIGHT)
    return echo.astype(np.complex64)


def targets(things: list[Distance], seconds: float = 1.5) -> list[RadarTargets]:
    """What the operator says of a walk over a floor towards `things`."""
    ports = Context(node="radar_obstacles", rig=read_rig(RIG), ports=PORTS, random=np.random.default_rng(1))
    program, dice = RadarObstaclesOperator(RadarTargetSettings(), ports), np.random.default_rng(2)
    scatterers = [(each, 0.3) for each in floor()] + [(each, 1.0) for each in things]
    said: list[RadarTargets] = []
    for number in range(round(seconds / PERIOD)):
        stamp = 10**18 + round(number * PERIOD * 1e9)
        pose = Pose(
            stamp=stamp,
            position=(number * PERIOD * SPEED, 0.0, 0.0),
            velocity=(SPEED, 0.0, 0.0),
            orientation=(EYE, 0.0, 0.0, -EYE),
            method="best",
        )
        frame = RadarFrame(
            stamp=stamp,
            scans=scan(number * PERIOD, scatterers, dice)[None],
            scan_period=PERIOD,
            range_start=START,
            range_step=STEP,
            carrier=CARRIER,
            bandwidth=BANDWIDTH,
        )
        assert not list(program.handle("pose", pose))
        for port, each in program.handle("frame", frame):
            assert port == "targets"
            assert isinstance(each, RadarTargets)
            said.append(each)
    return said


def test_the_floor_alone_is_no_target() -> None:
    said = targets([])
    assert len(said) == 9, "every tenth scan, once the window of 64 is full"
    assert all(each.above_floor is None or not each.above_floor.any() for each in said)


def test_a_post_as_high_as_the_antenna_stands_out_by_its_speed() -> None:
    said = targets([lambda t: 2.6 - SPEED * t])
    last = said[-1]
    assert last.range is not None
    assert last.range_rate is not None
    assert last.above_floor is not None
    above = np.flatnonzero(last.above_floor)
    assert len(above) == 1
    middle = 2.6 - SPEED * (1.5 - 0.32)  # the window's middle is 0.32 s old
    assert last.range[above[0]] == pytest.approx(middle, abs=0.15)
    assert last.range_rate[above[0]] == pytest.approx(-SPEED, abs=0.06), "one Doppler cell is 0.054 m/s"


def test_somebody_who_walks_away_faster_is_told_of_but_not_as_above_the_floor() -> None:
    said = targets([lambda t: 1.5 + 0.5 * t])
    last = said[-1]
    assert last.range is not None
    assert last.range_rate is not None
    assert last.above_floor is not None
    assert last.above_floor.tolist() == [0]
    assert last.range_rate[0] == pytest.approx(0.5, abs=0.06)


def test_a_pose_that_is_not_newer_is_refused() -> None:
    context = Context(node="radar_obstacles", rig=read_rig(RIG), ports=PORTS, random=np.random.default_rng(1))
    program = RadarObstaclesOperator(RadarTargetSettings(), context)
    still = (0.0, 0.0, 0.0)
    pose = Pose(stamp=10**18, position=still, velocity=still, orientation=(1.0, 0.0, 0.0, 0.0), method="best")
    list(program.handle("pose", pose))
    with pytest.raises(Refused, match="is not after the one before"):
        list(program.handle("pose", pose))
