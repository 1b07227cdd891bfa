"""A message of one's own: how far someone has walked. Import it from here: one file defines a schema."""

from typing import Annotated

from msgspec import Meta

from caneflow.messages import Sample
from caneflow.messages.bounds import require_within

FARTHEST = 1e6  # m


class Distance(Sample, frozen=True, kw_only=True):
    """The way since the start, along the path and not as the crow flies."""

    schema = "example.Distance/1"

    distance: Annotated[float, Meta(ge=0, le=FARTHEST, description="m, of the parts that the radar saw")]
    unseen: Annotated[float, Meta(ge=0, description="s without a valid speed: the distance may be too short by these")]

    def __post_init__(self) -> None:
        require_within("distance", self.distance, 0.0, FARTHEST, "m")  # here as well: also refuses NaN
