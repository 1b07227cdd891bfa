"""Every mistake is found before anything starts: all at once, each with its place and what would be right."""

import itertools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.runtime.dataflow.loading import examine, load
from caneflow.runtime.errors import DataflowError

PROGRAM = """
from dataclasses import dataclass, field
from typing import Annotated, Literal
from annotated_types import Gt, Lt
from caneflow.messages import GroundSpeed, Imu, Pose, RadarFrame
from caneflow.runtime import Operator

@dataclass(frozen=True, kw_only=True)
class Observer:
    pole: Annotated[float, Gt(0), Lt(1)] = 0.5
    gains: tuple[float, float] = (1.0, 2.0)

    def __post_init__(self):
        if self.pole == 0.25:
            raise ValueError("pole is 0.25; that one resonates")

@dataclass(frozen=True, kw_only=True)
class Settings_:
    method: Literal["luenberger", "kalman"] = "luenberger"
    count: int = 1
    live: bool = False
    observer: Observer = field(default_factory=Observer)

class Fuse(Operator):
    inputs = {"imu": Imu, "speed": GroundSpeed}
    outputs = {"pose": Pose}
    Settings = Settings_
    def __init__(self, settings, context): ...
    def handle(self, port, message):
        return ()
"""

SPEED = """
from caneflow.messages import GroundSpeed, RadarFrame
from caneflow.runtime import Operator

class Speed(Operator):
    inputs = {"frame": RadarFrame}
    outputs = {"speed": GroundSpeed}
    def __init__(self, settings, context): ...
    def handle(self, port, message):
        return ()
"""

RELAY = """
from caneflow.messages import Sample, Imu
from caneflow.runtime import ANY_PORT, Operator

class Relay(Operator):
    inputs = {ANY_PORT: Sample}
    outputs = {"out": Imu}
    def __init__(self, settings, context): ...
    def handle(self, port, message):
        return ()
"""

FLOW = """\
flow: demo
nodes:
  imu: {run: drivers.bno055}
  radar: {run: drivers.p440}
  speed: {run: speed.py, inputs: {frame: radar/frame}}
  fuse: {run: fuse.py, inputs: {imu: imu/imu, speed: speed/speed}}
results: [fuse/pose]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return with_programs(tmp_path)


def with_programs(folder: Path) -> Path:
    for name, program in (("fuse", PROGRAM), ("speed", SPEED), ("relay", RELAY)):
        (folder / f"{name}.py").write_text(program)
    return folder


def mistakes(folder: Path, text: str, *overrides: str) -> list[str]:
    """What is said of a file with `text`, without the file's name."""
    path = folder / "flow.yaml"
    path.write_text(text)
    with pytest.raises(DataflowError) as caught:
        load(path, overrides)
    return [line.replace(f"{path}:", "").replace(str(folder), "DIR") for line in str(caught.value).splitlines()]


def test_the_flow_of_these_tests_is_sound(folder: Path) -> None:
    (folder / "flow.yaml").write_text(FLOW)

    assert load(folder / "flow.yaml").warnings == ()


def test_seven_mistakes_are_seven_lines_in_the_order_of_the_file(folder: Path) -> None:
    text = """\
flow: demo
colour: red
rig: {boresight: [0, 1, 0], hand_height: tall, aperture: 0.87}
nodes:
  imu: {run: drivers.nosuch}
  radar: {run: drivers.p440, restarts: maybe}
  speed: {run: speed.py, inputs: {frame: radar/frames}}
  fuse: {run: fuse.py, inputs: {imu: imu/imu, speed: radar/frame}, settings: {method: magic}}
"""
    lines = mistakes(folder, text)

    assert (
        lines[0]
        == "2:1: colour: unknown key; allowed are flow, insecure, links, machines, nodes, results, rig, router, seed"
    )
    about = "it takes a number, at least 0.01 and at most 10 (m, of the hand above ground)"
    assert lines[1] == f"3:42: rig.hand_height: is 'tall'; {about}"
    assert re.match(r"5:14: nodes\.imu\.run: no program 'drivers\.nosuch' in .*drivers.*operators; ", lines[2])
    assert "there are drivers.a121, drivers.bno055" in lines[2]
    assert lines[3].startswith("6:30: nodes.radar.restarts: unknown key; did you mean 'restart'? allowed are ext")
    assert lines[4] == (
        "7:42: nodes.speed.inputs.frame: no output 'radar/frames'; did you mean 'radar/frame'? "
        "there are radar/frame, fuse/pose"
    )
    assert lines[5] == (
        "8:54: nodes.fuse.inputs.speed: radar/frame carries caneflow.RadarFrame/1, "
        "and this input takes caneflow.GroundSpeed/1; wire it to speed/speed"
    )
    assert lines[6] == "8:87: nodes.fuse.settings.method: is 'magic'; it takes one of luenberger, kalman"
    assert len(lines) == 7


