"""Whether there is a sound file, or an input of a sound card, for a Doppler module."""

import getpass
from collections.abc import Iterator
from typing import Any

from caneflow.errors import CaneflowError
from caneflow.recording.sound_file import SoundFile
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.hosts.attached.way_to import Finding

NO_CARD = (
    "see what ALSA has: arecord -l; a card on USB has to be plugged in",
    f"sudo usermod -aG audio {getpass.getuser()}, then log in again: others may not use it",
)


def examine(node: Node) -> Iterator[Finding]:
    """Whether there is a sound file or an input of a sound card that takes the settings."""
    settings = node.settings
    if settings.file is not None:
        yield from _sound_file(node)
        return
    try:
        import sounddevice  # type: ignore[import-untyped]  # it has no types
    except ImportError:
        attempts = ("pip install 'caneflow[audio]'",)
        yield Finding(node=node.name, state="bad", text="no Python package sounddevice", attempts=attempts)
        return
    except OSError:
        attempts = ("sudo apt install libportaudio2",)
        yield Finding(node=node.name, state="bad", text="PortAudio is not installed", attempts=attempts)
        return
    yield _sound_card(node, sounddevice)


def _sound_card(node: Node, sounddevice: Any) -> Finding:
    """Whether there is such an input, and it takes the settings."""
    settings = node.settings
    inputs = [found for found in sounddevice.query_devices() if found["max_input_channels"]]
    if not inputs:
        return Finding(node=node.name, state="bad", text="there is no sound card with an input", attempts=NO_CARD)
    device: str | int | None = None if settings.device == "default" else settings.device
    device = int(device) if isinstance(device, str) and device.isdigit() else device
    needed, rate = settings.channels.needed, settings.sample_rate
    try:
        name = sounddevice.query_devices(device, "input")["name"]
        sounddevice.check_input_settings(device, needed, settings.sample_format, samplerate=rate)
    except (sounddevice.PortAudioError, ValueError) as error:
        text = f"{settings.device}: {str(error).partition(' [PaErrorCode')[0]}"
        there = "; ".join(f"{found['index']}: {found['name']}" for found in inputs)
        attempts = (f"one of these inputs: {there}; then --set {node.name}.device=...", *_to_be_taken(node))
        return Finding(node=node.name, state="bad", text=text, attempts=attempts)
    channels = "1 channel" if needed == 1 else f"{needed} channels"
    return Finding(node=node.name, state="ok", text=f"{name}: takes {channels} at {rate:g} Hz")


def _to_be_taken(node: Node) -> tuple[str, ...]:
    return (
        f"a rate and channels that it has: --set {node.name}.sample_rate=48000, {node.name}.channel=0; "
        "ALSA's default and plughw convert, hw does not",
        "when it is in use: end the program that has it, or share it by ALSA's dsnoop (docs/hardware.md)",
    )


def _sound_file(node: Node) -> Iterator[Finding]:
    settings = node.settings
    try:
        sound = SoundFile(settings.file, settings.channels, block=settings.block)
    except CaneflowError as error:
        attempts = (f"a WAV or FLAC file that has the channels: --set {node.name}.file=... {node.name}.channel=0",)
        yield Finding(node=node.name, state="bad", text=str(error), attempts=attempts)
        return
    length = f"{sound.frames / sound.sample_rate:.1f} s at {sound.sample_rate:g} Hz, {sound.subtype}"
    yield Finding(node=node.name, state="ok", text=f"{settings.file}: {length}")
