"""The cane's operators, a list in and a list out: no process, no Zenoh."""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest

from caneflow.algorithms.rotations import rotate
from caneflow.messages import GroundSpeed, Imu, MessageError, Pose, RadarFrame, Sample
from caneflow.messages.rig import Rig, read_rig
from caneflow.runtime import Context, Operator, Refused
from caneflow.simulation.scenario import Walk, simulate_walk, walk_settings
from operators.fusion import Fusion, FusionSettings, Method
from operators.ground_speed import GroundSpeedOperator, GroundSpeedSettings


@cache
def walk() -> Walk:
    """8 s of a straight walk, the first 2 at rest."""
    return simulate_walk("straight", seed=3, duration=8.0)


def context(rig: Rig) -> Context:
    return Context(node="test", rig=rig, ports={}, random=np.random.default_rng(0))


def samples() -> Iterator[tuple[str, Sample]]:
    """Frames and IMU readings of the walk, in event time."""
    return samples_of(walk())


def samples_of(made: Walk) -> Iterator[tuple[str, Sample]]:
    """Frames and IMU readings of a walk, in event time."""
    imu = made.imu
    for i, stamp in enumerate(made.stamps_ns.tolist()):
        yield (
            "frame",
            RadarFrame(
                stamp=stamp,
                scans=made.scans[i : i + 1],
                scan_period=made.scan_period,
                range_start=made.range_start,
                range_step=made.range_step,
                carrier=made.carrier,
                bandwidth=made.bandwidth,
            ),
        )
        yield (
            "imu",
            Imu(
                stamp=stamp,
                gyro=tuple(imu.gyro[i].tolist()),
                accel=tuple(imu.accel[i].tolist()),
                mag=tuple(imu.mag[i].tolist()),
                orientation=tuple(imu.orientation[i].tolist()),
                linear_accel=tuple(imu.linear_accel[i].tolist()),
            ),
        )


def through(operator: Operator, messages: Iterator[tuple[str, Sample]]) -> list[Sample]:
    return [out for port, message in messages for _, out in operator.handle(port, message)]


def speeds(settings: GroundSpeedSettings | None = None) -> list[GroundSpeed]:
    operator = GroundSpeedOperator(settings or GroundSpeedSettings(), context(read_rig(walk().rig)))
    return [out for out in through(operator, samples()) if isinstance(out, GroundSpeed)]


def along_boresight(i: int) -> float:
    """The true velocity along the boresight's projection (m/s): what a radar on a swinging cane measures."""
    x, y, _ = rotate(tuple(walk().orientation[i].tolist()), (0.0, 1.0, 0.0))
    vx, vy = walk().velocity[i, :2].tolist()
    return float((vx * x + vy * y) / math.hypot(x, y))


def test_there_is_one_speed_per_frame_with_both_front_ends() -> None:
    found = speeds()
    assert [speed.stamp for speed in found] == walk().stamps_ns.tolist()
    assert not found[0].valid, "a window that is not full says nothing"
    assert found[0].quality == math.inf
    resting = [speed for speed in found if 1_000_000_000 < speed.stamp - found[0].stamp < 1_900_000_000]
    assert {(speed.speed, speed.quality, speed.valid) for speed in resting} == {(0.0, 0.0, True)}
    truth = float(np.mean([along_boresight(i) for i in range(500, len(walk().stamps_ns))]))  # m/s, walking
    walking = found[500:]
    assert np.mean([speed.speed for speed in walking if speed.valid]) == pytest.approx(truth, rel=0.1)
    forward = [speed.velocity[0] for speed in walking if speed.velocity and speed.velocity_cov]
    assert np.mean(forward) == pytest.approx(truth, rel=0.1)


def test_each_front_end_can_be_switched_off() -> None:
    assert all(speed.velocity is None for speed in speeds(GroundSpeedSettings(with_velocity=False))[-10:])
    alone = speeds(GroundSpeedSettings(with_speed=False))[-5:]
    assert not any(speed.valid for speed in alone)
    assert sum(speed.velocity is not None for speed in alone) == 1, "every fifth"
    with pytest.raises(ValueError, match="nothing to say"):
        GroundSpeedSettings(with_speed=False, with_velocity=False)


