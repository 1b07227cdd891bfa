"""Message types by their schema."""

from caneflow.messages.motion import GroundSpeed, Imu, Pose
from caneflow.messages.radar import DopplerBlock, DopplerTarget, RadarFrame
from caneflow.messages.sample import Sample
from caneflow.messages.surroundings import Cue, Grid, Obstacles, RadarTargets, Ranges

SAMPLES: dict[str, type[Sample]] = {
    kind.schema: kind
    for kind in (
        *(Imu, RadarFrame, GroundSpeed, Pose, DopplerBlock, DopplerTarget),
        *(Ranges, RadarTargets, Grid, Obstacles, Cue),
    )
}
