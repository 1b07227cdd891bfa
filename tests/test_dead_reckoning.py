"""What the fusion methods share, and all four of them on recorded walks by simulators that are not ours."""

import math
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray

from caneflow.algorithms import rotations
from caneflow.algorithms.cane.dead_reckoning import HISTORY, DeadReckoning, GroundVelocity
from caneflow.algorithms.cane.kalman import KalmanFilter, KalmanSettings
from caneflow.algorithms.cane.luenberger import LuenbergerObserver, LuenbergerSettings
from caneflow.algorithms.cane.naive_ins import NaiveIns, NaiveInsSettings
from caneflow.algorithms.cane.step_heading import StepHeading, StepHeadingSettings
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.imu_sample import SampleClock, heading_of
from caneflow.algorithms.judging.track_errors import Track, TrackErrors, boresight_yaws, track_errors

Floats = NDArray[np.float64]
WALKS = Path(__file__).parents[1].parent / "shared" / "data" / "walks"
BORESIGHT: rotations.Vector = (0.0, 1.0, 0.0)
STILL: rotations.Vector = (0.0, 0.0, 0.0)
STEP_LENGTH = 0.42  # m, of the recordings' rig
WINDOW = 64  # scans


def method(name: str) -> DeadReckoning:
    """Any of the four, as an operator picks one by name."""
    if name == "luenberger":
        return LuenbergerObserver(LuenbergerSettings(), boresight=BORESIGHT)
    if name == "kalman":
        return KalmanFilter(KalmanSettings(), boresight=BORESIGHT)
    if name == "shs":
        return StepHeading(StepHeadingSettings(), boresight=BORESIGHT, step_length=STEP_LENGTH)
    return NaiveIns(NaiveInsSettings())


@cache
def recorded(walk: str) -> dict[str, list[dict[str, Any]]]:
    """Samples of `imu` and `truth` of a walk, in the order of time; read without our own code."""
    path = WALKS / f"{walk}.mcap"
    if not path.exists():
        pytest.skip(f"the shared recordings are not here: ../shared/data/walks/{walk}.mcap")
    samples: dict[str, list[dict[str, Any]]] = {"imu": [], "truth": []}
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(topics=["cane/imu/imu", "cane/truth/pose"]):
            samples[channel.topic.split("/")[1]].append(msgspec.msgpack.decode(message.data))
    return samples


def radar_like_speeds(truth: list[dict[str, Any]]) -> Floats:
    """A stand-in for the radar: the true velocity along the boresight, as a Hann window of scans would see it."""
    velocities = np.array([sample["velocity"] for sample in truth])
    yaws = boresight_yaws(np.array([sample["orientation"] for sample in truth]), BORESIGHT)
    along = velocities[:, 0] * np.cos(yaws) + velocities[:, 1] * np.sin(yaws)
    window = np.hanning(WINDOW + 2)[1:-1]
    averaged: Floats = np.convolve(along, window / window.sum())[: len(along)]
    return averaged


def followed(walk: str, name: str) -> TrackErrors:
    samples = recorded(walk)
    reckoning = method(name)
    estimates = []
    for imu, speed in zip(samples["imu"], radar_like_speeds(samples["truth"]).tolist(), strict=True):
        reckoning.speed(imu["stamp"], speed, 0.07, True, 0.315)
        estimates.append(
            reckoning.imu(
                imu["stamp"],
                ImuReading(
                    tuple(imu["gyro"]),
                    tuple(imu["accel"]),
                    orientation=tuple(imu["orientation"]),
                    linear_accel=tuple(imu["linear_accel"]),
                ),
            )
        )
    assert reckoning.gaps == 0
    return track_errors(
        Track(
            stamps=np.array([imu["stamp"] for imu in samples["imu"]]),
            positions=np.array([estimate.position for estimate in estimates]),
            orientations=np.array([estimate.orientation for estimate in estimates]),
        ),
        Track(
            stamps=np.array([pose["stamp"] for pose in samples["truth"]]),
            positions=np.array([pose["position"] for pose in samples["truth"]]),
            orientations=np.array([pose["orientation"] for pose in samples["truth"]]),
        ),
        boresight=BORESIGHT,
    )


@pytest.mark.parametrize("name", ["luenberger", "kalman"])
@pytest.mark.parametrize("walk", ["swing_1", "swing_stop_2"])
def test_radar_and_imu_stay_within_the_papers_worst_error(walk: str, name: str) -> None:
    errors = followed(walk, name)
    assert errors.final_error < 2.7  # Table I, maximum of ten walks
    assert errors.ate < 1.5
    # a quarter turn or a wrong scale would not show in the closing distance of these loops
    assert errors.extent == pytest.approx(1.0, abs=0.1)


