"""Restarts that someone asked for: a node ends in order and starts again at once; its policy does not count them."""

import time
from collections.abc import Callable
from typing import Protocol

from caneflow.runtime.hosts.launcher.ends import RECORDS
from caneflow.runtime.hosts.launcher.node_state import NodeState
from caneflow.runtime.hosts.launcher.nodes import Nodes
from caneflow.runtime.hosts.launcher.processes import Exited
from caneflow.runtime.hosts.launcher.requests import Answer, RestartAsked
from caneflow.runtime.hosts.launcher.watcher import Say
from caneflow.runtime.stages.merge import BEGIN
from caneflow.runtime.wording import did_you_mean, listed

END_PATIENCE = 2.5  # s that a node has to end in order


class Ending(Protocol):
    """How processes are ended."""

    def ask_to_end(self, node: str) -> None:
        """Ask a node's process to end."""

    def kill(self, node: str) -> None:
        """End it at once."""


class AskedRestarts:
    """The requests of one run, until each is answered."""

    def __init__(self, nodes: Nodes, processes: Ending, start: Callable[[NodeState], None], say: Say) -> None:
        self._nodes = nodes
        self._processes = processes
        self._start = start
        self._say = say
        self._waiting: dict[str, list[RestartAsked]] = {}  # by node, for its new process to be ready
        self._kill_at: dict[str, float] = {}  # s, monotonic: of nodes that are to end

    def take(self, asked: RestartAsked) -> None:
        """Do what is asked, or say why not."""
        if (refusal := self._refusal(asked.node)) is not None:
            asked.answer(refusal)
            return
        node = self._nodes.head_of(asked.node)
        name = node.plan.node  # of the first node of its process, which starts again as a whole
        self._waiting.setdefault(name, []).append(asked)
        if name in self._kill_at:
            return  # it is ending already
        node.policy.asked(time.monotonic())
        if node.state == "waiting":
            node.restart_at = time.monotonic()
            return
        self._say(asked.node, "restart: someone asked for it")
        node.state = "ending"
        self._kill_at[name] = time.monotonic() + END_PATIENCE
        self._processes.ask_to_end(name)

    def ended(self, exited: Exited) -> bool:
        """Whether the process ended because it was asked to; then the node starts again."""
        node = self._nodes[exited.node]
        if exited.pid != node.pid or self._kill_at.pop(exited.node, None) is None:
            return False
        node.asked += 1
        if not node.plan.replay:
            node.handled = BEGIN  # a recorder that ends has taken all there is; the new one has not
        self._start(node)
        return True

    def look(self) -> None:
        """Kill who does not end, and answer for those whose new process is ready, or is not going to be."""
        now = time.monotonic()
        for name, at in self._kill_at.items():
            if now > at:
                self._say(name, f"did not end within {END_PATIENCE:g} s; killed", "warning")
                self._kill_at[name] = now + END_PATIENCE
                self._processes.kill(name)
        for name in [name for name in self._waiting if name not in self._kill_at]:
            node = self._nodes[name]
            if node.state == "ready":
                self._answer(name, Answer(pid=node.pid))
            elif node.state == "failed" or (node.state == "waiting" and node.restart_at > now):
                self._answer(name, Answer(error=f"{name} does not start: {node.last_line or 'see its log'}"))

    def _answer(self, name: str, answer: Answer) -> None:
        for asked in self._waiting.pop(name):
            asked.answer(answer)

    def _refusal(self, name: str) -> Answer | None:
        """Why a node cannot be started again; None: it can."""
        names = [node.plan.node for node in self._nodes]
        if name not in self._nodes:
            return Answer(error=f"no node {name!r};{did_you_mean(name, names)} there are {listed(names)}")
        node = self._nodes[name]
        if node.plan.external:
            return Answer(error=f"{name} is someone else's program: whoever started it starts it again")
        if not node.here:
            return Answer(elsewhere=True)
        if node.records:
            return Answer(error=f"{name}: {RECORDS}")
        return None
