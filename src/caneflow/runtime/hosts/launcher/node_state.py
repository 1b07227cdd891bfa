"""What the launcher knows of each node."""

from dataclasses import dataclass, field

from caneflow.messages.control import Counters
from caneflow.runtime.hosts.launcher.restarts import Restarts
from caneflow.runtime.hosts.process import last_words
from caneflow.runtime.hosts.process.last_words import LastWords
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.stages.merge import BEGIN


@dataclass
class NodeState:
    """What the launcher knows of one node."""

    plan: NodePlan
    policy: Restarts
    spare: bool = False  # a live flow goes on without it: its recorder
    records: bool = False  # a recorder of a replay runs in its process: the recording would begin again in the middle
    here: bool = True  # False: another machine's launcher starts it
    state: str = "starting"  # starting, ready, ending (as asked), waiting (for its restart), failed; away: out of reach
    pid: int = 0
    started_at: float = 0.0  # s, monotonic
    restart_at: float = 0.0  # s, monotonic
    restarts: int = 0  # after it had failed
    asked: int = 0  # restarts that someone asked for
    handled: int = BEGIN
    counters: Counters | None = None
    last_line: str = ""
    last_words: LastWords | None = None  # of the process that is ending
    shown: set[str] = field(default_factory=set)  # places of errors whose traceback was shown
    failing_since: float | None = None  # s, monotonic: of a spare one that cannot be had now
    say_at: float = 0.0  # s, monotonic: when to say so again

    @property
    def started_again(self) -> int:
        """How often it was started again, for whatever reason."""
        return self.restarts + self.asked

    @property
    def missing(self) -> bool:
        """Whether it is a spare one that could not even be started again."""
        return self.spare and (self.state == "away" or (self.failing_since is not None and self.policy.counted > 1))

    def take_line(self, text: str) -> list[tuple[str, str]]:
        """Take a line that the process wrote; what is to be shown: its last words once per place.

        Each line with its level; "": it says so itself.
        """
        words = last_words.heard(text)
        if words is None:
            self.last_line = text or self.last_line
            return [(text, "")]
        text = text.partition(last_words.MARK)[0]  # that of a line without an end
        shown = [(text, "")] if text else []
        self.last_words, self.last_line = words, words.error
        if words.place not in self.shown:
            self.shown.add(words.place)
            shown += [(line, "error") for line in words.lines]
        return shown
