"""Messages of the surroundings and the rig's range sensors: what is right is taken, what contradicts itself is not."""

from typing import Any

import numpy as np
import pytest

from caneflow.messages import Cue, Grid, MessageError, Obstacles, RadarTargets, Ranges, decode, numbered
from caneflow.messages.rig import Rig, read_rig

TWO = np.array([1.5, 0.0], np.float32)
STATUS = np.array([0, 1], np.uint8)
TABLE = np.zeros((3, 4), np.float32)
SLICES = np.full((2, 4, 6), 128, np.uint8)
OBSTACLE: dict[str, Any] = {"kind": "obstacle", "level": "low", "distance": 1.0, "azimuth": 0.0, "urgency": 0.5}
RANGER: dict[str, Any] = {
    "position": [0, -0.2, 0.03],
    "boresight": [0, 0.6, 0.8],
    "up": [0, -0.8, 0.6],
    "rows": 8,
    "columns": 8,
    "field": [0.78, 0.78],
    "reach": [0.02, 4],
    "kind": "tof",
}


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Ranges(stamp=1, ranges=TWO, status=STATUS[:1]), "status has 1 elements; ranges has 2"),
        (lambda: Ranges(stamp=1, ranges=-TWO, status=STATUS), "-1.5 m; expected 0 or more"),
        (lambda: Ranges(stamp=1, ranges=TWO * np.float32(np.nan), status=STATUS), "NaN"),
        (lambda: Ranges(stamp=1, ranges=TWO, status=STATUS + np.uint8(4)), "an element of 5; expected 0 to 4"),
        (lambda: Ranges(stamp=1, ranges=TWO.astype(float), status=STATUS), "allowed are float32"),
        (lambda: Ranges(stamp=1, ranges=TWO, status=STATUS, sigma=TWO[:1]), "sigma has 1 elements"),
        (lambda: Ranges(stamp=1, ranges=TWO, status=STATUS, delay=-0.1), "delay is -0.1"),
        (lambda: RadarTargets(stamp=1, range=TWO), "range_rate is missing"),
        (lambda: RadarTargets(stamp=1, snr=TWO), "snr is there without range"),
        (lambda: RadarTargets(stamp=1, range=TWO, range_rate=TWO, snr=TWO, above_floor=STATUS * 2), "expected 0 or 1"),
        (lambda: Obstacles(stamp=1, heading=0.0, walking=True, nearest=TABLE.T, known=TABLE), r"expected \(3, 4\)"),
        (lambda: Obstacles(stamp=1, heading=0.0, walking=True, nearest=TABLE - 1, known=TABLE), "element of -1"),
        (lambda: Obstacles(stamp=1, heading=0.0, walking=True, nearest=TABLE, known=TABLE + 2), "known has an element"),
        (lambda: Cue(stamp=1, since=1, **{**OBSTACLE, "level": "drop"}), "drop goes with drop alone"),
        (lambda: Cue(stamp=1, since=1, kind="obstacle", level="low"), "distance is missing"),
        (lambda: Cue(stamp=1, since=1, **{**OBSTACLE, "kind": "none"}), "has no level"),
        (lambda: Cue(stamp=1, since=1, kind="blind"), "reason is None"),
        (lambda: Cue(stamp=1, since=1, kind="none", reason="x"), "reason is x"),
        (lambda: Cue(stamp=1, since=1, **{**OBSTACLE, "urgency": 1.5}), "urgency is 1.5"),
    ],
)
def test_what_contradicts_itself_is_refused_and_named(make: Any, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make()


def test_a_grid_has_a_missing_floor_of_its_own_shape() -> None:
    about: dict[str, Any] = {"unit": 1 / 32, "cell": 0.1, "bottom": 0.0, "slice": 0.25, "origin": (0, 0)}
    with pytest.raises(ValueError, match=r"floor_missing has shape \(6, 4\)"):
        Grid(stamp=1, occupancy=SLICES, pose_stamp=1, floor_missing=SLICES[0].T, **about)
    assert Grid(stamp=1, occupancy=SLICES, pose_stamp=1, **about).floor_missing is None


def test_a_cue_on_the_wire_that_says_an_unknown_word_is_refused() -> None:
    payload = numbered(Cue(stamp=1, since=1, kind="none"), 0).replace(b"\xa4none", b"\xa4nOne")
    with pytest.raises(MessageError, match="nOne"):
        decode(payload, Cue)


def test_the_rig_knows_range_sensors_and_the_user() -> None:
    rig = read_rig({"rangers": {"tof_up": RANGER}, "user": {"shoulder": 0.4}})
    assert rig.rangers["tof_up"].rows == 8
    assert rig.user is not None
    assert (rig.user.shoulder, rig.user.height, rig.user.hand) == (0.4, 2.0, (0.3, -0.08))
    assert Rig().user is None
    assert Rig().rangers == {}


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"up": [0, 0.8, 0.6]}, "at right angles"),
        ({"boresight": [0, 0.6, 0.6]}, "norm"),
        ({"reach": [4, 0.02]}, "nearest first"),
        ({"rows": 0}, "rows"),
        ({"kind": "laser"}, "kind"),
    ],
)
def test_a_range_sensor_that_cannot_be_is_named(wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(MessageError, match=rf"rig.rangers.tof_up.*{says}"):
        read_rig({"rangers": {"tof_up": {**RANGER, **wrong}}})