def told(scans: np.ndarray) -> list[GroundSpeed]:
    """Of the walk's IMU and other scans, 3 s at rest; after 0.7 s, when the window is full."""
    operator = GroundSpeedOperator(GroundSpeedSettings(), context(read_rig(walk().rig)))
    frames, out = iter(scans), []
    for port, message in samples():
        if port == "frame" and (scan := next(frames, None)) is None:
            break
        if isinstance(message, RadarFrame) and scan is not None:
            message = msgspec.structs.replace(message, scans=scan[None])
        out += [sample for _, sample in operator.handle(port, message) if isinstance(sample, GroundSpeed)]
    return out[70:]


@cache
def at_rest(snr: float) -> np.ndarray:
    """Scans of the walk's first 1.9 s at another SNR (dB)."""
    settings = walk_settings("straight", 3)
    settings = replace(settings, radar=replace(settings.radar, snr=snr))
    return simulate_walk(settings, seed=3, duration=1.9).scans


@pytest.mark.parametrize("snr", [15.0, 0.0])
def test_rest_is_claimed_where_the_ground_is_seen(snr: float) -> None:
    found = told(at_rest(snr))
    assert all(one.valid and one.quality == 0.0 for one in found)
    assert all(one.velocity_cov[0] < 0.1 for one in found if one.velocity_cov)


BLIND: dict[str, np.ndarray | float] = {
    "noise": np.random.default_rng(1).normal(0.0, 200.0, (190, 288)),
    "noise of one bit": np.random.default_rng(1).integers(0, 2, (190, 288)),
    "faint ground": -15.0,
    "zeros": np.zeros((190, 288)),
    "a constant": np.full((190, 288), 77.0),
}


@pytest.mark.parametrize(
    ("seen", "dtype"),
    [*((seen, np.int32) for seen in BLIND), *(("noise", dtype) for dtype in (np.int16, np.float32, np.complex64))],
)
def test_where_the_radar_sees_nothing_nobody_stands(seen: str, dtype: type) -> None:
    made = BLIND[seen]
    scans = at_rest(made) if isinstance(made, float) else made
    assert_nothing(told(scans.astype(dtype)))


def test_a_radar_that_hangs_sees_nothing() -> None:
    assert_nothing(told(np.repeat(at_rest(15.0)[:1], 190, axis=0)))


def assert_nothing(found: list[GroundSpeed]) -> None:
    assert {(one.speed, one.quality, one.valid) for one in found} == {(0.0, math.inf, False)}
    assert {(one.velocity, one.velocity_cov) for one in found} == {(None, None), ((0.0, 0.0), (1e6, 0.0, 1e6))}


def test_a_steady_walk_in_noise_is_never_taken_for_rest() -> None:
    """1 m/s without swing: from 15 dB, where all is seen, to -10, where nothing is."""
    settings = walk_settings("straight", 3)
    motion = replace(settings.motion, speed=1.0, swing=0.0, wander=math.radians(0.5))
    for snr, least, most in ((15.0, 0.95, 1.0), (-6.0, 0.05, 0.9), (-10.0, 0.0, 0.05)):
        radar = replace(settings.radar, snr=snr)
        made = simulate_walk(replace(settings, motion=motion, radar=radar), seed=3, duration=6.0)
        found = steady(made)
        valid = [one for one in found if one.valid]
        assert least <= len(valid) / len(found) <= most
        assert all(one.speed > 0.5 for one in valid)
        seen = [one.velocity[0] for one in found if one.velocity and one.velocity_cov and one.velocity_cov[0] < 1e5]
        assert all(speed > 0.5 for speed in seen)


def covered(since_s: float) -> Iterator[tuple[str, Sample]]:
    """The walk, its antenna covered from `since_s` on: from there on the scans are noise."""
    noise, begin = np.random.default_rng(1), walk().stamps_ns[0]
    for port, message in samples():
        if isinstance(message, RadarFrame) and message.stamp - begin > since_s * 1e9:
            scans = np.rint(noise.normal(0.0, 200.0, message.scans.shape)).astype(np.int32)
            message = msgspec.structs.replace(message, scans=scans)
        yield port, message