ONE_MISTAKE = {
    # what is replaced, by what, and what is said of it
    "no flow": ("flow: demo\n", "", "1:1: flow: is missing; name the flow, e.g. `flow: cane`"),
    "name with capitals": (
        "flow: demo",
        "flow: Demo",
        "1:7: flow: is 'Demo'; it takes text such as cane "
        "(first part of every key: a lower-case letter, then lower-case letters, digits or _)",
    ),
    "node with a dash": (
        "  imu: {",
        "  im-u: {run: drivers.bno055}\n  imu: {",
        "3:3: nodes.im-u: not a valid name; expected a lower-case letter, then lower-case letters, digits or _",
    ),
    "node that is not a mapping": (
        "{run: drivers.bno055}",
        "drivers.bno055",
        "3:8: nodes.imu: is 'drivers.bno055'; it takes a mapping",
    ),
    "no program": (
        "{run: drivers.bno055}",
        "{}",
        "3:3: nodes.imu.run: is missing; name a program, e.g. `run: drivers.bno055`",
    ),
    "file that is not there": (
        "run: speed.py",
        "run: sped.py",
        "5:16: nodes.speed.run: no Python file 'DIR/sped.py'; did you mean 'speed.py'? "
        "there are fuse.py, relay.py, speed.py",
    ),
    "room that is none": (
        "run: drivers.bno055",
        "run: tools.check",
        "3:14: nodes.imu.run: no program 'tools.check' in ",
    ),
    "wire without a slash": (
        "frame: radar/frame",
        "frame: radar.frame",
        "5:42: nodes.speed.inputs.frame: is 'radar.frame'; it takes text such as radar/frame or a mapping "
        "(node/output, or a mapping that says more)",
    ),
    "wire to a node that is not there": (
        "imu: imu/imu",
        "imu: imux/imu",
        "6:38: nodes.fuse.inputs.imu: no output 'imux/imu'; did you mean 'imu/imu'? "
        "there are imu/imu, radar/frame, speed/speed",
    ),
    "input that is not wired": (
        "imu: imu/imu, ",
        "",
        "6:24: nodes.fuse.inputs.imu: is not wired; it takes caneflow.Imu/1: wire it to imu/imu",
    ),
    "input that the program lacks": (
        "{frame: radar/frame}",
        "{frame: radar/frame, image: radar/frame}",
        "5:55: nodes.speed.inputs.image: speed.py has no input 'image'; its inputs are frame",
    ),
    "inputs of a source": (
        "{run: drivers.bno055}",
        "{run: drivers.bno055, inputs: {x: radar/frame}}",
        "3:39: nodes.imu.inputs.x: drivers.bno055 has no input 'x'; it reads nothing",
    ),
    "operator that would never run": (
        "results:",
        "  relay: {run: relay.py}\nresults:",
        "7:3: nodes.relay: relay.py reads nothing here, so it would never run; its inputs are *",
    ),
    "queue": (
        "frame: radar/frame",
        "frame: {from: radar/frame, queue: fifo 0}",
        "5:69: nodes.speed.inputs.frame.queue: is 'fifo 0'; it takes text such as latest, fifo 10, all (live: ",
    ),
    "age": (
        "frame: radar/frame",
        "frame: {from: radar/frame, max_age_ms: 0}",
        "5:74: nodes.speed.inputs.frame.max_age_ms: is 0; it takes a number, at least 0.1 and at most 3600000 (ms",
    ),
    "input without its writer": (
        "frame: radar/frame",
        "frame: {queue: all}",
        "5:35: nodes.speed.inputs.frame.from: is missing; it takes text such as radar/frame (node and output)",
    ),
    "restart": (
        "run: drivers.bno055",
        "run: drivers.bno055, restart: alway",
        "3:39: nodes.imu.restart: is 'alway'; did you mean 'always'? it takes one of never, on-failure, always",
    ),
    "restart delays": (
        "run: drivers.bno055",
        "run: drivers.bno055, restart: {delay_s: 5, max_delay_s: 1}",
        "3:49: nodes.imu.restart.delay_s: is 5 s, more than max_delay_s, 1 s",
    ),
    "too patient": (
        "run: drivers.bno055",
        "run: drivers.bno055, ready_timeout_s: .inf",
        "3:47: nodes.imu.ready_timeout_s: is Infinity; it takes a number, at least 0.1 and at most 3600 (s from its ",
    ),
    "text for a number": (
        "run: fuse.py",
        "run: fuse.py, settings: {count: '3'}",
        "6:42: nodes.fuse.settings.count: is '3'; it takes a whole number",
    ),
    "truth for a number": (
        "run: fuse.py",
        "run: fuse.py, settings: {observer: {pole: true}}",
        "6:52: nodes.fuse.settings.observer.pole: is true; it takes a number, above 0 and below 1",
    ),
    "number for a truth": (
        "run: fuse.py",
        "run: fuse.py, settings: {live: 1}",
        "6:41: nodes.fuse.settings.live: is 1; it takes true or false",
    ),
    "out of range": (
        "run: fuse.py",
        "run: fuse.py, settings: {observer: {pole: 1.0}}",
        "6:52: nodes.fuse.settings.observer.pole: is 1.0; it takes a number, above 0 and below 1",
    ),
    "too short": (
        "run: fuse.py",
        "run: fuse.py, settings: {observer: {gains: [1]}}",
        "6:53: nodes.fuse.settings.observer.gains: is [1]; it takes a list of 2",
    ),
    "unknown setting far down": (
        "run: fuse.py",
        "run: fuse.py, settings: {observer: {poles: 1}}",
        "6:46: nodes.fuse.settings.observer.poles: unknown key; did you mean 'pole'? allowed are gains, pole",
    ),
    "settings for a program that has none": (
        "run: speed.py",
        "run: speed.py, settings: {x: 1}",
        "5:37: nodes.speed.settings.x: unknown key; allowed are none",
    ),
    "check of the program's own": (
        "run: fuse.py",
        "run: fuse.py, settings: {observer: {pole: 0.25}}",
        "6:52: nodes.fuse.settings.observer.pole: is 0.25; that one resonates",
    ),
    "check of a driver's own": (
        "run: drivers.p440",
        "run: drivers.p440, settings: {scan_stop_ps: 9000}",
        "4:55: nodes.radar.settings.scan_stop_ps: is 9000; the scan stops after it starts, at 10000 ps",
    ),
    "outputs of a program": (
        "run: drivers.bno055",
        "run: drivers.bno055, outputs: {imu: Imu}",
        "3:30: nodes.imu.outputs: the program says what it sends; only an external node lists outputs",
    ),
    "external with a program": (
        "run: drivers.bno055",
        "run: drivers.bno055, external: true, outputs: {imu: Imu}",
        "3:9: nodes.imu.run: an external node publishes by itself; it has only outputs and machine",
    ),
    "external without outputs": (
        "run: drivers.bno055",
        "external: true",
        "3:3: nodes.imu.outputs: is missing; an external node names them, e.g. {imu: Imu}",
    ),
    "message that is none": (
        "run: drivers.bno055",
        "external: true, outputs: {imu: Immu}",
        "3:40: nodes.imu.outputs.imu: no message 'Immu'; did you mean 'Imu'? there are Cue, DopplerBlock, ",
    ),
    "external with another message": (
        "run: drivers.bno055",
        "external: true, outputs: {imu: Pose}",
        "6:38: nodes.fuse.inputs.imu: imu/imu carries caneflow.Pose/1, and this input takes caneflow.Imu/1; "
        "no node of this flow gives that",
    ),
    "result that is not there": (
        "fuse/pose",
        "fuse/pos",
        "7:11: results.0: no output 'fuse/pos'; did you mean 'fuse",
    ),
    "seed below 0": (
        "flow: demo",
        "flow: demo\nseed: -1",
        "2:7: seed: is -1; it takes a whole number, at least 0 and ",
    ),
    "rig that points nowhere": (
        "flow: demo",
        "flow: demo\nrig: {boresight: [0, 2, 0]}",
        "2:18: rig.boresight: has norm 2; a direction has 1",
    ),
    "machine that is not there": (
        "run: drivers.bno055",
        "run: drivers.bno055, machine: gateway",
        "3:39: nodes.imu.machine: no machine 'gateway'; there are none",
    ),
    "own output": (
        "imu: imu/imu, ",
        "imu: fuse/pose, ",
        "6:38: nodes.fuse.inputs.imu: fuse reads its own output fuse/pose; a node cannot wait for itself",
    ),
    "no nodes": (FLOW[11:], "nodes: {}", "2:8: nodes: there are none; a flow has at least one node"),
}


