"""Radar: scans, points with Doppler, sound of a Doppler module, and the target in it. SI units, stamps in ns."""

from typing import Annotated

from msgspec import Meta

from caneflow.messages import bounds
from caneflow.messages.arrays import Array
from caneflow.messages.bounds import require_array, require_within
from caneflow.messages.sample import Sample


class RadarFrame(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """Scans of a pulse-Doppler radar: slow time x range."""

    schema = "caneflow.RadarFrame/1"

    scans: Annotated[
        Array,
        Meta(
            description="(N, M) int16, int32, float32 or complex64 (parts of floats within 4.3e9): N scans, oldest "
            "first, of M range bins"
        ),
    ]
    scan_period: Annotated[bounds.ScanPeriod, Meta(description="s between scans")]
    range_start: Annotated[bounds.RangeStart, Meta(description="m, range of bin 0, antenna delay taken off")]
    range_step: Annotated[bounds.RangeStep, Meta(description="m between bins")]
    carrier: Annotated[bounds.Carrier, Meta(description="Hz")]
    bandwidth: Annotated[bounds.Bandwidth, Meta(description="Hz")]

    def __post_init__(self) -> None:
        require_array("scans", self.scans, "hifF", dimensions=2, most=bounds.SCAN)
        require_within("scan_period", self.scan_period, *bounds.SCAN_PERIOD, "s")
        require_within("range_start", self.range_start, *bounds.RANGE_START, "m")
        require_within("range_step", self.range_step, *bounds.RANGE_STEP, "m")
        require_within("carrier", self.carrier, *bounds.CARRIER, "Hz")
        require_within("bandwidth", self.bandwidth, *bounds.BANDWIDTH, "Hz")


class RadarPoints(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """Points of one frame of an imaging radar, each with its Doppler; the stamp is that of the frame's last chirp."""

    schema = "caneflow.RadarPoints/1"

    position: Annotated[Array, Meta(description="(n, 3) float32 m, radar frame: x boresight, y left, z up; n may be 0")]
    doppler: Annotated[Array, Meta(description="(n,) float32 m/s, positive for approaching")]
    frame_time: Annotated[bounds.FrameTime, Meta(description="s from the first to the last chirp")]
    doppler_step: Annotated[bounds.DopplerStep, Meta(description="m/s, width of a Doppler bin")]
    doppler_limit: Annotated[bounds.DopplerStep, Meta(description="m/s, unambiguous to either side of zero")]
    snr: Annotated[Array | None, Meta(description="(n,) float32 dB")] = None
    noise: Annotated[Array | None, Meta(description="(n,) float32 dB")] = None

    def __post_init__(self) -> None:
        require_array("position", self.position, "f", dimensions=2, most=bounds.POINT, may_be_empty=True)
        points = len(self.position)
        if self.position.shape != (points, 3):
            raise ValueError(f"position has shape {self.position.shape}; expected (n, 3)")
        require_one_each("doppler", self.doppler, points, bounds.RANGE_RATE)
        if self.snr is not None:
            require_one_each("snr", self.snr, points, bounds.SNR)
        if self.noise is not None:
            require_one_each("noise", self.noise, points, bounds.SNR)
        require_within("frame_time", self.frame_time, 0.0, bounds.FRAME_TIME, "s")
        require_within("doppler_step", self.doppler_step, *bounds.DOPPLER_STEP, "m/s")
        require_within("doppler_limit", self.doppler_limit, *bounds.DOPPLER_STEP, "m/s")


def require_one_each(name: str, values: Array, points: int, most: float) -> None:
    """Raise ValueError unless there is one float32 within `most` for each of the points."""
    require_array(name, values, "f", dimensions=1, most=most, may_be_empty=True)
    if len(values) != points:
        raise ValueError(f"{name} has {len(values)} elements for {points} points; expected one for each")


class DopplerBlock(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """A block of a continuous-wave Doppler module's output; the stamp is that of its last sample."""

    schema = "caneflow.DopplerBlock/1"

    samples: Annotated[
        Array,
        Meta(description="(n,) int16, float32 or complex64 (I + jQ); of floats full scale is 1, parts within 1e5"),
    ]
    sample_rate: Annotated[bounds.SampleRate, Meta(description="Hz")]
    carrier: Annotated[bounds.Carrier, Meta(description="Hz")]

    def __post_init__(self) -> None:
        require_array("samples", self.samples, "hfF", dimensions=1, most=bounds.SOUND)
        require_within("sample_rate", self.sample_rate, *bounds.SAMPLE_RATE, "Hz")
        require_within("carrier", self.carrier, *bounds.CARRIER, "Hz")


class DopplerTarget(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """The predominant moving target that one Doppler module sees."""

    schema = "caneflow.DopplerTarget/1"

    range_rate: Annotated[
        bounds.RangeRate, Meta(description="m/s, positive away from the sensor; magnitude when not signed")
    ]
    signed: Annotated[bool, Meta(description="false: one mixer, the sign is unknown")]
    amplitude: Annotated[bounds.Amplitude, Meta(description="of the predominant line, full scale = 1 (int16: 32768)")]
    snr: Annotated[bounds.Snr, Meta(description="dB")]
    valid: Annotated[bool, Meta(description="false: no line above the threshold")]
    range: Annotated[bounds.TargetRange | None, Meta(description="m, from the received strength")] = None
    delay: Annotated[bounds.Delay | None, Meta(description="s by which the value lags its stamp")] = None

    def __post_init__(self) -> None:
        require_within("range_rate", self.range_rate, -bounds.RANGE_RATE, bounds.RANGE_RATE, "m/s")
        require_within("amplitude", self.amplitude, 0.0, bounds.AMPLITUDE)
        require_within("snr", self.snr, -bounds.SNR, bounds.SNR, "dB")
        if self.range is not None:
            require_within("range", self.range, 0.0, bounds.TARGET_RANGE, "m")
        if self.delay is not None:
            require_within("delay", self.delay, 0.0, bounds.DELAY, "s")
