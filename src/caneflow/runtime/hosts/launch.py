"""Runs a deployment as processes: starts them together, follows, restarts and ends them."""

import logging
import queue
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import msgspec
import zenoh

from caneflow.messages import MessageError, control_key, decode, encode
from caneflow.messages.control import Counters, Progress, Window
from caneflow.runtime.dataflow.graph import Restart
from caneflow.runtime.deployment import REPLAYER_MODULE, Deployment, linked, program_arguments
from caneflow.runtime.hosts.links import Ports, open_session
from caneflow.runtime.hosts.processes import Exited, Line, Processes
from caneflow.runtime.hosts.run_directory import RunDirectory
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.stages.merge import BEGIN, END

log = logging.getLogger(__name__)

REPLAY_WINDOW = 5_000_000_000  # ns of event time that the sources of a replay may be ahead of the slowest reader
STOP_PATIENCE = 2.5  # s that nodes have to end, and then as long for the sinks behind them: 5 s in all
WAKE_PERIOD = 0.2  # s between two looks at deadlines

LAUNCHER = "caneflow"  # the launcher's name in the merged log
RECORDER_RESTART = Restart(
    policy="never", max_restarts=0, window_s=0.0, delay_s=0.0, max_delay_s=0.0
)  # would overwrite

Report = Callable[[str, str], None]  # (node, line)


@dataclass(frozen=True)
class Said:
    """A control message, not yet looked at."""

    kind: type[Progress] | type[Counters]
    payload: bytes


@dataclass(frozen=True)
class Ready:
    """A node hears and is heard."""

    node: str


@dataclass(frozen=True)
class Interrupted:
    """Ctrl-C or SIGTERM."""


@dataclass
class NodeState:
    """What the launcher knows of one node."""

    plan: NodePlan
    restart: Restart
    state: str = "starting"  # starting, ready, waiting (for its restart), failed
    pid: int = 0
    started_at: float = 0.0  # s, monotonic
    restart_at: float = 0.0  # s, monotonic
    restarts: int = 0
    restarted: list[float] = field(default_factory=list)  # s, monotonic: the restarts within the policy's window
    handled: int = BEGIN
    counters: Counters | None = None
    last_line: str = ""


@dataclass
class Outcome:
    """How a run ended."""

    failures: list[str] = field(default_factory=list)
    interrupted: bool = False
    counters: dict[str, Counters] = field(default_factory=dict)
    span_s: float = 0.0  # of event time, in a replay

    @property
    def status(self) -> int:
        """The command's exit status."""
        return 1 if self.failures else 130 if self.interrupted else 0


