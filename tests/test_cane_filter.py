"""`best` on made-up walks: conventions, delays, rest, gaps, loss of inputs, and whether its covariance is honest."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from caneflow.algorithms.cane.cane_filter import CaneFilter, CaneFilterSettings, level_covariance
from caneflow.algorithms.cane.dead_reckoning import PoseEstimate
from caneflow.algorithms.cane.heading_hypotheses import Heading
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.rotations import (
    Quaternion,
    Vector,
    conjugate,
    from_rotation_vector,
    from_yaw,
    multiply,
    rotate,
)

Floats = NDArray[np.float64]
START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 10_000_000
BORESIGHT: Vector = (0.0, 1.0, 0.0)
PIVOT: Vector = (0.0, -0.3, 0.0)
PITCH = math.radians(42)
GRAVITY = 9.80665
UNOBSERVED = 1e6
DEGREE = math.pi / 180.0


def held(yaw: float) -> Quaternion:
    """The cane pitched by 42 deg, its boresight at `yaw`."""
    return multiply(from_yaw(yaw - math.pi / 2), from_rotation_vector((-PITCH, 0.0, 0.0)))


@dataclass(frozen=True, kw_only=True)
class Walk:
    """A walk at 100 Hz: yaws (rad) of boresight and velocity, speeds (m/s) along it; the gyro's bias (rad/s)."""

    yaws: Floats
    headings: Floats  # rad, of the way
    speeds: Floats  # m/s along the way
    gyro_bias: float = 0.0  # about the vertical and, as a bad gyro has it, about the level axes of the body
    north: Floats | None = None  # rad, by which the field errs
    noise: float = 0.0  # m/s, sd of the radar
    alike: float = 0.0  # correlation of neighbouring errors of the radar
    seed: int = 0
    truth: Floats = field(init=False)  # (n, 2) m

    def __post_init__(self) -> None:
        moved = self.speeds[:, None] * np.stack([np.cos(self.headings), np.sin(self.headings)], axis=1) * 0.01
        object.__setattr__(self, "truth", np.cumsum(moved, axis=0) - moved[0])


def run(
    walk: Walk,
    *,
    settings: CaneFilterSettings | None = None,
    delay: int = 0,
    speeds_only: bool = False,
    mag: bool = True,
    speed_first: bool = False,
    dropped: slice = slice(0, 0),
    watch: Callable[[CaneFilter], None] = lambda cane: None,
) -> tuple[CaneFilter, list[PoseEstimate]]:
    """The filter's estimates; radar values belong `delay` samples before their stamps; samples `dropped` are lost."""
    cane = CaneFilter(settings or CaneFilterSettings(), boresight=BORESIGHT, pivot=PIVOT)
    rng = np.random.default_rng(walk.seed)
    velocity = walk.speeds[:, None] * np.stack([np.cos(walk.headings), np.sin(walk.headings)], axis=1)
    force = np.gradient(velocity, 0.01, axis=0)
    rates = np.gradient(np.unwrap(walk.yaws), 0.01)
    bias = rotate(conjugate(held(0.0)), (walk.gyro_bias, walk.gyro_bias, walk.gyro_bias))
    lost = set(range(len(walk.yaws))[dropped])
    estimates, error = [], 0.0
    for index, yaw in enumerate(walk.yaws.tolist()):
        if index in lost:
            continue
        stamp_ns = START_NS + index * PERIOD_NS
        back = max(index - delay, 0)
        error = walk.alike * error + math.sqrt(1.0 - walk.alike**2) * float(rng.normal())
        seen = velocity[back] @ (math.cos(walk.yaws[back]), math.sin(walk.yaws[back])) + walk.noise * error

        def radar(stamp_ns: int = stamp_ns, seen: float = float(seen)) -> None:
            if speeds_only:
                cane.speed(stamp_ns, seen, 0.05, True, 0.01 * delay)
            else:
                variance = max(walk.noise, 0.03) ** 2
                cane.velocity(stamp_ns, (seen, 0.0), (variance, 0.0, UNOBSERVED), 0.01 * delay)

        body = held(yaw)
        inverse = conjugate(body)
        turning = rotate(inverse, (0.0, 0.0, float(rates[index])))
        gyro = (turning[0] + bias[0], turning[1] + bias[1], turning[2] + bias[2])
        accel = rotate(inverse, (float(force[index, 0]), float(force[index, 1]), GRAVITY))
        north = 0.0 if walk.north is None else float(walk.north[index])
        if speed_first:
            radar()
        field = rotate(inverse, (-20.0 * math.sin(north), 20.0 * math.cos(north), -40.0)) if mag else None
        estimates.append(cane.imu(stamp_ns, ImuReading(gyro, accel, field, orientation=body)))
        watch(cane)
        if not speed_first:
            radar()
    return cane, estimates


