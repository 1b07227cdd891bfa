"""Budgets in bytes: what a node holds of what it sent and of what came is bounded; a replay loses nothing by it."""

import queue
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from caneflow.messages import DopplerTarget, GroundSpeed, Pose, RadarFrame, Sample, numbered, sample_key
from caneflow.messages.control import PortMark
from caneflow.recording import RecordingWriter
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.deployment import deploy
from caneflow.runtime.hosts.process.inbox import Inbox
from caneflow.runtime.plan import InputPlan
from caneflow.runtime.stages.byte_budget import (
    CONTROL,
    INBOX,
    PER_MESSAGE,
    PER_SAMPLE,
    SENT,
    WAITING,
    share,
    weight,
    weight_of,
)
from caneflow.runtime.stages.merge import END
from caneflow.runtime.stages.sent_samples import History
from caneflow.runtime.stages.streams import CAUSES_NAMED, LONGEST_CAUSE, Arrivals
from tests.flows import launchers
from tests.test_operator_stage import emitted, imu, stage

MB = 10**6
BARE = 80 * MB  # what a node takes that holds nothing
SHARED_MEMORY = 16 * 2**20  # bytes: Zenoh's pool of a process that sends large samples


def frame(stamp: int, scans: int = 1, bins: int = 96) -> RadarFrame:
    return RadarFrame(
        stamp=stamp,
        scans=np.zeros((scans, bins), np.int32),
        scan_period=0.01,
        range_start=0.5,
        range_step=0.009,
        carrier=4.3e9,
        bandwidth=1.7e9,
    )


def test_all_budgets_of_a_node_together_leave_it_below_250_mb() -> None:
    snapshot = 3 * SENT  # what was sent is in it; while it grows, it is there twice
    assert BARE + SHARED_MEMORY + SENT + snapshot + WAITING + INBOX + CONTROL < 250 * MB


@pytest.mark.parametrize(
    ("message", "beyond"),
    [
        (imu(1, 0), 0),
        (frame(1, 64, 4096), 64 * 4096 * 4),
        (GroundSpeed(stamp=1, speed=1.0, quality=0.0, rays=1, valid=True), 0),
    ],
)
def test_a_message_weighs_what_its_arrays_do_and_a_little(message: Sample, beyond: int) -> None:
    assert weight_of(message) == PER_MESSAGE + beyond


def test_a_decoded_sample_weighs_less_than_twice_what_it_weighs_as_it_is_sent() -> None:
    """So a reader has room for whatever its writers may send before it confirms."""
    assert WAITING >= 2 * SENT
    assert INBOX >= 2 * SENT
    pose = Pose(
        stamp=1, position=(0.0,) * 3, velocity=(0.0,) * 3, orientation=(1.0, 0.0, 0.0, 0.0), method="m",
        covariance=np.eye(6),
    )  # fmt: skip
    target = DopplerTarget(stamp=1, range_rate=0.0, signed=True, amplitude=0.0, snr=0.0, valid=False)
    for message in (imu(1, 0), frame(1), frame(1, 64, 4096), pose, target):
        assert weight_of(message) < 2 * weight(numbered(message, 0))


# --- what was sent ------------------------------------------------------------------------------------------------


def kept(history: History) -> list[int]:
    return [each.seq for each in history.kept()["out"]]


def test_live_the_oldest_are_let_go_when_the_budget_is_used_up() -> None:
    history = History({"out": ["reader"]}, {"out": 3 * (PER_SAMPLE + 1000)})
    for seq in range(5):
        history.keep("out", seq, bytes(1000))
    assert kept(history) == [2, 3, 4]
    assert history.let_go == 2
    assert history.first("out") == 2
    assert history.held == 3 * (PER_SAMPLE + 1000)
    assert not history.full
    history.keep("out", 5, bytes(10**6))
    assert kept(history) == [5], "one is kept, however large"


def test_in_a_replay_nothing_is_let_go_and_the_writer_is_told_to_wait() -> None:
    history = History({"out": ["a", "b"]}, {"out": 3 * (PER_SAMPLE + 1000)}, waits=True)
    for seq in range(3):
        history.keep("out", seq, bytes(1000))
        assert not history.full
    history.keep("out", 3, bytes(1000))
    assert history.full == {"out"}
    history.confirm("out", "a", 3)
    assert history.full == {"out"}, "b has not"
    history.confirm("out", "b", 0)
    assert not history.full
    assert kept(history) == [1, 2, 3]
    assert history.let_go == 0


def test_an_older_word_of_a_reader_takes_nothing_back() -> None:
    history = History({"out": ["reader"]})
    for seq in range(5):
        history.keep("out", seq, b"")
    history.confirm("out", "reader", 2)
    history.confirm("out", "reader", 1)  # on its way for longer, or from a process that was started again
    history.keep("out", 5, b"")
    history.confirm("out", "reader", 3)
    assert kept(history) == [4, 5]
    history.confirm("out", "reader", 0)
    history.confirm("out", "nobody", 5)
    assert kept(history) == [4, 5]
    assert history.held == 2 * PER_SAMPLE


