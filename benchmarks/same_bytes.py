"""Whether two checkouts compute the same bytes from the same recordings: what a move of the code must leave as it was.

    python -m benchmarks.same_bytes BEFORE RECORDING...

BEFORE is another checkout with an environment of its own in .venv (`git worktree add`). Every recording goes through
the cane's or the room's graph in both, in one process, by every method of its kind; every sample that is computed is
compared. The last line says how many; the status is 1 when any differs.
"""

import hashlib
import subprocess
import sys
import tempfile
from pathlib import Path

from caneflow.recording import Recording

HERE = Path(__file__).parents[1]
CANE = ("best", "kalman", "luenberger", "luenberger_fixed", "shs", "naive_ins")
ROOM = ("best", "particle", "heading_particle", "ekf")


def runs(recording: Path) -> list[tuple[str, str]]:
    """The graph and the setting of each run of a recording, by the sensors in it."""
    with Recording(recording) as opened:
        streams = set(opened.streams)
    if ("radar", "frame") in streams:
        return [("dataflow.yaml", f"fusion.method={method}") for method in CANE]
    if ("south", "block") in streams:
        return [("dataflows/room.yaml", f"room_tracker.method={method}") for method in ROOM]
    return []


def computed(tree: Path, flow: str, setting: str, recording: Path, folder: Path) -> tuple[int, str]:
    """How many samples this checkout computes, and the digest of their streams, stamps and bytes."""
    out = folder / "computed.mcap"
    program: list[str | Path] = [tree / ".venv/bin/caneflow", "run", tree / flow, "--in-process", "--overwrite"]
    command = [*program, "--replay", recording, "--set", setting, "--record", out]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{tree}: {flow} {setting} on {recording.name}: {done.stderr.strip()}")
    count, digest = 0, hashlib.sha256()
    with Recording(out) as opened:
        for sample in opened.samples():
            count += 1
            digest.update(
                f"{sample.node}/{sample.port} {sample.stamp} {len(sample.payload)} ".encode() + sample.payload
            )
    return count, digest.hexdigest()


def main(before: Path, recordings: list[Path]) -> int:
    """Compare; the exit status."""
    samples, differ = 0, 0
    with tempfile.TemporaryDirectory() as folder:
        for recording in recordings:
            for flow, setting in runs(recording):
                old, new = (computed(tree, flow, setting, recording, Path(folder)) for tree in (before, HERE))
                samples += new[0]
                differ += old != new
                print(
                    f"{recording.name:32} {setting:32} {'equal' if old == new else f'DIFFERS: {old} {new}'}", flush=True
                )
    print(f"{samples} samples; {'equal in every byte' if not differ else f'{differ} runs differ'}")
    return 1 if differ or not samples else 0


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(str(__doc__))
    sys.exit(main(Path(sys.argv[1]).resolve(), [Path(name).resolve() for name in sys.argv[2:]]))
