"""`caneflow emulate p440` and a live flow with the real driver, as real processes over UDP on loopback."""

import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caneflow.errors import CaneflowError
from caneflow.messages import DopplerBlock, RadarFrame, Sample, numbered, sample_key
from caneflow.protocols import mrm
from caneflow.recording import Recording, RecordingWriter
from tools.emulate import p440 as emulate

CANEFLOW = [sys.executable, "-m", "caneflow.command"]
DEADLINE = 30.0  # s
FLOW = """
flow: {flow}
nodes:
  radar: {{run: drivers.p440, restart: never}}
results: [radar/frame]
"""


def frames(count: int, samples: int = 480) -> list[RadarFrame]:
    rng = np.random.default_rng(5)
    return [
        RadarFrame(
            stamp=1_000_000_000 + seq * 10_000_000,
            scans=rng.integers(-(10**6), 10**6, size=(1, samples), dtype=np.int32),
            scan_period=0.01,
            range_start=0.3,
            range_step=0.009149,
            carrier=4.3e9,
            bandwidth=1.7e9,
        )
        for seq in range(count)
    ]


def recorded(path: Path, samples: list[Sample], node: str = "radar", port: str = "frame") -> Path:
    with RecordingWriter(path, flow="desk", source="simulated", rig={}) as writer:
        for seq, sample in enumerate(samples):
            writer.write(
                sample_key("desk", node, port),
                type(sample),
                numbered(sample, seq),
                stamp=sample.stamp,
                seq=seq,
                log_time=sample.stamp,
            )
    return path


