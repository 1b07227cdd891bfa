"""Runs a deployment as processes: starts them together, follows, restarts and ends them."""

import logging
import queue
import secrets
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import zenoh

from caneflow.messages import MessageError, control_key, decode, encode
from caneflow.messages.control import Counters, Progress, Window
from caneflow.runtime.dataflow.graph import Restart
from caneflow.runtime.deployment import (
    RECORDER_MODULE,
    REPLAYER_MODULE,
    Deployment,
    linked,
    program_arguments,
    with_recorders_on,
)
from caneflow.runtime.hosts.launcher.clocks import Answer, Clocks
from caneflow.runtime.hosts.launcher.congestion import (
    closed_in_time,
    closing_at_once,
    launcher_ids,
    node_id,
    node_ids,
    tool_links,
)
from caneflow.runtime.hosts.launcher.fork_server import ForkServer
from caneflow.runtime.hosts.launcher.machines import (
    LINK_SETTINGS,
    Began,
    Company,
    Ended,
    Failed,
    Joined,
    Left,
    Word,
)
from caneflow.runtime.hosts.launcher.node_statistics import NodeStatistics
from caneflow.runtime.hosts.launcher.private_folder import PrivateFolder
from caneflow.runtime.hosts.launcher.processes import Exited, ForkServerLost, Line, Processes
from caneflow.runtime.hosts.launcher.restarts import Again, How, Restarts
from caneflow.runtime.hosts.launcher.run_directory import RunDirectory, remove_state_folder, state_folder
from caneflow.runtime.hosts.links.access import links_between, open_door
from caneflow.runtime.hosts.links.session import local_links, open_session, protocol
from caneflow.runtime.hosts.process import last_words
from caneflow.runtime.hosts.process.last_words import LastWords
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.stages.merge import BEGIN, END

log = logging.getLogger(__name__)

REPLAY_WINDOW = 5_000_000_000  # ns of event time that the sources of a replay may be ahead of the slowest reader
STOP_PATIENCE = 2.5  # s that nodes have to end, and then as long for the sinks behind them: 5 s in all
LEADER_PATIENCE = 120.0  # s that the part of a replay waits for its leader to come back
WAITING_SAID = 10.0  # s after which a launcher says again whom it waits for
WINDOW_PERIOD = 1.0  # s after which the window of a replay is said again
WAKE_PERIOD = 0.2  # s between two looks at deadlines

CRASHES = (signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGABRT)  # of a program by itself

LAUNCHER = "caneflow"  # the launcher's name in the merged log
RECORDER_RESTART = Restart(  # of a replay: its recording is its result
    policy="never", max_restarts=0, window_s=0.0, delay_s=0.0, max_delay_s=0.0
)
LIVE_RECORDER_RESTART = Restart(  # where the position is worth more than its recording: without end
    policy="always", max_restarts=sys.maxsize, window_s=60.0, delay_s=0.25, max_delay_s=10.0
)
FAILING_SAID = 60.0  # s after which the launcher says again that the flow goes on without its recorder

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
    there: bool = True  # False: not any more


@dataclass(frozen=True)
class StatusAsked:
    """Somebody wants to know how the flow is."""

    query: zenoh.Query


@dataclass(frozen=True)
class Interrupted:
    """Ctrl-C, SIGTERM or SIGHUP."""


@dataclass
class NodeState:
    """What the launcher knows of one node."""

    plan: NodePlan
    policy: Restarts
    spare: bool = False  # a live flow goes on without it: its recorder
    here: bool = True  # False: another machine's launcher starts it
    state: str = "starting"  # starting, ready, waiting (for its restart), failed; away: on a machine out of reach
    pid: int = 0
    started_at: float = 0.0  # s, monotonic
    restart_at: float = 0.0  # s, monotonic
    restarts: int = 0
    handled: int = BEGIN
    counters: Counters | None = None
    last_line: str = ""
    last_words: LastWords | None = None  # of the process that is ending
    shown: set[str] = field(default_factory=set)  # places of errors whose traceback was shown
    failing_since: float | None = None  # s, monotonic: of a spare one that cannot be had now
    say_at: float = 0.0  # s, monotonic: when to say so again

    @property
    def missing(self) -> bool:
        """Whether it is a spare one that could not even be started again."""
        return self.spare and (self.state == "away" or (self.failing_since is not None and self.policy.counted > 1))


