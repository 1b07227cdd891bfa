"""Whether a process that ended is started again: the policy by itself in virtual time, and what a failing node says."""

import errno
import sys

import pytest

from caneflow.errors import CaneflowError
from caneflow.runtime.dataflow.graph import Restart
from caneflow.runtime.dataflow.yaml_shape import RestartShape
from caneflow.runtime.hosts.launcher.restarts import Again, Failed, How, Restarts
from caneflow.runtime.hosts.process import last_words
from caneflow.runtime.hosts.process.last_words import LastWords, telling_failures, words_of

DEFAULT = Restart(**RestartShape().model_dump())


def lives(restarts: Restarts, up_s: float, starting_s: float = 0.1, most: int = 1000) -> tuple[float, list[float], str]:
    """A node that fails each time after it was up for `up_s`: when (s) it is given up, the delays, and why."""
    now, delays = 0.0, list[float]()
    while len(delays) < most:
        now += starting_s
        restarts.ready(now)
        now += up_s
        verdict = restarts.ended(now, f"sample {len(delays)}", How.FAULT)
        if isinstance(verdict, Failed):
            return now, delays, verdict.why
        delays.append(verdict.delay_s)
        now += verdict.delay_s
    return now, delays, ""


@pytest.mark.parametrize("up_s", [0.0, 0.43, 1.0, 5.0, 59.9])
def test_with_the_defaults_a_node_is_given_up_after_ten_restarts_however_long_it_lives_each_time(up_s: float) -> None:
    given_up, delays, why = lives(Restarts(DEFAULT, replay=False), up_s)
    assert delays == [0.25, 0.5, 1, 2, 4, 8, 10, 10, 10, 10]
    assert given_up == pytest.approx(55.75 + 11 * (0.1 + up_s))
    assert why == "given up, it was never up for 60 s"


def test_a_node_that_is_up_for_the_window_is_started_again_without_end_and_soon() -> None:
    _, delays, why = lives(Restarts(DEFAULT, replay=False), up_s=60.0, most=100)
    assert (delays, why) == ([0.25] * 100, "")


def test_time_in_which_it_starts_or_waits_is_no_time_up() -> None:
    restarts = Restarts(DEFAULT, replay=False)
    for hour in range(10):
        assert isinstance(restarts.ended(3600.0 * hour, None, How.STOPPED), Again)
    assert isinstance(restarts.ended(36_000.0, None, How.STOPPED), Failed)


def test_an_end_counts_until_the_node_has_been_up_for_the_window_in_one_piece() -> None:
    restarts = Restarts(DEFAULT, replay=False)
    for begin in (0.0, 50.0, 100.0):
        restarts.ready(begin)
        restarts.ended(begin + 49.0, None, How.FAULT)
    assert restarts.counted == 3
    restarts.ready(150.0)
    restarts.ready(205.0)  # said again: it has been up since 150
    assert restarts.ended(210.0, None, How.FAULT) == Again(0.25)


def test_in_a_replay_the_second_fault_at_one_sample_is_final() -> None:
    restarts = Restarts(DEFAULT, replay=True)
    assert restarts.ended(1.0, "imu seq 7", How.FAULT) == Again(0.25)
    assert restarts.ended(2.0, "imu seq 8", How.FAULT) == Again(0.5)
    given_up = restarts.ended(3.0, "imu seq 8", How.FAULT)
    assert given_up == Failed("given up, it was the second time at the same sample (imu seq 8)")


def test_in_a_replay_kills_from_outside_at_one_sample_are_not() -> None:
    restarts = Restarts(DEFAULT, replay=True)
    assert isinstance(restarts.ended(0.0, "imu seq 7", How.FAULT), Again)
    for kill in range(9):
        assert isinstance(restarts.ended(float(kill), "imu seq 7", How.STOPPED), Again)
    assert isinstance(restarts.ended(10.0, "imu seq 7", How.STOPPED), Failed)


def test_before_its_first_sample_a_node_may_fail_more_often() -> None:
    """A device that is not there yet, in a replay through it."""
    restarts = Restarts(DEFAULT, replay=True)
    assert [type(restarts.ended(0.0, None, How.FAULT)) for _ in range(11)] == [Again] * 10 + [Failed]


def test_live_a_sample_comes_only_once() -> None:
    restarts = Restarts(DEFAULT, replay=False)
    assert [type(restarts.ended(0.0, "imu seq 7", How.FAULT)) for _ in range(11)] == [Again] * 10 + [Failed]


