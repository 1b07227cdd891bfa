"""Recordings from strangers: told or refused in a line, within seconds, in bounded memory; no escape gets out."""

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from caneflow import command
from caneflow.printable import printable
from caneflow.recording import Recording, RecordingError, layout, reader
from caneflow.recording.layout import Block, Content, content_of
from tests import hostile

ROOT = Path(__file__).parents[1]
RAW = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069]")

# What every reader does with each file, under the limits that the parent sets; a line per file, then the peak (bytes).
READ_ALL = """
import resource, sys
from collections import deque
from pathlib import Path
from caneflow.errors import CaneflowError
from caneflow.recording import Recording, layout, recover
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.deployment import deploy
from caneflow.runtime.replayed import Replay

resource.setrlimit(resource.RLIMIT_CPU, (60, 60))  # s: they take about 6
layout.MAX_UNPACKED = 2**27  # an eighth, which takes an eighth of the time
folder = Path(sys.argv[1])
graph = load(folder / "mine.yaml")

def tried(what, path):
    try:
        what(path)
    except CaneflowError as error:
        return str(error)
    return "read"

def info(path):
    with Recording(path) as recording:
        recording.examined(glance=True)
        recording.examined()

def every_sample(path):
    with Recording(path) as recording:
        deque(recording.samples(), maxlen=0)

def replayed(path):
    deploy(graph, replay=Replay(recording=path))

def recovered(path):
    recover(path, folder / "out")
    info(folder / "out")

for path in sorted(folder.glob("*.mcap")):
    for what in (info, every_sample, replayed, recovered):
        print(path.stem, what.__name__, ascii(tried(what, path)), sep="|")
status = Path("/proc/self/status").read_text()  # ru_maxrss would be the greatest of the tests, which started this
print(status.partition("VmHWM:")[2].split()[0])
"""


def test_no_file_takes_more_than_a_moment_or_more_memory_than_is_there(tmp_path: Path) -> None:
    """27 files of up to 4 MB: all of them together take no more CPU than one of them did before, and 250 MB at most."""
    files = hostile.files()
    for name, data in files.items():
        assert len(data) < 5_000_000
        (tmp_path / f"{name}.mcap").write_bytes(data)
    (tmp_path / "mine.yaml").write_text(
        "flow: cane\nnodes:\n  imu: {run: drivers.bno055}\n  mine: {run: operators.attitude, inputs: {imu: imu/imu}}\n"
    )
    done = subprocess.run([sys.executable, "-c", READ_ALL, tmp_path], capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stderr) == (0, "")
    *lines, peak = done.stdout.splitlines()
    assert int(peak) < 250_000, "kB; 60 MB are the program's own"
    found = {tuple(line.split("|")[:2]): line.split("|", 2)[2] for line in lines}
    assert len(found) == 4 * len(files)
    assert all(len(said) < 3000 for said in found.values())
    assert "declares more than 1024 channels" in found["65534 channels", "info"]
    assert "unpacks to more than 1 GiB and 1000 times its size" in found["chunks of zeros", "info"]
    assert "damaged at byte" in found["a chunk of the same message", "info"]
    assert "lie so far apart in the file" in found["streams far apart in the file", "every_sample"]
    assert "lie too far apart in time" in found["streams far apart in time", "every_sample"]
    for name in ("a count of 2^63", "a chunk of 2^62 bytes", "the same chunk 10000 times", "a summary in itself"):
        assert {found[name, what] for what in ("info", "every_sample", "recovered")} == {"'read'"}, name
    assert found["5000 notes of what was lost", "replayed"] == "'read'"


