"""`caneflow import a121`: a recording of an HDF5 file of Acconeer's tools."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from caneflow.errors import CaneflowError
from caneflow.messages import NAME, NAME_RULE, RadarFrame, numbered, sample_key
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.protocols import a121 as radar
from caneflow.protocols.errors import ProtocolError
from caneflow.recording import RecordingWriter
from caneflow.recording.a121_file import A121Session, read_session, session_names


def a121(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="HDF5 recording of an A121.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="REC", help="Recording to write.")],
    session: Annotated[
        int, typer.Option(min=0, metavar="N", help="Session of the file, from 0: files often hold several.")
    ] = 0,
    subsweep: Annotated[
        int, typer.Option(min=0, metavar="N", help="Part of the sweep, from 0, where it consists of several.")
    ] = 0,
    range_offset: Annotated[
        float,
        typer.Option(metavar="M", help="m that the radar measures too far: it varies by centimetres with the profile."),
    ] = 0.0,
    flow: Annotated[str, typer.Option(help="Flow under whose name it is recorded.")] = "cane",
    stream: Annotated[str, typer.Option(metavar="NODE/PORT", help="The radar's node and port.")] = "radar/frame",
    overwrite: Overwrite = False,
) -> None:
    """Make a recording of an Acconeer A121's file: one sample per frame, positive Doppler approaching.

    Stamps are the radar's own time, 0 at the first sweep: a line through the ticks of its clock, which shows whole
    milliseconds on an XM125. Frames in which the receiver was saturated are left out, and counted. The extra `a121`
    brings what reads the file.

    Example: caneflow import a121 surface.h5 -o surface.mcap
    """
    node, _, port = stream.partition("/")
    for name in (flow, node, port):
        if not NAME.fullmatch(name):
            raise CaneflowError(f"{flow}/{stream}: {name!r} is not a name; that is {NAME_RULE}")
    key = sample_key(flow, node, port)
    with whole(output, inputs=[file], overwrite=overwrite) as recording:
        sessions = session_names(file)
        found = read_session(file, session)
        part, points = _part(file, found, subsweep)
        stamps = _stamps(file, found)
        written, mended = 0, 0
        with RecordingWriter(recording, flow=flow, source="imported", rig={}) as writer:
            for index, stamp in enumerate(stamps):
                if found.saturated[index]:
                    continue
                samples = found.frames[index][:, points]
                scans, changed = radar.repaired(radar.scans_of(samples["real"], samples["imag"]))
                mended += changed
                frame = _frame(stamp, scans, found, part, range_offset)
                writer.write(key, RadarFrame, numbered(frame, written), stamp=stamp, seq=written, log_time=stamp)
                written += 1
    if not written:
        raise CaneflowError(f"{file}, session {session}: the receiver was saturated in all of {len(stamps)} frames")
    print(_summary(output, found, written, mended))
    if len(sessions) > 1:
        print(f"{file}: session {session} of {len(sessions)}; --session 0 to {len(sessions) - 1}")
    if len(found.subsweeps) > 1:
        print(f"{file}: subsweep {subsweep} of {len(found.subsweeps)}; --subsweep 0 to {len(found.subsweeps) - 1}")


def _frame(
    stamp: int, scans: np.ndarray, session: A121Session, part: Mapping[str, Any], range_offset: float
) -> RadarFrame:
    axis = radar.range_axis(int(part["start_point"]), int(part["step_length"]), session.base_step)
    return RadarFrame(
        stamp=stamp,
        scans=scans,
        scan_period=1.0 / session.sweep_rate,
        range_start=axis.start - range_offset,
        range_step=axis.step,
        carrier=radar.CARRIER,
        bandwidth=radar.bandwidth_of(radar.profile_number(part["profile"])),
    )


def _part(file: Path, session: A121Session, number: int) -> tuple[Mapping[str, Any], slice]:
    """A subsweep's configuration, and which points of a sweep are its own."""
    if number >= len(session.subsweeps):
        raise CaneflowError(f"{file}: no subsweep {number}; it has {len(session.subsweeps)}, from 0")
    first = sum(int(each["num_points"]) for each in session.subsweeps[:number])
    part = session.subsweeps[number]
    end = first + int(part["num_points"])
    if end > session.frames.shape[2]:
        raise CaneflowError(f"{file}: subsweep {number} ends at point {end} of a sweep of {session.frames.shape[2]}")
    try:
        radar.profile_number(part["profile"])
    except ProtocolError as error:
        raise CaneflowError(f"{file}: {error}") from error
    return part, slice(first, end)


def _stamps(file: Path, session: A121Session) -> list[int]:
    """Stamps (ns) of the frames' last sweeps, 0 at the first sweep of all."""
    ticks = session.ticks.tolist()
    try:
        numbers = radar.frame_numbers(ticks)
        period = radar.frame_period(ticks, numbers) / session.ticks_per_second if len(ticks) > 1 else 0.0
    except ProtocolError as error:
        raise CaneflowError(f"{file}: {error}") from error
    length = (session.frames.shape[1] - 1) / session.sweep_rate
    if session.continuous:  # by its own making there is no shorter frame; ticks of a ms may say so in a short file
        period = max(period, (session.frames.shape[1] - 0.5) / session.sweep_rate)
    return [round((length + number * period) * 1e9) for number in numbers]


def _summary(output: Path, session: A121Session, written: int, mended: int) -> str:
    frames, sweeps, _ = session.frames.shape
    counts = {
        "saturated and left out": int(session.saturated.sum()),
        "delayed": int(session.delayed.sum()),
        "in need of calibration": int(session.uncalibrated.sum()),
    }
    said = "".join(f", {count} of {frames} frames {what}" for what, count in counts.items() if count)
    said += f", {mended} samples disturbed by double buffering and replaced" if mended else ""
    return f"{output}: {written} frames of {sweeps} sweeps, {session.sweep_rate:g} Hz{said}"


command = a121
