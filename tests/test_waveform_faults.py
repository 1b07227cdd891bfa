"""Impulses, steps and silence of a waveform: what is taken out, and that nothing else is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from caneflow.algorithms.radar.waveform_faults import mended

COUNT = 1024


def noise(seed: int = 1) -> NDArray[np.float64]:
    return np.random.default_rng(seed).standard_normal(COUNT)


def tone(period: float) -> NDArray[np.float64]:
    """`period` in samples; with a little noise, as nothing real is without."""
    return np.asarray(100.0 * np.sin(2 * np.pi * np.arange(COUNT) / period) + 0.01 * noise())


@pytest.mark.parametrize("whole", [noise(), tone(7.1), tone(400.0), np.round(3.0 * noise()), np.round(0.4 * noise())])
def test_a_signal_is_left_as_it_is(whole: NDArray[np.float64]) -> None:
    assert np.array_equal(mended(whole).samples, whole)
    assert mended(whole).still < 40


@settings(deadline=None)
@given(
    at=st.integers(0, COUNT - 2), length=st.integers(1, 4), height=st.floats(30.0, 1e9), sign=st.sampled_from([1, -1])
)
def test_an_impulse_is_bridged(at: int, length: int, height: float, sign: int) -> None:
    """Nothing is left of it beyond what noise does from one sample to the next."""
    wild = noise()
    wild[at : at + length] += sign * height
    repaired = mended(wild).samples
    assert np.abs(repaired - repaired.mean()).max() < 8.0
    assert np.array_equal(repaired[:at], wild[:at])


@pytest.mark.parametrize("height", [100.0, -32768.0, 1e12])
def test_a_step_is_taken_back(height: float) -> None:
    whole, wild = noise(), noise()
    wild[600:] += height
    repaired = mended(wild).samples
    assert np.abs(repaired - whole).max() < 6.0
    assert np.array_equal(repaired[:600], whole[:600])


def test_an_impulse_on_a_strong_tone_costs_the_sample_and_no_more() -> None:
    whole, wild = tone(40.0), tone(40.0)
    wild[[100, 400, 401, 900]] = 32767.0
    off = np.abs(mended(wild).samples - whole)
    assert off.max() < 10.0  # of 100, where the tone bends
    assert np.count_nonzero(off) <= 4


def test_what_jumps_often_is_the_signal() -> None:
    square = 100.0 * np.sign(np.sin(2 * np.pi * (np.arange(COUNT) + 0.5) / 40.0)) + noise()
    assert np.array_equal(mended(square).samples, square)


@pytest.mark.parametrize("value", [0.0, 1.0, 0.1, 32767 / 32768, -1.0])
def test_a_constant_stands_still(value: float) -> None:
    assert mended(np.full(COUNT, value)).still == COUNT
    assert mended(np.full(1, value)).still == 1


def test_a_constant_with_a_few_steps_and_impulses_stands_still_all_the_same() -> None:
    values = np.repeat([3.0, -5.0, 700.0, 0.1], COUNT // 4)
    values[[10, 500]] = 9e9
    assert mended(values).still == COUNT


def test_the_longest_run_is_found() -> None:
    values = noise()
    values[300:450] = values[300]
    assert mended(values).still == 150
