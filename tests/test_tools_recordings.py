"""The tools around recordings, as they are called: info, recover, export, schema, import and simulate."""

import csv
import json
import statistics
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caneflow import command
from caneflow.messages import GroundSpeed, Imu, Pose, RadarFrame, Sample, json_schema, numbered
from caneflow.protocols.mrm import SCAN_INFO_BYTES, RadarConfig, build
from caneflow.protocols.mrm_scans import Scan, split_scan
from caneflow.recording import Recording, RecordingWriter
from tools.import_recording import scan_period, stamps_of

SHARED = Path(__file__).parents[1].parent / "shared"
START = 1_700_000_000_000_000_000  # ns
TENTH = 100_000_000  # ns

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


def write(path: Path, samples: list[tuple[str, Sample, int]]) -> Path:
    """A recording of samples given by key and seq."""
    with RecordingWriter(path, flow="cane", source="replayed", rig={"hand_height": 0.95}, run="r1") as recording:
        for key, sample, seq in samples:
            payload, stamp = numbered(sample, seq), sample.stamp
            recording.write(key, type(sample), payload, stamp=stamp, seq=seq, log_time=stamp)
    return path


def pose(stamp: int) -> Pose:
    return Pose(
        stamp=stamp, position=(1.5, -2, 0.5), velocity=(0, 0, 0), orientation=(0.5, 0.5, -0.5, 0.5), method="best"
    )


def imu(stamp: int) -> Imu:
    return Imu(stamp=stamp, gyro=(0.25, 0, -1), accel=(0, 0, 9.75))


@pytest.fixture
def track(tmp_path: Path) -> Path:
    """11 poses with the truth beside them, and an IMU that lost samples 3 and 4."""
    times = [START + TENTH * i for i in range(11)]
    samples: list[tuple[str, Sample, int]] = [("cane/fusion/pose", pose(t), i) for i, t in enumerate(times)]
    samples += [("cane/truth/pose", pose(t), i) for i, t in enumerate(times)]
    samples += [("cane/imu/imu", imu(t), i) for i, t in enumerate(times) if i not in (3, 4)]
    return write(tmp_path / "track.mcap", samples)


def test_info_says_what_is_there_and_what_was_lost(caneflow: Callable[..., Run], track: Path) -> None:
    status, out, err = caneflow("info", track)
    assert (status, err) == (0, "")
    assert "flow      cane, replayed, run r1" in out
    assert "start     2023-11-14 22:13:20.000" in out
    assert "duration  1.000 s" in out
    rows = {line.split()[0]: line.split()[1:] for line in out.partition("\n\n")[2].splitlines()}
    assert rows["fusion/pose"] == ["caneflow.Pose/1", "11", "10.00", "Hz", "0"]
    assert rows["imu/imu"] == ["caneflow.Imu/1", "9", "8.00", "Hz", "2"]


def test_info_as_json(caneflow: Callable[..., Run], track: Path) -> None:
    about = json.loads(caneflow("info", track, "--json")[1])
    assert (about["complete"], about["duration"], about["start"]) == (True, 1.0, START)
    assert about["size"] == track.stat().st_size
    assert {s["stream"]: s["missing"] for s in about["streams"]} == {
        "fusion/pose": 0,
        "truth/pose": 0,
        "imu/imu": 2,
    }


def test_info_of_a_cut_recording_and_recover(caneflow: Callable[..., Run], track: Path) -> None:
    track.write_bytes(track.read_bytes()[:-100])
    assert "cut short; `caneflow recover` makes it sound" in caneflow("info", track)[1]
    status, out, _ = caneflow("recover", track)
    sound = track.with_name("track.recovered.mcap")
    assert status == 0
    assert out.endswith(f"{sound}: 31 messages; {track} was cut\n")
    assert " complete\n" in caneflow("info", sound)[1]


@pytest.mark.parametrize("word", ["info", "recover", "export --format tum", "plot -o track.png"])
def test_a_file_that_is_no_recording_is_one_line(caneflow: Callable[..., Run], tmp_path: Path, word: str) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("time,x,y\n")
    name, *options = word.split()
    status, out, err = caneflow(name, path, *options)
    assert (status, out) == (2, "")
    assert err.startswith(f"caneflow {name}: {path}: is not an MCAP file")
    assert err.count("\n") == 1


