"""The room's trackers on a person whose every measurement is known: errors, silence, standing still, real ranges."""

import itertools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.signal import hilbert

from caneflow.algorithms.room.room_ekf import RoomEkf, RoomEkfSettings
from caneflow.algorithms.room.room_particles import (
    HeadingParticleTracker,
    ParticleTracker,
    RoomParticleSettings,
    expected_strength,
)
from caneflow.algorithms.room.room_tracking import (
    Echo,
    HeadingHistory,
    MotionWatch,
    RoomEstimate,
    RoomStart,
    RoomTracker,
    SilenceWatch,
    StaticSensor,
    WayHistory,
    pattern_loss,
)

P4XX = Path(__file__).parents[1].parent / "shared" / "data" / "p4xx-walker-4nodes"
START_NS = 1_700_000_000_000_000_000
HOP_NS = 50_000_000
AREA = (0.0, 8.0, 0.0, 8.0)
SOUTH = StaticSensor(position=(4.0, -2.5), azimuth=0.5 * math.pi, k=1.0)
WEST = StaticSensor(position=(-2.5, 4.0), azimuth=0.0, k=1.0)
SENSORS = {"south": SOUTH, "west": WEST}

Make = Callable[[RoomStart], RoomTracker]
Turn = Callable[[float], float]  # rad, heading over time


def circle(at: float) -> tuple[float, float, float]:
    """Position and heading on a circle of 2.4 m at 1 m/s."""
    angle = at / 2.4
    return 4.0 + 2.4 * math.cos(angle), 4.0 + 2.4 * math.sin(angle), angle + 0.5 * math.pi


def echo_at(sensor: StaticSensor, at: float, stamp_ns: int, random: np.random.Generator, signed: bool) -> Echo:
    """What a sensor sees of someone on the circle: 3 dB of fading, 0.08 m/s of gait."""
    x, y, heading = circle(at)
    dx, dy = x - sensor.position[0], y - sensor.position[1]
    distance = math.hypot(dx, dy)
    rate = (dx * math.cos(heading) + dy * math.sin(heading)) / distance + 0.08 * random.standard_normal()
    off = math.atan2(dy, dx) - sensor.azimuth
    assert sensor.k is not None
    strength = 10.0 * math.log10(sensor.k / distance**4) - pattern_loss(off) + 3.0 * random.standard_normal()
    return Echo(
        stamp_ns=stamp_ns,
        valid=abs(rate) > 0.05,
        range_rate=rate if signed else abs(rate),
        signed=signed,
        strength=strength,
    )


def walk(
    tracker: RoomTracker,
    seconds: float,
    *,
    imu: bool = True,
    signed: bool = False,
    seed: int = 0,
    silent: Mapping[str, tuple[float, float]] | None = None,
) -> np.ndarray:
    """Errors in m, by hop, of someone who walks the circle; `silent`: sensors that say nothing from, to (s)."""
    random = np.random.default_rng(seed)
    errors = []
    for hop in range(round(seconds / 0.05)):
        at, stamp = hop * 0.05, START_NS + hop * HOP_NS
        x, y, heading = circle(at)
        if imu:
            tracker.heading(stamp, heading + math.radians(3.0))
        for name, sensor in SENSORS.items():
            gone = (silent or {}).get(name, (math.inf, math.inf))
            echo = echo_at(sensor, at, stamp, random, signed)
            if not gone[0] <= at < gone[1]:
                tracker.echo(name, echo)
        px, py = tracker.estimate(stamp).position
        errors.append(math.hypot(px - x, py - y))
    return np.array(errors)


def ekf(**chosen: Any) -> Make:
    return lambda start: RoomEkf(RoomEkfSettings(**chosen), SENSORS, start)


def particles(kind: type[ParticleTracker] | type[HeadingParticleTracker], seed: int = 0, **chosen: Any) -> Make:
    return lambda start: kind(RoomParticleSettings(**chosen), SENSORS, start, np.random.default_rng(seed))


GUESS = RoomStart(guess=(6.7, 3.8), error=0.5, area=AREA)
METHODS = {
    "ekf": (ekf(), 0.35),
    "heading_particle": (particles(HeadingParticleTracker), 0.5),
    "particle": (particles(ParticleTracker), 0.9),
}


@pytest.mark.parametrize("name", METHODS)
def test_somebody_on_a_circle_is_followed(name: str) -> None:
    make, limit = METHODS[name]
    errors = walk(make(GUESS), 40.0)[100:]
    assert errors.mean() < limit
    assert errors.max() < 4 * limit


