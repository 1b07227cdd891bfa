"""A stage between its streams: checked arrivals, event time, numbered departures, each fault in its counter."""

import logging
from collections.abc import Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st

from caneflow.messages import GroundSpeed, Imu, MessageError, Sample
from caneflow.messages.control import PortMark
from caneflow.runtime import Context, Emitted, Operator, Refused
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.plan import InputPlan, OutputPlan
from caneflow.runtime.stages.merge import END
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.runtime.stages.streams import FAR_AHEAD, SILENCE


class Echo(Operator):
    """Says each IMU sample's gyro x as a speed; refuses negative ones; one last word at the end."""

    inputs = {"a": Imu, "b": Imu}
    outputs = {"speed": GroundSpeed}

    def __init__(self, settings: object = None, context: Context | None = None) -> None:
        self.seen: list[tuple[str, int]] = []

    def handle(self, port: str, message: Sample) -> Emitted:
        assert isinstance(message, Imu)
        if message.gyro[0] < 0:
            raise Refused(f"gyro x is {message.gyro[0]}; this operator wants it positive")
        self.seen.append((port, message.stamp))
        if port == "a":
            yield "speed", speed(message.stamp, message.gyro[0])

    def finish(self) -> Emitted:
        yield "speed", speed(END - 1, 0.0)


def speed(stamp: int, value: float) -> GroundSpeed:
    return GroundSpeed(stamp=stamp, speed=value, quality=0.0, rays=1, valid=True)


def imu(stamp: int, seq: int, x: float = 1.0) -> Imu:
    return Imu(stamp=stamp, seq=seq, gyro=(x, 0.0, 0.0))


def stage(operator: Operator | None = None, *, awaited: bool = True, **overrides: object) -> Stage:
    inputs: Mapping[str, InputPlan] = {
        port: InputPlan(key=f"f/{port}/imu", schema="caneflow.Imu/1", writer=port, **overrides)  # type: ignore[arg-type]  # one override of a known field
        for port in ("a", "b")
    }
    outputs = {"speed": OutputPlan(key="f/echo/speed", schema="caneflow.GroundSpeed/1", awaited=awaited)}
    return Stage("echo", operator or Echo(), inputs, outputs)


def emitted(host: Stage, now: int | None = None) -> list[tuple[int, int]]:
    out = []
    while (step := host.step(now)) is not None:
        out += [(message.stamp, seq) for _, message, seq in step]
    return out


def test_outputs_are_numbered_and_the_end_is_passed_on() -> None:
    host = stage()
    for seq, stamp in enumerate((10, 20, 30)):
        host.offer("a", imu(stamp, seq))
    host.mark("b", PortMark(-1, END))
    assert emitted(host) == [(10, 0), (20, 1), (30, 2)]
    assert host.progress().handled == 30
    host.mark("a", PortMark(2, END))
    assert emitted(host) == [(END - 1, 3)]
    assert host.finished
    assert host.progress().ports["speed"] == PortMark(3, END)


def test_a_mark_counts_only_when_what_was_sent_before_it_has_come() -> None:
    host = stage()
    host.offer("a", imu(10, 0))
    host.mark("b", PortMark(0, 50))  # b sent its sample 0 before it said 50
    assert emitted(host) == []
    host.offer("b", imu(5, 0))
    assert emitted(host) == [(10, 0)]
    assert host.progress().handled == 10


@pytest.mark.parametrize("awaited", [True, False])
def test_how_far_it_has_come_is_said_at_once_only_where_a_reader_waits_for_it(awaited: bool) -> None:
    host = stage(awaited=awaited)
    host.offer("a", imu(10, 0))
    host.mark("b", PortMark(-1, 10))
    assert emitted(host) == [(10, 0)]
    assert not host.tells_more_than_samples(), "the sample at 10 says it"
    host.offer("b", imu(20, 0))
    host.mark("a", PortMark(0, 20))
    assert emitted(host) == []
    assert host.tells_more_than_samples() is awaited


def test_repeated_backwards_and_lost_samples_are_told_apart(caplog: pytest.LogCaptureFixture) -> None:
    host = stage()
    host.offer("a", imu(10, 0))
    host.offer("a", imu(10, 0))  # came again
    host.offer("a", imu(9, 1))  # time went back
    host.offer("a", imu(20, 5))  # 2, 3, 4 never came
    counts = host.input_counts()["a"]
    assert (counts.received, counts.repeated, counts.refused, counts.lost, counts.waiting) == (4, 1, 1, 3, 2)
    assert "time goes backwards" in caplog.text
    assert "3 samples lost before seq 5" in caplog.text


