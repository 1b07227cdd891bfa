"""Recordings of Acconeer's own tools: HDF5 files with one or several sessions of an A121."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caneflow.errors import not_installed
from caneflow.protocols import a121
from caneflow.protocols.errors import ProtocolError
from caneflow.recording.errors import RecordingError

TICKS_PER_SECOND = 1_000_000  # where the file does not say: a module on Acconeer's XC120


@dataclass(frozen=True, kw_only=True, eq=False)
class A121Session:
    """One session of one sensor."""

    frames: NDArray[Any]  # (frames, sweeps, points) int16 `real` and `imag`; points of all subsweeps
    ticks: NDArray[np.int64]  # (frames,) of the device's clock
    ticks_per_second: float
    saturated: NDArray[np.bool_]  # (frames,)
    delayed: NDArray[np.bool_]
    uncalibrated: NDArray[np.bool_]
    base_step: float  # m
    sweep_rate: float  # Hz
    continuous: bool  # sweeps without a gap from frame to frame
    subsweeps: tuple[Mapping[str, Any], ...]


def session_names(path: Path) -> list[str]:
    """The sessions of a file, in order; raises RecordingError for what is no such file."""
    with _opened(path) as file:
        return _sessions(path, file)


def read_session(path: Path, number: int) -> A121Session:
    """Session `number`, from 0; raises RecordingError for a file or a session that cannot be read."""
    with _opened(path) as file:
        names = _sessions(path, file)
        if not 0 <= number < len(names):
            raise RecordingError(f"{path}: no session {number}; it has {len(names)}, from 0")
        try:
            return _session(file, file["sessions"][names[number]])
        except (KeyError, IndexError, TypeError, ValueError, OSError, ProtocolError) as error:
            raise RecordingError(f"{path}, session {number}: not as an A121 records: {error}") from error


def _opened(path: Path) -> Any:
    try:
        import h5py
    except ImportError as error:
        raise RecordingError(not_installed("h5py", "a121")) from error
    try:
        return h5py.File(path, "r")
    except OSError as error:
        reason = "no such file" if not path.exists() else "not an HDF5 file"
        raise RecordingError(f"{path}: {reason}") from error


def _sessions(path: Path, file: Any) -> list[str]:
    if "sessions" not in file or not len(file["sessions"]):
        raise RecordingError(f"{path}: no sessions in it; expected a recording of an A121")
    return sorted(file["sessions"], key=lambda name: int(str(name).rpartition("_")[2]))


def _session(file: Any, session: Any) -> A121Session:
    entry = session["group_0"]["entry_0"]
    result = entry["result"]
    frames = result["frame"][()]
    if frames.ndim != 3 or not frames.size or not {"real", "imag"} <= set(frames.dtype.names or ()):
        raise ValueError(
            f"frames of shape {frames.shape} and type {frames.dtype}; expected (n, sweeps, points) of I, Q"
        )
    metadata = json.loads(entry["metadata"][()])
    config = next(iter(json.loads(session["session_config"][()])["groups"][0].values()))
    problem = a121.setup_problem(config)
    if problem:
        raise ValueError(problem)
    rate = config.get("sweep_rate") or metadata["max_sweep_rate"]
    flags = {
        name: np.asarray(result[name][()], bool) if name in result else np.zeros(len(frames), bool)
        for name in ("data_saturated", "frame_delayed", "calibration_needed")
    }
    return A121Session(
        frames=frames,
        ticks=np.asarray(result["tick"][()], np.int64),
        ticks_per_second=_ticks_per_second(file),
        saturated=flags["data_saturated"],
        delayed=flags["frame_delayed"],
        uncalibrated=flags["calibration_needed"],
        base_step=float(metadata["base_step_length_m"]),
        sweep_rate=float(rate),
        continuous=bool(config.get("continuous_sweep_mode")),
        subsweeps=tuple(config["subsweeps"]),
    )


def _ticks_per_second(file: Any) -> float:
    try:
        found = json.loads(file["server_info"][()]).get("ticks_per_second")
    except (KeyError, ValueError):
        found = None
    return float(found or TICKS_PER_SECOND)