def test_readers_that_confirm_in_turn_keep_what_the_slower_may_ask_for() -> None:
    history = History({"out": ["fast", "slow"]})
    for seq in range(6):
        history.keep("out", seq, b"")
    history.confirm("out", "slow", 3)
    history.confirm("out", "slow", 1)  # said before, heard after
    history.confirm("out", "fast", 5)
    assert kept(history) == [4, 5], "the slow one has said that it is sure of 3"


# --- what waits ---------------------------------------------------------------------------------------------------


def test_samples_that_wait_for_another_input_are_dropped_beyond_the_budget_the_oldest_first() -> None:
    host = stage()
    host.bound(2 * 3 * PER_MESSAGE)  # of two inputs
    for seq in range(5):
        host.offer("a", imu(10 + seq, seq))
    assert host.held == 3 * PER_MESSAGE
    host.close("b")
    assert emitted(host) == [(12, 0), (13, 1), (14, 2)]
    assert host.held == 0
    counts = host.input_counts()["a"]
    assert (counts.received, counts.dropped, counts.handled) == (5, 2, 3)
    assert [(note.reason, note.first_seq) for note in host.left_out()] == [("dropped", 0), ("dropped", 1)]


def test_what_is_missing_is_given_up_when_the_samples_after_it_use_up_the_budget() -> None:
    host = stage()
    host.close("b")
    host.bound(2 * 3 * PER_MESSAGE)
    arrivals = host.inputs["a"]
    arrivals.patient = True
    for seq in (2, 3, 5):
        host.offer("a", imu(10 + seq, seq))
    assert emitted(host) == []
    assert host.held == 3 * PER_MESSAGE
    host.offer("a", imu(17, 7))
    assert emitted(host) == [(12, 0), (13, 1)]
    assert host.input_counts()["a"].lost == 2
    assert arrivals.missing_before == 5, "what waited is not forgotten"
    host.offer("a", imu(14, 4))
    assert emitted(host) == [(14, 2), (15, 3)]
    host.offer("a", imu(16, 6))
    assert emitted(host) == [(16, 4), (17, 5)]
    assert host.held == 0


def test_the_names_of_causes_are_bounded(caplog: pytest.LogCaptureFixture) -> None:
    arrivals = Arrivals("echo", "a", InputPlan(key="f/a/imu", schema="caneflow.Imu/1", writer="a"))
    for number in range(2 * CAUSES_NAMED):
        arrivals.refuse("y" * (number % LONGEST_CAUSE) + " " + "x" * 10**5)
    assert arrivals.counts.refused == 2 * CAUSES_NAMED
    assert len(caplog.records) == CAUSES_NAMED
    assert max(len(record.getMessage()) for record in caplog.records) < LONGEST_CAUSE + 100


def test_a_cause_is_named_once_whatever_its_numbers(caplog: pytest.LogCaptureFixture) -> None:
    arrivals = Arrivals("echo", "a", InputPlan(key="f/a/imu", schema="caneflow.Imu/1", writer="a"))
    for found in ("1e+200", "-12.5", "nan", "-inf", "7"):
        arrivals.refuse(f"gyro is ({found}, 0.0, 0.0); expected -10000 to 10000 rad/s")
    arrivals.refuse("accel is (1e+200, 0.0, 0.0); expected -4000 to 4000 m/s^2")
    assert arrivals.counts.refused == 6
    assert [record.getMessage().split()[2] for record in caplog.records] == ["gyro", "accel"]


def test_samples_that_were_dropped_unseen_are_counted_and_said(caplog: pytest.LogCaptureFixture) -> None:
    host = stage()
    host.inputs["a"].drop_unseen(7)
    host.inputs["a"].drop_unseen(2)
    counts = host.input_counts()["a"]
    assert (counts.received, counts.dropped) == (9, 9)
    assert "7 samples dropped unseen" in caplog.text
    assert len(caplog.records) == 1


def test_unreadable_samples_of_a_flood_are_not_lost_as_well() -> None:
    host = stage()
    host.close("b")
    host.offer("a", imu(10, 0))
    for _ in range(1000):
        host.inputs["a"].refuse_unreadable(ValueError("no sample"))  # type: ignore[arg-type]  # any error
    host.offer("a", imu(20, 3))
    host.mark("a", PortMark(3, END))
    emitted(host)
    counts = host.input_counts()["a"]
    assert (counts.refused, counts.lost, counts.received) == (1000, 0, 1002)


# --- what was not looked at ---------------------------------------------------------------------------------------


def drained(inbox: Inbox[int]) -> Iterator[int]:
    try:
        while True:
            yield inbox.get_nowait()
    except queue.Empty:
        return


