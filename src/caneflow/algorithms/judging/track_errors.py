"""How far a track lies from the truth (cane.md row 16): horizontal, start pose given, nothing else fitted.

Aligned at start position and yaw only. A fit over the whole track would hide a constant scale or heading error.
"""

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.rotations import Vector

Floats: TypeAlias = NDArray[np.float64]
Stamps: TypeAlias = NDArray[np.int64]

START_NS = 500_000_000  # the yaw at the start is the mean of this long
LARGEST_MISS_NS = 1_000_000_000  # a track that starts later or ends earlier than the truth by this is not a track
LOCAL_DISTANCE = 2.0  # m ahead, of the point that is drawn again
LOCAL_QUANTILE = 0.95
RELATIVE_LENGTH = 1.0  # m of truth's path over which the relative error is taken


@dataclass(frozen=True, kw_only=True)
class TrackErrors:
    """Errors of one track; None where a figure has no meaning (a truth that does not move, or not far enough)."""

    poses: int
    duration: float  # s
    length: float  # m, of the truth's path
    final_distance: float  # m, end to start of the estimate: the paper's error, for closed walks
    final_error: float  # m, end of the estimate to end of the truth
    ate: float  # m, root mean square distance to the truth
    rpe: float | None  # m, root mean square error of the displacement over RELATIVE_LENGTH, heading at its start given
    drift_percent: float | None  # final_error in % of length
    path_length_ratio: float | None  # length of the estimate's path over that of the truth: shows a constant scale
    extent: float | None  # longer side of the estimate's bounding box over that of the truth
    growth_rate: float  # m/s, final_distance over duration, as in Table I
    local_1s: float | None = None  # m, 95 % quantile: how far off a point LOCAL_DISTANCE away is drawn 1 s after it was
    local_5s: float | None = None  # m, the same after 5 s: what a map of the surroundings rests on


@dataclass(frozen=True, kw_only=True)
class Track:
    """Poses in time: stamps (n,) ns strictly increasing, positions (n, 3) m, orientations (n, 4) w x y z."""

    stamps: Stamps
    positions: Floats
    orientations: Floats

    def __post_init__(self) -> None:
        count = len(self.stamps)
        if count < 2:
            raise ValueError(f"a track of {count} poses; at least 2 are needed")
        if self.positions.shape != (count, 3) or self.orientations.shape != (count, 4):
            raise ValueError(
                f"{count} stamps, positions {self.positions.shape}, orientations {self.orientations.shape}; "
                f"expected ({count}, 3) and ({count}, 4)"
            )


class Aligned(NamedTuple):
    """An estimate laid on the truth."""

    track: Floats  # (n, 2) m, the estimate
    path: Floats  # (n, 2) m, the truth at the estimate's stamps
    turn: float  # rad, by which the estimate was turned counter-clockwise


def track_errors(estimate: Track, truth: Track, *, boresight: Vector = (0.0, 1.0, 0.0)) -> TrackErrors:
    """Errors of `estimate` against `truth`; `boresight` is the body vector whose yaw is aligned.

    Raises ValueError when the estimate misses more than LARGEST_MISS_NS of either end of the truth.
    """
    _require_cover(estimate.stamps, truth.stamps)
    track, path, turn = aligned(estimate, truth, boresight=boresight)
    times = (estimate.stamps - estimate.stamps[0]) * 1e-9
    truth_times = (truth.stamps - estimate.stamps[0]) * 1e-9
    yaw = boresight_yaws(estimate.orientations, boresight) + turn
    truth_yaw = boresight_yaws(truth.orientations, boresight)
    heading_error = yaw - np.interp(times, truth_times, np.unwrap(truth_yaw))

    errors = np.linalg.norm(track - path, axis=1)
    length, final = path_length(path), float(errors[-1])
    final_distance = float(np.linalg.norm(track[-1]))
    duration = float(times[-1])
    return TrackErrors(
        poses=len(track),
        duration=duration,
        length=length,
        final_distance=final_distance,
        final_error=final,
        ate=float(np.sqrt(np.mean(errors**2))),
        rpe=relative_error(track, path, heading_error, RELATIVE_LENGTH),
        drift_percent=_ratio(100.0 * final, length),
        path_length_ratio=_ratio(path_length(track), length),
        extent=_ratio(float(np.ptp(track, axis=0).max()), float(np.ptp(path, axis=0).max())),
        growth_rate=final_distance / duration,
        local_1s=local_error(times, track, path, yaw, heading_error, 1.0),
        local_5s=local_error(times, track, path, yaw, heading_error, 5.0),
    )