def test_a_writer_that_was_restarted_and_counts_anew_is_followed() -> None:
    host = stage()
    host.offer("a", imu(10, 7))
    host.offer("a", imu(20, 0))
    host.offer("a", imu(30, 1))
    counts = host.input_counts()["a"]
    assert (counts.lost, counts.repeated, counts.waiting) == (7, 0, 3)


def test_two_writers_on_one_key_are_named_and_nothing_counts_as_lost(caplog: pytest.LogCaptureFixture) -> None:
    host = stage()
    numbers = [(seq, 20 * seq) for seq in range(100)] + [(seq, 1510 + 20 * seq) for seq in range(25)]
    order = sorted(numbers, key=lambda number: number[1])  # from seq 76 of the first on they take turns
    for seq, stamp in order:
        host.offer("a", imu(stamp + 1, seq))
    counts = host.input_counts()["a"]
    assert (counts.received, counts.lost, counts.repeated, counts.refused) == (125, 0, 0, 0)
    assert counts.waiting == 125
    assert [line for line in caplog.text.splitlines() if "f/a/imu" in line] == [
        line for line in caplog.text.splitlines() if "two programs write on this key" in line
    ]
    assert "two programs write on this key (one is at seq 76, one at 1)" in caplog.text


def test_who_restarts_and_loses_a_sample_later_is_no_second_writer(caplog: pytest.LogCaptureFixture) -> None:
    host = stage()
    for seq in (*range(2000), *range(1999), 2000):
        host.offer("a", imu(1 + host.input_counts()["a"].received, seq))
    assert host.input_counts()["a"].lost == 1
    assert "two programs" not in caplog.text


@given(
    st.lists(st.tuples(st.integers(0, 12), st.integers(0, 30), st.booleans(), st.booleans()), max_size=40),
    st.booleans(),
)
def test_at_any_time_what_was_received_is_the_sum_of_what_became_of_it(
    steps: list[tuple[int, int, bool, bool]], patient: bool
) -> None:
    host = stage(length=3)
    host.inputs["a"].patient = patient
    host.mark("b", PortMark(-1, 25))
    for seq, stamp, negative, works in steps:
        host.offer("a", imu(stamp, seq, -1.0 if negative else 1.0))
        if works:
            host.step(None)
        counts = host.input_counts()["a"]
        became = counts.handled + counts.refused + counts.repeated + counts.dropped + counts.late + counts.left_out
        assert counts.received == became + counts.waiting


def test_a_sample_that_cannot_be_decoded_is_refused_once_not_lost_as_well() -> None:
    host = stage()
    host.mark("b", PortMark(-1, END))
    host.offer("a", imu(10, 0))
    host.refuse("a", MessageError("truncated"))
    host.mark("a", PortMark(1, END))  # the refused one was the last
    assert emitted(host) == [(10, 0), (END - 1, 1)]
    counts = host.input_counts()["a"]
    assert (counts.received, counts.handled, counts.refused, counts.lost) == (2, 1, 1, 0)


def test_each_cause_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    host = stage()
    for _ in range(5):
        host.refuse("a", MessageError("truncated"))
    host.refuse("a", MessageError("too large"))
    assert [r.levelno for r in caplog.records] == [logging.WARNING] * 2
    assert host.input_counts()["a"].refused == 6


def test_what_an_operator_refuses_is_counted_and_life_goes_on() -> None:
    host = stage()
    host.mark("b", PortMark(-1, END))
    host.offer("a", imu(10, 0, x=-1.0))
    host.offer("a", imu(20, 1))
    assert emitted(host) == [(20, 0)]
    counts = host.input_counts()["a"]
    assert (counts.handled, counts.refused) == (1, 1)


def test_what_comes_after_the_graph_went_on_is_late() -> None:
    host = stage()
    host.offer("a", imu(10, 0))
    assert emitted(host) == []
    assert host.held_by() == "b"
    host.go_on_without("b", until=10)
    assert emitted(host) == [(10, 0)]
    host.offer("b", imu(4, 0))
    host.offer("b", imu(12, 1))
    counts = host.input_counts()["b"]
    assert (counts.late, counts.waiting) == (1, 1)


def test_a_full_queue_drops_its_oldest_and_counts() -> None:
    host = stage(length=2)
    for seq in range(5):
        host.offer("a", imu(10 + seq, seq))
    host.mark("b", PortMark(-1, END))
    assert emitted(host) == [(13, 0), (14, 1)]
    assert host.input_counts()["a"].dropped == 3


