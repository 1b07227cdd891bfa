"""The TDK InvenSense MPU-9250 on I2C, worn on the belt.

out  imu : Imu   gyro, acceleration, magnetic field, 100 Hz; no attitude, put operators.attitude behind it
"""

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, Le

from caneflow.messages import Imu
from caneflow.runtime import Brought, Context, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run


@dataclass(frozen=True, kw_only=True)
class Mpu9250Settings:
    """Where the chip is and how often it is read."""

    __pydantic_config__ = {"extra": "forbid"}

    bus: Annotated[int, Ge(0)] = 1  # /dev/i2c-N
    address: Annotated[int, Ge(0x68), Le(0x69)] = 0x68
    rate: Annotated[float, Gt(0), Le(1000)] = 100.0  # Hz; the magnetometer has 100 at most


class Mpu9250(Source):
    """Reads the chip's nine axes."""

    outputs = {"imu": Imu}
    Settings = Mpu9250Settings

    def __init__(self, settings: Mpu9250Settings, context: Context) -> None:
        self._settings = settings
        self._node = context.node

    def samples(self) -> Brought:
        """Raise DataflowError: this version has no live driver yet."""
        raise DataflowError(
            f"{self._node}: the live MPU-9250 driver on /dev/i2c-{self._settings.bus} comes with a later version; "
            "play a recording with --replay REC"
        )


if __name__ == "__main__":
    run(Mpu9250)
