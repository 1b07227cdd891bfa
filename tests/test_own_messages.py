"""Messages of a user's own: defined in their own file, known to every process, recorded and read back."""

import json
import subprocess
import textwrap
from pathlib import Path

import msgpack
import pytest
from mcap.reader import make_reader

from caneflow.messages import Imu, numbered
from caneflow.recording import RecordingWriter
from tests.flows import CANEFLOW

STEP = 10_000_000  # ns
SAMPLES = 40
RANGES = """
from caneflow.messages import Sample

class Range(Sample, frozen=True, kw_only=True):
    schema = "mine.Range/1"
    distance: float
    name: str = "front"
"""
OPERATOR = """
from {where} import Range
from caneflow.messages import Imu
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class Own(Operator):
    inputs = {{"{port}": {taken}}}
    outputs = {{"range": Range}}

    def __init__(self, settings, context):
        assert all(kind in (Imu, Range) for kind in context.ports.values()), "the class that this file imports"

    def handle(self, port, message):
        assert isinstance(message, {taken})
        yield "range", Range(stamp=message.stamp, {fields})

if __name__ == "__main__":
    run(Own)
"""
FLOW = """
flow: own
nodes:
  imu: {external: true, outputs: {imu: Imu}}
  ranger: {run: ./ranger.py, inputs: {imu: imu/imu}}
  doubler: {run: ./doubler.py, inputs: {range: ranger/range}}
results: [doubler/range]
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with a message, two operators that send and read it, their flow, and a recording for it."""
    (tmp_path / "ranges.py").write_text(RANGES)
    ranger = OPERATOR.format(where="ranges", port="imu", taken="Imu", fields="distance=2.5")
    doubler = OPERATOR.format(where="ranges", port="range", taken="Range", fields="distance=2 * message.distance")
    (tmp_path / "ranger.py").write_text(ranger)
    (tmp_path / "doubler.py").write_text(doubler.replace("2 * message.distance", '2 * message.distance, name="twice"'))
    (tmp_path / "own.yaml").write_text(FLOW)
    with RecordingWriter(tmp_path / "still.mcap", flow="own", source="simulated", rig={}) as writer:
        for seq in range(SAMPLES):
            imu = Imu(stamp=seq * STEP, gyro=(0.0, 0.0, 0.1))
            writer.write("own/imu/imu", Imu, numbered(imu, seq), stamp=imu.stamp, seq=seq, log_time=imu.stamp)
    return tmp_path


def caneflow(project: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([*CANEFLOW, *map(str, arguments)], cwd=project, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    return done


def recorded(path: Path) -> dict[str, tuple[str, dict[str, object], list[bytes]]]:
    """By topic the schema's name, the JSON Schema and the payloads, as any reader of MCAP has them."""
    found: dict[str, tuple[str, dict[str, object], list[bytes]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None
            entry = found.setdefault(channel.topic, (schema.name, json.loads(schema.data), []))
            entry[2].append(message.data)
    return found


def run(project: Path, name: str, *options: object) -> dict[str, tuple[str, dict[str, object], list[bytes]]]:
    done = caneflow(project, "run", "own.yaml", "--replay", "still.mcap", "--record", name, *options)
    assert done.returncode == 0, done.stderr
    return recorded(project / name)


def test_every_host_carries_it_and_records_it_under_its_schema(project: Path) -> None:
    inside = run(project, "inside.mcap", "--in-process")
    spread = run(project, "spread.mcap", "--speed", "max")
    assert inside == spread
    name, schema, payloads = spread["own/doubler/range"]
    assert name == schema["title"] == "mine.Range/1"
    assert schema["required"] == ["stamp", "seq", "distance"]
    assert [msgpack.unpackb(payload) for payload in payloads] == [
        {"stamp": seq * STEP, "seq": seq, "distance": 5.0, "name": "twice"} for seq in range(SAMPLES)
    ]
    verified = caneflow(project, "verify", "own.yaml", "spread.mcap")
    assert f"doubler/range: {SAMPLES} of {SAMPLES} samples equal in every byte" in verified.stdout, verified.stderr


def test_one_process_has_one_class_of_a_name_whichever_file_comes_first(project: Path) -> None:
    """`doubler` imports the message from the file of another node's program."""
    ranger = project / "ranger.py"
    ranger.write_text(textwrap.dedent(RANGES) + ranger.read_text().replace("from ranges import Range\n", ""))
    doubler = project / "doubler.py"
    doubler.write_text(doubler.read_text().replace("from ranges", "from ranger"))
    expected = run(project, "one.mcap", "--in-process")
    assert run(project, "processes.mcap", "--speed", "max") == expected
    lines = (project / "own.yaml").read_text().splitlines()
    lines[4], lines[5] = lines[5], lines[4]  # now `doubler` comes first
    (project / "own.yaml").write_text("\n".join(lines))
    assert run(project, "two.mcap", "--in-process") == expected


def test_two_files_that_define_one_schema_are_named_both(project: Path) -> None:
    (project / "others.py").write_text(RANGES.replace("distance", "length"))
    doubler = project / "doubler.py"
    doubler.write_text(doubler.read_text().replace("ranges", "others").replace("distance", "length"))
    done = caneflow(project, "check", "own.yaml")
    assert done.returncode == 1
    [line] = (done.stdout + done.stderr).splitlines()
    assert "schema mine.Range/1 is defined twice, as Range in " in line
    assert f"{project / 'ranges.py'}:4 and as Range in {project / 'others.py'}:4" in line


@pytest.mark.parametrize(
    ("written", "instead", "said"),
    [
        ('    schema = "mine.Range/1"\n', "", 'Range has no schema; give it one, e.g. schema = "mine.Range/1"'),
        ("mine.Range/1", "mine.Range", "schema 'mine.Range' is not valid; expected names, then a slash and a version"),
        ("mine.Range/1", "caneflow.Imu/1", "schema caneflow.Imu/1 is defined twice, as Imu in "),
        ("frozen=True", "array_like=True", "Range is not a map with stamp and seq"),
        ("frozen=True", "frozen=False", "Range is not frozen"),
        ("distance: float", "distance: complex", "Range cannot travel: the wire has nothing for a complex"),
    ],
    ids=["no schema", "no version", "one of ours", "array", "not frozen", "no type of the wire"],
)
def test_what_cannot_travel_is_refused_by_check(project: Path, written: str, instead: str, said: str) -> None:
    (project / "ranges.py").write_text(RANGES.replace(written, instead))
    done = caneflow(project, "check", "own.yaml")
    assert done.returncode == 1
    assert said in done.stdout + done.stderr
