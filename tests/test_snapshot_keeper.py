"""A snapshot is a luxury: one that cannot be written or read is one line, and the operator works without."""

import errno
import logging
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from caneflow.messages import GroundSpeed, Imu, Sample, numbered
from caneflow.runtime import Context, Emitted, Operator
from caneflow.runtime.hosts.process.events import Arrived, Event
from caneflow.runtime.hosts.process.process import Process
from caneflow.runtime.plan import InputPlan, NodePlan, OutputPlan, ProcessPlan
from caneflow.runtime.stages.references import SnapshotError
from caneflow.runtime.stages.snapshot_keeper import LAYOUT, Snapshot, SnapshotKeeper

INPUT = InputPlan(key="f/imu/imu", schema="caneflow.Imu/1", writer="imu")
OUTPUT = OutputPlan(key="f/adder/speed", schema="caneflow.GroundSpeed/1", readers=("reader",), awaited=False)


class Adder(Operator):
    """Says the sum of what it was told so far."""

    inputs = {"imu": Imu}
    outputs = {"speed": GroundSpeed}

    def __init__(self, settings: object = None, context: Context | None = None) -> None:
        self.total = 0.0
        self.seen: list[int] = []

    def handle(self, port: str, message: Sample) -> Emitted:
        assert isinstance(message, Imu)
        self.total += message.gyro[0]
        self.seen.append(message.seq)
        yield "speed", GroundSpeed(stamp=message.stamp, speed=self.total, quality=0.0, rays=1, valid=True)


class Unkeepable(Adder):
    """Holds what no snapshot can."""

    def __init__(self) -> None:
        super().__init__()
        self.lines = iter(())


class Bus:
    """What a node needs of a bus, without Zenoh."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def send(self, node: str, port: str, payload: bytes) -> None:
        self.sent.append(payload)

    def send_progress(self, progress: object) -> None: ...

    def send_marks(self, progress: object) -> None: ...

    def send_counters(self, counters: object) -> None: ...

    def ask_again(self, node: str, port: str, first: int) -> None: ...

    def pending(self) -> bool:
        return False

    def declare_ready(self) -> None: ...

    def events(self, timeout: float | None) -> Iterator[Event]:
        raise ZeroDivisionError("a bug of the operator's")
        yield


Make = Callable[..., Any]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "run"
    made.mkdir(mode=0o700)
    return made


@pytest.fixture
def make(folder: Path) -> Make:
    """A new process in the place of the one before: a node that has looked for its snapshot."""

    def make(operator: Operator | None = None, *, replay: bool = False, folder: Path = folder) -> Any:
        plan = NodePlan(flow="f", node="adder", inputs={"imu": INPUT}, outputs={"speed": OUTPUT}, replay=replay)
        bus: Any = Bus()
        return Process(ProcessPlan.of(plan), bus, {"adder": operator or Adder()}, folder / "adder.snapshot")

    return make


def take(host: Any, *seqs: int) -> None:
    """Let the node handle samples, and keep a snapshot of what it has come to."""
    for seq in seqs:
        sample = Imu(stamp=10 * (seq + 1), gyro=(float(seq), 0.0, 0.0))
        host.take_sample_at_once(Arrived("adder", "imu", numbered(sample, seq), "caneflow.Imu/1"))
    host.recovery["adder"]._next = 0.0
    host.keep_snapshots()


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    said = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert not any("\n" in line for line in said)
    caplog.clear()
    return said


def test_a_new_process_goes_on_where_the_last_snapshot_was_taken(make: Make) -> None:
    host = make()
    take(host, 0, 1, 2)
    assert host.recovery["adder"].confirmed == {"f/imu/imu": 2}
    again = make()
    assert again.recovery["adder"].resume()
    assert again.stages["adder"].state() == host.stages["adder"].state()
    assert again.outputs["adder"].history.kept() == host.outputs["adder"].history.kept()
    assert again.recovery["adder"].confirmed == {"f/imu/imu": 2}
    take(again, 3)
    assert make().recovery["adder"].resume(), "its own snapshots hold the operator that came back"
    assert vars(again.stages["adder"]._operator) == {"total": 6.0, "seen": [0, 1, 2, 3]}


def test_without_a_snapshot_there_is_nothing_to_say(make: Make, caplog: pytest.LogCaptureFixture) -> None:
    assert not make().recovery["adder"].resume()
    assert warnings(caplog) == []


def changed(**fields: Any) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        snapshot = msgspec.msgpack.decode(data, type=Snapshot)
        return msgspec.msgpack.encode(msgspec.structs.replace(snapshot, **fields))

    return change


def other(**fields: Any) -> Callable[[bytes], bytes]:
    """The same in msgpack's own terms, to say what a Snapshot cannot."""

    def change(data: bytes) -> bytes:
        return msgspec.msgpack.encode({**msgspec.msgpack.decode(data), **fields})

    return change