def test_export_of_poses_as_tum(caneflow: Callable[..., Run], track: Path) -> None:
    """Time in s to the ns, and w last."""
    status, out, err = caneflow("export", track, "--format", "tum")
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert len(lines) == 11
    assert lines[1] == "1700000000.100000000 1.5 -2.0 0.5 0.5 -0.5 0.5 0.5"


def test_export_of_samples_as_csv(caneflow: Callable[..., Run], track: Path, tmp_path: Path) -> None:
    status, out, err = caneflow("export", track, "--format", "csv", "--stream", "imu/imu", "-o", tmp_path / "imu.csv")
    assert (status, out, err) == (0, "", "")
    with (tmp_path / "imu.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 9
    assert (rows[0]["stamp"], rows[0]["seq"]) == (str(START), "0")
    assert [float(rows[0][f"gyro_{i}"]) for i in range(3)] == [0.25, 0, -1]
    assert [float(rows[0][f"accel_{i}"]) for i in range(3)] == [0, 0, 9.75]
    assert rows[0]["mag_2"] == "", "absent"


def test_csv_leaves_arrays_out_and_says_so(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    frame = RadarFrame(
        stamp=5,
        scans=np.ones((1, 4), np.int32),
        scan_period=0.01,
        range_start=0.3,
        range_step=0.009,
        carrier=4.3e9,
        bandwidth=1.7e9,
    )
    path = write(tmp_path / "radar.mcap", [("cane/radar/frame", frame, 0)])
    status, out, err = caneflow("export", path, "--format", "csv")
    assert (status, err) == (0, "cane/radar/frame: left out scans: an array does not fit into a row\n")
    assert out.splitlines() == [
        "stamp,seq,scan_period,range_start,range_step,carrier,bandwidth",
        "5,0,0.01,0.3,0.009,4300000000.0,1700000000.0",
    ]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["csv"], "choose what to write with --stream: fusion/pose, truth/pose, imu/imu"),
        (["tum", "--stream", "imu/imu"], "imu/imu holds caneflow.Imu/1; tum takes caneflow.Pose/1"),
        (["csv", "--stream", "radar/frame"], "no stream radar/frame; there are fusion/pose, truth/pose, imu/imu"),
    ],
)
def test_export_says_what_can_be_chosen(
    caneflow: Callable[..., Run], track: Path, options: list[str], said: str
) -> None:
    assert caneflow("export", track, "--format", *options) == (2, "", f"caneflow export: {track}: {said}\n")


def test_schemas_are_those_in_recordings(caneflow: Callable[..., Run]) -> None:
    for name in ("Imu", "caneflow.Imu/1"):
        assert json.loads(caneflow("schema", name)[1]) == json_schema(Imu)
    everything = json.loads(caneflow("schema")[1])
    assert everything["caneflow.GroundSpeed/1"] == json_schema(GroundSpeed)
    assert "properties" in json.loads(caneflow("schema", "dataflow")[1])
    status, _, err = caneflow("schema", "Im")
    assert (status, err.partition(";")[0]) == (2, "caneflow schema: no schema 'Im'")


def radar_log(scans: list[tuple[int, int, list[int]]], lost: int | None = None) -> bytes:
    """A log of scans given by radar, clock (ms) and samples; `lost`: the packet that is missing."""
    packets = [
        build(packet)
        for number, (source, clock, samples) in enumerate(scans)
        for packet in split_scan(
            Scan(
                source_id=source,
                message_id=number,
                timestamp_ms=clock,
                scan_start_ps=23342,
                scan_stop_ps=81935,
                scan_step_bins=32,
                scan_type=1,
                antenna_id=3,
                operation_mode=1,
                samples=np.array(samples, dtype=np.int32),
            )
        )
    ]
    kept = [packet for number, packet in enumerate(packets) if number != lost]
    return RadarConfig(node_id=1, scan_start_ps=23342, scan_stop_ps=81935).to_bytes() + b"".join(kept)