@pytest.mark.parametrize("name", ONE_MISTAKE)
def test_one_mistake_is_one_line(folder: Path, name: str) -> None:
    old, new, said = ONE_MISTAKE[name]
    assert old in FLOW

    (line,) = mistakes(folder, FLOW.replace(old, new, 1))

    assert line.startswith(said)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("fuse", "--set fuse: is not NODE.KEY=VALUE, e.g. fusion.method=kalman"),
        ("fuse=1", "--set fuse=1: is not NODE.KEY=VALUE, e.g. fusion.method=kalman"),
        ("fuse..x=1", "--set fuse..x=1: is not NODE.KEY=VALUE, e.g. fusion.method=kalman"),
        (
            "fus.live=true",
            "--set fus.live=true: no node 'fus'; did you mean 'fuse'? there are imu, radar, speed, fuse",
        ),
        ("fuse.live=maybe", "--set fuse.live=maybe: nodes.fuse.settings.live: is 'maybe'; it takes true or false"),
        ("fuse.method.x=1", '--set fuse.method.x=1: nodes.fuse.settings.method: is {"x": 1}; it takes one of '),
        (
            "fuse.observer.pol=1",
            "--set fuse.observer.pol=1: nodes.fuse.settings.observer.pol: unknown key; did you ",
        ),
        ("fuse.count=[1", "--set fuse.count=[1: not YAML: expected ',' or ']', but got '<stream end>'"),
        ("fuse.count=", "--set fuse.count=: nodes.fuse.settings.count: is null; it takes a whole number"),
    ],
)
def test_a_wrong_override_is_reported_like_the_rest(folder: Path, override: str, said: str) -> None:
    first, second = mistakes(folder, FLOW + "colour: red\n", override)

    assert first.startswith("8:1: colour: unknown key")
    assert second.startswith(said)


