"""Cues as sound and as words: what is heard of distance, level and side, and how seldom the words change."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.algorithms.surroundings.cue_texts import CLEAR, CueTexts, worded
from caneflow.algorithms.surroundings.sonification import (
    BLIND_EVERY,
    EARS,
    PITCHES,
    RATE,
    TONE,
    HearingSettings,
    Sonification,
    Sound,
    interval,
)

BEAT = RATE // 15  # frames between two cues


def heard(
    seconds: float, kind: str, level: str | None = None, distance: float = 0.0, azimuth: float = 0.0
) -> tuple[Sound, list[float]]:
    """The sound of one cue that lasts, and the times (s) at which something begins after 10 ms of silence."""
    sonification = Sonification(HearingSettings())
    blocks = []
    for _ in range(round(seconds * 15)):
        sonification.tell(kind, level, distance, azimuth)
        blocks.append(sonification.render(BEAT))
    sound = np.concatenate(blocks)
    return sound, starts(sound)


def starts(sound: Sound) -> list[float]:
    loud = np.flatnonzero(np.abs(sound).max(axis=1) > 0)
    first = loud[np.diff(loud, prepend=-RATE) > RATE // 100]
    return [float(at) / RATE for at in first]


@pytest.mark.parametrize(("distance", "expected"), [(0.2, 0.12), (0.5, 0.12), (1.75, 0.535), (3.0, 0.95)])
def test_distance_is_repetition(distance: float, expected: float) -> None:
    assert interval(distance) == pytest.approx(expected)
    _, times = heard(4.0, "obstacle", "waist", distance)
    assert np.diff(times) == pytest.approx(expected, abs=2 / RATE)


@pytest.mark.parametrize("level", PITCHES)
def test_level_is_pitch(level: str) -> None:
    sound, _ = heard(0.2, "obstacle", level, 2.0)
    tone = sound[: round(TONE * RATE), 0].astype(float)
    spectrum = np.abs(np.fft.rfft(tone, 1 << 16))
    found = np.fft.rfftfreq(1 << 16, 1 / RATE)[spectrum.argmax()]
    assert found == pytest.approx(PITCHES[level], rel=0.03)


def test_a_drop_falls_by_an_octave_and_is_heard_at_once() -> None:
    sonification = Sonification(HearingSettings())
    sonification.tell("obstacle", "low", 3.0, 0.0)
    sonification.render(RATE // 10)
    sonification.tell("drop", "drop", 0.9, 0.0)
    sound = sonification.render(RATE // 5)[:, 0].astype(float)
    assert np.abs(sound[: RATE // 100]).max() > 100  # the tones of the box would have paused for 0.85 s
    crossings = np.flatnonzero((sound[:-1] < 0) & (sound[1:] >= 0))
    periods = np.diff(crossings)
    assert periods[-2] / periods[1] == pytest.approx(2 ** (0.9), rel=0.2)


@settings(max_examples=25)
@given(st.floats(-1.0, 1.0))
def test_side_is_power_and_time_of_arrival(azimuth: float) -> None:
    sound, _ = heard(0.2, "obstacle", "head", 2.0, azimuth)
    power = (sound.astype(float) ** 2).sum(axis=0)
    middle, _ = heard(0.2, "obstacle", "head", 2.0, 0.0)
    assert power.sum() == pytest.approx((middle.astype(float) ** 2).sum(), rel=0.01)
    if abs(azimuth) > 0.02:
        assert (power[0] > power[1]) == (azimuth > 0)
    first = [np.flatnonzero(sound[:, ear])[0] for ear in (0, 1) if power[ear] > 1e6]
    if len(first) == 2:
        late = (first[1] - first[0]) / RATE
        assert late == pytest.approx(EARS * math.sin(azimuth), abs=4 / RATE)


def test_a_free_way_ticks_softly_and_blind_is_two_low_tones() -> None:
    free, ticks = heard(11.0, "none")
    blind, tones = heard(11.0, "blind")
    assert ticks == pytest.approx([0.0, 5.0, 10.0], abs=0.001)
    assert tones == pytest.approx([0.0, 0.24, BLIND_EVERY, BLIND_EVERY + 0.24], abs=0.01)
    assert np.abs(free).max() < 0.15 * np.abs(blind).max()


def test_without_cues_it_is_blind_after_half_a_second_and_sees_again() -> None:
    sonification = Sonification(HearingSettings(tick=0.0))
    sonification.tell("none", None, 0.0, 0.0)
    silent = sonification.render(2 * RATE)
    assert starts(silent)[0] == pytest.approx(0.5, abs=0.001)
    sonification.tell("none", None, 0.0, 0.0)
    assert not sonification.render(RATE // 3).any()


@settings(max_examples=25)
@given(st.lists(st.integers(1, 9000), min_size=1, max_size=15), st.integers(0, 100))
def test_the_sound_does_not_depend_on_how_it_is_cut(lengths: list[int], seed: int) -> None:
    random = np.random.default_rng(seed)
    cues = [
        (
            (
                "obstacle",
                str(random.choice(["low", "head"])),
                float(random.uniform(0.3, 3.5)),
                float(random.normal(0, 0.5)),
            )
        )
        if random.uniform() < 0.7
        else ("none", None, 0.0, 0.0)
        for _ in lengths
    ]
    whole, cut = Sonification(HearingSettings()), Sonification(HearingSettings())
    for cue, length in zip(cues, lengths, strict=True):
        whole.tell(*cue)
        cut.tell(*cue)
        one = whole.render(length)
        many = [cut.render(length // 3), cut.render(0), cut.render(length - length // 3)]
        assert np.array_equal(one, np.concatenate(many))


def test_a_user_hears_the_levels_the_range_and_the_volume_that_were_chosen() -> None:
    def loudness(settings: HearingSettings, level: str, distance: float) -> int:
        sonification = Sonification(settings)
        sonification.tell("obstacle", level, distance, 0.0)
        return int(np.abs(sonification.render(RATE // 10)).max())

    chosen = HearingSettings(volume=0.25, reach=1.5, levels=frozenset({"head"}), tick=0.0)
    assert loudness(chosen, "low", 1.0) == 0 == loudness(chosen, "head", 1.6)
    assert loudness(chosen, "head", 1.4) == pytest.approx(loudness(HearingSettings(), "head", 1.4) / 2, abs=2)


# --- words --------------------------------------------------------------------------------------------------------


def said(*cues: tuple[float, str | None, float]) -> list[tuple[float, str]]:
    """(time, text) of the changes; a cue is (s, level or None, m), `blind` as a level."""
    texts, found = CueTexts(), []
    for at, level, distance in cues:
        kind = "none" if level is None else "blind" if level == "blind" else "drop" if level == "drop" else "obstacle"
        told = level if kind in ("obstacle", "drop") else None
        if texts.update(
            round(at * 1e9), kind, told, distance, 0.0, "tof_up/ranges: no sample" if kind == "blind" else ""
        ):
            found.append((at, texts.text))
    return found


def test_words_are_for_the_ear() -> None:
    assert worded("head", 1.62, 0.3) == "Head high, 1.5 metres, left"
    assert worded("low", 0.94, -0.05) == "Low, 0.9 metres, ahead"
    assert worded("drop", 1.1, -0.4) == "Drop, 1 metre, right"


def test_the_text_changes_with_what_lasts_and_when_the_distance_halves() -> None:
    coming = [(i / 15, "waist", 3.0 - 0.05 * i) for i in range(55)]
    assert [text for _, text in said(*coming)] == [
        "Waist high, 3 metres, ahead", "Waist high, 1.5 metres, ahead", "Waist high, 0.8 metres, ahead",
        "Waist high, 0.3 metres, ahead"
    ]  # fmt: skip


def test_what_flickers_is_not_said_and_a_drop_is_at_once() -> None:
    flicker = [(i / 15, "waist" if i % 4 else "head", 2.0) for i in range(60)]
    gaps = [(4 + i / 15, "waist" if i % 10 else None, 2.0) for i in range(60)]
    texts = [text for _, text in said(*flicker, *gaps)]
    assert texts == ["Head high, 2 metres, ahead", "Waist high, 2 metres, ahead"]  # the second once it lasts
    assert said((0.0, "low", 2.0), (0.07, "drop", 1.0))[-1] == (0.07, "Drop, 1 metre, ahead")


def test_clear_comes_late_and_blind_at_once() -> None:
    cues = [(0.0, "low", 2.0), *((0.1 * i, None, 0.0) for i in range(1, 20)), (2.0, "blind", 0.0), (2.1, None, 0.0)]
    assert said(*cues) == [
        (0.0, "Low, 2 metres, ahead"), (1.6, CLEAR), (2.0, "Not seeing: tof_up/ranges: no sample"), (2.1, CLEAR)
    ]  # fmt: skip
