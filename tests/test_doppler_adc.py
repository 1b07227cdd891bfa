"""Doppler modules on a sound card and in sound files: every sample arrives as it was, under the right stamp.

The card is PortAudio's where it is installed, on ALSA's file plug-in; no sound card is needed.
"""

import json
import os
import queue
import subprocess
import sys
import threading
import time
import wave
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from ctypes.util import find_library
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import soundfile  # type: ignore[import-untyped]  # it has no types
import typer
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from typer.testing import CliRunner

from caneflow.errors import CaneflowError
from caneflow.messages import DopplerBlock, DopplerTarget
from caneflow.messages.rig import Rig
from caneflow.protocols.doppler_blocks import BlockCutter, ModuleChannels
from caneflow.protocols.errors import ProtocolError
from caneflow.recording import Recording, RecordingError
from caneflow.recording.sound_file import SoundFile
from caneflow.runtime import Context, Quiet
from caneflow.runtime.dataflow.programs import validated_settings
from caneflow.runtime.errors import DataflowError
from drivers import doppler_adc as driver
from tests.flows import caneflow, caneflow_here
from tools.import_wav import wav

RATE = 4000
SHARED = Path(__file__).parents[1].parent / "shared" / "data"


def noise(frames: int, channels: int = 1) -> NDArray[np.int16]:
    return np.random.default_rng(3).integers(-(2**15), 2**15, (frames, channels), dtype=np.int16)


def written(path: Path, frames: NDArray[np.int16], rate: int = RATE) -> Path:
    """A WAV file by the standard library, which knows nothing of libsndfile."""
    with wave.open(str(path), "wb") as file:
        file.setnchannels(frames.shape[1])
        file.setsampwidth(2)
        file.setframerate(rate)
        file.writeframes(frames.astype("<i2").tobytes())
    return path


def made(**chosen: Any) -> driver.DopplerAdc:
    context = Context(node="south", rig=Rig(), ports={"block": DopplerBlock}, random=np.random.default_rng(0))
    return driver.DopplerAdc(validated_settings(driver.DopplerAdc, chosen), context)


# --- frames to blocks -------------------------------------------------------------------------------------------


def test_a_module_is_its_channel_or_i_and_q() -> None:
    frames = np.array([[1, 2, 3], [-32768, 32767, 0]], dtype=np.int16)
    assert ModuleChannels(first=1).output(frames).tolist() == [2, 32767]
    assert ModuleChannels(first=1).output(frames).dtype == np.int16
    both = ModuleChannels(first=2, quadrature=0).output(frames)
    assert both.dtype == np.complex64
    assert both.tolist() == [3 / 32768 + 1j / 32768, -1j]
    assert ModuleChannels(first=2, quadrature=0).needed == 3


@pytest.mark.parametrize("frames", [np.zeros((3, 1), np.int16), np.zeros(3, np.int16), np.zeros((3, 2), np.int32)])
def test_frames_that_cannot_be_the_modules_are_refused(frames: NDArray[Any]) -> None:
    with pytest.raises(ProtocolError, match=r"channel 1 is needed|int16 or float32"):
        ModuleChannels(first=1).output(frames)


@settings(deadline=None)  # a busy machine is not a failure
@given(st.lists(st.integers(0, 40), max_size=20), st.integers(1, 30))
def test_blocks_are_the_samples_however_they_came(lengths: list[int], length: int) -> None:
    samples = noise(sum(lengths))[:, 0]
    cutter = BlockCutter(length)
    pieces = np.split(samples, np.cumsum(lengths))
    blocks = [block for piece in pieces for block in cutter.feed(piece)]
    assert all(len(block) == length for block in blocks)
    rest = cutter.rest()
    assert rest is None or 0 < len(rest) < length
    joined = [*blocks, *([] if rest is None else [rest])]
    assert np.array_equal(np.concatenate([np.empty(0, np.int16), *joined]), samples)


# --- sound files ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["WAV", "FLAC"])
def test_a_file_of_16_bits_comes_bit_for_bit(form: str, tmp_path: Path) -> None:
    frames = noise(1030, 2)
    path = tmp_path / f"sound.{form.lower()}"
    if form == "WAV":
        written(path, frames)
    else:
        soundfile.write(path, frames, RATE, format=form, subtype="PCM_16")
    found = SoundFile(path, ModuleChannels(first=1), block=0.05)
    blocks = list(found.blocks())
    assert (found.sample_rate, found.frames) == (RATE, 1030)
    assert [len(block.samples) for block in blocks] == [200] * 5 + [30]
    assert [block.last for block in blocks] == [199, 399, 599, 799, 999, 1029]
    assert np.array_equal(np.concatenate([block.samples for block in blocks]), frames[:, 1])