def loop(length: float = 3.0, **more: float | int | Floats) -> Walk:
    """Once round `length` x 3 m at 0.45 m/s, 2 s of rest at both ends, swinging by 20 deg at 0.55 Hz."""
    headings, speeds = [np.zeros(200)], [np.zeros(200)]
    for side, way_long in enumerate((length, 3.0, length, 3.0)):
        count = round(way_long / 0.0045)
        headings.append(np.full(count, side * math.pi / 2))
        speeds.append(np.full(count, 0.45))
        if side < 3:
            headings.append((side + np.linspace(0.0, 1.0, 150)) * math.pi / 2)
            speeds.append(np.full(150, 1e-3))
    headings.append(np.full(200, 1.5 * math.pi))
    speeds.append(np.zeros(200))
    way = np.concatenate(headings)
    speed = np.convolve(np.concatenate(speeds), np.hanning(61) / np.hanning(61).sum(), mode="same")
    swinging = 20 * DEGREE * np.sin(2 * math.pi * 0.55 * 0.01 * np.arange(len(way))) * np.minimum(speed / 0.45, 1.0)
    return Walk(yaws=way + swinging, headings=way, speeds=speed, **more)  # type: ignore[arg-type]


def final_error(walk: Walk, estimates: list[PoseEstimate]) -> float:
    x, y, _ = estimates[-1].position
    return math.hypot(x - walk.truth[-1, 0], y - walk.truth[-1, 1])


def test_an_open_path_along_y_goes_along_y() -> None:
    """A quarter turn too much or too little would not show on a loop."""
    way = np.full(1000, math.pi / 2)
    walk = Walk(yaws=way, headings=way, speeds=np.full(1000, 0.5))
    _, estimates = run(walk)
    x, y, _ = estimates[-1].position
    assert (x, y) == pytest.approx((0.0, 4.995), abs=0.06)
    assert estimates[-1].velocity[:2] == pytest.approx((0.0, 0.5), abs=0.02)
    assert estimates[-1].orientation == pytest.approx(held(math.pi / 2), abs=1e-6)


@pytest.mark.parametrize("delay", [0, 32])
def test_a_swinging_loop_with_late_radar_comes_back(delay: int) -> None:
    walk = loop()
    _, estimates = run(walk, delay=delay)
    assert final_error(walk, estimates) < 0.12
    track = np.array([e.position[:2] for e in estimates])
    assert np.abs(track - walk.truth).max() < 0.25


def test_the_radar_sees_a_component_only_and_the_swing_shows_the_rest() -> None:
    """The cane points 10 deg off the way all the time: taken for the heading, that would be 1.7 m in 10 m."""
    time = 0.01 * np.arange(2400)
    way = np.zeros(2400)
    yaws = 10 * DEGREE + 20 * DEGREE * np.sin(2 * math.pi * 0.55 * time)
    speeds = 0.45 * np.minimum(time / 1.0, 1.0)
    _, estimates = run(Walk(yaws=yaws, headings=way, speeds=speeds))
    assert abs(estimates[-1].position[1]) < 0.5


def test_standing_the_position_stays() -> None:
    still = np.zeros(3000)
    _, estimates = run(Walk(yaws=still, headings=still, speeds=still, noise=0.05))
    assert math.hypot(*estimates[-1].position[:2]) < 0.05
    assert math.hypot(*estimates[-1].velocity[:2]) < 0.01


def test_the_paper_speed_serves_where_nothing_better_comes() -> None:
    walk = loop()
    _, estimates = run(walk, speeds_only=True, delay=32)
    assert final_error(walk, estimates) < 0.5


