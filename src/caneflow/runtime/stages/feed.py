"""One source with its outputs: what it brings is numbered, and how far it has come is known."""

import logging
from collections.abc import Mapping

from caneflow.messages import MessageError, Sample, decode, numbered
from caneflow.messages.control import PortMark, Progress
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.plan import OutputPlan
from caneflow.runtime.program import Encoded
from caneflow.runtime.stages.merge import BEGIN, END
from caneflow.runtime.stages.streams import Departures

log = logging.getLogger(__name__)


class Feed:
    """A source before its streams."""

    def __init__(self, node: str, outputs: Mapping[str, OutputPlan], *, ordered: bool) -> None:
        self.node = node
        self.outputs = {port: Departures(plan) for port, plan in outputs.items()}
        self.ended = False
        self.unsent = dict.fromkeys(outputs, 0)  # by port the samples that the source brought and that cannot be sent
        self._ordered = ordered  # stamps increase over all ports together
        self._quiet = BEGIN

    def take(self, port: str, sample: Sample | Encoded) -> bytes | None:
        """The bytes to send for what the source brought on `port`; None when it cannot be sent."""
        departures = self.outputs.get(port)
        if departures is None:
            raise DataflowError(f"{self.node}: brought port {port!r}; it has {', '.join(self.outputs) or 'none'}")
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

    def nothing_until(self, stamp: int) -> None:
        """Note that no further sample with a stamp at or before `stamp` (ns) will be brought."""
        if stamp > self._quiet:
            self._quiet = stamp

    def progress(self) -> Progress:
        """How far each stream has come."""
        marks = {
            port: PortMark(out.sent - 1, END if self.ended else max(out.last_stamp, self._quiet))
            for port, out in self.outputs.items()
        }
        return Progress(self.node, min((mark.watermark for mark in marks.values()), default=END), marks)

    def _payload(self, departures: Departures, sample: Sample | Encoded) -> bytes | None:
        """The sample's bytes under its number in this run: a recording may begin in the middle, or have gaps."""
        if sample.stamp <= departures.last_stamp:
            if not self.refused:
                stamps = f"stamp {sample.stamp} after {departures.last_stamp}"
                log.warning("%s: not sent, time goes backwards: %s (counted from now on)", departures.plan.key, stamps)
            return None
        if isinstance(sample, Encoded):
            if sample.seq == departures.sent:
                departures.number_encoded(sample.kind, sample.stamp)
                return sample.payload
            try:
                sample = decode(sample.payload, sample.kind)
            except MessageError as error:
                if not self.refused:
                    log.warning("%s: not sent, a bad sample: %s (counted from now on)", departures.plan.key, error)
                return None
        return numbered(sample, departures.number(sample))
