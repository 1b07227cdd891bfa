"""What a driver itself brings: how often, how calibrated, how loud."""

import math
import statistics
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caneflow.errors import CaneflowError
from caneflow.messages import DopplerBlock, Imu, RadarFrame, Sample
from caneflow.messages.rig import read_rig
from caneflow.physics import GRAVITY
from caneflow.protocols.doppler_blocks import ModuleChannels
from caneflow.runtime import Context, Quiet, Source
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.hosts.attached.way_to import Finding

ENOUGH = 0.97  # part of the rate that is asked for
GRAVITY_TOLERANCE = 1.0  # m/s^2, between gravity by the orientation and by the accelerometer
AT_REST = 0.05  # rad/s, standard deviation of the gyro
MOST_BIAS = 5.0  # deg/s: the data sheet's zero-rate output
FIELD = (20.0, 70.0)  # uT, somewhere on earth (25 to 65)

TO_CALIBRATE = {
    "gyro": "gyro: lay the cane down for some seconds",
    "accelerometer": "accelerometer: hold the cane still in six positions, some seconds each",
    "magnetometer": "magnetometer: swing the cane in a figure of eight, away from steel",
}
CLIPPED = 0.001  # part of the samples
QUIETEST = 2.0**-24  # of full scale, rms: a bit of the best converters
SETTLING = 0.25  # part of the blocks that may be silent: some cards begin so


def examine_samples(node: Node, seconds: float, rig: dict[str, Any]) -> Iterator[Finding]:
    """What the driver itself brings."""
    try:
        samples = _brought(node, seconds, rig)
    except (CaneflowError, OSError) as error:
        attempts = ("its own words say more: caneflow run FILE", f"is {node.run} set as docs/hardware.md says?")
        yield Finding(node=node.name, state="bad", text=f"its driver fails: {error}", attempts=attempts)
        return
    if len(samples) < 2:
        attempts = ("more time: --seconds 10", "its own words say more: caneflow run FILE")
        text = f"{len(samples)} samples in {seconds:g} s"
        yield Finding(node=node.name, state="bad", text=text, attempts=attempts)
        return
    yield _rate(node, samples)
    last = samples[-1]
    if isinstance(last, Imu):
        imu = [sample for sample in samples if isinstance(sample, Imu)]
        yield from _imu(node, last, imu) if last.orientation is not None else _raw_imu(node, imu)
    elif isinstance(last, DopplerBlock):
        yield from _sound(node, [sample for sample in samples if isinstance(sample, DopplerBlock)])
    elif isinstance(last, RadarFrame):
        length = last.range_start + last.range_step * last.scans.shape[1]
        text = f"{last.scans.shape[1]} range bins, {last.range_start:.2f} to {length:.2f} m"
        yield Finding(node=node.name, state="ok", text=text)


def _brought(node: Node, seconds: float, rig: dict[str, Any]) -> list[Sample]:
    """The samples of `seconds`, counted from the first, which may take as long as the driver allows."""
    assert node.program is not None
    context = Context(node=node.name, rig=read_rig(rig), ports=node.outputs, random=np.random.default_rng(0))
    source = node.program(node.settings, context)
    assert isinstance(source, Source)
    brought: list[Sample] = []
    patience = time.monotonic() + 5.0 + seconds
    with closing(source.samples()) as items:
        for item in items:
            if not isinstance(item, Quiet):
                assert isinstance(item[1], Sample)
                if not brought:
                    patience = time.monotonic() + seconds
                brought.append(item[1])
            if time.monotonic() > patience:
                break
    return brought


def _rate(node: Node, samples: list[Sample]) -> Finding:
    steps = [(b.stamp - a.stamp) / 1e6 for a, b in pairwise(samples)]
    rate = 1e3 / statistics.mean(steps)
    text = f"{rate:.1f} Hz, jitter {statistics.pstdev(steps):.2f} ms, longest step {max(steps):.1f} ms"
    asked = _asked_rate(node)
    attempts: tuple[str, ...] = ()
    if asked is not None and rate < ENOUGH * asked:
        text += f"; {asked:g} Hz are asked for"
        attempts = ("another program may take the processor: see top",)
        if isinstance(samples[-1], RadarFrame):
            attempts = ("a shorter scan or a lower integration index: docs/hardware.md", *attempts)
    return Finding(node=node.name, state="look" if attempts else "ok", text=text, attempts=attempts)


def _asked_rate(node: Node) -> float | None:
    period = getattr(node.settings, "scan_period_us", 0)
    block = getattr(node.settings, "block", 0)
    rate: float | None = 1e6 / period if period else getattr(node.settings, "rate", 1.0 / block if block else None)
    return rate


def _imu(node: Node, last: Imu, samples: list[Imu]) -> Iterator[Finding]:
    if last.calibration is not None:
        levels = dict(zip(("system", "gyro", "accelerometer", "magnetometer"), last.calibration, strict=True))
        low = [name for name, level in levels.items() if name in TO_CALIBRATE and level < 3]
        if getattr(node.settings, "mode", "") == "imu" and "magnetometer" in low:
            low.remove("magnetometer")  # it sleeps
        text = "calibration " + ", ".join(f"{name} {level}" for name, level in levels.items()) + " of 3"
        attempts = tuple(TO_CALIBRATE[name] for name in low)
        yield Finding(node=node.name, state="look" if low else "ok", text=text, attempts=attempts)
    apart = [_gravity_apart(sample) for sample in samples]
    known = [value for value in apart if value is not None]
    if known:
        median = statistics.median(known)
        text = f"gravity by orientation and by accelerometer: {median:.2f} m/s^2 apart"
        bad = median > GRAVITY_TOLERANCE
        attempts = ("one of the two is turned: see `axes` in docs/hardware.md",) if bad else ()
        yield Finding(node=node.name, state="look" if bad else "ok", text=text, attempts=attempts)


