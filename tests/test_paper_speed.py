"""The paper's speed: against ground of known speed, and where it must refuse."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from caneflow.algorithms.inertial.attitude_history import AttitudeHistory
from caneflow.algorithms.radar.footprint import CaneGeometry
from caneflow.algorithms.radar.moving_returns import (
    MovingReturnsFilter,
    MovingReturnsSettings,
    RadarParameters,
)
from caneflow.algorithms.radar.paper_speed import PaperSpeed, PaperSpeedSettings, SpeedEstimate
from caneflow.algorithms.radar.rest import RestSettings
from caneflow.algorithms.rotations import Quaternion, Vector, from_rotation_vector
from caneflow.physics import SPEED_OF_LIGHT

PARAMETERS = RadarParameters(scan_period=0.01, range_start=0.3, range_step=0.009149, carrier=4.3e9, bandwidth=1.7e9)
PERIOD = 10_000_000  # ns
HEIGHT, DOWN, APERTURE = 0.75, math.radians(42), math.radians(50)
GEOMETRY = CaneGeometry(hand_height=HEIGHT, aperture=APERTURE, pivot=(0.0, 0.0, 0.0))
HELD = from_rotation_vector((-DOWN, 0.0, 0.0))
DEFAULT = PaperSpeedSettings()
WALKING: Vector = (0.0, 0.0, 0.5)  # rad/s


@cache
def ground(speed: float, seed: int = 0, count: int = 96, snr_db: float = 15.0) -> np.ndarray:
    """Real scans (count, 288) int32 of flat ground that comes at `speed` m/s.

    Point scatterers of random strength on a plane, a Gaussian beam's two ways, power falling with range^4, a
    Gaussian pulse of 1.7 GHz (-10 dB), white noise. Nothing in it knows of rays, windows or edges.
    """
    rng = np.random.default_rng(seed)
    reach = speed * count * PARAMETERS.scan_period
    density = 120  # per m^2, some ten per cell of range and Doppler
    low, high = (-2.0, min(-1.0, reach - 1.0)), (2.0, max(3.5, reach + 3.5))
    x, y = rng.uniform(low, high, (round(density * 4 * (high[1] - low[1])), 2)).T
    strength = rng.normal(size=len(x))
    bins = np.arange(288)
    half = 14  # bins, three sigma of the pulse
    scans = np.zeros((count, 288))
    for k in range(count):
        ahead = y - speed * k * PARAMETERS.scan_period
        distance = np.sqrt(x * x + ahead * ahead + HEIGHT**2)
        off_axis = np.arccos((ahead * math.cos(DOWN) + HEIGHT * math.sin(DOWN)) / distance)
        amplitude = strength * np.exp(-4 * math.log(2) * (off_axis / APERTURE) ** 2) / distance**2
        at = np.rint((distance - PARAMETERS.range_start) / PARAMETERS.range_step).astype(int)
        near = at[:, None] + np.arange(-half, half + 1)
        away = PARAMETERS.range_start + near * PARAMETERS.range_step - distance[:, None]
        echo = np.exp(-0.5 * (away / 0.0426) ** 2) * np.cos(4 * math.pi * PARAMETERS.carrier / SPEED_OF_LIGHT * away)
        inside = (near >= 0) & (near < len(bins))
        scans[k] = np.bincount(near[inside], (amplitude[:, None] * echo)[inside], minlength=288)
    scans *= 1000 / scans[:, 90:110].std()
    noise = rng.normal(scale=1000 * 10 ** (-snr_db / 20), size=scans.shape)
    return np.rint(scans + noise).astype(np.int32)


def estimates(
    scans: np.ndarray,
    settings: PaperSpeedSettings = DEFAULT,
    *,
    gyro: Vector = WALKING,
    held: Quaternion = HELD,
    block: int = 1,
    kept: Callable[[int], bool] = lambda k: True,
    period: int = PERIOD,
) -> list[SpeedEstimate]:
    """One estimate per frame of `block` scans; a frame is lost unless `kept` says otherwise of its number."""
    returns = MovingReturnsFilter(MovingReturnsSettings())
    attitudes = AttitudeHistory()
    paper = PaperSpeed(settings, GEOMETRY)
    out = []
    for k in range(len(scans)):
        attitudes.add(k * period, held, gyro)
        if k % block == block - 1 and kept(k // block):
            frame = scans[k + 1 - block : k + 1]
            out.append(paper.update(returns.update(k * period, frame, PARAMETERS), attitudes))
    return out


def settled(out: list[SpeedEstimate], window: int = 64) -> np.ndarray:
    assert all(e.valid for e in out[window:])
    return np.array([e.speed for e in out[window:]])


@pytest.mark.parametrize("speed", [0.3, 0.6, 1.1])
def test_finds_the_speed_of_ground(speed: float) -> None:
    both = np.concatenate([settled(estimates(ground(speed, seed))) for seed in (0, 1)])
    assert both.mean() == pytest.approx(speed, rel=0.05)
    assert both.std() < 0.08


@pytest.mark.parametrize("window", [32, 64])
def test_without_compensation_the_edge_lies_0_8_cells_beyond(window: int) -> None:
    """cane.md row 6: 0.12 m/s over ground at N = 32, 0.06 at N = 64."""
    settings = PaperSpeedSettings(window=window)
    scans = ground(0.6)
    raw = settled(estimates(scans, replace(settings, compensate_edge=False)), window)
    compensated = settled(estimates(scans, settings), window)
    assert (raw - compensated).mean() == pytest.approx({32: 0.12, 64: 0.06}[window], abs=0.015)
    assert abs(compensated.mean() - 0.6) < abs(raw.mean() - 0.6)


@pytest.mark.parametrize("average", ["median", "weighted"])
def test_other_averages_agree(average: Any) -> None:
    got = settled(estimates(ground(0.6), replace(DEFAULT, average=average)))
    assert got.mean() == pytest.approx(0.6, rel=0.06)


def test_quality_is_the_spread_over_the_rays() -> None:
    clean = [e.quality for e in estimates(ground(0.6, snr_db=20))[64:]]
    noisy = [e.quality for e in estimates(ground(0.6, snr_db=-4))[64:]]
    assert 0 < np.mean(clean) < 0.12
    assert np.mean(noisy) > np.mean(clean)


def test_a_window_that_is_not_full_has_no_speed() -> None:
    out = estimates(ground(0.6))
    assert [e.valid for e in out] == [False] * 63 + [True] * 33
    for e in out[:63]:
        assert (e.speed, e.quality, e.rays) == (0.0, math.inf, 0)
    assert {round(e.delay, 9) for e in out} == {0.315}


def test_frames_of_many_scans_give_the_same_estimates() -> None:
    one, many = estimates(ground(0.6)), estimates(ground(0.6), block=8)
    assert [e.valid for e in many] == [e.valid for e in one[7::8]]
    assert [e.speed for e in many] == pytest.approx([e.speed for e in one[7::8]], abs=1e-3)


def test_the_same_frames_give_the_same_bits() -> None:
    assert estimates(ground(0.6)) == estimates(ground(0.6))


@pytest.mark.parametrize("speed", [1.9, 2.4, 3.0, 3.6])
def test_a_speed_beyond_the_limit_is_refused_not_wrapped(speed: float) -> None:
    """The limit c / (4 f T cos(alpha)) is 1.88 m/s for the shallowest ray, 2.35 m/s in the beam's middle."""
    assert not any(e.valid for e in estimates(ground(speed)))


