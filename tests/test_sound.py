"""drivers.sound: the file of a replay is the same on every host and after kills; the live device, emulated."""

import logging
import os
import signal
import stat
import sys
import types
import wave
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caneflow.algorithms.surroundings.sonification import RATE
from caneflow.errors import CaneflowError
from caneflow.messages import Cue, encode, numbered, sample_key
from caneflow.messages.rig import Rig, read_rig
from caneflow.recording import RecordingWriter
from caneflow.runtime import Context
from caneflow.runtime.errors import DataflowError
from drivers.sound import CueLog, CueSound, Player, SoundSettings, hearing_of
from tests.flows import caneflow_here, launchers, node_processes, wait_for

SECOND = 1_000_000_000
FLOW = """
flow: {flow}
nodes:
  surroundings: {{external: true, outputs: {{cue: Cue}}}}
  sound: {{run: drivers.sound, inputs: {{cue: surroundings/cue}}, settings: {{file: {file}}}}}
results: []
"""


def cues(seconds: float) -> Iterator[Cue]:
    """Someone comes nearer, a stair, nothing, a sensor that is gone."""
    for seq in range(round(seconds * 15)):
        stamp, at = SECOND + seq * SECOND // 15, seq / 15
        if at % 6 < 3:
            told: dict[str, Any] = {"kind": "obstacle", "level": "head", "distance": 3 - at % 6, "azimuth": 0.2}
        elif at % 6 < 4:
            told = {"kind": "drop", "level": "drop", "distance": 0.9, "azimuth": -0.1}
        else:
            told = {"kind": "none"} if at % 6 < 5 else {"kind": "blind", "reason": "tof_up/ranges: no sample"}
        if "level" in told:
            told["urgency"] = 0.5
        yield Cue(stamp=stamp, seq=seq, since=stamp, **told)


def sound(file: Path | None, *, takes_over: bool = False, replay: bool = True, rig: Rig | None = None) -> CueSound:
    context = Context(
        node="sound",
        rig=rig or Rig(),
        ports={"cue": Cue},
        random=np.random.default_rng(0),
        replay=replay,
        takes_over=takes_over,
    )
    return CueSound(SoundSettings(file=None if file is None else str(file)), context)


def give(sink: CueSound, some: list[Cue]) -> None:
    for cue in some:
        sink.take("cane/surroundings/cue", cue, encode(cue), cue.stamp)


