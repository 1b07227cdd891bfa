"""A continuous-wave Doppler module on a sound card or another ADC that PortAudio knows.

out  block : DopplerBlock   one per 50 ms
"""

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt

from caneflow.messages import DopplerBlock
from caneflow.runtime import Brought, Context, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run


@dataclass(frozen=True, kw_only=True)
class DopplerAdcSettings:
    """Which input of which device the module is on."""

    __pydantic_config__ = {"extra": "forbid"}

    device: str = "default"  # as PortAudio names it
    channel: Annotated[int, Ge(0)] = 0  # of the device: the module's output, or I of an I/Q module
    quadrature: Annotated[int, Ge(0)] | None = None  # channel of Q; None: a module with one mixer
    sample_rate: Annotated[float, Gt(0)] = 4000.0  # Hz
    carrier: Annotated[float, Gt(0)] = 24.125e9  # Hz
    block: Annotated[float, Gt(0)] = 0.05  # s


class DopplerAdc(Source):
    """Reads blocks of the module's output."""

    outputs = {"block": DopplerBlock}
    Settings = DopplerAdcSettings

    def __init__(self, settings: DopplerAdcSettings, context: Context) -> None:
        self._settings = settings
        self._node = context.node

    def samples(self) -> Brought:
        """Raise DataflowError: this version has no live driver yet."""
        raise DataflowError(
            f"{self._node}: the live driver of a Doppler module on {self._settings.device} comes with a later "
            "version; play a recording with --replay REC"
        )


if __name__ == "__main__":
    run(DopplerAdc)
