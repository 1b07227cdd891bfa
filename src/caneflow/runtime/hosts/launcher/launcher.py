"""Runs a deployment as processes: starts them together, follows, restarts and ends them."""

import queue
import secrets
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import zenoh

from caneflow.messages import control_key, encode
from caneflow.messages.control import Window
from caneflow.runtime.dataflow.graph import Restart
from caneflow.runtime.deployment import Deployment, with_recorders_on
from caneflow.runtime.hosts.launcher.asked_restarts import AskedRestarts
from caneflow.runtime.hosts.launcher.clocks import Answer, Clocks
from caneflow.runtime.hosts.launcher.companions import Began, Companions, Ended, Failed, Joined, Left
from caneflow.runtime.hosts.launcher.congestion import closed_in_time
from caneflow.runtime.hosts.launcher.ends import Ends
from caneflow.runtime.hosts.launcher.fork_server import ForkServer
from caneflow.runtime.hosts.launcher.hearing import Ready, Said, StatusAsked, answer_status, hearing
from caneflow.runtime.hosts.launcher.launcher_session import open_launcher_session, reached_at
from caneflow.runtime.hosts.launcher.linking import linked
from caneflow.runtime.hosts.launcher.node_state import NodeState
from caneflow.runtime.hosts.launcher.nodes import LAUNCHER, Nodes
from caneflow.runtime.hosts.launcher.private_folder import PrivateFolder
from caneflow.runtime.hosts.launcher.processes import Exited, ForkServerLost, Line, Processes
from caneflow.runtime.hosts.launcher.replay_progress import ReplayProgress
from caneflow.runtime.hosts.launcher.replay_window import ReplayWindow
from caneflow.runtime.hosts.launcher.requests import RestartAsked, requests
from caneflow.runtime.hosts.launcher.restarts import How
from caneflow.runtime.hosts.launcher.run_directory import RunDirectory, remove_state_folder, state_folder
from caneflow.runtime.hosts.launcher.run_log import RunLog
from caneflow.runtime.hosts.launcher.starting import plan_to_start, program_arguments
from caneflow.runtime.hosts.launcher.stop_signals import Interrupted, stop_signals
from caneflow.runtime.hosts.launcher.stopping import STOP_PATIENCE, Stopping
from caneflow.runtime.hosts.launcher.watcher import Watcher
from caneflow.runtime.hosts.links.access import opened
from caneflow.runtime.hosts.links.session import local_links
from caneflow.runtime.outcome import Outcome, note_losses
from caneflow.runtime.stages.merge import BEGIN

LEADER_PATIENCE = 120.0  # s that the part of a replay waits for its leader to come back
WAITING_SAID = 10.0  # s after which a launcher says again whom it waits for
PAGE = "the page"  # no node can be called so
WAKE_PERIOD = 0.2  # s between two looks at deadlines


