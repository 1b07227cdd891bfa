"""ROS message types by distribution, without ROS: classes, definitions, hashes, and CDR in and out, all by rosbags."""

from collections.abc import Callable
from functools import cache
from typing import Any

from caneflow.bridges.errors import BridgeError
from caneflow.bridges.repeated_cdr import RepeatedCdr
from caneflow.errors import not_installed

MISSING = not_installed("rosbags", "ros2")
DISTROS = ("humble", "jazzy", "kilted", "lyrical")
DEFAULT_DISTRO = "jazzy"
NO_HASHES = "humble"  # which knows none: rmw_zenoh has this word in their place there
NO_HASH = "TypeHashNotSupported"


class RosTypes:
    """The message types of one distribution; raises BridgeError where rosbags is not installed."""

    def __init__(self, distro: str = DEFAULT_DISTRO) -> None:
        self.distro = distro
        self._store = _store(distro)

    def __getitem__(self, kind: str) -> Any:
        """The class of a type such as `nav_msgs/msg/Odometry`."""
        return self._store.types[kind]

    @property
    def store(self) -> Any:
        """The store itself, as the writers of rosbags take it."""
        return self._store

    def encoded(self, kind: str, message: Any) -> bytes:
        """`message` as CDR, little-endian, with its header of four bytes."""
        return bytes(self._store.serialize_cdr(message, kind))

    def encoder(self, kind: str) -> Callable[[Any], bytes]:
        """The same for the messages of one topic, in a fraction of the time."""
        return RepeatedCdr(self._store, kind, self.encoded)

    def decoded(self, kind: str, cdr: bytes) -> Any:
        """The message in `cdr`; raises BridgeError for bytes that hold none."""
        try:
            return self._store.deserialize_cdr(cdr, kind)
        except Exception as error:  # rosbags' generated readers raise whatever they stumble over
            raise BridgeError(f"not a {kind} in CDR: {error}") from error

    def definition(self, kind: str) -> str:
        """The definition as text (`ros2msg`), with those of the types in it."""
        return str(self._store.generate_msgdef(kind, ros_version=2)[0])

    def hash(self, kind: str) -> str:
        """The hash of a type as rmw_zenoh has it in its keys."""
        return NO_HASH if self.distro == NO_HASHES else str(self._store.hash_rihs01(kind))


@cache
def _store(distro: str) -> Any:
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise BridgeError(MISSING) from error
    return get_typestore(Stores[f"ROS2_{distro.upper()}"])
