"""Messages of a user's own: defined in their own file, known to every process, recorded and read back."""

import importlib
import json
import re
import sys
import textwrap
from collections.abc import Iterator
from contextlib import nullcontext
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader

from caneflow.messages import Imu, MessageError, Sample, decode, numbered, registry
from caneflow.messages.arrays import to_bytes
from caneflow.messages.rig import read_rig
from caneflow.recording import Recorded, Recording, RecordingWriter
from caneflow.recording.export_parquet import export_parquet
from caneflow.recording.untyped_rows import untyped_rows
from caneflow.runtime.dataflow.loading import examine
from caneflow.runtime.hosts.attached.attach import Heard
from caneflow.runtime.hosts.process.events import Arrived
from caneflow.runtime.hosts.process.inputs import check_schema
from caneflow.runtime.plan import InputPlan
from caneflow.runtime.stages.snapshot import pack, unpack
from caneflow.runtime.user_files import kind_at, module_of, place_of
from caneflow.viewing.live import LiveStreams
from tests.flows import caneflow, caneflow_here
from tools.echo import told

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


@pytest.fixture(autouse=True)
def forgotten_afterwards(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test imports from its folder is gone with it, as with a process."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    tables: tuple[dict[str, Any], ...] = (registry.SAMPLES, registry._definitions, sys.modules)
    before = [dict(table) for table in tables]
    yield
    for table, old in zip(tables, before, strict=True):
        for name in set(table) - set(old):
            del table[name]


def said(project: Path, *arguments: object) -> str:
    done = caneflow_here(*arguments, cwd=project)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


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
    done = caneflow("run", "own.yaml", "--replay", "still.mcap", "--record", name, *options, cwd=project)
    assert "Traceback" not in done.stderr
    assert done.returncode == 0, done.stderr
    return recorded(project / name)


def test_every_host_carries_it_and_records_it_under_its_schema(project: Path) -> None:
    inside = run(project, "inside.mcap", "--in-process")
    spread = run(project, "spread.mcap", "--speed", "max")
    assert inside == spread == run(project, "grouped.mcap", "--speed", "max", "--one-process")
    name, schema, payloads = spread["own/doubler/range"]
    assert name == schema["title"] == "mine.Range/1"
    assert schema["required"] == ["stamp", "seq", "distance"]
    assert [msgpack.unpackb(payload) for payload in payloads] == [
        {"stamp": seq * STEP, "seq": seq, "distance": 5.0, "name": "twice"} for seq in range(SAMPLES)
    ]
    verified = said(project, "verify", "own.yaml", "spread.mcap")
    assert f"doubler/range: {SAMPLES} of {SAMPLES} samples equal in every byte" in verified


def test_who_does_not_know_the_type_shows_its_fields(project: Path) -> None:
    """Those that the wire leaves out, as they are the default, are in the recorded JSON Schema."""
    run(project, "out.mcap", "--in-process")
    assert "mine.Range/1" not in registry.SAMPLES, "nobody here knows it"
    assert re.search(rf"^ranger/range +mine\.Range/1 +{SAMPLES} ", said(project, "info", "out.mcap"), re.MULTILINE)
    table = said(project, "export", "out.mcap", "--format", "csv", "--stream", "ranger/range")
    assert table.splitlines()[:3] == [
        "stamp,seq,distance,name",
        "0,0,2.5,front",
        f"{STEP},1,2.5,front",
    ]
    with Recording(project / "out.mcap") as recording:
        if find_spec("polars") is not None:
            export_parquet(recording, recording.stream("ranger", "range"), project / "range.parquet")
            rows = importlib.import_module("polars").read_parquet(project / "range.parquet")
            assert rows.row(1) == (STEP, 1, 2.5, "front")
    schema = said(project, "schema", "out.mcap:mine.Range/1")
    assert json.loads(schema) == recorded(project / "out.mcap")["own/ranger/range"][1]
    assert schema == said(project, "schema", "ranges.py:Range")
    assert set(json.loads(said(project, "schema", "own.yaml"))) == {"caneflow.Imu/1", "mine.Range/1"}


def test_an_external_node_may_send_it_and_a_recording_stands_in_for_that(project: Path) -> None:
    whole = run(project, "whole.mcap", "--in-process")
    external = [line for line in FLOW.splitlines() if "imu" not in line]
    for named in ("Range", "./ranges.py:Range", "mine.Range/1"):
        lines = [*external[:3], f"  ranger: {{external: true, outputs: {{range: {named}}}}}", *external[3:]]
        (project / "own.yaml").write_text("\n".join(lines))
        graph, _ = examine(project / "own.yaml")
        assert graph is not None
        assert graph.nodes["ranger"].outputs["range"].schema == "mine.Range/1"
    done = caneflow("run", "own.yaml", "--replay", "whole.mcap", "--record", "part.mcap", "--speed", "max", cwd=project)
    assert done.returncode == 0, done.stderr
    part = recorded(project / "part.mcap")
    assert part == {key: whole[key] for key in ("own/ranger/range", "own/doubler/range")}


def test_a_name_that_no_program_of_the_flow_defines_is_told_where_to_find(project: Path) -> None:
    (project / "own.yaml").write_text("flow: own\nnodes:\n  front: {external: true, outputs: {range: mine.Range/1}}\n")
    graph, [problem] = examine(project / "own.yaml")
    assert graph is None
    assert "no message 'mine.Range/1'" in problem.text
    assert "a message of your own is named by its file and class, e.g. ./ranges.py:Range" in problem.text


def test_echo_shows_what_msgpack_has() -> None:
    fields = {"stamp": 1_500_000_000, "seq": 3, "distance": 2.5, "hits": list(range(9)), "about": {"on": True}}
    heard = Heard("f/front/range", "mine.Distance/1", msgpack.packb(fields), 0)
    line = told(heard, {}, as_json=False)
    assert line == "front/range  3  1.500000000  distance=2.5 hits=(0, 1, 2, ..., 6, 7, 8) about={on=True}"
    assert json.loads(told(heard, {}, as_json=True)) == {"stream": "front/range", "schema": "mine.Distance/1", **fields}
    del fields["seq"]
    heard = Heard("f/front/range", "mine.Distance/1", msgpack.packb(fields), 0)
    assert told(heard, {}, as_json=False).startswith("front/range  refused: seq is missing")


def test_view_counts_it_under_its_name() -> None:
    streams = LiveStreams(flow="f", rig=read_rig({}))
    streams.take("front/range", decode(msgpack.packb({"stamp": 5, "seq": 0, "distance": 2.5}), Sample), 6, "mine.Far/1")
    batch = msgpack.unpackb(streams.batch())
    assert batch["traffic"]["front/range"]["type"] == "mine.Far"
    assert batch["traffic"]["front/range"]["count"] == 1


def test_an_operator_may_keep_one_in_its_snapshot(project: Path) -> None:
    (project / "kept_ranges.py").write_text(RANGES.replace("mine.Range", "mine.Kept"))
    kind: Any = kind_at(f"{project / 'kept_ranges.py'}:Range")
    assert place_of(kind) == f"{project / 'kept_ranges.py'}:Range"
    assert importlib.import_module("kept_ranges").Range is kind
    last = kind(stamp=1, distance=2.5, name="last")
    assert unpack(pack({"last": last}, "__main__"), "__main__") == {"last": last}


def test_a_file_that_was_edited_is_read_again_and_no_other(project: Path) -> None:
    file = project / "edited_ranges.py"
    file.write_text(RANGES.replace("mine.Range", "mine.Edited"))
    first = module_of(file)
    assert module_of(file) is first
    file.write_text(RANGES.replace("mine.Range", "mine.Edited").replace("distance", "length"))
    second = module_of(file)
    assert {"length", "name"} < set(second.Range.__struct_fields__)
    assert second is importlib.import_module("edited_ranges")


def test_one_process_has_one_class_of_a_name_whichever_file_comes_first(project: Path) -> None:
    """`doubler` imports the message from the file of another node's program."""
    ranger = project / "ranger.py"
    ranger.write_text(textwrap.dedent(RANGES) + ranger.read_text().replace("from ranges import Range\n", ""))
    doubler = project / "doubler.py"
    doubler.write_text(doubler.read_text().replace("from ranges", "from ranger"))
    expected = run(project, "one.mcap", "--in-process")
    assert run(project, "processes.mcap", "--speed", "max") == expected
    assert run(project, "grouped.mcap", "--speed", "max", "--one-process") == expected
    lines = (project / "own.yaml").read_text().splitlines()
    lines[4], lines[5] = lines[5], lines[4]  # now `doubler` comes first
    (project / "own.yaml").write_text("\n".join(lines))
    assert run(project, "two.mcap", "--in-process") == expected


def test_two_files_that_define_one_schema_are_named_both(project: Path) -> None:
    (project / "others.py").write_text(RANGES.replace("distance", "length"))
    doubler = project / "doubler.py"
    doubler.write_text(doubler.read_text().replace("ranges", "others").replace("distance", "length"))
    graph, [problem] = examine(project / "own.yaml")
    assert graph is None
    line = str(problem)
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
    graph, problems = examine(project / "own.yaml")
    assert graph is None
    assert said in str(problems[0])


def test_rows_of_an_unknown_type_have_a_column_per_element_of_a_vector() -> None:
    vector = {"type": "array", "minItems": 2, "maxItems": 2}
    schema = {
        "properties": {
            "place": {"anyOf": [vector, {"type": "null"}]},
            "hits": {"type": "array"},
            "name": {"default": "front"},
            "stamp": {},
        }
    }
    field = np.zeros((2, 3), np.float32)
    rows = [
        {"stamp": 7, "seq": 0, "place": [1.5, 2.5], "hits": [], "field": msgpack.ExtType(1, to_bytes(field))},
        {"stamp": 8, "seq": 1, "hits": [{"at": 1}], "name": "left"},
    ]
    samples = [Recorded("f/a/b", "a", "b", None, 0, 0, 0, msgpack.packb(row)) for row in rows]
    assert list(untyped_rows(iter(samples), schema)) == [
        ["stamp", "seq", "place_0", "place_1", "hits", "name", "field"],
        [7, 0, 1.5, 2.5, "[]", "front", "float32[2, 3]"],
        [8, 1, None, None, '[{"at": 1}]', "left", None],
    ]
    assert list(untyped_rows(iter([]), schema)) == []


@pytest.mark.parametrize(
    ("said", "refused"),
    [
        ("mine.Range/1", False),
        ("mine.Range/2", True),
        ("caneflow.Imu/1", True),
        ("", False),
        ("application/msgpack", False),
    ],
)
def test_a_sample_that_says_another_schema_is_refused(said: str, refused: bool) -> None:
    wire = InputPlan(key="f/a/range", schema="mine.Range/1", writer="a")
    arrived = Arrived(node="b", port="range", payload=b"", schema=said)
    with pytest.raises(MessageError, match="the port takes") if refused else nullcontext():
        check_schema(arrived, wire)