def test_the_field_where_the_walk_began_shows_the_gyros_bias() -> None:
    x, y = loop(8.0).truth.T
    north = 10 * DEGREE * (np.sin(x / 2.0 + 1.0) + np.cos(y / 2.0 - x / 3.0) - 1.2)
    walk = loop(8.0, gyro_bias=0.15 * DEGREE, north=north)
    cane, estimates = run(walk)
    assert cane.gyro_bias == pytest.approx(0.15 * DEGREE, abs=0.06 * DEGREE)
    assert final_error(walk, estimates) < 0.3


def test_a_heading_that_cannot_be_known_shows_in_the_covariance() -> None:
    """The field wanders by 15 deg and is not a map: nothing holds a gyro of 0.3 deg/s."""
    wander = np.cumsum(np.random.default_rng(1).normal(0.0, 0.0035, len(loop(8.0).yaws)))
    walk = loop(8.0, gyro_bias=0.3 * DEGREE, north=wander)
    _, estimates = run(walk)
    covariance = estimates[-1].covariance
    assert covariance is not None
    spread = math.sqrt(np.trace(covariance[:2, :2]))
    assert spread > 0.3
    assert final_error(walk, estimates) < 3.0 * spread


def test_the_final_error_is_of_the_size_that_the_covariance_says() -> None:
    """Loops with gyro biases of sd 0.1 deg/s in rooms with 14 deg of field errors; the radar errs alike for 0.1 s.

    The long test in test_cane_filter_walks.py does it on simulated radar, which is less kind.
    """
    squares = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        waves, phases = rng.normal(0.0, 1 / 1.8, (4, 2)), rng.uniform(0.0, 2 * math.pi, 4)
        north = 14 * DEGREE * math.sqrt(0.5) * np.sin(loop().truth @ waves.T + phases).sum(axis=1)
        walk = loop(
            gyro_bias=rng.normal(0.0, 0.1) * DEGREE, north=north - north[0], noise=0.05, alike=9 / 11, seed=seed
        )
        _, estimates = run(walk)
        covariance = estimates[-1].covariance
        assert covariance is not None
        error = np.array(estimates[-1].position[:2]) - walk.truth[-1]
        squares.append(float(error @ np.linalg.solve(covariance[:2, :2], error)))
    assert 0.3 < np.mean(squares) < 3.5  # chi-square of 8 degrees of freedom over 4: 0.54 to 4.4, 19 times in 20
    assert max(squares) < 9.2


def test_a_correction_is_followed_without_a_jump() -> None:
    """Each radar velocity moves the position by up to a millimetre; taken at once, that makes the track longer."""
    walk = loop(noise=0.1)
    excess = []
    for time in (0.3, 1e-6):
        _, estimates = run(walk, settings=CaneFilterSettings(correction_time=time))
        assert final_error(walk, estimates) < 0.5
        track = np.array([e.position[:2] for e in estimates])
        excess.append(float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum()) - float(walk.speeds.sum() * 0.01))
    assert 0.0 < excess[0] < 0.5 * excess[1]


def test_velocities_that_come_more_often_are_worth_less_each() -> None:
    """What is published at 20 or at 100 Hz says the same of the position's variance, to a third."""
    way = np.zeros(1000)
    walk = Walk(yaws=way, headings=way, speeds=np.full(1000, 0.5), noise=0.05)
    spreads = []
    for every in (1, 5):
        cane = CaneFilter(CaneFilterSettings(), boresight=BORESIGHT, pivot=PIVOT)
        for index in range(len(walk.yaws)):
            stamp_ns = START_NS + index * PERIOD_NS
            accel = rotate(conjugate(held(0.0)), (0.0, 0.0, GRAVITY))
            estimate = cane.imu(stamp_ns, ImuReading((0.0, 0.0, 0.0), accel, orientation=held(0.0)))
            if index % every == 0:
                cane.velocity(stamp_ns, (0.5, 0.0), (0.0025, 0.0, UNOBSERVED), 0.025)
        assert estimate.covariance is not None
        spreads.append(math.sqrt(estimate.covariance[3, 3]))
    assert spreads[0] == pytest.approx(spreads[1], rel=0.33)


def test_the_covariance_is_a_covariance() -> None:
    _, estimates = run(loop(noise=0.05))
    for estimate in estimates[::50]:
        assert estimate.covariance is not None
        np.testing.assert_allclose(estimate.covariance, estimate.covariance.T, atol=1e-12)
        assert np.linalg.eigvalsh(estimate.covariance).min() > -1e-9
    first, last = estimates[0].covariance, estimates[-1].covariance
    assert first is not None
    assert last is not None
    assert np.trace(first[:2, :2]) < 1e-6 < np.trace(last[:2, :2])


