"""What recordings of real devices have and a simulated walk lacks: readings that are wrong, missing or mislabelled.

The noise of the receiver and a field that changes in time are settings of radar and IMU; the rest is here. Sources:
`p440-rail-mocap` and `p440-udp-loss` are recordings of github jjimmykang/bwsi-backprojection @ 440e21f.
"""

from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Lt
from numpy.random import Generator
from numpy.typing import NDArray

from caneflow.simulation import attitude
from caneflow.simulation.attitude import Floats
from caneflow.simulation.imu import ACCEL_STEP, GYRO_STEP, MAG_STEP, SAMPLE_RATE, ImuSamples
from caneflow.simulation.radar import BORESIGHT
from caneflow.simulation.walk import Rig

NotNegative = Annotated[float, Ge(0)]
Share = Annotated[float, Ge(0), Lt(1)]

# Seconds: reads of a BNO055 that take 100 to 200 ms now and then (github adafruit/Adafruit_CircuitPython_BNO055 #129),
# and a chip that is set up again after them (reset 0.65 s, data sheet table 0-2)
HOLE = (0.05, 0.65)
SCANS_PER_GAP = (1, 2, 3)  # p440-udp-loss, test_scan711_1000: 32 gaps of one (2), two (19) or three (11) scans
GAP_SHARES = (2 / 32, 19 / 32, 11 / 32)
_READINGS = 1 << 15  # of either sign: a register holds 16 bits


@dataclass(frozen=True, kw_only=True)
class FieldFaults:
    """How often and how much; nothing by default."""

    # A register of the IMU read wrong, any of its 16-bit values: a bus that stretches its clock does that (a BNO055 on
    # the I2C of a Raspberry Pi: learn.adafruit.com, raspberry-pi-i2c-clock-stretching-fixes). Not of the quaternion: a
    # driver sees that its norm is not 1
    glitches: NotNegative = 0.0  # per second
    holes: NotNegative = 0.0  # of the IMU, per minute, of a length in HOLE, evenly spread over orders of magnitude
    scan_loss: Share = 0.0  # of the radar's scans (p440-udp-loss, test_scan711_1000: 0.09), in gaps of one to three
    carrier_off: Annotated[float, Gt(-0.5), Lt(0.5)] = 0.0  # what is stated over what is true, less 1
    # Two of the IMU's samples that come in one go and get the time of the second, as half of the rows of an IMU log
    # had; streams need stamps that increase, so they are spread from there on, as `import imu-csv` does
    equal_stamps: Share = 0.0  # of the samples, how many are the second of such a pair
    rig_shift: NotNegative = 0.0  # m: each length of the stated rig is wrong by it, pivot and antenna in any direction
    rig_turn: NotNegative = 0.0  # rad between the stated boresight and the true one, about any axis across it


class Received(NamedTuple):
    """Which of n instants came through, and with which stamp."""

    imu_stamps_ns: NDArray[np.int64]  # (n,)
    imu_kept: NDArray[np.bool_]  # (n,)
    scan_kept: NDArray[np.bool_]  # (n,)


def received(stamps_ns: NDArray[np.int64], faults: FieldFaults, rng: Generator) -> Received:
    """What is left of samples and scans at `stamps_ns`, (n,) ns. The first two seconds are kept: a device starts."""
    hole_rng, scan_rng, stamp_rng = rng.spawn(3)
    count = len(stamps_ns)
    imu_kept = ~_holes(count, faults.holes, hole_rng)
    stamps = stamps_ns.copy()
    pairs = (stamp_rng.random(count) < faults.equal_stamps)[1:] & imu_kept[1:] & imu_kept[:-1]
    pairs[1:] &= ~pairs[:-1]
    second = np.flatnonzero(pairs) + 1
    stamps[second - 1] = stamps_ns[second]
    stamps[second] += 500_000_000 // SAMPLE_RATE
    return Received(stamps, imu_kept, ~_gaps(count, faults.scan_loss, scan_rng))


def glitched(imu: ImuSamples, faults: FieldFaults, rng: Generator) -> ImuSamples:
    """The samples with single readings replaced."""
    count = len(imu.gyro)
    vectors = {"gyro": GYRO_STEP, "accel": ACCEL_STEP, "mag": MAG_STEP, "linear_accel": ACCEL_STEP}
    changed = {name: getattr(imu, name).copy() for name in vectors}
    draws = rng.random((count, 4))
    for i in np.flatnonzero(draws[:, 0] * SAMPLE_RATE < faults.glitches):
        name = list(vectors)[int(draws[i, 1] * len(vectors))]
        row = changed[name][i]
        reading = int((2.0 * draws[i, 3] - 1.0) * _READINGS)
        row[int(draws[i, 2] * len(row))] = vectors[name] * reading
    return imu._replace(**changed)


def stated_rig(rig: Rig, faults: FieldFaults, rng: Generator) -> dict[str, Any]:
    """The rig as someone measured it, as in wire.md."""
    turn, *shifts = (_direction(rng) for _ in range(3))
    higher = faults.rig_shift * (1.0 if rng.random() < 0.5 else -1.0)
    stated: dict[str, Any] = rig.as_map()
    if faults.rig_shift:
        stated["hand_height"] = rig.hand_height + higher
        for name, shift in zip(("pivot", "antenna"), shifts, strict=True):
            stated[name] = (np.array(getattr(rig, name)) + faults.rig_shift * shift).tolist()
    if faults.rig_turn:
        boresight = np.array(BORESIGHT)
        axis = np.cross(boresight, turn)
        turned = attitude.from_rotation_vector((faults.rig_turn * axis / np.linalg.norm(axis))[None])
        stated["boresight"] = attitude.rotate(turned, boresight)[0].tolist()
    return stated


def _holes(count: int, per_minute: float, rng: Generator) -> NDArray[np.bool_]:
    """Where the IMU is silent, (count,): a hole may begin at any sample."""
    draws = rng.random((count, 2))
    lengths = HOLE[0] * (HOLE[1] / HOLE[0]) ** draws[:, 1] * SAMPLE_RATE
    return _silent(draws[:, 0] < per_minute / 60.0 / SAMPLE_RATE, lengths)


def _gaps(count: int, share: float, rng: Generator) -> NDArray[np.bool_]:
    """Where scans are lost, (count,)."""
    draws = rng.random((count, 2))
    lengths = np.take(SCANS_PER_GAP, np.searchsorted(np.cumsum(GAP_SHARES[:-1]), draws[:, 1], side="right"))
    # a gap begins with probability p at any scan that is not in one, so (1 - p) / p scans lie between two
    mean = float(np.dot(SCANS_PER_GAP, GAP_SHARES))
    begins = draws[:, 0] < share / (share + mean * (1.0 - share))
    return _silent(begins, lengths.astype(np.float64))


def _silent(begins: NDArray[np.bool_], lengths: Floats) -> NDArray[np.bool_]:
    silent = np.zeros(len(begins), dtype=np.bool_)
    for i in np.flatnonzero(begins):
        if i >= 2 * SAMPLE_RATE and not silent[i]:
            silent[i : i + round(lengths[i])] = True
    return silent


def _direction(rng: Generator) -> Floats:
    vector = rng.normal(0.0, 1.0, 3)
    return np.asarray(vector / np.linalg.norm(vector), dtype=np.float64)
