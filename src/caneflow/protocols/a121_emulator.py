"""An exploration server that plays recorded frames of an A121. Knows no clock: the time is told."""

import json
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from caneflow.protocols.a121 import BASE_STEP, SweepSetup
from caneflow.protocols.a121_messages import FAST_BAUD, LONGEST_LINE, frame_line, line
from caneflow.protocols.errors import ProtocolError

TICK_SPAN: Final = 1 << 32
VERSION: Final = "a121-v1.0.0"  # of the sensor's software, as a server names it
TEMPERATURE: Final = 25  # degC
MOST_UNSENT: Final = 1 << 20  # bytes that a slow client may leave; then frames are lost, and the next is `delayed`


@dataclass(frozen=True, kw_only=True, eq=False)
class Played:
    """What an A121 measured."""

    setups: Sequence[SweepSetup]  # of each subsweep; sweeps and rate are those of the first
    times: Sequence[float]  # s, of each frame's last sweep
    frames: Sequence[NDArray[np.int16]]  # (sweeps, points of all subsweeps, 2), I and Q
    flags: Sequence[dict[str, bool]]  # of each frame: data_saturated, ...
    base_step: float = BASE_STEP  # m

    @property
    def points(self) -> int:
        """Of a sweep."""
        return sum(setup.points for setup in self.setups)


@dataclass
class Counts:
    """What was done."""

    requests: int = 0
    refused: int = 0
    sent: int = 0  # frames
    lost: int = 0


