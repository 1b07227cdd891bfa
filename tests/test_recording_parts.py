"""A recording in parts: by size, by time, and the last seconds when someone asks."""

import errno
import itertools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caneflow import command
from caneflow.messages import Imu, numbered
from caneflow.messages.rig import read_rig
from caneflow.recording import Recording, RecordingError, RecordingWriter
from caneflow.recording.layout import Block, Content, Declarations, content_of
from caneflow.recording.parts import WRITE_NOW, LastSeconds, RotatingWriter, Rotation, part_path, read_span
from caneflow.recording.reader import GLANCE_BLOCKS
from caneflow.runtime import Context
from tools.record import Recorder, RecordSettings

STEP = 10_000_000  # ns: 100 Hz
KEY = "cane/imu/imu"
START = 1_700_000_000_000_000_000  # ns

Run = tuple[int, str, str]  # exit status, standard output, standard error


@pytest.fixture
def caneflow(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Run]:
    """The command, run in this process."""

    def run(*arguments: object) -> Run:
        monkeypatch.setattr(sys, "argv", ["caneflow", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            command.main()
        said = capsys.readouterr()
        return int(end.value.code or 0), said.out, said.err

    return run


def imu(seq: int) -> Imu:
    return Imu(stamp=START + seq * STEP, gyro=(0.1 * seq, 0.0, 0.0))


def feed(recorder: Recorder, seqs: range) -> None:
    for seq in seqs:
        sample = imu(seq)
        recorder.take(KEY, sample, numbered(sample, seq), sample.stamp)


def recorder(path: Path, **settings: object) -> Recorder:
    whole = RecordSettings(path=str(path), flow="cane", source="live", rig={}, **settings)  # type: ignore[arg-type]
    context = Context(node="recorder", rig=read_rig({}), ports={}, random=np.random.default_rng(0))
    return Recorder(whole, context)


def seqs_of(path: Path) -> list[int]:
    with Recording(path) as recording:
        assert recording.complete
        return [sample.seq for sample in recording.samples()]


def test_a_part_by_time_holds_that_much_and_all_together_everything(tmp_path: Path) -> None:
    recording = recorder(tmp_path / "walk.mcap", rotate_s=2.0)
    feed(recording, range(1000))
    recording.finish()
    parts = sorted(tmp_path.iterdir())
    assert [part.name for part in parts] == [f"walk_{number:03}.mcap" for number in range(5)]
    assert [seqs_of(part) for part in parts] == [list(range(first, first + 200)) for first in range(0, 1000, 200)]
    with Recording(parts[0]) as first, Recording(parts[4]) as last:
        assert first.metadata["run"] == last.metadata["run"]
        assert (first.metadata["part"], last.metadata["part"]) == ("0", "4")


def test_a_recorder_in_the_place_of_another_goes_on_in_the_next_part(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    for begin, goes_on in ((0, False), (100, True), (200, True)):
        further = recorder(path, run="one", goes_on=goes_on)
        feed(further, range(begin, begin + 100))
        further.finish()
    names = ["walk.mcap", "walk_001.mcap", "walk_002.mcap"]
    assert sorted(part.name for part in tmp_path.iterdir()) == names
    for number, name in enumerate(names):
        assert seqs_of(tmp_path / name) == list(range(100 * number, 100 * number + 100))
        with Recording(tmp_path / name) as part:
            assert (part.metadata["run"], part.metadata["source"]) == ("one", "live")
            assert part.metadata.get("part") == (str(number) if number else None)


def test_what_is_kept_is_counted_over_a_restart_of_the_recorder(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    other = recorder(path, run="of another day", rotate_s=1.0)
    feed(other, range(100))
    other.finish()
    for begin, goes_on in ((0, False), (300, True)):
        parts = recorder(path, run="one", rotate_s=1.0, keep=2, goes_on=goes_on)
        feed(parts, range(begin, begin + 300))
        parts.finish()
    assert [part.name for part in sorted(tmp_path.iterdir())] == ["walk_000.mcap", "walk_005.mcap", "walk_006.mcap"]
    assert seqs_of(part_path(path, 6)) == list(range(500, 600))


def test_on_a_disk_that_is_nearly_full_no_part_is_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("caneflow.recording.parts.LEAST_ROOM", sys.maxsize)
    with pytest.raises(RecordingError, match=r"walk\.mcap: cannot go on: No space left on device") as refused:
        recorder(tmp_path / "walk.mcap", goes_on=True)
    assert isinstance(refused.value.__cause__, OSError), "so it is tried again"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("loss", ["removed", "replaced", "moved with its folder"])
def test_a_file_that_lost_its_name_is_not_written_on(tmp_path: Path, loss: str) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    recording = recorder(folder / "walk.mcap")
    feed(recording, range(50))
    if loss == "moved with its folder":
        folder.rename(tmp_path / "elsewhere")
    else:
        (folder / "walk.mcap").unlink()
    if loss == "replaced":
        (folder / "walk.mcap").write_bytes(b"of someone else")
    with pytest.raises(RecordingError, match="was removed or moved while it was written"):
        feed(recording, range(50, 200))  # within the next second


def test_a_recording_that_could_not_begin_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(RecordingWriter, "_flush", full)
    with pytest.raises(RecordingError, match="No space left on device"):
        recorder(tmp_path / "walk.mcap")
    assert not list(tmp_path.iterdir())


def test_a_part_by_size_is_not_much_larger(tmp_path: Path) -> None:
    recording = recorder(tmp_path / "walk.mcap", rotate_bytes=20_000)
    feed(recording, range(4000))
    recording.finish()
    parts = sorted(tmp_path.iterdir())
    assert len(parts) > 3
    assert list(itertools.chain.from_iterable(map(seqs_of, parts))) == list(range(4000))
    for part in parts[:-1]:  # one second's chunk and the summary come on top
        assert 20_000 <= part.stat().st_size < 30_000


def test_only_the_newest_parts_are_kept_and_earlier_runs_are_left_alone(tmp_path: Path) -> None:
    earlier = part_path(tmp_path / "walk.mcap", 7)
    earlier.write_bytes(b"of another day")
    recording = recorder(tmp_path / "walk.mcap", rotate_s=1.0, keep=2)
    feed(recording, range(500))
    recording.finish()
    assert [part.name for part in sorted(tmp_path.iterdir())] == ["walk_007.mcap", "walk_011.mcap", "walk_012.mcap"]
    assert earlier.read_bytes() == b"of another day"
    assert seqs_of(part_path(tmp_path / "walk.mcap", 12)) == list(range(400, 500))


@pytest.mark.parametrize(
    ("text", "rotation"),
    [
        ("100MB", Rotation(size=100_000_000)),
        ("1.5GiB", Rotation(size=1_610_612_736)),
        ("10min", Rotation(span_s=600)),
        ("512kB,30s", Rotation(size=512_000, span_s=30)),
    ],
)
def test_when_to_rotate_is_read_from_text(text: str, rotation: Rotation) -> None:
    assert Rotation.read(text) == rotation


@pytest.mark.parametrize("text", ["", "100", "100 parsecs", "-5MB", "0s", "10min,", "MB"])
def test_what_is_no_size_or_time_is_refused(text: str) -> None:
    with pytest.raises(RecordingError, match="give a size or a time"):
        Rotation.read(text)


def test_spans() -> None:
    assert [read_span(text) for text in ("30s", "2min", "1h", "45")] == [30, 120, 3600, 45]
    with pytest.raises(RecordingError, match="'soon': not a duration"):
        read_span("soon")


def test_the_last_seconds_are_written_when_asked_for(tmp_path: Path) -> None:
    recording = recorder(tmp_path / "walk.mcap", last_s=3.0)
    assert recording.asked(WRITE_NOW, 0) is not None
    assert not list(tmp_path.iterdir()), "nothing was there to be written"
    feed(recording, range(1000))
    answer = msgspec.json.decode(recording.asked(WRITE_NOW, 0) or b"")
    assert answer == {"path": str(tmp_path / "walk_000.mcap"), "samples": 301, "span": 3.0}
    feed(recording, range(1000, 1100))
    recording.asked(WRITE_NOW, 0)
    recording.finish()
    assert seqs_of(tmp_path / "walk_000.mcap") == list(range(699, 1000))
    assert seqs_of(tmp_path / "walk_001.mcap") == list(range(799, 1100)), "the memory goes on"
    assert len(list(tmp_path.iterdir())) == 2, "at the end nothing is written that nobody asked for"


def test_a_question_that_is_none_of_the_recorders_has_no_answer(tmp_path: Path) -> None:
    assert recorder(tmp_path / "a.mcap", last_s=3.0).asked(b"how are you", 0) is None
    whole = recorder(tmp_path / "b.mcap")
    assert whole.asked(WRITE_NOW, 0) is None, "it has written everything already"
    whole.finish()


@given(sizes=st.lists(st.integers(1, 400), min_size=1, max_size=60), largest=st.integers(50, 1000))
def test_memory_is_bounded_in_bytes_and_time(sizes: list[int], largest: int) -> None:
    def no_file(path: Path, number: int) -> RecordingWriter:
        raise AssertionError

    last = LastSeconds(Path("/nowhere/x.mcap"), span_s=0.2, opener=no_file, largest=largest)
    for seq, size in enumerate(sizes):
        last.write(KEY, Imu, bytes(size), stamp=seq * STEP, seq=seq, log_time=seq * STEP)
        kept = list(last._kept)
        assert kept[-1].seq == seq
        assert len(kept) == 1 or sum(len(each.payload) for each in kept) <= largest
        assert kept[-1].log_time - kept[0].log_time <= 0.2e9
        # What could stay did: one more would be too much, or too old.
        oldest = kept[0].seq - 1
        assert oldest < 0 or sum(sizes[oldest : seq + 1]) > largest or (seq - oldest) * STEP > 0.2e9 or last.overfull


def test_parts_are_closed_when_the_disk_is_full(tmp_path: Path) -> None:
    opened: list[Path] = []

    def opener(path: Path, number: int) -> RecordingWriter:
        opened.append(path)
        if number == 1:
            raise RecordingError(f"{path}: cannot be written: No space left on device")
        return RecordingWriter(path, flow="cane", source="live", rig={})

    writer = RotatingWriter(tmp_path / "walk.mcap", Rotation(span_s=1), opener)
    with pytest.raises(RecordingError, match="No space left"):
        for seq in range(200):
            writer.write(KEY, Imu, numbered(imu(seq), seq), stamp=imu(seq).stamp, seq=seq, log_time=imu(seq).stamp)
    assert seqs_of(opened[0]) == list(range(100))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--rotate", "10min"], "--rotate, --keep and --record-last say how to record; add --record OUT"),
        (["--record", "x.mcap", "--keep", "3"], "--keep 3: says how many files of --rotate are kept; add e.g."),
        (["--record", "x.mcap", "--rotate", "a lot"], "--rotate a lot: give a size or a time, e.g. 100MB, 10min"),
        (["--record", "x.mcap", "--record-last", "30s", "--rotate", "1h"], "--record-last writes a file whenever"),
        (["--record", "x.mcap", "--record-last", "30s", "--in-process"], "--record-last needs a flow that can be"),
    ],
)
def test_options_that_do_not_go_together_are_named(caneflow: Callable[..., Run], options: list[str], said: str) -> None:
    file = Path(__file__).parents[1] / "dataflow.yaml"
    status, _, err = caneflow("run", file, *options)
    assert status == 2
    assert err.startswith(f"caneflow run: {said}")
    assert err.count("\n") == 1


def test_record_without_now_says_what_it_does(caneflow: Callable[..., Run]) -> None:
    said = "caneflow record: say --now; a whole run is recorded by `caneflow run FILE --record OUT`\n"
    assert caneflow("record") == (2, "", said)


def test_info_of_a_large_file_reads_little_of_it(
    caneflow: Callable[..., Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """20 minutes in over 1000 chunks: what is unpacked is the first, the last and some between them."""
    path = tmp_path / "long.mcap"
    with RecordingWriter(path, flow="cane", source="live", rig={}) as writer:
        for seq in range(0, 12_000):
            if seq not in (5000, 5001, 7000):
                stamp = START + seq * 10 * STEP
                writer.write(KEY, Imu, numbered(imu(seq), seq), stamp=stamp, seq=seq, log_time=stamp)
    unpacked: list[Block] = []

    def counting(file: BinaryIO, block: Block, declared: Declarations) -> Content:
        unpacked.append(block)
        return content_of(file, block, declared)

    monkeypatch.setattr("caneflow.recording.reader.content_of", counting)
    about = json.loads(caneflow("info", path, "--json")[1])
    assert len(unpacked) <= 2 + GLANCE_BLOCKS
    (stream,) = about["streams"]
    assert (stream["count"], stream["missing"], stream["restarts"]) == (11_997, 3, None)
    assert stream["rate"] == pytest.approx(10, rel=1e-3)
    (stream,) = json.loads(caneflow("info", path, "--json", "--full")[1])["streams"]
    assert (stream["missing"], stream["restarts"], stream["stamps_back"]) == (3, 0, 0)


def test_info_knows_when_numbers_began_anew(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    path = tmp_path / "again.mcap"
    with RecordingWriter(path, flow="cane", source="live", rig={}) as writer:
        for place, seq in enumerate([*range(50), *range(10)]):
            stamp = START + place * STEP
            payload = numbered(Imu(stamp=stamp, gyro=(0.0, 0.0, 0.0)), seq)
            writer.write(KEY, Imu, payload, stamp=stamp, seq=seq, log_time=stamp)
    assert "numbers began again; --full counts" in caneflow("info", path)[1]
    assert "0, numbers began again 1 x" in caneflow("info", path, "--full")[1]