class Launcher:
    """One run of a deployment."""

    def __init__(
        self,
        deployment: Deployment,
        restarts: dict[str, Restart],
        watcher: Watcher,
        fork_server: ForkServer,
        keys: Path | None = None,
        *,
        view: bool = False,
    ) -> None:
        """`keys`: the folder with this machine's certificate, where it has one. `view`: open the page at the start."""
        self._run = secrets.token_hex(8)  # nobody can guess the ids of its nodes' sessions
        self._fork_server = fork_server
        self._keys = keys
        self._view = view
        self._events: queue.SimpleQueue[object] = queue.SimpleQueue()
        self._restarts = restarts
        self._watcher = watcher
        self._deployment = deployment
        self._companions = Companions.of(deployment)
        self._leads = self._companions is None or self._companions.site.leads
        site = deployment.site
        self._clocks = None if site is None else Clocks(deployment.flow, site.name, site.others)
        self._nodes = Nodes(self._say)
        self._started_s: float | None = None  # monotonic; None: not every node was ready yet
        self._window = ReplayWindow(deployment.origin)
        self._progress = ReplayProgress(deployment.origin, deployment.last, watcher.played)
        self._outcome = Outcome()
        self._ends = Ends(self._say, self._outcome)
        self._state_folder: PrivateFolder | None = None
        self._said_removed = False
        self._endpoint = ""  # where it listens for its nodes

    def run(self) -> Outcome:
        """Start everything, follow it to its end, end everything."""
        self._deployment, settings = opened(self._deployment, self._keys)
        deployment, replay = self._deployment, self._deployment.replay
        with (
            RunDirectory(deployment.flow) as self._directory,
            local_links(deployment.links, self._directory.path) as ports,
            closed_in_time(
                open_launcher_session(deployment, self._run, endpoint := ports.endpoint(), settings), [endpoint]
            ) as self._session,
            RunLog(self._directory.root, deployment.flow, replay=replay) as self._log,
            hearing(self._session, deployment.flow, self._events.put, progress=self._leads and replay),
            self._directory.announced(endpoint, deployment.streams),  # tools may attach from here on
            requests(self._directory.folder, self._events.put),
            Processes(self._events, self._fork_server) as self._processes,
            stop_signals(self._events.put),
        ):
            self._endpoint = endpoint
            self._asked = AskedRestarts(self._nodes, self._processes, self._start, self._say)
            if self._directory.remark:
                self._say(LAUNCHER, f"{self._directory.remark}; this run is in {self._directory.path}")
            site = deployment.site or deployment.door
            if site is not None and (site.listen or site.router):
                self._say(LAUNCHER, reached_at(site, alone=deployment.site is None))
            if self._gather():
                self._take_nodes(linked(self._deployment, ports, endpoint))
                for node in self._nodes.heads:
                    self._start(node)
                self._follow()
            if self._companions is not None:
                self._companions.part(self._session, deployment.flow, self._outcome)
            stopping = Stopping(self._nodes, self._processes, self._events, self._say)
            stopping.stop(self._outcome, begun=self._started_s is not None)
            self._let_others_leave()
            self._conclude()
        return self._outcome

    def _gather(self) -> bool:
        """Wait until every machine of the flow is there; False when the run ends before."""
        companions = self._companions
        if companions is None:
            return True
        companions.join(self._session, self._deployment.flow, self._events.put)
        self._watcher.settled()
        if self._clocks is not None:
            self._clocks.open(self._session, self._events.put)
        self._say(LAUNCHER, f"{companions.site.leader} leads; {companions.waits_for(self._session)}")
        later = []
        say_again = time.monotonic() + WAITING_SAID
        while companions.missing and not self._is_over():
            if time.monotonic() > say_again:
                say_again += WAITING_SAID
                self._say(LAUNCHER, f"still {companions.waits_for(self._session)}")
            for event in self._next_events():
                if isinstance(event, Ready | Said | Began):
                    later.append(event)
                else:
                    self._take(event)
        for event in later:
            self._events.put(event)
        self._deployment = with_recorders_on(self._deployment, companions.recording)
        return not self._is_over()

    def _take_nodes(self, deployment: Deployment) -> None:
        """Know the nodes that start here; the leader those of all machines."""
        self._state_folder = None
        if self._companions and self._companions.leader_run:
            # The next launcher on this machine may go on where this one was killed, if the same leader still runs.
            machine = self._companions.site.name
            self._state_folder = state_folder(deployment.flow, machine, self._companions.leader_run)
        self._nodes.take(deployment, self._restarts, leads=self._leads)

    def _let_others_leave(self) -> None:
        """The leader's session is how the others hear the end: close it after them."""
        if self._companions is None:
            return
        deadline = time.monotonic() + 2 * STOP_PATIENCE
        while self._leads and self._companions.present and time.monotonic() < deadline:
            for event in self._next_events():
                if isinstance(event, Left):
                    self._companions.take(event)
        if self._state_folder is not None and not self._outcome.failures:
            remove_state_folder(self._state_folder)

    def _follow(self) -> None:
        """Take events until the run has ended, well or badly."""
        while not (self._is_over() or self._all_ended()):
            for event in self._next_events():
                self._take(event)
            self._look_at_folder()
            self._look_at_deadlines()
            self._asked.look()
            self._nodes.follow_heads()
            self._open_window()
            if self._clocks is not None:
                self._clocks.look()
            self._nodes.look()

    def _next_events(self) -> Iterator[object]:
        now = time.monotonic()
        restarts = [node.restart_at - now for node in self._nodes if node.state == "waiting"]
        with suppress(queue.Empty):
            yield self._events.get(timeout=max(0.0, min([WAKE_PERIOD, *restarts])))
            while not self._events.empty():
                yield self._events.get_nowait()

    def _take(self, event: object) -> None:
        match event:
            case Line(node, text):
                self._nodes.take_line(node, text)
            case Ready(node, there) if node in self._nodes:
                self._nodes.take_ready(node, there=there)
                if there and self._started_s is not None:
                    self._say_start()
                self._begin_if_all_are_ready()
            case Exited(node) if node not in self._nodes:
                self._processes.forget(event)
            case Exited():
                self._processes.forget(event)
                if not self._asked.ended(event):
                    self._ends.exited(self._nodes[event.node], event, begun=self._started_s is not None)
                self._begin_if_all_are_ready()
            case RestartAsked():
                self._asked.take(event)
            case Interrupted():
                self._outcome.interrupted = True
            case ForkServerLost():
                self._outcome.failures.append("the process that nodes are started from was killed, and they with it")
            case Said():
                self._nodes.take_said(event)
            case Began():
                self._begin()
            case Joined() | Left() | Ended() | Failed() if self._companions is not None:
                said = self._companions.hear(event, self._outcome, replay=self._deployment.replay)
                if said is not None:
                    self._say(LAUNCHER, said)
            case Answer() if self._clocks is not None:
                if (said := self._clocks.take(event)) is not None:
                    self._say(LAUNCHER, said)
            case StatusAsked(query):
                answer_status(query, self._nodes.status(self._deployment, self._endpoint))

    def _begin_if_all_are_ready(self) -> None:
        if self._started_s is None and self._leads and self._nodes.all_ready:
            self._begin()
            self._say_start()

    def _begin(self) -> None:
        if self._started_s is None:
            self._started_s = time.monotonic()
            self._say(LAUNCHER, f"ready: {len(self._nodes.here)} nodes; to look: caneflow view {self._deployment.flow}")
            self._watcher.settled()
            if self._view:
                words = ("view", self._deployment.flow, "--at", self._endpoint, "--open")
                self._processes.start_program(PAGE, ("-m", "caneflow.words", *words))

    def _start(self, node: NodeState) -> None:
        folder = self._directory.path
        if self._deployment.links == "unix" and not self._directory.is_there:
            cause = f"cannot be started: the run's folder {folder}, where its links would be, was removed"
            self._end(node, cause, How.LASTING)
            return
        members = self._nodes.members(node)
        readers = [reader for each in members for reader in each.plan.readers]
        plan = plan_to_start(
            members,
            run=self._run,
            state=self._state_folder.path if self._state_folder else folder,
            spares=self._nodes.spares,
            out_of_reach=self._companions.out_of_reach(readers) if self._companions else (),
            started_s=self._started_s,
        )
        node.last_words = None
        for each in members:
            each.state, each.started_at = "starting", time.monotonic()
        try:
            arguments, called = program_arguments(plan), folder / f"{plan.name}.json"
            encoded = plan.encoded() if len(members) > 1 else plan.nodes[0].encoded()
            node.pid = self._processes.start(node.plan.node, arguments, encoded, called)
        except OSError as error:
            self._end(node, f"cannot be started: {error.strerror}", How.STOPPED)

    def _end(self, node: NodeState, cause: str, how: How) -> None:
        self._ends.ended(node, cause, how, None, begun=self._started_s is not None)
        self._begin_if_all_are_ready()

    def _look_at_folder(self) -> None:
        """Say once that the folder of the run was removed, as cleaners do: links that are there go on."""
        if not (self._said_removed or self._directory.is_there):
            self._said_removed = True
            self._say(LAUNCHER, self._directory.without_it(self._deployment.links), "warning")

    def _look_at_deadlines(self) -> None:
        now = time.monotonic()
        alone_since = self._companions.alone_since if self._companions else None
        if self._deployment.replay and alone_since and now - alone_since > LEADER_PATIENCE:
            self._outcome.failures.append(f"the leading machine has not come back for {LEADER_PATIENCE:g} s")
        for node in self._nodes.heads:
            starting = [each for each in self._nodes.members(node) if each.state == "starting"]
            if node.state == "waiting" and now >= node.restart_at:
                self._start(node)
            elif any(now - each.started_at > each.plan.ready_timeout_s for each in starting):
                self._processes.kill(node.plan.node)
                pid, node.pid = node.pid, 0  # its exit is told here
                self._end(node, f"not ready after {node.plan.ready_timeout_s:g} s (pid {pid} killed)", How.STOPPED)

    def _open_window(self) -> None:
        """Let the sources of a replay go on: as far as the slowest reader, and a window beyond."""
        if not (self._leads and self._started_s is not None and self._deployment.replay):
            return
        if self._window.to_be_said(self._nodes.handled, time.monotonic()):
            self._tell("window", encode(Window(self._window.until)))
        self._progress.look(self._nodes.handled)

    def _say_start(self) -> None:
        self._tell("start", b"")
        if self._window.until > BEGIN:
            self._tell("window", encode(Window(self._window.until)))

    def _tell(self, what: str, payload: bytes) -> None:
        key = control_key(self._deployment.flow, what)
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def _say(self, node: str, line: str, level: str = "") -> None:
        self._log.take(node, line, level)
        self._watcher.line(node, line)

    def _is_over(self) -> bool:
        over = self._companions is not None and self._companions.over
        return bool(self._outcome.failures or self._outcome.interrupted or over)

    def _all_ended(self) -> bool:
        return self._leads and self._nodes.all_ended

    def _conclude(self) -> None:
        self._outcome.unrecorded += self._nodes.unrecorded
        self._outcome.counters = self._nodes.counters
        if self._deployment.replay and not self._outcome.interrupted:
            failures, self._outcome.failures = self._outcome.failures, []
            note_losses(self._outcome)
            self._outcome.failures += failures  # last, as it is the cause
        for failure in self._outcome.failures:
            self._log.take(LAUNCHER, failure, "error")
        self._log.end(self._outcome.status, self._outcome.lost)
