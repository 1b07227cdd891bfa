"""The Doppler front end: lines of known frequency and amplitude, the noise floor, gaps, cost, and real recordings."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import wavfile
from scipy.signal import butter, sosfilt

from caneflow.algorithms.radar.doppler_line import (
    DopplerLine,
    DopplerLineSettings,
    LineFollower,
    of_the_mains,
    predominant_line,
    range_from_strength,
)
from caneflow.algorithms.radar.doppler_spectrum import DopplerSpectrum, DopplerSpectrumSettings, SlidingSpectrum
from caneflow.algorithms.radar.noise_floor import NoiseFloor
from caneflow.physics import SPEED_OF_LIGHT

CW24 = Path(__file__).parents[1].parent / "shared" / "data" / "cw24-walk"
RATE = 4000.0  # Hz
CARRIER = 24.125e9  # Hz
BLOCK = 200  # samples, 50 ms
START_NS = 1_700_000_000_000_000_000
BLOCK_NS = 50_000_000


def spectra(
    samples: np.ndarray, rate: float = RATE, chosen: DopplerSpectrumSettings | None = None
) -> list[DopplerSpectrum]:
    """Of samples cut into blocks of 50 ms."""
    window = SlidingSpectrum(chosen or DopplerSpectrumSettings())
    size = round(0.05 * rate)
    found = []
    for index in range(len(samples) // size):
        block = samples[index * size : (index + 1) * size]
        one = window.update(START_NS + (index + 1) * BLOCK_NS, block, rate, CARRIER)
        if one is not None:
            found.append(one)
    return found


def tone(frequency: float, amplitude: float, seconds: float = 1.0, noise: float = 1e-4) -> np.ndarray:
    """An I/Q line in a little noise."""
    at = np.arange(round(seconds * RATE)) / RATE
    random = np.random.default_rng(5)
    noises = noise * (random.standard_normal(len(at)) + 1j * random.standard_normal(len(at)))
    return np.asarray(amplitude * np.exp(2j * np.pi * frequency * at) + noises, dtype=np.complex64)


def lines_of(samples: np.ndarray) -> list[DopplerLine]:
    """What the operator makes of them."""
    follower = LineFollower(DopplerLineSettings())
    return [follower.update(one) for one in spectra(samples)]


def line_of(samples: np.ndarray) -> DopplerLine:
    """Their last line, after two seconds of an empty room that is as quiet as `tone`."""
    before = tone(0.0, 0.0, seconds=2.0).astype(np.complex64)
    if samples.dtype.kind != "c":
        scale = 32768.0 if samples.dtype.kind == "i" else 1.0
        return lines_of(np.concatenate([np.round(before.real * scale), samples]).astype(samples.dtype))[-1]
    return lines_of(np.concatenate([before, samples]))[-1]


@settings(max_examples=20, deadline=None)
@given(
    speed=st.floats(0.15, 3.3),
    approaching=st.booleans(),
    decibels=st.floats(-50.0, 0.0),
)
def test_a_line_has_its_speed_its_sign_and_its_amplitude(speed: float, approaching: bool, decibels: float) -> None:
    """24.125 GHz: 160.9 Hz per m/s; positive frequency approaches, so the range shrinks."""
    amplitude = 10.0 ** (decibels / 20.0)
    frequency = (1.0 if approaching else -1.0) * 2.0 * CARRIER * speed / SPEED_OF_LIGHT
    line = line_of(tone(frequency, amplitude))
    assert line.valid
    assert line.range_rate == pytest.approx(-speed if approaching else speed, abs=0.003)
    assert 20.0 * math.log10(line.amplitude / amplitude) == pytest.approx(0.0, abs=0.1)


def test_one_mixer_sees_the_same_strength_and_no_sign() -> None:
    samples = tone(-190.0, 0.05).real
    line = line_of(np.round(samples * 32768.0).astype(np.int16))
    assert line.amplitude == pytest.approx(0.05, rel=0.02)
    assert line.range_rate == pytest.approx(190.0 / 160.93, rel=0.01)


def test_the_image_of_an_unbalanced_module_is_not_taken_for_the_line() -> None:
    samples = tone(200.0, 0.05)
    assert line_of(samples + 0.2 * np.conj(samples)).range_rate < 0.0


def test_the_floor_of_white_noise_is_its_mean() -> None:
    """The bias of the minimum, simulated: within 1 dB over the band, once its memory is filled."""
    random = np.random.default_rng(1)
    found = spectra(random.standard_normal(round(60 * RATE)).astype(np.float32) * 0.01)
    mean = np.mean([one.power for one in found])
    assert 10.0 * math.log10(np.mean(found[-1].floor) / mean) == pytest.approx(0.0, abs=1.0)


def test_the_floor_forgets_in_its_time_and_not_before() -> None:
    """A line that comes later is a target for as long as the memory, and then for three quarters of it again."""
    floor = NoiseFloor(memory=400, spacing=1, cell=2.0)
    random = np.random.default_rng(7)
    power = random.exponential(size=(1400, 64))
    power[400:, 30:33] += 1000.0
    after = np.array([floor.update(row) for row in power])
    assert after[1050, 31] < 3.0
    assert after[1390, 31] > 300.0
    assert after[1390, 10] == pytest.approx(1.0, rel=0.6)


def test_a_floor_that_falls_is_known_within_half_of_its_memory() -> None:
    floor = NoiseFloor(memory=100, spacing=1, cell=2.0)
    random = np.random.default_rng(8)
    power = random.exponential(size=(180, 200))
    power[:130] *= 100.0
    after = np.array([floor.update(row) for row in power])
    assert np.median(after[129]) == pytest.approx(100.0, rel=0.2)
    assert np.median(after[179]) < 4.0


def test_lamp_hum_is_part_of_the_floor() -> None:
    """A line that never goes away is not a person, though it is the strongest."""
    random = np.random.default_rng(2)
    at = np.arange(round(30 * RATE)) / RATE
    hum = 0.003 * np.cos(2 * np.pi * 100.0 * at)
    walker = np.where(at > 20.0, 0.001 * np.cos(2 * np.pi * 190.0 * at), 0.0)
    samples = (hum + walker + 1e-3 * random.standard_normal(len(at))).astype(np.float32)
    lines = lines_of(samples)
    assert [line.range_rate for line in lines[-150:]] == pytest.approx([190.0 / 160.93] * 150, rel=0.02)
    assert not any(line.valid for line in lines[:390])


def test_noise_alone_is_hardly_ever_a_person() -> None:
    random = np.random.default_rng(3)
    lines = lines_of((0.01 * random.standard_normal(round(60 * RATE))).astype(np.float32))
    assert np.mean([line.valid for line in lines]) <= 0.01


def test_an_even_spread_of_energy_is_no_line() -> None:
    """Ten lines of one strength: each is far over the floor, none is a quarter of the energy."""
    lines = [tone(60.0 + 50.0 * index, 0.02, noise=1e-5) for index in range(10)]
    line = line_of(np.asarray(np.sum(lines, axis=0), dtype=np.complex64))
    assert line.snr > 10.0
    assert not line.valid


def test_a_longer_gap_starts_the_window_again() -> None:
    window = SlidingSpectrum(DopplerSpectrumSettings())
    samples = tone(200.0, 0.1)
    given = 0
    stamps = [START_NS + index * BLOCK_NS for index in range(20)]
    for index, stamp in enumerate(stamps):
        if index in (10, 11):
            continue
        block = samples[index * BLOCK : (index + 1) * BLOCK]
        given += window.update(stamp, block, RATE, CARRIER) is not None
    # 256 ms take 6 blocks; before the gap 10 blocks came, after it 8
    assert window.gaps == 1
    assert given == (10 - 5) + (8 - 5)


def blocks_of(samples: np.ndarray) -> list[np.ndarray]:
    return [samples[start : start + BLOCK] for start in range(0, len(samples), BLOCK)]


@pytest.mark.parametrize("at", range(34, 40))
@pytest.mark.parametrize("fault", ["lost", "full-scale noise", "of another scale"])
def test_one_bad_block_leaves_the_line(at: int, fault: str) -> None:
    """In each place of the window: right to 1 % in speed, 0.5 dB in amplitude, under 1/f noise 30 dB over the rest."""
    random = np.random.default_rng(8)
    seconds = np.arange(round(2 * RATE)) / RATE
    slow = 0.03 * np.sin(2 * np.pi * 7.0 * seconds)
    walker = 0.01 * np.sin(2 * np.pi * 143.0 * seconds) * (seconds > 1.3)
    samples = (slow + walker + 1e-3 * random.standard_normal(len(seconds))).astype(np.float32)
    blocks: list[np.ndarray | None] = list(blocks_of(samples))
    wild = {
        "lost": None,
        "full-scale noise": random.uniform(-1, 1, BLOCK),
        "of another scale": 32768.0 * samples[:BLOCK],
    }
    blocks[at] = wild[fault]
    window, follower = SlidingSpectrum(DopplerSpectrumSettings()), LineFollower(DopplerLineSettings())
    lines = []
    for index, block in enumerate(blocks):
        if block is None:
            continue
        spectrum = window.update(START_NS + index * BLOCK_NS, block.astype(np.float32), RATE, CARRIER)
        if spectrum is not None:
            line = follower.update(spectrum)
            if index >= 34:
                lines.append(line)
    assert len(lines) == 5
    for line in lines:
        assert line.valid
        assert line.range_rate == pytest.approx(143.0 / 160.93, rel=0.01)
        assert 20 * np.log10(line.amplitude / 0.01) == pytest.approx(0.0, abs=0.5)


def test_a_walker_who_comes_close_at_once_is_no_bad_block() -> None:
    """From nothing to a sixth of full scale in one block is believed at once; what then clips, after three blocks."""
    seconds = np.arange(round(3 * RATE)) / RATE
    size = np.select([seconds < 1, seconds < 2], [1e-5, 0.16], 40.0)
    samples = (size * np.sin(2 * np.pi * 143.0 * seconds)).astype(np.float32)
    window = SlidingSpectrum(DopplerSpectrumSettings())
    given = [
        window.update(START_NS + index * BLOCK_NS, block, RATE, CARRIER) is not None
        for index, block in enumerate(blocks_of(samples))
    ]
    assert given == [False] * 5 + [True] * 35 + [False] * 3 + [False] * 5 + [True] * 12


def test_the_length_of_the_blocks_does_not_matter() -> None:
    samples = tone(-150.0, 0.1)
    whole = spectra(samples)[-1]
    window = SlidingSpectrum(DopplerSpectrumSettings())
    found = []
    for index in range(len(samples) // 40):
        stamp = START_NS + (index + 1) * 10_000_000
        found.append(window.update(stamp, samples[index * 40 : (index + 1) * 40], RATE, CARRIER))
    given = [one for one in found if one is not None]
    assert len(given) == len(spectra(samples))
    np.testing.assert_allclose(given[-1].power, whole.power, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("chosen", [{"lowest": 600.0}, {"highest": 3000.0}])
def test_a_band_that_cannot_be_is_refused(chosen: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="band"):
        spectra(tone(200.0, 0.1), chosen=DopplerSpectrumSettings(**chosen))


def test_time_must_go_on() -> None:
    window = SlidingSpectrum(DopplerSpectrumSettings())
    window.update(START_NS, tone(200.0, 0.1)[:BLOCK], RATE, CARRIER)
    with pytest.raises(ValueError, match="not newer"):
        window.update(START_NS, tone(200.0, 0.1)[:BLOCK], RATE, CARRIER)


def test_a_silent_channel_has_no_line_and_teaches_the_floor_nothing() -> None:
    """A constant in the middle of noise: not valid, the lowest SNR; the floor after it is the one before it."""
    samples = 0.01 * np.random.default_rng(4).standard_normal(round(20 * RATE))
    without = spectra(samples.astype(np.float32))
    samples[20000:52000] = 0.25
    found = spectra(samples.astype(np.float32))
    silent = [one for one in found if one.silent]
    assert 155 <= len(silent) <= 160  # 8 s, less the windows that are half full
    lines = [predominant_line(one, DopplerLineSettings()) for one in silent]
    assert {(line.valid, line.amplitude, line.snr, line.range_rate) for line in lines} == {(False, 0.0, -99.0, 0.0)}
    change = 10.0 * np.log10(np.median(found[-1].floor) / np.median(without[-1].floor))
    assert abs(change) < 1.0


@pytest.mark.parametrize("part", ["I", "Q"])
def test_half_a_module_tells_no_sign_so_nothing(part: str) -> None:
    samples = tone(200.0, 0.1)
    if part == "I":
        samples.real = 0.3
    else:
        samples.imag = 0.0
    assert all(one.silent for one in spectra(samples))


@pytest.mark.parametrize("time_constant", [0.1, 0.3, 1.0, 5.0])
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_what_settles_slowly_is_no_line(time_constant: float, noise: float) -> None:
    at = np.arange(round(3 * RATE)) / RATE
    samples = 0.6 * np.exp(-at / time_constant) + noise * np.random.default_rng(6).standard_normal(len(at))
    found = spectra(np.round(samples * 32768.0).clip(-32768, 32767).astype(np.int16))
    follower = LineFollower(DopplerLineSettings())
    assert not any(follower.update(one).valid for one in found)


@pytest.mark.parametrize("dtype", [np.int16, np.float32, np.complex64])
def test_an_impulse_in_every_window_leaves_the_line(dtype: type) -> None:
    samples = np.concatenate([tone(0.0, 0.0, seconds=2.0), tone(-190.0, 0.05, seconds=2.0)])
    full = 32767.0 if dtype is np.int16 else 100.0
    scaled = samples if dtype is np.complex64 else samples.real.astype(np.float32)
    if dtype is np.int16:
        scaled = np.round(scaled * 32768.0).astype(np.int16)
    scaled[50::800] = full
    for line in lines_of(scaled)[-34:]:
        assert line.valid
        assert abs(line.range_rate) == pytest.approx(190.0 / 160.93, rel=0.01)
        assert line.amplitude == pytest.approx(0.05, rel=0.02)


def fed(*makes: tuple[float, float, int]) -> tuple[int, list[str], SlidingSpectrum]:
    """Blocks of 50 ms of what each says: rate and carrier (Hz) and samples. -> spectra, refusals, the window."""
    window, given, refused = SlidingSpectrum(DopplerSpectrumSettings()), 0, []
    for index, (rate, carrier, count) in enumerate(makes):
        samples = np.resize(tone(200.0, 0.1)[:BLOCK], count)
        try:
            given += window.update(START_NS + index * BLOCK_NS, samples, rate, carrier) is not None
        except ValueError as error:
            refused.append(str(error))
    return given, refused, window


@pytest.mark.parametrize("wild", [(1e200, CARRIER), (10.0, CARRIER), (8000.0, CARRIER), (RATE, 1e300), (1e7, CARRIER)])
def test_a_block_that_says_another_rate_or_carrier_once_is_taken_for_one_of_the_others(
    wild: tuple[float, float],
) -> None:
    given, refused, window = fed(*[(RATE, CARRIER, BLOCK)] * 10, (*wild, BLOCK), *[(RATE, CARRIER, BLOCK)] * 9)
    assert (given, refused, window.gaps) == (20 - 5, [], 0)


def test_a_block_whose_samples_are_of_another_rate_too_is_bridged_and_believed_when_it_lasts() -> None:
    once = [(RATE, CARRIER, BLOCK)] * 10 + [(2 * RATE, CARRIER, 2 * BLOCK)] + [(RATE, CARRIER, BLOCK)] * 9
    given, refused, window = fed(*once)
    assert (given, refused, window.gaps) == (20 - 5 - 1, [], 1)
    lasting = [(RATE, CARRIER, BLOCK)] * 10 + [(2 * RATE, CARRIER, 2 * BLOCK)] * 12
    given, refused, _ = fed(*lasting)
    assert (given, refused) == ((10 - 5) + (12 - 3 - 5), [])


def test_a_rate_that_no_window_can_hold_is_refused_for_as_long_as_it_lasts() -> None:
    given, refused, _ = fed(*[(1e9, CARRIER, BLOCK)] * 6)
    assert given == 0
    assert len(refused) == 6
    assert "a window of 0.256 s at 1e+09 Hz" in refused[-1]


def amplifier(seconds: float, seed: int, rise: float, corner: float, *, signed: bool) -> np.ndarray:
    """Noise of 1e-3 and, below `corner` (Hz), `rise` dB more: as a module with an ordinary amplifier has it."""
    random, count = np.random.default_rng(seed), round(seconds * RATE)
    frequency = np.fft.rfftfreq(count, 1.0 / RATE)
    shape = np.sqrt(1.0 + 10.0 ** (0.1 * rise) / (1.0 + (frequency / corner) ** 6))

    def channel() -> np.ndarray:
        white = 1e-3 * random.standard_normal(count)
        return np.asarray(np.fft.irfft(np.fft.rfft(white) * shape, count))

    return (channel() + 1j * channel()).astype(np.complex64) if signed else channel().astype(np.float32)


def walker(samples: np.ndarray, speed: float, decibels: float, begin: float, end: float) -> np.ndarray:
    """The samples with someone at `speed` m/s between two times (s), so far above white noise of 1e-3 in a window."""
    at = np.arange(len(samples)) / RATE
    amplitude = math.sqrt(2.0 * 1.5 / 0.256 * 1e-6 / (RATE / 2.0) * 10.0 ** (0.1 * decibels))
    wave = amplitude * np.exp(2j * np.pi * 160.93 * speed * at) * ((at > begin) & (at < end))
    return np.asarray(samples + (wave if samples.dtype.kind == "c" else wave.real), dtype=samples.dtype)


def shares(samples: np.ndarray, speed: float, begin: float, end: float) -> tuple[float, float]:
    """Of the frames of a walker between two times those that are right, and of all those that are valid and wrong."""
    lines = lines_of(samples)
    middle = (np.arange(len(lines)) + 6) * 0.05 - 0.128
    right = np.array([line.valid and abs(abs(line.range_rate) - speed) < 0.15 for line in lines])
    valid = np.array([line.valid for line in lines])
    there = (middle > begin + 0.2) & (middle < end - 0.2)
    around = (middle > begin - 0.15) & (middle < end + 0.15)
    return float(right[there].mean()), float((valid & ~(right & around)).mean())


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize(("rise", "corner"), [(0.0, 1.0), (33.0, 20.0), (20.0, 50.0), (35.0, 15.0)])
def test_a_walker_stands_out_of_an_amplifiers_noise(signed: bool, rise: float, corner: float) -> None:
    """Line 18 dB clear of the white noise, at speeds above the corner: 95 % right, 2 % valid and wrong."""
    for seed, speed in ((1, 0.9), (2, 1.6), (3, 3.1)):
        samples = walker(amplifier(10.0, seed, rise, corner, signed=signed), speed, 18.0, 3.0, 8.0)
        right, wrong = shares(samples, speed, 3.0, 8.0)
        assert right >= 0.95
        assert wrong <= 0.02


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize(("rise", "corner"), [(0.0, 1.0), (33.0, 20.0), (20.0, 50.0), (35.0, 15.0)])
def test_an_empty_room_is_empty_from_the_first_second_on(signed: bool, rise: float, corner: float) -> None:
    frames = [line.valid for seed in range(4) for line in lines_of(amplifier(10.0, seed, rise, corner, signed=signed))]
    assert np.mean(frames) <= 0.01


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("speed", [4.0, 4.5, 6.0, 9.0])
def test_who_is_too_fast_for_the_band_is_nobody(signed: bool, speed: float) -> None:
    """Even with a slower line beside it, as limbs are: the strongest is not in the band."""
    samples = walker(amplifier(10.0, 4, 30.0, 20.0, signed=signed), speed, 35.0, 3.0, 8.0)
    assert np.mean([line.valid for line in lines_of(samples)]) <= 0.02
    if speed < 7.0:
        samples = walker(samples, 2.0, 20.0, 3.2, 7.8)
        assert np.mean([line.valid for line in lines_of(samples)]) <= 0.02


def test_somebody_who_walks_steadily_for_long_is_not_learnt() -> None:
    samples = walker(amplifier(30.0, 5, 30.0, 20.0, signed=False), 1.0, 20.0, 3.0, 30.0)
    right, wrong = shares(samples, 1.0, 3.0, 30.0)
    assert right >= 0.98
    assert wrong <= 0.01


@pytest.mark.parametrize(("mains", "signed"), [(50.02, False), (59.97, False), (50.02, True)])
def test_hum_is_nobody_and_hides_nobody(mains: float, signed: bool) -> None:
    samples = amplifier(10.0, 6, 20.0, 30.0, signed=signed)
    for harmonic, decibels in ((1, 40.0), (2, 35.0), (5, 25.0)):
        samples = walker(samples, harmonic * mains / 160.93, decibels, -1.0, 11.0)
    assert np.mean([line.valid for line in lines_of(samples)]) <= 0.01
    right, wrong = shares(walker(samples, 1.1, 20.0, 3.0, 8.0), 1.1, 3.0, 8.0)
    assert right >= 0.95
    assert wrong <= 0.02


def test_a_lamp_that_is_switched_on_is_nobody_half_a_second_later() -> None:
    samples = walker(amplifier(10.0, 7, 0.0, 1.0, signed=False), 99.98 / 160.93, 30.0, 4.0, 11.0)
    valid = np.array([line.valid for line in lines_of(samples)])
    assert valid.sum() <= 12
    assert not valid[-80:].any()


@pytest.mark.parametrize(
    ("frequency", "told"), [(100.1, True), (299.6, True), (180.2, True), (97.0, False), (160.9, False)]
)
def test_harmonics_of_both_grids_are_known(frequency: float, told: bool) -> None:
    assert of_the_mains(frequency) is told


@pytest.mark.parametrize("signed", [False, True])
def test_a_step_behind_a_high_pass_is_nobody(signed: bool) -> None:
    samples = amplifier(10.0, 8, 0.0, 1.0, signed=signed)
    for at in (4.0, 6.0, 8.0):
        samples[round(at * RATE) :] += 0.05
    passed = sosfilt(butter(2, 5.0, "high", fs=RATE, output="sos"), samples)
    assert np.mean([line.valid for line in lines_of(passed.astype(samples.dtype))]) <= 0.02


@pytest.mark.parametrize("signed", [False, True])
def test_clipping_leaves_the_speed(signed: bool) -> None:
    """An input at its ends half of the time has odd overtones, over a floor that is far lower there."""
    samples = walker(amplifier(8.0, 9, 35.0, 60.0, signed=signed), 0.45, 55.0, 3.0, 8.0)
    samples.real = np.clip(samples.real, -0.008, 0.008)
    if signed:
        samples.imag = np.clip(samples.imag, -0.008, 0.008)
    right, wrong = shares(samples, 0.45, 3.0, 8.0)
    assert right >= 0.95
    assert wrong <= 0.02


def test_range_is_the_fourth_root() -> None:
    """Twelve decibels less are twice as far."""
    near, far = range_from_strength(0.1, 1.0), range_from_strength(0.025, 1.0)
    assert far / near == pytest.approx(2.0)
    assert near == pytest.approx(0.01**-0.25)
    with pytest.raises(ValueError, match="no range"):
        range_from_strength(0.0, 1.0)


def test_hop(benchmark: Any) -> None:
    """50 ms of one sensor: its share of a spectrum and the line in it; `make bench` says how long 200 of them take."""
    samples = np.concatenate([tone(0.0, 0.0, seconds=2.0), tone(190.0, 0.1, seconds=8.0)])
    lines = benchmark(lambda: lines_of(samples))
    assert lines[-1].range_rate == pytest.approx(-190.0 * SPEED_OF_LIGHT / (2.0 * CARRIER), abs=0.01)


def recorded(name: str, highest: float) -> list[DopplerLine]:
    path = CW24 / name
    if not path.exists():
        pytest.skip(f"the recording {name} is not here")
    rate, samples = wavfile.read(path)
    follower = LineFollower(DopplerLineSettings())
    return [follower.update(one) for one in spectra(samples, float(rate), DopplerSpectrumSettings(highest=highest))]


def test_a_real_person_walks_at_one_metre_per_second() -> None:
    """24 GHz, one mixer: the line of the torso, from 3 s on at 150 to 220 Hz by its spectrogram."""
    lines = recorded("RadarHumanData_WalkingData.wav", 560.0)[60:]
    speeds = np.array([line.range_rate for line in lines if line.valid])
    assert len(speeds) > 0.9 * len(lines)
    assert np.mean((speeds > 0.9) & (speeds < 1.4)) > 0.95
    assert 1.0 <= np.median(speeds) <= 1.15


def test_a_real_car_comes_at_five_metres_per_second() -> None:
    """It comes nearer and passes: from 2 s to 7 s its line goes from 2.6 to 5.2 m/s, by its spectrogram."""
    lines = recorded("FirthRoad_20kmV1.wav", 1600.0)
    coming = lines[35:130]
    assert np.mean([line.valid for line in coming]) > 0.97
    speeds = np.array([line.range_rate for line in coming])
    assert np.abs(np.diff(speeds)).max() < 0.35
    assert np.median(speeds[-40:]) == pytest.approx(5.1, abs=0.1)


def test_a_real_car_that_is_too_fast_for_the_band_is_nobody() -> None:
    lines = recorded("FirthRoad_20kmV1.wav", 560.0)
    assert not any(line.valid for line in lines[50:130])