def test_what_lasts_and_what_is_not_to_be_restarted_is_given_up_at_once() -> None:
    assert Restarts(DEFAULT, replay=False).ended(0.0, None, How.LASTING) == Failed("a restart would not mend it")
    never = Restart(**RestartShape(policy="never").model_dump())
    assert Restarts(never, replay=False).ended(0.0, None, How.STOPPED) == Failed("")


def test_a_thousand_restarts_wait_no_longer_than_the_longest_delay() -> None:
    patient = Restart(**RestartShape(max_restarts=1000, delay_s=3600.0, max_delay_s=3600.0).model_dump())
    _, delays, _ = lives(Restarts(patient, replay=False), up_s=0.0)
    assert delays == [3600.0] * 1000


def raised(error: BaseException, cause: BaseException | None = None) -> BaseException:
    try:
        raise error from cause
    except BaseException as caught:
        return caught


NO_PACKAGE = ModuleNotFoundError("No module named 'x'")
NO_DEVICE = OSError(errno.ENODEV, "no device")


@pytest.mark.parametrize(
    ("error", "lasting"),
    [
        (raised(NO_PACKAGE), True),
        (raised(ValueError("a setting")), True),
        (raised(CaneflowError("rig.boresight: is missing")), True),
        (raised(MemoryError()), True),
        (raised(CaneflowError("pyserial is not installed"), cause=NO_PACKAGE), True),
        (raised(NO_DEVICE), False),
        (raised(TimeoutError("no answer")), False),
        (raised(CaneflowError("imu: no device"), cause=NO_DEVICE), False),
        (raised(CaneflowError("imu: no device"), cause=raised(CaneflowError("no device"), cause=NO_DEVICE)), False),
        (raised(KeyboardInterrupt()), False),
    ],
)
def test_what_fails_while_a_node_is_built_lasts_unless_the_system_refused_it(
    error: BaseException, lasting: bool
) -> None:
    assert words_of(error, building=True, at=None).lasting is lasting
    assert words_of(error, building=False, at="imu seq 7").lasting is (NO_PACKAGE in (error, error.__cause__))


def test_a_bug_is_told_with_its_traceback_an_expected_error_without() -> None:
    words = words_of(raised(ZeroDivisionError("a bug\nin two lines")), building=False, at="imu seq 7")
    assert words.error == "ZeroDivisionError: a bug in two lines"
    assert words.traceback[0] == "Traceback (most recent call last):"
    assert words.traceback[-1].strip() == "raise error from cause"
    assert words.lines == (*words.traceback, words.error)

    words = words_of(raised(CaneflowError("no radar at 10.0.0.1")), building=False, at=None)
    assert words.lines == ("ERROR no radar at 10.0.0.1",)


def test_one_bug_has_one_place_whatever_it_says_and_wherever_it_is_called_from() -> None:
    def again() -> BaseException:
        return raised(ZeroDivisionError("another number"))

    assert (
        words_of(again(), building=False, at=None).place
        == words_of(raised(ZeroDivisionError("a number")), building=False, at="imu seq 7").place
    )
    assert (
        words_of(raised(KeyError(1)), building=False, at=None).place != words_of(again(), building=False, at=None).place
    )


@pytest.mark.parametrize(
    ("end", "status", "said"),
    [
        (RuntimeError("no more"), 1, "RuntimeError: no more"),
        (CaneflowError("no more"), 2, "ERROR no more"),
        (SystemExit(7), 7, "SystemExit: 7"),
        (SystemExit(), None, "SystemExit: 0"),
    ],
)
def test_the_last_words_are_one_line_that_the_launcher_understands(
    capfd: pytest.CaptureFixture[str], end: BaseException, status: int | None, said: str
) -> None:
    sys.stdout.write("half a line")
    with pytest.raises(SystemExit) as ended, telling_failures(), telling_failures(at=lambda: "imu seq 7"):
        raise end
    assert ended.value.code == status
    text = "".join(capfd.readouterr())
    (words,) = filter(None, map(last_words.heard, text.splitlines()))
    assert (words.error, words.at, words.lasting) == (said, "imu seq 7", False)


def test_any_other_line_is_for_people() -> None:
    for line in ("", "INFO all well", last_words.MARK, f"{last_words.MARK}{{}}", f"{last_words.MARK}[1"):
        assert last_words.heard(line) is None
    words = LastWords(error="e", place="p")
    assert words.lines == ("e",)