def test_when_the_antenna_is_covered_the_walk_before_is_not_taken_for_rest() -> None:
    operator = GroundSpeedOperator(GroundSpeedSettings(), context(read_rig(walk().rig)))
    found = [each for each in through(operator, covered(5.0)) if isinstance(each, GroundSpeed)]
    after = [each for each in found if each.stamp - walk().stamps_ns[0] > 5.2e9]
    seen = [each for each in after if each.velocity_cov and each.velocity_cov[0] < 1e5]
    assert [each.velocity for each in seen] == []
    assert not any(each.valid for each in after)


def test_while_no_radar_tells_the_speed_the_pose_says_how_unsure_it_is() -> None:
    operator = GroundSpeedOperator(GroundSpeedSettings(), context(read_rig(walk().rig)))
    fusion = Fusion(FusionSettings(method="best"), context(read_rig(walk().rig)))
    poses: list[Pose] = []
    for port, message in covered(5.0):
        if isinstance(message, Imu):
            poses += [pose for _, pose in fusion.handle("imu", message) if isinstance(pose, Pose)]
        for _, speed in operator.handle(port, message):
            list(fusion.handle("speed", speed))
    sd = [math.sqrt(np.trace(pose.covariance[3:5, 3:5])) for pose in poses if pose.covariance is not None]
    assert sd[-1] > 2.0 * sd[490], "3 s later, m/s"
    walked, told = math.hypot(*walk().velocity[-1][:2]), math.hypot(*poses[-1].velocity[:2])
    assert abs(told - walked) < 2.5 * sd[-1]


def steady(made: Walk) -> list[GroundSpeed]:
    """The speeds of its last 2 s."""
    operator = GroundSpeedOperator(GroundSpeedSettings(), context(read_rig(made.rig)))
    out = [sample for sample in through(operator, samples_of(made)) if isinstance(sample, GroundSpeed)]
    return out[-200:]


def test_what_the_rig_lacks_is_named() -> None:
    with pytest.raises(MessageError, match=r"rig\.hand_height is not known"):
        GroundSpeedOperator(GroundSpeedSettings(), context(Rig()))
    with pytest.raises(MessageError, match=r"rig\.step_length is not known"):
        Fusion(FusionSettings(method="shs"), context(Rig()))


def test_an_imu_without_orientation_is_refused_with_the_way_out() -> None:
    operator = GroundSpeedOperator(GroundSpeedSettings(), context(read_rig(walk().rig)))
    with pytest.raises(Refused, match=r"operators\.attitude"):
        list(operator.handle("imu", Imu(stamp=1, gyro=(0.0, 0.0, 0.0))))
    fusion = Fusion(FusionSettings(), context(Rig()))
    with pytest.raises(Refused, match="no orientation"):
        list(fusion.handle("imu", Imu(stamp=1, gyro=(0.0, 0.0, 0.0))))


@pytest.mark.parametrize("method", ["luenberger", "kalman", "best"])
def test_fusion_follows_a_constant_speed_along_the_boresight(method: str) -> None:
    """The boresight points along x: 1 s of 1 m/s^2, then 3 s of 1 m/s are 3.5 m along x, whatever estimates it."""
    rig = read_rig({"boresight": [1, 0, 0], "pivot": [-0.3, 0, 0]})
    fusion = Fusion(FusionSettings(method=method), context(rig))  # type: ignore[arg-type]  # a name from the list above
    poses: list[Pose] = []
    for i in range(500):
        stamp = 1 + i * 10_000_000
        moving = min(max(i - 100, 0) * 0.01, 1.0)  # m/s
        gained = 1.0 if 100 <= i < 200 else 0.0  # m/s^2
        imu = Imu(
            stamp=stamp,
            gyro=(0.0, 0.0, 0.0),
            accel=(gained, 0.0, 9.80665),
            orientation=(1.0, 0.0, 0.0, 0.0),
            linear_accel=(gained, 0.0, 0.0),
        )
        speed = GroundSpeed(
            stamp=stamp,
            speed=moving,
            quality=0.01,
            rays=16,
            valid=True,
            delay=0.0,
            velocity=(moving, 0.0),
            velocity_cov=(1e-4, 0.0, 1e6),
            velocity_delay=0.0,
        )
        for port, message in (("imu", imu), ("speed", speed)):
            poses += [out for _, out in fusion.handle(port, message) if isinstance(out, Pose)]
    assert len(poses) == 500
    assert {pose.method for pose in poses} == {method}
    assert poses[-1].position[0] == pytest.approx(3.5, abs=0.15)
    assert poses[-1].position[1] == pytest.approx(0.0, abs=0.1)
    if method != "luenberger":
        covariance = poses[-1].covariance
        assert covariance is not None
        assert np.linalg.eigvalsh(covariance).min() > 0


