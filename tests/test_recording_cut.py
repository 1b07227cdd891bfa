"""Recordings that were cut or damaged: a killed writer loses a second at most, and no file breaks the reader."""

import signal
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import ChunkIndex

from caneflow.messages import Imu, numbered
from caneflow.recording import NothingLeftError, Recording, RecordingError, RecordingWriter, recover, writer

SAMPLES = 40
Read = list[tuple[int, bytes]]  # stamp, payload

RECORD_UNTIL_KILLED = """
import sys
from caneflow.messages import Imu, numbered
from caneflow.recording import RecordingWriter

with RecordingWriter(sys.argv[1], flow="cane", source="live", rig={"hand_height": 0.95}, run="r1") as recording:
    for seq in range(int(sys.argv[2])):
        stamp = 10_000_000 * seq
        payload = numbered(Imu(stamp=stamp, gyro=(0.0, 0.0, 0.0)), seq)
        recording.write("cane/imu/imu", Imu, payload, stamp=stamp, seq=seq, log_time=stamp)
    print("written", flush=True)
    sys.stdin.read()
"""


def killed(path: Path, samples: int) -> None:
    """Write `samples` at 100 Hz of log time in another process, and kill it with the file open."""
    with subprocess.Popen(
        [sys.executable, "-c", RECORD_UNTIL_KILLED, path, str(samples)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"written\n"
        process.send_signal(signal.SIGKILL)
        process.wait()


def read(path: Path) -> Read:
    with Recording(path) as recording:
        return [(sample.stamp, sample.payload) for sample in recording.samples()]


def test_a_killed_recorder_loses_a_second_at_most(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    killed(path, samples=1050)
    with Recording(path) as recording:
        assert not recording.complete
        assert recording.metadata["run"] == "r1"
        assert recording.rig == {"hand_height": 0.95}
        stream = recording.stream("imu", "imu")
        assert stream.count >= 950
        assert [sample.seq for sample in recording.samples()] == list(range(stream.count))
        assert recording.span() == (0, 10_000_000 * (stream.count - 1))
        assert [s.seq for s in recording.samples(start_ns=9_000_000_000, end_ns=9_020_000_000)] == [900, 901]


def test_a_recorder_killed_before_its_first_second_leaves_the_metadata(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    killed(path, samples=1)
    with Recording(path) as recording:
        assert (recording.complete, recording.flow, recording.streams) == (False, "cane", {})


def test_recover_makes_a_file_that_others_open(tmp_path: Path) -> None:
    path, sound = tmp_path / "walk.mcap", tmp_path / "sound.mcap"
    killed(path, samples=500)
    found = recover(path, sound)
    expected = read(path)
    assert (found.complete, found.damaged, found.messages) == (False, 0, {"cane/imu/imu": len(expected)})
    assert read(sound) == expected
    with sound.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert [(m.publish_time, m.data) for _, _, m in reader.iter_messages()] == expected
        names = [metadata.name for metadata in reader.iter_metadata()]
    assert names == ["caneflow", "rig"]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, Read]:
    """The bytes of a recording with many small chunks, and its samples."""
    path = tmp_path_factory.mktemp("sound") / "walk.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "CHUNK_SIZE", 300)
        with RecordingWriter(path, flow="cane", source="live", rig={}) as recording:
            for stamp in range(SAMPLES):
                payload = numbered(Imu(stamp=stamp, gyro=(0.1, 0.2, stamp)), stamp)
                recording.write("cane/imu/imu", Imu, payload, stamp=stamp, seq=stamp, log_time=stamp)
    return path.read_bytes(), read(path)


cuts = settings(deadline=None, max_examples=250, suppress_health_check=[HealthCheck.function_scoped_fixture])


@cuts
@given(data=st.data())
def test_a_file_cut_anywhere_yields_what_came_before_the_cut(
    tmp_path: Path, sound: tuple[bytes, Read], data: st.DataObject
) -> None:
    whole, samples = sound
    cut = data.draw(st.integers(0, len(whole) - 1))
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[:cut])
    try:
        got = read(path)
    except RecordingError:
        assert cut < 400, "only a file without its metadata is refused"
        return
    assert got == samples[: len(got)]
    recover(path, tmp_path / "recovered.mcap")
    assert read(tmp_path / "recovered.mcap") == got


@cuts
@given(data=st.data())
def test_a_damaged_byte_is_found_or_harmless(tmp_path: Path, sound: tuple[bytes, Read], data: st.DataObject) -> None:
    whole, samples = sound
    at, value = data.draw(st.integers(0, len(whole) - 1)), data.draw(st.integers(0, 255))
    path = tmp_path / "damaged.mcap"
    path.write_bytes(whole[:at] + bytes([value]) + whole[at + 1 :])
    for reading in (read, saved):
        try:
            got = reading(path)
        except RecordingError as error:
            assert "\n" not in str(error)
        else:
            assert set(got) <= set(samples)


def saved(path: Path) -> Read:
    recover(path, path.with_name("saved.mcap"))
    return read(path.with_name("saved.mcap"))


def chunk_of(whole: bytes, number: int) -> ChunkIndex:
    summary = make_reader(BytesIO(whole)).get_summary()
    assert summary is not None
    return summary.chunk_indexes[number]


@pytest.mark.parametrize("number", [0, 3])
def test_recover_leaves_out_a_damaged_chunk_and_keeps_the_rest(
    tmp_path: Path, sound: tuple[bytes, Read], number: int
) -> None:
    """Also the first one, which declares the channels of all: the summary repeats them."""
    whole, samples = sound
    chunk = chunk_of(whole, number)
    at = chunk.chunk_start_offset + chunk.chunk_length - 5
    path = tmp_path / "damaged.mcap"
    path.write_bytes(whole[:at] + b"\0\0\0\0" + whole[at + 4 :])

    with pytest.raises(RecordingError, match=rf"damaged at byte {chunk.chunk_start_offset}; `caneflow recover"):
        read(path)
    found = recover(path, tmp_path / "sound.mcap")
    assert (found.complete, found.damaged) == (True, 1)
    rest = read(tmp_path / "sound.mcap")
    assert len(samples) - 10 < len(rest) < len(samples)
    assert set(rest) < set(samples)


def test_a_tail_of_zeros_is_a_cut(tmp_path: Path, sound: tuple[bytes, Read]) -> None:
    """Some file systems leave them after a power cut."""
    path = tmp_path / "zeros.mcap"
    path.write_bytes(sound[0][: chunk_of(sound[0], 3).chunk_start_offset + 20] + bytes(100_000))
    got = read(path)
    assert 0 < len(got) < SAMPLES
    assert got == sound[1][: len(got)]


def test_recover_does_not_overwrite_what_it_reads(tmp_path: Path, sound: tuple[bytes, Read]) -> None:
    path = tmp_path / "walk.mcap"
    path.write_bytes(sound[0])
    with pytest.raises(RecordingError, match="is the file to recover; give the sound one another name"):
        recover(path, path)
    assert path.read_bytes() == sound[0]


def test_what_recover_writes_is_read_whatever_the_cut(tmp_path: Path, sound: tuple[bytes, Read]) -> None:
    """All that came before the cut with its flow and rig, or no file and the word that nothing is left."""
    whole, samples = sound
    path, target = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
    kept: list[int] = []
    for cut in (*range(500), *range(500, len(whole), 11), len(whole)):
        path.write_bytes(whole[:cut])
        try:
            found = recover(path, target)
        except RecordingError as error:
            assert isinstance(error, NothingLeftError) or cut < 8, "or it is not an MCAP file yet"
            assert "nothing to recover" in str(error) or cut < 8
            assert not target.exists()
            assert not kept, "what is longer has more"
            continue
        got = read(target)
        with Recording(target) as recording:
            assert (recording.complete, recording.flow, recording.rig) == (True, "cane", {})
            assert recording.metadata["source"] == "live"
        assert found.messages.get("cane/imu/imu", 0) == len(got)
        assert found.replaced == ()
        assert got == samples[: len(got)]
        target.unlink()
        kept.append(len(got))
    assert kept == sorted(kept)
    assert (kept[0], kept[-1]) == (0, SAMPLES)


@pytest.mark.parametrize("lost", ["caneflow", "rig"])
def test_lost_metadata_is_made_up_when_there_are_samples(tmp_path: Path, sound: tuple[bytes, Read], lost: str) -> None:
    """The flow's name stands in the keys."""
    path, target = tmp_path / "damaged.mcap", tmp_path / "saved.mcap"
    name = len(lost).to_bytes(4, "little") + lost.encode()
    path.write_bytes(sound[0].replace(name, b"\xff" * 4 + lost.encode()))
    assert recover(path, target).replaced == (lost,)
    assert read(target) == sound[1]
    with Recording(target) as recording:
        assert (recording.flow, recording.rig) == ("cane", {})


def test_two_flows_in_one_file_are_no_recording(tmp_path: Path) -> None:
    path, target = tmp_path / "two.mcap", tmp_path / "saved.mcap"
    with RecordingWriter(path, flow="one", source="live", rig={}) as writing:
        for flow in ("one", "two"):
            writing.write(f"{flow}/imu/imu", Imu, numbered(Imu(stamp=1, gyro=(0, 0, 0)), 0), stamp=1, seq=0, log_time=1)
    with pytest.raises(
        NothingLeftError, match="what is left of it is not a recording: both one/imu/imu and two/imu/imu"
    ):
        recover(path, target)
    assert not target.exists()