def test_an_override_does_not_cover_up_a_mistake_of_the_file(folder: Path) -> None:
    (line,) = mistakes(folder, FLOW.replace("run: fuse.py", "run: fuse.py, settings: 3"), "fuse.live=true")

    assert line == "6:34: nodes.fuse.settings: is 3; it takes a mapping (the program's own; see its Settings)"


BROKEN_PROGRAMS = {
    "cannot be imported: SyntaxError: invalid syntax (line 2 of DIR/bad.py)": "x = 1\ndef def\n",
    "cannot be imported: ModuleNotFoundError: No module named 'nosuch' (line 1 of DIR/bad.py)": "import nosuch\n",
    "cannot be imported: ZeroDivisionError: division by zero (line 3 of DIR/bad.py)": "\n\n1 / 0\n",
    "cannot be imported: SystemExit: 3 (line 2 of DIR/bad.py)": "import sys\nsys.exit(3)\n",
    "cannot be imported: RuntimeError: two lines (line 1 of DIR/bad.py)": "raise RuntimeError('two\\nlines')\n",
    "'bad.py' holds no program; that is a class derived from Operator, Source or Sink": "x = 1\n",
    "'bad.py' holds several programs: Speed, Other; one file holds one": SPEED + "\nclass Other(Speed): ...\n",
    "'bad.py': Speed does not define handle": SPEED.replace("def handle", "def handel"),
    "'bad.py': Speed.inputs: 'Frame': not a valid port name; expected a lower-case": SPEED.replace(
        '"frame"', '"Frame"'
    ),
    "'bad.py': Speed.outputs not a table of ports; expected e.g. {'imu': Imu}": SPEED.replace(
        '{"speed": GroundSpeed}', '["speed"]'
    ),
    "'bad.py': Speed.Settings cannot be checked: ": SPEED + "\nclass Odd: ...\nSpeed.Settings = Odd\n",
}


