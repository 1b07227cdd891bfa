"""Sessions of Zenoh: which of their threads take what comes, and what Python keeps for them."""

import threading
from collections.abc import Iterator

import pytest
import zenoh

from caneflow.runtime.hosts.links import KnownThreads, Ports, open_session
from tests.flows import wait_for

SAMPLES = 5


@pytest.fixture
def sessions() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    ports = Ports()
    endpoint = ports.endpoint()
    with open_session(listen=[endpoint]) as writer, open_session(connect=[endpoint]) as reader:
        yield writer, reader
    ports.release()


@pytest.mark.parametrize("known", [False, True])
def test_a_known_thread_keeps_what_python_holds_for_it(
    sessions: tuple[zenoh.Session, zenoh.Session], known: bool
) -> None:
    """What is local to a thread is the part of its state that can be seen from Python."""
    writer, reader = sessions
    threads, local = KnownThreads(), threading.local()
    counted: dict[int, list[int]] = {}  # by thread

    def take(sample: zenoh.Sample) -> None:
        if known:
            threads.know_this_one()
        local.count = getattr(local, "count", 0) + 1
        counted.setdefault(threading.get_native_id(), []).append(local.count)

    held = reader.declare_subscriber("test", zenoh.handlers.Callback(take, indirect=False))
    publisher = writer.declare_publisher("test", express=True)
    wait_for(lambda: publisher.matching_status.matching, "the subscription to arrive")  # type: ignore[attr-defined]  # the stub says bool
    for number in range(SAMPLES):
        publisher.put(b"")
        wait_for(lambda: sum(map(len, counted.values())) > number, f"sample {number}")  # noqa: B023 - called at once
    del held
    assert threading.get_native_id() not in counted
    for counts in counted.values():
        assert counts == (list(range(1, len(counts) + 1)) if known else [1] * len(counts))
    assert not known or max(map(len, counted.values())) > 1
