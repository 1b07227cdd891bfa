"""Sessions of Zenoh: what Python keeps for the threads that bring what comes; endpoints within a machine."""

import subprocess
import sys
from pathlib import Path

import pytest

from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.links.session import Sockets, open_session

# In a process of its own: a thread that is known once stays known.
COUNTS = """
import sys, threading, time, zenoh
from caneflow.runtime.hosts.links.session import KnownThreads, Ports, open_session

endpoint = Ports().endpoint()
threads, local, counts, came = KnownThreads(), threading.local(), [], threading.Semaphore(0)

def take(sample):
    if sys.argv[1] == "known":
        threads.know_this_one()
    local.count = getattr(local, "count", 0) + 1
    counts.append(local.count)
    came.release()

with open_session(listen=[endpoint]) as writer, open_session(connect=[endpoint]) as reader:
    held = reader.declare_subscriber("test", zenoh.handlers.Callback(take, indirect=False))
    publisher = writer.declare_publisher("test")
    while not publisher.matching_status.matching:
        time.sleep(0.01)
    for _ in range(3):
        publisher.put(b"")
        assert came.acquire(timeout=30)
    print(counts)
    held.undeclare()
"""


@pytest.mark.parametrize(("thread", "counts"), [("known", [1, 2, 3]), ("unknown", [1, 1, 1])])
def test_a_known_thread_keeps_what_python_holds_for_it(thread: str, counts: list[int]) -> None:
    """What is local to a thread, a count here, is the part of its state that can be seen from Python."""
    command = [sys.executable, "-c", COUNTS, thread]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == (f"{counts}\n", "")


def test_sockets_are_numbered_in_the_folder_of_the_run() -> None:
    sockets = Sockets(Path("/run/cane-1"))
    assert [sockets.endpoint() for _ in range(3)] == [f"unixsock-stream//run/cane-1/{number}" for number in range(3)]


def test_a_path_that_is_too_long_for_a_socket_is_refused_with_what_to_do(tmp_path: Path) -> None:
    folder = tmp_path / ("x" * (94 - len(str(tmp_path)) - 1))
    Sockets(folder)
    with pytest.raises(DataflowError, match=r"too long .*100 bytes.*at most 99\); set XDG_RUNTIME_DIR .* `links: tcp`"):
        Sockets(folder.with_name(folder.name + "x"))


@pytest.mark.parametrize("name", ["a?b", "a#b", "a\nb", "a\udce4b"])
def test_a_name_that_zenoh_would_misread_is_refused(name: str) -> None:
    with pytest.raises(DataflowError, match="set XDG_RUNTIME_DIR to another folder") as refused:
        Sockets(Path("/run") / name)
    assert str(refused.value).isprintable()


def test_a_folder_that_is_full_of_letters_beyond_ascii_is_measured_in_bytes() -> None:
    with pytest.raises(DataflowError, match="too long"):
        Sockets(Path("/run") / ("\N{SNOWMAN}" * 32))


def test_a_socket_that_was_left_by_a_killed_process_is_taken_over(tmp_path: Path) -> None:
    endpoint = Sockets(tmp_path).endpoint()
    opening = "from caneflow.runtime.hosts.links.session import open_session"
    listen = f"{opening}; s = open_session(listen=[{endpoint!r}]); print()"
    with subprocess.Popen([sys.executable, "-c", f"{listen}; input()"], stdin=-1, stdout=-1) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.kill()
    assert {path.name for path in tmp_path.iterdir()} == {"0", "0.lock"}
    with open_session(listen=[endpoint]), open_session(mode="client", connect=[endpoint]):
        pass
