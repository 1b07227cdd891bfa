"""Event-time merging: the order depends on stamps alone, whatever arrives when."""

from hypothesis import given
from hypothesis import strategies as st

from caneflow.messages import Imu
from caneflow.runtime.stages.merge import END, Merge


def sample(stamp: int) -> Imu:
    return Imu(stamp=stamp, gyro=(0.0, 0.0, 0.0))


def drained(merge: Merge) -> list[tuple[str, int]]:
    out = []
    while (due := merge.pop()) is not None:
        out.append((due[0], due[1].stamp))
    return out


def test_a_sample_waits_for_the_other_streams() -> None:
    merge = Merge(["a", "b"])
    merge.push("a", sample(10))
    assert merge.pop() is None
    assert merge.held_by() == "b"
    merge.push("b", sample(11))
    assert drained(merge) == [("a", 10)]
    assert merge.held_by() == "a"


def test_equal_stamps_go_in_port_order() -> None:
    merge = Merge(["a", "b", "c"])
    for port in ("c", "a", "b"):
        merge.push(port, sample(5))
    assert drained(merge) == [("a", 5), ("b", 5), ("c", 5)]


def test_an_earlier_port_may_still_bring_the_same_stamp() -> None:
    merge = Merge(["a", "b"])
    merge.push("b", sample(5))
    merge.advance("a", 4)
    assert merge.pop() is None  # a may still bring 5, and a goes first
    merge.advance("a", 5)
    assert drained(merge) == [("b", 5)]


def test_a_later_port_holds_nothing_up_at_the_same_stamp() -> None:
    merge = Merge(["a", "b"])
    merge.push("a", sample(5))
    merge.advance("b", 4)
    assert drained(merge) == [("a", 5)]


def test_a_stream_that_never_speaks_but_ends_holds_nobody_up() -> None:
    merge = Merge(["a", "b"])
    merge.push("a", sample(5))
    merge.advance("b", END)
    assert drained(merge) == [("a", 5)]
    merge.advance("a", END)
    assert merge.handled() == END


def test_handled_is_what_can_cause_nothing_any_more() -> None:
    merge = Merge(["a", "b"])
    merge.push("a", sample(7))
    merge.advance("b", 3)
    assert merge.handled() == 3
    merge.advance("b", 100)
    assert merge.handled() == 6  # the sample at 7 still waits to be popped
    drained(merge)
    assert merge.handled() == 7


streams = st.lists(st.lists(st.integers(0, 50), max_size=12, unique=True).map(sorted), min_size=1, max_size=4)


@given(streams, st.randoms(use_true_random=False))
def test_every_arrival_order_gives_the_sorted_order(stamps: list[list[int]], random: object) -> None:
    """The slow, obvious version: sort everything by (stamp, port)."""
    ports = [f"p{i}" for i in range(len(stamps))]
    waiting = {port: list(values) for port, values in zip(ports, stamps, strict=True)}
    merge, got = Merge(ports), []
    while waiting:
        port = random.choice(sorted(waiting))  # type: ignore[attr-defined]  # hypothesis hands out a random.Random
        if waiting[port]:
            merge.push(port, sample(waiting[port].pop(0)))
        else:
            del waiting[port]
            merge.advance(port, END)
        got += drained(merge)
    expected = sorted((stamp, i) for i, values in enumerate(stamps) for stamp in values)
    assert got == [(f"p{i}", stamp) for stamp, i in expected]


@given(
    marks=st.lists(st.integers(-1, 12), min_size=1, max_size=3),
    waiting=st.lists(st.booleans(), min_size=3, max_size=3),
    at=st.integers(0, 2),
    stamp=st.integers(0, 12),
)
def test_a_sample_that_passes_by_is_one_that_would_be_handed_on_next(
    marks: list[int], waiting: list[bool], at: int, stamp: int
) -> None:
    ports = ["a", "b", "c"][: len(marks)]
    port = ports[at % len(ports)]

    def made() -> Merge:
        merge = Merge(ports)
        for each, mark, holds in zip(ports, marks, waiting, strict=False):
            if holds and mark >= 0:
                merge.push(each, sample(mark))
            else:
                merge.advance(each, mark)
        return merge

    slow, quick = made(), made()
    empty = not any(slow.waiting(each) for each in ports)
    if stamp > slow.watermark(port):
        slow.push(port, sample(stamp))
        due = slow.pop() if empty else None
        expected = due is not None
    else:
        expected = False
    assert quick.pass_by(port, stamp) is expected
    if expected:
        assert [quick.watermark(each) for each in ports] == [slow.watermark(each) for each in ports]
        assert quick.handled() == slow.handled()