def test_a_gap_is_counted_and_bridged() -> None:
    way = np.zeros(1500)
    walk = Walk(yaws=way, headings=way, speeds=np.full(1500, 0.5))
    cane, estimates = run(walk, dropped=slice(700, 900))
    assert cane.gaps == 1
    assert estimates[-1].position[0] == pytest.approx(7.5, abs=0.3)
    before, after = estimates[699].covariance, estimates[700].covariance
    assert before is not None
    assert after is not None
    assert after[0, 0] > 50 * before[0, 0]


def test_the_order_of_delivery_of_one_stamp_does_not_matter() -> None:
    walk = loop(noise=0.05)
    _, after = run(walk)
    _, before = run(walk, speed_first=True)
    assert [e.position for e in after] == [e.position for e in before]


def test_what_is_missing_is_named() -> None:
    cane = CaneFilter(CaneFilterSettings(), boresight=BORESIGHT)
    with pytest.raises(ValueError, match="best: the imu sample has no orientation"):
        cane.imu(START_NS, ImuReading((0.0, 0.0, 0.0), (0.0, 0.0, GRAVITY)))
    with pytest.raises(ValueError, match="neither linear_accel nor accel"):
        cane.imu(START_NS, ImuReading((0.0, 0.0, 0.0), orientation=held(0.0)))


def test_covariance_is_turned_and_takes_in_heading_and_scale() -> None:
    """Against the sum of its parts: what the filter has, turned; what turns and what stretches the track."""
    root = np.random.default_rng(8).normal(size=(4, 4))
    motion, yaw, scale = root @ root.T, 0.7, 0.02
    heading = Heading(position=3 - 2j, yaw=yaw, yaw_variance=0.01, xx=0.5, xy=-0.1, yy=0.3)
    velocity = 0.8 + 0.3j
    got = level_covariance(motion, heading, complex(math.cos(yaw), math.sin(yaw)), velocity, scale)
    rotation = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    expected = np.kron(np.eye(2), rotation) @ motion @ np.kron(np.eye(2), rotation).T
    expected[:2, :2] += np.array([[0.5, -0.1], [-0.1, 0.3]]) + scale**2 * np.outer([3, -2], [3, -2])
    expected[2:, 2:] += 0.01 * np.outer([-0.3, 0.8], [-0.3, 0.8])
    level = [0, 1, 3, 4]
    assert got[np.ix_(level, level)] == pytest.approx(expected)
    assert not got[[2, 5]].any() and not got[:, [2, 5]].any()


def test_a_filter_that_disagrees_with_the_radar_for_a_second_believes_it_again() -> None:
    """A velocity that is wrong by 20 m/s, with a covariance of nothing: after 1.5 s it is right."""
    cane = CaneFilter(CaneFilterSettings(), boresight=BORESIGHT, pivot=PIVOT)
    rng = np.random.default_rng(5)
    body, at_rest = held(0.0), rotate(conjugate(held(0.0)), (0.0, 0.0, GRAVITY))
    for index in range(1000):
        stamp_ns = START_NS + index * PERIOD_NS
        if index == 400:
            before = cane.imu(stamp_ns, ImuReading((0.0, 0.0, 0.0), at_rest, orientation=body))
            cane._motion._x[2] = 20.0
            cane._motion._p[2:4, :] = cane._motion._p[:, 2:4] = 0.0
            continue
        estimate = cane.imu(stamp_ns, ImuReading((0.0, 0.0, 0.0), at_rest, orientation=body))
        if index % 5 == 0:
            cane.velocity(stamp_ns, (0.5 + 0.03 * rng.normal(), 0.0), (0.0009, 0.0, UNOBSERVED), 0.0)
        if index == 550:
            assert estimate.velocity[0] == pytest.approx(0.5, abs=0.1)
    moved = estimate.position[0] - before.position[0]
    assert moved == pytest.approx(0.5 * 6.0, abs=2.0), "most of the 20 m that it went wrong are taken back as well"


