"""`caneflow import wav`: a recording of a sound file, as a Doppler module's ADC made it."""

from pathlib import Path
from typing import Annotated

import typer

from caneflow.errors import CaneflowError
from caneflow.messages import NAME, NAME_RULE, DopplerBlock, numbered, sample_key
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.protocols.doppler_blocks import ModuleChannels
from caneflow.recording import RecordingWriter
from caneflow.recording.sound_file import SoundFile


def wav(
    sound: Annotated[Path, typer.Argument(metavar="FILE", help="WAV, FLAC or another sound file.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="REC", help="Recording to write.")],
    channel: Annotated[int, typer.Option(min=0, help="The module's output, or I of an I/Q module; 0: the first.")] = 0,
    quadrature: Annotated[
        int | None, typer.Option(min=0, help="Q of an I/Q module; none: a module with one mixer.")
    ] = None,
    carrier: Annotated[float, typer.Option(min=1, metavar="HZ", help="Hz, of the module.")] = 24.125e9,
    block: Annotated[float, typer.Option(min=1e-3, max=10, metavar="S", help="s of sound in a sample.")] = 0.05,
    key: Annotated[
        str, typer.Option(metavar="FLOW/NODE/PORT", help="Under which name it is recorded.")
    ] = "room/south/block",
    overwrite: Overwrite = False,
) -> None:
    """Make a recording of a sound file: the blocks that drivers.doppler_adc gives with the setting `file`.

    Stamps are the file's own time: a block's is that of its last sample, the first sample's is 0.
    Files of up to 16 bits stay int16, others become float32; I and Q become complex64.

    Example: caneflow import wav walking.wav -o walking.mcap --carrier 24.1e9

    I on the first channel and Q on the second: caneflow import wav iq.wav -o iq.mcap --quadrature 1
    """
    flow, stream = _flow_and_key(key)
    if quadrature == channel:
        raise CaneflowError(f"--quadrature {quadrature}: is --channel too; I and Q are on two channels")
    with whole(output, inputs=[sound], overwrite=overwrite) as recording:
        file = SoundFile(sound, ModuleChannels(first=channel, quadrature=quadrature), block=block)
        if not file.frames:
            raise CaneflowError(f"{sound}: holds no sound")
        seq, end = 0, 0
        with RecordingWriter(recording, flow=flow, source="imported", rig={}) as writer:
            for samples, last in file.blocks():
                stamp = round(last * 1e9 / file.sample_rate)
                sample = DopplerBlock(stamp=stamp, samples=samples, sample_rate=file.sample_rate, carrier=carrier)
                writer.write(stream, DopplerBlock, numbered(sample, seq), stamp=stamp, seq=seq, log_time=stamp)
                seq, end = seq + 1, last + 1
    lacking = f"; {file.frames - end} of {file.frames} frames are not in the file" if end < file.frames else ""
    refused = f"; {file.refused} blocks left out: they hold what is not a number" if file.refused else ""
    if file.channels > 1 and quadrature is None:
        others = ", ".join(str(other) for other in range(file.channels) if other != channel)
        print(f"{sound}: channel {channel} of {file.channels}; --channel {others}, or --quadrature for I and Q")
    length = f"{end / file.sample_rate:.1f} s at {file.sample_rate:g} Hz"
    print(f"{output}: {seq} blocks, {length}, {file.subtype}{refused or lacking}")


def _flow_and_key(key: str) -> tuple[str, str]:
    parts = key.split("/")
    if len(parts) != 3 or not all(NAME.fullmatch(part) for part in parts):
        raise CaneflowError(f"--key {key!r}: expected flow/node/port, each {NAME_RULE}")
    return parts[0], sample_key(*parts)


command = wav
