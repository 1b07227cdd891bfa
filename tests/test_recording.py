"""Recordings: what is written is read back, by stamp and in bounded memory; errors name the file."""

import json
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from caneflow.messages import Imu, Pose, RadarFrame, Sample, json_schema, numbered
from caneflow.recording import Recorded, Recording, RecordingError, RecordingWriter, writer

SHARED = Path(__file__).parents[1].parent / "shared"
RIG = {"boresight": [0, 1, 0], "hand_height": 0.95}

Row = tuple[str, type[Sample], bytes, int, int, int]  # key, kind, payload, stamp, seq, log time


def imu(stamp: int) -> Imu:
    return Imu(stamp=stamp, gyro=(0.1, 0.2, stamp % 10**9 / 1e9))


def frame(stamp: int) -> RadarFrame:
    scans = np.arange(6, dtype=np.int32)[None, :] + stamp % 1000
    return RadarFrame(
        stamp=stamp,
        scans=scans,
        scan_period=0.01,
        range_start=0.3,
        range_step=0.009,
        carrier=4.3e9,
        bandwidth=1.7e9,
    )


def row(key: str, sample: Sample, seq: int, log_time: int | None = None) -> Row:
    return (
        key,
        type(sample),
        numbered(sample, seq),
        sample.stamp,
        seq,
        sample.stamp if log_time is None else log_time,
    )


def walk(count: int) -> list[Row]:
    stamps = [1_700_000_000_000_000_000 + 10_000_000 * i for i in range(count)]
    return [
        each
        for i, stamp in enumerate(stamps)
        for each in (row("cane/imu/imu", imu(stamp), i), row("cane/radar/frame", frame(stamp), i))
    ]


def write(path: Path, rows: list[Row], compression: str = "zstd") -> Path:
    chosen = cast("writer.Compression", compression)
    with RecordingWriter(path, flow="cane", source="simulated", rig=RIG, compression=chosen) as recording:
        for key, kind, payload, stamp, seq, log_time in rows:
            recording.write(key, kind, payload, stamp=stamp, seq=seq, log_time=log_time)
    return path


def as_row(sample: Recorded) -> Row:
    assert sample.kind is not None
    return sample.key, sample.kind, sample.payload, sample.stamp, sample.seq, sample.log_time


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_what_is_written_is_read_back(tmp_path: Path, compression: str) -> None:
    rows = walk(300)
    with Recording(write(tmp_path / "walk.mcap", rows, compression)) as recording:
        assert recording.complete
        assert recording.flow == "cane"
        assert recording.rig == RIG
        assert recording.metadata["source"] == "simulated"
        assert len(recording.metadata["run"]) == 32
        assert [as_row(sample) for sample in recording.samples()] == rows
        stream = recording.stream("radar", "frame")
        assert (stream.key, stream.schema, stream.count) == ("cane/radar/frame", "caneflow.RadarFrame/1", 300)
        assert (stream.first_stamp, stream.last_stamp) == recording.span() == (rows[0][3], rows[-1][3])
        first = next(recording.samples([("radar", "frame")])).decoded()
        assert isinstance(first, RadarFrame)
        assert first.scans.tolist() == [[0, 1, 2, 3, 4, 5]]


def test_every_run_has_its_own_id(tmp_path: Path) -> None:
    ids = []
    for name in ("a", "b"):
        with Recording(write(tmp_path / name, [])) as recording:
            ids.append(recording.metadata["run"])
    assert ids[0] != ids[1]


def test_another_reader_finds_what_the_contract_says(tmp_path: Path) -> None:
    path = write(tmp_path / "walk.mcap", walk(3))
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        schema, channel, message = next(iter(reader.iter_messages(topics="cane/imu/imu")))
    assert channel.message_encoding == "msgpack"
    assert schema is not None
    assert (schema.name, schema.encoding) == ("caneflow.Imu/1", "jsonschema")
    assert json.loads(schema.data) == json_schema(Imu)
    assert (message.publish_time, message.sequence) == (1_700_000_000_000_000_000, 0)