def test_steps_serve_while_the_cane_swings_and_fail_when_it_stops() -> None:
    assert followed("swing_1", "shs").final_error < 2.0
    assert followed("swing_stop_2", "shs").final_error > 4.0


def test_the_naive_way_is_lost() -> None:
    assert followed("swing_1", "naive_ins").final_error > 10.0


@pytest.mark.parametrize("name", ["luenberger", "kalman", "shs", "naive_ins"])
def test_the_first_estimate_is_the_origin_and_every_sample_gives_one(name: str) -> None:
    reckoning = method(name)
    orientation = rotations.from_yaw(0.3)
    reckoning.speed(999, 0.5, 0.1, True, 0.3)
    first = reckoning.imu(1_000, ImuReading(STILL, STILL, orientation=orientation, linear_accel=STILL))
    assert first.position == first.velocity == STILL
    assert first.orientation == orientation
    assert (
        reckoning.imu(2_000, ImuReading(STILL, STILL, orientation=orientation, linear_accel=STILL)).orientation
        == orientation
    )


def test_the_clock_measures_intervals_and_counts_gaps() -> None:
    clock = SampleClock()
    assert clock.interval(1_700_000_000_000_000_000) is None
    assert clock.interval(1_700_000_000_010_000_001) == pytest.approx(0.010000001, rel=1e-12)
    assert clock.gaps == 0
    assert clock.interval(1_700_000_000_510_000_002) == pytest.approx(0.500000001, rel=1e-12)
    assert clock.gaps == 1
    with pytest.raises(ValueError, match="is not after the one before"):
        clock.interval(1_700_000_000_510_000_002)
    assert clock.interval(1_700_000_000_520_000_002) == pytest.approx(0.01), "the refused one left no trace"


def test_heading_is_the_boresights_yaw_whatever_the_pitch() -> None:
    for yaw in np.linspace(-3.0, 3.0, 13).tolist():
        pitched = rotations.multiply(
            rotations.from_yaw(yaw - math.pi / 2), rotations.from_rotation_vector((-0.8, 0.0, 0.0))
        )
        assert heading_of(pitched, BORESIGHT) == pytest.approx((math.cos(yaw), math.sin(yaw)))
    straight_down = rotations.from_rotation_vector((-math.pi / 2, 0.0, 0.0))
    assert math.hypot(*heading_of(straight_down, BORESIGHT)) == pytest.approx(1.0)


def seen(ground: GroundVelocity, count: int) -> None:
    """IMU samples every 10 ms, turning by 0.1 rad each, the first at stamp 0."""
    for k in range(count):
        ground.imu(10_000_000 * k, rotations.from_yaw(0.1 * k), STILL, 0.01 if k else None)


def test_a_speed_that_comes_late_is_turned_by_the_heading_of_its_stamp() -> None:
    ground = GroundVelocity((1.0, 0.0, 0.0), compensate_delay="none")
    seen(ground, 20)
    ground.speed(50_000_000, 2.0, 0.1, True, 0.3)
    velocity = ground.take(200_000_000)
    assert velocity is not None
    assert (velocity.x, velocity.y) == pytest.approx((2.0 * math.cos(0.5), 2.0 * math.sin(0.5)))


def test_a_speed_waits_for_a_later_sample_and_is_taken_once() -> None:
    ground = GroundVelocity((1.0, 0.0, 0.0), compensate_delay="none")
    seen(ground, 3)
    ground.speed(20_000_000, 1.0, 0.1, True, None)
    assert ground.take(20_000_000) is None
    assert ground.take(30_000_000) is not None
    assert ground.take(40_000_000) is None


def test_of_several_speeds_the_newest_counts_and_memory_is_bounded() -> None:
    ground = GroundVelocity((1.0, 0.0, 0.0), compensate_delay="heading")
    seen(ground, HISTORY + 100)
    for k in range(1000):
        ground.speed(k, float(k), 0.1, True, 0.0)
    velocity = ground.take(10_000_000_000)
    assert velocity is not None
    # its time is before all that is kept, so the oldest heading has to do
    assert math.hypot(velocity.x, velocity.y) == pytest.approx(999.0)
    assert math.atan2(velocity.y, velocity.x) == pytest.approx(rotations.wrapped(0.1 * 100))
