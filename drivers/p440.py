"""The Time Domain PulsON 440 as a monostatic radar (MRM), on Ethernet.

out  frame : RadarFrame   one scan each, up to 100 Hz
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le

from caneflow.messages import RadarFrame
from caneflow.runtime import Brought, Context, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

Picoseconds = Annotated[int, Ge(-499_998), Le(499_998)]


@dataclass(frozen=True, kw_only=True)
class P440Settings:
    """Where the radar is and how it scans; by default 480 bins, which fit into 10 ms at integration index 11."""

    __pydantic_config__ = {"extra": "forbid"}

    host: str = "192.168.1.100"
    port: Annotated[int, Ge(1), Le(65535)] = 21210  # UDP
    scan_start_ps: Picoseconds = 10_000  # ps after the pulse, antenna path included
    scan_stop_ps: Picoseconds = 39_297  # ps; the radar rounds the window up to a multiple of 96 bins of 61.035 ps
    scan_period_us: Annotated[int, Ge(0), Le(2**32 - 1)] = 10_000  # us between scans; 0: back to back
    integration_index: Annotated[int, Ge(6), Le(15)] = 11  # 2^index pulses are summed in a bin
    code_channel: Annotated[int, Ge(0), Le(10)] = 6
    transmit_gain: Annotated[int, Ge(0), Le(63)] = 63  # 0..63; the regulator may ask for less
    antennas: Literal["a", "b", "a_to_b", "b_to_a"] = "a_to_b"  # transmits by the first, receives by the last
    antenna_delay_ps: Annotated[int, Ge(0), Le(100_000)] = 10_000  # ps of path in the antennas, both ways
    carrier: Annotated[float, Gt(0)] = 4.3e9  # Hz, effective centre of the received band
    bandwidth: Annotated[float, Gt(0)] = 1.7e9  # Hz, at -10 dB

    def __post_init__(self) -> None:
        if self.scan_stop_ps <= self.scan_start_ps:
            raise ValueError(
                f"scan_stop_ps is {self.scan_stop_ps}; the scan stops after it starts, at {self.scan_start_ps} ps"
            )


class P440(Source):
    """Asks the radar for scans without end and puts their packets together."""

    outputs = {"frame": RadarFrame}
    Settings = P440Settings

    def __init__(self, settings: P440Settings, context: Context) -> None:
        self._settings = settings
        self._node = context.node

    def samples(self) -> Brought:
        """Raise DataflowError: this version has no live driver yet."""
        raise DataflowError(
            f"{self._node}: the live P440 driver for {self._settings.host} comes with a later version; "
            "play a recording with --replay REC"
        )


if __name__ == "__main__":
    run(P440)
