"""The Bosch BNO055 on a UART.

out  imu : Imu   gyro, acceleration, magnetic field, the chip's own attitude, 100 Hz
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Gt, Le

from caneflow.messages import Imu
from caneflow.runtime import Brought, Context, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run


@dataclass(frozen=True, kw_only=True)
class Bno055Settings:
    """Where the chip is and how it is to work."""

    __pydantic_config__ = {"extra": "forbid"}

    port: str = "/dev/serial0"
    baud: Literal[115200] = 115200  # bit/s, the only rate that the chip has
    mode: Literal["ndof", "imu"] = "ndof"  # the chip's fusion: with the magnetometer, or without
    rate: Annotated[float, Gt(0), Le(100)] = 100.0  # Hz; the chip's fusion has 100
    external_crystal: bool = True


class Bno055(Source):
    """Reads the chip's measurements and its fusion in one burst."""

    outputs = {"imu": Imu}
    Settings = Bno055Settings

    def __init__(self, settings: Bno055Settings, context: Context) -> None:
        self._settings = settings
        self._node = context.node

    def samples(self) -> Brought:
        """Raise DataflowError: this version has no live driver yet."""
        raise DataflowError(
            f"{self._node}: the live BNO055 driver on {self._settings.port} comes with a later version; "
            "play a recording with --replay REC"
        )


if __name__ == "__main__":
    run(Bno055)
