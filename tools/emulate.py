"""`caneflow emulate`: a device that is not there, played from a recording over the transport that its driver uses."""

import math
import os
import select
import signal
import socket
import time
import tty
from collections.abc import Generator, Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import gettempdir
from typing import Annotated, Any, TypeAlias

import numpy as np
import typer
from numpy.typing import NDArray

from caneflow.errors import CaneflowError
from caneflow.messages import Imu, RadarFrame, Sample
from caneflow.physics import LOCAL_GRAVITY
from caneflow.protocols import bno055_emulator, mrm, mrm_emulator
from caneflow.protocols.bno055 import Measurement, registers
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm_scans import (
    ANTENNA_DELAY_PS,
    BIN_SECONDS,
    CLOCK_SPAN,
    ID_SPAN,
    Scan,
    range_start,
    range_step,
    split_scan,
)
from caneflow.recording import Recording

MCAP = b"\x89MCAP"  # how a recording begins; a log begins with a configuration block
LONGEST_WAIT = 0.5  # s
SERIAL_PORT = Path(gettempdir()) / "caneflow-bno055"
TERMINALS = Path("/dev/pts")


# --- options of both --------------------------------------------------------------------------------------------


def share(text: str) -> float:
    """A part of a whole: `0.02` or `2%`."""
    number = str(text)
    try:
        value = float(number.removesuffix("%")) * (0.01 if number.endswith("%") else 1.0)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= 1.0:
        raise typer.BadParameter(f"{text!r}: not a share; expected e.g. 0.02 or 2%")
    return value


def span(text: str) -> tuple[float, float]:
    """`AT:FOR` as two numbers of s."""
    try:
        at, lasts = map(float, str(text).split(":"))
    except ValueError:
        at = lasts = math.nan
    if not (at >= 0.0 and lasts > 0.0):
        raise typer.BadParameter(f"{text!r} is not an AT:FOR, e.g. 10:3 for 3 s from second 10 on")
    return at, lasts


def _part_of(what: str) -> Any:
    return typer.Option(parser=share, metavar="PART", help=f"Part of {what}, e.g. 0.02 or 2%.")


def _spans_in_which(what: str) -> Any:
    return typer.Option(metavar="AT:FOR", help=f"From AT, for FOR s, {what} (may be given again).")


Spans: TypeAlias = list[str] | None
Begin: TypeAlias = Annotated[
    float | None,
    typer.Option(metavar="UNIX", help="Unix time (s) at which the recording begins; else when it is first set going."),
]
Seed: TypeAlias = Annotated[int, typer.Option(min=0, help="Seed of the random faults.")]


def _spans(texts: Spans) -> tuple[tuple[float, float], ...]:
    return tuple(sorted(map(span, texts or ())))


# --- BNO055 -----------------------------------------------------------------------------------------------------


