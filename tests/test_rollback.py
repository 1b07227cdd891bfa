"""A sample that an operator cannot handle is refused, and the operator is what it was before, to the last bit."""

import contextvars
import logging
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caneflow.messages import GroundSpeed, Imu, Sample
from caneflow.messages.control import PortMark
from caneflow.runtime import Context, Emitted, Operator, Refused
from caneflow.runtime.plan import InputPlan, OutputPlan
from caneflow.runtime.stages import rollback
from caneflow.runtime.stages.merge import END
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.runtime.stages.snapshot import pack
from caneflow.runtime.stages.snapshot_keeper import SnapshotKeeper

GOOD, REFUSED, FAILS = 1.0, -1.0, 800.0  # of the gyro's x: exp(800) is not a number
SINGULAR, BUG, NUMPY, WRONG_OUTPUT, LATE, VALUE_ERROR = 801.0, 802.0, 803.0, 804.0, 805.0, 806.0


class Careless(Operator):
    """Changes its state, and only then finds out whether it can handle the sample; someone else's operator."""

    inputs = {"imu": Imu}
    outputs = {"speed": GroundSpeed}

    def __init__(self, settings: object = None, context: Context | None = None) -> None:
        self.count = 0
        self.track = np.zeros(3)
        self.recent: list[float] = []
        self.random = np.random.default_rng(7)
        self.scale = 1.0

    def handle(self, port: str, message: Sample) -> Emitted:
        assert isinstance(message, Imu)
        x = message.gyro[0]
        self.count += 1
        self.track += self.random.normal(size=3)
        self.recent.append(x)
        if x == REFUSED:
            raise Refused("not of this kind")
        if x == LATE:
            yield "speed", speed(message.stamp, 1.0)
        if x == SINGULAR:
            np.linalg.inv(np.zeros((2, 2)))
        if x == BUG:
            raise ZeroDivisionError("a bug")
        if x == VALUE_ERROR:
            int("a bug")
        if x == NUMPY:
            self.track *= np.float64(1e300)
            self.track *= np.float64(1e300)
        if x == WRONG_OUTPUT:
            yield "speed", speed(message.stamp, 1e30)
        if x in (FAILS, LATE):
            math.exp(800)
        yield "speed", speed(message.stamp, self.scale * float(self.track[0]) / 10 + self.count / 1e3)


def speed(stamp: int, value: float) -> GroundSpeed:
    return GroundSpeed(stamp=stamp, speed=value, quality=0.0, rays=1, valid=True)


def stage(operator: Operator | None = None) -> Stage:
    inputs = {"imu": InputPlan(key="f/imu/imu", schema="caneflow.Imu/1", writer="imu")}
    outputs = {"speed": OutputPlan(key="f/mine/speed", schema="caneflow.GroundSpeed/1", awaited=True)}
    return Stage("mine", operator or Careless(), inputs, outputs)


def imu(number: int, x: float) -> Imu:
    return Imu(stamp=1000 + number, seq=number, gyro=(x, 0.0, 0.0))


def given_to(host: Stage, values: list[float], first: int = 0) -> list[tuple[int, float, int]]:
    """What follows from samples with these values, numbered from `first`."""
    out = []
    for number, x in enumerate(values, start=first):
        host.offer("imu", imu(number, x))
        while (step := host.step()) is not None:
            out += [(each.stamp, each.speed, seq) for _, each, seq in step if isinstance(each, GroundSpeed)]
    return out


def state(host: Stage) -> bytes:
    return pack(host.operator, Careless.__module__)


@pytest.mark.parametrize(
    ("x", "said"),
    [
        (FAILS, "it makes the arithmetic fail: math range error"),
        (NUMPY, "it makes the arithmetic fail: overflow encountered in multiply"),
        (SINGULAR, "it makes the arithmetic fail: Singular matrix"),
        (WRONG_OUTPUT, "what follows from it is not a sample: speed is 1e+30; expected -100 to 100 m/s"),
        (LATE, "it makes the arithmetic fail: math range error"),
    ],
)
def test_a_sample_that_cannot_be_handled_changes_nothing(x: float, said: str, caplog: pytest.LogCaptureFixture) -> None:
    host = stage()
    given_to(host, [GOOD] * 5)
    before = state(host)
    assert given_to(host, [x, x], first=5) == []  # not even what was said before it failed
    assert state(host) == before
    counts = host.input_counts()["imu"]
    assert (counts.received, counts.handled, counts.refused) == (7, 5, 2)
    assert [record.message for record in caplog.records] == [
        f"f/imu/imu: refused: {said} (counted from now on, not repeated)"
    ]
    untroubled = stage()
    values = [speed for _, speed, _ in given_to(untroubled, [GOOD] * 8)]
    after = given_to(host, [GOOD] * 3, first=7)
    assert [speed for _, speed, _ in after] == values[5:]
    assert [seq for _, _, seq in after] == [5, 6, 7]


def test_a_sample_that_is_handled_at_once_likewise() -> None:
    host = stage()
    for number, x in enumerate([GOOD, FAILS, GOOD]):
        assert host.handle_at_once("imu", imu(number, x), None) is not None
    operator = host.operator
    assert isinstance(operator, Careless)
    assert operator.recent == [GOOD, GOOD]


@pytest.mark.parametrize(("x", "error"), [(BUG, ZeroDivisionError), (VALUE_ERROR, ValueError)])
def test_a_bug_of_the_program_is_not_the_samples_fault(x: float, error: type[Exception]) -> None:
    with pytest.raises(error):
        given_to(stage(), [GOOD, x])