def test_a_stated_error_of_nothing_is_not_believed() -> None:
    """A velocity counts as no better than any radar's: no covariance of 0 comes of one that says 0."""
    body, force = held(0.0), rotate(conjugate(held(0.0)), (0.0, 0.0, GRAVITY))
    cane = CaneFilter(CaneFilterSettings(), boresight=BORESIGHT, pivot=PIVOT)
    for index in range(60):
        if index % 5 == 0:
            cane.velocity(START_NS + index * PERIOD_NS, (0.0, 0.0), (0.0, 0.0, 0.0), 0.0)
        estimate = cane.imu(START_NS + index * PERIOD_NS, ImuReading((0.0, 0.0, 0.0), force, orientation=body))
    assert estimate.covariance is not None
    assert 0.004**2 < estimate.covariance[3, 3] < 0.02**2


def test_a_radar_that_moves_sideways_is_believed_less() -> None:
    """Beside a first velocity all else is vague, so its variance is the filter's: stated, twice, and the sideways."""
    variances = []
    for reach, rate in ((0.0, 2.0), (1.0, 2.0)):  # m from the IMU to the antenna, rad/s: no and 1.5 m/s to the side
        settings = CaneFilterSettings(velocity_correlation=0.1, sideways_share=0.14)
        cane = CaneFilter(settings, boresight=BORESIGHT, pivot=PIVOT, antenna=(0.0, reach, 0.0))
        for index in range(12):
            orientation = held(rate * 0.01 * index)
            inverse = conjugate(orientation)
            stamp_ns = START_NS + index * PERIOD_NS
            reading = ImuReading(
                rotate(inverse, (0.0, 0.0, rate)), rotate(inverse, (0.0, 0.0, GRAVITY)), orientation=orientation
            )
            estimate = cane.imu(stamp_ns, reading)
            if index in (5, 10):  # the first one after a silence is not believed yet
                cane.velocity(stamp_ns, (0.0, 0.0001), (0.04, 0.0, UNOBSERVED), 0.0)
        assert estimate.covariance is not None
        ahead = np.array([math.cos(rate * 0.11), math.sin(rate * 0.11)])
        variance = float(ahead @ estimate.covariance[3:5, 3:5] @ ahead)
        variances.append(1.0 / (1.0 / variance - 1.0))
    assert variances[0] == pytest.approx(0.08, rel=0.05)
    assert variances[1] == pytest.approx(0.08 + (0.14 * 2.0 * math.cos(PITCH)) ** 2, rel=0.05)


def test_the_local_pose_never_leaps_and_its_covariance_grows_as_the_way_does() -> None:
    """When the field shows the gyro's bias, the track is laid again; a map of the last seconds must not notice."""
    walk = loop(gyro_bias=0.3 * DEGREE, noise=0.05, alike=9 / 11)
    locals_: list[PoseEstimate] = []
    _, estimates = run(walk, watch=lambda cane: locals_.append(cane.local()))

    def largest_leap(poses: list[PoseEstimate]) -> float:
        places = np.array([pose.position[:2] for pose in poses])
        speeds = np.array([pose.velocity[:2] for pose in poses])
        return float(np.linalg.norm(np.diff(places, axis=0) - 0.01 * speeds[1:], axis=1).max())

    assert largest_leap(locals_) < 0.006  # what the radar corrects in 10 ms, spread over 0.3 s
    assert largest_leap(estimates) > 0.02
    # the way of the last seconds, in the heading at its start, is as far off as the covariance has grown
    squares, grown = [], []
    for start in range(400, len(locals_) - 500, 100):
        first, last = locals_[start], locals_[start + 500]
        assert first.covariance is not None
        assert last.covariance is not None
        ahead = rotate(first.orientation, BORESIGHT)
        off = math.atan2(ahead[1], ahead[0]) - walk.yaws[start]
        way = np.array(last.position[:2]) - np.array(first.position[:2])
        turn = np.array([[math.cos(off), -math.sin(off)], [math.sin(off), math.cos(off)]])
        error = way - turn @ (walk.truth[start + 500] - walk.truth[start])
        growth = last.covariance[:2, :2] - first.covariance[:2, :2]
        assert np.linalg.eigvalsh(growth).min() > 0.0
        squares.append(float(error @ error))
        grown.append(float(np.trace(growth)))
    assert 0.5 < math.sqrt(np.mean(squares) / np.mean(grown)) < 1.8