def test_a_p440_log_becomes_a_recording(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    log, path = tmp_path / "log.bin", tmp_path / "radar.mcap"
    log.write_bytes(radar_log([(7, 5000 + 10 * i, [i] * 400) for i in range(20)], lost=9))  # a packet of scan 4
    status, out, _ = caneflow("import", "p440", log, "-o", path, "--carrier", 4.07e9)
    assert status == 0
    assert "19 scans of 400 samples, 100.00 Hz, 1 incomplete ones left out" in out
    with Recording(path) as recording:
        assert (recording.metadata["source"], recording.rig) == ("imported", {})
        samples = list(recording.samples())
    assert {sample.key for sample in samples} == {"cane/radar/frame"}
    assert [sample.seq for sample in samples] == list(range(19))
    assert [sample.stamp for sample in samples] == [10_000_000 * i for i in range(20) if i != 4]
    frames = [sample.decoded() for sample in samples]
    first = frames[0]
    assert isinstance(first, RadarFrame)
    assert [int(frame.scans[0, 0]) for frame in frames if isinstance(frame, RadarFrame)] == [
        i for i in range(20) if i != 4
    ]
    assert (first.carrier, first.bandwidth, first.scan_period) == (4.07e9, 1.7e9, 0.01)
    assert first.range_step == pytest.approx(9.149e-3, abs=1e-6)  # m: 61.035 ps, both ways
    assert first.range_start == pytest.approx((23342 - 10000) * 1e-12 * 299792458 / 2)


def test_lost_scans_are_said_in_the_last_line(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    log, path = tmp_path / "log.bin", tmp_path / "radar.mcap"
    whole = radar_log([(7, 5000 + 10 * i, [i] * 400) for i in range(60)])
    packets = [whole[at : at + SCAN_INFO_BYTES] for at in range(32, len(whole), SCAN_INFO_BYTES)]
    log.write_bytes(b"".join(packets[:20] + packets[26:50] + packets[51:]))  # scans 10 to 12, and a packet of 25
    status, out, _ = caneflow("import", "p440", log, "-o", path)
    last = "56 scans of 400 samples, 100.00 Hz, 1 incomplete ones left out, 3 never came by their numbers"
    assert (status, out.splitlines()[-1]) == (0, f"{path}: {last}"), "what never came is not a fault of the log"
    packets[30] = b"#" * SCAN_INFO_BYTES
    log.write_bytes(b"".join(packets))
    status, out, _ = caneflow("import", "p440", log, "-o", path, "--overwrite")
    assert (status, out.splitlines()[-1].endswith("1 lost with 1452 damaged bytes")) == (1, True)


def test_a_log_of_several_radars_is_imported_one_by_one(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    log = tmp_path / "log.bin"
    log.write_bytes(radar_log([(source, 10 * i, [source] * 96) for i in range(5) for source in (101, 102)]))
    refused = caneflow("import", "p440", log, "-o", tmp_path / "radar.mcap")
    assert refused == (2, "", f"caneflow import: {log}: scans of 2 radars; choose one with --source: 101, 102\n")
    assert "5 scans of 96 samples" in caneflow("import", "p440", log, "--source", 102, "-o", tmp_path / "r.mcap")[1]


@pytest.mark.parametrize(
    ("content", "said"),
    [(b"x" * 20, ""), (radar_log([]), "0 complete raw scans; a period takes 2\n"), (b"x" * 2000, "")],
)
def test_what_is_no_log_is_one_line(caneflow: Callable[..., Run], tmp_path: Path, content: bytes, said: str) -> None:
    log = tmp_path / "log.bin"
    log.write_bytes(content)
    status, _, err = caneflow("import", "p440", log, "-o", tmp_path / "radar.mcap")
    assert status == 2
    assert err.startswith(f"caneflow import: {log}: ")
    assert err.endswith(said)
    assert err.count("\n") == 1
    assert not (tmp_path / "radar.mcap").exists()


@given(clocks=st.lists(st.integers(0, 3), min_size=2, max_size=50), first=st.integers(0, 2**32 - 1))
def test_stamps_increase_and_keep_to_the_clock(clocks: list[int], first: int) -> None:
    """Scans of one millisecond share it; the clock wraps after 49.7 days."""
    elapsed = [sum(clocks[:i]) for i in range(1, len(clocks) + 1)]
    stamps = stamps_of([(first + ms) % 2**32 for ms in elapsed])
    assert stamps[0] == 0
    assert all(later > earlier for earlier, later in pairwise(stamps))
    assert all(
        0 <= stamp - (ms - elapsed[0]) * 1_000_000 < 1_000_000 for stamp, ms in zip(stamps, elapsed, strict=True)
    )


def test_a_clock_that_begins_anew_lets_time_go_on() -> None:
    assert stamps_of([70_000, 70_010, 15, 25]) == [0, 10_000_000, 11_000_000, 21_000_000]


def test_the_period_is_finer_than_the_clock_and_survives_losses() -> None:
    """17.28 ms, as in the rail recording: a clock of 1 ms shows 17 and 18, whose median is 17."""
    clock = [int(17.28 * i) for i in range(600) if i % 7 not in (3, 4)]
    stamps = stamps_of(clock)
    assert statistics.median(later - earlier for earlier, later in pairwise(stamps)) == 17_000_000
    assert scan_period(stamps) == pytest.approx(17.28e-3, rel=2e-4)


@pytest.mark.parametrize(
    ("name", "count", "rate"),
    [
        ("p440-rail-mocap/scan_2105627.txt", 607, 57.9),
        ("p440-udp-loss/test_scan711_1000.txt", 427, 48.6),
        ("p440-udp-loss/test_scan2.txt", 100, 46.4),
    ],
)
def test_logs_of_real_radars(caneflow: Callable[..., Run], tmp_path: Path, name: str, count: int, rate: float) -> None:
    """Counts and the first rate are those of the data's description; the others follow from the scan durations."""
    log, path = SHARED / "data" / name, tmp_path / "radar.mcap"
    if not log.exists():
        pytest.skip("the logs of real radars are not here")
    assert caneflow("import", "p440", log, "-o", path)[0] == 0
    with Recording(path) as recording:
        assert recording.stream("radar", "frame").count == count
        frame = next(recording.samples()).decoded()
    assert isinstance(frame, RadarFrame)
    assert 1 / frame.scan_period == pytest.approx(rate, abs=0.05)


def test_a_simulated_walk_keeps_the_contract(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    path, again = tmp_path / "walk.mcap", tmp_path / "again.mcap"
    status, _, err = caneflow("simulate", "walk", "--seed", 3, "--duration", 1, "-o", path)
    assert (status, err) == (0, ""), "no progress bar without a terminal"
    caneflow("simulate", "walk", "--seed", 3, "--duration", 1, "-o", again)
    with Recording(path) as recording, Recording(again) as other:
        assert recording.metadata["source"] == "simulated"
        assert recording.rig["boresight"] == [0, 1, 0]
        assert {s.key: s.count for s in recording.streams.values()} == {
            "cane/imu/imu": 101,
            "cane/radar/frame": 101,
            "cane/truth/pose": 101,
        }
        assert [sample.payload for sample in recording.samples()] == [sample.payload for sample in other.samples()]
    check = SHARED / "checks" / "conform.py"
    if check.exists():
        done = subprocess.run([sys.executable, check, path], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout


def test_simulate_finds_a_bad_path_before_it_works(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    path = tmp_path / "nowhere" / "walk.mcap"
    expected = f"caneflow simulate: {path}: cannot be written, there is no folder {path.parent}\n"
    assert caneflow("simulate", "walk", "-o", path) == (2, "", expected)


def test_simulate_names_the_walks_there_are(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    status, _, err = caneflow("simulate", "walk", "--scenario", "moonwalk", "-o", tmp_path / "walk.mcap")
    assert status == 2
    assert "no walk 'moonwalk'; there are swing, swing_stop" in " ".join(err.replace("│", " ").split())
