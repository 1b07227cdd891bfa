"""Cues as vibration: patterns by their times, the chip's registers, the driver on an emulated chip and on PWM files."""

import errno
import logging
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from caneflow.algorithms.surroundings.sonification import BLIND_EVERY, LONGEST_SILENCE, interval
from caneflow.algorithms.surroundings.vibration import PATTERNS, FeelingSettings, Vibration
from caneflow.i2c_bus import serve_client
from caneflow.messages import Cue, Imu, Sample
from caneflow.protocols import drv2605
from caneflow.protocols.drv2605 import Register
from caneflow.protocols.drv2605_emulator import Drv2605Emulator
from caneflow.protocols.errors import ProtocolError
from caneflow.runtime.errors import DataflowError
from caneflow.testing import context
from drivers.haptic import Haptic, HapticSettings
from tests.flows import wait_for

MS = 1_000_000
START = 5_000 * MS


def cue(kind: str = "obstacle", level: str | None = "waist", distance: float = 1.0) -> Cue:
    if kind in ("none", "blind"):
        return Cue(stamp=1, kind=kind, since=1, reason="pose" if kind == "blind" else None)  # type: ignore[arg-type]
    return Cue(stamp=1, kind=kind, since=1, level=level, distance=distance, azimuth=0.0, urgency=0.5)  # type: ignore[arg-type]


def felt(
    seconds: float, *, settings: FeelingSettings | None = None, **told: object
) -> list[tuple[float, float, float]]:
    """Pulses (begin and length in s, strength) when the same cue comes ten times a second for so long."""
    vibration = Vibration(settings or FeelingSettings(strength=1.0), START)
    pulses: list[tuple[float, float, float]] = []
    last = 0.0
    for step in range(round(seconds * 1000)):
        now = START + step * MS
        if step % 100 == 0:
            said = cue(**told)  # type: ignore[arg-type]
            vibration.tell(now, said.kind, said.level, said.distance or 0.0)
        strength = vibration.strength(now)
        if strength and not last:
            pulses.append((step / 1000, 0.0, strength))
        if last and not strength:
            begin, _, of = pulses[-1]
            pulses[-1] = (begin, step / 1000 - begin, of)
        last = strength
    return [pulse for pulse in pulses if pulse[1]]


