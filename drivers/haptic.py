"""Cues as vibration of a small motor on the cane: by a DRV2605 on I2C, or by a PWM output of the board.

in   cue : Cue

Live only: a replay moves no motor. Not tried with a motor.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, TypeAlias

from annotated_types import Ge, Le

from caneflow.algorithms.surroundings.vibration import FeelingSettings, Vibration
from caneflow.i2c_bus import opened_bus
from caneflow.messages import Cue, Sample
from caneflow.messages.rig import Guidance, User
from caneflow.protocols import drv2605
from caneflow.protocols.drv2605 import Register
from caneflow.protocols.errors import ProtocolError
from caneflow.runtime import Context, Sink
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

STEP: Final = 0.01  # s between two looks at how strong the motor is to run
RETRY: Final = 0.5  # s between two attempts to reach a chip that is gone
LOOK: Final = 1.0  # s between two looks at the chip's own complaints
PWM_PERIOD: Final = 50_000  # ns: 20 kHz, which nobody hears
END: Final = 1.0  # s that the motor's thread may take to end

Drive: TypeAlias = Callable[[float], None]  # 0..1


@dataclass(frozen=True, kw_only=True)
class HapticSettings:
    """Where the motor is. What is felt is set per user: rig.user.guidance."""

    __pydantic_config__ = {"extra": "forbid"}

    bus: Annotated[int, Ge(0), Le(255)] | str = 1  # /dev/i2c-N; or the socket of an emulator
    motor: drv2605.Motor = "erm"  # with an eccentric mass, or lra: a linear one
    pwm: str | None = None  # instead of the chip: a channel of Linux's, e.g. /sys/class/pwm/pwmchip0/pwm0


class Haptic(Sink):
    """Drives a motor as cues come."""

    Settings = HapticSettings

    def __init__(self, settings: HapticSettings, context: Context) -> None:
        strangers = [port for port, kind in context.ports.items() if kind is not Cue]
        if strangers or len(context.ports) != 1:
            raise DataflowError(f"{context.node}: expected one input, a Cue; found {', '.join(context.ports)}")
        feeling = feeling_of((context.rig.user or User()).guidance)
        self._motor = None if context.replay else Motor(settings, feeling)

    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        """Take one cue."""
        assert isinstance(message, Cue)
        if self._motor is not None:
            self._motor.tell(message)

    def idle(self, time: int) -> None:
        """The motor has a thread of its own."""

    def finish(self) -> None:
        """Stop the motor."""
        if self._motor is not None:
            self._motor.close()


def feeling_of(guidance: Guidance) -> FeelingSettings:
    """What one user wants to feel."""
    return FeelingSettings(
        strength=guidance.volume, reach=guidance.range, levels=frozenset(guidance.levels), tick=guidance.tick
    )


class Motor:
    """A motor and the thread that drives it."""

    def __init__(self, settings: HapticSettings, feeling: FeelingSettings) -> None:
        """Raises DataflowError when the motor cannot be reached at the start; later it is waited for."""
        self._opened = _pwm(Path(settings.pwm)) if settings.pwm is not None else _chip(settings)
        self._where = settings.pwm or f"{drv2605.NAME} on I2C bus {settings.bus}"
        self._vibration = Vibration(feeling, time.monotonic_ns())
        self._lock = threading.Lock()
        self._ended = threading.Event()
        try:
            with self._opened() as drive:
                drive(0.0)
        except (OSError, ProtocolError) as error:
            raise DataflowError(f"{self._where}: {_reason(error)}") from error
        self._thread = threading.Thread(target=self._run, name="motor", daemon=True)
        self._thread.start()

    def tell(self, cue: Cue) -> None:
        """Vibrate as `cue` says, from the next step on."""
        with self._lock:
            self._vibration.tell(time.monotonic_ns(), cue.kind, cue.level, cue.distance or 0.0)

    def close(self) -> None:
        """Stop it."""
        self._ended.set()
        self._thread.join(END)

    def _run(self) -> None:
        said = False
        while not self._ended.is_set():
            try:
                with self._opened() as drive:
                    if said:
                        log.warning("%s: is back", self._where)
                        said = False
                    self._drive(drive)
            except (OSError, ProtocolError) as error:
                if not said:
                    log.warning("%s: %s; the motor stands until it is back", self._where, _reason(error))
                    said = True
                self._ended.wait(RETRY)

    def _drive(self, drive: Drive) -> None:
        last: float | None = None
        last_at = 0.0
        try:
            while not self._ended.wait(STEP):
                with self._lock:
                    wanted = self._vibration.strength(time.monotonic_ns())
                now = time.monotonic()
                if wanted != last or now - last_at >= LOOK:  # now and then anyway: a chip that was reset shows
                    drive(wanted)
                    last, last_at = wanted, now
        finally:
            with contextlib.suppress(OSError, ProtocolError):
                drive(0.0)


def _chip(settings: HapticSettings) -> Callable[[], contextlib.AbstractContextManager[Drive]]:
    @contextmanager
    def opened() -> Iterator[Drive]:
        with opened_bus(settings.bus) as transfer:

            def read(register: int) -> int:
                return transfer(drv2605.ADDRESS, bytes([register]), 1)[0]

            def write(register: int, value: int) -> None:
                transfer(drv2605.ADDRESS, bytes([register, value]), 0)

            drv2605.require_device(read(Register.STATUS))
            write(Register.MODE, drv2605.RESET)
            time.sleep(drv2605.RESET_TIME)
            for register, value in drv2605.set_up(settings.motor, read(Register.FEEDBACK), read(Register.CONTROL_3)):
                write(register, value)

            def drive(strength: float) -> None:
                if read(Register.MODE) != drv2605.PLAYING:
                    raise ProtocolError("the chip was reset: it is set up again")
                if (complaint := drv2605.trouble(read(Register.STATUS))) is not None:
                    raise ProtocolError(complaint)
                write(Register.PLAYBACK, drv2605.strength_byte(strength))

            yield drive

    return opened


def _pwm(channel: Path) -> Callable[[], contextlib.AbstractContextManager[Drive]]:
    @contextmanager
    def opened() -> Iterator[Drive]:
        (channel / "duty_cycle").write_text("0")  # first: a period shorter than it is refused
        (channel / "period").write_text(str(PWM_PERIOD))
        (channel / "enable").write_text("1")
        try:
            yield lambda strength: _write(channel / "duty_cycle", round(strength * PWM_PERIOD))
        finally:
            with contextlib.suppress(OSError):
                (channel / "enable").write_text("0")

    return opened


def _write(file: Path, value: int) -> None:
    file.write_text(str(value))


def _reason(error: Exception) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)


if __name__ == "__main__":
    run(Haptic)