def _raw_imu(node: Node, samples: list[Imu]) -> Iterator[Finding]:
    """Whether a chip without fusion of its own measures what it must at rest."""
    gyro = np.array([sample.gyro for sample in samples])
    accel = np.array([sample.accel for sample in samples if sample.accel is not None])
    mag = np.array([sample.mag for sample in samples if sample.mag is not None])
    attempts = []
    rests = float(gyro.std(axis=0).max()) < AT_REST and len(accel) > 0
    turn = math.degrees(float(np.linalg.norm(gyro.mean(axis=0))))
    text = f"turns by {turn:.1f} deg/s"
    if len(accel):
        pull = float(np.linalg.norm(accel.mean(axis=0)))
        text += f", feels {pull:.2f} m/s^2"
        if rests and abs(pull - GRAVITY) > GRAVITY_TOLERANCE:
            attempts.append(
                f"at rest it must feel {GRAVITY:.2f} m/s^2: is accel_range the chip's? a board may be broken"
            )
    if rests and turn > MOST_BIAS:
        attempts.append("at rest it turns: let it warm up; operators.attitude takes off what stays the same")
    if len(mag):
        field = float(np.linalg.norm(mag.mean(axis=0)))
        text += f", a field of {field:.0f} uT"
        if not FIELD[0] < field < FIELD[1]:
            attempts.append(
                f"the earth's field has {FIELD[0]:g} to {FIELD[1]:g} uT: away from steel and magnets, or, for what is "
                f"worn with it, --set {node.name}.mag_offset=[x,y,z] (docs/hardware.md)"
            )
    elif getattr(node.settings, "magnetometer", False):
        text += ", no field"
        attempts.append("a magnet is too near: the magnetometer is at its end")
    if not rests:
        text += "; it moves"
        attempts.append("hold it still, and look again: then more can be said")
    yield Finding(node=node.name, state="look" if attempts else "ok", text=text, attempts=tuple(attempts))


def _gravity_apart(sample: Imu) -> float | None:
    """How far gravity by the orientation is from gravity by the accelerometer, m/s^2."""
    if sample.orientation is None or sample.accel is None or sample.linear_accel is None:
        return None
    w, x, y, z = sample.orientation
    by_orientation = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    by_accel = (a - b for a, b in zip(sample.accel, sample.linear_accel, strict=True))
    return math.dist([GRAVITY * along for along in by_orientation], list(by_accel))


def _sound(node: Node, blocks: list[DopplerBlock]) -> Iterator[Finding]:
    """How loud each channel of a module is: a dead wire and an overdriven input look alike to a spectrum."""
    samples = np.concatenate([block.samples for block in blocks])
    full = 2.0**15 if samples.dtype.kind == "i" else 1.0
    channels: ModuleChannels = getattr(node.settings, "channels", ModuleChannels())
    parts = {channels.first: samples}
    if samples.dtype.kind == "c":
        channels = ModuleChannels(first=channels.first, quadrature=channels.quadrature or channels.first + 1)
        assert channels.quadrature is not None
        parts = {channels.first: samples.real, channels.quadrature: samples.imag}
    quiet = Counter(channel for block in blocks for channel in channels.silent(block.samples))
    for channel, part in parts.items():
        name = channels.named(channel)
        yield _channel(node, name, part.astype(np.float64) / full, quiet[channel] / len(blocks))


def _channel(node: Node, name: str, values: NDArray[np.float64], silent: float) -> Finding:
    """How loud one channel is, of values of full scale 1; `silent` is the part of its blocks without a change."""
    wiring = (
        f"is the module powered, and on {name}? its wire to the input, its ground to the input's",
        "the input may be muted or its gain 0: alsamixer, capture (F4)",
        f"another channel of the card: --set {node.name}.channel=...; 0 is the first",
    )
    if silent == 1.0 or float(np.std(values)) < QUIETEST:
        return Finding(node=node.name, state="look", text=f"{name} is silent: not a bit changes", attempts=wiring)
    rms, clipped = float(np.std(values)), float((np.abs(values) >= 1.0 - 2.0**-14).mean())
    text = f"{name}: loudest {float(np.abs(values).max()):.3f} of full scale, {20 * math.log10(rms):.0f} dB on average"
    attempts: tuple[str, ...] = ()
    if silent > SETTLING:
        text += f", silent in {100 * silent:.0f} % of the blocks"
        attempts = ("a wire may be loose, or another program mutes the input", *wiring[:2])
    elif clipped > CLIPPED:
        text += f", {100 * clipped:.1f} % of the samples at its end"
        attempts = ("less gain: alsamixer, capture (F4); or a divider before the input",)
    return Finding(node=node.name, state="look" if attempts else "ok", text=text, attempts=attempts)