@pytest.mark.parametrize("distance", [0.5, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("level", ["low", "waist"])
def test_the_nearer_the_more_often_and_the_first_pulse_at_once(level: str, distance: float) -> None:
    pulses = felt(5.0, level=level, distance=distance)
    pulse = PATTERNS[level][0]
    assert pulses[0][0] == 0.0
    assert {(round(length, 3), strength) for _, length, strength in pulses} == {(pulse.length, pulse.strength)}
    pauses = [after[0] - before[0] for before, after in pairwise(pulses)]
    expected = max(interval(distance), pulse.length + 0.09)
    assert pauses == pytest.approx([expected] * len(pauses), abs=0.002)


def test_the_head_is_two_short_pulses_and_a_drop_one_long_one() -> None:
    head = felt(3.0, level="head", distance=3.0)
    assert [round(begin, 2) for begin, _, _ in head[:4]] == [0.0, 0.1, 0.95, 1.05]
    drop = felt(3.0, kind="drop", level="drop", distance=0.8)
    assert {round(length, 2) for _, length, _ in drop} == {0.3}
    assert all(strength == 1.0 for _, _, strength in drop)


def test_nothing_is_a_faint_tick_now_and_then_or_never() -> None:
    ticks = felt(12.0, kind="none")
    assert [begin for begin, _, _ in ticks] == pytest.approx([4.94, 9.94], abs=0.002)
    assert felt(12.0, kind="none", settings=FeelingSettings(strength=1.0, tick=0.0)) == []


@pytest.mark.parametrize(
    ("told", "of"),
    [
        ({"distance": 2.5}, FeelingSettings(reach=2.0, tick=0.0)),
        ({"level": "low"}, FeelingSettings(levels=frozenset({"head"}), tick=0.0)),
    ],
)
def test_what_a_user_does_not_want_is_not_felt(told: dict[str, object], of: FeelingSettings) -> None:
    assert felt(3.0, settings=of, **told) == []


def test_strength_is_the_users() -> None:
    assert {strength for _, _, strength in felt(2.0, settings=FeelingSettings(strength=0.5))} == {0.4}


def test_silence_of_the_graph_is_felt_as_blind() -> None:
    """Two long pulses from half a second after the last cue on, and again every ten seconds."""
    vibration = Vibration(FeelingSettings(strength=1.0, tick=0.0), START)
    vibration.tell(START, "none", None, 0.0)
    on = [ms for ms in range(12_000) if vibration.strength(START + ms * MS)]
    begins = [on[0], *(after for before, after in pairwise(on) if after > before + 1)]
    first = round(LONGEST_SILENCE * 1000)
    again = first + round(BLIND_EVERY * 1000)
    assert begins == [first, first + 550, again, again + 550]


def test_a_chip_is_set_up_for_its_motor() -> None:
    erm = dict(drv2605.set_up("erm", 0xB6, 0x80))
    assert (erm[Register.FEEDBACK], erm[Register.CONTROL_3]) == (0x36, 0x80 | 0x20 | 0x08)
    lra = dict(drv2605.set_up("lra", 0x36, 0xA0))
    assert (lra[Register.FEEDBACK], lra[Register.CONTROL_3]) == (0xB6, 0x80 | 0x08)
    assert [drv2605.strength_byte(part) for part in (-1.0, 0.0, 0.5, 1.0, 7.0)] == [0, 0, 128, 255, 255]
    assert drv2605.require_device(0xE0) == "DRV2605L"
    with pytest.raises(ProtocolError, match="status 0x00 is not that of a DRV2605"):
        drv2605.require_device(0x00)


class Bus:
    """A Unix socket with an emulated chip behind it."""

    def __init__(self, path: Path, chip: Drv2605Emulator) -> None:
        self.chip, self.now = chip, 0.0
        self._server = socket.socket(socket.AF_UNIX)
        self._server.bind(str(path))
        self._server.listen()
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            try:
                client, _ = self._server.accept()
            except OSError:
                return
            serve_client(client, self.chip, lambda: self.now)

    def close(self) -> None:
        self._server.close()


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[Bus]:
    made = Bus(tmp_path / "i2c", Drv2605Emulator(gone=((10.0, 10.0),)))
    yield made
    made.close()


def haptic(**settings: object) -> Haptic:
    return Haptic(HapticSettings(**settings), context(ports={"cue": Cue}))  # type: ignore[arg-type]


def tell(sink: Haptic, message: Sample) -> None:
    sink.take("cane/surroundings/cue", message, b"", 0)


def test_the_motor_runs_as_cues_come_and_stands_at_the_end(bus: Bus, tmp_path: Path) -> None:
    sink = haptic(bus=str(tmp_path / "i2c"))

    def runs() -> bool:
        tell(sink, cue(distance=0.5))
        return sum(strength > 0 for _, strength in bus.chip.driven) >= 3

    wait_for(runs, "pulses")
    assert any(strength == pytest.approx(0.8 * 0.5, abs=0.002) for _, strength in bus.chip.driven)
    sink.finish()
    assert bus.chip.strength == 0.0


def test_a_chip_that_goes_is_said_once_and_set_up_when_it_is_back(
    bus: Bus, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    sink = haptic(bus=str(tmp_path / "i2c"))
    bus.now = 15.0
    wait_for(lambda: "the motor stands until it is back" in caplog.text, "its loss is said")
    bus.now = 25.0
    wait_for(lambda: "is back" in caplog.messages[-1], "and its return")
    before = len(bus.chip.driven)

    def runs() -> bool:
        tell(sink, cue(distance=0.5))
        return len(bus.chip.driven) > before + 2

    wait_for(runs, "pulses again")
    sink.finish()
    assert len([line for line in caplog.messages if "stands until" in line]) == 1


def test_a_motor_that_is_not_there_at_the_start_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DataflowError, match=r"^DRV2605 on I2C bus \S+nowhere: No such file or directory$"):
        haptic(bus=str(tmp_path / "nowhere"))


def test_another_chip_at_its_address_is_refused(tmp_path: Path) -> None:
    other = Bus(tmp_path / "i2c", Drv2605Emulator(device=0))
    with pytest.raises(DataflowError, match="status 0x00 is not that of a DRV2605"):
        haptic(bus=str(tmp_path / "i2c"))
    other.close()


def test_a_pwm_channel_is_driven_by_its_files_and_let_go(tmp_path: Path) -> None:
    for name in ("duty_cycle", "period", "enable"):
        (tmp_path / name).write_text("")
    sink = haptic(pwm=str(tmp_path))

    def running() -> bool:
        tell(sink, cue(level="head", distance=0.5))
        return (tmp_path / "duty_cycle").read_text() == "25000"  # half of 50 us

    wait_for(running, "a duty cycle")
    assert (tmp_path / "period").read_text() == "50000"
    sink.finish()
    assert ((tmp_path / "duty_cycle").read_text(), (tmp_path / "enable").read_text()) == ("0", "0")


def test_a_replay_moves_no_motor(tmp_path: Path) -> None:
    sink = Haptic(HapticSettings(bus=str(tmp_path / "nowhere")), replace(context(ports={"cue": Cue}), replay=True))
    tell(sink, cue())
    sink.idle(time.time_ns())
    sink.finish()


def test_only_a_cue_is_taken() -> None:
    with pytest.raises(DataflowError, match="expected one input, a Cue"):
        Haptic(HapticSettings(), context(ports={"imu": Imu}))


def test_a_bus_that_does_not_answer_is_an_error() -> None:
    chip = Drv2605Emulator()
    with pytest.raises(OSError) as error:
        chip(0x10, b"\x00", 1, 0.0)
    assert error.value.errno == errno.EREMOTEIO
