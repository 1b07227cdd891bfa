"""The nodes of a run as their launcher follows them: what they say, whether all are ready, whether all have ended."""

import time
from collections.abc import Iterator, Mapping

from caneflow.messages import MessageError, decode
from caneflow.messages.control import Counters, FlowStatus, Progress
from caneflow.runtime.dataflow.graph import Restart
from caneflow.runtime.deployment import RECORDER_MODULE, Deployment
from caneflow.runtime.hosts.launcher.ends import LIVE_RECORDER_RESTART, RECORDER_RESTART
from caneflow.runtime.hosts.launcher.hearing import Said
from caneflow.runtime.hosts.launcher.node_state import NodeState
from caneflow.runtime.hosts.launcher.node_statistics import NodeStatistics
from caneflow.runtime.hosts.launcher.restarts import Restarts
from caneflow.runtime.hosts.launcher.watcher import Say
from caneflow.runtime.hosts.process.speaker import spoken
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.stages.merge import END

LAUNCHER = "caneflow"  # the launcher's name in the merged log


class Nodes:
    """Those that start here; at the leader those of all machines."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self._nodes: dict[str, NodeState] = {}
        self._processes: dict[str, list[NodeState]] = {}  # of those here, by the first node of each
        self._statistics = NodeStatistics()

    def take(self, deployment: Deployment, restarts: Mapping[str, Restart], *, leads: bool) -> None:
        """Know the nodes of `deployment`, each with its restart policy."""
        plans = deployment.plans.values()
        recording = {plan.runs_in for plan in plans if plan.module == RECORDER_MODULE and deployment.replay}
        for name, plan in deployment.plans.items():
            here = deployment.runs_here(name)
            if leads or here:
                records = plan.runs_in in recording
                restart = RECORDER_RESTART if records else restarts.get(name, LIVE_RECORDER_RESTART)
                policy = Restarts(restart, replay=deployment.replay)
                alone = sum(other.runs_in == plan.runs_in for other in plans) == 1
                spare = plan.module == RECORDER_MODULE and not deployment.replay and alone
                state = "external" if plan.external else "starting"
                self._nodes[name] = NodeState(plan, policy, spare=spare, records=records, here=here, state=state)
        first: dict[str, str] = {}
        for node in self.here:
            self._processes.setdefault(first.setdefault(node.plan.runs_in, node.plan.node), []).append(node)

    def __getitem__(self, name: str) -> NodeState:
        return self._nodes[name]

    def __contains__(self, name: object) -> bool:
        return name in self._nodes

    def __iter__(self) -> Iterator[NodeState]:
        return iter(self._nodes.values())

    @property
    def here(self) -> list[NodeState]:
        """Those that this launcher starts."""
        return [node for node in self if node.here and not node.plan.external]

    @property
    def heads(self) -> list[NodeState]:
        """The first node of each process that this launcher starts: what is known of the process is noted there."""
        return [members[0] for members in self._processes.values()]

    def head_of(self, name: str) -> NodeState:
        """The first node of the process that runs the node `name`."""
        return next((members[0] for members in self._processes.values() if self[name] in members), self[name])

    def members(self, head: NodeState) -> list[NodeState]:
        """All nodes of the process whose first one is `head`."""
        return self._processes[head.plan.node]

    def follow_heads(self) -> None:
        """Note with each node what has become of its process."""
        for head, *others in self._processes.values():
            for node in others:
                node.pid, node.restarts, node.asked = head.pid, head.restarts, head.asked
                if head.state in ("ending", "waiting", "failed"):
                    node.state, node.restart_at = head.state, head.restart_at

    @property
    def spares(self) -> list[str]:
        """Those that a live flow goes on without."""
        return [node.plan.node for node in self if node.spare]

    @property
    def all_ready(self) -> bool:
        """Whether all can begin; nobody waits for an external one, or a spare one that is elsewhere or has failed."""
        return all(
            node.state in ("ready", "external") or (node.spare and (not node.here or node.failing_since is not None))
            for node in self
        )

    @property
    def all_ended(self) -> bool:
        """Whether everything has been handled."""
        return all(node.handled == END or node.missing for node in self)

    @property
    def handled(self) -> Iterator[int]:
        """Up to which stamp (ns) each reader has handled everything."""
        return (node.handled for node in self if node.plan.inputs)

    @property
    def plans(self) -> dict[str, list[NodePlan]]:
        """What each process here runs, by its first node."""
        return {head: [node.plan for node in members] for head, members in self._processes.items()}

    @property
    def unrecorded(self) -> list[str]:
        """Why the recording of a live flow is incomplete, at the end."""
        failed = [node for node in self.here if node.spare and (node.failing_since is not None or node.last_words)]
        return [f"{node.plan.node}: the recording is incomplete: {node.last_line}" for node in failed]

    @property
    def counters(self) -> dict[str, Counters]:
        """The last that each said it counted."""
        return {node.plan.node: node.counters for node in self if node.counters is not None}

    def take_line(self, name: str, text: str) -> None:
        """Report a line that a node, or a program beside them, wrote."""
        if name not in self:
            self._say(name, text)
            return
        head = self[name]
        speaker, text = spoken(text)
        node = self._nodes.get(speaker, head)
        for line, level in head.take_line(text):
            self._say(node.plan.node, line, level)
        node.last_line = head.last_line

    def take_said(self, said: Said) -> None:
        """Note what a node says of its progress, or of what it counted."""
        try:
            message = decode(said.payload, said.kind)
        except MessageError as error:
            self._say(LAUNCHER, f"a {said.kind.__name__} refused: {error}", "warning")
            return
        if isinstance(message, Counters):
            self._statistics.note(message)
        node = self._nodes.get(message.node)
        if node is None:
            return
        if isinstance(message, Progress):
            # A restarted reader begins again: what it had handled before stands.
            node.handled = max(node.handled, message.handled)
            return
        if node.here:
            for line in self._statistics.grown_old(message):
                self._say(message.node, line, "warning")
        node.counters = message
        if message.ended:
            node.handled = END

    def take_ready(self, name: str, *, there: bool) -> None:
        """Note that a node hears and is heard; not `there`: that it is out of reach."""
        node = self[name]
        if not there:
            if not node.here:  # the end of a process of this machine is told by the process
                node.state = "away"
            return
        node.state = "ready"
        now = time.monotonic()
        if all(member.state == "ready" for member in self._processes.get(name, ())):
            node.policy.ready(now)
        if node.failing_since is not None:
            self._say(name, f"is there again, after {now - node.failing_since:.1f} s")
            node.failing_since = None

    def look(self) -> None:
        """See what each process costs, once a second."""
        self._statistics.look(self)

    def status(self, deployment: Deployment, endpoint: str) -> FlowStatus:
        """Everything that is known of those here, now; `endpoint`: where their launcher listens for them."""
        here = {node.plan.node: node for node in self if node.here}
        machine = deployment.site.name if deployment.site else ""
        site = deployment.site or deployment.door
        at = site.listen[0] if site and site.listen else endpoint
        return self._statistics.status(deployment.flow, machine, here, replay=deployment.replay, endpoint=at)
