"""Stages with wires between them: a call instead of a key, the same numbers, marks and counters."""

from collections.abc import Mapping

import msgspec
import pytest

from caneflow.messages import GroundSpeed, Imu, Sample, decode, sample_key
from caneflow.messages.control import LeftOut
from caneflow.runtime import Emitted, Operator, Sink
from caneflow.runtime.plan import InputPlan, NodePlan, OutputPlan
from caneflow.runtime.stages.decisions import Decided, WasLeftOut, WentOn
from caneflow.runtime.stages.group import Group, in_order
from caneflow.runtime.stages.merge import END
from caneflow.runtime.stages.source_stage import Feed


class Speed(Operator):
    """Says each gyro x as a speed; -1: nothing follows."""

    inputs = {"imu": Imu}
    outputs = {"speed": GroundSpeed}

    def __init__(self) -> None: ...

    def handle(self, port: str, message: Sample) -> Emitted:
        assert isinstance(message, Imu)
        if message.gyro[0] >= 0:
            yield "speed", GroundSpeed(stamp=message.stamp, speed=message.gyro[0], quality=0.0, rays=1, valid=True)


class Both(Operator):
    """What it was handed, in order."""

    inputs = {"imu": Imu, "speed": GroundSpeed}
    outputs = {"imu": Imu}

    def __init__(self) -> None:
        self.came: list[tuple[str, int, int]] = []

    def handle(self, port: str, message: Sample) -> Emitted:
        self.came.append((port, message.stamp, message.seq))
        return ()


class Keep(Sink):
    """The bytes that it took."""

    def __init__(self) -> None:
        self.taken: list[tuple[str, bytes, int]] = []
        self.finished = 0

    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        self.taken.append((key, payload, time))

    def idle(self, time: int) -> None: ...

    def finish(self) -> None:
        self.finished += 1


def node(name: str, inputs: Mapping[str, str] = {}, outputs: Mapping[str, type[Sample]] = {}) -> NodePlan:
    kinds = {"imu": "caneflow.Imu/1", "speed": "caneflow.GroundSpeed/1"}
    return NodePlan(
        flow="f",
        node=name,
        inputs={
            port: InputPlan(key=f"f/{wire}", schema=kinds[wire.partition("/")[2]], writer=wire.partition("/")[0])
            for port, wire in inputs.items()
        },
        outputs={
            port: OutputPlan(key=sample_key("f", name, port), schema=kind.schema) for port, kind in outputs.items()
        },
    )


PLANS = {
    "keep": node("keep", {"both/imu": "both/imu", "speed": "speed/speed"}),
    "both": node("both", {"imu": "imu/imu", "speed": "speed/speed"}, {"imu": Imu}),
    "speed": node("speed", {"imu": "imu/imu"}, {"speed": GroundSpeed}),
}


@pytest.fixture
def made() -> tuple[Group, Both, Keep]:
    """The three of PLANS; the IMU is outside."""
    both, keep = Both(), Keep()
    group = Group(PLANS, received=lambda node, port, message: message.stamp + 7)
    for name, built in (("keep", keep), ("both", both), ("speed", Speed())):
        group.add(PLANS[name], built)
    return group, both, keep


def imu(stamp: int, seq: int, x: float = 1.0) -> Imu:
    return Imu(stamp=stamp, gyro=(x, 0.0, 0.0), seq=seq)


def hear(group: Group, message: Imu) -> None:
    """What comes from outside comes to each of its readers."""
    for name in ("both", "speed"):
        group.take(name, "imu", message, None, message.stamp)


def settle(group: Group) -> list[tuple[str, str, int]]:
    sent = []
    while (stepped := group.step()) is not None:
        name, emitted = stepped
        sent += [(name, port, seq) for port, _, seq in emitted]
    return sent


def test_writers_come_before_their_readers() -> None:
    assert in_order(PLANS) == ["speed", "both", "keep"]


def test_a_sample_between_members_comes_in_event_time_with_its_number(made: tuple[Group, Both, Keep]) -> None:
    group, both, keep = made
    hear(group, imu(10, 0))
    hear(group, imu(20, 1))
    assert settle(group) == [("speed", "speed", 0), ("speed", "speed", 1)]
    assert both.came == [("imu", 10, 0), ("speed", 10, 0), ("imu", 20, 1), ("speed", 20, 1)]
    assert [(key, decode(payload, GroundSpeed).seq, time) for key, payload, time in keep.taken] == [
        ("f/speed/speed", 0, 17),
        ("f/speed/speed", 1, 27),
    ]


def test_a_reader_does_not_wait_for_a_writer_that_has_nothing_to_say(made: tuple[Group, Both, Keep]) -> None:
    group, both, _ = made
    hear(group, imu(10, 0, x=-1.0))
    hear(group, imu(20, 1, x=-1.0))
    settle(group)
    assert both.came == [("imu", 10, 0), ("imu", 20, 1)], "marks pass as samples do"


def test_one_that_is_held_handles_nothing_until_it_is_let_go(made: tuple[Group, Both, Keep]) -> None:
    group, both, _ = made
    group.held.add("speed")
    hear(group, imu(10, 0))
    assert settle(group) == []
    assert both.came == [], "nobody knows that no speed comes first"
    group.held.clear()
    assert settle(group) == [("speed", "speed", 0)]
    assert both.came == [("imu", 10, 0), ("speed", 10, 0)]


def test_what_ends_outside_ends_every_member_once(made: tuple[Group, Both, Keep]) -> None:
    group, _, keep = made
    ended = Feed("imu", node("imu", outputs={"imu": Imu}).outputs, ordered=False)
    ended.ended = True
    for name in ("both", "speed"):
        group.mark(name, "imu", ended.progress().ports["imu"])
    settle(group)
    settle(group)
    group.finish()
    assert keep.finished == 1
    assert all(reader.progress().handled == END for reader in group.readers.values())


def test_local_wires_are_counted_as_others_are(made: tuple[Group, Both, Keep]) -> None:
    group, _, _ = made
    hear(group, imu(10, 0))
    hear(group, imu(20, 1))
    settle(group)
    counters = {each.node: each for each in group.counters()}
    assert counters["speed"].outputs == {"speed": 2}
    assert {port: (each.received, each.handled) for port, each in counters["both"].inputs.items()} == {
        "imu": (2, 2),
        "speed": (2, 2),
    }
    assert counters["keep"].inputs["speed"].handled == 2


def test_what_was_decided_before_a_kill_is_decided_behind_the_same_samples() -> None:
    note = LeftOut(node="mix", port="late", reason="dropped", first_seq=7, last_seq=7, stamp=70)
    lost = LeftOut(node="mix", port="late", reason="lost", first_seq=3, last_seq=4)
    decided = Decided([WentOn("mix", "late", 20, 2), WasLeftOut(lost), WentOn("mix", "late", 60, 6), WasLeftOut(note)])
    assert list(decided.passed(1)) == []
    assert list(decided.passed(5)) == [20]
    assert list(decided.passed(9)) == [60]
    imu = Imu(stamp=70, gyro=(0.0, 0.0, 0.0))
    reasons = [decided.reason(msgspec.structs.replace(imu, stamp=10 * seq, seq=seq)) for seq in range(2, 9)]
    assert reasons == [None, "lost", "lost", None, None, "dropped", None]
