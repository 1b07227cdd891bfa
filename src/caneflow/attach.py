"""The samples of a running flow in a program of one's own, decoded.

from caneflow.attach import attached

with attached("cane") as flow:
    for stream, sample in flow.samples("fusion/pose"):
        print(stream, sample.position)
"""

import queue
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

from caneflow.messages import SAMPLES, MessageError, Sample, decode, stream_of
from caneflow.messages.control import FlowStatus
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.attached.attach import ANY, Attached, Heard
from caneflow.runtime.hosts.attached.attach import attached as joined
from caneflow.runtime.site import DEFAULT_KEYS

__all__ = ["Flow", "attached"]

MOST_WAITING = 10_000  # samples; a flow does not wait for a program that listens, so the oldest are dropped beyond


class Flow:
    """A running flow, heard by this program. `refused`: samples that came and could not be decoded."""

    def __init__(self, here: Attached) -> None:
        self._here = here
        self.name = here.flow
        self.refused = 0
        self.dropped = 0  # samples for which there was no room: this program was too slow for them

    def status(self) -> FlowStatus:
        """What the flow's launchers know of its nodes; raises DataflowError when none answers."""
        return self._here.status()

    def samples(self, *streams: str, timeout: float | None = None) -> Generator[tuple[str, Sample], None, None]:
        """(stream, sample) as they come, of `streams` such as "fusion/pose" (none: of all); live, so never the past.

        Ends when nothing has come for `timeout` s; None: never. Of a program that is too slow the oldest samples are
        dropped and counted, the flow goes on. Raises DataflowError for a name that is not a stream's.
        """
        wanted = [_stream(each) for each in streams] or [(ANY, ANY)]
        waiting: queue.Queue[Heard] = queue.Queue()
        with self._here.samples(wanted, waiting.put):
            while True:
                try:
                    heard = waiting.get(timeout=timeout)
                except queue.Empty:
                    return
                while waiting.qsize() > MOST_WAITING:
                    heard = waiting.get()
                    self.dropped += 1
                sample = self._decoded(heard)
                if sample is not None:
                    yield "/".join(stream_of(heard.key)), sample

    def _decoded(self, heard: Heard) -> Sample | None:
        try:
            kind = SAMPLES.get(heard.schema)
            if kind is not None:
                return decode(heard.payload, kind)
        except MessageError:
            pass
        self.refused += 1
        return None


@contextmanager
def attached(flow: str | None = None, endpoint: str | None = None, keys: str | Path = DEFAULT_KEYS) -> Iterator[Flow]:
    """Join the running flow of the name `flow` (None: the only one), on this machine or at `endpoint`.

    To an endpoint `tls/...` it goes as an observer, by its certificate in the folder `keys`.

    Raises DataflowError when there is none, or when there are several to choose from.
    """
    with joined(flow, endpoint, Path(keys)) as here:
        yield Flow(here)


def _stream(name: str) -> tuple[str, str]:
    node, slash, port = name.partition("/")
    if not (node and slash and port):
        raise DataflowError(f"{name!r} names no stream; one is NODE/PORT, such as fusion/pose")
    return node, port