def test_what_is_too_old_for_a_live_graph_is_dropped() -> None:
    host = stage(max_age_ms=1.0)
    host.mark("b", PortMark(-1, END))
    host.offer("a", imu(1_000_000, 0))
    host.offer("a", imu(2_500_000, 1))
    assert emitted(host, now=3_000_000) == [(2_500_000, 0)]
    assert host.input_counts()["a"].dropped == 1


NOW, LATER = 10**18, 10**18 + 60 * 10**9


def test_a_sample_from_the_future_is_refused_and_holds_nothing_up(caplog: pytest.LogCaptureFixture) -> None:
    host = stage()
    host.close("b")
    arrivals = host.inputs["a"]
    arrivals.patient = True
    assert arrivals.ahead_of(NOW + FAR_AHEAD, NOW) is None
    ahead = arrivals.ahead_of(LATER, NOW)
    assert ahead == 60 * 10**9
    host.offer("a", imu(NOW, 0))
    host.offer("a", imu(NOW + 2, 2))  # waits for 1
    host.refuse_ahead("a", imu(LATER, 1), ahead)
    host.refuse_ahead("a", imu(LATER, 1), ahead)  # came again
    host.refuse_ahead("a", imu(LATER, 3), ahead)
    host.offer("a", imu(NOW + 4, 4))
    assert emitted(host) == [(NOW, 0), (NOW + 2, 1), (NOW + 4, 2)]
    counts = host.input_counts()["a"]
    assert (counts.received, counts.handled, counts.refused, counts.lost) == (5, 3, 2, 0)
    assert host.progress().handled == NOW + 4
    (record,) = caplog.records
    assert record.message.startswith(
        "f/a/imu: refused: seq 1 is stamped 60.0 s ahead of the clock; at most 1 s is taken"
    )


def test_a_sample_from_the_future_after_a_gap_is_not_lost_as_well() -> None:
    host = stage()
    host.inputs["a"].patient = True
    host.offer("a", imu(NOW, 0))
    host.refuse_ahead("a", imu(LATER, 2), 60 * 10**9)
    host.offer("a", imu(NOW + 3, 3))
    assert host.inputs["a"].missing_before == 3
    host.skip_to("a", 3)
    counts = host.input_counts()["a"]
    assert (counts.lost, counts.refused, counts.waiting) == (1, 1, 2)


@pytest.mark.parametrize(("offset", "late", "taken"), [(0, 2.0, False), (2 * 10**9, 2.0, True), (None, 3600.0, True)])
def test_the_future_begins_on_the_writers_clock(offset: int | None, late: float, taken: bool) -> None:
    arrivals = stage().inputs["a"]
    arrivals.clock_offset = offset
    assert (arrivals.ahead_of(NOW + round(late * 1e9), NOW) is None) is taken
    assert arrivals.ahead_of(END, NOW) is None, "the end of a stream"
    assert arrivals.ahead_of(END - 1, NOW) is not None, "whatever is known of the clock"


def test_before_its_end_a_stage_promises_no_time_that_cannot_be() -> None:
    host = stage()
    host.offer("a", imu(10, 0))
    host.close("a")
    host.close("b")
    host.step()
    assert host.progress().ports["speed"] == PortMark(0, 10)
    assert emitted(host) == [(END - 1, 1)]
    assert host.progress().ports["speed"] == PortMark(1, END)


def test_missing_samples_do_not_hold_a_mark_for_ever() -> None:
    host = stage()
    host.mark("b", PortMark(-1, END))
    host.mark("a", PortMark(2, END))  # three samples were sent, none came
    assert emitted(host) == []
    host.skip_to("a", 3)
    assert emitted(host) == [(END - 1, 0)]
    assert host.input_counts()["a"].lost == 3


class Backwards(Echo):
    """Emits the same stamp twice: a bug in an operator."""

    def handle(self, port: str, message: Sample) -> Emitted:
        yield "speed", speed(message.stamp, 0.0)
        yield "speed", speed(message.stamp, 0.0)


def test_an_operator_whose_stamps_do_not_increase_is_a_bug_that_shows() -> None:
    host = stage(Backwards())
    host.mark("b", PortMark(-1, END))
    host.offer("a", imu(10, 0))
    with pytest.raises(DataflowError, match="stamp 10 after 10; stamps of one stream strictly increase"):
        emitted(host)


def arrivals() -> st.SearchStrategy[list[tuple[str, int, int, float]]]:
    """Port, step of the stamp, step of the number and gyro x of each sample: mostly next, some lost, old or refused."""
    step = st.sampled_from([1, 1, 1, 1, 1, 2, 0, -1])
    return st.lists(st.tuples(st.sampled_from("ab"), step, step, st.sampled_from([1.0, 1.0, -1.0])), max_size=30)


