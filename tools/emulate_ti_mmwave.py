"""`caneflow emulate ti_mmwave`: a TI radar that is not there, played from a recording over one or two serial ports."""

import select
import signal
import time
from contextlib import ExitStack
from pathlib import Path
from tempfile import gettempdir
from typing import Annotated

import numpy as np
import typer

from caneflow.errors import CaneflowError
from caneflow.messages import RadarPoints
from caneflow.protocols.ti_mmwave import built
from caneflow.protocols.ti_mmwave_emulator import MmwaveRadar
from caneflow.recording import Recording
from caneflow.serial_ports import MadePort, made_port

CLI, DATA = (Path(gettempdir()) / f"caneflow-mmwave-{name}" for name in ("cli", "data"))
LONGEST_WAIT = 0.2  # s
LAST_WORDS = 0.5  # s that the driver may take for what was sent last


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="Recording.", show_default=False)],
    cli: Annotated[Path, typer.Option(metavar="PATH", help="The port to make that takes the configuration.")] = CLI,
    data: Annotated[Path, typer.Option(metavar="PATH", help="The port to make that sends points.")] = DATA,
    one_port: Annotated[
        bool, typer.Option("--one-port", help="Send points on the first port, as an IWRL6432.")
    ] = False,
    stream: Annotated[
        str | None, typer.Option(metavar="NODE/PORT", help="Which radar, where the recording has several.")
    ] = None,
    loss: Annotated[
        float, typer.Option(min=0, max=1, metavar="PART", help="Packets that never come, as a part of all.")
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Of what gets lost.")] = 1,
) -> None:
    """Be a TI mmWave radar that sees what was recorded, once, in real time. Ends with the recording.

    It takes any configuration that has the usual lines. The recording begins with the first sensorStart.

    Example: caneflow emulate ti_mmwave walk.mcap --cli /tmp/cli --data /tmp/data & caneflow run cane_mmwave.yaml
    """
    times, packets = played(recording, stream)
    radar = MmwaveRadar(times, packets, loss=loss, random=np.random.default_rng(seed))
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends like Ctrl-C
    try:
        with ExitStack() as ports:
            commands = ports.enter_context(made_port(cli))
            points = commands if one_port else ports.enter_context(made_port(data))
            print(f"TI mmWave radar of {recording} on {cli}{'' if one_port else f' and {data}'}", flush=True)
            serve(radar, commands, points)
        print("the recording is over", flush=True)
    finally:
        print(f"{radar.lines} lines, {radar.refused} refused; {radar.sent} packets, {radar.lost} lost", flush=True)


def played(path: Path, stream: str | None = None) -> tuple[list[float], list[bytes]]:
    """When (s) which packet is sent."""
    with Recording(path) as recording:
        there = {f"{found.node}/{found.port}": (found.node, found.port) for found in recording.streams_of(RadarPoints)}
        if stream is None and len(there) == 1:
            (stream,) = there
        if stream not in there:
            asked = f"no radar points {stream}" if stream else "choose one radar with --stream"
            raise CaneflowError(f"{path}: {asked}; there are {', '.join(there) or 'none'}")
        samples = [found.decoded() for found in recording.samples([there[stream]])]
    frames = [sample for sample in samples if isinstance(sample, RadarPoints)]
    steps = np.diff([frame.stamp for frame in frames])
    period = float(np.median(steps)) if len(steps) else 1.0  # ns
    numbers = [round((frame.stamp - frames[0].stamp) / period) for frame in frames]
    times = [(frame.stamp - frames[0].stamp) * 1e-9 for frame in frames]
    packets = [
        built(number + 1, frame.position, frame.doppler, frame.snr, frame.noise)
        for number, frame in zip(numbers, frames, strict=True)
    ]
    return times, packets


def serve(radar: MmwaveRadar, commands: MadePort, points: MadePort) -> None:
    """Answer and send until the recording is over."""
    while not radar.over:
        now = time.monotonic()
        due = radar.next_due()
        wait = LONGEST_WAIT if due is None else min(max(due - now, 0.0), LONGEST_WAIT)
        if select.select([commands], [], [], wait)[0]:
            commands.write(radar.receive(commands.read() or b"", time.monotonic()))
        for packet in radar.send_due(time.monotonic()):
            _write_all(points, packet)
    time.sleep(LAST_WORDS)


def _write_all(port: MadePort, data: bytes) -> None:
    """What a terminal does not take within its time is lost, as on a wire."""
    until = time.monotonic() + LAST_WORDS
    while data and time.monotonic() < until:
        select.select([], [port], [], LONGEST_WAIT)
        data = data[port.write(data) :]
