"""Surroundings: what range sensors see, the grid of what is occupied, the nearest obstacles, and what to tell."""

from typing import Annotated, Literal, TypeAlias

from msgspec import Meta

from caneflow.messages import bounds
from caneflow.messages.arrays import Array
from caneflow.messages.bounds import require_array, require_within
from caneflow.messages.sample import Sample, Stamp

Level: TypeAlias = Literal["low", "waist", "head", "drop"]

ROWS, COLUMNS = ("left", "ahead", "right"), ("low", "waist", "head", "drop")  # of the arrays of Obstacles
NOT_TRUSTED, NOT_MEASURED = 3, 4  # of a zone's status
TARGET, NO_TARGET, TOO_NEAR = 0, 1, 2


class Ranges(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """One reading of a range sensor: zones row by row, top row first, each from left to right as it looks out."""

    schema = "caneflow.Ranges/1"

    ranges: Annotated[Array, Meta(description="(Z,) float32 m along each zone's ray, 0 to 1e4; 0 where there is none")]
    status: Annotated[
        Array,
        Meta(
            description="(Z,) uint8: 0 a target, 1 no target up to the reach, 2 nearer than it can see, "
            "3 not to be trusted, 4 not measured"
        ),
    ]
    sigma: Annotated[Array | None, Meta(description="(Z,) float32 m, standard deviation of each range")] = None
    signal: Annotated[Array | None, Meta(description="(Z,) float32, in the sensor's units, within 1e9")] = None
    ambient: Annotated[Array | None, Meta(description="(Z,) float32, in the sensor's units, within 1e9")] = None
    exposure: Annotated[bounds.Delay | None, Meta(description="s that the zones were exposed")] = None
    delay: Annotated[bounds.Delay | None, Meta(description="s from the exposure's middle to the stamp")] = None

    def __post_init__(self) -> None:
        require_array("ranges", self.ranges, "f", dimensions=1, most=bounds.RANGE)
        require_array("status", self.status, "B", dimensions=1, most=NOT_MEASURED)
        if int(self.status.max()) > NOT_MEASURED:
            raise ValueError(f"status has an element of {int(self.status.max())}; expected 0 to {NOT_MEASURED}")
        _require_as_many("status", self.status, "ranges", self.ranges)
        if float(self.ranges.min()) < 0:
            raise ValueError(f"ranges has an element of {float(self.ranges.min()):g} m; expected 0 or more")
        for name, each in (("sigma", self.sigma), ("signal", self.signal), ("ambient", self.ambient)):
            if each is not None:
                most = bounds.RANGE if name == "sigma" else bounds.LIGHT
                require_array(name, each, "f", dimensions=1, most=most)
                _require_as_many(name, each, "ranges", self.ranges)
        if self.exposure is not None:
            require_within("exposure", self.exposure, 0.0, bounds.DELAY, "s")
        if self.delay is not None:
            require_within("delay", self.delay, 0.0, bounds.DELAY, "s")


class RadarTargets(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """What a RadarFrame holds besides the floor: K targets; with K = 0 the arrays are absent."""

    schema = "caneflow.RadarTargets/1"

    range: Annotated[Array | None, Meta(description="(K,) float32 m, 0 to 1e6")] = None
    range_rate: Annotated[Array | None, Meta(description="(K,) float32 m/s, positive away, within 1000")] = None
    snr: Annotated[Array | None, Meta(description="(K,) float32 dB, within 400")] = None
    above_floor: Annotated[
        Array | None, Meta(description="(K,) uint8, 1 when the Doppler is above the floor's edge")
    ] = None

    def __post_init__(self) -> None:
        columns = {"range_rate": self.range_rate, "snr": self.snr, "above_floor": self.above_floor}
        if self.range is None:
            for name, each in columns.items():
                if each is not None:
                    raise ValueError(f"{name} is there without range; expected all four arrays, or none of them")
            return
        require_array("range", self.range, "f", dimensions=1, most=bounds.TARGET_RANGE)
        if float(self.range.min()) < 0:
            raise ValueError(f"range has an element of {float(self.range.min()):g} m; expected 0 or more")
        for (name, each), letters, most in zip(
            columns.items(), "ffB", (bounds.RANGE_RATE, bounds.SNR, 1.0), strict=True
        ):
            if each is None:
                raise ValueError(f"{name} is missing; expected all four arrays, or none of them")
            require_array(name, each, letters, dimensions=1, most=most)
            _require_as_many(name, each, "range", self.range)
        assert self.above_floor is not None
        if int(self.above_floor.max()) > 1:
            raise ValueError(f"above_floor has an element of {int(self.above_floor.max())}; expected 0 or 1")


class Grid(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """What is occupied around the user, in slices of height, aligned with R0 and never rolled."""

    schema = "caneflow.Grid/1"

    occupancy: Annotated[
        Array, Meta(description="(S, H, W) uint8: 128 + integer log-odds, 128 unknown; i along x0, j along y0")
    ]
    unit: Annotated[bounds.LogOdds, Meta(description="nat per count")]
    cell: Annotated[bounds.CellSize, Meta(description="m, edge of a cell")]
    bottom: Annotated[bounds.Height, Meta(description="m above the floor, of slice 0's lower face")]
    slice: Annotated[bounds.CellSize, Meta(description="m, height of a slice")]
    origin: Annotated[
        tuple[bounds.CellIndex, bounds.CellIndex],
        Meta(description="world cell of [.., 0, 0]: element [s, i, j] covers x0 from (origin[0] + i) cell"),
    ]
    pose_stamp: Annotated[Stamp, Meta(description="ns, of the newest pose used")]
    floor_missing: Annotated[Array | None, Meta(description="(H, W) uint8, the same coding")] = None

    def __post_init__(self) -> None:
        require_array("occupancy", self.occupancy, "B", dimensions=3, most=255)
        if self.floor_missing is not None:
            require_array("floor_missing", self.floor_missing, "B", dimensions=2, most=255)
            if self.floor_missing.shape != self.occupancy.shape[1:]:
                raise ValueError(
                    f"floor_missing has shape {self.floor_missing.shape}; expected {self.occupancy.shape[1:]}"
                )
        require_within("unit", self.unit, *bounds.LOG_ODDS)
        require_within("cell", self.cell, *bounds.CELL_SIZE, "m")
        require_within("slice", self.slice, *bounds.CELL_SIZE, "m")
        require_within("bottom", self.bottom, -bounds.HEIGHT, bounds.HEIGHT, "m")
        for index in self.origin:
            require_within("origin", index, -bounds.CELL_INDEX, bounds.CELL_INDEX)


class Obstacles(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """The nearest of each sector and level: rows left, ahead, right; columns low, waist, head, drop."""

    schema = "caneflow.Obstacles/1"

    heading: Annotated[bounds.Bearing, Meta(description="rad, walking direction in R0, counter-clockwise from x0")]
    walking: Annotated[bool, Meta(description="false while the direction is held, or is the cane's mean yaw")]
    nearest: Annotated[Array, Meta(description="(3, 4) float32 m ahead of the hand; 0 where nothing is told of")]
    known: Annotated[Array, Meta(description="(3, 4) float32, 0 to 1: share of the sector's cells that are known")]
    closing: Annotated[
        Array | None, Meta(description="(3, 4) float32 m/s, positive nearer, 0 where unknown; within 1000")
    ] = None
    place: Annotated[
        Array | None, Meta(description="(3, 4, 2) float32 m in R0, of the cell behind nearest; within 4.1e7")
    ] = None

    def __post_init__(self) -> None:
        require_within("heading", self.heading, -bounds.BEARING, bounds.BEARING, "rad")
        _require_table("nearest", self.nearest, 0.0, bounds.RANGE)
        _require_table("known", self.known, 0.0, 1.0)
        if self.closing is not None:
            _require_table("closing", self.closing, -bounds.RANGE_RATE, bounds.RANGE_RATE)
        if self.place is not None:
            require_array("place", self.place, "f", dimensions=3, most=bounds.POSITION)
            if self.place.shape != (3, 4, 2):
                raise ValueError(f"place has shape {self.place.shape}; expected (3, 4, 2)")


class Cue(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """The one thing to tell the user now: an obstacle, a drop, nothing, or that the device does not see."""

    schema = "caneflow.Cue/1"

    kind: Annotated[Literal["none", "obstacle", "drop", "blind"], Meta(description="what there is to tell")]
    since: Annotated[Stamp, Meta(description="ns: exposure's middle of the first reading that confirmed it")]
    level: Annotated[Level | None, Meta(description="of an obstacle or a drop")] = None
    distance: Annotated[bounds.Distance | None, Meta(description="m ahead of the hand")] = None
    azimuth: Annotated[
        bounds.Azimuth | None, Meta(description="rad from the walking direction, left positive: tan = aside / distance")
    ] = None
    urgency: Annotated[bounds.Share | None, Meta(description="0 to 1")] = None
    time: Annotated[bounds.Contact | None, Meta(description="s to contact, where it comes nearer")] = None
    reason: Annotated[str | None, Meta(description="of blind: names the stream that is missing")] = None

    def __post_init__(self) -> None:
        told = {"level": self.level, "distance": self.distance, "azimuth": self.azimuth, "urgency": self.urgency}
        if self.kind in ("obstacle", "drop"):
            for name, value in told.items():
                if value is None:
                    raise ValueError(f"{name} is missing; a cue of kind {self.kind} has it")
            if (self.kind == "drop") != (self.level == "drop"):
                raise ValueError(f"level is {self.level} with kind {self.kind}; drop goes with drop alone")
        elif any(value is not None for value in told.values()) or self.time is not None:
            raise ValueError(f"a cue of kind {self.kind} has no level, distance, azimuth, urgency or time")
        if (self.kind == "blind") != (self.reason is not None):
            raise ValueError(f"reason is {self.reason} with kind {self.kind}; it goes with blind alone")
        if self.distance is not None:
            require_within("distance", self.distance, 0.0, bounds.RANGE, "m")
        if self.azimuth is not None:
            require_within("azimuth", self.azimuth, -bounds.AZIMUTH, bounds.AZIMUTH, "rad")
        if self.urgency is not None:
            require_within("urgency", self.urgency, 0.0, 1.0)
        if self.time is not None:
            require_within("time", self.time, 0.0, bounds.CONTACT, "s")


def _require_as_many(name: str, array: Array, other: str, reference: Array) -> None:
    if array.shape != reference.shape:
        raise ValueError(f"{name} has {array.size} elements; {other} has {reference.size}")


def _require_table(name: str, table: Array, least: float, most: float) -> None:
    require_array(name, table, "f", dimensions=2, most=most)
    if table.shape != (len(ROWS), len(COLUMNS)):
        raise ValueError(f"{name} has shape {table.shape}; expected ({len(ROWS)}, {len(COLUMNS)})")
    if float(table.min()) < least:
        raise ValueError(f"{name} has an element of {float(table.min()):g}; expected {least:g} to {most:g}")
