"""Sessions of Zenoh: what Python keeps for the threads that bring what comes."""

import subprocess
import sys

import pytest

# In a process of its own: a thread that is known once stays known.
COUNTS = """
import sys, threading, zenoh
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
    while not counts:  # until the subscription has arrived
        writer.put("test", b"")
        came.acquire(timeout=0.05)
    begin = len(counts)
    for _ in range(3):
        writer.put("test", b"")
        assert came.acquire(timeout=30)
    print(counts[-1] - counts[begin - 1])
    held.undeclare()
"""


@pytest.mark.parametrize(("thread", "more"), [("known", 3), ("unknown", 0)])
def test_a_known_thread_keeps_what_python_holds_for_it(thread: str, more: int) -> None:
    """What is local to a thread, a count here, is the part of its state that can be seen from Python."""
    command = [sys.executable, "-c", COUNTS, thread]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == (f"{more}\n", "")
