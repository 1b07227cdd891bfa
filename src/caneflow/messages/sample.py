"""What every sample has.

A sample checks itself when it is made, so a bad one is refused on the way in and on the way out alike.
"""

from typing import Annotated, ClassVar, TypeAlias

import msgspec
from msgspec import Meta

Stamp: TypeAlias = Annotated[int, Meta(ge=0, le=2**63 - 2)]  # one more says that a stream has ended

UNNUMBERED = -1  # a sample that no host has published yet


class Sample(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """What every sample has."""

    schema: ClassVar[str] = ""  # e.g. "caneflow.Imu/1", in the Zenoh encoding and in recordings

    stamp: Annotated[
        Stamp, Meta(description="ns, Unix epoch: when the sensor measured; strictly increasing per stream")
    ]
    seq: Annotated[int, Meta(description="0, 1, 2 ... per stream and run; a gap is a loss")] = UNNUMBERED