def test_more_than_16_bits_become_float32_and_lose_nothing(tmp_path: Path) -> None:
    exact = (np.random.default_rng(1).integers(-(2**23), 2**23, 500) / 2**23).astype(np.float32)
    soundfile.write(tmp_path / "sound.wav", exact, RATE, subtype="PCM_24")
    (block, *_) = SoundFile(tmp_path / "sound.wav", ModuleChannels(), block=1.0).blocks()
    assert block.samples.dtype == np.float32
    assert np.array_equal(block.samples, exact)


def test_a_block_with_what_is_no_number_is_left_out(tmp_path: Path) -> None:
    values = np.zeros(600, np.float32)
    values[250] = np.nan
    soundfile.write(tmp_path / "sound.wav", values, RATE, subtype="FLOAT")
    file = SoundFile(tmp_path / "sound.wav", ModuleChannels(), block=0.05)
    assert [block.last for block in file.blocks()] == [199, 599]
    assert file.refused == 1


def test_a_file_that_was_cut_off_gives_what_is_there(tmp_path: Path) -> None:
    path = written(tmp_path / "sound.wav", noise(4000))
    path.write_bytes(path.read_bytes()[: 44 + 2 * 1000])
    blocks = list(SoundFile(path, ModuleChannels(), block=0.05).blocks())
    assert np.array_equal(np.concatenate([block.samples for block in blocks]), noise(4000)[:1000, 0])


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("none.wav", None, "is not there"),
        ("empty.wav", b"", "not a sound file"),
        ("text.wav", b"hello", "not a sound file"),
        ("sound.raw", b"\0\0", "not a sound file"),
    ],
)
def test_what_is_no_sound_is_named(name: str, data: bytes | None, says: str, tmp_path: Path) -> None:
    if data is not None:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(RecordingError, match=says) as caught:
        SoundFile(tmp_path / name, ModuleChannels(), block=0.05)
    assert "\n" not in str(caught.value)


def test_a_channel_that_is_not_there_is_named(tmp_path: Path) -> None:
    path = written(tmp_path / "sound.wav", noise(10))
    with pytest.raises(RecordingError, match=r"has 1 channel; channel 1 is asked for"):
        SoundFile(path, ModuleChannels(quadrature=1), block=0.05)


