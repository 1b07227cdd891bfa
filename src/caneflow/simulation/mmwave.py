"""A TI mmWave class radar that looks ahead: points with Doppler of what stands around, and some that move.

Errors of angles and steps of Doppler are those of an IWR6843AOP whose chirps reach 3 m/s (radars.md, sections 6 and 7).
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Gt
from numpy.random import Generator

from caneflow.simulation import attitude
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.scene import Scene
from caneflow.simulation.walk import Motion, Rig


@dataclass(frozen=True, kw_only=True)
class MmwaveSettings:
    """The radar of dataflows/cane_mmwave.yaml."""

    rate: Annotated[float, Gt(0)] = 20.0  # Hz
    frame_time: Annotated[float, Gt(0)] = 0.0185  # s
    doppler_step: Annotated[float, Gt(0)] = 0.13  # m/s
    doppler_limit: Annotated[float, Gt(0)] = 3.0  # m/s
    most_points: Annotated[int, Gt(0)] = 40  # of a frame; what a radar finds varies down to half of it, chosen
    nearest: Annotated[float, Gt(0)] = 0.5  # m
    farthest: Annotated[float, Gt(0)] = 8.0  # m
    view: Annotated[float, Gt(0)] = 60.0 * DEGREE  # rad to either side, and up and down
    azimuth_error: Annotated[float, Ge(0)] = 2.0 * DEGREE  # rad, sd
    elevation_error: Annotated[float, Ge(0)] = 5.0 * DEGREE  # rad, sd
    range_error: Annotated[float, Ge(0)] = 0.03  # m, sd
    fewest_wild: Annotated[float, Ge(0)] = 0.1  # part of the points: people, multipath; ...
    most_wild: Annotated[float, Ge(0)] = 0.35  # ... from frame to frame, evenly
    wild_speed: Annotated[float, Ge(0)] = 1.5  # m/s, of what they say, to either side


class Points(NamedTuple):
    """One frame."""

    time: float  # s, of the last chirp
    position: Floats  # (n, 3) m, radar frame
    doppler: Floats  # (n,) m/s, positive approaching
    snr: Floats  # (n,) dB


def frames(
    motion: Motion, scene: Scene, rig: Rig, to_body: Floats, settings: MmwaveSettings, rng: Generator
) -> list[Points]:
    """The frames of a walk; `to_body` (4,) turns the radar's axes into the body's."""
    antenna = motion.position + attitude.rotate(motion.orientation, rig.antenna)
    velocity = np.gradient(antenna, motion.time, axis=0)
    found = []
    for end in np.arange(motion.time[0] + 1.0 / settings.rate, motion.time[-1], 1.0 / settings.rate):
        middle = int(np.searchsorted(motion.time, end - 0.5 * settings.frame_time))
        turn = attitude.multiply(motion.orientation[middle], to_body)
        found.append(_frame(end, antenna[middle], velocity[middle], turn, scene, settings, rng))
    return found


def _frame(
    end: float, antenna: Floats, velocity: Floats, turn: Floats, scene: Scene, settings: MmwaveSettings, rng: Generator
) -> Points:
    near = scene.points[np.abs(scene.points - antenna).max(axis=1) < settings.farthest]
    picked = near[rng.permutation(len(near))[: 60 * settings.most_points]]
    axes = np.stack([attitude.rotate(turn, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))])
    offset = (picked - antenna) @ axes.T
    distance = np.linalg.norm(offset, axis=1)
    azimuth, elevation = np.arctan2(offset[:, 1], offset[:, 0]), np.arcsin(offset[:, 2] / distance)
    seen = (distance > settings.nearest) & (distance < settings.farthest)
    seen &= (np.abs(azimuth) < settings.view) & (np.abs(elevation) < settings.view)
    kept = np.flatnonzero(seen)[: int(rng.integers(settings.most_points // 2, settings.most_points + 1))]
    distance, azimuth, elevation = distance[kept], azimuth[kept], elevation[kept]
    doppler = offset[kept] @ (axes @ velocity) / distance
    wild = rng.random(len(kept)) < rng.uniform(settings.fewest_wild, settings.most_wild)
    doppler = np.where(wild, rng.uniform(-settings.wild_speed, settings.wild_speed, len(kept)), doppler)
    span = 2.0 * settings.doppler_limit
    doppler = (doppler + settings.doppler_limit) % span - settings.doppler_limit
    doppler = settings.doppler_step * np.rint(doppler / settings.doppler_step)
    azimuth = azimuth + settings.azimuth_error * rng.normal(size=len(kept))
    elevation = elevation + settings.elevation_error * rng.normal(size=len(kept))
    measured = distance + settings.range_error * rng.normal(size=len(kept))
    flat = np.cos(elevation)
    direction = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    return Points(float(end), measured[:, None] * direction, doppler, rng.uniform(8.0, 30.0, len(kept)))