@pytest.mark.parametrize("name", METHODS)
def test_signed_modules_do_without_an_imu(name: str) -> None:
    make, _ = METHODS[name]
    if name == "heading_particle":
        pytest.skip("without a heading this method has nothing to walk along")
    assert walk(make(GUESS), 40.0, imu=False, signed=True)[100:].mean() < 0.9


@pytest.mark.parametrize("name", METHODS)
def test_a_silent_sensor_is_left_out_and_comes_back(name: str) -> None:
    make, limit = METHODS[name]
    errors = walk(make(GUESS), 40.0, silent={"west": (10.0, 15.0)})
    assert errors[200:300].max() < 2.5
    assert errors[500:].mean() < 1.3 * limit


@pytest.mark.parametrize("name", METHODS)
def test_who_stands_is_held_where_they_are_and_ever_less_surely(name: str) -> None:
    make, _ = METHODS[name]
    tracker = make(GUESS)
    walk(tracker, 20.0)
    assert tracker.moving
    stopped = START_NS + 400 * HOP_NS
    spreads, positions = [], []
    for hop in range(100):
        for sensor in SENSORS:
            tracker.echo(sensor, Echo(stamp_ns=stopped + hop * HOP_NS, valid=False))
        estimate = tracker.estimate(stopped + hop * HOP_NS)
        spreads.append(estimate.covariance[0, 0])
        positions.append(estimate.position)
    assert not tracker.moving
    assert math.hypot(*estimate.velocity) < 0.05
    assert math.dist(positions[30], positions[-1]) < 0.4
    assert spreads[-1] > spreads[40] > spreads[25]


