"""Acconeer A121: what can be set, how long a sweep takes, and what a frame's samples mean.

Numbers from the vendor's documentation and source (github acconeer/acconeer-python-exploration @ e29f30d); times per
sample agree with `max_sweep_rate` in two real recordings within 1.3 %.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from statistics import median_low
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from caneflow.physics import SPEED_OF_LIGHT
from caneflow.protocols.errors import ProtocolError

CARRIER: Final = 60.5e9  # Hz
BASE_STEP: Final = 2.502274e-3  # m of range between points; in every recording that was looked at
BUFFER_POINTS: Final = 4095  # of a frame
STEP_UNIT: Final = 24  # a step length divides it, or is a multiple of it
BYTES_PER_POINT: Final = 4  # int16 I and Q
FASTEST_WRAP: Final = 2**32  # ticks, after which the device's clock begins again
CONTINUOUS_NS: Final = 32_000  # ns added to a sweep in continuous sweep mode
EXTRA_SAMPLES: Final = 3  # of a sweep, without points
OUTLIER: Final = 8.0  # times the median of the second differences along sweeps, beyond which a sample is disturbed
FEWEST_SWEEPS: Final = 32  # of a frame, for the median to mean something: the vendor's filter needs as many
HEADERS: Final = 15e3  # bytes per second of a link that frames' own lines take
UART_BITS: Final = 10  # of a byte


class Profile(NamedTuple):
    """A transmitted pulse."""

    width: float  # m, full width at half power
    gain: float  # dB, radar loop gain: SNR of 1 m^2 at 1 m in one sample
    sample: float  # ns of one averaged sample at 15.6 MHz
    overhead: float  # ns of one point


PROFILES: Final = {
    1: Profile(0.04, 11.3, 1795.0, 2102.0),
    2: Profile(0.07, 13.7, 1344.0, 1612.0),
    3: Profile(0.14, 19.0, 1026.0, 1282.0),
    4: Profile(0.19, 20.5, 1026.0, 1282.0),
    5: Profile(0.32, 21.6, 1026.0, 1282.0),
}


class Repetition(NamedTuple):
    """A pulse repetition frequency."""

    frequency: float  # Hz
    farthest: float  # m that can be measured
    folds: float  # m beyond which an echo comes back as a nearer one


REPETITIONS: Final = {
    "19_5_MHz": Repetition(19.5e6, 3.1, 7.7),
    "15_6_MHz": Repetition(15.6e6, 5.1, 9.6),
    "13_0_MHz": Repetition(13.0e6, 7.0, 11.5),
}


@dataclass(frozen=True, kw_only=True)
class SweepSetup:
    """How the radar measures: points of a sweep and sweeps of a frame, in continuous sweep mode."""

    start_point: int  # in base steps
    points: int
    step_length: int  # base steps from point to point
    profile: int = 3
    averages: int = 8  # per point, the vendor's HWAAS
    repetition: str = "15_6_MHz"
    sweep_rate: float = 2000.0  # Hz
    sweeps: int = 20  # per frame

    @property
    def sweep_time(self) -> float:
        """Least time (s) of a sweep."""
        profile = PROFILES[self.profile]
        scale = REPETITIONS["15_6_MHz"].frequency / REPETITIONS[self.repetition].frequency
        nanoseconds = self.points * (self.averages * profile.sample + profile.overhead) + EXTRA_SAMPLES * profile.sample
        return (nanoseconds * scale + CONTINUOUS_NS) * 1e-9

    @property
    def link_rate(self) -> float:
        """Bytes per second of samples."""
        return self.points * BYTES_PER_POINT * self.sweep_rate

    def config(self) -> dict[str, Any]:
        """As the exploration protocol has it; 0.0 for no frame rate of its own: sweeps without a gap."""
        return {
            "sweep_rate": self.sweep_rate,
            "frame_rate": 0.0,
            "continuous_sweep_mode": True,
            "double_buffering": True,
            "inter_frame_idle_state": "ready",
            "inter_sweep_idle_state": "ready",
            "sweeps_per_frame": self.sweeps,
            "subsweeps": [
                {
                    "start_point": self.start_point,
                    "num_points": self.points,
                    "step_length": self.step_length,
                    "profile": self.profile,
                    "hwaas": self.averages,
                    "receiver_gain": 16,
                    "enable_tx": True,
                    "enable_loopback": False,
                    "phase_enhancement": False,
                    "prf": self.repetition,
                }
            ],
        }


class RangeAxis(NamedTuple):
    """Where the points of a sweep lie."""

    start: float  # m, of the first
    step: float  # m from one to the next


def setup_fault(setup: SweepSetup, baud: int | None) -> str | None:
    """Why a radar on a UART of `baud` bit/s (None: another link) cannot measure so, in m, Hz and kB/s; None: it can."""
    last = (setup.start_point + (setup.points - 1) * setup.step_length) * BASE_STEP
    repetition = REPETITIONS[setup.repetition]
    if setup.repetition == "19_5_MHz" and setup.profile != 1:
        return f"prf is 19_5_MHz with profile {setup.profile}; it needs profile 1"
    if last > repetition.farthest:
        return f"end is {last:.2f} m; at prf {setup.repetition} the radar measures to {repetition.farthest:g} m"
    size = setup.points * setup.sweeps
    if size > BUFFER_POINTS:
        return f"{setup.points} points x {setup.sweeps} sweeps are {size}; the radar's buffer holds {BUFFER_POINTS}"
    fastest = 1.0 / setup.sweep_time
    if setup.sweep_rate > fastest:
        return (
            f"sweep_rate is {setup.sweep_rate:g} Hz; {setup.points} points of profile {setup.profile} and hwaas "
            f"{setup.averages} take {1e3 * setup.sweep_time:.3f} ms, {fastest:.0f} Hz at most"
        )
    capacity = math.inf if baud is None else baud / UART_BITS - HEADERS
    if setup.link_rate > capacity:
        return (
            f"{setup.points} points at {setup.sweep_rate:g} Hz are {setup.link_rate / 1e3:.0f} kB/s; a UART of {baud} "
            f"bit/s carries {max(capacity, 0.0) / 1e3:.0f} kB/s of samples"
        )
    return None


def range_axis(start_point: int, step_length: int, base_step: float = BASE_STEP) -> RangeAxis:
    """Ranges of a sweep that begins at `start_point` base steps."""
    return RangeAxis(start_point * base_step, step_length * base_step)


def bandwidth_of(profile: int) -> float:
    """Hz, of a Gaussian pulse as wide as the profile's: 0.44 c / (2 width)."""
    return 0.44 * SPEED_OF_LIGHT / (2.0 * PROFILES[profile].width)


