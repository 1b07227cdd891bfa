"""What every sample has. A message of one's own is a class derived from Sample, with a schema and fields.

A sample checks itself when it is made, so a bad one is refused on the way in and on the way out alike.
"""

import sys
from typing import Annotated, Any, ClassVar, TypeAlias

import msgspec
from msgspec import Meta

from caneflow.messages.registry import register

Stamp: TypeAlias = Annotated[int, Meta(ge=0, le=2**63 - 2)]  # one more says that a stream has ended

UNNUMBERED = -1  # a sample that no host has published yet


class Sample(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """What every sample has."""

    schema: ClassVar[str] = ""  # e.g. "caneflow.Imu/1", in the Zenoh encoding and in recordings

    stamp: Annotated[
        Stamp, Meta(description="ns, Unix epoch: when the sensor measured; strictly increasing per stream")
    ]
    seq: Annotated[int, Meta(description="0, 1, 2 ... per stream and run; a gap is a loss")] = UNNUMBERED

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if cls.schema:  # else it is a base of messages
            definition = sys._getframe(1)
            register(cls, definition.f_code.co_filename, definition.f_lineno)