@given(st.lists(st.sampled_from([GOOD, GOOD, REFUSED, FAILS, NUMPY, WRONG_OUTPUT, LATE]), max_size=40))
def test_whatever_comes_all_is_as_if_what_failed_had_never_come(values: list[float]) -> None:
    """Across packed states, and with what the operator itself refuses: that it may change its state by."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollback, "JOURNAL_LENGTH", 5)
        host, other = stage(), stage()
        right = [x for x in values if x in (GOOD, REFUSED)]
        got, expected = given_to(host, values), given_to(other, right)
        assert [each[1:] for each in got] == [each[1:] for each in expected]
        assert state(host) == state(other)


def test_what_is_remembered_is_bounded_in_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollback, "JOURNAL_BYTES", 3000)
    packed = []

    def counted(operator: object, module: str) -> bytes:
        packed.append(operator)
        return pack(operator, module)

    monkeypatch.setattr(rollback, "pack", counted)
    given_to(stage(), [GOOD] * 8)
    assert len(packed) == 3  # as it was built, and after each four of 768 bytes


class WithAFile(Careless):
    """Its state cannot be kept."""

    def __init__(self) -> None:
        super().__init__()
        self.file = Path(__file__).open()  # noqa: SIM115 - closed by the test


def test_an_operator_whose_state_cannot_be_kept_goes_on_and_says_so(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollback, "MOST_IN_A_ROW", 4)
    operator = WithAFile()
    try:
        host = stage(operator)
        assert len(given_to(host, [GOOD, FAILS, FAILS, FAILS, GOOD])) == 2
        said = [record.message for record in caplog.records if "undone" in record.message]
        assert len(said) == 1
        assert said[0].startswith("mine: what a refused sample has changed cannot be undone: state.file is a ")
        with pytest.raises(OverflowError):  # it can no longer handle any: the node ends, and begins again
            given_to(host, [FAILS] * 4, first=5)
    finally:
        operator.file.close()


class Poisoned(Careless):
    """Python's own products overflow without a word: what follows from every sample after that is not a sample."""

    def handle(self, port: str, message: Sample) -> Emitted:
        assert isinstance(message, Imu)
        if message.gyro[0] == FAILS:
            self.scale *= 1e300
            self.scale *= 1e300
            return ()
        return super().handle(port, message)


def test_an_operator_that_was_poisoned_in_silence_begins_again(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollback, "MOST_IN_A_ROW", 10)
    host = stage(Poisoned())
    assert len(given_to(host, [GOOD, GOOD, FAILS])) == 2
    assert given_to(host, [GOOD] * 10, first=3) == []
    assert "mine: 10 samples of imu in a row could not be handled; begins again" in caplog.text
    (first,) = given_to(stage(Poisoned()), [GOOD])
    (again,) = given_to(host, [GOOD], first=13)
    assert again[1:] == (first[1], 2)


def test_samples_that_nobody_could_handle_do_not_cost_the_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollback, "MOST_IN_A_ROW", 10)
    host = stage()
    given_to(host, [GOOD] * 3)
    before = state(host)
    assert given_to(host, [FAILS] * 25, first=3) == []
    assert state(host) == before


class Farewell(Careless):
    """Says two things at the end; the second cannot be said."""

    def finish(self) -> Emitted:
        yield "speed", speed(END - 2, 1.0)
        yield "speed", speed(END - 1, 1e30)


def test_what_cannot_be_said_at_the_end_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    host = stage(Farewell())
    host.mark("imu", PortMark(-1, END))
    step = host.step()
    assert step is not None
    assert [seq for _, _, seq in step] == [0]
    assert host.finished
    assert host.step() is None
    assert "mine: at its end: speed is 1e+30; expected -100 to 100 m/s" in caplog.text


def test_a_snapshot_holds_the_operator_as_it_is_after_a_refusal(tmp_path: Path) -> None:
    operator = Careless()
    host, keeper = stage(operator), SnapshotKeeper(tmp_path / "mine", operator)
    given_to(host, [GOOD, GOOD, FAILS, GOOD])
    snapshot = keeper.taken(host.state(), {"speed": []}, host.operator)
    assert snapshot is not None
    assert keeper.state == state(host)
    keeper.keep(snapshot)
    resumed = SnapshotKeeper(tmp_path / "mine", Careless()).resume()
    assert resumed is not None
    other = stage()
    other.resume(resumed.stage, resumed.operator)
    assert state(other) == state(host)
    assert given_to(other, [FAILS, GOOD], first=4) == given_to(host, [FAILS, GOOD], first=4)


def test_a_state_that_was_packed_for_a_snapshot_is_gone_on_from(monkeypatch: pytest.MonkeyPatch) -> None:
    host = stage()
    given_to(host, [GOOD] * 3)
    host.note_packed(state(host))
    handled: list[float] = []
    monkeypatch.setattr(Careless, "handle", _noted(handled))
    before = state(host)
    given_to(host, [FAILS], first=3)
    assert state(host) == before
    assert handled == [FAILS]  # and none before it again


def _noted(handled: list[float]) -> object:
    handle = Careless.handle

    def noted(self: Careless, port: str, message: Sample) -> Emitted:
        assert isinstance(message, Imu)
        handled.append(message.gyro[0])
        return handle(self, port, message)

    return noted


def test_numpy_raises_only_in_the_context_in_which_operators_run() -> None:
    def errors_there() -> str:
        rollback.let_overflow_raise()
        return np.geterr()["over"]

    here = contextvars.Context()
    assert here.run(np.geterr)["over"] == "warn"
    assert here.copy().run(errors_there) == "raise"
    assert here.run(np.geterr)["over"] == "warn"


@pytest.fixture(autouse=True)
def logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