def test_the_outside_check_finds_no_fault(tmp_path: Path) -> None:
    check = SHARED / "checks" / "conform.py"
    if not check.exists():
        pytest.skip("the outside checks are not here")
    path = write(tmp_path / "walk.mcap", walk(300))
    done = subprocess.run([sys.executable, check, path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert done.stdout == f"{path}: cane/imu/imu 300, cane/radar/frame 300\n"


def test_recordings_of_others_are_read(tmp_path: Path) -> None:
    path = SHARED / "data" / "walks" / "swing_1.mcap"
    if not path.exists():
        pytest.skip("the recordings of others are not here")
    with Recording(path) as recording, path.open("rb") as file:
        expected = [(c.topic, m.sequence, m.data) for _, c, m in make_reader(file).iter_messages()]
        got = [(sample.key, sample.seq, sample.payload) for sample in recording.samples()]
    assert len(got) == 15903
    assert sorted(got) == sorted(expected)


def test_what_the_flow_says_of_itself_is_no_stream(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "run.mcap", flow="cane", source="live", rig={}) as recording:
        recording.write_control("cane/@/progress/fusion", "caneflow.Progress/1", b"\x80", log_time=5)
        recording.write(*row("cane/imu/imu", imu(7), 0)[:3], stamp=7, seq=0, log_time=7)
    with Recording(tmp_path / "run.mcap") as read:
        assert list(read.streams) == [("imu", "imu")]
        assert read.control == {"cane/@/progress/fusion": 1}
        assert list(read.said("cane/@/progress/fusion")) == [b"\x80"]
        assert [sample.stamp for sample in read.samples()] == [7]


def test_the_example_of_the_docs_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[1] / "docs" / "recordings.md").read_text(encoding="utf-8")
    example = page.partition("```python\n")[2].partition("```")[0]
    write(tmp_path / "walk.mcap", walk(2))
    monkeypatch.chdir(tmp_path)
    exec(example, {})  # noqa: S102  # the docs are ours
    assert len(capsys.readouterr().out.splitlines()) == 5


def test_order_comes_from_the_stamps_not_from_the_arrival(tmp_path: Path) -> None:
    """A derived stream arrives late, as in every live recording; ties go by the order that was asked for."""
    late = 250_000_000
    rows = [row("cane/imu/imu", imu(10_000_000 * i), i) for i in range(200)]
    rows += [row("cane/fusion/pose", pose(10_000_000 * i), i, log_time=10_000_000 * i + late) for i in range(200)]
    rows.sort(key=lambda each: each[5])
    with Recording(write(tmp_path / "run.mcap", rows)) as recording:
        for order in ([("imu", "imu"), ("fusion", "pose")], [("fusion", "pose"), ("imu", "imu")]):
            got = [(sample.stamp, (sample.node, sample.port)) for sample in recording.samples(order)]
            assert got == [(10_000_000 * i, name) for i in range(200) for name in order]


def pose(stamp: int) -> Pose:
    return Pose(stamp=stamp, position=(0, 0, 0), velocity=(0, 0, 0), orientation=(1, 0, 0, 0), method="none")


@st.composite
def arrivals(draw: st.DrawFn) -> list[Row]:
    """Up to three streams, each with increasing stamps, that arrive in any mixture."""
    keys = ["cane/a/x", "cane/b/x", "cane/c/x"][: draw(st.integers(1, 3))]
    stamps = {key: sorted(draw(st.sets(st.integers(0, 40), max_size=30))) for key in keys}
    mixture = draw(st.permutations([key for key in keys for _ in stamps[key]]))
    waiting = {key: iter(enumerate(stamps[key])) for key in keys}
    rows = []
    for arrival, key in enumerate(mixture):
        seq, stamp = next(waiting[key])
        rows.append(row(key, imu(stamp), seq, log_time=arrival))
    return rows


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rows=arrivals(), start=st.integers(0, 40), length=st.integers(0, 40))
def test_any_mixture_and_window_is_the_sorted_whole(
    tmp_path: Path, small_chunks: None, rows: list[Row], start: int, length: int
) -> None:
    order = [("c", "x"), ("a", "x"), ("b", "x")]
    with Recording(write(tmp_path / "run.mcap", rows)) as recording:
        order = [name for name in order if name in recording.streams]
        expected = sorted(rows, key=lambda each: (each[3], order.index((each[0][5], "x")), each[4]))
        assert [as_row(sample) for sample in recording.samples(order)] == expected
        window = recording.samples(order, start_ns=start, end_ns=start + length)
        assert [as_row(sample) for sample in window] == [r for r in expected if start <= r[3] < start + length]


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Chunks of a few samples, so that a short recording has many."""
    monkeypatch.setattr(writer, "CHUNK_SIZE", 400)
    yield


def test_memory_is_bounded_whatever_the_order_of_arrival(tmp_path: Path) -> None:
    """20 MB: first all of one stream, then all of the other, over the same stamps."""
    payload = bytes(10_000)
    rows = [(key, Imu, payload, stamp, stamp, 0) for key in ("cane/a/x", "cane/b/x") for stamp in range(1000)]
    path = write(tmp_path / "run.mcap", cast("list[Row]", rows))
    tracemalloc.start()
    try:
        with Recording(path) as recording:
            count = sum(1 for _ in recording.samples())
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert count == 2000
    assert peak < 2e6


def test_files_without_chunks_are_read(tmp_path: Path) -> None:
    """Some writers make none; there is no index in such a file."""
    path = tmp_path / "bare.mcap"
    with path.open("wb") as file:
        bare = Writer(file, use_chunking=False)
        bare.start()
        bare.add_metadata("caneflow", {"flow": "cane", "version": "1", "run": "1", "source": "live"})
        bare.add_metadata("rig", {"json": "{}"})
        schema = bare.register_schema("caneflow.Imu/1", "jsonschema", b"{}")
        channel = bare.register_channel("cane/imu/imu", "msgpack", schema)
        for seq in range(50):
            bare.add_message(channel, seq, b"\x80", seq, seq)
        bare.finish()  # type: ignore[no-untyped-call]
    with Recording(path) as recording:
        assert recording.complete
        assert [sample.stamp for sample in recording.samples()] == list(range(50))


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (None, "cannot be read: No such file"),
        (b"", "is empty"),
        (b"time,x,y\n", "is not an MCAP file, it begins with b'time,x,y'"),
        (b"\x89MCAP", "was cut in its first bytes"),
        (b"\x89MCAP0\r\n", "has no metadata record 'caneflow' with 'flow', it was cut before there was any"),
    ],
)
def test_what_is_no_recording_is_refused_by_name(tmp_path: Path, content: bytes | None, found: str) -> None:
    path = tmp_path / "walk.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError) as error:
        Recording(path)
    assert str(error.value).startswith(f"{path}: {found}")
    assert "\n" not in str(error.value)


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be read: Is a directory"):
        Recording(tmp_path)


def test_an_mcap_file_of_something_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    with path.open("wb") as file:
        other = Writer(file)
        other.start()
        schema = other.register_schema("sensor_msgs/Imu", "ros1msg", b"")
        other.add_message(other.register_channel("/imu", "ros1", schema), 0, b"", 0)
        other.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(RecordingError, match="no metadata record 'caneflow' with 'flow'; a recording is an MCAP file"):
        Recording(path)


def test_a_stream_in_another_encoding_is_refused_where_it_is_wanted(tmp_path: Path) -> None:
    path = tmp_path / "mixed.mcap"
    with path.open("wb") as file:
        mixed = Writer(file)
        mixed.start()
        mixed.add_metadata("caneflow", {"flow": "cane"})
        mixed.add_metadata("rig", {"json": "{}"})
        ros = mixed.register_schema("sensor_msgs/Imu", "ros1msg", b"")
        good = mixed.register_schema("caneflow.Imu/1", "jsonschema", b"{}")
        mixed.add_message(mixed.register_channel("cane/imu/imu", "ros1", ros), 0, b"", 0)
        mixed.add_message(mixed.register_channel("cane/hand/imu", "msgpack", good), 0, b"", 0)
        mixed.finish()  # type: ignore[no-untyped-call]
    with Recording(path) as recording:
        assert len(list(recording.samples([("hand", "imu")]))) == 1
        with pytest.raises(
            RecordingError, match=r"cane/imu/imu is ros1 with schema sensor_msgs/Imu \(ros1msg\); a sample is"
        ):
            recording.samples()


def test_a_stream_that_is_not_there_is_named_with_those_that_are(tmp_path: Path) -> None:
    with (
        Recording(write(tmp_path / "walk.mcap", walk(2))) as recording,
        pytest.raises(RecordingError, match="no stream radar/frames; there are imu/imu, radar/frame"),
    ):
        recording.samples([("radar", "frames")])


def test_a_sample_that_breaks_the_contract_is_passed_on_and_named_when_decoded(tmp_path: Path) -> None:
    rows: list[Row] = [*walk(1), ("cane/imu/imu", Imu, b"\x80", 2 * 10**18, 1, 2 * 10**18)]
    with Recording(write(tmp_path / "walk.mcap", rows)) as recording:
        *_, last = recording.samples()
        assert last.payload == b"\x80"
        with pytest.raises(RecordingError, match=r"cane/imu/imu: sample 1: .*missing required field"):
            last.decoded()


@pytest.mark.parametrize("name", ["nowhere/walk.mcap", "."])
def test_a_path_that_cannot_be_written_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(RecordingError, match=r"cannot be written.*(no folder .*nowhere|Is a directory)"):
        RecordingWriter(tmp_path / name, flow="cane", source="live", rig={})


def test_a_full_disk_ends_the_recording_with_one_error() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full on this system")
    with pytest.raises(RecordingError, match="/dev/full: No space left on device; the recording ends here"):
        RecordingWriter("/dev/full", flow="cane", source="live", rig={})


def test_a_key_keeps_its_schema(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "walk.mcap", flow="cane", source="live", rig={}) as recording:
        recording.write("cane/imu/imu", Imu, b"\x80", stamp=0, seq=0, log_time=0)
        with pytest.raises(
            RecordingError, match=r"cane/imu/imu is a stream of caneflow\.Imu/1, not of caneflow\.Pose/1"
        ):
            recording.write("cane/imu/imu", Pose, b"\x80", stamp=1, seq=1, log_time=1)


def test_an_error_inside_still_ends_the_file_soundly(tmp_path: Path) -> None:
    def interrupted() -> None:
        with RecordingWriter(tmp_path / "walk.mcap", flow="cane", source="live", rig={}) as recording:
            recording.write("cane/imu/imu", Imu, b"\x80", stamp=0, seq=0, log_time=0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with Recording(tmp_path / "walk.mcap") as recording:
        assert recording.complete
        assert recording.stream("imu", "imu").count == 1