def aligned(estimate: Track, truth: Track, *, boresight: Vector = (0.0, 1.0, 0.0)) -> Aligned:
    """Both tracks from one origin in the truth's frame: aligned at the start's position and yaw, nothing else."""
    origin = estimate.stamps[0]
    yaw = boresight_yaws(estimate.orientations, boresight)
    turn = _start_turn(estimate.stamps, yaw, boresight_yaws(truth.orientations, boresight))
    times, truth_times = (estimate.stamps - origin) * 1e-9, (truth.stamps - origin) * 1e-9
    path = np.stack([np.interp(times, truth_times, truth.positions[:, axis]) for axis in (0, 1)], axis=1)
    track = _turned((estimate.positions - estimate.positions[0])[:, :2], turn)
    return Aligned(track, path - path[0], turn)


def final_offset(estimate: Track, truth: Track, *, boresight: Vector = (0.0, 1.0, 0.0)) -> Floats:
    """Where the estimate ends less where the truth ends (m, shape (2,)), both aligned as in `aligned`.

    In the estimate's own frame, which is that of its covariance; its length is `final_error`.
    """
    track, path, turn = aligned(estimate, truth, boresight=boresight)
    offset: Floats = _turned(track[-1:] - path[-1:], -turn)[0]
    return offset


def boresight_yaws(orientations: Floats, boresight: Vector) -> Floats:
    """Yaw (rad, shape (n,)) of a body vector for orientations, shape (n, 4)."""
    w, x, y, z = np.asarray(orientations, dtype=np.float64).T
    a, b, c = boresight
    east = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c
    north = 2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c
    yaw: Floats = np.arctan2(north, east)
    return yaw


def path_length(path: Floats) -> float:
    """Length (m) of a polyline, shape (n, 2)."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def relative_error(track: Floats, path: Floats, heading_error: Floats, length: float) -> float | None:
    """Root mean square error (m) of the displacement over `length` m of the true path, from every pose on.

    `track` and `path` have shape (n, 2), `heading_error` (rad) shape (n,): estimated less true yaw. Each estimated
    displacement is turned back by the heading error at its start, so an old heading error does not count again.
    None when the path is shorter than `length`.
    """
    travelled = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))))
    ends = np.searchsorted(travelled, travelled + length)
    starts = np.flatnonzero(ends < len(path))
    if not len(starts):
        return None
    ends = ends[starts]
    moved = _turned(track[ends] - track[starts], -heading_error[starts])
    errors = moved - (path[ends] - path[starts])
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def local_error(
    times: Floats, track: Floats, path: Floats, yaw: Floats, heading_error: Floats, after: float
) -> float | None:
    """How far (m) from its first place a fixed point is drawn `after` s later, LOCAL_QUANTILE over all poses.

    `track` and `path` (n, 2) m are the estimated and true places at `times` (n,) s, `yaw` the estimated one and
    `heading_error` that less the true one, (n,) rad. The point lies LOCAL_DISTANCE ahead of the true place at first; it
    is drawn where an estimate puts what a faultless sensor sees. None when the track is shorter.
    """
    ends = np.searchsorted(times, times + after)
    starts = np.flatnonzero(ends < len(times))
    if not len(starts):
        return None
    ends = ends[starts]
    true_yaw = (yaw - heading_error)[starts]
    ahead = LOCAL_DISTANCE * np.stack([np.cos(true_yaw), np.sin(true_yaw)], axis=1)
    first = track[starts] + _turned(ahead, heading_error[starts])
    again = track[ends] + _turned(path[starts] + ahead - path[ends], heading_error[ends])
    return float(np.quantile(np.linalg.norm(again - first, axis=1), LOCAL_QUANTILE))


def _require_cover(stamps: Stamps, truth: Stamps) -> None:
    if stamps[0] - truth[0] > LARGEST_MISS_NS or truth[-1] - stamps[-1] > LARGEST_MISS_NS:
        late, early = (stamps[0] - truth[0]) * 1e-9, (truth[-1] - stamps[-1]) * 1e-9
        raise ValueError(
            f"the track starts {late:.2f} s after the truth and ends {early:.2f} s before it; "
            f"at most {LARGEST_MISS_NS * 1e-9:g} s may be missing"
        )


def _start_turn(stamps: Stamps, yaw: Floats, truth_yaw: Floats) -> float:
    """Angle (rad) that turns the estimate's yaw at the start into the truth's.

    Both means are over as many poses as the estimate has in START_NS, counted from the first of each.
    """
    count = min(int(np.searchsorted(stamps, stamps[0] + START_NS)), len(truth_yaw))
    return float(np.angle(np.mean(np.exp(1j * (truth_yaw[:count] - yaw[:count])))))


def _turned(vectors: Floats, angle: float | Floats) -> Floats:
    """Vectors, shape (n, 2), turned counter-clockwise by one angle or by one each (rad)."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)


def _ratio(value: float, of: float) -> float | None:
    return value / of if of > 0 else None
