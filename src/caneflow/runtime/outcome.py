"""How a run ended, on any host."""

from dataclasses import dataclass, field

from caneflow.messages.control import Counters


@dataclass
class Outcome:
    """How a run ended."""

    failures: list[str] = field(default_factory=list)
    interrupted: bool = False
    counters: dict[str, Counters] = field(default_factory=dict)
    span_s: float = 0.0  # of event time, in a replay
    unrecorded: list[str] = field(default_factory=list)  # why the recording of a live flow is incomplete

    @property
    def lost(self) -> tuple[str, ...]:
        """A line for each node with what did not arrive, could not be used or was not recorded."""
        told = (f"{node}: {'; '.join(troubles(counters))}" for node, counters in self.counters.items())
        return (*(line for line in told if not line.endswith(": ")), *self.unrecorded)

    @property
    def status(self) -> int:
        """The command's exit status."""
        return 1 if self.failures else 130 if self.interrupted else 1 if self.unrecorded else 0


def troubles(counters: Counters) -> list[str]:
    """What a node counted that should not have been, port by port."""
    found = [
        f"{port}: {number} {what}"
        for port, counts in counters.inputs.items()
        for what in ("refused", "repeated", "lost", "dropped", "late")
        if (number := getattr(counts, what))
    ]
    return [*found, f"{counters.refused} refused"] if counters.refused else found


def note_losses(outcome: Outcome) -> None:
    """In a replay every loss is a failure: the result would not be the recording's."""
    for name, counters in outcome.counters.items():
        for port, counts in counters.inputs.items():
            for what in ("lost", "late", "dropped"):
                if number := getattr(counts, what):
                    outcome.failures.append(f"{name}.{port}: {number} samples {what}; the result is incomplete")
            if 2 * counts.refused > counts.received:
                refused = f"{counts.refused} of {counts.received} samples refused"
                outcome.failures.append(f"{name}.{port}: {refused}; more than half of the recording is lost")
        for port, number in counters.unsent.items():
            if number > counters.outputs.get(port, 0):
                outcome.failures.append(f"{name}/{port}: {number} samples not sent; more than half is lost")
