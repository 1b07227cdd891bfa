"""Message types by their schema."""

from caneflow.messages.motion import GroundSpeed, Imu, Pose
from caneflow.messages.radar import DopplerBlock, DopplerTarget, RadarFrame
from caneflow.messages.sample import Sample

SAMPLES: dict[str, type[Sample]] = {
    kind.schema: kind for kind in (Imu, RadarFrame, GroundSpeed, Pose, DopplerBlock, DopplerTarget)
}