def test_the_file_holds_the_sound_of_the_cues_at_their_stamps(tmp_path: Path) -> None:
    sink = sound(tmp_path / "cues.wav")
    give(sink, list(cues(7)))
    sink.finish()
    with wave.open(str(tmp_path / "cues.wav")) as file:
        assert (file.getnchannels(), file.getsampwidth(), file.getframerate()) == (2, 2, RATE)
        heard = np.frombuffer(file.readframes(file.getnframes()), "<i2").reshape(-1, 2)
    assert len(heard) == pytest.approx((7 + 0.5) * RATE, abs=RATE / 10)
    assert np.abs(heard[: RATE // 100]).max() > 1000  # the first cue
    assert not heard[round(4.25 * RATE) : round(4.9 * RATE)].any()  # nothing in the way
    assert np.abs(heard[round(5.0 * RATE) : round(5.3 * RATE)]).max() > 1000  # blind
    assert [each.name for each in tmp_path.iterdir()] == ["cues.wav"]


@pytest.mark.parametrize("cut", [0, 1, 7])
def test_a_sink_in_the_place_of_a_killed_one_writes_the_same_bytes(tmp_path: Path, cut: int) -> None:
    every = list(cues(7))
    whole = sound(tmp_path / "whole.wav")
    give(whole, every)
    whole.finish()
    give(sound(tmp_path / "killed.wav"), every[:40])  # and no finish
    log = tmp_path / "killed.wav.cues"
    os.truncate(log, log.stat().st_size - cut)  # bytes that the kill has cut
    after = sound(tmp_path / "killed.wav", takes_over=True)
    give(after, every[39 - (cut > 0) :])  # some come again
    after.finish()
    assert (tmp_path / "killed.wav").read_bytes() == (tmp_path / "whole.wav").read_bytes()


def test_what_an_earlier_run_has_left_is_not_taken_over(tmp_path: Path) -> None:
    give(sound(tmp_path / "a.wav"), list(cues(3)))
    fresh = sound(tmp_path / "a.wav")
    give(fresh, list(cues(1)))
    fresh.finish()
    with wave.open(str(tmp_path / "a.wav")) as file:
        assert file.getnframes() == pytest.approx(1.5 * RATE, abs=RATE / 10)


def test_a_file_that_exists_is_kept_but_by_who_takes_over(tmp_path: Path) -> None:
    file = tmp_path / "kept.wav"
    file.write_bytes(b"a year's work")
    with pytest.raises(CaneflowError, match="already exists"):
        sound(file)
    assert file.read_bytes() == b"a year's work"
    assert [each.name for each in tmp_path.iterdir()] == ["kept.wav"]
    sound(file, takes_over=True).finish()  # killed between the file and its end
    with wave.open(str(file)) as written:
        assert written.getframerate() == RATE


def test_a_folder_that_is_not_there_is_told_in_a_line(tmp_path: Path) -> None:
    with pytest.raises(DataflowError, match="cannot be written: No such file"):
        CueLog(tmp_path / "no" / "a.wav.cues", goes_on=False)


def test_processes_a_kill_and_one_process_give_the_same_bytes(tmp_path: Path) -> None:
    recording = tmp_path / "cues.mcap"
    with RecordingWriter(recording, flow="elsewhere", source="simulated", rig={}) as writer:
        for cue in cues(12):
            key = sample_key("elsewhere", "surroundings", "cue")
            writer.write(key, Cue, numbered(cue, cue.seq), stamp=cue.stamp, seq=cue.seq, log_time=cue.stamp)
    name = f"s{os.getpid()}"
    for file in ("one", "many"):
        (tmp_path / f"{file}.yaml").write_text(FLOW.format(flow=name, file=tmp_path / f"{file}.wav"))
    with launchers() as launch:
        one = caneflow_here("run", tmp_path / "one.yaml", "--replay", recording, "--in-process")
        assert one.returncode == 0, one.stderr
        many = launch("run", tmp_path / "many.yaml", "--replay", recording, "--speed", 4, log=tmp_path / "many.log")
        log = tmp_path / "many.wav.cues"
        wait_for(lambda: log.exists() and log.stat().st_size > 2000, "some cues")
        node_processes(many.process.pid)["sound"].send_signal(signal.SIGKILL)
        assert many.ends() == 0, many.said
        again = caneflow_here("run", tmp_path / "one.yaml", "--replay", recording, "--in-process")
        assert again.returncode == 2, again.stderr
        assert "one.wav: already exists" in again.stderr
    assert (tmp_path / "many.wav").read_bytes() == (tmp_path / "one.wav").read_bytes()


# --- live ---------------------------------------------------------------------------------------------------------


class Device:
    """sounddevice.OutputStream, whose frames are drawn by the test."""

    latency_s = 0.02

    def __init__(self, **how: Any) -> None:
        self.how, self.active = how, False

    def start(self) -> None:
        self.active = True

    def close(self) -> None:
        self.active = False

    def draw(self) -> np.ndarray[Any, Any]:
        out = np.zeros((self.how["blocksize"], 2), np.int16)
        moment = types.SimpleNamespace(currentTime=5.0, outputBufferDacTime=5.0 + self.latency_s)
        self.how["callback"](out, len(out), moment, None)
        return out


@pytest.fixture
def devices(monkeypatch: pytest.MonkeyPatch) -> list[Device]:
    opened: list[Device] = []

    def stream(**how: Any) -> Device:
        opened.append(Device(**how))
        return opened[-1]

    library = types.SimpleNamespace(OutputStream=stream, PortAudioError=RuntimeError)
    monkeypatch.setitem(sys.modules, "sounddevice", library)
    return opened


def test_live_cues_sound_in_the_next_block_and_their_latency_is_told(
    devices: list[Device], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr("drivers.sound.time.time_ns", lambda: 10 * SECOND)
    sink = sound(None, replay=False, rig=read_rig({"user": {"guidance": {"tick": 0}}}))
    (device,) = devices
    assert not device.draw().any()
    cue = Cue(
        stamp=10 * SECOND, kind="obstacle", level="low", distance=2.0, azimuth=0.0, urgency=0.3, since=9_900_000_000
    )
    give(sink, [cue])
    assert device.draw().any()
    sink.finish()
    assert "exposure to sound: p50 120 ms, p99 120 ms of 1 tones" in caplog.text  # 100 ms and the device's 20
    assert not device.active


def test_a_device_that_is_gone_is_opened_again(devices: list[Device], monkeypatch: pytest.MonkeyPatch) -> None:
    player = Player(None, hearing_of(read_rig({"user": {}}).user.guidance))  # type: ignore[union-attr]
    devices[0].active = False
    player.look_after()
    assert len(devices) == 2
    assert devices[1].active


def test_without_the_library_a_line_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sounddevice", None)
    with pytest.raises(DataflowError, match=r"sounddevice is not installed; `pip install 'caneflow\[sound\]'`"):
        sound(None, replay=False)


def test_words_go_to_espeak_ng_where_it_is_installed(
    devices: list[Device], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "espeak-ng"
    program.write_text(f'#!/bin/sh\necho "$@: $(cat)" >> {tmp_path}/said\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    context = Context(node="sound", rig=Rig(), ports={"cue": Cue}, random=np.random.default_rng(0))
    sink = CueSound(SoundSettings(say=True), context)
    give(sink, [next(cues(1))])
    wait_for(lambda: (tmp_path / "said").exists() and (tmp_path / "said").read_text(), "a word")
    assert (tmp_path / "said").read_text() == "-s 220 --stdin: Head high, 3 metres, left\n"
    sink.finish()
