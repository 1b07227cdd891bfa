"""Nodes are forked: what they are to themselves and to others is what an interpreter of their own would be."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from tests.flows import CANEFLOW, NODES, node_processes, spread_cane, wait_for, write_walk

# Starts a program from a fork server; prints its pid, all that it wrote, and how it ended.
START = """
import json, os, sys
from caneflow.runtime.hosts.process import last_words
from caneflow.runtime.hosts.launcher.fork_server import ForkServer
fork_server = ForkServer()
reading, writing = os.pipe()
fork_server.start(sys.argv[1:], writing)
os.close(writing)
started = fork_server.hear()
wrote = ""
for line in os.fdopen(reading):  # as the launcher shows them
    words = last_words.heard(line)
    wrote += line if words is None else "\\n".join(words.lines) + "\\n"
ended = fork_server.hear()
fork_server.close()
print(json.dumps([started.pid, wrote, ended.pid, ended.status]))
"""
WITH_A_PLAN = """
plan = os.memfd_create("plan")
os.write(plan, b"what is to be done")
fork_server.start(sys.argv[1:], writing, plan)
"""
SAY = """
import atexit, json, os, sys, threading
atexit.register(lambda: print("bye"))
print(json.dumps({
    "argv": sys.argv, "name": __name__, "path": sys.path[0], "stdin": sys.stdin.read(),
    "leads": os.getsid(0) == os.getpid() == os.getpgid(0), "threads": threading.active_count(),
    "descriptors": sorted(int(each) for each in os.listdir("/proc/self/fd"))[:-1],
}))
"""


@pytest.fixture
def started(tmp_path: Path) -> Callable[..., tuple[str, int]]:
    def start(program: str, *arguments: str) -> tuple[str, int]:
        """What the text of a program wrote, and its status."""
        file = tmp_path / "program.py"
        file.write_text(program)
        done = subprocess.run(
            [sys.executable, "-c", START, str(file), *arguments], check=True, capture_output=True, text=True, timeout=60
        )
        pid, wrote, ended, status = json.loads(done.stdout)
        assert pid == ended
        return wrote, status

    return start


def test_a_program_finds_itself_as_if_it_had_been_called(
    tmp_path: Path, started: Callable[..., tuple[str, int]]
) -> None:
    wrote, status = started(SAY, "plan.json")
    said, bye = wrote.splitlines()
    assert (status, bye) == (0, "bye")
    assert json.loads(said) == {
        "argv": [str(tmp_path / "program.py"), "plan.json"],
        "name": "__main__",
        "path": str(tmp_path),
        "stdin": "",
        "leads": True,
        "threads": 1,
        "descriptors": [0, 1, 2],
    }


def test_a_program_finds_its_plan_without_a_folder(tmp_path: Path) -> None:
    file = tmp_path / "program.py"
    file.write_text("import sys\nfrom pathlib import Path\nprint(sys.argv[1], Path(sys.argv[1]).read_text())")
    with_a_plan = START.replace("fork_server.start(sys.argv[1:], writing)", WITH_A_PLAN)
    command = [sys.executable, "-c", with_a_plan, str(file), str(tmp_path / "nowhere" / "node.json")]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60)
    assert json.loads(done.stdout)[1] == "/proc/self/fd/3 what is to be done\n"


@pytest.mark.parametrize(
    ("program", "last_line", "status"),
    [
        ("import sys; sys.exit(7)", "", 7),
        ("import sys; sys.exit('no such device')", "no such device", 1),
        ("import sys; sys.exit()", "", 0),
        ("1 / 0", "ZeroDivisionError: division by zero", 1),
        ("import os, signal; os.kill(os.getpid(), signal.SIGTERM)", "", -signal.SIGTERM),
        ("import os, signal; os.kill(os.getpid(), signal.SIGINT)", "KeyboardInterrupt", 1),
        ("import os; os._exit(9)", "", 9),
    ],
)
def test_how_a_program_ends(started: Callable[..., tuple[str, int]], program: str, last_line: str, status: int) -> None:
    wrote, ended = started(program)
    assert (wrote.splitlines() or [""])[-1] == last_line
    assert ended == status


def test_what_a_node_started_ends_with_it(started: Callable[..., tuple[str, int]]) -> None:
    wrote, status = started(
        "import subprocess, sys\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(1000)'], stdout=subprocess.DEVNULL,\n"
        "                         stderr=subprocess.DEVNULL)\n"
        "print(child.pid)"
    )
    assert status == 0
    wait_for(lambda: not psutil.pid_exists(int(wrote)), "the end of the node's own child")


def test_a_killed_fork_server_ends_the_run_in_one_line(tmp_path: Path) -> None:
    flow = "n" + str(time.time_ns())
    file = tmp_path / "flow.yaml"
    file.write_text(spread_cane(flow, "  here: {}\n", dict.fromkeys(NODES, "here")))
    walk = write_walk(tmp_path / "walk.mcap")
    running = subprocess.Popen(
        [*CANEFLOW, "run", str(file), "--replay", str(walk), "--loop"], stderr=subprocess.PIPE, text=True
    )
    wait_for(lambda: len(node_processes(running.pid)) == 4, "all nodes")
    nodes = node_processes(running.pid)
    fork_server = nodes["fusion"].parent()
    assert fork_server is not None
    fork_server.kill()
    _, said = running.communicate(timeout=60)
    assert running.returncode == 1
    assert "Traceback" not in said
    assert said.splitlines()[-1] == (
        "caneflow run: the process that nodes are started from was killed, and they with it"
    )
    psutil.wait_procs(nodes.values(), timeout=10)
    assert not node_processes(running.pid)