class Started:
    """A command that goes on, and the lines it prints."""

    def __init__(self, *args: object) -> None:
        self.process = subprocess.Popen(
            [*CANEFLOW, *map(str, args)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.lines: list[str] = []

    def wait_for(self, pattern: str) -> re.Match[str]:
        """The first line from here on that has `pattern` in it."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line)
            if found := re.search(pattern, line):
                return found
        raise AssertionError(f"{pattern!r} is not in {self.lines}")

    def end(self, number: int | None = None) -> tuple[int, str]:
        """Send a signal, if any, and wait; the exit status and all that was printed."""
        if number is not None:
            self.process.send_signal(number)
        rest, _ = self.process.communicate(timeout=DEADLINE)
        return self.process.returncode, "".join(self.lines) + rest


@pytest.fixture
def start() -> Iterator[Callable[..., Started]]:
    started: list[Started] = []

    def start(*args: object) -> Started:
        started.append(Started(*args))
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            one.process.terminate()  # a launcher ends its nodes
            one.process.communicate(timeout=DEADLINE)


@pytest.fixture
def flow(tmp_path: Path) -> Path:
    path = tmp_path / "flow.yaml"
    path.write_text(FLOW.format(flow="t" + re.sub(r"\W", "", tmp_path.name).lower()[-40:]))
    return path


def live(port: str) -> list[str]:
    return ["--set", "radar.host=127.0.0.1", "--set", f"radar.port={port}"]


def test_a_live_run_gives_the_scans_of_the_recording(flow: Path, tmp_path: Path, start: Callable[..., Started]) -> None:
    given = frames(150)
    emulator = start("emulate", "p440", recorded(tmp_path / "given.mcap", [*given]), "--port", "0", "--reorder", "0.1")
    port = emulator.wait_for(r"UDP port (\d+)")[1]
    out = tmp_path / "out.mcap"
    running = start("run", flow, *live(port), "--record", out)
    running.wait_for("has sent no scan")  # the recording is over
    status, printed = running.end(signal.SIGINT)
    assert status == 130, printed
    status, printed = emulator.end()
    assert status == 0, printed
    assert "the recording is over" in printed
    with Recording(out) as recording:
        got = [sample.decoded() for sample in recording.samples([("radar", "frame")])]
    assert len(got) == len(given)
    for frame, was in zip(got, given, strict=True):
        assert isinstance(frame, RadarFrame)
        assert np.array_equal(frame.scans, was.scans)
        assert frame.scan_period == was.scan_period
        assert frame.range_start == pytest.approx(was.range_start, abs=1e-4)
        assert frame.range_step == pytest.approx(was.range_step, abs=1e-6)
    steps = np.diff([frame.stamp for frame in got])
    assert np.median(steps) == pytest.approx(10_000_000, abs=100_000)  # ns; the first ones are learning


def test_ctrl_c_leaves_the_radar_stopped(flow: Path, tmp_path: Path, start: Callable[..., Started]) -> None:
    recording = recorded(tmp_path / "given.mcap", [*frames(3000, samples=96)])
    emulator = start("emulate", "p440", recording, "--port", "0", "--loss", "0.05")
    port = emulator.wait_for(r"UDP port (\d+)")[1]
    out = tmp_path / "out.mcap"
    running = start("run", flow, *live(port), "--record", out)
    emulator.wait_for("scans for 127.0.0.1")
    running.wait_for("scans lost")  # it has been going on for a while
    status, printed = running.end(signal.SIGINT)
    assert status == 130, printed
    assert "killed" not in printed
    emulator.wait_for("^stopped$")
    status, printed = emulator.end(signal.SIGTERM)
    assert status == 130
    assert printed.splitlines()[-1].startswith("stopped; ")
    with Recording(out) as got:
        assert got.complete
        assert got.streams["radar", "frame"].count > 100


def frames_of(path: Path) -> list[RadarFrame]:
    with Recording(path) as recording:
        decoded = [sample.decoded() for sample in recording.samples([("radar", "frame")])]
    return [frame for frame in decoded if isinstance(frame, RadarFrame)]


@pytest.mark.parametrize(
    ("name", "scans"), [("test_scan2.txt", 100), pytest.param("test_scan711_1000.txt", 427, marks=pytest.mark.long)]
)
def test_recorded_packets_over_udp_give_the_importers_frames(
    name: str, scans: int, flow: Path, tmp_path: Path, start: Callable[..., Started]
) -> None:
    log = Path(__file__).parents[1].parent / "shared" / "data" / "p440-udp-loss" / name
    if not log.exists():
        pytest.skip("the recorded packets are not here")
    imported, out = tmp_path / "imported.mcap", tmp_path / "out.mcap"
    assert start("import", "p440", log, "-o", imported).end()[0] == 0
    emulator = start("emulate", "p440", log, "--port", "0")
    port = emulator.wait_for(r"UDP port (\d+)")[1]
    running = start("run", flow, *live(port), "--set", "radar.scan_period_us=0", "--record", out)
    running.wait_for("has sent no scan")  # the log is over
    assert running.end(signal.SIGINT)[0] == 130
    assert "the recording is over" in emulator.end()[1]
    got, given = frames_of(out), frames_of(imported)
    assert len(got) == len(given) == scans
    for frame, was in zip(got, given, strict=True):
        assert np.array_equal(frame.scans, was.scans)
        assert (frame.range_start, frame.range_step) == (was.range_start, was.range_step)
        assert frame.scan_period == pytest.approx(was.scan_period, rel=3e-3)
        late = (frame.stamp - got[0].stamp) - (was.stamp - given[0].stamp)
        assert abs(late) < 5e6, "the importer's stamps are whole ms, the driver's a line fit"


@pytest.mark.parametrize("what", ["no radar", "complex", "no such radar", "port", "cut log"])
def test_what_cannot_be_played_is_named_in_one_line(what: str, tmp_path: Path) -> None:
    path = tmp_path / "given.mcap"
    options: dict[str, Any] = {"port": 0}
    if what == "no radar":
        block = DopplerBlock(stamp=1, samples=np.zeros(4, np.int16), sample_rate=4e3, carrier=2.4e10)
        recorded(path, [block], "south", "block")
        says = "choose one radar with --stream; there are none"
    elif what == "complex":
        (frame,) = frames(1)
        values = {name: getattr(frame, name) for name in frame.__struct_fields__}
        recorded(path, [RadarFrame(**{**values, "scans": frame.scans.astype(np.complex64)})])
        says = "desk/radar/frame holds no integer scans"
    elif what == "no such radar":
        recorded(path, [*frames(1)])
        options["stream"] = "radar/picture"
        says = "no radar radar/picture; there are radar/frame"
    elif what == "port":
        recorded(path, [*frames(1)])
        options["host"] = "192.0.2.1"  # an address that nobody has
        says = "192.0.2.1, UDP port 0: Cannot assign requested address"
    else:
        path.write_bytes(mrm.RadarConfig(node_id=1, scan_start_ps=0, scan_stop_ps=1).to_bytes()[:20])
        says = "20 bytes, at least 32 are needed"
    with pytest.raises(CaneflowError, match=re.escape(says)) as raised:
        emulate(path, **options)
    assert "\n" not in str(raised.value)
