"""The keys, tokens and attachments of rmw_zenoh, ROS 2's own way over Zenoh: strings and bytes, no session.

Written from its sources: liveliness_utils.cpp @ bfc065f, attachment_helpers.cpp @ 534747d, qos.cpp @ 5e10d47.
A malformed attachment ends the ROS process that receives it, so there is one function that makes them, of one length.
"""

import struct
from typing import Final, NamedTuple

from caneflow.bridges.errors import BridgeError
from caneflow.errors import not_installed

MISSING = not_installed("xxhash", "ros2")
ROUTER: Final = "tcp/127.0.0.1:7447"  # where rmw_zenohd listens
MOST_DOMAINS: Final = 232  # ROS_DOMAIN_ID: beyond, DDS has no ports
NODE, PUBLISHER, SUBSCRIPTION = "NN", "MP", "MS"
GID_BYTES: Final = 16
HEAD: Final = struct.Struct("<qqB")  # sequence number, ns of the Unix epoch when sent, length of the gid (a varint)
ATTACHMENT_BYTES: Final = HEAD.size + GID_BYTES
# Quality of service, empty where it is rmw_zenoh's default: reliability:durability:history,depth:deadline:lifespan:
# liveliness.
STREAM_QOS = "::,10:,:,:,,"  # ROS's own default: reliable, volatile, the last 10
LATCHED_QOS = ":1:,1:,:,:,,"  # transient local, the last one
# Jazzy 0.2.0 to 0.2.3 named each field: the name as a string with its length before it, then the value.
NAMED = (b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid")


class Attachment(NamedTuple):
    """What comes with every message."""

    number: int  # of the message, by its publisher
    sent: int  # ns of the Unix epoch
    gid: bytes  # of the publisher


class Participant(NamedTuple):
    """A ROS node in a session of Zenoh."""

    domain: int
    session: str  # its id in hexadecimal
    namespace: str  # "" or e.g. /cane
    name: str

    def token(self) -> str:
        """The liveliness token that says that the node is there."""
        return f"{self._head(0, NODE)}"

    def entity_token(self, number: int, entity: str, topic: str, kind: str, digest: str, qos: str) -> str:
        """The token of a publisher or a subscription; `number` is unique in the session."""
        return "/".join((self._head(number, entity), mangled(topic), dds_type(kind), digest, qos))

    def key(self, topic: str, kind: str, digest: str) -> str:
        """Where the messages of a topic travel; `digest` may be `*`."""
        return f"{self.domain}/{topic.lstrip('/')}/{dds_type(kind)}/{digest}"

    def _head(self, number: int, entity: str) -> str:
        place = f"@ros2_lv/{self.domain}/{self.session}/0/{number}/{entity}"
        return f"{place}/{mangled('')}/{mangled(self.namespace)}/{self.name}"


def mangled(name: str) -> str:
    """A name with slashes as one part of a token: Zenoh takes no empty part."""
    return name.replace("/", "%") or "%"


def dds_type(kind: str) -> str:
    """The name that DDS has for a type such as `sensor_msgs/msg/Imu`."""
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def gid_of(token: str) -> bytes:
    """The 16 bytes by which ROS knows the publisher with this token: XXH3-128, low half first, little-endian."""
    try:
        import xxhash
    except ImportError as error:
        raise BridgeError(MISSING) from error
    return int(xxhash.xxh3_128(token.encode()).intdigest()).to_bytes(GID_BYTES, "little")


def attachment(number: int, sent: int, gid: bytes) -> bytes:
    """The 33 bytes that go with message `number` (1, 2, 3 ...), sent at `sent` (ns)."""
    if len(gid) != GID_BYTES:
        raise ValueError(f"a gid has {GID_BYTES} bytes, not {len(gid)}")
    return HEAD.pack(number, sent, GID_BYTES) + gid


def read_attachment(data: bytes) -> Attachment | None:
    """What an attachment says, in today's form and in that of Jazzy 0.2.0; None: it is malformed."""
    if len(data) == ATTACHMENT_BYTES and data[HEAD.size - 1] == GID_BYTES:
        number, sent, _ = HEAD.unpack_from(data)
        return Attachment(number, sent, data[HEAD.size :])
    values = []
    for name, size in zip(NAMED, (8, 8, 1 + GID_BYTES), strict=True):
        if not data.startswith(name) or len(data) < len(name) + size:
            return None
        values.append(data[len(name) : len(name) + size])
        data = data[len(name) + size :]
    if data or values[2][0] != GID_BYTES:
        return None
    return Attachment(int.from_bytes(values[0], "little"), int.from_bytes(values[1], "little"), values[2][1:])
