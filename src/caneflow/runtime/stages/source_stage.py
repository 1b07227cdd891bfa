"""One source with its outputs: what it brings is numbered, and how far it has come is known."""

import logging
from collections.abc import Mapping

import msgspec

from caneflow.messages import MessageError, Sample, decode, numbered
from caneflow.messages.control import PortMark, Progress
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.plan import OutputPlan
from caneflow.runtime.program import Encoded
from caneflow.runtime.stages.merge import BEGIN, END
from caneflow.runtime.stages.references import SnapshotError
from caneflow.runtime.stages.streams import FAR_AHEAD, Departures, lies_ahead
from caneflow.runtime.wording import listed

log = logging.getLogger(__name__)


class FeedState(msgspec.Struct, frozen=True):
    """Where the streams of a source stand."""

    outputs: dict[str, tuple[int, int]]  # by port how many were sent, and the last one's stamp (ns)
    quiet: int  # ns: nothing with a stamp at or before it will be brought


class Feed:
    """A source before its streams."""

    def __init__(self, node: str, outputs: Mapping[str, OutputPlan], *, ordered: bool) -> None:
        self.node = node
        self.outputs = {port: Departures(plan) for port, plan in outputs.items()}
        self.ended = False
        self.unsent = dict.fromkeys(outputs, 0)  # by port the samples that the source brought and that cannot be sent
        self._ordered = ordered  # stamps increase over all ports together
        self._quiet = BEGIN
        self._named: set[str] = set()  # kinds of cause

    def take(self, port: str, sample: Sample | Encoded, now: int | None = None) -> bytes | None:
        """The bytes to send for what the source brought on `port`; None when it cannot be sent.

        `now` (ns) is the host's clock, given by a live host only: no stamp may lie far ahead of it.
        """
        departures = self.outputs.get(port)
        if departures is None:
            raise DataflowError(f"{self.node}: brought port {port!r}; it has {', '.join(self.outputs) or 'none'}")
        if now is not None and sample.stamp - now > FAR_AHEAD:
            self._say_once("ahead", f"{departures.plan.key}: not sent, a sample {lies_ahead(sample.stamp - now)}")
            self.unsent[port] += 1
            return None
        if self._ordered:
            self.nothing_until(sample.stamp - 1)
        payload = self._payload(departures, sample)
        if payload is None:
            self.unsent[port] += 1
        return payload

    @property
    def refused(self) -> int:
        """How many samples the source brought that cannot be sent."""
        return sum(self.unsent.values())

    def nothing_until(self, stamp: int, now: int | None = None) -> None:
        """Note that no further sample with a stamp at or before `stamp` (ns) will be brought; `now` as in `take`."""
        if now is not None and stamp - now > FAR_AHEAD:
            self._say_once("quiet", f"{self.node}: its silence {lies_ahead(stamp - now)}; ignored")
        elif stamp > self._quiet:
            self._quiet = stamp

    def progress(self) -> Progress:
        """How far each stream has come."""
        marks = {
            port: PortMark(out.sent - 1, END if self.ended else max(out.last_stamp, self._quiet))
            for port, out in self.outputs.items()
        }
        return Progress(self.node, min((mark.watermark for mark in marks.values()), default=END), marks)

    def tells_more_than_samples(self) -> bool:
        """Whether a reader cannot see from the samples alone how far the source has come."""
        return self.ended or any(out.last_stamp < self._quiet for out in self.outputs.values())

    def state(self) -> FeedState:
        """Where the streams stand."""
        return FeedState({port: (out.sent, out.last_stamp) for port, out in self.outputs.items()}, self._quiet)

    def resume(self, state: FeedState) -> None:
        """Go on where `state` was taken; raises SnapshotError when it is one of other ports."""
        if self.outputs.keys() != state.outputs.keys():
            raise SnapshotError(f"it has the outputs {listed(state.outputs)}; expected {listed(self.outputs)}")
        for port, (sent, stamp) in state.outputs.items():
            self.outputs[port].sent, self.outputs[port].last_stamp = sent, stamp
        self._quiet = state.quiet

    def _payload(self, departures: Departures, sample: Sample | Encoded) -> bytes | None:
        """The sample's bytes under its number in this run: a recording may begin in the middle, or have gaps."""
        if sample.stamp <= departures.last_stamp:
            stamps = f"stamp {sample.stamp} after {departures.last_stamp}"
            self._say_once("backwards", f"{departures.plan.key}: not sent, time goes backwards: {stamps}")
            return None
        if isinstance(sample, Encoded):
            if sample.seq == departures.sent:
                departures.number_encoded(sample.kind, sample.stamp)
                return sample.payload
            try:
                sample = decode(sample.payload, sample.kind)
            except MessageError as error:
                self._say_once("bad", f"{departures.plan.key}: not sent, a bad sample: {error}")
                return None
        return numbered(sample, departures.number(sample))

    def _say_once(self, kind: str, text: str) -> None:
        if kind not in self._named:
            self._named.add(kind)
            log.warning("%s (counted from now on, not repeated)", text)