@pytest.mark.parametrize("speed", [1.7, 1.8, 2.1, 2.3])
def test_near_the_limit_a_speed_is_refused_or_nearly_right(speed: float) -> None:
    for e in estimates(ground(speed)):
        assert not e.valid or e.speed > 0.85 * speed


def test_rays_that_see_only_noise_are_left_out() -> None:
    """Echoes fade with range^4: at -12 dB the far rays have none."""
    weak = estimates(ground(0.6, snr_db=-12))[64:]
    assert all(e.valid for e in weak)
    assert max(e.rays for e in weak) < 16
    assert np.mean([e.speed for e in weak]) == pytest.approx(0.6, rel=0.1)


def test_receding_ground_is_refused() -> None:
    assert not any(e.valid for e in estimates(ground(-0.5)))


def still(seed: int) -> np.ndarray:
    """Strong ground that stands, in noise."""
    rng = np.random.default_rng(seed)
    return np.rint(rng.normal(scale=9000, size=288) + rng.normal(scale=100, size=(96, 288))).astype(np.int32)


def test_rest_is_a_speed_of_zero_that_is_sure() -> None:
    for e in estimates(still(3), gyro=(0.01, 0.0, 0.0))[64:]:
        assert (e.speed, e.quality, e.valid, e.rays) == (0.0, 0.0, True, 16)


