"""CDR of messages that come again: the bytes of rosbags for any numbers, other texts, longer lists, any release."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from caneflow.bridges.ros_messages import (
    IMAGE_TYPE,
    IMU_TYPE,
    MAG_TYPE,
    ODOMETRY_TYPE,
    POSE_COVARIANCE_TYPE,
    POSE_TYPE,
    TF_TYPE,
    TWIST_TYPE,
)
from caneflow.bridges.ros_types import DISTROS, RosTypes

FIXED = (IMU_TYPE, MAG_TYPE, POSE_TYPE, POSE_COVARIANCE_TYPE, ODOMETRY_TYPE, TWIST_TYPE, TF_TYPE)
WHOLE = {"int32": (-(2**31), 2**31), "uint32": (0, 2**32), "uint8": (0, 256)}


class Maker:
    """Messages of a kind in which every number is random."""

    def __init__(self, types: RosTypes, seed: int = 0) -> None:
        self.types, self.random = types, np.random.default_rng(seed)
        self.frame, self.length = "odom", 2

    def __call__(self, kind: str) -> Any:
        fields = self.types.store.fielddefs[kind][1]
        return self.types[kind](**{name: self._value(node.name, about) for name, (node, about) in fields})

    def _value(self, node: str, about: Any) -> Any:
        if node == "NAME":
            return self(about)
        if node == "SEQUENCE" and about[0][0].name == "NAME":
            return [self(about[0][1]) for _ in range(self.length)]
        if node == "SEQUENCE":
            return self.random.integers(0, 256, self.length).astype(np.uint8)
        if node == "ARRAY":
            return self.random.standard_normal(about[1])
        if about[0] == "string":
            return self.frame
        if about[0] == "float64":
            return float(self.random.standard_normal())
        return int(self.random.integers(*WHOLE[about[0]]))


@pytest.mark.parametrize("distro", DISTROS)
@pytest.mark.parametrize("kind", (*FIXED, IMAGE_TYPE))
def test_the_bytes_are_those_of_rosbags(kind: str, distro: str) -> None:
    """Also when a frame has another name from some message on, in any alignment, or a list another length."""
    types = RosTypes(distro)
    make, encoded = Maker(types), types.encoder(kind)
    for frame, length in [("odom", 2), ("a", 2), ("", 2), ("base_link", 3), ("base_link", 0), ("map", 1)]:
        make.frame, make.length = frame, length
        for message in messages(make, kind, 5):
            assert encoded(message) == types.encoded(kind, message)


@pytest.mark.parametrize("kind", FIXED)
def test_rosbags_is_asked_once_while_nothing_but_numbers_changes(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    types = RosTypes()
    asked: list[str] = []
    whole = types.encoded

    def asking(of: str, message: Any) -> bytes:
        asked.append(of)
        return whole(of, message)

    monkeypatch.setattr(types, "encoded", asking)
    encoded = types.encoder(kind)
    for message in messages(Maker(types), kind, 20):
        encoded(message)
    assert asked == [kind]


def messages(make: Maker, kind: str, count: int) -> Iterator[Any]:
    return (make(kind) for _ in range(count))
