"""`caneflow check` and `caneflow graph`, as a user calls them."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from caneflow.runtime.dataflow.graph_pictures import as_dot, as_svg
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.errors import DataflowError
from tools import check, graph

FLOW = """\
flow: demo
machines:
  gateway: {listen: [tcp/0.0.0.0:7447]}
  phone: {connect: [tcp/gateway.local:7447]}
nodes:
  imu: {run: drivers.bno055, machine: gateway}
  belt: {external: true, machine: gateway, outputs: {imu: Imu}}
  end: {run: my/relay.py, machine: phone, inputs: {imu: imu/imu, belt: {from: belt/imu, queue: latest}}}
"""

RELAY = """
from caneflow.messages import Sample, Pose
from caneflow.runtime import ANY_PORT, Operator

class Relay(Operator):
    inputs = {ANY_PORT: Sample}
    outputs = {"pose": Pose}
    def __init__(self, settings, context): ...
    def handle(self, port, message):
        return ()
"""


def called(tool: Any, *arguments: str) -> tuple[int, str]:
    """Exit status and standard output of a tool."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(tool.command)
    result = CliRunner().invoke(app, arguments, catch_exceptions=True)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "my").mkdir()
    (tmp_path / "my" / "relay.py").write_text(RELAY)
    path = tmp_path / "flow.yaml"
    path.write_text(FLOW)
    return path


def test_a_sound_file_is_ok_with_its_warnings(file: Path) -> None:
    status, out = called(check, str(file))

    assert status == 0
    assert out.splitlines() == [
        f"{file}:8:3: warning: nodes.end: no node reads its output end/pose (caneflow.Pose/1);"
        " wire it, or list it under results",
        f"{file}: ok, 3 nodes, 2 wires",
    ]


def test_mistakes_are_printed_one_a_line_and_the_status_is_1(file: Path) -> None:
    file.write_text(FLOW.replace("drivers.bno055", "drivers.bno05"))

    status, out = called(check, str(file), "--set", "end.x=1", "--set", "imu.rate=500")

    assert status == 1
    first, second = out.splitlines()
    assert first.startswith(f"{file}:6:14: nodes.imu.run: no program 'drivers.bno05' in ")
    assert second == "--set end.x=1: nodes.end.settings.x: unknown key; allowed are none"


def test_json_has_the_same_in_parts(file: Path) -> None:
    status, out = called(check, str(file), "--json")
    sound = json.loads(out)
    assert (status, sound["ok"], sound["nodes"], sound["wires"], sound["mistakes"]) == (0, True, 3, 2, [])
    assert [(w["line"], w["column"], w["path"]) for w in sound["warnings"]] == [(8, 3, "nodes.end")]

    status, out = called(check, str(file), "--json", "--set", "imu.rate=500")
    wrong = json.loads(out)
    assert (status, wrong["ok"], wrong["nodes"]) == (1, False, None)
    assert wrong["mistakes"] == [
        {
            "source": "--set imu.rate=500",
            "line": None,
            "column": None,
            "path": "nodes.imu.settings.rate",
            "text": "is 500; it takes a number, at least 0.01 and at most 100",
        }
    ]


def test_a_rig_is_checked_with_the_file(file: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text("hand_height: 0.9\n")
    assert called(check, str(file), "--rig", str(rig))[0] == 0

    rig.write_text("hand_height: -0.9\n")
    with pytest.raises(
        DataflowError, match=r"rig\.yaml:1:14: hand_height: is -0\.9; it takes a number, at least 0\.01"
    ):
        called(check, str(file), "--rig", str(rig))


def test_a_file_that_is_not_there_is_a_mistake_and_no_traceback(tmp_path: Path) -> None:
    assert called(check, str(tmp_path / "no.yaml")) == (
        1,
        f"{tmp_path / 'no.yaml'}: cannot be read: No such file or directory\n",
    )


def test_mermaid_has_programs_in_boxes_and_messages_on_arrows(file: Path) -> None:
    assert called(graph, str(file)) == (
        0,
        """\
flowchart LR
    subgraph machine_gateway[gateway]
        node_imu["imu<br/>drivers.bno055"]
        node_belt["belt<br/>external"]
    end
    subgraph machine_phone[phone]
        node_end["end<br/>my/relay.py"]
    end
    node_imu -- "imu: Imu" --> node_end
    node_belt -- "imu: Imu" --> node_end
""",
    )


def test_json_has_nodes_and_edges(file: Path) -> None:
    picture = json.loads(called(graph, str(file), "--format", "json")[1])

    assert [(node["name"], node["run"], node["machine"]) for node in picture["nodes"]] == [
        ("imu", "drivers.bno055", "gateway"),
        ("belt", None, "gateway"),
        ("end", "my/relay.py", "phone"),
    ]
    assert [(e["from"], e["to"], e["type"], e["queue"]) for e in picture["edges"]] == [
        ("imu/imu", "end/imu", "caneflow.Imu/1", "all"),
        ("belt/imu", "end/belt", "caneflow.Imu/1", "latest"),
    ]


def test_a_picture_may_go_to_a_file(file: Path, tmp_path: Path) -> None:
    out = tmp_path / "flow.mmd"

    assert called(graph, str(file), "-o", str(out)) == (0, "")
    assert out.read_text().startswith("flowchart LR\n")


def test_svg_without_graphviz_is_one_line(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")

    with pytest.raises(DataflowError, match=r"^no `dot` on this machine; install Graphviz, or use --format mermaid$"):
        called(graph, str(file), "--format", "svg")


def test_svg_is_what_dot_makes_of_the_graph(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dot = tmp_path / "dot"
    dot.write_text('#!/bin/sh\necho "<svg $1>"\ncat\n')
    dot.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    flow = load(file)

    assert as_svg(flow) == "<svg -Tsvg>\n" + as_dot(flow)
    dot.write_text("#!/bin/sh\nexit 3\n")
    with pytest.raises(DataflowError, match=r"did not draw the graph: .* non-zero exit status 3"):
        as_svg(flow)


def test_graphviz_draws_every_node(file: Path) -> None:
    if shutil.which("dot") is None:
        pytest.skip("Graphviz is not here")

    drawn = as_svg(load(file))

    assert all(f">{name}</text>" in drawn for name in ("imu", "belt", "end"))


def test_the_graph_of_a_wrong_file_is_not_drawn(file: Path) -> None:
    file.write_text(FLOW.replace("imu/imu", "imu/im"))

    with pytest.raises(DataflowError, match=r"flow\.yaml:8:57: nodes\.end\.inputs\.imu: no output 'imu/im'"):
        called(graph, str(file))


def test_the_command_itself_says_the_same(file: Path) -> None:
    file.write_text("flow: [demo\n")

    caneflow = Path(sys.executable).with_name("caneflow")
    done = subprocess.run([caneflow, "check", file], capture_output=True, text=True, check=False)

    assert done.returncode == 1
    assert done.stdout == f"{file}:2:1: not YAML: expected ',' or ']', but got '<stream end>'\n"
    assert done.stderr == ""
