"""The simulated Doppler module against the Doppler formula, the radar equation and its own specification."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.typing import NDArray

from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.doppler_module import (
    REAL_AMPLIFIER,
    Kind,
    Module,
    ModuleSettings,
    Mounting,
    Wall,
    echo,
    module,
    noise,
    pattern,
    receive,
    white_density,
)
from caneflow.simulation.room_course import RATE

SETTINGS = ModuleSettings()
QUIET = ModuleSettings(detection_range=1e4, hum=-200.0)  # the noise is set by the range; hum is set by the noise
PERFECT = Module(1.0, 1.0, 0j, 0.0, 0.0, 1.0, 0.0)
WEST = Mounting(np.array([0.0, 0.0, 1.2]), 0.0)  # looks along x
SAMPLE_RATE = 4000


def straight_at(speed: float, start: float = 5.0, seconds: float = 1.0) -> Floats:
    """One point on the axis of WEST that goes away from it at `speed`: (1, n, 3) m."""
    time = np.arange(round(seconds * RATE)) / RATE
    points: Floats = np.stack([start + speed * time, np.zeros_like(time), np.full_like(time, 1.2)], axis=-1)
    return points[None]


def echo_of(points: Floats, walls: tuple[Wall, ...] = (), settings: ModuleSettings = SETTINGS) -> NDArray[np.complex64]:
    return echo(points, np.ones(points.shape[:2]), WEST, walls, settings)


def peak(samples: NDArray[np.complex64] | NDArray[np.int16]) -> float:
    """Frequency of the strongest line, Hz, by a parabola through the logarithms of three bins of a Hann window."""
    spectrum = np.abs(np.fft.fft(samples * np.hanning(len(samples))))
    spectrum[0] = 0.0
    top = int(np.argmax(spectrum))
    below, at, above = np.log(spectrum[[top - 1, top, (top + 1) % len(spectrum)]])
    place = top + 0.5 * (below - above) / (below - 2.0 * at + above)
    return float((place + len(samples) / 2) % len(samples) - len(samples) / 2) * SAMPLE_RATE / len(samples)


@pytest.mark.parametrize("speed", [-1.5, -0.5, 0.4, 1.0, 1.5])
def test_doppler_is_161_hz_per_metre_per_second_and_positive_when_approaching(speed: float) -> None:
    echoes = echo_of(straight_at(speed), settings=QUIET)
    heard = receive(echoes, PERFECT, "iq", QUIET, default_rng(0))
    assert heard.dtype == np.complex64
    assert peak(heard) == pytest.approx(-160.9 * speed, abs=0.3)
    one_mixer = receive(echoes, PERFECT, "real", QUIET, default_rng(0))
    assert abs(peak(one_mixer)) == pytest.approx(160.9 * abs(speed), abs=0.5)


def test_power_falls_as_the_fourth_power_of_the_range() -> None:
    ranges = np.array([1.0, 2.0, 4.0, 8.0])
    power = [np.abs(echo_of(straight_at(0.0, start, 0.1))[0]) ** 2 for start in ranges]
    assert power * ranges**4 == pytest.approx(SETTINGS.gain**2, rel=1e-5)


def test_the_echo_is_proportional_to_the_square_root_of_the_cross_section() -> None:
    points = straight_at(0.0, 3.0, 0.1)
    small, large = (echo(points, np.full(points.shape[:2], a), WEST, (), SETTINGS)[0] for a in (0.1, 0.3))
    assert large / small == pytest.approx(3.0, rel=1e-5)


def test_paths_between_the_given_instants_are_exact_to_a_thousandth_of_a_turn() -> None:
    def place(time: Floats) -> Floats:
        x = 4.0 + 1.2 * time + 0.25 * np.sin(2.0 * np.pi * 2.0 * time) + 0.03 * np.sin(2.0 * np.pi * 8.0 * time)
        return np.stack([x, 0.3 * np.cos(3.0 * time), np.full_like(time, 0.4)], axis=-1)

    fine = np.arange(2 * SAMPLE_RATE) / SAMPLE_RATE
    got = echo_of(place(fine[:: SAMPLE_RATE // RATE])[None])
    offset = place(fine) - WEST.position
    distance = np.linalg.norm(offset, axis=1)
    expected = np.exp(-4.0j * np.pi * distance / SETTINGS.wavelength)
    inside = slice(200, -200)  # at both ends a recording is at rest, which this point is not
    assert np.abs(np.angle(got / expected)[inside]).max() < 2.0 * np.pi / 1000.0
    size = SETTINGS.gain * pattern(offset, WEST, SETTINGS) ** 2 / distance**2
    assert np.abs(got)[inside] == pytest.approx(size[inside], rel=2e-3)


def test_the_antenna_is_down_by_3_db_one_way_at_60_deg() -> None:
    def gain(azimuth: float, elevation: float = 0.0) -> float:
        level = np.cos(elevation)
        direction = np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)])
        return float(pattern(5.0 * direction, WEST, SETTINGS))

    assert gain(0.0) == 1.0
    for side in (-1.0, 1.0):
        assert 20.0 * np.log10(gain(side * 60.0 * DEGREE)) == pytest.approx(-3.01, abs=0.01)
        assert 20.0 * np.log10(gain(0.0, side * 17.0 * DEGREE)) == pytest.approx(-3.01, abs=0.01)
    assert gain(np.pi) < 0.1
    # so in the echo, which goes there and back, 6 dB
    aside = 5.0 * np.array([np.cos(60.0 * DEGREE), np.sin(60.0 * DEGREE), 0.0]) + WEST.position
    ahead = 5.0 * np.array([1.0, 0.0, 0.0]) + WEST.position
    power = [np.abs(echo_of(np.tile(at, (1, 20, 1)))[0]) ** 2 for at in (aside, ahead)]
    assert 10.0 * np.log10(power[0] / power[1]) == pytest.approx(-6.02, abs=0.02)


def test_reflections_are_the_square_of_the_sum_of_all_ways_to_a_point() -> None:
    walls = (Wall(2, 0.0, -0.3), Wall(1, 4.0, -0.4))
    point = np.array([5.0, 1.0, 1.0])
    got = echo_of(np.tile(point, (1, 10, 1)), walls)[0]
    one_way = 0.0j
    for image, reflection in ((point, 1.0), (point * [1, 1, -1], -0.3), (np.array([5.0, 7.0, 1.0]), -0.4)):
        offset = image - WEST.position
        length = np.linalg.norm(offset)
        strength = float(pattern(offset, WEST, SETTINGS)) * reflection / length
        one_way += strength * np.exp(-2.0j * np.pi * length / SETTINGS.wavelength)
    assert got == pytest.approx(SETTINGS.gain * one_way**2, rel=1e-4)


def test_a_wall_behind_a_walker_adds_the_image_that_comes_towards_the_module() -> None:
    moving = straight_at(1.0, 4.0)
    spectrum = np.abs(np.fft.fft(echo_of(moving, (Wall(0, 9.0, -0.5),)) * np.hanning(SAMPLE_RATE)))
    frequency = np.fft.fftfreq(SAMPLE_RATE, 1.0 / SAMPLE_RATE)
    away = spectrum[np.abs(frequency + 161.0) < 4.0].max()
    towards = spectrum[np.abs(frequency - 161.0) < 4.0].max()
    # path and strength of the image, in the middle of the walk: (9 + 4.5) m against 4.5 m, twice 0.5
    assert towards / away == pytest.approx((0.5 * 4.5 / 13.5) ** 2, rel=0.15)


@pytest.mark.parametrize("kind", ["real", "iq"])
def test_the_band_is_5_to_900_hz(kind: Kind) -> None:
    time = np.arange(4 * SAMPLE_RATE) / SAMPLE_RATE

    def passed(frequency: float) -> float:
        tone = (0.5 * np.exp(2.0j * np.pi * frequency * time)).astype(np.complex64)
        heard = np.asarray(receive(tone, PERFECT, kind, QUIET, default_rng(0)), dtype=np.complex128)
        full = 32768.0 if kind == "real" else 1.0
        line = np.abs(np.mean(heard[SAMPLE_RATE:] * np.exp(-2.0j * np.pi * frequency * time[SAMPLE_RATE:]))) / full
        return float(20.0 * np.log10(line / (0.25 if kind == "real" else 0.5)))

    assert passed(70.0) == pytest.approx(0.0, abs=0.2)
    for edge in (5.0, 900.0):
        assert passed(edge) == pytest.approx(-3.0, abs=0.1)
    assert passed(1.0) < -20.0
    assert passed(1800.0) < -30.0


def test_samples_are_on_the_grid_of_12_bits_and_saturate() -> None:
    loud = (1.5 * np.exp(2.0j * np.pi * 200.0 * np.arange(4000) / 4000)).astype(np.complex64)
    real = receive(loud, PERFECT, "real", SETTINGS, default_rng(0))
    assert real.dtype == np.int16
    assert not (np.asarray(real) % 16).any()
    assert (real.min(), real.max()) == (-32768, 32752)
    both = receive(0.1 * loud, PERFECT, "iq", SETTINGS, default_rng(0))
    codes = np.concatenate([both.real, both.imag]) * 2048
    assert np.array_equal(codes, np.rint(codes))
    assert np.gcd.reduce(np.asarray(codes, dtype=int)) == 1


def density(samples: Floats, frequency: float, width: float) -> float:
    """One-sided spectral density around a frequency, 1/Hz, full scale 1."""
    spectrum = np.abs(np.fft.rfft(samples)) ** 2 * 2.0 / (len(samples) * SAMPLE_RATE)
    near = np.abs(np.fft.rfftfreq(len(samples), 1.0 / SAMPLE_RATE) - frequency) < width
    return float(spectrum[near].mean())


def test_the_noise_is_white_and_one_over_f() -> None:
    samples = noise(60 * SAMPLE_RATE, SETTINGS, default_rng(1))
    for frequency in (20.0, 60.0, 150.0, 500.0, 1500.0):
        expected = white_density(SETTINGS) * (1.0 + 150.0 / frequency)
        assert density(samples, frequency, 0.2 * frequency) == pytest.approx(expected, rel=0.15)


def test_a_real_amplifier_adds_what_it_says_below_its_corner_and_nothing_above() -> None:
    samples = noise(60 * SAMPLE_RATE, REAL_AMPLIFIER, default_rng(1))
    for frequency in (10.0, 20.0, 30.0, 60.0, 150.0, 500.0):
        rise = 10.0**2.8 / (1.0 + (frequency / 30.0) ** 6)
        expected = white_density(SETTINGS) * (1.0 + 150.0 / frequency + rise)
        assert density(samples, frequency, 0.1 * frequency) == pytest.approx(expected, rel=0.25)


def test_an_empty_room_is_noise_and_hum_within_the_band() -> None:
    unit = PERFECT._replace(hum=0.02 + 0j)
    nothing = np.zeros(20 * SAMPLE_RATE, dtype=np.complex64)
    heard = np.asarray(receive(nothing, unit, "real", SETTINGS, default_rng(2)), dtype=np.float64) / 32768.0
    for frequency in (30.0, 160.0, 300.0):
        expected = white_density(SETTINGS) * (1.0 + 150.0 / frequency)
        assert density(heard, frequency, 10.0) == pytest.approx(expected, rel=0.25)
    assert abs(heard.mean()) < 1e-4
    spectrum = np.abs(np.fft.rfft(heard * np.hanning(len(heard))))
    assert np.fft.rfftfreq(len(heard), 1.0 / SAMPLE_RATE)[np.argmax(spectrum)] == 100.0
    line = 2.0 * np.abs(np.mean(heard * np.exp(-2.0j * np.pi * 100.0 * np.arange(len(heard)) / SAMPLE_RATE)))
    assert line == pytest.approx(0.02, rel=0.05)
    # without the lamp there is no line there
    dark = np.asarray(receive(nothing, PERFECT, "real", SETTINGS, default_rng(2)), dtype=np.float64) / 32768.0
    assert density(dark, 100.0, 0.3) == pytest.approx(density(dark, 110.0, 9.0), rel=0.6)


def test_a_steady_line_at_the_detection_range_is_10_db_over_the_noise_of_a_window() -> None:
    length, window = 1024, np.hanning(1025)[:-1]
    tone = np.exp(2.0j * np.pi * 160.9 * np.arange(length) / SAMPLE_RATE)

    def power(samples: Floats) -> float:
        return float(np.abs(2.0 * np.sum(samples * window * np.conj(tone)) / window.sum()) ** 2)

    amplitude = SETTINGS.gain * np.sqrt(0.6) / SETTINGS.detection_range**2
    line = power(amplitude * tone.real)
    samples = noise(400 * length, SETTINGS, default_rng(3)).reshape(-1, length)
    floor = np.mean([power(part) for part in samples])
    assert 10.0 * np.log10(line / floor) == pytest.approx(10.0, abs=0.4)


def test_the_iq_image_is_what_the_imbalance_makes_it() -> None:
    unit = PERFECT._replace(gain_ratio=10.0 ** (0.5 / 20.0), phase_error=3.0 * DEGREE)
    echoes = echo_of(straight_at(1.0), settings=QUIET)
    spectrum = np.abs(np.fft.fft(receive(echoes, unit, "iq", QUIET, default_rng(0)) * np.hanning(SAMPLE_RATE)))
    image, line = spectrum[155:168].max(), spectrum[-168:-155].max()
    skew = unit.gain_ratio * np.exp(1j * unit.phase_error)  # the textbook's ratio of the image to the line
    assert image / line == pytest.approx(np.abs((1.0 - skew) / (1.0 + skew)), rel=0.1)


def test_modules_differ_by_what_was_asked_for() -> None:
    units = [module(SETTINGS, default_rng(seed)) for seed in range(400)]
    assert np.std([20.0 * np.log10(unit.gain) for unit in units]) == pytest.approx(1.5, rel=0.12)
    assert np.std([20.0 * np.log10(unit.noise) for unit in units]) == pytest.approx(1.0, rel=0.12)
    assert np.std([20.0 * np.log10(unit.gain_ratio) for unit in units]) == pytest.approx(0.5, rel=0.12)
    assert np.std([unit.phase_error for unit in units]) == pytest.approx(3.0 * DEGREE, rel=0.12)
    assert module(SETTINGS, default_rng(1)) == module(SETTINGS, default_rng(1))
    louder = module(replace(SETTINGS, hum=20.0), default_rng(1))
    assert abs(louder.hum) == pytest.approx(10.0 * abs(module(SETTINGS, default_rng(1)).hum))
