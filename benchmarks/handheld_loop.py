"""The recorded loop of a TI radar and an IMU held in the hand: its samples, and where they lead when summed."""

import math
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from caneflow.algorithms.rotations import from_yaw, multiply, normalized, rotate
from caneflow.messages import GroundSpeed, Imu, RadarPoints, Sample
from caneflow.testing import run_operator
from operators.attitude import Attitude
from operators.ego_velocity import EgoVelocityOperator

FRAME_TIME = 0.0185  # s


class Loop(NamedTuple):
    """Velocities along the gyro's heading, summed."""

    observed: int  # frames that told a velocity
    path: float  # m
    end_to_start: float  # m, horizontal


def walked(imu: list[Sample], points: list[Sample], rig: dict[str, Any], *, seed: int) -> Loop:
    """The way from the samples of `recorded`: `operators.attitude` without magnetometer, `operators.ego_velocity`."""
    fused = run_operator(Attitude, {"imu": imu}, settings={"magnetometer": False})["imu"]
    said = run_operator(EgoVelocityOperator, {"imu": fused, "points": points}, rig=rig, seed=seed)["speed"]
    stamps = np.array([each.stamp for each in fused])
    facing = np.array([rotate(cast(Any, each).orientation, tuple(rig["boresight"]))[:2] for each in fused])
    place, path, last = np.zeros(2), 0.0, None
    observed = 0
    for each in said:
        assert isinstance(each, GroundSpeed)
        at = each.stamp - round((each.velocity_delay or 0.0) * 1e9)
        x, y = facing[min(int(np.searchsorted(stamps, at)), len(stamps) - 1)]
        along = np.array([x, y]) / math.hypot(x, y)
        if not each.valid or each.velocity is None:
            continue
        observed += 1
        velocity = each.velocity[0] * along + each.velocity[1] * np.array([-along[1], along[0]])
        if last is not None:
            step = 0.5 * (velocity + last[1]) * (at - last[0]) * 1e-9
            place += step
            path += float(np.hypot(*step))
        last = (at, velocity)
    return Loop(observed, path, float(np.hypot(*place)))


def recorded(file: Path) -> tuple[list[Sample], list[Sample], dict[str, Any]]:
    """IMU less the gyro's bias at rest, points in our frame and sign, and the rig of the recording's calibration."""
    data = np.load(file)
    start = int(data["imu_stamp"][0])
    bias = np.radians([-0.07, -0.05, -0.43])
    imu: list[Sample] = [
        Imu(stamp=int(stamp) - start, gyro=tuple((gyro - bias).tolist()), accel=tuple(accel.tolist()))
        for stamp, gyro, accel in zip(data["imu_stamp"], data["gyro"].astype(float), data["accel"], strict=True)
    ]
    points: list[Sample] = []
    for first, last, trigger in zip(data["offset"][:-1], data["offset"][1:], data["trigger_stamp"], strict=False):
        cloud = data["points"][first:last]
        points.append(
            RadarPoints(
                stamp=int(trigger) - start + round(FRAME_TIME * 1e9),
                position=cloud[:, :3].copy(),
                doppler=-cloud[:, 4],
                snr=cloud[:, 3].copy(),
                frame_time=FRAME_TIME,
                doppler_step=0.125,
                doppler_limit=2.5,
            )
        )
    # the calibration's radar frame is (right, forward, up)
    to_imu = multiply(normalized(tuple(data["radar_to_imu_quaternion_wxyz"].tolist())), from_yaw(0.5 * math.pi))
    boresight = rotate(to_imu, (1.0, 0.0, 0.0))
    antenna = data["radar_position_in_imu"].tolist()
    return imu, points, {"boresight": boresight, "radar_orientation": to_imu, "antenna": antenna}
