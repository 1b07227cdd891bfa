"""Acconeer's exploration protocol: lines of JSON both ways, and behind some of the server's lines samples.

The client writes one line, the server answers one; where that has `payload_size`, so many bytes follow. Facts from the
vendor's source (github acconeer/acconeer-python-exploration @ e29f30d).
"""

import json
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from caneflow.protocols.a121 import BUFFER_POINTS, BYTES_PER_POINT, SweepSetup
from caneflow.protocols.errors import ProtocolError

TCP_PORT: Final = 6110
FIRST_BAUD: Final = 115_200  # of a UART, until another rate was agreed
FAST_BAUD: Final = 2_000_000
SENSOR: Final = 1  # the number of the sensor that measures
LONGEST_LINE: Final = 65_536  # bytes
LARGEST_PAYLOAD: Final = BUFFER_POINTS * BYTES_PER_POINT
RESULT_FLAGS: Final = ("data_saturated", "frame_delayed", "calibration_needed")


class Answer(NamedTuple):
    """One line of the server, and the bytes behind it."""

    said: dict[str, Any]
    payload: bytes


class Metadata(NamedTuple):
    """What a radar makes of a setup."""

    frame_points: int  # samples of a frame
    sweep_points: int
    base_step: float  # m
    fastest_sweeps: float  # Hz


class Frame(NamedTuple):
    """One frame as it came."""

    tick: int  # uint32, of the device's clock
    saturated: bool
    delayed: bool
    uncalibrated: bool
    samples: NDArray[np.int16]  # (sweeps, points, 2), I and Q


def line(said: dict[str, Any]) -> bytes:
    """A line of either side."""
    return json.dumps(said, separators=(",", ":")).encode() + b"\n"


def setup_request(setup: SweepSetup) -> dict[str, Any]:
    """Asks a server to measure so with its first sensor."""
    return {"cmd": "setup", "groups": [[{"sensor_id": SENSOR, "config": setup.config()}]]}


def frame_line(tick: int, size: int, temperature: int, flags: dict[str, bool]) -> bytes:
    """The line in front of a frame's `size` bytes."""
    result = {"tick": tick, "temperature": temperature, **{name: flags.get(name, False) for name in RESULT_FLAGS}}
    return line({"status": "ok", "payload_size": size, "result_info": [[result]]})


class Lines:
    """Takes bytes as they come, gives whole lines with what follows them."""

    def __init__(self) -> None:
        self._held = bytearray()

    def feed(self, data: bytes) -> Iterator[Answer]:
        """Yield what is whole; raises ProtocolError for what is not a line of the protocol."""
        self._held += data
        while (found := self._next()) is not None:
            yield found

    def _next(self) -> Answer | None:
        end = self._held.find(b"\n")
        if end < 0:
            if len(self._held) > LONGEST_LINE:
                raise ProtocolError(f"{len(self._held)} bytes without the end of a line")
            return None
        try:
            said = json.loads(bytes(self._held[:end]))
        except (ValueError, RecursionError) as error:
            raise ProtocolError(f"a line that is not JSON: {bytes(self._held[:60])!r}") from error
        if not isinstance(said, dict):
            raise ProtocolError(f"a line that is not a JSON object: {bytes(self._held[:60])!r}")
        size = said.get("payload_size", 0)
        if not isinstance(size, int) or not 0 <= size <= LARGEST_PAYLOAD:
            raise ProtocolError(f"payload_size is {size!r}; a frame has 0 to {LARGEST_PAYLOAD} bytes")
        if len(self._held) < end + 1 + size:
            return None
        payload = bytes(self._held[end + 1 : end + 1 + size])
        del self._held[: end + 1 + size]
        return Answer(said, payload)


def metadata_of(said: dict[str, Any]) -> Metadata:
    """What the answer to a setup tells; raises ProtocolError when it does not."""
    try:
        found = said["metadata"][0][0]
        return Metadata(
            int(found["frame_data_length"]),
            int(found["sweep_data_length"]),
            float(found["base_step_length_m"]),
            float(found["max_sweep_rate"]),
        )
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ProtocolError(f"an answer to setup without its metadata: {str(said)[:80]}") from error


def frame_of(answer: Answer, setup: SweepSetup) -> Frame:
    """The frame in an answer; raises ProtocolError for one of another shape."""
    try:
        result = answer.said["result_info"][0][0]
        tick = int(result["tick"])
        saturated, delayed, uncalibrated = (bool(result.get(name)) for name in RESULT_FLAGS)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise ProtocolError(f"a frame without its result: {str(answer.said)[:80]}") from error
    wanted = setup.sweeps * setup.points * BYTES_PER_POINT
    if len(answer.payload) != wanted:
        raise ProtocolError(f"a frame of {len(answer.payload)} bytes; {setup.sweeps} sweeps have {wanted}")
    samples = np.frombuffer(answer.payload, "<i2").reshape(setup.sweeps, setup.points, 2)
    return Frame(tick, saturated, delayed, uncalibrated, samples)
