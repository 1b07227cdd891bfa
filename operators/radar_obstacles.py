"""What the cane's own radar sees besides the floor: echoes with a Doppler that the floor cannot have.

in   frame   : RadarFrame    one scan per 10 ms
in   pose    : Pose          of the cane: how fast the antenna moves, and how high it is
out  targets : RadarTargets  every tenth scan; without arrays where there is nothing

Neither a side nor a height can be told, so a target stands in no map. It is not a mobility aid: research software only.
"""

import math
from collections import deque
from dataclasses import dataclass, field, fields

from caneflow.algorithms.radar.footprint import CaneGeometry, antenna_height
from caneflow.algorithms.radar.moving_returns import MovingReturnsFilter, MovingReturnsSettings, RadarParameters
from caneflow.algorithms.radar.radar_obstacles import RadarObstacles, RadarObstaclesSettings
from caneflow.messages import Pose, RadarFrame, RadarTargets, Sample
from caneflow.runtime import Context, Emitted, Operator, Refused
from caneflow.runtime.node import run

PARAMETERS = tuple(each.name for each in fields(RadarParameters))  # a frame calls them the same
MOST_POSES = 4096
OLDEST_POSE_NS = 300_000_000  # ns; an older one says nothing about a window of 0.64 s


@dataclass(frozen=True, kw_only=True)
class RadarTargetSettings:
    """How the floor's picture is removed, and what counts as a target."""

    __pydantic_config__ = {"extra": "forbid"}

    moving_returns: MovingReturnsSettings = field(default_factory=MovingReturnsSettings)
    targets: RadarObstaclesSettings = field(default_factory=RadarObstaclesSettings)


class RadarObstaclesOperator(Operator):
    """Moving returns in a sliding window; every tenth scan what is above the floor's Doppler edge."""

    inputs = {"frame": RadarFrame, "pose": Pose}
    outputs = {"targets": RadarTargets}
    Settings = RadarTargetSettings

    def __init__(self, settings: RadarTargetSettings, context: Context) -> None:
        rig = context.rig
        self._geometry = CaneGeometry(
            hand_height=rig.need("hand_height"),
            aperture=rig.need("aperture"),
            pivot=rig.need("pivot"),
            boresight=rig.boresight,
            antenna=rig.antenna,
        )
        self._moving_returns = MovingReturnsFilter(settings.moving_returns)
        self._obstacles = RadarObstacles(settings.targets)
        self._scans = settings.targets.window
        self._motion: deque[tuple[int, float, float]] = deque()  # stamp (ns), antenna's height (m), speed (m/s)

    def handle(self, port: str, message: Sample) -> Emitted:
        """Yield the targets of the window that ends with a frame, when it is time."""
        if isinstance(message, Pose):
            self._take_pose(message)
            return
        assert isinstance(message, RadarFrame)
        parameters = RadarParameters(**{name: getattr(message, name) for name in PARAMETERS})
        try:
            returns = self._moving_returns.update(message.stamp, message.scans, parameters)
        except ValueError as error:
            raise Refused(str(error)) from error
        is_due = self._obstacles.take(returns)
        window_ns = round(message.scan_period * self._scans * 1e9) + OLDEST_POSE_NS
        while self._motion and self._motion[0][0] < message.stamp - window_ns:
            self._motion.popleft()
        if not is_due or not self._motion or message.stamp - self._motion[-1][0] > OLDEST_POSE_NS:
            return
        targets = self._obstacles.look(
            height=min(height for _, height, _ in self._motion), speed=max(speed for _, _, speed in self._motion)
        )
        if not len(targets.ranges):
            yield "targets", RadarTargets(stamp=message.stamp)
            return
        yield (
            "targets",
            RadarTargets(
                stamp=message.stamp,
                range=targets.ranges,
                range_rate=targets.range_rates,
                snr=targets.snr,
                above_floor=targets.above_floor,
            ),
        )

    def _take_pose(self, pose: Pose) -> None:
        last_ns = self._motion[-1][0] if self._motion else None
        if last_ns is not None and pose.stamp <= last_ns:
            raise Refused(f"pose: stamp {pose.stamp} ns is not after the one before, {last_ns} ns")
        height = max(antenna_height(self._geometry, pose.orientation), 0.0)
        self._motion.append((pose.stamp, height, math.hypot(pose.velocity[0], pose.velocity[1])))
        if len(self._motion) > MOST_POSES:
            self._motion.popleft()


if __name__ == "__main__":
    run(RadarObstaclesOperator)
