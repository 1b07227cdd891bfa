"""The rig: what is bolted on, as opposed to what flows. One map, for every node and in every recording."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeAlias

from annotated_types import Ge, Le
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from caneflow.messages.errors import MessageError

# What bolts things together is measured with a ruler: a lever is no longer than a person, a building is no longer than
# ten kilometres, and nobody reads less than a millimetre.
Component: TypeAlias = Annotated[float, Ge(-10), Le(10)]  # of a direction: its norm is looked at after that
Lever: TypeAlias = Annotated[float, Ge(-10), Le(10)]  # m
Place: TypeAlias = Annotated[float, Ge(-1e4), Le(1e4)]  # m, R0
FieldOfView: TypeAlias = Annotated[float, Ge(1e-3), Le(3.15)]  # rad
Reach: TypeAlias = Annotated[float, Ge(0), Le(1e4)]  # m
Direction: TypeAlias = tuple[Component, Component, Component]
Levers: TypeAlias = tuple[Lever, Lever, Lever]
Rotation: TypeAlias = tuple[Component, Component, Component, Component]  # as Component
Area: TypeAlias = tuple[Place, Place, Place, Place]

MOST_CAUSES = 20  # that are told of one rig


class Sensor(BaseModel):
    """One static Doppler module of a room."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    position: Annotated[tuple[Place, Place, Place], Field(description="m, R0")]
    azimuth: Annotated[float, Field(ge=-100, le=100, description="rad, of the boresight, counter-clockwise from x0")]
    # 1 mm to 1 km where the amplitude is 1
    k: Annotated[float | None, Field(ge=1e-12, le=1e12, description="m^4: range = (k / amplitude^2)^(1/4)")] = None


class Start(BaseModel):
    """The user's guess of where a person starts."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    position: Annotated[tuple[Place, Place], Field(description="m, R0")]
    sd: Annotated[float, Field(ge=1e-3, le=1e4, description="m")]


class Ranger(BaseModel):
    """One range sensor on the cane: where it sits, and where its zones look."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    position: Annotated[Levers, Field(description="m from the IMU, body frame")]
    boresight: Annotated[Direction, Field(description="unit vector of its axis, body frame")]
    up: Annotated[Direction, Field(description="unit vector at right angles to it: up as the sensor looks out")]
    rows: Annotated[int, Field(ge=1, le=64, description="zones one above the other")]
    columns: Annotated[int, Field(ge=1, le=64, description="zones side by side")]
    field: Annotated[tuple[FieldOfView, FieldOfView], Field(description="rad over the rows, over the columns")]
    reach: Annotated[tuple[Reach, Reach], Field(description="m, nearest and farthest")]
    kind: Annotated[Literal["tof", "sonar"], Field(description="light or sound")] = "tof"

    @field_validator("boresight", "up")
    @classmethod
    def _unit(cls, direction: Direction) -> Direction:
        return require_direction(direction)

    @model_validator(mode="after")
    def _sound(self) -> "Ranger":
        across = sum(x * y for x, y in zip(self.boresight, self.up, strict=True))
        if abs(across) > 0.01:
            raise ValueError(f"up is not at right angles to boresight: their product is {across:.3g}, expected 0")
        if not self.reach[0] < self.reach[1]:
            raise ValueError(f"reach is {list(self.reach)}; expected the nearest first, then the farthest")
        return self


class Guidance(BaseModel):
    """What one person wants to hear and feel of the cues."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    volume: Annotated[float, Field(ge=0, le=1, description="of sounds and vibration; 0: none")] = 0.5
    range: Annotated[float, Field(ge=0.3, le=10, description="m, beyond which nothing is told")] = 3.0
    levels: Annotated[
        tuple[Literal["low", "waist", "head", "drop"], ...], Field(max_length=4, description="that are told of")
    ] = ("low", "waist", "head", "drop")
    tick: Annotated[float, Field(ge=0, le=60, description="s of silence until a soft tick says it runs; 0: never")] = (
        5.0
    )


class User(BaseModel):
    """The person who holds the cane."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    shoulder: Annotated[float, Field(ge=0.1, le=2, description="m, half the width to keep free")] = 0.35
    height: Annotated[float, Field(ge=1.3, le=3, description="m, up to which something is in the way")] = 2.0
    hand: Annotated[
        tuple[Lever, Lever], Field(description="m, of the hand ahead and to the left of the body's middle")
    ] = (0.30, -0.08)
    guidance: Annotated[Guidance, Field(description="what the person wants to hear and feel")] = Guidance()


