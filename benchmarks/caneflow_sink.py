"""caneflow's sink: notes down when each sample came."""

from typing import Any

from benchmarks.work import Job, Notes
from caneflow.messages import Sample
from caneflow.runtime import Context, Sink
from caneflow.runtime.node import run


class HopSink(Sink):
    """Takes samples and the time."""

    def __init__(self, settings: Any, context: Context) -> None:
        self._notes = Notes(Job.told())

    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        """Note it down."""
        self._notes.take(message)

    def idle(self, time: int) -> None:
        """Nothing came."""

    def finish(self) -> None:
        """Nothing is left to do."""


if __name__ == "__main__":
    run(HopSink)
