"""A node takes samples on the thread that brings them: live while it is quick, in a replay always."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import msgspec
import pytest
import zenoh

from caneflow.messages import GroundSpeed, Imu, Sample, numbered
from caneflow.messages.control import Again, PortMark, Progress
from caneflow.runtime import Emitted, Operator
from caneflow.runtime.hosts.process import inputs, process, quickness, recovery, reports, sayings
from caneflow.runtime.hosts.process.events import (
    Arrived,
    AskEnded,
    Broken,
    Event,
    HistoryAnswered,
    HistoryAsked,
    Marked,
)
from caneflow.runtime.plan import InputPlan, NodePlan, OutputPlan, ProcessPlan

PLAN = NodePlan(
    flow="f",
    node="echo",
    inputs={"imu": InputPlan(key="f/imu/imu", schema="caneflow.Imu/1", writer="imu")},
    outputs={"speed": OutputPlan(key="f/echo/speed", schema="caneflow.GroundSpeed/1", awaited=False)},
)
TIMES = 64  # events, over which slowness is judged


class Clock:
    """Time that passes only when it is told to, and the CPU's part of it."""

    def __init__(self) -> None:
        self.now = 0.0
        self.worked = 0.0

    def work(self, seconds: float) -> None:
        self.now += seconds
        self.worked += seconds

    def monotonic(self) -> float:
        return self.now

    def thread_time(self) -> float:
        return self.worked

    def time_ns(self) -> int:
        return round(self.now * 1e9)


class Echo(Operator):
    """Says each gyro x as a speed, and takes its time over it."""

    inputs = {"imu": Imu}
    outputs = {"speed": GroundSpeed}

    def __init__(self, clock: Clock) -> None:
        self.clock, self.takes, self.waits = clock, 0.0, 0.0
        self.threads: list[int] = []

    def handle(self, port: str, message: Sample) -> Emitted:
        self.clock.work(self.takes)
        self.clock.now += self.waits
        self.threads.append(threading.get_ident())
        assert isinstance(message, Imu)
        if message.gyro[0] < 0:
            raise ZeroDivisionError("a bug of the operator's")
        if message.gyro[0] == 0:
            return
        yield "speed", GroundSpeed(stamp=message.stamp, speed=message.gyro[0], quality=0.0, rays=1, valid=True)


