"""A sink behind its streams: what is missing, repeated or unreadable is told apart; it goes on after a resume."""

from caneflow.messages import Imu, MessageError, Sample
from caneflow.messages.control import PortMark
from caneflow.runtime.plan import InputPlan
from caneflow.runtime.program import Sink
from caneflow.runtime.stages.sink_stage import Tap


class Kept(Sink):
    """Remembers the stamps that it was handed."""

    def __init__(self) -> None:
        self.stamps: list[int] = []

    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        self.stamps.append(message.stamp)

    def idle(self, time: int) -> None: ...

    def finish(self) -> None: ...


def tap(*, patient: bool = False) -> tuple[Tap, Kept]:
    kept = Kept()
    made = Tap("recorder", kept, {"imu": InputPlan(key="f/imu/imu", schema="caneflow.Imu/1", writer="imu")})
    made.inputs["imu"].patient = patient
    return made, kept


def offer(to: Tap, seq: int, stamp: int) -> None:
    to.offer("imu", Imu(stamp=stamp, seq=seq, gyro=(0.0, 0.0, 0.0)), b"", 0)


def test_after_a_resume_neither_numbers_nor_time_go_back() -> None:
    before, _ = tap()
    offer(before, 0, 10)
    offer(before, 1, 20)
    after, kept = tap()
    after.resume(before.state())
    offer(after, 1, 20)  # once more: it had come
    offer(after, 2, 15)  # the next number, and a time that has passed
    offer(after, 4, 40)
    counts = after.input_counts()["imu"]
    assert kept.stamps == [40]
    assert (counts.received, counts.repeated, counts.refused, counts.lost) == (3, 1, 1, 1)


def test_what_cannot_be_read_and_what_was_given_up_are_counted_once_each() -> None:
    host, kept = tap(patient=True)
    offer(host, 0, 10)
    host.refuse("imu", MessageError("no msgpack"))  # seq 1
    offer(host, 3, 40)  # seq 2 is missing and is waited for
    assert kept.stamps == [10]
    host.skip_to("imu", 3, 0)
    assert kept.stamps == [10, 40]
    offer(host, 5, 60)  # seq 4 is missing: the unreadable one, which is made up for, does not stand for it
    assert kept.stamps == [10, 40]
    host.mark("imu", PortMark(5, 60))
    host.skip_to("imu", 5, 0)
    counts = host.input_counts()["imu"]
    assert kept.stamps == [10, 40, 60]
    assert (counts.refused, counts.lost) == (1, 2)