@settings(deadline=None, max_examples=150)
@given(st.data())
def test_no_bytes_upset_the_reader(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.wav"
    sound = bytearray(written(path, noise(300, 2)).read_bytes())
    for at, value in data.draw(st.lists(st.tuples(st.integers(0, 60), st.integers(0, 255)), max_size=6)):
        sound[at] = value
    path.write_bytes(bytes(sound[: data.draw(st.integers(0, len(sound)))]) + data.draw(st.binary(max_size=50)))
    with closing(_blocks(path)) as blocks:
        for number, samples in enumerate(blocks):
            assert np.isfinite(samples).all()
            if number == 100:  # a head may announce more than anybody wants
                break


def _blocks(path: Path) -> Generator[NDArray[Any], None, None]:
    try:
        for block in SoundFile(path, ModuleChannels(first=1), block=0.05).blocks():
            yield block.samples
    except CaneflowError:
        return


# --- import ------------------------------------------------------------------------------------------------------


def imported(*args: object) -> str:
    app = typer.Typer()
    app.command()(wav)
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    return str(result.exception) if result.exit_code == 1 else result.output


def recorded_blocks(path: Path) -> list[DopplerBlock]:
    with Recording(path) as recording:
        decoded = [found.decoded() for found in recording.samples()]
    return [block for block in decoded if isinstance(block, DopplerBlock)]


def test_import_makes_a_recording_of_a_file(tmp_path: Path) -> None:
    frames = noise(450, 2)
    path = written(tmp_path / "sound.wav", frames)
    out = tmp_path / "out.mcap"
    said = imported(path, "-o", out, "--quadrature", 1, "--carrier", 24e9, "--key", "lab/east/block")
    assert said == f"{out}: 3 blocks, 0.1 s at 4000 Hz, PCM_16\n"
    blocks = recorded_blocks(out)
    assert [block.stamp for block in blocks] == [round(1e9 * last / RATE) for last in (199, 399, 449)]
    assert {(block.sample_rate, block.carrier) for block in blocks} == {(4000.0, 24e9)}
    assert np.array_equal(
        np.concatenate([block.samples for block in blocks]), (frames[:, 0] + 1j * frames[:, 1]) / 32768
    )
    with Recording(out) as recording:
        assert (recording.flow, list(recording.streams)) == ("lab", [("east", "block")])


def test_what_cannot_be_imported_is_said_in_one_line(tmp_path: Path) -> None:
    path, out = written(tmp_path / "sound.wav", noise(10)), tmp_path / "out.mcap"
    assert "I and Q are on two channels" in imported(path, "-o", out, "--quadrature", 0)
    assert "expected flow/node/port" in imported(path, "-o", out, "--key", "south")
    assert "another name" in imported(path, "-o", path)
    assert "is not there" in imported(tmp_path / "none.wav", "-o", out)
    assert "holds no sound" in imported(written(tmp_path / "empty.wav", noise(0)), "-o", out)
    assert not out.exists()


@pytest.mark.parametrize("name", ["RadarHumanData_WalkingData.wav", "FirthRoad_20kmV1.wav"])
def test_recorded_walks_of_others_are_imported(name: str, tmp_path: Path) -> None:
    if not (SHARED / "cw24-walk" / name).exists():
        pytest.skip("the shared recordings are not here")
    imported(SHARED / "cw24-walk" / name, "-o", tmp_path / "out.mcap")
    with wave.open(str(SHARED / "cw24-walk" / name)) as file:
        told = np.frombuffer(file.readframes(file.getnframes()), "<i2")
    got = np.concatenate([block.samples for block in recorded_blocks(tmp_path / "out.mcap")])
    assert np.array_equal(got, told)


# --- the driver with a file ---------------------------------------------------------------------------------------


class Hours:
    """A clock that goes on only when someone waits; in the place of the module `time`."""

    def __init__(self) -> None:
        self.now = 100.0  # s

    def monotonic(self) -> float:
        return self.now

    def monotonic_ns(self) -> int:
        return round(self.now * 1e9)

    def time_ns(self) -> int:
        return 1_700_000_000_000_000_000 + self.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def hours(monkeypatch: pytest.MonkeyPatch) -> Hours:
    clock = Hours()
    monkeypatch.setattr(driver, "time", clock)
    return clock


def test_a_file_is_played_in_real_time_with_the_importers_blocks(hours: Hours, tmp_path: Path) -> None:
    path, out = written(tmp_path / "sound.wav", noise(450)), tmp_path / "out.mcap"
    imported(path, "-o", out)
    began = hours.time_ns()
    for item, was in zip(made(file=str(path), sample_rate=123).samples(), recorded_blocks(out), strict=True):
        assert not isinstance(item, Quiet)
        port, block = item
        assert port == "block"
        assert isinstance(block, DopplerBlock)
        assert np.array_equal(block.samples, was.samples)
        assert (block.sample_rate, block.carrier) == (was.sample_rate, was.carrier)
        assert block.stamp - began == pytest.approx(was.stamp + 1e9 / RATE, abs=1.0)
        assert hours.time_ns() >= block.stamp - 1000, "nothing comes before its time"


FLOW = """
flow: {flow}
nodes:
  south: {{run: drivers.doppler_adc, settings: {{file: {sound}}}}}
  south_line: {{run: operators.doppler, inputs: {{block: south/block}}}}
results: [south_line/target]
"""


def targets(path: Path) -> list[tuple[float, float, bool]]:
    with Recording(path) as recording:
        decoded = [found.decoded() for found in recording.samples([("south_line", "target")])]
    return [(t.range_rate, t.amplitude, t.valid) for t in decoded if isinstance(t, DopplerTarget)]


def test_a_flow_hears_the_same_from_a_file_and_from_its_recording(tmp_path: Path) -> None:
    times = np.arange(4 * RATE) / RATE  # s: two of an empty room, two of a target
    tone = 10_000 * np.sin(2 * np.pi * 320 * times) * (times >= 2.0) + noise(4 * RATE)[:, 0] / 100
    path, flow = written(tmp_path / "sound.wav", tone.astype(np.int16)[:, None]), tmp_path / "flow.yaml"
    flow.write_text(FLOW.format(flow="t" + tmp_path.name.replace("_", "")[-30:], sound=path))
    imported(path, "-o", tmp_path / "in.mcap")
    done = caneflow("run", "flow.yaml", "--record", "live.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    replay = ("--replay", "in.mcap", "--in-process", "--record", "replayed.mcap")
    done = caneflow_here("run", "flow.yaml", *replay, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    live, replayed = targets(tmp_path / "live.mcap"), targets(tmp_path / "replayed.mcap")
    assert live == replayed
    speeds = [speed for speed, _, valid in live if valid]
    assert len(speeds) > 25
    assert np.median(speeds) == pytest.approx(320 * 299_792_458 / (2 * 24.125e9), rel=5e-3)


# --- the driver with a card ---------------------------------------------------------------------------------------


class Card:
    """A card as `opened` shows it: pieces of its frames, on the clock that goes on only when someone waits."""

    def __init__(self, hours: Hours, pieces: list[driver.Piece | None]) -> None:
        self.hours = hours
        self.pieces = pieces  # None: the card is pulled out
        self.opened = 0

    @contextmanager
    def open(self, _: object) -> Iterator[Iterator[driver.Piece]]:
        self.opened += 1
        if not self.pieces:
            raise driver.Lost("default: No such device")
        yield self._said()

    def _said(self) -> Iterator[driver.Piece]:
        while self.pieces:
            piece = self.pieces.pop(0)
            if piece is None:
                break
            self.hours.now = max(self.hours.now, piece.last / 1e9)
            yield piece
        raise driver.Lost("default: says nothing any more")


def pieces(frames: NDArray[np.int16], begin: float, size: int = 34, overflowed: bool = False) -> list[Any]:
    """What a card of exactly RATE that was started at `begin` s hands over."""
    cut = [frames[at : at + size] for at in range(0, len(frames), size)]
    ends = np.cumsum([len(part) for part in cut])
    return [
        driver.Piece(part, round((begin + (end - 1) / RATE) * 1e9), overflowed and place == 0)
        for place, (part, end) in enumerate(zip(cut, ends, strict=True))
    ]


def heard(source: driver.DopplerAdc, count: int) -> list[DopplerBlock]:
    """The next `count` blocks."""
    blocks: list[DopplerBlock] = []
    with closing(source.samples()) as items:
        for item in items:
            if not isinstance(item, Quiet) and isinstance(item[1], DopplerBlock):
                blocks.append(item[1])
                if len(blocks) == count:
                    break
    return blocks


def test_blocks_are_stamped_by_the_cards_own_count(hours: Hours, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = noise(4000)
    card = Card(hours, pieces(frames, begin=101.0))
    monkeypatch.setattr(driver, "opened", card.open)
    blocks = heard(made(), 19)
    assert np.array_equal(np.concatenate([block.samples for block in blocks]), frames[: 19 * 200, 0])
    epoch = 1_700_000_000_000_000_000
    for place, block in enumerate(blocks, start=1):
        assert block.stamp == pytest.approx(epoch + (101.0 + (200 * place - 1) / RATE) * 1e9, abs=2000)


def test_an_overflow_is_a_gap_in_the_stamps_and_never_inside_a_block(
    hours: Hours, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    frames = noise(4000)
    # 1000 frames, then 0.3 s of which the card handed nothing over
    card = Card(hours, [*pieces(frames[:1010], 101.0), *pieces(frames[2210:], 101.0 + 2210 / RATE, overflowed=True)])
    monkeypatch.setattr(driver, "opened", card.open)
    blocks = heard(made(), 12)
    assert [len(block.samples) for block in blocks] == [200] * 5 + [10] + [200] * 6
    assert np.array_equal(np.concatenate([b.samples for b in blocks[:6]]), frames[:1010, 0])
    assert np.array_equal(np.concatenate([b.samples for b in blocks[6:]]), frames[2210:3410, 0])
    steps = [(b.stamp - a.stamp) * 1e-9 - len(b.samples) / RATE for a, b in pairwise(blocks)]
    assert steps[5] == pytest.approx(1200 / RATE, abs=1e-5), "as long as what is missing"
    assert max(map(abs, steps[:5] + steps[6:])) < 1e-5
    assert caplog.messages == ["1 overflows in 6 blocks: samples are missing there"]


def test_a_card_that_is_pulled_out_comes_back(
    hours: Hours, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    frames = noise(2000)
    card = Card(hours, [*pieces(frames[:1000], 101.0), None, *pieces(frames[1000:], 105.0)])
    monkeypatch.setattr(driver, "opened", card.open)
    blocks = heard(made(), 10)
    assert card.opened == 2
    gaps = [(b.stamp - a.stamp) * 1e-9 for a, b in pairwise(blocks)]
    assert max(gaps) > 3.5
    assert [message for message in caplog.messages if "tries again" in message] == [
        "default: says nothing any more; tries again"
    ]


def test_a_card_that_is_never_there_is_an_error_with_the_next_step(
    hours: Hours, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "opened", Card(hours, []).open)
    with pytest.raises(DataflowError, match=r"^south: no block within 10 s: default: No such device; .*--devices"):
        heard(made(), 1)
    assert 110.0 < hours.now < 111.0


@pytest.mark.parametrize("drift", [0.0, 80e-6, -80e-6])
def test_the_clock_takes_off_the_jitter_and_follows_the_cards_rate(drift: float) -> None:
    """Times told late by up to a piece of 8.5 ms: the stamps are late by a constant, within 0.2 ms."""
    rng = np.random.default_rng(8)
    clock = driver.StreamClock(RATE)
    size, errors = 34, []
    for place in range(1, 60 * RATE // size):
        true = place * size / RATE * (1.0 + drift) * 1e9
        clock.heard(size, round(true + rng.uniform(0.0, 8.5e6)))
        errors.append(clock.at(0) - true)
    settled = np.array(errors[len(errors) // 3 :])
    assert settled.max() - settled.min() < 0.2e6
    assert abs(settled.mean()) < 0.2e6


def test_stamps_increase_also_where_a_card_keeps_no_time() -> None:
    clock = driver.StreamClock(RATE)
    stamps = []
    for call in range(50):  # 1 s of sound in each us
        clock.heard(RATE, 1000 * call)
        stamps += [clock.at(behind) for behind in (3000, 2000, 1000, 0)]
    assert all(a < b for a, b in pairwise(stamps))


@pytest.mark.parametrize(
    ("adc", "current", "last"),
    [
        (50.0, 50.1, -0.1 + 199 / RATE),  # the first frame is 0.1 s old
        (50.0, 50.0, 0.0),  # a card that says that it was sampled just now, all 50 ms of it
        (0.0, 50.0, -0.05 + 199 / RATE),  # one that says nothing: it has just become whole
        (50.0, 49.0, -0.05 + 199 / RATE),  # one that says what cannot be
        (1.0, 50.0, -0.05 + 199 / RATE),
    ],
)
def test_the_time_of_a_piece(adc: float, current: float, last: float) -> None:
    handed: queue.Queue[driver.Piece] = queue.Queue()
    card = driver.Heard(RATE, handed, threading.Event())
    before = time.monotonic_ns()
    times = SimpleNamespace(inputBufferAdcTime=adc, currentTime=current)
    card(noise(200), 200, times, SimpleNamespace(input_overflow=True))
    after = time.monotonic_ns()
    piece = handed.get_nowait()
    assert before <= piece.last - round(last * 1e9) <= after
    assert piece.overflowed


def test_a_full_queue_holds_the_card_up_until_the_flow_ends() -> None:
    ends = threading.Event()
    card = driver.Heard(RATE, queue.Queue(maxsize=1), ends)
    times = SimpleNamespace(inputBufferAdcTime=0.0, currentTime=0.0)
    said = SimpleNamespace(input_overflow=False)
    card(noise(1), 1, times, said)
    waiting = threading.Thread(target=card, args=(noise(1), 1, times, said), daemon=True)
    waiting.start()
    ends.set()
    waiting.join(timeout=60.0)
    assert not waiting.is_alive()


@pytest.mark.parametrize(
    ("chosen", "said"),
    [({"quadrature": 0}, "I and Q are on two channels"), ({"channel": -1}, "channel"), ({"device": 3}, "device")],
)
def test_settings_that_cannot_be_are_refused(chosen: dict[str, Any], said: str) -> None:
    with pytest.raises(DataflowError, match=said):
        validated_settings(driver.DopplerAdc, chosen)


def test_devices_by_number_and_name() -> None:
    assert [driver.named(device) for device in ("default", "3", "hw:1,0")] == [None, 3, "hw:1,0"]


# --- PortAudio on ALSA's file plug-in -----------------------------------------------------------------------------

ASOUNDRC = """
pcm.cane {{ type file, slave.pcm {{ type null }}, file /dev/null, infile {sound}, format raw }}
pcm.!default pcm.cane
"""
# In a process of its own: PortAudio reads ALSA's configuration once.
LISTENER = """
import json, sys
import numpy as np
from caneflow.drivers.doppler_adc import DopplerAdc
from caneflow.messages.rig import Rig
from caneflow.runtime import Context, Quiet
from caneflow.runtime.dataflow.programs import validated_settings

wanted, out, settings = int(sys.argv[1]), sys.argv[2], json.loads(sys.argv[3])
context = Context(node="south", rig=Rig(), ports=DopplerAdc.outputs, random=np.random.default_rng(0))
items, blocks, stamps = DopplerAdc(validated_settings(DopplerAdc, settings), context).samples(), [], []
while sum(map(len, blocks)) < wanted:
    item = next(items)
    if not isinstance(item, Quiet):
        blocks.append(item[1].samples)
        stamps.append(item[1].stamp)
items.close()
np.savez(out, samples=np.concatenate(blocks)[:wanted], stamps=stamps)
"""


def through_portaudio(folder: Path, frames: NDArray[np.int16], chosen: dict[str, Any]) -> tuple[Any, Any]:
    """What the driver heard of `frames`, and the blocks' stamps."""
    if find_library("portaudio") is None:
        pytest.skip("PortAudio is not installed: apt-get install libportaudio2")
    frames.tofile(folder / "sound.raw")
    (folder / "asoundrc").write_text(ASOUNDRC.format(sound=folder / "sound.raw"))
    environment = {**os.environ, "ALSA_CONFIG_PATH": str(folder / "asoundrc")}
    command = [sys.executable, "-c", LISTENER, str(len(frames)), str(folder / "heard.npz"), json.dumps(chosen)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    with np.load(folder / "heard.npz") as heard:
        return heard["samples"], heard["stamps"]


@pytest.mark.parametrize(
    ("chosen", "channels"),
    [({}, 1), ({"device": "cane", "channel": 1}, 2), ({"device": "cane", "channel": 1, "quadrature": 0}, 2)],
)
def test_a_stream_of_portaudio_comes_bit_for_bit(chosen: dict[str, Any], channels: int, tmp_path: Path) -> None:
    frames = noise(40_000, channels)
    heard, stamps = through_portaudio(tmp_path, frames, {"start_timeout_s": 2.0, **chosen})
    given = frames[:, chosen.get("channel", 0)]
    expected = (given + 1j * frames[:, 0]) / 32768 if "quadrature" in chosen else given
    assert np.array_equal(heard, expected)
    assert all(np.diff(stamps) > 0)


# --- silence ----------------------------------------------------------------------------------------------------


def test_a_channel_that_falls_silent_is_said_by_its_name_and_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Q stands still for 1.5 s and for another 1.2 s; I for 0.5 s, which some cards do when they begin."""
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    frames = noise(20000, 2)
    frames[2000:8000, 1] = -7
    frames[12000:16800, 1] = 0
    frames[:2000, 0] = 0
    source = made(file=str(written(tmp_path / "sound.wav", frames)), quadrature=1)
    with closing(source.samples()) as items:
        assert len(list(items)) == 100
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(said) == 2
    assert all(text.startswith("channel 1 (Q) is silent: not a bit changes for 1 s") for text in said)


def test_both_channels_are_told_apart() -> None:
    one, two = ModuleChannels(first=3), ModuleChannels(first=0, quadrature=2)
    assert one.silent(np.full(10, 5, np.int16)) == (3,)
    assert one.silent(np.arange(10, dtype=np.int16)) == ()
    assert two.silent(np.arange(10) + 0j) == (2,)
    assert two.silent(np.arange(10) * 1j) == (0,)
    assert two.silent(np.zeros(10, np.complex64)) == (0, 2)
    assert (one.named(3), two.named(0), two.named(2)) == ("channel 3", "channel 0 (I)", "channel 2 (Q)")


def test_a_block_that_no_converter_makes_is_left_out_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    values = np.random.default_rng(1).normal(0.0, 0.1, 2000).astype(np.float32)
    values[250], values[450], values[650] = np.nan, 1e30, -1e9
    soundfile.write(tmp_path / "sound.wav", values, RATE, subtype="FLOAT")
    with closing(made(file=str(tmp_path / "sound.wav")).samples()) as items:
        blocks = [item for item in items if not isinstance(item, Quiet)]
    assert len(blocks) == 7
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(said) == 2
    assert said[0].startswith("a block is left out, as are others like it: samples has an element of 1e+30")
    assert said[1].endswith("3 blocks left out: they hold what is not a number, or no sound")
