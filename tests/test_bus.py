"""A node's place on the bus: on whose thread samples come, and that what has come is taken before the end."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh

from caneflow.messages import control_key, encode
from caneflow.messages.control import Again, PortMark, Progress
from caneflow.runtime.hosts.links.session import Ports, open_session
from caneflow.runtime.hosts.process.bus import Bus
from caneflow.runtime.hosts.process.callbacks import AGAIN
from caneflow.runtime.hosts.process.events import Arrived, Event, HistoryAsked, Started
from caneflow.runtime.plan import InputPlan, Links, NodePlan, OutputPlan, ProcessPlan
from tests.flows import wait_for

KEY = "f/imu/imu"
SAMPLES = 2000  # more than the 256 that Zenoh's own queue takes


@contextmanager
def met(*, replay: bool) -> Iterator[tuple[Bus, zenoh.Session]]:
    """A reader's bus, and its writer's session."""
    ports = Ports()
    endpoint = ports.endpoint()
    inputs = {"imu": InputPlan(key=KEY, schema="caneflow.Imu/1", writer="imu")}
    plan = NodePlan(flow="f", node="sink", replay=replay, inputs=inputs, links=Links(listen=(endpoint,)))
    with Bus(ProcessPlan.of(plan)) as bus, open_session(connect=[endpoint], replay=replay) as writer:
        yield bus, writer
    ports.release()


def say(writer: zenoh.Session, count: int) -> None:
    """Samples, and after them, on the same link, the word to start."""
    block = zenoh.CongestionControl.BLOCK
    publisher = writer.declare_publisher(KEY, congestion_control=block)
    wait_for(lambda: publisher.matching_status.matching, "the subscription to arrive")  # type: ignore[attr-defined]  # the stub says bool
    for number in range(count):
        publisher.put(str(number))
    writer.put(control_key("f", "start"), b"", congestion_control=block)


def test_what_has_come_in_a_replay_is_taken_before_the_end() -> None:
    taken: list[int] = []
    free = threading.Event()

    def take(event: Event) -> bool:
        free.wait(30)
        assert isinstance(event, Arrived)
        taken.append(int(event.payload))
        return True

    with met(replay=True) as (bus, writer):
        bus.at_once = take
        say(writer, SAMPLES)
        events = bus.events(30)
        assert isinstance(next(events), Started), "a sample that is being taken holds nothing else up"
        assert taken == []
        free.set()
        bus.hear_out()
    assert taken == list(range(SAMPLES))


def test_in_a_replay_no_mark_or_answer_overtakes_the_samples_that_were_sent_before_it() -> None:
    """Or they would be asked for while they are on their way, and come twice."""
    free = threading.Event()
    came: list[str] = []

    def take(event: Event) -> bool:
        free.wait(30)
        again = isinstance(event, Arrived) and event.again
        came.append(type(event).__name__ + ("Again" if again else ""))
        return True

    with met(replay=True) as (bus, writer):
        bus.at_once = take
        history, progress = control_key("f", "history", "imu", "imu"), control_key("f", "progress", "imu")
        answered = threading.Event()

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(history, b"0")
                end = encode(Again(0, PortMark(2, 30)))
                query.reply(history, end, encoding=zenoh.Encoding("application/msgpack").with_schema(AGAIN))
            answered.set()

        writer.declare_queryable(history, zenoh.handlers.Callback(answer, indirect=False))
        say(writer, 2)
        mark = encode(Progress("imu", 20, {"imu": PortMark(1, 20)}))
        writer.put(progress, mark, congestion_control=zenoh.CongestionControl.BLOCK)
        bus.ask_again("sink", "imu", 0)
        assert answered.wait(30)
        say(writer, 1)
        assert came == []
        free.set()
        wait_for(lambda: len(came) == 7, "everything to be taken")
    assert came.index("HistoryAnswered") < came.index("AskEnded"), "the end of a query belongs to no order but its own"
    came.remove("AskEnded")
    assert came == ["Arrived", "Arrived", "Marked", "ArrivedAgain", "HistoryAnswered", "Arrived"]


@pytest.mark.parametrize("replay", [False, True])
def test_what_is_not_taken_at_once_waits_in_the_inbox(replay: bool) -> None:
    with met(replay=replay) as (bus, writer):
        bus.at_once = lambda _: False
        say(writer, 3)
        came: list[Event] = []
        while sum(isinstance(event, Arrived) for event in came) < 3:
            came += bus.events(30)
        assert [event.payload for event in came if isinstance(event, Arrived)] == [b"0", b"1", b"2"]


def test_a_sink_is_not_woken_for_marks_that_only_operators_wait_for() -> None:
    with met(replay=False) as (_, writer):
        progress = writer.declare_publisher(control_key("f", "progress", "imu"))
        marks = writer.declare_publisher(control_key("f", "marks", "imu"))
        wait_for(lambda: progress.matching_status.matching, "the subscription to arrive")  # type: ignore[attr-defined]  # the stub says bool
        assert not marks.matching_status.matching  # type: ignore[attr-defined]  # the stub says bool


@pytest.mark.parametrize("asked", [b"9" * 5000, b"\xff\xfe", b"-1", b"", "\u0661".encode()])
def test_a_request_that_names_no_number_is_left_unanswered(asked: bytes, caplog: pytest.LogCaptureFixture) -> None:
    ports = Ports()
    endpoint = ports.endpoint()
    outputs = {"imu": OutputPlan(key=KEY, schema="caneflow.Imu/1")}
    plan = NodePlan(flow="f", node="imu", outputs=outputs, links=Links(listen=(endpoint,)))
    with Bus(ProcessPlan.of(plan)) as bus, open_session(connect=[endpoint]) as reader:
        key = control_key("f", "history", "imu", "imu")
        querier = reader.declare_querier(key, timeout=30.0)
        wait_for(lambda: querier.matching_status.matching, "the link")  # type: ignore[attr-defined]  # the stub says bool
        assert list(querier.get(payload=asked)) == []
        replies = querier.get(payload=b"7")
        (event,) = bus.events(30)
        assert isinstance(event, HistoryAsked)
        assert event.first == 7
        bus.answer(event, [], Again(0, PortMark(-1, -1)))
        assert len(list(replies)) == 1
    ports.release()
