"""The predominant moving target of one continuous-wave Doppler module: speed along the beam, strength, range.

in   block  : DopplerBlock    any length; 50 ms is usual
out  target : DopplerTarget   one per hop of 50 ms (a longer block gives one), once a window of 256 ms is there
"""

from dataclasses import dataclass, field

from caneflow.algorithms.quantities import RangeCalibration
from caneflow.algorithms.radar.doppler_line import DopplerLineSettings, LineFollower, range_from_strength
from caneflow.algorithms.radar.doppler_spectrum import DopplerSpectrumSettings, SlidingSpectrum
from caneflow.messages import DopplerBlock, DopplerTarget, MessageError, Sample
from caneflow.messages.rig import Rig
from caneflow.runtime import Context, Emitted, Operator, Refused
from caneflow.runtime.node import run


@dataclass(frozen=True, kw_only=True)
class DopplerSettings:
    """Which sensor of the rig it is, and how its spectrum is read."""

    __pydantic_config__ = {"extra": "forbid"}

    sensor: str | None = None  # its name in the rig, whose k gives the range
    k: RangeCalibration | None = None  # m^4, instead of the rig's
    spectrum: DopplerSpectrumSettings = field(default_factory=DopplerSpectrumSettings)
    line: DopplerLineSettings = field(default_factory=DopplerLineSettings)


class Doppler(Operator):
    """A sliding window over the blocks, and the strongest line in it."""

    inputs = {"block": DopplerBlock}
    outputs = {"target": DopplerTarget}
    Settings = DopplerSettings

    def __init__(self, settings: DopplerSettings, context: Context) -> None:
        self._spectrum = SlidingSpectrum(settings.spectrum)
        self._line = LineFollower(settings.line)
        self._k = settings.k or range_calibration(settings.sensor, context.rig)

    def handle(self, port: str, message: Sample) -> Emitted:
        """Yield the target of the window that ends with the block; between hops there is none."""
        assert isinstance(message, DopplerBlock)
        try:
            spectrum = self._spectrum.update(message.stamp, message.samples, message.sample_rate, message.carrier)
        except ValueError as error:
            raise Refused(str(error)) from error
        if spectrum is None:
            return
        line = self._line.update(spectrum)
        with_range = self._k is not None and line.valid
        yield (
            "target",
            DopplerTarget(
                stamp=message.stamp,
                range_rate=line.range_rate,
                signed=spectrum.signed,
                amplitude=line.amplitude,
                range=range_from_strength(line.amplitude, self._k) if with_range and self._k else None,
                snr=line.snr,
                valid=line.valid,
                delay=self._spectrum.delay,
            ),
        )


def range_calibration(sensor: str | None, rig: Rig) -> float | None:
    """The sensor's k, m^4; None when none is named, or not calibrated. Raises MessageError for a stranger."""
    if sensor is None:
        return None
    if sensor not in rig.sensors:
        there = ", ".join(rig.sensors) or "none"
        raise MessageError(f"rig.sensors has no {sensor!r}; there are: {there}")
    return rig.sensors[sensor].k


if __name__ == "__main__":
    run(Doppler)