def of_an_older_version(data: bytes) -> bytes:
    snapshot = msgspec.msgpack.decode(data)
    del snapshot["layout"]
    return msgspec.msgpack.encode(snapshot)


def operator(*packed: Any) -> bytes:
    return msgspec.msgpack.encode(list(packed))


ADDER = f"{__name__}:Adder"
STAGE = {"inputs": {"imu": [2, 30]}, "outputs": {"speed": [3, 30]}, "finished": False}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda _: b"", "damaged"),
        (lambda data: data[: len(data) // 2], "damaged"),
        (lambda data: data[:-1], "damaged"),
        (lambda data: data + b"x", "damaged"),
        (lambda _: b"\xc1" * 100, "damaged"),
        (lambda _: b"\xdf\xff\xff\xff\xff", "damaged"),
        (lambda _: b"\x91" * 100_000, "damaged"),
        (lambda _: b"\xa5\xff\xff\xff\xff\xff", "damaged"),
        (of_an_older_version, "layout 0"),
        (changed(layout=LAYOUT + 1), f"layout {LAYOUT + 1}"),
        (changed(version="0.0.1"), "caneflow 0.0.1"),
        (changed(program="m:Other"), "m:Other"),
        (other(stage={**STAGE, "inputs": {}}), "has the inputs none; expected imu"),
        (other(stage={**STAGE, "inputs": {"imu": [2, 30], "speed": [2, 30]}}), "expected imu"),
        (other(stage={**STAGE, "inputs": {"other": [2, 30]}}), "has the inputs other; expected imu"),
        (other(stage={**STAGE, "outputs": {"pose": [3, 30]}}, history={"pose": []}), "outputs pose; expected speed"),
        (other(stage={**STAGE, "inputs": {"imu": [-2, 30]}}), "damaged"),
        (other(stage={**STAGE, "inputs": {"imu": [2, 2**63]}}), "damaged"),
        (other(stage={**STAGE, "inputs": {"imu": [2]}}), "damaged"),
        (other(history={}), "its samples"),
        (other(history={"speed": [[0, "text"]]}), "damaged"),
        (other(operator=b""), "does not fit"),
        (other(operator=operator("object", 0, ADDER, ["total", 1.0])), "lacks the attribute seen"),
        (other(operator=operator("object", 0, f"{__name__}:Bus", ["sent", ["list", 1, []]])), "a Bus, not a Adder"),
        (other(operator=operator("table", 0, "dict", ["total", 1.0])), "a dict, not a Adder"),
        (other(operator=operator("struct", 0, "caneflow.command:os.system", ["command", "true"])), "os.system"),
        (other(operator=operator("object", 0, f"{__name__}:shutil.rmtree", [])), "rmtree"),
        (other(operator=operator("object", 0, "caneflow.no_such_module:Adder", [])), "no_such_module"),
        (other(operator=operator("object", 0, "caneflow.algorithms.no_such_module:Adder", [])), "not imported"),
    ],
)
def test_a_snapshot_that_does_not_fit_is_one_line_and_a_start_without(
    make: Make, folder: Path, caplog: pytest.LogCaptureFixture, change: Callable[[bytes], bytes], says: str
) -> None:
    take(make(), 0, 1, 2)
    file = folder / "adder.snapshot"
    file.write_bytes(change(file.read_bytes()))
    host = make()
    fresh = host.stages["adder"].state()
    assert not host.recovery["adder"].resume()
    (said,) = warnings(caplog)
    assert said.startswith("starts without its snapshot, which cannot be used: ")
    assert says in said
    assert host.stages["adder"].state() == fresh
    assert vars(host.stages["adder"]._operator) == {"total": 0.0, "seen": []}
    take(host, 0)
    assert vars(host.stages["adder"]._operator) == {"total": 0.0, "seen": [0]}
    assert make().recovery["adder"].resume(), "the next one is its own"