@given(arrivals(), st.lists(st.integers(0, 30), max_size=30), st.one_of(st.none(), st.integers(0, 10**9)))
def test_at_once_is_the_same_as_in_two_steps(
    coming: list[tuple[str, int, int, float]], marks: list[int], now: int | None
) -> None:
    """Whatever comes: the same follows, and the same is counted."""
    ways: list[tuple[Stage, list[tuple[int, int]]]] = [(stage(max_age_ms=1e-5), []) for _ in range(2)]
    at, seq = dict.fromkeys("ab", 0), dict.fromkeys("ab", -1)
    for k, (port, stamp_step, seq_step, x) in enumerate(coming):
        at[port] += stamp_step
        seq[port] = max(0, seq[port] + seq_step)
        message = imu(max(0, at[port]), seq[port], x)
        for quick, (host, found) in enumerate(ways):
            followed = host.handle_at_once(port, message, now) if quick else None
            if followed is None:
                host.offer(port, message)
                found += emitted(host, now)
            else:
                found += [(each.stamp, number) for _, each, number in followed]
            if k < len(marks):
                host.mark("b", PortMark(seq["b"] + 1 - marks[k] % 2, marks[k]))
                found += emitted(host, now)
    (slow, from_slow), (fast, from_fast) = ways
    assert from_fast == from_slow
    assert fast.input_counts() == slow.input_counts()
    assert fast.state() == slow.state()


def test_an_older_mark_does_not_replace_the_one_that_waits() -> None:
    host = stage()
    host.close("b")
    host.mark("a", PortMark(1, END))
    host.mark("a", PortMark(1, 15))
    host.offer("a", imu(10, 0))
    host.offer("a", imu(20, 1))
    emitted(host)
    assert host.finished


def resumed() -> Stage:
    """A stage that goes on from the state of another one, which handled two samples of `a` and none of `b`."""
    before, after = stage(), stage()
    before.mark("b", PortMark(-1, 20))
    before.offer("a", imu(10, 0))
    before.offer("a", imu(20, 1))
    assert emitted(before) == [(10, 0), (20, 1)]
    after.resume(before.state(), Echo())
    return after


def test_after_a_resume_time_does_not_go_back(caplog: pytest.LogCaptureFixture) -> None:
    host = resumed()
    host.close("b")
    host.offer("a", imu(20, 2))  # the next number, and a stamp that was handled before
    host.offer("a", imu(15, 3))
    assert "seq 2 has stamp 20, after 20" in caplog.text
    host.offer("a", imu(30, 4))
    assert emitted(host) == [(30, 2)]
    counts = host.input_counts()["a"]
    assert (counts.received, counts.handled, counts.refused, counts.late, counts.lost) == (3, 1, 2, 0, 0)


def test_after_a_resume_what_was_handled_before_is_known_as_such() -> None:
    host = resumed()
    host.close("b")
    host.offer("a", imu(20, 1), again=True)
    host.offer("a", imu(20, 1))
    host.offer("a", imu(30, 2))
    assert emitted(host) == [(30, 2)]
    counts = host.input_counts()["a"]
    assert (counts.received, counts.repeated, counts.late, counts.lost) == (2, 1, 0, 0)


def test_after_a_resume_the_silence_before_the_next_sample_is_told(caplog: pytest.LogCaptureFixture) -> None:
    host = resumed()
    host.offer("a", imu(20 + 3 * SILENCE, 2))
    assert "nothing for 3.00 s before seq 2" in caplog.text


def test_after_a_resume_outputs_go_on_in_number_and_time() -> None:
    host = resumed()
    host.close("b")
    assert host.outputs["speed"].number(speed(30, 0.0)) == 2
    with pytest.raises(DataflowError, match="stamp 25 after 30"):
        host.outputs["speed"].number(speed(25, 0.0))
    with pytest.raises(DataflowError, match="stamp 20 after 20"):
        resumed().outputs["speed"].number(speed(20, 0.0))


def test_after_a_resume_an_input_that_had_nothing_yet_begins_with_its_first_sample() -> None:
    host = resumed()
    host.offer("b", imu(5, 0))
    assert emitted(host) == []
    assert host.input_counts()["b"].handled == 1, "the other one is known to have passed it"
    host.offer("a", imu(30, 2))
    host.offer("b", imu(30, 1))
    assert emitted(host) == [(30, 2)]
    assert host.input_counts()["b"].lost == 0


def test_a_finished_stage_stays_finished() -> None:
    before, after = stage(), stage()
    for port in ("a", "b"):
        before.close(port)
    assert emitted(before) == [(END - 1, 0)]
    after.resume(before.state(), Echo())
    assert emitted(after) == []
    assert after.finished