@pytest.mark.parametrize(("oldest_first", "stay"), [(True, [0, 4, 3, 5]), (False, [4, 3, 0])])
def test_an_inbox_keeps_to_its_budget(oldest_first: bool, stay: list[int]) -> None:
    """An event weighs what it is, nothing is an order of ours."""
    dropped: list[int] = []
    inbox: Inbox[int] = Inbox(12, lambda event: event, dropped.append, oldest_first=oldest_first)
    if oldest_first:
        for event in (6, 0, 4, 3, 5):
            inbox.put(event)
        assert dropped == [6]
        assert sorted(drained(inbox)) == sorted(stay)
    else:
        for event in (4, 3, 0):
            inbox.put(event)
        assert dropped == []
        inbox.put(9)  # begun while there was room
        inbox.put(1)
        assert dropped == [1]
        assert list(drained(inbox)) == [4, 3, 0, 9]
    assert inbox.held == 0
    assert inbox.empty()


def test_a_flood_of_orders_of_ours_is_never_dropped() -> None:
    dropped: list[int] = []
    inbox: Inbox[int] = Inbox(10, lambda event: event, dropped.append, oldest_first=True)
    for _ in range(1000):
        inbox.put(0)
    inbox.put(11)
    assert dropped in ([], [11])
    assert len(list(drained(inbox))) >= 1000


# --- the plan, and a replay ---------------------------------------------------------------------------------------

LARGE = """
import resource
import time
from pathlib import Path
from caneflow.messages import GroundSpeed, RadarFrame
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class Slow(Operator):
    inputs = {"frame": RadarFrame}
    outputs = {"frame": RadarFrame}

    def __init__(self, settings, context):
        self.state = STATE

    def handle(self, port, message):
        time.sleep(SECONDS)
        yield "frame", message

    def finish(self):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        Path(__file__).with_suffix(".peak").write_text(str(peak))
        return ()

if __name__ == "__main__":
    run(Slow)
"""
SOURCE = """
from caneflow.messages import RadarFrame
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Camera(Source):
    outputs = {"frame": RadarFrame}

    def __init__(self, settings, context): ...

    def samples(self):
        yield from ()

if __name__ == "__main__":
    run(Camera)
"""
FRAMES = 120  # of 1 MB, within the window of 5 s of a replay


@pytest.fixture
def large(tmp_path: Path) -> tuple[Path, Path]:
    """A flow of 1 MB frames through two operators, of which the second is slow, and a recording for it."""
    (tmp_path / "camera.py").write_text(SOURCE)
    for name, seconds in (("quick", 0), ("slow", 0.02)):
        (tmp_path / f"{name}.py").write_text(LARGE.replace("SECONDS", str(seconds)).replace("STATE", "0"))
    flow = re.sub(r"\W", "_", tmp_path.name)
    file = tmp_path / "large.yaml"
    file.write_text(
        f"flow: {flow}\nnodes:\n  camera: {{run: ./camera.py}}\n"
        "  quick: {run: ./quick.py, inputs: {frame: camera/frame}}\n"
        "  slow: {run: ./slow.py, inputs: {frame: quick/frame}}\nresults: [slow/frame]\n"
    )
    recording = tmp_path / "large.mcap"
    key = sample_key(flow, "camera", "frame")
    with RecordingWriter(recording, flow=flow, source="simulated", rig={}) as writer:
        for seq in range(FRAMES):
            stamp = 10**9 + seq * 25_000_000
            payload = numbered(frame(stamp, 64, 4096), seq)
            writer.write(key, RadarFrame, payload, stamp=stamp, seq=seq, log_time=stamp)
    return file, recording


@pytest.mark.parametrize("state", ["0", "iter(())"], ids=["that can be kept", "that no snapshot can hold"])
def test_a_replay_of_large_frames_with_a_slow_reader_loses_nothing_and_stays_below_250_mb(
    state: str, tmp_path: Path, large: tuple[Path, Path]
) -> None:
    file, recording = large
    for program in (file.with_name("quick.py"), file.with_name("slow.py")):
        program.write_text(program.read_text().replace("self.state = 0", f"self.state = {state}"))
    with launchers() as launch:
        running = launch("run", file, "--replay", recording, "--speed", "max", log=tmp_path / "log")
        assert running.ends() == 0, running.said
    said = [line for line in running.said.splitlines() if "WARNING" in line]
    assert all("cannot be brought back exactly after a kill" in line for line in said)
    assert len(said) == (0 if state == "0" else 2)
    assert f"slow: {FRAMES} x frame" in running.said
    for name in ("quick", "slow"):
        assert int((tmp_path / f"{name}.peak").read_text()) < 250 * MB, name


def test_both_ends_of_a_wire_know_the_same_budget(large: tuple[Path, Path]) -> None:
    file, _ = large
    plans = deploy(load(file), record=file.with_name("out.mcap")).plans
    budgets = {name: plan.outputs["frame"].budget for name, plan in plans.items() if plan.outputs}
    assert budgets == dict.fromkeys(("camera", "quick", "slow"), share(SENT, 3)), "the recorder reads three"
    for plan in plans.values():
        for wire in plan.inputs.values():
            assert wire.budget == budgets[wire.writer]