@pytest.mark.parametrize("name", ["particle", "heading_particle"])
def test_particles_are_a_matter_of_their_seed_alone(name: str) -> None:
    kind = ParticleTracker if name == "particle" else HeadingParticleTracker
    first, again, other = (walk(particles(kind, seed)(GUESS), 5.0) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_without_a_guess_the_person_is_found_anywhere_in_the_area() -> None:
    errors = walk(particles(HeadingParticleTracker)(RoomStart(area=AREA)), 40.0)
    assert errors[400:].mean() < 1.0


@pytest.mark.long
def test_everything_together_is_better_than_a_part_of_it() -> None:
    """The paper's Fig. 6, and its reason for fusing; means of three seeds."""

    def mean(imu: bool, **chosen: bool) -> float:
        runs = [walk(particles(ParticleTracker, seed, **chosen)(GUESS), 40.0, imu=imu, seed=seed) for seed in range(3)]
        return float(np.mean([errors[100:].mean() for errors in runs]))

    together = mean(imu=True)
    assert together < mean(imu=False, use_speed=False)
    assert together < mean(imu=False, use_strength=False)


def test_a_measurement_that_no_particle_fits_is_discarded_and_counted() -> None:
    tracker = particles(ParticleTracker)(GUESS)
    walk(tracker, 10.0)
    before, discarded = tracker.estimate(START_NS + 200 * HOP_NS), tracker.discarded
    tracker.echo("south", Echo(stamp_ns=START_NS + 200 * HOP_NS, valid=True, range_rate=9.0, strength=80.0))
    assert tracker.discarded == discarded + 2
    assert math.dist(tracker.estimate(START_NS + 200 * HOP_NS).position, before.position) < 0.2


def test_the_covariance_of_the_ekf_is_one_and_covers() -> None:
    tracker = RoomEkf(RoomEkfSettings(), SENSORS, GUESS)
    random = np.random.default_rng(4)
    inside = []
    for hop in range(800):
        stamp = START_NS + hop * HOP_NS
        x, y, heading = circle(hop * 0.05)
        tracker.heading(stamp, heading)
        for name, sensor in SENSORS.items():
            tracker.echo(name, echo_at(sensor, hop * 0.05, stamp, random, False))
        estimate = tracker.estimate(stamp)
        assert np.linalg.eigvalsh(estimate.covariance).min() > 0.0
        off = np.array([estimate.position[0] - x, estimate.position[1] - y])
        inside.append(off @ np.linalg.solve(estimate.covariance[:2, :2], off) < 5.99)
    assert np.mean(inside[100:]) > 0.8  # 0.95 of a true one


def test_step_of_a_thousand_particles(benchmark: Any) -> None:
    """50 ms of the room: two sensors and one pose."""
    tracker = particles(ParticleTracker)(GUESS)
    random = np.random.default_rng(5)
    told = []
    for hop in range(300):
        stamp = START_NS + hop * HOP_NS
        echoes = {name: echo_at(sensor, hop * 0.05, stamp, random, False) for name, sensor in SENSORS.items()}
        told.append((stamp, circle(hop * 0.05)[2], echoes))
    coming = iter(told)

    def step(stamp: int, heading: float, echoes: Mapping[str, Echo]) -> RoomEstimate:
        tracker.heading(stamp, heading)
        for name, echo in echoes.items():
            tracker.echo(name, echo)
        return tracker.estimate(stamp)

    last = benchmark.pedantic(step, setup=lambda: (next(coming), {}), rounds=len(told))
    assert math.dist(last.position, circle(299 * 0.05)[:2]) < 2.0


@pytest.mark.parametrize("name", ["ekf", "heading_particle"])
def test_who_is_felt_to_stand_is_held_at_once_whatever_the_sensors_say(name: str) -> None:
    make, _ = METHODS[name]
    tracker = make(GUESS)
    walk(tracker, 10.0)
    before = tracker.estimate(START_NS + 199 * HOP_NS).position
    for hop in range(200, 260):
        stamp = START_NS + hop * HOP_NS
        tracker.heading(stamp, 1.0, True)
        for sensor in SENSORS:  # an arm that moves
            tracker.echo(sensor, Echo(stamp_ns=stamp, valid=True, range_rate=0.8, signed=False, strength=-30.0))
    estimate = tracker.estimate(stamp)
    assert not tracker.moving
    assert math.dist(estimate.position, before) < 0.5
    assert math.hypot(*estimate.velocity) < 0.1
    tracker.heading(stamp + HOP_NS, 1.0, False)
    tracker.echo("south", Echo(stamp_ns=stamp + HOP_NS, valid=True, range_rate=0.8, signed=False, strength=-30.0))
    assert tracker.moving


def test_who_walks_again_walks_ahead() -> None:
    tracker = RoomEkf(RoomEkfSettings(use_speed=False, use_strength=False), SENSORS, GUESS)
    for hop in range(31):
        stamp = START_NS + hop * HOP_NS
        tracker.heading(stamp, 2.0, hop < 30)
        tracker.echo("south", Echo(stamp_ns=stamp, valid=True))
        if hop == 29:
            assert math.hypot(*tracker.estimate(stamp).velocity) < 0.01
    assert tracker.estimate(stamp).velocity == pytest.approx((0.5 * math.cos(2.0), 0.5 * math.sin(2.0)), abs=0.05)


def test_an_imu_that_falls_silent_no_longer_says_that_its_wearer_stands() -> None:
    watch = MotionWatch(0.7, 0.5)
    watch.steps(START_NS, True)
    watch.echo(START_NS, True)
    assert watch.standing(START_NS + 400_000_000)
    assert not watch.moving(START_NS + 400_000_000)
    assert watch.moving(START_NS + 600_000_000)
    watch.steps(START_NS + 700_000_000, None)  # it cannot tell
    assert watch.moving(START_NS + 700_000_000)


def test_the_drift_of_dead_reckoning_is_bounded_by_the_sensors() -> None:
    """A way that turns by 0.7 degrees too much per second and is 3 % too long: alone it is lost in a minute."""

    def errors(with_way: bool) -> tuple[np.ndarray, np.ndarray]:
        tracker, random = RoomEkf(RoomEkfSettings(), SENSORS, GUESS), np.random.default_rng(7)
        place, found, alone = np.array(circle(0.0)[:2]), [], []
        for hop in range(1600):
            at, stamp = hop * 0.05, START_NS + hop * HOP_NS
            x, y, heading = circle(at)
            wrong = heading + math.radians(0.7) * at
            place = place + 0.0515 * np.array([math.cos(wrong), math.sin(wrong)])
            if with_way:
                tracker.walked(stamp, (float(place[0]), float(place[1])))
            for name, sensor in SENSORS.items():
                tracker.echo(name, echo_at(sensor, at, stamp, random, False))
            found.append(math.dist(tracker.estimate(stamp).position, (x, y)))
            alone.append(math.dist(place, (x, y)))
        return np.array(found)[100:], np.array(alone)[100:]

    both, cane = errors(True)
    sensors, _ = errors(False)
    assert cane.max() > 2.0
    assert both.mean() < sensors.mean()
    assert both[-400:].mean() < 0.5 * cane[-400:].mean()  # the one is bounded, the other grows on


def test_a_way_is_interpolated_and_its_velocity_is_a_mean() -> None:
    way = WayHistory()
    assert math.isinf(way.age(START_NS))
    for tick in range(101):
        way.add(START_NS + tick * 10_000_000, (0.008 * tick, -0.002 * tick))
    assert way.between(START_NS + 105_000_000, START_NS + 215_000_000) == pytest.approx((0.088, -0.022))
    assert way.between(START_NS + 900_000_000, START_NS + 2_000_000_000) == pytest.approx((0.08, -0.02))
    assert way.velocity(START_NS + 900_000_000, 500_000_000) == pytest.approx((0.8, -0.2))
    with pytest.raises(ValueError, match="not after"):
        way.add(START_NS, (0.0, 0.0))


def test_headings_add_up_to_the_way_that_was_walked() -> None:
    history = HeadingHistory()
    for step in range(201):
        history.add(START_NS + step * 10_000_000, 0.5 * step * 0.01)
    travel = history.travel(START_NS + 500_000_000, START_NS + 1_500_000_000)
    # half a radian per second: the chord from 0.25 to 0.75 rad of a circle of radius 2
    assert travel.east == pytest.approx(2.0 * (math.sin(0.75) - math.sin(0.25)), rel=1e-4)
    assert travel.north == pytest.approx(2.0 * (math.cos(0.25) - math.cos(0.75)), rel=1e-4)
    assert travel.turned == pytest.approx(0.5)
    with pytest.raises(ValueError, match="not after"):
        history.add(START_NS, 0.0)


def test_a_heading_turns_over_pi_the_short_way() -> None:
    history = HeadingHistory()
    history.add(START_NS, 3.1)
    history.add(START_NS + 100_000_000, -3.1)
    assert history.travel(START_NS, START_NS + 100_000_000).turned == pytest.approx(math.tau - 6.2)


def test_a_single_echo_is_not_taken_for_a_person_and_a_share_of_them_is() -> None:
    watch = SilenceWatch(1.0)
    assert watch.moving(START_NS)
    stamps = [START_NS + hop * HOP_NS for hop in range(100)]
    for hop, stamp in enumerate(stamps[:60]):  # 3 s: one valid echo in 20
        watch.update(stamp, hop % 20 == 0)
    assert not watch.moving(stamps[59])
    for hop, stamp in enumerate(stamps[60:]):  # one in 4
        watch.update(stamp, hop % 4 == 0)
    assert watch.moving(stamps[99])
    assert watch.moving(stamps[99] + 1_000_000_001), "echoes that are missing do not say that nothing moves"
    assert not watch.moving(stamps[99] + 2_000_000_001), "but after 2 s nobody knows"


def test_after_a_hole_a_single_echo_does_not_say_that_the_person_stood() -> None:
    watch = SilenceWatch(0.7)
    for hop in range(60):
        watch.update(START_NS + hop * HOP_NS, True)
    back = START_NS + 80 * HOP_NS  # 1 s later
    watch.update(back, False)
    assert watch.moving(back)
    for hop in range(81, 95):
        watch.update(START_NS + hop * HOP_NS, False)
    assert not watch.moving(START_NS + 94 * HOP_NS)


def test_an_echo_that_reaches_far_back_does_not_silence_the_others() -> None:
    watch = SilenceWatch(0.7)
    for hop in range(60):
        watch.update(START_NS + hop * HOP_NS, True)
    watch.update(START_NS, True)
    assert watch.moving(START_NS + 60 * HOP_NS)


def test_a_leap_of_the_frame_is_no_way() -> None:
    """As when dead reckoning lays its track again: the way goes on from there."""
    way = WayHistory()
    for k in range(100):
        leapt = 1e5 if 40 <= k < 70 else 0.0
        way.add(START_NS + k * 10_000_000, (0.01 * k + leapt, -leapt))
    east, north = way.between(START_NS, START_NS + 990_000_000)
    assert east == pytest.approx(0.97, abs=1e-6), "but for the two steps in which it leapt"
    assert north == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("across", [0.0, 1e-4])
def test_a_wild_speed_without_sign_does_not_open_the_covariance(across: float) -> None:
    """Both of its signs are impossible; their mean, about 0, is not."""
    tracker = RoomEkf(RoomEkfSettings(), SENSORS, RoomStart(guess=(4.0, 4.0), error=0.3))
    south = SENSORS["south"].position
    for hop in range(40):
        stamp = START_NS + hop * HOP_NS
        tracker.heading(stamp, 0.0)
        tracker.echo("south", Echo(stamp_ns=stamp, valid=True, range_rate=across, signed=False))
    at = START_NS + 39 * HOP_NS
    before = tracker.estimate(at)
    tracker.echo("south", Echo(stamp_ns=at, valid=True, range_rate=300.0, signed=False))
    after = tracker.estimate(at)
    assert abs(before.position[0] - south[0]) < 8.0
    assert np.trace(after.covariance) <= np.trace(before.covariance)
    assert after.velocity == pytest.approx(before.velocity)
    assert tracker.discarded == 1


def test_the_antenna_takes_six_decibels_off_an_echo_at_sixty_degrees() -> None:
    assert pattern_loss(math.radians(60.0)) == pytest.approx(6.02, abs=0.01)
    assert pattern_loss(0.0) == 0.0
    x, y = np.array([3.0]), np.array([3.0 * math.sqrt(3.0)])
    expected = expected_strength(WEST, 2.0, x, y, np.hypot(x, y))
    assert expected[0] == pytest.approx(10.0 * math.log10(2.0 / 6.0**4) - 6.02, abs=0.01)


NODES = {"101": (-2.0, 2.0), "102": (2.0, 2.0), "104": (-2.0, -2.0), "106": (2.0, -2.0)}
TRIANGLE = np.array([(1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (1.0, -1.0)])


def leading_ranges(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times in ms and ranges in m (NaN: none) of the first strong return that moves, in a P4xx recording."""
    scans = loadmat(path, struct_as_record=False, squeeze_me=True)["scn"]
    axis = 299_792_458.0 / 2.0 * 1e-12 * np.linspace(scans[0].Tstrt, scans[0].Tstp, scans[0].Nscn, endpoint=False)
    analytic = hilbert(np.array([scan.scn for scan in scans], dtype=float), axis=1)
    background, ranges = analytic[:20].mean(axis=0), []
    for scan in analytic:
        moving = np.convolve(np.abs(scan - background), np.ones(9) / 9.0, mode="same")
        background += 0.05 * (scan - background)
        threshold = max(0.5 * moving.max(), 5.0 * np.median(moving))
        ranges.append(axis[np.argmax(moving > threshold)] if (moving > threshold).any() else math.nan)
    return np.array([scan.T for scan in scans]), np.array(ranges)


def test_a_real_person_on_a_triangle_is_followed_by_range() -> None:
    """Four static UWB radars; one range offset, common to all, is calibrated on the first 3 s at the known start."""
    if not P4XX.exists():
        pytest.skip("the recordings of four P4xx radars are not here")
    seen = {node: leading_ranges(P4XX / f"{node}_P1.mat") for node in NODES}
    begin = min(times[0] for times, _ in seen.values())
    at_start = [
        (ranges - math.dist(NODES[node], TRIANGLE[0]))[times < begin + 3000] for node, (times, ranges) in seen.items()
    ]
    offset = float(np.nanmedian(np.concatenate(at_start)))
    sensors = {node: StaticSensor(position=position, azimuth=0.0) for node, position in NODES.items()}
    settings = RoomEkfSettings(use_speed=False, range_error=0.15)
    tracker = RoomEkf(settings, sensors, RoomStart(guess=(1.0, -1.0), error=0.3))
    told = sorted(
        (int(t), node, r) for node, (times, ranges) in seen.items() for t, r in zip(times, ranges, strict=True)
    )
    track = []
    for at, node, measured in told:
        there = math.isfinite(measured)
        tracker.echo(node, Echo(stamp_ns=at * 1_000_000, valid=there, range=measured - offset if there else None))
        track.append(tracker.estimate(at * 1_000_000).position)
    assert np.median([distance_to_triangle(np.array(position)) for position in track]) < 0.15
    assert np.ptp(np.array(track), axis=0).min() > 1.5  # it does go round


def distance_to_triangle(point: np.ndarray) -> float:
    def to(a: np.ndarray, b: np.ndarray) -> float:
        along = float(np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0))
        return float(np.linalg.norm(point - a - along * (b - a)))

    return min(to(a, b) for a, b in itertools.pairwise(TRIANGLE))


def test_outside_of_the_area_a_particle_is_less_likely_with_the_square_of_the_distance() -> None:
    """An echo that says nothing else, so that what the edge does to the weights stands alone."""
    settings = RoomParticleSettings(use_speed=False, use_strength=False, edge_share=0.5)
    start = RoomStart(guess=(7.9, 0.1), error=1.0, area=AREA)
    tracker: Any = ParticleTracker(settings, SENSORS, start, np.random.default_rng(6))
    tracker.echo("south", Echo(stamp_ns=START_NS, valid=True, range_rate=0.5))
    x, y = tracker._particles.states[:2].astype(float)
    beyond = np.maximum.reduce([-x, x - 8.0, -y, y - 8.0, np.zeros_like(x)])
    assert (beyond > 0.5).sum() > 1000
    expected = np.exp(-0.5 * beyond**2)
    np.testing.assert_allclose(tracker._particles.weights, expected / expected.sum(), rtol=1e-4)