def test_what_is_no_file_is_no_snapshot(make: Make, folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    elsewhere = folder.parent / "elsewhere"
    take(make(), 0)
    (folder / "adder.snapshot").rename(elsewhere)
    (folder / "adder.snapshot").symlink_to(elsewhere)
    assert not make().recovery["adder"].resume()
    (folder / "adder.snapshot").unlink()
    os.mkfifo(folder / "adder.snapshot")
    assert not make().recovery["adder"].resume(), "nobody waits for someone to write"
    (folder / "adder.snapshot").unlink()
    (folder / "adder.snapshot").mkdir()
    host = make()
    assert not host.recovery["adder"].resume()
    assert len(warnings(caplog)) == 3
    take(host, 0)
    assert "cannot write a snapshot" in warnings(caplog)[0]


def test_a_folder_that_others_write_to_is_not_used(make: Make, folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    take(make(), 0)
    link = folder.parent / "link"
    link.symlink_to(folder)
    folder.chmod(0o770)
    for place in (folder, link, folder.parent / "gone"):
        assert not make(folder=place).recovery["adder"].resume()
        (said,) = warnings(caplog)
        assert said.startswith(f"keeps no snapshots: {place}: ")


def no_room(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("replay", [True, False])
def test_on_a_full_disk_the_operator_goes_on_and_confirms_nothing_that_is_not_kept(
    make: Make, folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, replay: bool
) -> None:
    host = make(replay=replay)
    take(host, 0, 1)
    with monkeypatch.context() as full:
        full.setattr(SnapshotKeeper, "_write", no_room)
        take(host, 2)
        take(host, 3)
    (said,) = warnings(caplog)
    assert said.startswith("cannot write a snapshot: No space left on device; goes on without")
    assert host.recovery["adder"].confirmed == {"f/imu/imu": 1}, (
        "a new process goes on from the snapshot before and asks for the rest"
    )
    again = make(replay=replay)
    assert again.recovery["adder"].resume()
    assert again.stages["adder"].inputs["imu"].expected == 2
    take(host, 4)
    assert host.recovery["adder"].confirmed == {"f/imu/imu": 4}, "there is room again"
    assert os.listdir(folder) == ["adder.snapshot"]  # noqa: PTH208 - names alone


def test_half_a_snapshot_is_not_left_behind(make: Make, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    host = make()
    take(host, 0)
    with monkeypatch.context() as full:
        full.setattr(os, "replace", no_room)
        take(host, 1)
    assert os.listdir(folder) == ["adder.snapshot"]  # noqa: PTH208 - names alone


def test_a_removed_folder_is_not_made_again_nor_found_under_its_name(
    make: Make, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    host = make()
    take(host, 0)
    shutil.rmtree(folder)
    take(host, 1)
    assert not folder.exists()
    folder.mkdir(mode=0o700)  # by another user, as far as the node knows
    take(host, 2)
    assert not list(folder.iterdir())
    assert len(warnings(caplog)) == 1
    assert host.recovery["adder"].confirmed == {"f/imu/imu": 0}


def test_live_an_operator_that_cannot_be_kept_begins_after_a_kill_with_what_is_new(
    make: Make, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    host = make(Unkeepable())
    take(host, 0, 1)
    take(host, 2)
    (said,) = warnings(caplog)
    assert said.startswith("cannot be brought back exactly after a kill: state.lines is a ")
    assert host.recovery["adder"].confirmed == {"f/imu/imu": 2}
    assert not list(folder.iterdir())


def test_in_a_replay_it_begins_again_with_its_first_sample(make: Make) -> None:
    host = make(Unkeepable(), replay=True)
    take(host, 0, 1)
    assert host.recovery["adder"].confirmed == {}


def test_live_an_old_snapshot_is_not_gone_on_from_once_none_can_be_taken(make: Make, folder: Path) -> None:
    host = make()
    take(host, 0)
    host.stages["adder"]._operator.seen = iter(())
    take(host)
    host.stages["adder"].inputs["imu"].handled_seq = 1
    take(host)
    assert not list(folder.iterdir())


def test_an_attribute_that_is_deleted_is_named_not_taken_for_damage_later(
    make: Make, caplog: pytest.LogCaptureFixture
) -> None:
    host = make()
    del host.stages["adder"]._operator.total
    host.stages["adder"].inputs["imu"].handled_seq = 1
    take(host)
    assert warnings(caplog) == [
        "cannot be brought back exactly after a kill: state.total was deleted; a snapshot without it would look damaged"
    ]


@pytest.mark.parametrize("kept_since", [False, True])
def test_a_snapshot_that_an_error_follows_is_not_gone_on_from_again(
    make: Make, folder: Path, caplog: pytest.LogCaptureFixture, kept_since: bool
) -> None:
    """Whatever a state is that fits and breaks the operator: the second process after it starts without."""
    take(make(), 0)
    host = make()
    if kept_since:
        handle_all = host.handle_all

        def keep_one_and_go_on(*, resumed: bool) -> None:
            take(host, 1)
            handle_all(resumed=resumed)

        host.handle_all = keep_one_and_go_on
    with pytest.raises(ZeroDivisionError):
        host.run()
    assert (folder / "adder.snapshot").exists() is kept_since
    assert len(warnings(caplog)) == (0 if kept_since else 1)


def test_a_node_that_started_without_keeps_its_snapshots_when_it_fails(make: Make, folder: Path) -> None:
    host = make()
    take(host, 0)
    with pytest.raises(ZeroDivisionError):
        host.handle_all(resumed=False)
    host.recovery["adder"].keeper.note_failure()
    assert (folder / "adder.snapshot").exists()


def test_a_state_of_other_ports_changes_nothing(make: Make) -> None:
    host = make()
    state = msgspec.structs.replace(host.stages["adder"].state(), inputs={"speed": (3, 4)})
    with pytest.raises(SnapshotError, match="has the inputs speed; expected imu"):
        host.stages["adder"].resume(state, Adder())
    assert host.stages["adder"].inputs["imu"].expected == 0