def test_opening_unpacks_each_block_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many streams begin or end in it."""
    path = tmp_path / "many.mcap"
    chunks = [hostile.chunk(b"".join(hostile.message(k, j, j) for k in range(1, 501))) for j in range(4)]
    path.write_bytes(hostile.MAGIC + hostile.START + hostile.numbered(500) + b"".join(chunks))
    unpacked: list[int] = []

    def counting(file: object, block: Block, declared: layout.Declarations) -> Content:
        unpacked.append(block.offset)
        return content_of(file, block, declared)  # type: ignore[arg-type]

    monkeypatch.setattr(reader, "content_of", counting)
    with Recording(path) as recording:
        assert len(recording.streams) == 500
        assert (len(unpacked), len(set(unpacked))) == (2, 2)
        recording.examined()
        assert len(unpacked) == 2 + 4


@pytest.mark.parametrize(
    ("raw", "shown"),
    [
        ("imu/imu", "imu/imu"),
        ("Größe 速度 скорость سرعة", "Größe 速度 скорость سرعة"),
        ("\x1b[2J", r"\x1b[2J"),
        ("a\nb\tc\x7f", r"a\nb\tc\x7f"),
        ("\x9b2J", r"\x9b2J"),
        ("abc\u202edef\u2066", r"abc\u202edef\u2066"),
        ("\u2028\ud800", r"\u2028\ud800"),
    ],
)
def test_what_is_printable_stays_and_the_rest_is_escaped(raw: str, shown: str) -> None:
    assert printable(raw) == shown


@pytest.fixture
def caneflow(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """The command, run in this process: its exit status and all that it said."""

    def run(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["caneflow", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            command.main()
        said = capsys.readouterr()
        return int(end.value.code or 0), said.out + said.err

    return run


TOOLS = [
    ("info", "REC"),
    ("info", "REC", "--full"),
    ("recover", "REC", "-o", "OUT"),
    ("export", "REC", "--format", "csv"),
    ("export", "REC", "--format", "csv", "--stream", "no/such"),
    ("export", "REC", "--format", "foxglove", "-o", "OUT"),
    ("plot", "REC", "-o", "OUT.png"),
    ("verify", ROOT / "dataflow.yaml", "REC"),
    ("eval", "REC", "--flow", ROOT / "dataflow.yaml", "--methods", "kalman"),
    ("bench", "REC", "--flow", ROOT / "dataflow.yaml"),
    ("calibrate", "room", "REC", "REC", "-o", "OUT.yaml"),
    ("run", ROOT / "dataflow.yaml", "--replay", "REC", "--in-process"),
]


@pytest.mark.parametrize("rig", ["as it is", "sound"])
@pytest.mark.parametrize("words", TOOLS, ids=lambda words: " ".join(map(str, words[:1])))
def test_no_name_of_a_recording_reaches_the_terminal_raw(
    caneflow: Callable[..., tuple[int, str]], tmp_path: Path, words: tuple[object, ...], rig: str
) -> None:
    path = tmp_path / "names.mcap"
    data = hostile.with_names()
    if rig == "sound":
        data = re.sub(rb"\x0c.{8}\x03\0\0\0rig.*?(?=\x03.{8}\x01\0)", lambda _: hostile.RIG, data, flags=re.DOTALL)
    path.write_bytes(data)
    of = {"REC": path, "OUT": tmp_path / "out.mcap", "OUT.png": tmp_path / "out.png", "OUT.yaml": tmp_path / "rig.yaml"}
    _, said = caneflow(*(of.get(str(word), word) for word in words))
    assert said.strip()
    assert not RAW.search(said), said
    assert "Traceback" not in said


def test_a_name_in_an_error_of_the_command_is_shown_escaped(
    caneflow: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    assert caneflow("info", tmp_path / "\x1b[2J.mcap")[1].count(r"\x1b[2J.mcap") == 1
    assert not RAW.search(caneflow("check", "\x1b[2J")[1])
    assert not RAW.search(caneflow("\x1b[2J")[1])


def test_a_newer_layout_is_named(tmp_path: Path) -> None:
    path = tmp_path / "newer.mcap"
    path.write_bytes(
        hostile.MAGIC + hostile.HEADER + hostile.metadata("caneflow", {**hostile.ABOUT, "version": "9"}) + hostile.RIG
    )
    with pytest.raises(RecordingError, match=r"has version 9 of the layout; this version of caneflow reads version 1"):
        Recording(path)


def test_a_wrong_rig_names_its_recording(tmp_path: Path) -> None:
    path = tmp_path / "rig.mcap"
    rig = hostile.metadata("rig", {"json": '{"hand_height": -1}'})
    path.write_bytes(hostile.MAGIC + hostile.HEADER + hostile.FLOW + rig)
    with Recording(path) as recording, pytest.raises(RecordingError, match=rf"^{path}: rig\.hand_height: "):
        recording.validated_rig()