@dataclass
class Outcome:
    """How a run ended."""

    failures: list[str] = field(default_factory=list)
    interrupted: bool = False
    counters: dict[str, Counters] = field(default_factory=dict)
    span_s: float = 0.0  # of event time, in a replay
    unrecorded: list[str] = field(default_factory=list)  # why the recording of a live flow is incomplete

    @property
    def status(self) -> int:
        """The command's exit status."""
        return 1 if self.failures else 130 if self.interrupted else 1 if self.unrecorded else 0


class Launcher:
    """One run of a deployment."""

    def __init__(
        self,
        deployment: Deployment,
        restarts: dict[str, Restart],
        report: Report,
        fork_server: ForkServer,
        keys: Path | None = None,
    ) -> None:
        """`keys`: the folder with this machine's certificate, where the flow has several machines."""
        self._run = secrets.token_hex(8)  # nobody can guess the ids of its nodes' sessions
        self._fork_server = fork_server
        self._keys = keys
        self._events: queue.SimpleQueue[object] = queue.SimpleQueue()
        self._restarts = restarts
        self._report = report
        self._deployment = deployment
        self._company = Company.of(deployment)
        self._leads = self._company is None or self._company.site.leads
        site = deployment.site
        self._clocks = None if site is None else Clocks(deployment.flow, site.name, site.others)
        self._over = False  # the leader has said so
        self._alone_since: float | None = None  # s, monotonic: since when the leader is gone
        self._nodes: dict[str, NodeState] = {}
        self._barrier_passed = False
        self._started_s = 0.0  # monotonic
        self._until = BEGIN
        self._say_window_at = 0.0  # s, monotonic
        self._outcome = Outcome()
        self._state_folder: PrivateFolder | None = None
        self._statistics = NodeStatistics()
        self._said_removed = False

    def run(self) -> Outcome:
        """Start everything, follow it to its end, end everything."""
        with (
            RunDirectory(self._deployment.flow) as self._directory,
            local_links(self._deployment.links, self._directory.path) as ports,
            closed_in_time(self._open_session(endpoint := ports.endpoint()), [endpoint]) as self._session,
            self._subscribed(),
            self._directory.announced(endpoint),  # tools may attach from here on
            Processes(self._events, self._fork_server) as self._processes,
            self._signals(),
        ):
            if self._directory.remark:
                self._report(LAUNCHER, f"{self._directory.remark}; this run is in {self._directory.path}")
            if self._gather():
                self._take_nodes(linked(self._deployment, ports, endpoint))
                for node in self._nodes.values():
                    if node.here:
                        self._start(node)
                self._follow()
            self._part()
            self._stop()
            self._let_others_leave()
        self._conclude()
        return self._outcome

    # --- the other machines -----------------------------------------------------------------------------------

    def _open_session(self, endpoint: str) -> zenoh.Session:
        deployment, site = self._deployment, self._deployment.site
        here = filter(deployment.runs_here, deployment.plans)
        own = [each for node in here for each in node_ids(self._run, node)]
        if site is None:
            door, secured = open_door(deployment, self._keys)
            more = tool_links(deployment.flow, map(protocol, (endpoint, *door)), own, replay=deployment.replay)
            return open_session(listen=[endpoint, *door], replay=deployment.replay, more={**secured, **more})
        site, secured = links_between(deployment, site, self._keys)
        own += [each for machine in site.others for each in launcher_ids(deployment.flow, machine)]
        strangers = map(protocol, (endpoint, *site.listen))
        router = protocol(site.connect[-1]) if site.router else ""
        more = tool_links(deployment.flow, strangers, own, replay=deployment.replay, router=router)
        return open_session(
            mode="router",
            listen=[endpoint, *site.listen],
            connect=site.connect,
            replay=deployment.replay,
            identity=secrets.choice(launcher_ids(deployment.flow, site.name)),
            more={**LINK_SETTINGS, **secured, **more},
        )

    def _gather(self) -> bool:
        """Wait until every machine of the flow is there; False when the run ends before."""
        company = self._company
        if company is None:
            return True
        company.join(self._session, self._deployment.flow, self._events.put)
        if self._clocks is not None:
            self._clocks.open(self._session, self._events.put)
        self._report(LAUNCHER, f"{company.site.leader} leads; {company.waits_for(self._session)}")
        later = []
        say_again = time.monotonic() + WAITING_SAID
        while company.missing and not self._is_over():
            if time.monotonic() > say_again:
                say_again += WAITING_SAID
                self._report(LAUNCHER, f"still {company.waits_for(self._session)}")
            for event in self._next_events():
                if isinstance(event, Ready | Said | Began):
                    later.append(event)
                else:
                    self._take(event)
        for event in later:
            self._events.put(event)
        self._deployment = with_recorders_on(self._deployment, company.recording)
        return not self._is_over()

    def _take_nodes(self, deployment: Deployment) -> None:
        """Know the nodes that start here; the leader those of all machines."""
        self._state_folder = None
        if self._company and self._company.leader_run:
            # The next launcher on this machine may go on where this one was killed, if the same leader still runs.
            self._state_folder = state_folder(deployment.flow, self._company.site.name, self._company.leader_run)
        self._nodes = {
            name: self._node(plan, here=deployment.runs_here(name))
            for name, plan in deployment.plans.items()
            if self._leads or deployment.runs_here(name)
        }

    def _node(self, plan: NodePlan, *, here: bool) -> NodeState:
        replay = self._deployment.replay
        recorder = RECORDER_RESTART if replay else LIVE_RECORDER_RESTART
        policy = Restarts(self._restarts.get(plan.node, recorder), replay=replay)
        return NodeState(plan, policy, spare=plan.module == RECORDER_MODULE and not replay, here=here)

    def _take_word(self, company: Company, word: Word) -> None:
        """Take what another machine's launcher says."""
        match word:
            case Joined() | Left():
                said = company.take(word)
                if said is not None:
                    self._report(LAUNCHER, said)
                if word.machine == company.site.leader:
                    self._take_leader(company, word)
            case Began():
                self._pass_barrier()
            case Ended(failures, interrupted):
                self._over = True
                self._outcome.failures += [f"{company.site.leader}: {failure}" for failure in failures]
                self._outcome.interrupted = self._outcome.interrupted or interrupted
            case Failed(machine, failures):
                self._outcome.failures += [f"{machine}: {failure}" for failure in failures]

    def _take_leader(self, company: Company, word: Joined | Left) -> None:
        leader = company.site.leader
        self._alone_since = None if leader in company.present else time.monotonic()
        if isinstance(word, Joined) and company.leader_run is None:
            company.leader_run = word.run
        elif isinstance(word, Joined) and company.leader_run != word.run:
            company.leader_run = word.run
            if self._deployment.replay:
                self._outcome.failures.append(f"{leader} has begun another replay; this part belongs to the one before")

    def _part(self) -> None:
        """Tell the other machines that it is over, for all or for this one."""
        if self._company is None:
            return
        outcome, site = self._outcome, self._company.site
        if self._leads:
            word: Ended | Failed = Ended(outcome.failures, outcome.interrupted)
            self._company.tell(self._session, self._deployment.flow, word)
        elif outcome.failures and not self._over:
            self._company.tell(self._session, self._deployment.flow, Failed(site.name, outcome.failures))

    def _let_others_leave(self) -> None:
        """The leader's session is how the others hear the end: close it after them."""
        if self._company is None:
            return
        deadline = time.monotonic() + 2 * STOP_PATIENCE
        while self._leads and self._company.present and time.monotonic() < deadline:
            for event in self._next_events():
                if isinstance(event, Left):
                    self._company.take(event)
        if self._state_folder is not None and not self._outcome.failures:
            remove_state_folder(self._state_folder)

    # --- what comes -------------------------------------------------------------------------------------------

    @contextmanager
    def _subscribed(self) -> Iterator[None]:
        """Hear the nodes, and answer whoever asks, before anybody can know of this run."""
        flow = self._deployment.flow
        held: list[object] = [
            closing_at_once(self._session),
            self._session.declare_subscriber(control_key(flow, "counters", "*"), self._hearing(Counters)),
            self._session.liveliness().declare_subscriber(
                control_key(flow, "ready", "*"),
                zenoh.handlers.Callback(self._on_token, indirect=False),
                history=True,
            ),
            self._session.declare_queryable(
                control_key(flow, "status"),
                zenoh.handlers.Callback(self._on_status_asked, indirect=False),
            ),
        ]
        if self._leads and self._deployment.replay:  # live, that a node has ended stands in its counters
            key = control_key(flow, "progress", "*")
            held.append(self._session.declare_subscriber(key, self._hearing(Progress)))
        yield
        held.clear()  # they end with the session

    def _hearing(self, kind: type[Progress] | type[Counters]) -> "zenoh.handlers.Callback[zenoh.Sample]":
        def put(sample: zenoh.Sample) -> None:
            self._events.put(Said(kind, sample.payload.to_bytes()))

        return zenoh.handlers.Callback(put, indirect=False)

    def _on_token(self, sample: zenoh.Sample) -> None:
        there = sample.kind == zenoh.SampleKind.PUT
        self._events.put(Ready(str(sample.key_expr).rpartition("/")[2], there))

    def _on_status_asked(self, query: zenoh.Query) -> None:
        self._events.put(StatusAsked(query))

    def _follow(self) -> None:
        """Take events until the run has ended, well or badly."""
        while not (self._is_over() or self._all_ended()):
            for event in self._next_events():
                self._take(event)
            self._look_at_folder()
            self._look_at_deadlines()
            self._open_window()
            if self._clocks is not None:
                self._clocks.look()
            self._statistics.look(self._nodes.values())

    def _next_events(self) -> Iterator[object]:
        now = time.monotonic()
        restarts = [node.restart_at - now for node in self._nodes.values() if node.state == "waiting"]
        with suppress(queue.Empty):
            yield self._events.get(timeout=max(0.0, min([WAKE_PERIOD, *restarts])))
            while not self._events.empty():
                yield self._events.get_nowait()

    def _take(self, event: object) -> None:
        match event:
            case Line(node, text):
                self._take_line(self._nodes[node], text)
            case Ready(node, there) if node in self._nodes:
                self._take_ready(self._nodes[node], there=there)
            case Exited():
                self._processes.forget(event)
                self._take_exit(self._nodes[event.node], event)
            case Interrupted():
                self._outcome.interrupted = True
            case ForkServerLost():
                self._outcome.failures.append("the process that nodes are started from was killed, and they with it")
            case Said():
                self._take_said(event)
            case Joined() | Left() | Began() | Ended() | Failed() if self._company is not None:
                self._take_word(self._company, event)
            case Answer() if self._clocks is not None:
                if (said := self._clocks.take(event)) is not None:
                    self._report(LAUNCHER, said)
            case StatusAsked(query):
                here = {name: node for name, node in self._nodes.items() if node.here}
                deployment = self._deployment
                machine = deployment.site.name if deployment.site else ""
                status = self._statistics.status(deployment.flow, machine, here, replay=deployment.replay)
                with query:
                    query.reply(query.key_expr, encode(status))

    def _take_line(self, node: NodeState, text: str) -> None:
        words = last_words.heard(text)
        text = text if words is None else text.partition(last_words.MARK)[0]  # that of a line without an end
        if words is None or text:
            node.last_line = text or node.last_line
            self._report(node.plan.node, text)
        if words is None:
            return
        node.last_words, node.last_line = words, words.error
        if words.place not in node.shown:
            node.shown.add(words.place)
            for line in words.lines:
                self._report(node.plan.node, line)

    def _take_said(self, said: Said) -> None:
        try:
            message = decode(said.payload, said.kind)
        except MessageError as error:
            self._report(LAUNCHER, f"a {said.kind.__name__} refused: {error}")
            return
        if isinstance(message, Counters):
            self._statistics.note(message)
        node = self._nodes.get(message.node)
        if node is None:
            return
        if isinstance(message, Counters) and node.here:
            for line in self._statistics.grown_old(message):
                self._report(message.node, line)
        if isinstance(message, Progress):
            # A restarted reader begins anew: what it had handled before stands.
            node.handled = max(node.handled, message.handled)
        else:
            node.counters = message
            if message.ended:
                node.handled = END

    def _take_ready(self, node: NodeState, *, there: bool) -> None:
        if not there:
            if not node.here:
                node.state = "away"
            return  # the end of a process of this machine is told by the process
        node.state = "ready"
        now = time.monotonic()
        node.policy.ready(now)
        if node.failing_since is not None:
            self._report(node.plan.node, f"is there again, after {now - node.failing_since:.1f} s")
            node.failing_since = None
        self._pass_barrier_if_all_are_ready()
        if self._barrier_passed:
            self._say_start()

    def _pass_barrier_if_all_are_ready(self) -> None:
        """Nobody waits for a spare node that is on another machine, or has failed."""
        if self._leads and all(
            node.state == "ready" or (node.spare and (not node.here or node.failing_since is not None))
            for node in self._nodes.values()
        ):
            self._pass_barrier()

    def _pass_barrier(self) -> None:
        if not self._barrier_passed:
            self._barrier_passed = True
            self._started_s = time.monotonic()

    def _take_exit(self, node: NodeState, exited: Exited) -> None:
        if exited.pid != node.pid:
            return
        words, status = node.last_words, exited.status
        reached = f"up to stamp {node.handled}"
        cause = f"ended with killed by {_signal_name(-status)}" if status < 0 else f"ended with status {status}"
        if words is not None:
            how = How.LASTING if words.lasting else How.FAULT
            self._restart_or_fail(node, cause, how, words.at)
        elif -status in CRASHES or status >= 0:
            self._restart_or_fail(node, cause, How.FAULT, reached)
        else:
            self._restart_or_fail(node, cause, How.STOPPED, reached)

    def _restart_or_fail(self, node: NodeState, cause: str, how: How, at: object) -> None:
        name, now = node.plan.node, time.monotonic()
        if node.spare and self._barrier_passed and how is How.LASTING:
            how = How.FAULT  # it has worked before
        verdict = node.policy.ended(now, at, how)
        if node.spare and isinstance(verdict, Again):
            self._go_on_without(node, cause, verdict.delay_s)
            return
        if not isinstance(verdict, Again):
            node.state = "failed"
            tried = f" after {node.restarts} restarts" if node.restarts else ""
            parts = (f"{name} {cause}{tried}", verdict.why, node.last_line)
            self._outcome.failures.append(": ".join(filter(None, parts)))
            return
        node.restarts += 1
        node.state = "waiting"
        node.restart_at = now + verdict.delay_s
        again = f"restart {node.policy.counted} of {node.policy.allowed} in {verdict.delay_s:g} s"
        said = f": {node.last_words.error}" if node.last_words else ""
        self._report(name, f"{cause}{said}; {again}")

    def _go_on_without(self, node: NodeState, cause: str, delay_s: float) -> None:
        """Have a spare node started again some time; say that it is missing, and say it again now and then."""
        now = time.monotonic()
        if node.failing_since is None:
            node.failing_since = node.say_at = now
        node.restarts += 1
        node.state = "waiting"
        node.restart_at = now + delay_s
        node.last_line = node.last_words.error if node.last_words else cause
        if now >= node.say_at:
            node.say_at = now + FAILING_SAID
            said = f": {node.last_words.error}" if node.last_words else ""
            self._report(node.plan.node, f"{cause}{said}; THE FLOW GOES ON WITHOUT ITS RECORDING and tries again")
        if not self._barrier_passed:
            self._pass_barrier_if_all_are_ready()
            if self._barrier_passed:
                self._say_start()

    # --- what goes out ----------------------------------------------------------------------------------------

    def _start(self, node: NodeState) -> None:
        folder = self._directory.path
        state = self._state_folder.path if self._state_folder else folder
        plan = msgspec.structs.replace(node.plan, state_folder=str(state))
        if self._barrier_passed and plan.module == REPLAYER_MODULE:
            settings = {**plan.settings, "started_s": self._started_s}
            plan = msgspec.structs.replace(plan, settings=settings)
        # What a spare reader misses at the start it asks for: nobody waits for it, as it may never come.
        absent = tuple(name for name, other in self._nodes.items() if other.spare)
        if self._company is not None:
            plan = msgspec.structs.replace(plan, absent=self._company.out_of_reach(plan.readers))
        plan = msgspec.structs.replace(plan, absent=(*plan.absent, *absent), takes_over=node.restarts > 0)
        if node.restarts and plan.module == RECORDER_MODULE:
            plan = msgspec.structs.replace(plan, settings={**plan.settings, "goes_on": True})
        identity = node_id(self._run, plan.node, node.restarts)
        plan = msgspec.structs.replace(plan, links=msgspec.structs.replace(plan.links, identity=identity))
        if self._deployment.links == "unix" and not self._directory.is_there:
            cause = f"cannot be started: the run's folder {folder}, where its links would be, was removed"
            self._restart_or_fail(node, cause, How.LASTING, None)
            return
        node.state, node.last_words = "starting", None
        node.started_at = time.monotonic()
        try:
            arguments, called = program_arguments(plan), folder / f"{plan.node}.json"
            node.pid = self._processes.start(plan.node, arguments, plan.encoded(), called)
        except OSError as error:
            self._restart_or_fail(node, f"cannot be started: {error.strerror}", How.STOPPED, None)

    def _look_at_folder(self) -> None:
        """Say once that the folder of the run was removed, as cleaners do: links that are there go on."""
        if not (self._said_removed or self._directory.is_there):
            self._said_removed = True
            lost = (
                "tools cannot attach any more, and a node that ends cannot start again"
                if self._deployment.links == "unix"
                else "tools cannot find it by its name any more"
            )
            self._report(LAUNCHER, f"{self._directory.path} was removed: the flow goes on, but {lost}")

    def _look_at_deadlines(self) -> None:
        now = time.monotonic()
        if self._deployment.replay and self._alone_since and now - self._alone_since > LEADER_PATIENCE:
            self._outcome.failures.append(f"the leading machine has not come back for {LEADER_PATIENCE:g} s")
        for node in self._nodes.values():
            if not node.here:
                continue
            if node.state == "waiting" and now >= node.restart_at:
                self._start(node)
            elif node.state == "starting" and now - node.started_at > node.plan.ready_timeout_s:
                self._processes.kill(node.plan.node)
                pid, node.pid = node.pid, 0  # its exit is told here
                cause = f"not ready after {node.plan.ready_timeout_s:g} s (pid {pid} killed)"
                self._restart_or_fail(node, cause, How.STOPPED, None)

    def _open_window(self) -> None:
        """Let the sources of a replay go on: as far as the slowest reader, and a window beyond."""
        if not (self._leads and self._barrier_passed and self._deployment.replay):
            return
        slowest = min((node.handled for node in self._nodes.values() if node.plan.inputs), default=END)
        if slowest >= END - 1:
            return  # nobody needs a window any more, and sessions may be closing
        until = max(slowest, self._deployment.origin) + REPLAY_WINDOW
        if until >= self._until + REPLAY_WINDOW // 16:
            self._until = until
        elif time.monotonic() < self._say_window_at:
            return
        self._say_window_at = time.monotonic() + WINDOW_PERIOD  # the last word may have met a broken link
        self._tell("window", encode(Window(self._until)))

    def _say_start(self) -> None:
        self._tell("start", b"")
        if self._until > BEGIN:
            self._tell("window", encode(Window(self._until)))

    def _tell(self, what: str, payload: bytes) -> None:
        key = control_key(self._deployment.flow, what)
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def _is_over(self) -> bool:
        return bool(self._outcome.failures or self._outcome.interrupted or self._over)

    def _all_ended(self) -> bool:
        return self._leads and all(node.handled == END or node.missing for node in self._nodes.values())

    def _stop(self) -> None:
        """End the sources, then the operators, then the sinks: each still takes what was on its way.

        Else a recorder may hear a sample that an operator, which ended sooner, has neither handled nor left out.
        """
        sources = [name for name, node in self._nodes.items() if not node.plan.inputs]
        sinks = [name for name, node in self._nodes.items() if node.plan.inputs and not node.plan.outputs]
        operators = [name for name in self._nodes if name not in (*sources, *sinks)]
        killed = self._processes.end(sources, operators, patience=STOP_PATIENCE)
        killed += self._processes.end(sinks, patience=STOP_PATIENCE - 0.5)
        for name in killed:
            self._report(name, f"did not end within {STOP_PATIENCE:g} s; killed")
            if self._nodes[name].spare:
                self._outcome.unrecorded.append(f"{name}: the recording is incomplete: it was killed at the end")
        while not self._events.empty():
            match self._events.get_nowait():
                case Line(node, text):
                    self._take_line(self._nodes[node], text)
                case Said() as said:
                    self._take_said(said)

    def _conclude(self) -> None:
        nodes = self._nodes.items()
        for name, node in nodes:
            if node.spare and node.here and (node.failing_since is not None or node.last_words is not None):
                self._outcome.unrecorded.append(f"{name}: the recording is incomplete: {node.last_line}")
        self._outcome.counters = {name: node.counters for name, node in nodes if node.counters is not None}
        if self._deployment.replay and not self._outcome.interrupted:
            failures, self._outcome.failures = self._outcome.failures, []
            note_losses(self._outcome)
            self._outcome.failures += failures  # last, as it is the cause

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """Turn Ctrl-C, SIGTERM and SIGHUP (which nohup has ignored) into an event: everything ends in order."""
        numbers = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            numbers.append(signal.SIGHUP)
        before = {number: signal.getsignal(number) for number in numbers}
        for number in before:
            signal.signal(number, lambda *_: self._events.put(Interrupted()))
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # of the real-time signals only two have names
        return f"signal {number}"


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
