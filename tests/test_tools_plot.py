"""`caneflow plot`: a picture of whatever there is; the errors it prints are those of the evaluation."""

import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caneflow import command
from caneflow.algorithms.judging.track_errors import track_errors
from caneflow.messages import DopplerBlock, Grid, GroundSpeed, Imu, Pose, RadarFrame, Sample, numbered
from caneflow.recording import RecordingWriter
from caneflow.viewing.sensor_pictures import euler_angles
from tools.plot import read_picture, summary

Run = tuple[int, str, str]  # exit status, standard output, standard error
PERIOD = 10_000_000  # ns
YAW = 0.4  # rad that the estimate's world is turned against the truth's


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


def write(path: Path, samples: list[tuple[str, Sample]], rig: dict[str, object] | None = None) -> Path:
    with RecordingWriter(path, flow="cane", source="replayed", rig=rig or {}) as recording:
        seqs: dict[str, int] = {}
        for key, sample in samples:
            seq = seqs[key] = seqs.get(key, -1) + 1
            payload, stamp = numbered(sample, seq), sample.stamp
            recording.write(key, type(sample), payload, stamp=stamp, seq=seq, log_time=stamp)
    return path


def pose(stamp: int, x: float, y: float, yaw: float, method: str) -> Pose:
    return Pose(
        stamp=stamp,
        position=(x, y, 0),
        velocity=(0.5, 0, 0),
        orientation=(float(np.cos(yaw / 2)), 0, 0, float(np.sin(yaw / 2))),
        method=method,
    )


def walk(seconds: float, error_at_the_end: float, first: int = 0) -> list[tuple[str, Sample]]:
    """Straight on at 0.5 m/s, and from sample `first` on an estimate, in a turned world, that goes astray."""
    count = round(seconds * 100)
    samples: list[tuple[str, Sample]] = []
    for i in range(count):
        stamp, x = PERIOD * i, 0.005 * i
        samples.append(("cane/truth/pose", pose(stamp, 3 + x, 1, 0, "truth")))
        if i >= first:
            along, aside = x - 0.005 * first, error_at_the_end * i / (count - 1)
            turned = (np.cos(YAW) * along - np.sin(YAW) * aside, np.sin(YAW) * along + np.cos(YAW) * aside)
            samples.append(("cane/fusion/pose", pose(stamp, float(turned[0]), float(turned[1]), YAW, "kalman")))
    return samples


def radar(count: int, radial_speed: float) -> list[tuple[str, Sample]]:
    """One scatterer that comes nearer: its phase turns by 4 pi v T / wavelength from scan to scan."""
    wavelength = 299_792_458 / 4.3e9
    step = 4 * np.pi * radial_speed * 0.01 / wavelength
    return [
        (
            "cane/radar/frame",
            RadarFrame(
                stamp=PERIOD * i,
                scans=np.array([[1e-3, np.exp(1j * step * i)]], np.complex64),
                scan_period=0.01,
                range_start=0.3,
                range_step=0.009,
                carrier=4.3e9,
                bandwidth=1.7e9,
            ),
        )
        for i in range(count)
    ]


def speeds(count: int) -> list[tuple[str, Sample]]:
    return [
        (
            "cane/ground_speed/speed",
            GroundSpeed(
                stamp=PERIOD * i, speed=0.5, quality=0.05 if i else float("inf"), rays=9, valid=i > 5, delay=0.3
            ),
        )
        for i in range(count)
    ]


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_a_track_with_everything_is_drawn(caneflow: Callable[..., Run], tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / "track.mcap", [*walk(3, 0.2), *speeds(300), *radar(300, 0.4)])
    picture = tmp_path / f"track{suffix}"
    status, out, err = caneflow("plot", path, "-o", picture)
    assert (status, err) == (0, "")
    assert out == "fusion/pose kalman: final error 0.20 m, ATE 0.12 m, end to start 1.51 m, drift 13.4 % of 1.5 m\n"
    assert picture.stat().st_size > 10_000


def test_errors_are_those_of_the_evaluation(tmp_path: Path) -> None:
    picture = read_picture(write(tmp_path / "track.mcap", walk(3, 0.2)))
    track, truth = picture.tracks["fusion/pose kalman"], picture.truth
    assert truth is not None
    expected = track_errors(track, truth)
    errors = picture.errors(track)
    assert errors[-1] == pytest.approx(expected.final_error) == pytest.approx(0.2)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(expected.ate)