class Rig(BaseModel):
    """Everything that may be known of a rig; what is not known is None."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    boresight: Annotated[Direction, Field(description="unit vector of the radar's axis, body frame")] = (
        0.0,
        1.0,
        0.0,
    )
    hand_height: Annotated[float | None, Field(ge=0.01, le=10, description="m, of the hand above ground")] = None
    aperture: Annotated[float | None, Field(ge=1e-3, lt=3.2, description="rad, full -3 dB angle (delta)")] = None
    aperture_across: Annotated[
        float | None, Field(ge=1e-3, lt=3.2, description="rad, full -3 dB angle across the cane; default: aperture")
    ] = None
    radar_orientation: Annotated[
        Rotation | None,
        Field(description="w x y z, radar to body frame; default: x on boresight, y horizontal in a level cane"),
    ] = None
    pivot: Annotated[Levers | None, Field(description="m, from the sensors to the hand, body frame")] = None
    antenna: Annotated[Levers, Field(description="m, from IMU to antenna, body frame")] = (0.0, 0.0, 0.0)
    step_length: Annotated[float | None, Field(ge=0.01, le=10, description="m, step-and-heading only")] = None
    sensors: Annotated[dict[str, Sensor], Field(description="room: Doppler modules by node name")] = {}
    area: Annotated[Area | None, Field(description="room: xmin, xmax, ymin, ymax, m")] = None
    start: Annotated[Start | None, Field(description="room: the user's guess of the start")] = None

    rangers: Annotated[dict[str, Ranger], Field(description="cane: range sensors by node name")] = {}
    user: Annotated[User | None, Field(description="who holds the cane; without it an adult, right hand")] = None

    @field_validator("boresight")
    @classmethod
    def _unit(cls, boresight: Direction) -> Direction:
        return require_direction(boresight)

    @field_validator("radar_orientation")
    @classmethod
    def _rotation(cls, orientation: Rotation | None) -> Rotation | None:
        if orientation is not None:
            norm = sum(x * x for x in orientation) ** 0.5
            if abs(norm - 1) > 1e-3:
                raise ValueError(f"has norm {norm:.6g}; a rotation has 1")
        return orientation

    def need(self, name: str) -> Any:
        """The value of key `name`; raises MessageError when it is not known."""
        value = getattr(self, name)
        if value is None:
            meaning = type(self).model_fields[name].description
            raise MessageError(
                f"rig.{name} is not known ({meaning}); write it under rig: in the yaml, or give --rig FILE"
            )
        return value


def require_direction(direction: Direction) -> Direction:
    """The same; raises ValueError unless its norm is 1 within a thousandth."""
    norm = sum(x * x for x in direction) ** 0.5
    if abs(norm - 1) > 1e-3:
        raise ValueError(f"has norm {norm:.6g}; a direction has 1")
    return direction


def read_rig(values: Mapping[str, object]) -> Rig:
    """The rig in a map that a recording or a plan holds; raises MessageError, naming every value that is not right.

    Keys that this version does not know are left out: a later one may have recorded them.
    """
    known = {key: value for key, value in values.items() if key in Rig.model_fields}
    try:
        return Rig.model_validate(known)
    except ValidationError as error:
        errors = error.errors(include_url=False, include_input=False)
        causes = [f"rig.{'.'.join(map(str, cause['loc']))}: {cause['msg']}" for cause in errors[:MOST_CAUSES]]
        more = [f"and {len(errors) - MOST_CAUSES} more"] if len(errors) > MOST_CAUSES else []
        raise MessageError("; ".join(causes + more)) from error


def overlaid(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """`above` laid over `below`, key by key, to any depth."""
    merged = dict(below)
    for key, value in above.items():
        under = merged.get(key)
        merged[key] = overlaid(under, value) if isinstance(under, dict) and isinstance(value, dict) else value
    return merged