@pytest.mark.parametrize("said", BROKEN_PROGRAMS)
def test_a_program_that_cannot_run_is_one_line(folder: Path, said: str) -> None:
    (folder / "bad.py").write_text(BROKEN_PROGRAMS[said])

    (line,) = mistakes(folder, FLOW.replace("speed.py", "bad.py"))

    assert line.startswith("5:16: nodes.speed.run: ")
    assert said in line


def test_settings_whose_own_check_breaks_are_one_line(folder: Path) -> None:
    broken = PROGRAM.replace('raise ValueError("pole is 0.25; that one resonates")', "1 / 0")
    (folder / "fuse.py").write_text(broken)

    (line,) = mistakes(folder, FLOW, "fuse.observer.pole=0.25")

    assert line.startswith(
        "--set fuse.observer.pole=0.25: nodes.fuse.settings: Settings_ breaks on these: ZeroDivisionError: "
    )


def test_an_edited_program_is_read_anew(folder: Path) -> None:
    path = folder / "flow.yaml"
    path.write_text(FLOW)
    load(path)
    (folder / "speed.py").write_text(SPEED.replace('"frame"', '"fraem"'))  # of the same size, within the same second

    assert examine(path)[0] is None


def test_a_program_may_print_and_import_its_neighbour(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "neighbour_of_speed.py").write_text("print('hello')\n")
    (folder / "speed.py").write_text("import neighbour_of_speed\n" + SPEED)
    (folder / "flow.yaml").write_text(FLOW)

    load(folder / "flow.yaml")

    assert capsys.readouterr() == ("", "hello\n")


def test_a_cycle_is_named(folder: Path) -> None:
    text = """\
flow: demo
nodes:
  imu: {run: drivers.bno055}
  a: {run: relay.py, inputs: {imu: imu/imu, c: c/out}}
  b: {run: relay.py, inputs: {a: a/out}}
  c: {run: relay.py, inputs: {b: b/out}}
  d: {run: relay.py, inputs: {c: c/out}}
results: [d/out]
"""
    assert mistakes(folder, text) == [
        "4:48: nodes.a.inputs.c: closes the cycle a -> b -> c -> a: each would wait for the others; "
        "take one of these wires out"
    ]


wirings = st.integers(1, 6).flatmap(
    lambda n: st.lists(
        st.lists(st.sampled_from([f"n{i}" for i in range(n)]), unique=True, max_size=2), min_size=n, max_size=n
    ).map(lambda reads: {f"n{i}": [w for w in writers if w != f"n{i}"] for i, writers in enumerate(reads)})
)