class A121Server:
    """Answers one client at a time; the recording runs on from the first start of streaming."""

    def __init__(
        self, played: Played, *, ticks_per_second: int, loss: float = 0.0, random: np.random.Generator
    ) -> None:
        self._played, self._rate = played, ticks_per_second
        self._loss, self._random = loss, random
        self._asked = bytearray()
        self._begin: float | None = None  # s, of the told clock
        self._next = 0
        self._behind = False  # the client did not take a frame
        self._set_up = False
        self.streaming = False
        self.counts = Counts()

    @property
    def over(self) -> bool:
        """Whether every frame is past."""
        return self._next >= len(self._played.frames)

    def client_left(self) -> None:
        """Forget what was half said, and fall still."""
        self._asked.clear()
        self.streaming = self._set_up = False

    def receive(self, data: bytes, now: float) -> bytes:
        """The answers to what came."""
        self._asked += data
        out = b""
        while (end := self._asked.find(b"\n")) >= 0:
            asked = bytes(self._asked[:end])
            del self._asked[: end + 1]
            out += line(self._answer(asked, now))
        if len(self._asked) > LONGEST_LINE:
            self._asked.clear()
        return out

    def next_due(self) -> float | None:
        """When the next frame is due, in s of the told clock; None before the first start, and at the end."""
        return None if self._begin is None or self.over else self._begin + self._since_start(self._next)

    def send_due(self, now: float, *, unsent: int = 0) -> bytes:
        """The frames that are due; `unsent`: bytes that the client has not taken yet."""
        out = b""
        while (due := self.next_due()) is not None and due <= now:
            number, self._next = self._next, self._next + 1
            if not self.streaming:
                continue
            behind = unsent + len(out) > MOST_UNSENT
            if behind or (self._loss and self._random.random() < self._loss):
                self._behind |= behind
                self.counts.lost += 1
                continue
            out += self._frame(number)
            self.counts.sent += 1
        return out

    def _since_start(self, number: int) -> float:
        return self._played.times[number] - self._played.times[0]

    def _frame(self, number: int) -> bytes:
        samples = self._played.frames[number].astype("<i2").tobytes()
        flags = dict(self._played.flags[number])
        flags["frame_delayed"], self._behind = flags.get("frame_delayed", False) or self._behind, False
        tick = math.floor(self._played.times[number] * self._rate) % TICK_SPAN
        return frame_line(tick, len(samples), TEMPERATURE, flags) + samples

    def _answer(self, asked: bytes, now: float) -> dict[str, Any]:
        self.counts.requests += 1
        try:
            request = json.loads(asked)
            if not isinstance(request, dict):
                raise ProtocolError("a request is a JSON object")
            return self._served(request, now)
        except (ValueError, RecursionError, ProtocolError) as error:
            self.counts.refused += 1
            return {"status": "error", "message": str(error)}

    def _served(self, request: dict[str, Any], now: float) -> dict[str, Any]:
        match request.get("cmd"):
            case "get_system_info":
                return {"status": "ok", "system_info": self._system_info()}
            case "get_sensor_info":
                return {"status": "ok", "sensor_info": [{"connected": True, "serial": "emulated"}]}
            case "set_uart_baudrate":
                return {"status": "ok", "message": "set baudrate"}
            case "setup":
                return self._setup(request)
            case "start_streaming":
                if not self._set_up:
                    raise ProtocolError("start_streaming before setup")
                self._begin = now if self._begin is None else self._begin
                self.streaming = True
                return {"status": "start", "message": "Started streaming"}
            case "stop_streaming":
                self.streaming = False
                return {"status": "stop", "message": "Stopped streaming"}
            case other:
                raise ProtocolError(f"unknown command {other!r}")

    def _system_info(self) -> dict[str, Any]:
        return {
            "rss_version": VERSION,
            "sensor": "a121",
            "sensor_count": 1,
            "ticks_per_second": self._rate,
            "hw": "caneflow emulator",
            "max_baudrate": FAST_BAUD,
        }

    def _setup(self, request: dict[str, Any]) -> dict[str, Any]:
        if self.streaming:
            raise ProtocolError("setup while streaming")
        try:
            ((sensor,),) = request["groups"]
            config = sensor["config"]
            asked = [(part["start_point"], part["num_points"], part["step_length"]) for part in config["subsweeps"]]
            sweeps = config["sweeps_per_frame"]
        except (KeyError, TypeError, ValueError) as error:
            raise ProtocolError("setup for one sensor in one group is all that a recording can play") from error
        first = self._played.setups[0]
        there = [(setup.start_point, setup.points, setup.step_length) for setup in self._played.setups]
        if (asked, sweeps) != (there, first.sweeps):
            raise ProtocolError(
                f"the recording has {first.sweeps} sweeps of {_described(there)}; asked for {sweeps} of "
                f"{_described(asked)}"
            )
        self._set_up = True
        return {"status": "ok", "tick_period": 0, "payload_size": 0, "metadata": [[self._metadata()]]}

    def _metadata(self) -> dict[str, Any]:
        played, first = self._played, self._played.setups[0]
        lengths = [setup.points for setup in played.setups]
        return {
            "frame_data_length": first.sweeps * played.points,
            "sweep_data_length": played.points,
            "subsweep_data_offset": [sum(lengths[:number]) for number in range(len(lengths))],
            "subsweep_data_length": lengths,
            "calibration_temperature": TEMPERATURE,
            "tick_period": 0,
            "base_step_length_m": played.base_step,
            "max_sweep_rate": 1.0 / sum(setup.sweep_time for setup in played.setups),
            "high_speed_mode": False,
        }


def _described(parts: Sequence[tuple[Any, Any, Any]]) -> str:
    return " and ".join(f"{points} points from {start} every {step}" for start, points, step in parts)


class Outbox:
    """Bytes on their way to a client that takes some at a time."""

    def __init__(self) -> None:
        self._waiting: deque[bytes] = deque()
        self.size = 0

    def put(self, data: bytes) -> None:
        """Let `data` follow what waits."""
        if data:
            self._waiting.append(data)
            self.size += len(data)

    def head(self) -> bytes:
        """What to send next; b"" when nothing waits."""
        return self._waiting[0] if self._waiting else b""

    def took(self, count: int) -> None:
        """The client has taken `count` bytes of the head."""
        head = self._waiting.popleft()
        self.size -= count
        if count < len(head):
            self._waiting.appendleft(head[count:])

    def clear(self) -> None:
        """The client has gone."""
        self._waiting.clear()
        self.size = 0
