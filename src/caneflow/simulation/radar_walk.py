"""The walks of scenario.py with a radar that can be bought in the P440's place: an A121 low on the shaft, a TI mmWave.

Person, course and IMU are drawn as for the P440; a sensor low on the shaft moves differently from one near the hand.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.simulation import a121, mmwave
from caneflow.simulation.a121 import A121Settings
from caneflow.simulation.attitude import Floats
from caneflow.simulation.imu import SAMPLE_RATE, ImuSamples, measure
from caneflow.simulation.mmwave import MmwaveSettings, Points
from caneflow.simulation.scenario import EPOCH_NS, WalkSettings, generators
from caneflow.simulation.scene import scene
from caneflow.simulation.walk import RATE, Motion, course_of, walk

Floor: TypeAlias = Literal["rough", "usual", "smooth", "polished"]

# m^2 per m^2 at 60 GHz and about 45 deg. `rough`: asphalt and concrete (Ulaby and Dobson, Handbook of Radar Scattering
# Statistics for Terrain, 1989). `polished`: what water seen at 45 deg sends back to an A121, -28 to -35 dB in three
# recordings (a121-flow). Those between are chosen: nobody here has measured a floor at 60 GHz.
FLOORS: Mapping[Floor, float] = MappingProxyType({"rough": 0.03, "usual": 0.01, "smooth": 0.003, "polished": 0.001})
LOW_PIVOT = (0.0, -0.9, 0.0)  # m, sensors to hand: 0.35 m above the ground with 42 deg of slope (cane_a121.yaml)
FLOOR_POINTS = 5.0  # 1/m^2 that a radar finds which looks ahead, where walls have 60: chosen


@dataclass(frozen=True, kw_only=True)
class RadarWalk:
    """n instants at 100 Hz of IMU and truth, frames of the radar beside them. Frames and units as in wire.md."""

    stamps_ns: NDArray[np.int64]  # (n,)
    imu: ImuSamples
    position: Floats  # (n, 3) m, of the IMU's origin in R0
    velocity: Floats  # (n, 3) m/s, R0
    orientation: Floats  # (n, 4)
    rig: Mapping[str, object]
    sweeps: tuple[Floats, NDArray[np.complex64]] | None = None  # of an A121: times s, frames
    points: tuple[Points, ...] = ()  # of a TI radar


def simulate_a121_walk(
    settings: WalkSettings,
    seed: int,
    floor: Floor = "usual",
    radar: A121Settings | None = None,
    duration: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> RadarWalk:
    """A walk with an A121 low on the shaft, over a floor of FLOORS; raises ValueError for a negative seed."""
    radar = radar or A121Settings()
    rig = replace(settings.rig, pivot=LOW_PIVOT, antenna=(0.0, 0.0, 0.0), aperture=radar.aperture)
    settings = replace(settings, rig=rig, scene=replace(settings.scene, floor_reflectivity=FLOORS[floor]))
    _, person_rng, scene_rng, radar_rng, imu_rng, _ = generators(seed)
    motion = walk(settings.motion, rig, person_rng, duration)
    room = scene(settings.scene, course_of(settings.motion), scene_rng)
    sweeps = a121.frames(motion, room, rig, settings.motion.pitch, radar, radar_rng, progress)
    stated = {**rig.as_map(), "aperture_across": float(radar.aperture_across)}
    return replace(_sampled(motion, measure(motion, settings.imu, imu_rng), stated), sweeps=sweeps)


def simulate_mmwave_walk(
    settings: WalkSettings, seed: int, radar: MmwaveSettings | None = None, duration: float | None = None
) -> RadarWalk:
    """A walk between walls with a TI radar that looks ahead and level; raises ValueError for a negative seed."""
    radar = radar or MmwaveSettings()
    rig = settings.rig
    _, person_rng, scene_rng, radar_rng, imu_rng, _ = generators(seed)
    motion = walk(settings.motion, rig, person_rng, duration)
    among = replace(settings.scene, walls=True, person=False, floor_density=FLOOR_POINTS)
    room = scene(among, course_of(settings.motion), scene_rng)
    to_body = level_ahead(settings.motion.pitch)
    points = tuple(mmwave.frames(motion, room, rig, to_body, radar, radar_rng))
    stated = {**rig.as_map(), "radar_orientation": to_body.tolist()}
    return replace(_sampled(motion, measure(motion, settings.imu, imu_rng), stated), points=points)


def level_ahead(pitch: float) -> Floats:
    """The turn (4,) from a radar that looks ahead and level to the body of a cane that points down by `pitch` (rad)."""
    quarter = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # x ahead to y down the shaft
    half = 0.5 * pitch
    w, x = np.cos(half), np.sin(half)
    # first the quarter turn about z, then the tilt about x
    return np.array([w * quarter[0], x * quarter[0], -x * quarter[3], w * quarter[3]])


def _sampled(motion: Motion, imu: ImuSamples, rig: Mapping[str, object]) -> RadarWalk:
    sampled = Motion(*(values[:: RATE // SAMPLE_RATE] for values in motion))
    period_ns = 1_000_000_000 // SAMPLE_RATE
    return RadarWalk(
        stamps_ns=EPOCH_NS + period_ns * np.arange(len(sampled.time), dtype=np.int64),
        imu=imu,
        position=sampled.position,
        velocity=sampled.velocity,
        orientation=sampled.orientation,
        rig=rig,
    )