def test_noise_while_the_cane_turns_or_without_the_gate_is_no_speed() -> None:
    assert not any(e.valid for e in estimates(still(3), gyro=WALKING))
    gateless = replace(DEFAULT, rest=RestSettings(enabled=False))
    assert not any(e.valid for e in estimates(still(3), gateless, gyro=(0.0, 0.0, 0.0)))


def test_ground_that_moves_is_no_rest_even_without_turning() -> None:
    assert settled(estimates(ground(0.3), gyro=(0.0, 0.0, 0.0))).min() > 0.2


def test_some_lost_scans_do_no_harm() -> None:
    got = [e for e in estimates(ground(0.6, count=120), kept=lambda k: k % 9 != 4) if e.valid]
    assert len(got) > 40
    assert np.mean([e.speed for e in got]) == pytest.approx(0.6, rel=0.08)


def test_too_many_lost_scans_are_no_window() -> None:
    assert not any(e.valid for e in estimates(ground(0.6, count=120), kept=lambda k: k % 3 == 0))


def test_after_a_gap_the_window_fills_anew() -> None:
    scans = np.concatenate([ground(0.6), ground(0.6, seed=1)])
    out = estimates(scans, kept=lambda k: not 90 <= k < 110)
    # 90 frames before the gap, 63 more to fill the window after it.
    assert [e.valid for e in out] == [False] * 63 + [True] * 27 + [False] * 63 + [True] * 19


def test_without_an_attitude_there_is_no_speed() -> None:
    returns = MovingReturnsFilter(MovingReturnsSettings())
    paper = PaperSpeed(DEFAULT, GEOMETRY)
    nobody = AttitudeHistory()
    for k, scan in enumerate(ground(0.6)):
        e = paper.update(returns.update(k * PERIOD, scan[None, :], PARAMETERS), nobody)
        assert not e.valid
    assert e.delay == pytest.approx(0.315)


def test_the_scan_period_is_measured() -> None:
    """A radar that scans every 12 ms and says 10 sees the same ground 1.2 times slower."""
    as_told, measured = estimates(ground(0.6)), estimates(ground(0.6), period=12_000_000)
    assert [1.2 * e.speed for e in measured] == pytest.approx([e.speed for e in as_told], abs=1e-3)
    assert measured[-1].delay == pytest.approx(1.2 * as_told[-1].delay)


def test_a_beam_that_misses_the_ground_has_no_speed() -> None:
    up = from_rotation_vector((0.3, 0.0, 0.0))
    assert not any(e.valid for e in estimates(ground(0.6), held=up))


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (PaperSpeedSettings(window=64, transform=32), r"transform is 32; it is at least window, 64"),
        (PaperSpeedSettings(shallowest=1.2, steepest=1.0), r"shallowest is 1\.2 rad; it is less than"),
    ],
)
def test_settings_that_contradict_are_refused(settings: PaperSpeedSettings, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        PaperSpeed(settings, GEOMETRY)


def test_cost_of_a_frame(benchmark: Any) -> None:
    scans = ground(0.6)
    returns = MovingReturnsFilter(MovingReturnsSettings())
    attitudes = AttitudeHistory()
    paper = PaperSpeed(DEFAULT, GEOMETRY)
    k = 0

    def one_frame() -> SpeedEstimate:
        nonlocal k
        k += 1
        attitudes.add(k * PERIOD, HELD, WALKING)
        return paper.update(returns.update(k * PERIOD, scans[k % 96, None], PARAMETERS), attitudes)

    for _ in range(100):
        one_frame()
    assert isinstance(benchmark(one_frame), SpeedEstimate)
