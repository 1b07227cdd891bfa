"""What follows when the process of a node ends: another start, a flow that goes on without it, or a failure."""

import signal
import sys
import time

from caneflow.runtime.dataflow.graph import Restart
from caneflow.runtime.hosts.launcher.node_state import NodeState
from caneflow.runtime.hosts.launcher.processes import Exited
from caneflow.runtime.hosts.launcher.restarts import Again, How
from caneflow.runtime.hosts.launcher.stop_signals import signal_name
from caneflow.runtime.hosts.launcher.watcher import Say
from caneflow.runtime.outcome import Outcome

CRASHES = (signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGABRT)  # of a program by itself
RECORDER_RESTART = Restart(  # in a replay, of whatever process a recorder is in: its recording is its result
    policy="never", max_restarts=0, window_s=0.0, delay_s=0.0, max_delay_s=0.0
)
LIVE_RECORDER_RESTART = Restart(  # where the position is worth more than its recording: without end
    policy="always", max_restarts=sys.maxsize, window_s=60.0, delay_s=0.25, max_delay_s=10.0
)
RECORDS = "not started again: the recording of a replay is its result, and would begin again in the middle"
FAILING_SAID = 60.0  # s after which the launcher says again that the flow goes on without its recorder


class Ends:
    """Decides by each node's policy, tells, and notes what failed for good."""

    def __init__(self, say: Say, outcome: Outcome) -> None:
        self._say = say
        self._outcome = outcome

    def exited(self, node: NodeState, exited: Exited, *, begun: bool) -> None:
        """Take the end of the process of `node`; `begun`: all nodes were ready once."""
        if exited.pid != node.pid:
            return
        words, status = node.last_words, exited.status
        reached = f"up to stamp {node.handled}"
        cause = f"ended with killed by {signal_name(-status)}" if status < 0 else f"ended with status {status}"
        if words is not None:
            self.ended(node, cause, How.LASTING if words.lasting else How.FAULT, words.at, begun=begun)
        elif -status in CRASHES or status >= 0:
            self.ended(node, cause, How.FAULT, reached, begun=begun)
        else:
            self.ended(node, cause, How.STOPPED, reached, begun=begun)

    def ended(self, node: NodeState, cause: str, how: How, at: object, *, begun: bool) -> None:
        """Have `node` started again some time, or note that it failed; `at`: where in its work it ended."""
        name, now = node.plan.node, time.monotonic()
        if node.spare and begun and how is How.LASTING:
            how = How.FAULT  # it has worked before
        verdict = node.policy.ended(now, at, how)
        if node.spare and isinstance(verdict, Again):
            self._go_on_without(node, cause, verdict.delay_s)
            return
        if not isinstance(verdict, Again):
            node.state = "failed"
            tried = f" after {node.restarts} restart{'s' * (node.restarts > 1)}" if node.restarts else ""
            why = verdict.why or (node.records and RECORDS) or ""
            parts = (f"{name} {cause}{tried}", why, node.last_line)
            self._outcome.failures.append(": ".join(filter(None, parts)))
            return
        node.restarts += 1
        node.state = "waiting"
        node.restart_at = now + verdict.delay_s
        again = f"restart {node.policy.counted} of {node.policy.allowed} in {verdict.delay_s:g} s"
        said = f": {node.last_words.error}" if node.last_words else ""
        self._say(name, f"{cause}{said}; {again}", "warning")

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
            lost = "THE FLOW GOES ON WITHOUT ITS RECORDING and tries again"
            self._say(node.plan.node, f"{cause}{said}; {lost}", "error")
