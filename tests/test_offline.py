"""What needs no running flow needs nothing of Linux, nor Zenoh: tried by hiding them, as neither Mac nor Windows is."""

import socket
import subprocess
import sys
from pathlib import Path

import pytest

from caneflow.recording import Recording

# Runs commands one after the other, as on a system without these modules and functions; says each one's status.
HIDING = """
import os, shlex, signal, sys

class Hidden:
    NAMES = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "zenoh"}
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.NAMES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Hidden())
for name in Hidden.NAMES & sys.modules.keys():
    del sys.modules[name]
for name in ("fork", "getuid", "geteuid", "memfd_create", "killpg", "setsid", "mkfifo"):
    delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "pthread_sigmask", "setitimer"):
    delattr(signal, name)

from caneflow.command import main

for line in sys.stdin:
    sys.argv = ["caneflow", *shlex.split(line)]
    try:
        main()
    except SystemExit as end:
        print(end.code or 0, line.strip(), flush=True)
"""


def commands(folder: Path, *lines: str) -> tuple[list[str], str]:
    """Run commands where only what any system has is there: the lines that say how each ended, and all output."""
    done = subprocess.run(
        [sys.executable, "-c", HIDING],
        input="\n".join(lines),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=folder,
        timeout=120,
        check=False,
    )
    return [line for line in done.stdout.splitlines() if line.partition(" ")[2] in lines], done.stdout


def test_recordings_are_made_run_looked_at_and_exported(tmp_path: Path) -> None:
    lines = (
        "simulate walk --duration 2 -o walk.mcap",
        "info walk.mcap",
        "new flow cane",
        "check cane.yaml",
        "graph cane.yaml -o cane.json --format json",
        "run cane.yaml --replay walk.mcap --in-process --record track.mcap",
        "verify cane.yaml track.mcap",
        "eval walk.mcap --flow cane.yaml",
        "plot track.mcap -o track.png",
        "export track.mcap --format tum -o track.tum",
        "recover track.mcap -o again.mcap",
        "schema Imu",
        "--help",
    )
    ended, output = commands(tmp_path, *lines)
    assert ended == [f"0 {line}" for line in lines], output
    with Recording(tmp_path / "track.mcap") as recording:
        assert recording.complete
        assert recording.streams["fusion", "pose"].count == recording.streams["imu", "imu"].count


def test_what_needs_a_running_flow_says_so_in_one_line(tmp_path: Path) -> None:
    words = ("run cane.yaml", "status", "list", "view", "echo", "doctor", "stop", "logs")
    ended, output = commands(tmp_path, "new flow cane", *words)
    assert ended == ["0 new flow cane", *(f"2 {word}" for word in words)], output
    told = [line for line in output.splitlines() if "needs Linux and Zenoh (there is no " in line]
    assert [line.partition(":")[0] for line in told] == [f"caneflow {word.split()[0]}" for word in words], output
    assert "Traceback" not in output


def test_the_page_and_foxglove_can_show_a_recording(tmp_path: Path) -> None:
    """Up to where they would serve it: the port is taken."""
    pytest.importorskip("uvicorn")
    pytest.importorskip("foxglove")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        lines = (
            "simulate walk --duration 1 -o walk.mcap",
            f"view walk.mcap --port {port}",
            f"foxglove walk.mcap --port {port}",
        )
        ended, output = commands(tmp_path, *lines)
    assert [line[0] for line in ended] == ["0", "2", "2"], output
    told = [line for line in output.splitlines() if line.startswith("caneflow ") and str(port) in line]
    assert len(told) == 2, output
