"""The rest gate: what noise gives, what motion gives, and that neither depends on the noise's strength."""

import math

import numpy as np
import pytest

from caneflow.algorithms.radar.range_doppler import hann, range_doppler_map
from caneflow.algorithms.radar.rest import (
    STANDING_CELLS,
    RestSettings,
    ground_stands,
    is_at_rest,
    median,
    peaks_and_floor,
)

SETTINGS = RestSettings()
STILL = 0.01  # rad/s


def spectrum(scans: np.ndarray) -> np.ndarray:
    """As the front end makes it: slow-time power in sum over the range rows; `scans` is (rows, 64)."""
    return np.asarray((np.abs(range_doppler_map(scans, hann(64), 256)) ** 2).sum(axis=0))


def peak_and_floor(scans: np.ndarray) -> tuple[float, float]:
    approaching, receding, floor = peaks_and_floor(spectrum(scans), 4)
    return max(approaching, receding), floor


def noise(rng: np.random.Generator, sd: float = 1.0) -> np.ndarray:
    return np.asarray(sd * (rng.normal(size=(18, 64)) + 1j * rng.normal(size=(18, 64))))


def ground(rng: np.random.Generator, speed: float, snr_db: float) -> np.ndarray:
    """Lines of random strength below `speed` (m/s, radial), in unit noise."""
    lines = speed * np.cos(rng.uniform(-0.6, 0.6, 40))
    phases = 4 * math.pi * 4.3e9 / 299_792_458 * lines[:, None] * np.arange(64) * 0.01
    weights = rng.normal(size=(18, 40)) + 1j * rng.normal(size=(18, 40))
    echoes = weights @ np.exp(1j * phases)
    return np.asarray(echoes / np.abs(echoes).std() * 10 ** (snr_db / 20) + noise(rng))


@pytest.mark.parametrize("sd", [1e-2, 1.0, 1e4])
def test_in_noise_of_any_strength_nothing_moves(sd: float) -> None:
    rng = np.random.default_rng(11)
    ratios = []
    for _ in range(300):
        peak, floor = peak_and_floor(noise(rng, sd))
        ratios.append(peak / floor)
        assert is_at_rest(peak, floor, STILL, SETTINGS)
    assert np.median(ratios) == pytest.approx(2.0, abs=0.2), "the number in the settings' comment"
    assert max(ratios) < 0.75 * SETTINGS.largest_peak


@pytest.mark.parametrize("snr_db", [0, 5, 15])
@pytest.mark.parametrize("speed", [0.2, 0.5, 1.2])
def test_ground_that_moves_is_no_rest_even_at_0_db(speed: float, snr_db: float) -> None:
    rng = np.random.default_rng(12)
    for _ in range(50):
        peak, floor = peak_and_floor(ground(rng, speed, snr_db))
        assert not is_at_rest(peak, floor, STILL, SETTINGS)


def test_a_floor_is_found_under_ground_that_fills_half_the_axis() -> None:
    rng = np.random.default_rng(13)
    floors = [peak_and_floor(ground(rng, 1.7, 20))[1] for _ in range(20)]
    quiet = [peak_and_floor(noise(rng))[1] for _ in range(20)]
    assert np.median(floors) < 2 * np.median(quiet)


def test_the_sides_of_the_spectrum_are_told_apart() -> None:
    rng = np.random.default_rng(15)
    coming = ground(rng, 0.8, 15)
    approaching, receding, floor = peaks_and_floor(spectrum(coming), 4)
    assert approaching > 50 * floor > 10 * receding
    mirrored = peaks_and_floor(spectrum(coming.conj()), 4)
    assert mirrored == pytest.approx((receding, approaching, floor), rel=1e-4)


def test_what_stands_or_drifts_by_less_than_a_cell_is_rest() -> None:
    rng = np.random.default_rng(14)
    for drift in (0.0, 0.02):  # m/s; a cell is 0.054
        peak, floor = peak_and_floor(ground(rng, drift, 15))
        assert is_at_rest(peak, floor, STILL, SETTINGS)


def test_turning_is_no_rest_and_the_gate_can_be_left_open() -> None:
    assert is_at_rest(2.0, 1.0, math.radians(2), SETTINGS), "a gyro's bias"
    assert not is_at_rest(2.0, 1.0, math.radians(8), SETTINGS)
    assert not is_at_rest(2.0, 1.0, STILL, RestSettings(enabled=False))


def test_ground_stands_where_half_of_the_cells_show_it() -> None:
    tip, ground = np.zeros(16), np.zeros(16)
    tip[7:10] = 1e6  # the cane's own
    ground[::2] = ground[1] = 0.2
    assert not ground_stands(tip, 1.0, 0.01, 0.05)
    assert ground_stands(ground, 1.0, 0.01, 0.05)
    assert not ground_stands(ground, 10.0, 0.01, 0.05), "what is left of a scan hides it"
    assert not ground_stands(ground, 1.0, 0.1, 0.05), "a mean over few scans has noise of its own"


def test_without_any_noise_there_is_no_radar() -> None:
    assert not ground_stands(np.ones(16), 0.0, 0.01, 0.05)
    assert not ground_stands(np.zeros(16), 0.0, 0.01, 0.05)


def test_noise_alone_hardly_ever_passes_for_ground_that_stands() -> None:
    """The mean over 0.5 s at 100 Hz has a hundredth of the noise; cells are neighbours, two independent in three."""
    rng = np.random.default_rng(14)
    taken = 0
    for _ in range(2000):
        picture = np.repeat(0.01 * rng.exponential(size=6), 3)
        taken += ground_stands(picture, 1.0, 0.01, SETTINGS.least_standing)
    assert taken == 0


@pytest.mark.parametrize("cell", [1.0, 2.0, 3.5])
def test_what_is_slower_than_the_standing_cells_is_on_neither_side(cell: float) -> None:
    """A line in each bin of a spectrum in turn: the bins from -(standing - 1) to standing - 1 stand, for both sides."""
    length, standing = 64, math.ceil(STANDING_CELLS * cell)
    for at in range(length):
        power = np.zeros(length)
        power[at] = 1.0
        signed = at if at < length // 2 else at - length
        approaching, receding, floor = peaks_and_floor(power, cell)
        assert (approaching, receding, floor) == (float(signed >= standing), float(signed <= -standing), 0.0), signed


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 17, 18, 64])
def test_the_median_is_numpys_to_the_last_bit(kind: type[np.floating], count: int) -> None:
    rng = np.random.default_rng(count)
    for _ in range(100):
        values = rng.lognormal(sigma=5.0, size=count).astype(kind)
        assert median(values) == float(np.median(values))
    values[-1] = math.nan
    assert math.isnan(median(values))