def bno055(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="Recording.", show_default=False)],
    port: Annotated[
        Path, typer.Option(metavar="PATH", help="The serial port to make: a link to a pseudo-terminal.")
    ] = SERIAL_PORT,
    stream: Annotated[
        str | None, typer.Option(metavar="NODE/PORT", help="Which IMU, where the recording has several.")
    ] = None,
    overruns: Annotated[float, _part_of("the requests that are answered by EE 07, bus overrun")] = 0.0,
    loss: Annotated[float, _part_of("the requests that are never answered")] = 0.0,
    short: Annotated[float, _part_of("the answers that end too early")] = 0.0,
    glitches: Annotated[float, _part_of("the readings with a value at its end, or all zeros or ones")] = 0.0,
    page: Annotated[int, typer.Option(min=0, max=1, help="Page of registers that another program left chosen.")] = 0,
    freeze: Annotated[Spans, _spans_in_which("or until a reset, the values stand still")] = None,
    silence: Annotated[Spans, _spans_in_which("it does not answer")] = None,
    unplug: Annotated[Spans, _spans_in_which("there is no port and no power")] = None,
    reset: Annotated[
        list[float] | None, typer.Option(metavar="AT", help="At AT the chip starts again by itself (likewise).")
    ] = None,
    begin: Begin = None,
    seed: Seed = 1,
) -> None:
    """Be a BNO055 on a UART that measures what was recorded, once, in real time. Ends with the recording.

    AT is in s of the recording.

    Example: caneflow emulate bno055 walk.mcap & caneflow run dataflow.yaml --set imu.port=/tmp/caneflow-bno055
    """
    outages = list(_spans(unplug))
    faults = bno055_emulator.Faults(
        overruns=overruns,
        loss=loss,
        short=short,
        glitches=glitches,
        page=page,
        freezes=_spans(freeze),
        silences=_spans(silence),
        resets=tuple(reset or ()),
    )
    motion = _motion(recording, stream)
    now = time.monotonic()
    chip = bno055_emulator.Emulator(
        motion,
        faults,
        np.random.default_rng(seed),
        now=now,
        begin=None if begin is None else now + begin - time.time(),
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends like Ctrl-C
    plug = _Plug(port)
    try:
        plug.put_in()
        print(f"BNO055 of {recording} on {port}", flush=True)
        _serve_bno055(chip, plug, outages)
        print("the recording is over", flush=True)
    finally:
        plug.pull_out()
        tally = chip.tally
        print(
            f"{tally.requests} requests, {tally.overruns} overruns, {tally.lost} lost, {tally.short} cut short; "
            f"{tally.bursts} readings, {tally.glitches} of them glitched, "
            f"of {len(motion.times)} values {len(motion.times) - len(tally.seen)} were not read",
            flush=True,
        )


class _Plug:
    """A serial port that can be pulled out: a pseudo-terminal under a name that stays."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._ends: tuple[int, ...] = ()

    def put_in(self) -> None:
        """Make the port; raises CaneflowError when something else has its name."""
        # What an emulator that was killed left behind is a link to a pseudo-terminal.
        if os.path.lexists(self._path) and not (self._path.is_symlink() and self._path.readlink().parent == TERMINALS):
            raise CaneflowError(f"{self._path}: exists and is not an emulator's port; choose another name with --port")
        # This end of the terminal stays open too, or a driver that leaves would take the terminal with it.
        self._ends = os.openpty()
        tty.setraw(self._ends[1])
        os.set_blocking(self._ends[0], False)
        beside = self._path.with_name(f"{self._path.name}.{os.getpid()}")
        beside.symlink_to(os.ttyname(self._ends[1]))
        beside.replace(self._path)

    def pull_out(self) -> None:
        """Take the port away."""
        if self._ends:
            self._path.unlink(missing_ok=True)
        for end in self._ends:
            os.close(end)
        self._ends = ()

    def wait(self, seconds: float) -> bytes:
        """What was written to the port, after up to `seconds` of waiting for it."""
        if not select.select(self._ends[:1], [], [], seconds)[0]:
            return b""
        return os.read(self._ends[0], 4096)

    def write(self, data: bytes) -> None:
        """Say something; what is not read is lost, as on a wire."""
        with suppress(BlockingIOError):
            os.write(self._ends[0], data)


def _serve_bno055(chip: bno055_emulator.Emulator, plug: _Plug, outages: list[tuple[float, float]]) -> None:
    """Answer until the recording is over."""
    now = time.monotonic()
    while not chip.ended(now):
        due = chip.next_time()
        received = plug.wait(LONGEST_WAIT if due is None else min(max(due - now, 0.0), LONGEST_WAIT))
        now = time.monotonic()
        if received:
            chip.receive(received, now)
        if sent := chip.send(now):
            plug.write(sent)
        if outages and chip.begin is not None and now >= chip.begin + outages[0][0]:
            _, lasts = outages.pop(0)
            plug.pull_out()
            print(f"unplugged for {lasts:g} s", flush=True)
            time.sleep(lasts)
            plug.put_in()
            now = time.monotonic()
            chip.power_on(now)
            print("plugged in again", flush=True)


def _motion(path: Path, stream: str | None) -> bno055_emulator.Motion:
    """What a recording's IMU measured, as the registers of a BNO055."""
    with Recording(path) as recording:
        name = _stream_of(recording, stream, Imu, "IMU")
        span = recording.span()
        assert span is not None  # the IMU has said something
        samples = [(found.stamp, found.decoded()) for found in recording.samples([name])]
    blocks = [_registers(path, sample) for _, sample in samples]
    return bno055_emulator.Motion(times=[(stamp - span[0]) / 1e9 for stamp, _ in samples], blocks=blocks)


def _registers(path: Path, sample: Sample) -> bytes:
    if not isinstance(sample, Imu) or sample.orientation is None or sample.linear_accel is None:
        raise CaneflowError(f"{path}: the IMU gave no orientation or no linear acceleration, which a BNO055 does")
    w, x, y, z = sample.orientation
    ax, ay, az = sample.linear_accel
    gx, gy = 2 * LOCAL_GRAVITY * (x * z - w * y), 2 * LOCAL_GRAVITY * (y * z + w * x)
    gz = LOCAL_GRAVITY * (1 - 2 * (x * x + y * y))
    return registers(
        Measurement(
            gyro=sample.gyro,
            orientation=sample.orientation,
            linear_accel=sample.linear_accel,
            gravity=(gx, gy, gz),
            temperature=25,
            calibration=sample.calibration or (3, 3, 3, 3),
            accel=sample.accel or (ax + gx, ay + gy, az + gz),
            mag=sample.mag,
        )
    )


# --- P440 -------------------------------------------------------------------------------------------------------


def p440(
    recording: Annotated[
        Path,
        typer.Argument(metavar="REC|LOG", help="Recording, or log of raw MRM packets.", show_default=False),
    ],
    host: Annotated[str, typer.Option(metavar="ADDRESS", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="UDP port; 0: one that is free.")] = mrm.UDP_PORT,
    stream: Annotated[
        str | None, typer.Option(metavar="NODE/PORT", help="Which radar, where the recording has several.")
    ] = None,
    loss: Annotated[float, _part_of("the datagrams that get lost, both ways")] = 0.0,
    reorder: Annotated[float, _part_of("the scan packets that up to 3 others overtake")] = 0.0,
    duplicate: Annotated[float, _part_of("the scan packets that come twice")] = 0.0,
    freeze: Annotated[Spans, _spans_in_which("or until it is started again, no scans come")] = None,
    unplug: Annotated[Spans, _spans_in_which("it has no power; then it has booted")] = None,
    begin: Begin = None,
    seed: Seed = 1,
) -> None:
    """Be a P440 on UDP that sees what was recorded, once, in real time. Ends with the recording.

    AT is in s of the recording.

    Example: caneflow emulate p440 walk.mcap --loss 0.02 & caneflow run dataflow.yaml --set radar.host=127.0.0.1
    """
    faults = mrm_emulator.Faults(
        loss=loss, reorder=reorder, duplicate=duplicate, freezes=_spans(freeze), unplugs=_spans(unplug)
    )
    is_log = not _starts_with(recording, MCAP)
    config, moments = _moments_of_log(recording) if is_log else _moments_of_recording(recording, stream)
    radar = mrm_emulator.RadarEmulator(
        moments,
        config=config,
        random=np.random.default_rng(seed),
        faults=faults,
        begin=None if begin is None else time.monotonic() + begin - time.time(),
    )
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            udp.bind((host, port))
            signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends like Ctrl-C
            print(f"P440 of {recording} on {host}, UDP port {udp.getsockname()[1]}", flush=True)
            _serve_p440(radar, udp)
        print("the recording is over", flush=True)
    except OSError as error:
        raise CaneflowError(f"{host}, UDP port {port}: {error.strerror or error}") from error
    finally:
        counts = radar.counts
        print(
            f"{'scanning' if radar.scanning else 'stopped'}; "
            f"{counts.requests} requests, {counts.unknown} not understood; "
            f"{counts.scans} {'packets' if is_log else 'scans'} played, {counts.packets} datagrams sent, "
            f"{counts.lost} lost, {counts.reordered} reordered, {counts.duplicated} doubled",
            flush=True,
        )


def _serve_p440(radar: mrm_emulator.RadarEmulator, udp: socket.socket) -> None:
    """Serve the one who asked last, until the recording is over."""
    client: tuple[str, int] | None = None
    scanning = False
    while not radar.over:
        now = time.monotonic()
        due = radar.next_due(now)
        wait = LONGEST_WAIT if due is None else min(max(due - now, 0.0), LONGEST_WAIT)
        requests = select.select([udp], [], [], wait)[0]
        now = time.monotonic()
        out = radar.send_due(now)
        if requests:
            message, client = udp.recvfrom(65_535)
            out += radar.receive(message, now)
        if client is None:
            continue
        for packet in out:
            udp.sendto(packet, client)
        if radar.scanning != scanning:
            scanning = radar.scanning
            print(f"scans for {client[0]}:{client[1]}" if scanning else "stopped", flush=True)


def _starts_with(path: Path, magic: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(magic)) == magic


def _moments_of_log(path: Path) -> tuple[mrm.RadarConfig, Iterator[mrm_emulator.Moment]]:
    try:
        config, moments = mrm_emulator.moments_of_log(path.read_bytes())
        return config, iter(list(moments))
    except ProtocolError as error:
        raise CaneflowError(f"{path}: {error}") from error


def _moments_of_recording(path: Path, stream: str | None) -> tuple[mrm.RadarConfig, Iterator[mrm_emulator.Moment]]:
    """How a radar would have been set, and what it would have sent; draws from the file as it is played."""
    scans = _scans(path, stream)
    _, first = next(scans)
    scans.close()
    config = mrm.RadarConfig(node_id=1, scan_start_ps=first.scan_start_ps, scan_stop_ps=first.scan_stop_ps)
    moments = (
        mrm_emulator.Moment(time, tuple(mrm.build(packet) for packet in split_scan(scan)))
        for time, scan in _scans(path, stream)
    )
    return config, moments


def _scans(path: Path, stream: str | None) -> Generator[tuple[float, Scan], None, None]:
    """The scans of a recording's radar as the radar sent them, each with its time (s since the recording began)."""
    with Recording(path) as recording:
        name = _stream_of(recording, stream, RadarFrame, "radar")
        span = recording.span()
        assert span is not None  # the radar has said something
        number = 0
        for found in recording.samples([name]):
            frame = found.decoded()
            if not isinstance(frame, RadarFrame) or frame.scans.dtype.kind != "i":
                raise CaneflowError(f"{path}: {found.key} holds no integer scans, which are all that a P440 sends")
            last = (found.stamp - span[0]) / 1e9
            for back, samples in zip(range(len(frame.scans) - 1, -1, -1), frame.scans, strict=True):
                taken = max(last - back * frame.scan_period, 0.0)
                yield taken, _scan(frame, samples, number, taken)
                number += 1


def _scan(frame: RadarFrame, samples: NDArray[np.integer], number: int, taken: float) -> Scan:
    """One row of a frame, taken `taken` s after the radar's boot, as the radar calls it."""
    step_bins = max(round(frame.range_step / range_step(1)), 1)
    start_ps = round(frame.range_start / range_start(1.0, 0.0) + ANTENNA_DELAY_PS)
    return Scan(
        source_id=1,
        message_id=number % ID_SPAN,
        timestamp_ms=math.floor(1e3 * taken + 1e-6) % CLOCK_SPAN,  # the margin: 0.58 s are 580 ms
        scan_start_ps=start_ps,
        scan_stop_ps=start_ps + round(len(samples) * step_bins * BIN_SECONDS * 1e12),
        scan_step_bins=step_bins,
        scan_type=1,
        antenna_id=1,
        operation_mode=mrm.MODE_MRM,
        samples=samples.astype(np.int32),
    )


# --- both -------------------------------------------------------------------------------------------------------


def _stream_of(recording: Recording, stream: str | None, kind: type[Sample], what: str) -> tuple[str, str]:
    """Node and port of the stream of `kind` that is meant."""
    there = {f"{found.node}/{found.port}": found for found in recording.streams_of(kind)}
    if stream is None and len(there) == 1:
        (stream,) = there
    if stream not in there:
        asked = f"no {what} {stream}" if stream else f"choose one {what} with --stream"
        raise CaneflowError(f"{recording.path}: {asked}; there are {', '.join(there) or 'none'}")
    return there[stream].node, there[stream].port


commands = {
    "bno055": bno055,
    "p440": p440,
    "a121": "emulate_a121",
    "ti_mmwave": "emulate_ti_mmwave",
    "mb1202": "emulate_mb1202",
    "vl53l5cx": "emulate_vl53l5cx",
    "vl53l1x": "emulate_vl53l1x",
    "drv2605": "emulate_drv2605",
}
