"""The launchers of one flow on several machines: who is there, who leads, and what they tell each other.

Each launcher is a Zenoh router: nodes dial their own machine's launcher, launchers dial each other, and samples go
from peer to router to router to peer. (A router does not relay between its own peers; those have direct links.)
"""

import secrets
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import msgspec
import zenoh

from caneflow.messages import MessageError, control_key, decode, encode
from caneflow.runtime.deployment import Deployment
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.links.certificates import OBSERVER
from caneflow.runtime.outcome import Outcome
from caneflow.runtime.site import Site
from caneflow.runtime.wording import listed

# Shared memory does not lead to another machine.
LINK_SETTINGS = {"transport/shared_memory/enabled": False}


class Ended(msgspec.Struct, frozen=True):
    """`@/end`: the leader's word that the run is over."""

    failures: list[str]
    interrupted: bool


class Failed(msgspec.Struct, frozen=True):
    """`@/failed/<machine>`: a node there failed for good."""

    machine: str
    failures: list[str]


class Joined(msgspec.Struct, frozen=True):
    """A machine is there: read from the key of its liveliness token."""

    machine: str
    run: str  # a launcher's own id
    digest: str  # of the flow that it runs
    records: bool


class Left(msgspec.Struct, frozen=True):
    """A machine is gone, or out of reach."""

    machine: str
    run: str


class Began(msgspec.Struct, frozen=True):
    """`@/start`: the leader's word that every node is ready."""


Word: TypeAlias = Ended | Failed | Joined | Left | Began


@dataclass
class Companions:
    """The machines of a flow, as one of their launchers sees them."""

    site: Site
    digest: str
    records: bool
    run: str = field(default_factory=lambda: secrets.token_hex(4))
    present: dict[str, Joined] = field(default_factory=dict)
    leader_run: str | None = None  # of the leader that this launcher has followed
    over: bool = False  # the leader has said so
    alone_since: float | None = None  # s, monotonic: since when the leader is gone
    _held: list[Any] = field(default_factory=list)

    @classmethod
    def of(cls, deployment: Deployment) -> "Companions | None":
        """Those of a deployment that has several machines."""
        if deployment.site is None:
            return None
        return cls(deployment.site, deployment.digest, deployment.records)

    def join(self, session: zenoh.Session, flow: str, put: Callable[[Word], None]) -> None:
        """Say that this machine is there; what others say is handed to `put`, on Zenoh's thread."""

        def on_token(sample: zenoh.Sample) -> None:
            machine, run, digest, records = str(sample.key_expr).split("/")[-4:]
            if sample.kind == zenoh.SampleKind.PUT:
                put(Joined(machine, run, digest, records == "records"))
            else:
                put(Left(machine, run))

        def on_word(kind: type[Ended] | type[Failed]) -> Callable[[zenoh.Sample], None]:
            def take(sample: zenoh.Sample) -> None:
                try:
                    put(decode(sample.payload.to_bytes(), kind))
                except MessageError:
                    return  # only the launchers' own machines may write here

            return take

        def hear(key: str, callback: Callable[[zenoh.Sample], None]) -> None:
            self._held.append(session.declare_subscriber(key, zenoh.handlers.Callback(callback, indirect=False)))

        if self.site.leads:
            hear(control_key(flow, "failed", "*"), on_word(Failed))
        else:
            hear(control_key(flow, "start"), lambda _: put(Began()))
            hear(control_key(flow, "end"), on_word(Ended))
        tokens = session.liveliness()
        handler = zenoh.handlers.Callback(on_token, indirect=False)
        everybody = control_key(flow, "machine", "*", "*", "*", "*")
        self._held.append(tokens.declare_subscriber(everybody, handler, history=True))
        own = ("machine", self.site.name, self.run, self.digest, "records" if self.records else "listens")
        self._held.append(tokens.declare_token(control_key(flow, *own)))

    def hear(self, word: Ended | Failed | Joined | Left, outcome: Outcome, *, replay: bool) -> str | None:
        """Take what another machine's launcher says, its failures into `outcome`; what there is to say about it."""
        match word:
            case Joined() | Left():
                said = self.take(word)
                if word.machine == self.site.leader:
                    self._take_leader(word, outcome, replay=replay)
                return said
            case Ended(failures, interrupted):
                self.over = True
                outcome.failures += [f"{self.site.leader}: {failure}" for failure in failures]
                outcome.interrupted = outcome.interrupted or interrupted
            case Failed(machine, failures):
                outcome.failures += [f"{machine}: {failure}" for failure in failures]
        return None

    def _take_leader(self, word: Joined | Left, outcome: Outcome, *, replay: bool) -> None:
        leader = self.site.leader
        self.alone_since = None if leader in self.present else time.monotonic()
        if isinstance(word, Joined) and self.leader_run is None:
            self.leader_run = word.run
        elif isinstance(word, Joined) and self.leader_run != word.run:
            self.leader_run = word.run
            if replay:
                outcome.failures.append(f"{leader} has begun another replay; this part belongs to the one before")

    def take(self, word: Joined | Left) -> str | None:
        """Note who came or went; what there is to say about it."""
        if word.machine not in self.site.others:
            return None  # this one's own token
        known = self.present.get(word.machine)
        if isinstance(word, Left):
            if known is None or known.run != word.run:
                return None  # its next launcher was faster
            del self.present[word.machine]
            return f"{word.machine} has left, or is out of reach; going on, it may come back"
        if word.digest != self.digest:
            other = (
                f"{word.machine} runs another flow, recording or version of caneflow; "
                "give the same file and options on every machine"
            )
            if word.machine == self.site.leader and self.leader_run is None:
                raise DataflowError(other)  # nothing is started yet; what runs is not ended by a newcomer
            return other
        self.present[word.machine] = word
        return f"{word.machine} is there" if known is None else None

    @property
    def missing(self) -> list[str]:
        """The machines that are not there."""
        return [machine for machine in self.site.others if machine not in self.present]

    @property
    def recording(self) -> list[str]:
        """The other machines that record."""
        return [joined.machine for joined in self.present.values() if joined.records]

    def waits_for(self, session: zenoh.Session) -> str:
        """Who is missing, and whom a link leads to instead: access control lets nothing of such a one through."""
        reached = {str(link.auth_identifier) for link in session.info.links() if link.auth_identifier}
        strangers = sorted(reached - {*self.site.others, OBSERVER})
        instead = f"; there is a link with {listed(strangers)}, by its certificate" if strangers else ""
        return f"waits for {listed(self.missing)}{instead}"

    def out_of_reach(self, nodes: Iterable[str]) -> tuple[str, ...]:
        """Those of `nodes` whose machine is not there."""
        missing = self.missing
        return tuple(node for node in nodes if self.site.places.get(node) in missing)

    def part(self, session: zenoh.Session, flow: str, outcome: Outcome) -> None:
        """Tell the other machines that it is over, for all or for this one."""
        if self.site.leads:
            self._tell(session, flow, Ended(outcome.failures, outcome.interrupted))
        elif outcome.failures and not self.over:
            self._tell(session, flow, Failed(self.site.name, outcome.failures))

    def _tell(self, session: zenoh.Session, flow: str, word: Ended | Failed) -> None:
        key = control_key(flow, "end") if isinstance(word, Ended) else control_key(flow, "failed", word.machine)
        session.put(key, encode(word), congestion_control=zenoh.CongestionControl.BLOCK)
