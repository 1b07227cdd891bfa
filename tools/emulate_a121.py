"""`caneflow emulate a121`: an Acconeer A121 that is not there, played from a recording over TCP or a serial port."""

import select
import signal
import socket
import time
from contextlib import suppress
from pathlib import Path
from tempfile import gettempdir
from typing import Annotated, Protocol

import numpy as np
import typer
from numpy.typing import NDArray

from caneflow.errors import CaneflowError
from caneflow.messages import RadarFrame
from caneflow.protocols import a121
from caneflow.protocols.a121_emulator import A121Server, Outbox, Played
from caneflow.protocols.errors import ProtocolError
from caneflow.recording import Recording
from caneflow.recording.a121_file import read_session
from caneflow.serial_ports import made_port

MCAP = b"\x89MCAP"  # how a recording begins; all else is taken for the vendor's HDF5
PORT = str(Path(gettempdir()) / "caneflow-a121")
LONGEST_WAIT = 0.2  # s
AT_ONCE = 65_536  # bytes
LAST_WORDS = 2.0  # s that a client may take for what was sent last
TCP_TICKS, SERIAL_TICKS = 1_000_000, 1_000  # per second, of an XC120 and of an XM125
LARGEST = 2.0**15 - 1


def command(
    recording: Annotated[
        Path, typer.Argument(metavar="REC|FILE", help="Recording, or HDF5 of Acconeer's tools.", show_default=False)
    ],
    port: Annotated[
        str,
        typer.Option(
            metavar="PATH|TCP", help="The serial port to make, or a TCP port of this host; 0: one that is free."
        ),
    ] = PORT,
    stream: Annotated[
        str | None, typer.Option(metavar="NODE/PORT", help="Which radar, where the recording has several.")
    ] = None,
    session: Annotated[int, typer.Option(min=0, metavar="N", help="Session of an HDF5 file, from 0.")] = 0,
    loss: Annotated[
        str, typer.Option(metavar="PART", help="Part of the frames that never come, e.g. 0.02 or 2%.")
    ] = "0",
    seed: Annotated[int, typer.Option(min=0, help="Of what gets lost.")] = 1,
) -> None:
    """Be an A121 behind an exploration server that sees what was recorded, once, in real time. Ends with the recording.

    It takes only a setup that measures the recorded points. The recording begins with the first start of streaming.

    Example: caneflow emulate a121 walk.mcap --port 6110 & caneflow run cane_a121.yaml --set radar.host=127.0.0.1
    """
    on_tcp = port.isdecimal()
    if on_tcp and int(port) > 65_535:
        raise CaneflowError(f"--port {port}: a TCP port is 0 to 65535; anything else is the path of a serial port")
    server = A121Server(
        played(recording, stream, session),
        ticks_per_second=TCP_TICKS if on_tcp else SERIAL_TICKS,
        loss=_share(loss),
        random=np.random.default_rng(seed),
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends like Ctrl-C
    try:
        if on_tcp:
            _on_tcp(server, recording, int(port))
        else:
            on_serial_port(server, recording, Path(port))
        print("the recording is over", flush=True)
    finally:
        counts = server.counts
        print(
            f"{counts.requests} requests, {counts.refused} refused; {counts.sent} frames sent, {counts.lost} lost",
            flush=True,
        )


def played(path: Path, stream: str | None = None, session: int = 0) -> Played:
    """What an A121 measured, of a recording or of a file of the vendor's; raises CaneflowError for another radar's."""
    try:
        with path.open("rb") as file:
            is_recording = file.read(len(MCAP)) == MCAP
    except OSError as error:
        raise CaneflowError(f"{path}: {error.strerror or error}") from error
    return _of_recording(path, stream) if is_recording else _of_file(path, session)


def _of_file(path: Path, number: int) -> Played:
    session = read_session(path, number)
    sweeps = session.frames.shape[1]
    try:
        setups = [
            a121.SweepSetup(
                start_point=int(part["start_point"]),
                points=int(part["num_points"]),
                step_length=int(part["step_length"]),
                profile=a121.profile_number(part["profile"]),
                averages=int(part.get("hwaas", 8)),
                sweep_rate=session.sweep_rate,
                sweeps=sweeps,
            )
            for part in session.subsweeps
        ]
    except ProtocolError as error:
        raise CaneflowError(f"{path}: {error}") from error
    samples = np.stack([session.frames["real"], session.frames["imag"]], axis=-1)
    flags = [
        {"data_saturated": bool(saturated), "frame_delayed": bool(delayed)}
        for saturated, delayed in zip(session.saturated, session.delayed, strict=True)
    ]
    times = (np.asarray(session.ticks, np.int64) / session.ticks_per_second).tolist()
    return Played(setups=setups, times=times, frames=list(samples), flags=flags, base_step=session.base_step)


def _of_recording(path: Path, stream: str | None) -> Played:
    with Recording(path) as recording:
        there = {f"{found.node}/{found.port}": (found.node, found.port) for found in recording.streams_of(RadarFrame)}
        if stream is None and len(there) == 1:
            (stream,) = there
        if stream not in there:
            asked = f"no radar {stream}" if stream else "choose one radar with --stream"
            raise CaneflowError(f"{path}: {asked}; there are {', '.join(there) or 'none'}")
        frames = [found.decoded() for found in recording.samples([there[stream]])]
    first = frames[0]
    assert isinstance(first, RadarFrame)
    if first.scans.dtype.kind != "c":
        raise CaneflowError(f"{path}: {stream} holds scans of real numbers; an A121 measures complex ones")
    setup = _setup(first)
    times, samples = [], []
    for frame in frames:
        assert isinstance(frame, RadarFrame)
        if frame.scans.shape != first.scans.shape:
            raise CaneflowError(f"{path}: frames of {first.scans.shape} and {frame.scans.shape}; an A121's are alike")
        times.append(frame.stamp * 1e-9)
        samples.append(_raw(frame.scans))
    return Played(setups=[setup], times=times, frames=samples, flags=[{}] * len(frames))


def _setup(frame: RadarFrame) -> a121.SweepSetup:
    """How the radar was set that measured a frame."""
    profile = min(a121.PROFILES, key=lambda each: abs(a121.bandwidth_of(each) - frame.bandwidth))
    return a121.SweepSetup(
        start_point=round(frame.range_start / a121.BASE_STEP),
        points=frame.scans.shape[1],
        step_length=max(round(frame.range_step / a121.BASE_STEP), 1),
        profile=profile,
        sweep_rate=1.0 / frame.scan_period,
        sweeps=len(frame.scans),
    )


def _raw(scans: NDArray[np.complexfloating]) -> NDArray[np.int16]:
    """Samples as the radar sends them: int16, the phase growing with range."""
    parts = np.stack([scans.real, -scans.imag], axis=-1)
    return np.clip(np.rint(parts), -LARGEST, LARGEST).astype(np.int16)


def _share(text: str) -> float:
    try:
        value = float(text.removesuffix("%")) * (0.01 if text.endswith("%") else 1.0)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 1.0:
        raise typer.BadParameter(f"{text!r} is not part of a whole, e.g. 0.02 or 2%", param_hint="--loss")
    return value


# --- ways to it -------------------------------------------------------------------------------------------------


class Client(Protocol):
    """Who is at the other end: a file to wait for, bytes from it and to it."""

    def fileno(self) -> int:
        """For `select`."""

    def read(self) -> bytes | None:
        """What came; None: it has gone."""

    def write(self, data: bytes) -> int:
        """Bytes that it took."""


class SocketClient:
    """A client on TCP."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        connection.setblocking(False)

    def fileno(self) -> int:
        """For `select`."""
        return self._connection.fileno()

    def read(self) -> bytes | None:
        """What came; None: it has hung up."""
        try:
            return self._connection.recv(AT_ONCE) or None
        except BlockingIOError:
            return b""
        except OSError:
            return None

    def write(self, data: bytes) -> int:
        """Bytes that it took."""
        with suppress(OSError):
            return self._connection.send(data)
        return 0


def serve(server: A121Server, client: Client) -> None:
    """Serve a client until it leaves, or the recording is over and it has had all."""
    outbox = Outbox()
    ended: float | None = None
    while True:
        now = time.monotonic()
        due = server.next_due()
        wait = LONGEST_WAIT if due is None else min(max(due - now, 0.0), LONGEST_WAIT)
        readable, writable, _ = select.select([client], [client] if outbox.size else [], [], wait)
        now = time.monotonic()
        if readable:
            received = client.read()
            if received is None:
                break
            outbox.put(server.receive(received, now))
        outbox.put(server.send_due(now, unsent=outbox.size))
        if writable or outbox.size:
            outbox.took(client.write(outbox.head()))
        if server.over:
            ended = now if ended is None else ended
            if not outbox.size or now - ended > LAST_WORDS:
                break
    server.client_left()


def _on_tcp(server: A121Server, recording: Path, port: int) -> None:
    try:
        with socket.create_server(("127.0.0.1", port)) as listening:
            print(f"A121 of {recording} on 127.0.0.1, TCP port {listening.getsockname()[1]}", flush=True)
            while not server.over:
                if select.select([listening], [], [], LONGEST_WAIT)[0]:
                    with listening.accept()[0] as connection:
                        serve(server, SocketClient(connection))
                else:
                    server.send_due(time.monotonic())  # the world goes on
    except OSError as error:
        raise CaneflowError(f"TCP port {port}: {error.strerror or error}") from error


def on_serial_port(server: A121Server, recording: Path, path: Path) -> None:
    """Make the port and serve whoever opens it, until the recording is over."""
    with made_port(path) as port:
        print(f"A121 of {recording} on {path}", flush=True)
        serve(server, port)
