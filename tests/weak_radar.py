"""Frames of an A121 that looks at flat ground from a straight walk: scatterers, one after the other."""

import math
from collections.abc import Callable

import numpy as np

from caneflow.algorithms.rotations import Quaternion, conjugate, from_rotation_vector, from_yaw, multiply, rotate
from caneflow.messages import Imu, RadarFrame, Sample
from caneflow.physics import GRAVITY

CARRIER, WIDTH, SPEED_OF_LIGHT = 60.5e9, 0.14, 299_792_458.0  # Hz, m at half power, m/s
HEIGHT, DOWN = 0.75, math.radians(42.0)  # m, rad
APERTURE, ACROSS = math.radians(53.0), math.radians(65.0)
RIG = {"hand_height": HEIGHT, "pivot": [0.0, 0.0, 0.0], "aperture": APERTURE, "aperture_across": ACROSS}
SWEEPS, PERIOD = 20, 0.0005  # per frame, s
DENSITY = 120.0  # scatterers per m^2


def weak_walk(
    snr: float,
    speed: Callable[[float], float],
    *,
    seed: int,
    seconds: float = 1.5,
    swing: float = 0.0,
    start: float = 0.7,
    points: int = 30,
    step: float = 0.06,
    noise: float = 40.0,
    accel: bool = True,
) -> tuple[dict[str, list[Sample]], np.ndarray]:
    """Messages, and the true speed along the boresight at each frame's stamp; `snr` dB per sweep in the best cell."""
    random = np.random.default_rng(seed)
    sweeps = int(seconds / PERIOD)
    times = PERIOD * np.arange(sweeps)
    speeds = np.array([speed(time) for time in times])
    way = np.cumsum(speeds) * PERIOD
    yaw = math.radians(swing) * np.sin(2 * math.pi * 0.9 * times)
    ahead = way[-1] + 4.0
    count = int(DENSITY * ahead * 3.6)
    places = np.stack([random.uniform(-0.3, ahead, count), random.uniform(-1.8, 1.8, count)], axis=1)
    amplitude = random.normal(size=count) + 1j * random.normal(size=count)
    ranges = start + step * np.arange(points)
    scans = np.zeros((sweeps, points), np.complex128)
    for first in range(0, sweeps, 5):
        now = slice(first, first + 5)
        middle = min(first + 2, sweeps - 1)
        near = (places[:, 0] > way[middle] - 0.3) & (places[:, 0] < way[middle] + 2.5)
        x, y = places[near, 0] - way[middle], places[near, 1]
        distance = np.sqrt(x * x + y * y + HEIGHT * HEIGHT)
        turned = math.cos(yaw[middle]) * x + math.sin(yaw[middle]) * y
        beside = -math.sin(yaw[middle]) * x + math.cos(yaw[middle]) * y
        on_axis = math.cos(DOWN) * turned + math.sin(DOWN) * HEIGHT
        upward = math.sin(DOWN) * turned - math.cos(DOWN) * HEIGHT
        lit = on_axis > 0.05
        off = np.arctan2(upward, on_axis) ** 2 / APERTURE**2 + np.arctan2(beside, on_axis) ** 2 / ACROSS**2
        # the two-way power of a beam is 1/2 in all, one way -3 dB: exp(-8 ln2 (theta / delta)^2) for both ways
        gain = np.where(lit, np.exp(-4 * math.log(2) * off), 0.0) * amplitude[near] / distance**2
        envelope = np.exp(-2 * math.log(2) * ((ranges[:, None] - distance) / WIDTH) ** 2)
        each = np.sqrt((x[:, None] - (way[now] - way[middle])) ** 2 + (y * y + HEIGHT * HEIGHT)[:, None])
        scans[now] = ((envelope * gain) @ np.exp(-4j * math.pi * CARRIER / SPEED_OF_LIGHT * each)).T
    strongest = (np.abs(scans) ** 2).mean(axis=0).max()
    scans *= noise * math.sqrt(10 ** (0.1 * snr) / strongest)
    scans += noise * math.sqrt(0.5) * (random.normal(size=scans.shape) + 1j * random.normal(size=scans.shape))
    frames: list[Sample] = [
        RadarFrame(
            stamp=round((last * PERIOD) * 1e9),
            scans=np.round(scans[last - SWEEPS + 1 : last + 1]).astype(np.complex64),
            scan_period=PERIOD,
            range_start=start,
            range_step=step,
            carrier=CARRIER,
            bandwidth=0.44 * SPEED_OF_LIGHT / (2 * WIDTH),
        )
        for last in range(SWEEPS - 1, sweeps, SWEEPS)
    ]
    imu: list[Sample] = []
    for index in range(int(100 * seconds) + 1):
        angle = math.radians(swing) * math.sin(2 * math.pi * 0.9 * 0.01 * index)
        rate = math.radians(swing) * 2 * math.pi * 0.9 * math.cos(2 * math.pi * 0.9 * 0.01 * index)
        # yaw turns x0 to the boresight, which is y: a quarter turn back
        orientation: Quaternion = multiply(from_yaw(angle - 0.5 * math.pi), from_rotation_vector((-DOWN, 0.0, 0.0)))
        gyro = (0.0, -rate * math.sin(DOWN), rate * math.cos(DOWN))
        force = rotate(conjugate(orientation), (0.0, 0.0, GRAVITY)) if accel else None
        imu.append(Imu(stamp=round(index * 1e7), gyro=gyro, orientation=orientation, accel=force))
    return {"frame": frames, "imu": imu}, (speeds * np.cos(yaw))[SWEEPS - 1 :: SWEEPS]