def scans_of(real: NDArray[np.int16], imag: NDArray[np.int16]) -> NDArray[np.complex64]:
    """Samples of sweeps, shape (N, M), as a RadarFrame has them.

    The conjugate: the A121's raw phase grows with range, so that what approaches would have a negative Doppler.
    """
    scans = np.empty(real.shape, np.complex64)
    scans.real = real
    scans.imag = -imag.astype(np.float32)
    return scans


def repaired(scans: NDArray[np.complex64]) -> tuple[NDArray[np.complex64], int]:
    """The sweeps without the samples that double buffering disturbs, and how many those were.

    While the radar sends one buffer it fills the other, which disturbs up to two sweeps of a frame. A disturbed sample
    stands out in the second difference along sweeps; its neighbours' mean takes its place.
    """
    if len(scans) < FEWEST_SWEEPS:
        return scans, 0
    second = np.abs(scans[2:] - 2.0 * scans[1:-1] + scans[:-2])
    usual = np.median(second, axis=0)
    wild = np.zeros(scans.shape, bool)
    # a wild sample makes three second differences large, its own the most
    wild[1:-1] = second > OUTLIER * np.maximum(usual, 1.0)
    wild[2:-1] &= second[1:] >= second[:-1]
    wild[1:-2] &= second[:-1] >= second[1:]
    count = int(np.count_nonzero(wild))
    if not count:
        return scans, 0
    means = 0.5 * (scans[2:] + scans[:-2])
    mended = scans.copy()
    mended[1:-1][wild[1:-1]] = means[wild[1:-1]]
    return mended, count


def frame_numbers(ticks: Sequence[int]) -> list[int]:
    """Numbers of frames, from 0, by the device's clock (uint32, wraps): frames that are missing are left out.

    Raises:
        ProtocolError: the clock does not go on.
    """
    steps = _steps(ticks)
    if not steps:
        return [0] * len(ticks)
    usual = median_low(steps)  # one of them: the mean of a frame and of a gap is neither
    if usual <= 0 or max(steps) > FASTEST_WRAP // 2:
        raise ProtocolError(f"the clock of its frames does not go on: steps of {min(steps)} to {max(steps)} ticks")
    numbers = [0]
    for step in steps:
        numbers.append(numbers[-1] + max(round(step / usual), 1))
    return numbers


def frame_period(ticks: Sequence[int], numbers: Sequence[int]) -> float:
    """Ticks from frame to frame: the line of least squares through all of them; needs two."""
    elapsed = np.array([0, *accumulate(_steps(ticks))], np.float64)
    slope, _ = np.polyfit(np.asarray(numbers, np.float64), elapsed, 1)
    return float(slope)


def _steps(ticks: Sequence[int]) -> list[int]:
    return [(later - earlier) % FASTEST_WRAP for earlier, later in pairwise(ticks)]


def setup_problem(setup: Mapping[str, Any]) -> str | None:
    """What keeps a recorded or sent sensor configuration from being read; None: nothing."""
    sweeps = setup.get("subsweeps")
    if not isinstance(sweeps, list) or not sweeps:
        return "it has no subsweeps"
    for name in ("start_point", "num_points", "step_length", "profile"):
        if name not in sweeps[0]:
            return f"its subsweep has no {name}"
    return None


def profile_number(profile: object) -> int:
    """1 to 5, of "PROFILE_3" (a file) or 3 (the protocol); raises ProtocolError for another."""
    text = str(profile).removeprefix("PROFILE_")
    if not text.isdecimal() or int(text) not in PROFILES:
        raise ProtocolError(f"profile {profile!r}; there are {', '.join(map(str, PROFILES))}")
    return int(text)


def fitting_step(step: float) -> int:
    """The step length (base steps) nearest to `step` m that the radar takes: a divisor of 24, or a multiple."""
    wanted = step / BASE_STEP
    allowed = [each for each in range(1, STEP_UNIT) if STEP_UNIT % each == 0]
    allowed += [STEP_UNIT * each for each in range(1, max(2, math.ceil(wanted / STEP_UNIT) + 1))]
    return min(allowed, key=lambda each: abs(each - wanted))