def test_a_run_over_a_part_of_the_walk_is_compared_with_that_part(tmp_path: Path) -> None:
    picture = read_picture(write(tmp_path / "track.mcap", walk(4, 0.0, first=200)))
    assert list(summary(picture)) == ["fusion/pose kalman: error 0.00 m after 2.0 s of the walk"]


def test_doppler_shows_what_approaches_above_zero(tmp_path: Path) -> None:
    picture = read_picture(write(tmp_path / "track.mcap", [*walk(3, 0.2), *radar(300, 0.4)]))
    drawn = picture.radar
    assert drawn is not None
    assert drawn.speed_time.shape == (len(drawn.speeds), len(drawn.times))
    found = drawn.speeds[drawn.speed_time.argmax(axis=0)]
    assert found == pytest.approx(0.4, abs=drawn.speeds[1] - drawn.speeds[0])


def test_in_a_room_positions_are_absolute(tmp_path: Path) -> None:
    rig: dict[str, object] = {"sensors": {"south": {"position": [4.1, -2.8, 1.2], "azimuth": 1.5}}}
    samples = [("room/truth/pose", pose(PERIOD * i, 1, 2, 0, "truth")) for i in range(100)]
    samples += [("room/room_tracker/pose", pose(PERIOD * i, 1, 2.5, 0, "particles")) for i in range(100)]
    picture = read_picture(write(tmp_path / "room.mcap", list(samples), rig))
    assert picture.sensors == {"south": (4.1, -2.8)}
    assert list(summary(picture)) == [
        "room_tracker/pose particles: error mean 0.50 m, max 0.50 m, final 0.50 m",
    ]


@pytest.mark.parametrize("kept", ["truth", "fusion"])
def test_truth_alone_and_a_track_alone_are_drawn(caneflow: Callable[..., Run], tmp_path: Path, kept: str) -> None:
    path = write(tmp_path / "walk.mcap", [each for each in walk(1, 0.1) if kept in each[0]])
    status, out, _ = caneflow("plot", path, "-o", tmp_path / "walk.png")
    assert status == 0
    assert out == ("" if kept == "truth" else "fusion/pose kalman: 100 poses; no ground truth to compare with\n")


