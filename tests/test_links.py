"""Sessions of Zenoh: what Python keeps for the threads that bring what comes."""

import subprocess
import sys

import pytest

# In a process of its own: a thread that is known once stays known.
COUNTS = """
import sys, threading, time, zenoh
from caneflow.runtime.hosts.links import KnownThreads, Ports, open_session

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
