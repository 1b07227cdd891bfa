"""An Acconeer A121 class radar: complex sweeps of a scene, without a gap from frame to frame.

Power is absolute: a scatterer of cross-section S at R has gain + 10 log10(averages) + 10 log10(S) - 40 log10(R) dB over
the noise of one sweep on the boresight (the vendor's radar loop gain). Nothing about the floor is set from the noise.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt
from numpy.random import Generator
from numpy.typing import NDArray

from caneflow.physics import SPEED_OF_LIGHT
from caneflow.protocols import a121
from caneflow.simulation import attitude
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.radar import BORESIGHT
from caneflow.simulation.scene import Scene
from caneflow.simulation.walk import Motion, Rig

ACROSS = (1.0, 0.0, 0.0)  # of the beam's wider plane, body frame: horizontal in a cane that is held straight

_FAINT = 0.02  # one-way power below which a scatterer is left out
_FASTEST = 0.05  # m that the antenna moves at most within a frame, and rad that it turns


@dataclass(frozen=True, kw_only=True)
class A121Settings:
    """The radar of dataflows/cane_a121.yaml."""

    setup: a121.SweepSetup = field(
        default_factory=lambda: a121.SweepSetup(start_point=120, points=17, step_length=24, averages=16)
    )
    noise: Annotated[float, Gt(0)] = 43.0  # LSB, rms of a complex sample: 41 to 46 in the recordings of a121-flow
    aperture: Annotated[float, Gt(0)] = 53.0 * DEGREE  # rad, along the cane (E plane), one way
    aperture_across: Annotated[float, Gt(0)] = 65.0 * DEGREE  # rad (H plane)
    tip_section: Annotated[float, Ge(0)] = 0.003  # m^2: as the P440's, chosen; 60 GHz was not measured


def frames(
    motion: Motion,
    scene: Scene,
    rig: Rig,
    pitch: float,
    settings: A121Settings,
    rng: Generator,
    progress: Callable[[float], None] | None = None,
) -> tuple[Floats, NDArray[np.complex64]]:
    """Times of the frames' last sweeps, (n,) s, and frames (n, sweeps, points) LSB, approaching positive.

    The antenna's way within a frame is followed sweep by sweep, its beam stays as in the frame's middle.
    """
    setup = settings.setup
    still_rng, noise_rng = rng.spawn(2)
    period = 1.0 / setup.sweep_rate
    count = int((motion.time[-1] - motion.time[0]) / (period * setup.sweeps))
    times = motion.time[0] + period * np.arange(count * setup.sweeps)
    antenna = motion.position + attitude.rotate(motion.orientation, rig.antenna)
    way = np.stack([np.interp(times, motion.time, axis) for axis in antenna.T], axis=1).reshape(count, setup.sweeps, 3)
    middles = np.searchsorted(motion.time, times[setup.sweeps // 2 :: setup.sweeps])
    boresight = attitude.rotate(motion.orientation[middles], BORESIGHT)
    across = attitude.rotate(motion.orientation[middles], ACROSS)
    profile = a121.PROFILES[setup.profile]
    gain = settings.noise * 10.0 ** (0.05 * (profile.gain + 10.0 * np.log10(setup.averages)))
    still = _tip(rig, pitch, settings, still_rng)
    out = np.empty((count, setup.sweeps, setup.points), np.complex64)
    for number in range(count):
        points, amplitudes = _seen(scene, way[number], boresight[number], settings)
        if scene.walker is not None:
            points = np.concatenate([points, scene.walker.positions(times[number * setup.sweeps][None])[0]])
            amplitudes = np.concatenate([amplitudes, scene.walker.amplitudes])
        echo = echoes(way[number], boresight[number], across[number], points, amplitudes, settings) + still
        draws = noise_rng.normal(0.0, settings.noise * np.sqrt(0.5), (2, setup.sweeps, setup.points))
        received = gain * echo + draws[0] + 1j * draws[1]
        out[number] = np.rint(received.real) + 1j * np.rint(received.imag)
        if progress is not None and number % 64 == 0:
            progress(number / count)
    return times[setup.sweeps - 1 :: setup.sweeps], out


def echoes(
    antenna: Floats, boresight: Floats, across: Floats, points: Floats, amplitudes: NDArray[np.complex128],
    settings: A121Settings,
) -> NDArray[np.complex128]:  # fmt: skip
    """Echoes of one frame, (sweeps, points), 1/m: `antenna` (sweeps, 3) m, scatterers (k, 3) m and (k,) m."""
    setup = settings.setup
    middle = points - antenna[len(antenna) // 2]
    distance = np.linalg.norm(middle, axis=1)
    strength = _beam(middle, boresight, across, settings) / distance**2 * amplitudes
    ranges = (setup.start_point + setup.step_length * np.arange(setup.points)) * a121.BASE_STEP
    width = a121.PROFILES[setup.profile].width
    # power at half of the width is a half, so the amplitude's exponent is half of 4 ln 2
    envelope = np.exp(-2.0 * np.log(2.0) * ((ranges[:, None] - distance) / width) ** 2) * strength
    offset = points[None, :, :] - antenna[:, None, :]
    phase = 4.0 * np.pi * a121.CARRIER / SPEED_OF_LIGHT * np.sqrt((offset * offset).sum(axis=2))
    summed: NDArray[np.complex128] = np.exp(-1j * phase) @ envelope.T
    return summed


def _beam(offset: Floats, boresight: Floats, across: Floats, settings: A121Settings) -> Floats:
    """Amplitude of the two-way pattern towards `offset` (k, 3), 1 on the boresight: Gaussian in both planes."""
    ahead, beside = offset @ boresight, offset @ across
    above = offset @ np.cross(boresight, across)
    along_angle, across_angle = np.arctan2(above, ahead), np.arctan2(beside, ahead)
    off = (along_angle / settings.aperture) ** 2 + (across_angle / settings.aperture_across) ** 2
    gain: Floats = np.where(ahead > 0.0, np.exp(-4.0 * np.log(2.0) * off), 0.0)
    return gain


def _seen(
    scene: Scene, way: Floats, boresight: Floats, settings: A121Settings
) -> tuple[Floats, NDArray[np.complex128]]:
    """The scatterers that may be within range and beam during a frame."""
    setup = settings.setup
    farthest = (setup.start_point + setup.step_length * setup.points) * a121.BASE_STEP
    farthest += a121.PROFILES[setup.profile].width
    offset = scene.points - way[len(way) // 2]
    near = np.flatnonzero(np.abs(offset[:, 0]) < farthest)
    offset = offset[near]
    distance = np.linalg.norm(offset, axis=1)
    widest = settings.aperture_across * np.sqrt(-np.log(_FAINT) / (4.0 * np.log(2.0))) + _FASTEST
    kept = near[(distance < farthest) & (offset @ boresight > distance * np.cos(widest))]
    return scene.points[kept], scene.amplitudes[kept]


def _tip(rig: Rig, pitch: float, settings: A121Settings, rng: Generator) -> NDArray[np.complex128]:
    """The tip of the cane, which stands in the radar's own frame, (points,) 1/m: where it touches the floor."""
    setup = settings.setup
    reach = rig.hand_height / np.sin(pitch) - float(np.linalg.norm(rig.pivot))
    ranges = (setup.start_point + setup.step_length * np.arange(setup.points)) * a121.BASE_STEP
    width = a121.PROFILES[setup.profile].width
    envelope = np.exp(-2.0 * np.log(2.0) * ((ranges - reach) / width) ** 2)
    phase = rng.uniform(0.0, 2.0 * np.pi)
    still: NDArray[np.complex128] = np.sqrt(settings.tip_section) / reach**2 * envelope * np.exp(1j * phase)
    return still