def test_a_radar_alone_is_drawn_over_range_time_and_speed(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    path = write(tmp_path / "radar.mcap", radar(300, 0.4))
    status, out, err = caneflow("plot", path, "-o", tmp_path / "radar.png")
    assert (status, out, err) == (0, "radar: 0.3 to 0.3 m, +-1.74 m/s\n", "")
    assert (tmp_path / "radar.png").stat().st_size > 10_000
    drawn = read_picture(path).radar
    assert drawn is not None
    speed, place = np.unravel_index(drawn.range_speed.argmax(), drawn.range_speed.shape)
    assert drawn.ranges[place] == pytest.approx(0.309)  # the second range bin is the one that moves
    assert drawn.speeds[speed] == pytest.approx(0.4, abs=drawn.speeds[1] - drawn.speeds[0])
    assert drawn.range_time.argmax(axis=0).tolist() == [1] * len(drawn.times)


def module(seconds: float, speed: float) -> list[tuple[str, Sample]]:
    """A Doppler module at 24.125 GHz that hears a walker of constant speed in white noise."""
    rate, carrier = 4000, 24.125e9
    time = np.arange(int(seconds * rate)) / rate
    noise = 1e-3 * np.random.default_rng(2).standard_normal(len(time))
    sound = 0.05 * np.sin(2 * np.pi * 2 * speed * carrier / 299_792_458 * time) * (time > 2.0) + noise
    blocks = np.float32(sound).reshape(-1, 200)
    return [
        (
            "room/south/block",
            DopplerBlock(stamp=(i + 1) * 50_000_000, samples=block, sample_rate=float(rate), carrier=carrier),
        )
        for i, block in enumerate(blocks)
    ]


def test_a_doppler_module_alone_is_drawn_with_its_line(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    path = write(tmp_path / "sound.mcap", module(5.0, 1.2))
    status, out, err = caneflow("plot", path, "-o", tmp_path / "sound.png")
    assert (status, err) == (0, "")
    assert re.fullmatch(r"south/block: a line in \d+ of 95 spectra, median 1\.20 m/s\n", out)
    assert (tmp_path / "sound.png").stat().st_size > 10_000
    drawn = read_picture(path).modules["south/block"]
    walking = drawn.times > 2.5
    found = drawn.speeds[drawn.power.argmax(axis=0)]
    assert found[walking] == pytest.approx(1.2, abs=2 * (drawn.speeds[1] - drawn.speeds[0]))
    assert drawn.line[walking] == pytest.approx(1.2, abs=0.01)
    assert drawn.power[:, drawn.times < 1.5].max() < 20.0 < drawn.power[:, walking].max()


def test_an_imu_alone_is_drawn_with_its_attitude(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    """It rolls at 0.5 rad/s, gravity with it: 57.3 degrees after 2 s."""
    angles = 0.5 * np.arange(201) / 100
    samples = [
        (
            "cane/imu/imu",
            Imu(stamp=PERIOD * i, gyro=(0.5, 0, 0), accel=(0.0, 9.81 * float(np.sin(a)), 9.81 * float(np.cos(a)))),
        )
        for i, a in enumerate(angles)
    ]
    path = write(tmp_path / "imu.mcap", list(samples))
    status, out, err = caneflow("plot", path, "-o", tmp_path / "imu.png")
    assert (status, out, err) == (0, "imu: 201 samples, 100.0 Hz; attitude filter, yaw from 0\n", "")
    assert (tmp_path / "imu.png").stat().st_size > 10_000
    drawn = read_picture(path).imu
    assert drawn is not None
    assert drawn.attitude is not None
    assert drawn.attitude[-1] == pytest.approx((np.degrees(1.0), 0.0, 0.0), abs=1.0)


def test_angles_are_those_of_the_rotations_about_z_y_x() -> None:
    expected = np.array([[10.0, -20.0, 170.0], [12.0, -25.0, 190.0], [-30.0, 40.0, 200.0]])
    turned = Rotation.from_euler("ZYX", expected[:, ::-1], degrees=True).as_quat(scalar_first=True)
    assert euler_angles(turned) == pytest.approx(expected)


def test_a_recording_with_nothing_to_draw_says_so(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    path = write(tmp_path / "walk.mcap", [("cane/imu/imu", Imu(stamp=0, gyro=(0, 0, 0)))])
    status, _, err = caneflow("plot", path, "-o", tmp_path / "walk.png")
    assert status == 2
    assert err == (
        f"caneflow plot: {path}: nothing to draw; expected 2 poses or IMU samples, 8 radar scans, "
        "or 0.3 s of a Doppler module\n"
    )


def test_another_kind_of_picture_is_refused_before_the_work(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    said = caneflow("plot", tmp_path / "walk.mcap", "-o", tmp_path / "walk.gif")
    assert said == (2, "", f"caneflow plot: {tmp_path / 'walk.gif'}: a picture is one of .png, .svg, .pdf\n")


def test_a_grid_is_drawn_where_its_cells_are(tmp_path: Path) -> None:
    occupancy, missing = np.full((2, 8, 8), 128, np.uint8), np.full((8, 8), 128, np.uint8)
    occupancy[1, 5, 6] = 128 + 40
    occupancy[0, 2, 2] = 128 + 39  # one count too few
    missing[7, 0] = 128 + 40
    grid = Grid(
        stamp=10**9,
        occupancy=occupancy,
        floor_missing=missing,
        unit=1 / 32,
        cell=0.1,
        bottom=0.0,
        slice=0.25,
        origin=(15, -2),
        pose_stamp=10**9,
    )
    samples: list[tuple[str, Sample]] = [
        *(("cane/fusion/pose", pose(10**9 + i, 0.0, 0.0, 0.0, "best")) for i in range(2)),
        ("cane/surroundings/grid", grid),
    ]
    picture = read_picture(write(tmp_path / "grid.mcap", samples))
    assert picture.occupied is not None
    assert picture.floor_missing is not None
    np.testing.assert_allclose(picture.occupied, [[2.05, 0.45]])
    np.testing.assert_allclose(picture.floor_missing, [[2.25, -0.15]])


def test_tracks_have_their_colours_by_name_whichever_came_first(tmp_path: Path) -> None:
    samples: list[tuple[str, Sample]] = []
    for node in ("paper", "other", "fusion"):
        samples += [(f"cane/{node}/pose", pose(PERIOD * i, 0.1 * i, 0.0, 0.0, "kalman")) for i in range(3)]
    picture = read_picture(write(tmp_path / "track.mcap", samples))
    assert list(picture.tracks) == ["fusion/pose kalman", "other/pose kalman", "paper/pose kalman"]