class Launcher:
    """One run of a deployment."""

    def __init__(self, deployment: Deployment, restarts: dict[str, Restart], report: Report) -> None:
        self._events: queue.SimpleQueue[object] = queue.SimpleQueue()
        self._restarts = restarts
        self._report = report
        self._deployment = deployment
        self._nodes: dict[str, NodeState] = {}
        self._barrier_passed = False
        self._started_s = 0.0  # monotonic
        self._until = BEGIN
        self._outcome = Outcome()

    def run(self) -> Outcome:
        """Start everything, follow it to its end, end everything."""
        ports = Ports()
        try:
            endpoint = ports.endpoint()
            deployment = linked(self._deployment, ports, endpoint)
            self._nodes = {
                name: NodeState(plan, self._restarts.get(name, RECORDER_RESTART))
                for name, plan in deployment.plans.items()
            }
            with (
                open_session(listen=[endpoint], replay=deployment.replay) as self._session,
                RunDirectory(deployment.flow, endpoint) as self._directory,  # tools may attach from here on
                Processes(self._events, self._directory.path) as self._processes,
                self._signals(),
            ):
                self._subscribe()
                for node in self._nodes.values():
                    self._start(node)
                self._follow()
                self._stop()
        finally:
            ports.release()
        self._conclude()
        return self._outcome

    # --- what comes -------------------------------------------------------------------------------------------

    def _subscribe(self) -> None:
        flow = self._deployment.flow
        self._held = [
            self._session.declare_subscriber(control_key(flow, "progress", "*"), self._hearing(Progress)),
            self._session.declare_subscriber(control_key(flow, "counters", "*"), self._hearing(Counters)),
            self._session.liveliness().declare_subscriber(
                control_key(flow, "ready", "*"),
                zenoh.handlers.Callback(self._on_token, indirect=False),
                history=True,
            ),
        ]

    def _hearing(self, kind: type[Progress] | type[Counters]) -> "zenoh.handlers.Callback[zenoh.Sample]":
        def put(sample: zenoh.Sample) -> None:
            self._events.put(Said(kind, sample.payload.to_bytes()))

        return zenoh.handlers.Callback(put, indirect=False)

    def _on_token(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._events.put(Ready(str(sample.key_expr).rpartition("/")[2]))

    def _follow(self) -> None:
        """Take events until the run has ended, well or badly."""
        while not (self._outcome.failures or self._outcome.interrupted or self._all_ended()):
            for event in self._next_events():
                self._take(event)
            self._look_at_deadlines()
            self._open_window()

    def _next_events(self) -> Iterator[object]:
        with suppress(queue.Empty):
            yield self._events.get(timeout=WAKE_PERIOD)
            while not self._events.empty():
                yield self._events.get_nowait()

    def _take(self, event: object) -> None:
        match event:
            case Line(node, text):
                self._nodes[node].last_line = text or self._nodes[node].last_line
                self._report(node, text)
            case Ready(node):
                self._take_ready(self._nodes[node])
            case Exited():
                self._processes.forget(event)
                self._take_exit(self._nodes[event.node], event)
            case Interrupted():
                self._outcome.interrupted = True
            case Said():
                self._take_said(event)

    def _take_said(self, said: Said) -> None:
        try:
            message = decode(said.payload, said.kind)
        except MessageError as error:
            self._report(LAUNCHER, f"a {said.kind.__name__} refused: {error}")
            return
        node = self._nodes.get(message.node)
        if node is None:
            return
        if isinstance(message, Progress):
            # A restarted reader begins anew: what it had handled before stands.
            node.handled = max(node.handled, message.handled)
        else:
            node.counters = message

    def _take_ready(self, node: NodeState) -> None:
        node.state = "ready"
        if not self._barrier_passed and all(other.state == "ready" for other in self._nodes.values()):
            self._barrier_passed = True
            self._started_s = time.monotonic()
        if self._barrier_passed:
            self._say_start()

    def _take_exit(self, node: NodeState, exited: Exited) -> None:
        if exited.pid != node.pid:
            return
        cause = f"killed by {signal.Signals(-exited.status).name}" if exited.status < 0 else f"status {exited.status}"
        self._restart_or_fail(node, f"ended with {cause}")

    def _restart_or_fail(self, node: NodeState, cause: str) -> None:
        name, policy = node.plan.node, node.restart
        now = time.monotonic()
        node.restarted = [moment for moment in node.restarted if now - moment < policy.window_s]
        if policy.policy == "never" or len(node.restarted) >= policy.max_restarts:
            node.state = "failed"
            tried = f" after {node.restarts} restarts" if node.restarts else ""
            said = f": {node.last_line}" if node.last_line else ""
            self._outcome.failures.append(f"{name} {cause}{tried}{said}")
            return
        delay = min(policy.delay_s * 2 ** len(node.restarted), policy.max_delay_s)
        node.restarts += 1
        node.restarted.append(now)
        node.state = "waiting"
        node.restart_at = now + delay
        self._report(name, f"{cause}; restart {len(node.restarted)} of {policy.max_restarts} in {delay:g} s")

    # --- what goes out ----------------------------------------------------------------------------------------

    def _start(self, node: NodeState) -> None:
        path = self._directory.path / f"{node.plan.node}.json"
        plan = node.plan
        if self._barrier_passed and plan.module == REPLAYER_MODULE:
            settings = {**plan.settings, "started_s": self._started_s}
            plan = msgspec.structs.replace(plan, settings=settings)
        plan.write(path)
        node.state = "starting"
        node.started_at = time.monotonic()
        node.pid = self._processes.start(node.plan.node, program_arguments(node.plan), path)

    def _look_at_deadlines(self) -> None:
        now = time.monotonic()
        for node in self._nodes.values():
            if node.state == "waiting" and now >= node.restart_at:
                self._start(node)
            elif node.state == "starting" and now - node.started_at > node.plan.ready_timeout_s:
                self._processes.kill(node.plan.node)
                pid, node.pid = node.pid, 0  # its exit is told here
                self._restart_or_fail(node, f"not ready after {node.plan.ready_timeout_s:g} s (pid {pid} killed)")

    def _open_window(self) -> None:
        """Let the sources of a replay go on: as far as the slowest reader, and a window beyond."""
        if not (self._barrier_passed and self._deployment.replay):
            return
        slowest = min((node.handled for node in self._nodes.values() if node.plan.inputs), default=END)
        if slowest >= END - 1:
            return  # nobody needs a window any more, and sessions may be closing
        until = max(slowest, self._deployment.origin) + REPLAY_WINDOW
        if until >= self._until + REPLAY_WINDOW // 16:
            self._until = until
            self._tell("window", encode(Window(until)))

    def _say_start(self) -> None:
        self._tell("start", b"")
        if self._until > BEGIN:
            self._tell("window", encode(Window(self._until)))

    def _tell(self, what: str, payload: bytes) -> None:
        key = control_key(self._deployment.flow, what)
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def _all_ended(self) -> bool:
        return all(node.handled == END for node in self._nodes.values())

    def _stop(self) -> None:
        """End sources and operators, then the sinks, which take what was still on its way."""
        sinks = [name for name, node in self._nodes.items() if node.plan.inputs and not node.plan.outputs]
        others = [name for name in self._nodes if name not in sinks]
        killed = self._processes.end(others, STOP_PATIENCE) + self._processes.end(sinks, STOP_PATIENCE - 0.5)
        for name in killed:
            self._report(name, f"did not end within {STOP_PATIENCE:g} s; killed")
        while not self._events.empty():
            match self._events.get_nowait():
                case Line(node, text):
                    self._report(node, text)
                case Said() as said:
                    self._take_said(said)

    def _conclude(self) -> None:
        nodes = self._nodes.items()
        self._outcome.counters = {name: node.counters for name, node in nodes if node.counters is not None}
        if self._deployment.replay and not self._outcome.interrupted:
            note_losses(self._outcome)

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """Turn Ctrl-C and SIGTERM into an event: everything ends in order."""
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        for number in before:
            signal.signal(number, lambda *_: self._events.put(Interrupted()))
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def note_losses(outcome: Outcome) -> None:
    """In a replay every loss is a failure: the result would not be the recording's."""
    for name, counters in outcome.counters.items():
        for port, counts in counters.inputs.items():
            for what in ("lost", "late", "dropped"):
                if number := getattr(counts, what):
                    outcome.failures.append(f"{name}.{port}: {number} samples {what}; the result is incomplete")