@pytest.mark.parametrize(
    "wild",
    [{"gyro": (35.7, 0.0, 35.7)}, {"accel": (0.0, -327.68, 4000.0)}, {"orientation": (0.0, 1.0, 0.0, 0.0)}],
    ids=lambda wild: next(iter(wild)),
)
def test_a_wild_reading_of_the_imu_does_not_reach_the_ground_speed(wild: dict[str, tuple[float, ...]]) -> None:
    """One in ten is wild; what is held in its place is 10 ms old."""
    operator = GroundSpeedOperator(GroundSpeedSettings(), context(read_rig(walk().rig)))
    spoilt = (
        (port, msgspec.structs.replace(each, **wild) if isinstance(each, Imu) and index % 20 == 11 else each)
        for index, (port, each) in enumerate(samples())
    )
    found = [each for each in through(operator, spoilt) if isinstance(each, GroundSpeed)]
    off = [a.speed - b.speed for a, b in zip(found, speeds(), strict=True)]
    forward = [a.velocity[0] - b.velocity[0] for a, b in zip(found, speeds(), strict=True) if a.velocity and b.velocity]
    assert max(map(abs, off)) < 0.05
    assert max(map(abs, forward)) < 0.05


def test_what_needs_no_speed_runs_where_none_is_wired_and_the_rest_says_so() -> None:
    """Step and heading uses the speed not at all: the same poses with it and without."""
    rig = read_rig({"boresight": [0, 1, 0], "pivot": [0, -0.3, 0], "step_length": 0.42})
    alone = replace(context(rig), ports={"imu": Imu})
    both = replace(context(rig), ports={"imu": Imu, "speed": GroundSpeed})
    readings = [message for port, message in samples() if port == "imu"]
    without: tuple[Method, ...] = ("shs", "naive_ins")
    needing: tuple[Method, ...] = ("luenberger", "luenberger_fixed", "kalman", "best")
    for method in without:
        settings = FusionSettings(method=method)
        one, other = Fusion(settings, alone), Fusion(settings, both)
        assert [list(one.handle("imu", each)) for each in readings] == [
            list(other.handle("imu", each)) for each in readings
        ]
    for method in needing:
        with pytest.raises(MessageError, match=f"method {method} needs the input speed, which is not wired"):
            Fusion(FusionSettings(method=method), alone)


def test_the_local_pose_is_sent_where_it_is_asked_for() -> None:
    """At the start the two are one; afterwards both are of each sample."""
    rig = Rig(pivot=(0.0, -0.3, 0.0))
    with_local = Fusion(FusionSettings(method="best", with_local=True), context(rig))
    alone = Fusion(FusionSettings(method="best"), context(rig))
    for port, message in samples():
        if port == "imu":
            (first, pose), (second, local) = with_local.handle(port, message)
            assert (first, second) == ("pose", "local")
            ((_, same),) = alone.handle(port, message)
            assert isinstance(pose, Pose)
            assert isinstance(local, Pose)
            assert isinstance(same, Pose)
            assert local.stamp == pose.stamp == message.stamp
            assert pose.position == same.position
            assert local.position == pytest.approx(pose.position, abs=0.05)
    with pytest.raises(ValueError, match="with_local is for the method best; luenberger has one pose"):
        FusionSettings(with_local=True)