class Bus:
    """What a node needs of a bus, without Zenoh."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.inbox: list[Event] = []
        self.told: list[Progress] = []
        self.marked: list[Progress] = []
        self.asked: list[int] = []
        self.answers: list[list[bytes]] = []

    def send(self, node: str, port: str, payload: bytes) -> None:
        self.sent.append(payload)

    def send_progress(self, progress: Progress) -> None:
        self.told.append(progress)

    def send_marks(self, progress: Progress) -> None:
        self.marked.append(progress)

    def ask_again(self, node: str, port: str, first: int) -> None:
        self.asked.append(first)

    def answer(self, asked: HistoryAsked, payloads: list[bytes], end: Again) -> None:
        self.answers.append(payloads)

    def pending(self) -> bool:
        return bool(self.inbox)

    def events(self, timeout: float | None) -> Iterator[Event]:
        while self.inbox:
            yield self.inbox.pop(0)

    def put(self, event: Event) -> None:
        self.inbox.append(event)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    for module in (process, inputs, quickness, recovery, reports, sayings):
        monkeypatch.setattr(module, "time", clock)
    return clock


@pytest.fixture
def made(clock: Clock, tmp_path: Path) -> Callable[..., tuple[Any, Bus, Echo]]:
    def make(*, replay: bool = False, awaited: bool = False) -> tuple[Any, Bus, Echo]:
        bus: Any = Bus()
        outputs = {"speed": msgspec.structs.replace(PLAN.outputs["speed"], awaited=awaited)}
        plan = NodePlan(flow="f", node="echo", inputs=PLAN.inputs, outputs=outputs, replay=replay)
        echo = Echo(clock)
        host = process.Process(ProcessPlan.of(plan), bus, {"echo": echo}, tmp_path / "echo.snapshot")
        return host, bus, echo

    return make


def arrival(seq: int, x: float = 1.0) -> Arrived:
    return sample(10_000_000 * (seq + 1), seq, x)


def sample(stamp: int, seq: int, x: float = 1.0) -> Arrived:
    return Arrived("echo", "imu", numbered(Imu(stamp=stamp, gyro=(x, 0.0, 0.0)), seq), "caneflow.Imu/1")


def test_while_it_is_quick_what_follows_is_sent_before_the_bringing_thread_goes_on(made: Any) -> None:
    host, bus, echo = made()
    for seq in range(3):
        assert host.take_at_once(arrival(seq))
        assert len(bus.sent) == seq + 1
    assert set(echo.threads) == {threading.get_ident()}
    assert not bus.inbox


def test_a_reader_that_waits_hears_at_once_that_nothing_follows_from_a_sample(made: Any) -> None:
    host, bus, _ = made(awaited=True)
    host.take_at_once(arrival(0))
    assert bus.marked == [], "the sample says it"
    host.take_at_once(arrival(1, x=0.0))
    (progress,) = bus.marked
    assert progress.ports["speed"] == PortMark(0, 20_000_000)
    host.take_at_once(Marked("echo", "imu", PortMark(1, 20_000_000)))
    assert len(bus.marked) == 1, "nothing is said twice"
    assert bus.told == [], "nobody else is woken"


def test_a_slow_one_is_left_to_its_own_thread_for_good(made: Any) -> None:
    host, _, echo = made()
    echo.takes = 1.01 * quickness.QUICK
    taken = sum(host.take_at_once(arrival(seq)) for seq in range(2 * TIMES))
    assert 1 < taken < TIMES // 2, "some slow ones are forgiven, not many"
    echo.takes = 0.0
    assert not host.take_at_once(arrival(2 * TIMES))


def test_one_that_the_machine_keeps_waiting_is_not_slow(made: Any) -> None:
    host, _, echo = made()
    echo.waits = 0.9 * quickness.STALLED
    assert all(host.take_at_once(arrival(seq)) for seq in range(10 * TIMES))


def test_one_that_waits_for_long_is_left_to_its_own_thread(made: Any) -> None:
    host, _, echo = made()
    echo.waits = 1.1 * quickness.STALLED
    assert sum(host.take_at_once(arrival(seq)) for seq in range(2 * TIMES)) < TIMES // 2


def test_no_sample_waits_for_the_disk_that_a_snapshot_goes_to(made: Any, clock: Clock) -> None:
    host, bus, _ = made()
    host.take_at_once(arrival(0))
    clock.now += 1.01 * recovery.LIVE_SNAPSHOT_PERIOD
    keep, taken = host.recovery["echo"].keeper.keep, []

    def bring() -> None:
        taken.append(host.take_at_once(arrival(1)))

    def keep_slowly(snapshot: bytes) -> bool:
        bringing = threading.Thread(target=bring)
        bringing.start()
        bringing.join(30)
        return bool(keep(snapshot))

    host.recovery["echo"].keeper.keep = keep_slowly
    host.keep_snapshots()
    assert taken == [True]
    assert len(bus.sent) == 2
    assert host.recovery["echo"].confirmed == {"f/imu/imu": 0}, "the sample that came meanwhile is not in it"


def test_one_slow_event_in_five_is_forgiven(made: Any) -> None:
    host, _, echo = made()
    for seq in range(10 * TIMES):
        echo.takes = 10 * quickness.QUICK if seq % 5 == 0 else 0.0
        assert host.take_at_once(arrival(seq))


def test_what_an_operator_raises_is_raised_on_the_nodes_own_thread(made: Any) -> None:
    host, bus, _ = made()
    assert host.take_at_once(arrival(0, x=-1.0))
    (broken,) = bus.inbox
    assert isinstance(broken, Broken)
    with pytest.raises(ZeroDivisionError, match="a bug of the operator's"):
        host.take(broken)
    assert not host.take_at_once(arrival(1)), "nothing is handled after it"


def test_in_a_replay_however_slow_it_is_samples_are_taken_at_once_and_nothing_else(made: Any) -> None:
    host, bus, echo = made(replay=True)
    echo.takes = 10 * quickness.QUICK
    for seq in range(2 * TIMES):
        assert host.take_at_once(arrival(seq))
    assert len(bus.sent) == 2 * TIMES
    assert not host.take_at_once(Marked("echo", "imu", PortMark(2 * TIMES, 10**12)))


def test_between_the_samples_of_a_replay_all_else_is_done(made: Any) -> None:
    """Samples may come without end: who asks is answered all the same, and how far the node has come is said."""
    host, bus, echo = made(replay=True)
    echo.takes = reports.REPORT_PERIOD
    host.take_at_once(arrival(0))
    bus.inbox.append(HistoryAsked("echo", "speed", 0, query=cast("zenoh.Query", None)))
    host.take_at_once(arrival(1))
    assert [len(each) for each in bus.answers] == [0], "nobody reads it, so nothing is kept for anybody"
    assert [progress.handled for progress in bus.told] == [10_000_000, 20_000_000]


def test_in_a_replay_what_does_not_come_is_asked_for_and_waited_for(made: Any, clock: Clock) -> None:
    host, bus, _ = made(replay=True)
    host.take(HistoryAnswered("echo", "imu", 0, PortMark(-1, -1)))
    host.take_at_once(arrival(0))
    host.take(Marked("echo", "imu", PortMark(2, 10**12)))
    host.ask_for_missing()
    assert bus.asked == [1]
    clock.now += 0.9 * inputs.REPLAY_PATIENCE
    host.ask_for_missing()
    assert host.stages["echo"].inputs["imu"].counts.lost == 0
    clock.now += 0.11 * inputs.REPLAY_PATIENCE
    host.ask_for_missing()
    assert host.stages["echo"].inputs["imu"].counts.lost == 2


def test_what_is_asked_for_already_is_not_asked_for_twice(made: Any, clock: Clock) -> None:
    host, bus, _ = made(replay=True)
    host.ask_for_missing()
    host.take_at_once(arrival(7))
    assert bus.asked == [0], "a node that is new asks for what it may have missed: that is the same"
    clock.now += 1.01 * inputs.ASK_PERIOD
    host.ask_for_missing()
    assert bus.asked == [0], "the answer may be on its way, or wait behind what came before it"
    host.take(AskEnded("echo", "imu"))
    host.ask_for_missing()
    assert set(bus.asked) == {0}, "there was no answer"
    assert len(bus.asked) > 1


def test_a_gap_in_the_numbers_is_asked_for_at_once(made: Any) -> None:
    host, bus, _ = made(replay=True)
    host.take(HistoryAnswered("echo", "imu", 0, PortMark(-1, -1)))
    host.take_at_once(arrival(0))
    host.take_at_once(arrival(2))
    assert bus.asked == [1]


def test_live_a_writer_that_is_silent_is_waited_for_longer_than_one_that_goes_on(made: Any, clock: Clock) -> None:
    """A busy one answers when it is done; one that sends more and does not answer will not."""
    for goes_on in (False, True):
        host, _, _ = made()
        counts = host.stages["echo"].inputs["imu"].counts
        host.take_at_once(arrival(0))
        host.take_at_once(arrival(2))
        clock.now += 0.5 * inputs.LIVE_PATIENCE
        if goes_on:
            host.take_at_once(arrival(3))
        clock.now += 0.6 * inputs.LIVE_PATIENCE
        host.ask_for_missing()
        assert counts.lost == (1 if goes_on else 0)
        clock.now += inputs.SILENT_PATIENCE
        host.ask_for_missing()
        assert counts.lost == 1
        host.handle_what_is_due()
        assert counts.handled == (3 if goes_on else 2), "what came after it is handled"


@pytest.mark.parametrize("stamp", [5, 3600, None])
def test_what_lies_in_the_future_moves_nothing(made: Any, stamp: int | None) -> None:
    """From whoever it comes; `stamp`: s from now, None: as late as can be said. Of the marks only the end counts."""
    host, bus, _ = made()
    now = time.time_ns()
    late = 2**63 - 2 if stamp is None else now + stamp * 10**9
    host.take_at_once(sample(now, 0))
    host.take_at_once(sample(late, 1))
    host.take_at_once(Marked("echo", "imu", PortMark(1, late)))
    host.take_at_once(HistoryAnswered("echo", "imu", 0, PortMark(1, late)))
    host.take_at_once(sample(now + 1, 2))
    assert len(bus.sent) == 2
    assert host.stages["echo"].progress().handled == now + 1
    assert bus.asked == [], "the one that was refused is not missing"
    host.take_at_once(Marked("echo", "imu", PortMark(2, 2**63 - 1)))
    assert host.stages["echo"].finished


def test_a_replay_has_no_present(made: Any) -> None:
    host, bus, _ = made(replay=True)
    host.take_at_once(sample(time.time_ns() + 10**18, 0))
    assert len(bus.sent) == 1


def test_after_its_end_a_node_takes_no_more(made: Any) -> None:
    host, bus, _ = made()
    host.take_no_more()
    assert not host.take_at_once(arrival(0))
    assert not bus.sent