@given(wirings)
@settings(max_examples=15, deadline=None)
def test_cycles_are_reported_exactly_when_a_node_reaches_itself(
    tmp_path_factory: pytest.TempPathFactory, reads: dict[str, list[str]]
) -> None:
    path = with_programs(tmp_path_factory.mktemp("cycle")) / "flow.yaml"
    lines = ["flow: demo", "nodes:", "  imu: {run: drivers.bno055}"]
    for reader, writers in reads.items():
        wires = ", ".join(f"{writer}: {writer}/out" for writer in writers)
        lines.append(f"  {reader}: {{run: relay.py, inputs: {{imu: imu/imu, {wires}}}}}")
    path.write_text("\n".join(lines))

    graph, problems = examine(path)

    reach = {(writer, reader) for reader, writers in reads.items() for writer in writers}
    for _ in reads:  # Warshall's closure, the slow and obvious way
        reach |= {(a, d) for (a, b), (c, d) in itertools.product(reach, reach) if b == c}
    assert (graph is None) == any((name, name) in reach for name in reads)
    for problem in problems:
        if not problem.warning:
            around = problem.text.removeprefix("closes the cycle ").partition(":")[0].split(" -> ")
            assert around[0] == around[-1]
            assert all(writer in reads[reader] for writer, reader in itertools.pairwise(around))


# A setting of each level, where a stray key may be put in.
LEVELS: dict[str, tuple[str, ...]] = {
    "": (),
    "rig": ("rig",),
    "rig.sensors.south": ("rig", "sensors", "south"),
    "machines.here": ("machines", "here"),
    "nodes.imu": ("nodes", "imu"),
    "nodes.imu.restart": ("nodes", "imu", "restart"),
    "nodes.imu.settings": ("nodes", "imu", "settings"),
    "nodes.speed.inputs.frame": ("nodes", "speed", "inputs", "frame"),
    "nodes.fuse.settings.observer": ("nodes", "fuse", "settings", "observer"),
}


def whole() -> dict[str, Any]:
    return {
        "flow": "demo",
        "rig": {"sensors": {"south": {"position": [1, 2, 3], "azimuth": 0.5}}},
        "machines": {"here": {"listen": ["tcp/0.0.0.0:7447"]}},
        "nodes": {
            "imu": {"run": "drivers.bno055", "restart": {"policy": "never"}, "settings": {"rate": 50}},
            "radar": {"run": "drivers.p440"},
            "speed": {"run": "speed.py", "inputs": {"frame": {"from": "radar/frame", "queue": "all"}}},
            "fuse": {
                "run": "fuse.py",
                "inputs": {"imu": "imu/imu", "speed": "speed/speed"},
                "settings": {"observer": {"pole": 0.5}},
            },
        },
    }


def laid_out(value: Any, draw: Callable[..., Any], indent: str = "") -> str:
    """`value` as YAML, each mapping in block or in flow style, with blank lines and comments where they may be."""
    if not isinstance(value, dict):
        return f"[{', '.join(map(str, value))}]\n" if isinstance(value, list) else f"{value}\n"
    if draw(st.booleans()):
        gap = " " * draw(st.integers(1, 3))
        return "{" + f",{gap}".join(f"{k}:{gap}{flow_style(v)}" for k, v in value.items()) + "}\n"
    inside = indent + " " * draw(st.integers(1, 4))
    between = draw(st.sampled_from(["", "\n", f"{inside}# here: [no, key]\n"]))
    lines = [f"{between}{inside}{k}: {laid_out(v, draw, inside)}" for k, v in value.items()]
    return "\n" + "".join(lines)


def flow_style(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {flow_style(v)}" for k, v in value.items()) + "}"
    return f"[{', '.join(map(str, value))}]" if isinstance(value, list) else str(value)


@given(st.data(), st.sampled_from(sorted(LEVELS)))
@settings(max_examples=20, deadline=None)
def test_a_stray_key_is_found_where_it_was_written(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, level: str
) -> None:
    values = whole()
    inside = values
    for key in LEVELS[level]:
        inside = inside[key]
    inside["stray"] = 1
    text = "".join(f"{key}: {laid_out(value, data.draw)}" for key, value in values.items())
    path = with_programs(tmp_path_factory.mktemp("stray")) / "flow.yaml"
    path.write_text(text)

    _, problems = examine(path)

    (problem,) = (problem for problem in problems if not problem.warning)
    assert problem.path == ".".join(filter(None, (level, "stray")))
    before = text[: text.index("stray")]
    assert problem.place.line == before.count("\n") + 1
    assert problem.place.column == len(before) - before.rfind("\n")
