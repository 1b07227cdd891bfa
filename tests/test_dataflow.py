"""What a sound dataflow.yaml becomes."""

import subprocess
import sys
from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.messages import GroundSpeed, Imu, Pose, RadarFrame
from caneflow.runtime.dataflow.graph import Graph, Queue, Restart
from caneflow.runtime.dataflow.loading import load, read_rig
from caneflow.runtime.dataflow.programs import validated_settings
from caneflow.runtime.dataflow.topology import NOBODY_LISTENS
from caneflow.runtime.errors import DataflowError

ROOT = Path(__file__).parents[1]

SPEED = """
from dataclasses import dataclass, field
from caneflow.messages import GroundSpeed, Imu, RadarFrame
from caneflow.runtime import Operator

@dataclass(frozen=True, kw_only=True)
class Window:
    length: int = 64  # scans

@dataclass(frozen=True, kw_only=True)
class SpeedSettings:
    window: Window = field(default_factory=Window)
    range_limits: tuple[float, float] = (0.3, 4.0)  # m

class Speed(Operator):
    inputs = {"frame": RadarFrame, "imu": Imu}
    outputs = {"speed": GroundSpeed}
    optional_inputs = frozenset({"imu"})
    Settings = SpeedSettings

    def __init__(self, settings, context):
        self.settings = settings

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

SINK = """
from caneflow.runtime import Sink

class Speak(Sink):
    def __init__(self, settings, context): ...
    def take(self, key, message, payload, time): ...
    def idle(self, time): ...
    def finish(self): ...
"""

FLOW = """
flow: demo
seed: 7
nodes:
  speed:
    run: my/speed.py
    inputs:
      imu: imu/imu
      frame: {from: radar/frame, queue: fifo 10, max_lag_ms: 100, max_age_ms: 500.5}
    settings: {window: {length: 32}}
    restart: {policy: always, max_restarts: 3}
    ready_timeout_s: 5
  imu: {run: drivers.bno055, restart: never}
  radar: {external: true, outputs: {frame: RadarFrame, imu: caneflow.Imu/1}}
results: [speed/speed, radar/imu]
"""


def flow_in(folder: Path, text: str) -> Path:
    (folder / "my").mkdir(exist_ok=True)
    for name, program in (("speed", SPEED), ("relay", RELAY), ("speak", SINK)):
        (folder / "my" / f"{name}.py").write_text(program)
    path = folder / "flow.yaml"
    path.write_text(text)
    return path


def test_everything_in_the_file_is_in_the_graph(tmp_path: Path) -> None:
    graph = load(flow_in(tmp_path, FLOW))

    assert (graph.flow, graph.seed, graph.rig, graph.machines) == ("demo", 7, {}, {})
    assert graph.warnings == (f"{graph.path}:14:3: warning: nodes.radar: {NOBODY_LISTENS}",)
    assert list(graph.nodes) == ["speed", "imu", "radar"]
    assert graph.results == ("speed/speed", "radar/imu")
    speed = graph.nodes["speed"]
    assert speed.module is None
    assert speed.file == (tmp_path / "my" / "speed.py").resolve()
    assert speed.program is not None
    assert speed.program.__name__ == "Speed"
    assert speed.outputs == {"speed": GroundSpeed}
    assert speed.settings.window.length == 32
    assert speed.settings.range_limits == (0.3, 4.0)
    assert speed.settings_map == {"window": {"length": 32}}
    assert speed.restart == Restart(policy="always", max_restarts=3, window_s=60, delay_s=0.25, max_delay_s=10)
    assert speed.ready_timeout_s == 5
    frame, imu = speed.inputs["frame"], speed.inputs["imu"]
    assert (frame.node, frame.port, frame.kind) == ("radar", "frame", RadarFrame)
    assert (frame.queue, frame.max_lag_ms, frame.max_age_ms) == (Queue(mode="fifo", length=10), 100, 500.5)
    assert (imu.stream, imu.kind, imu.queue.mode, imu.max_lag_ms, imu.max_age_ms) == (
        "imu/imu",
        Imu,
        "all",
        None,
        None,
    )
    driver, radar = graph.nodes["imu"], graph.nodes["radar"]
    assert (driver.module, driver.file, driver.restart.policy) == ("caneflow.drivers.bno055", None, "never")
    assert (radar.external, radar.program, radar.settings) == (True, None, None)
    assert radar.outputs == {"frame": RadarFrame, "imu": Imu}
    with pytest.raises(FrozenInstanceError):
        graph.flow = "other"  # type: ignore[misc]


def test_inputs_come_in_the_order_of_the_program_not_of_the_file(tmp_path: Path) -> None:
    graph = load(flow_in(tmp_path, FLOW))

    assert list(graph.nodes["speed"].inputs) == ["frame", "imu"]


def test_a_process_can_check_the_settings_again(tmp_path: Path) -> None:
    node = load(flow_in(tmp_path, FLOW), ["speed.range_limits=[1, 2]"]).nodes["speed"]
    assert node.program is not None

    assert validated_settings(node.program, node.settings_map) == node.settings
    with pytest.raises(DataflowError, match=r"^settings\.window\.lenght: unknown key; did you mean 'length'\?"):
        validated_settings(node.program, {"window": {"lenght": 3}})


def test_any_port_takes_every_name_and_type(tmp_path: Path) -> None:
    text = """
flow: demo
nodes:
  imu: {run: drivers.bno055}
  radar: {run: drivers.p440}
  relay: {run: my/relay.py, inputs: {a: radar/frame, b: imu/imu}}
  speak: {run: my/speak.py, inputs: {whatever: relay/out}}
"""
    graph = load(flow_in(tmp_path, text))

    assert {port: wire.kind for port, wire in graph.nodes["relay"].inputs.items()} == {"a": RadarFrame, "b": Imu}
    assert graph.nodes["speak"].outputs == {}
    assert graph.warnings == ()


def test_settings_can_be_overridden_to_any_depth(tmp_path: Path) -> None:
    overrides = ["speed.window.length=16", "speed.range_limits=[0.5, 2]", "imu.port=/dev/ttyS1"]
    graph = load(flow_in(tmp_path, FLOW), overrides)

    assert graph.nodes["speed"].settings.window.length == 16
    assert graph.nodes["speed"].settings.range_limits == (0.5, 2.0)
    assert graph.nodes["imu"].settings.port == "/dev/ttyS1"
    assert graph.nodes["imu"].settings_map == {"port": "/dev/ttyS1"}


def test_a_given_rig_is_laid_over_the_files_key_by_key(tmp_path: Path) -> None:
    sensors = "rig: {hand_height: 1.1, sensors: {south: {position: [4, -2.5, 1], azimuth: 1.57}}}"
    path = flow_in(tmp_path, FLOW + sensors)

    rig = load(path, rig={"aperture": 0.9, "sensors": {"south": {"k": 3.0}}}).rig

    assert rig == {
        "hand_height": 1.1,
        "aperture": 0.9,
        "sensors": {"south": {"position": [4, -2.5, 1], "azimuth": 1.57, "k": 3.0}},
    }
    with pytest.raises(DataflowError, match=r"^rig of the recording or --rig: rig\.aperture: is 9; it takes a number"):
        load(path, rig={"aperture": 9})


def test_a_rig_may_lie_in_a_file_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("hand_height: 0.9\nsensors:\n  south: {position: [4, -2.5, 1], azimuth: 1.57, k: 2.5e-3}\n")
    assert read_rig(path)["sensors"]["south"]["k"] == 2.5e-3

    path.write_text("hand_height: 0.9\nsensors:\n  south: {position: [4, -2.5], azimuth: 1.57, postion: 2}\n")
    with pytest.raises(DataflowError) as caught:
        read_rig(path)
    assert str(caught.value).splitlines() == [
        f"{path}:3:21: sensors.south.position: is [4, -2.5]; it takes a list of 3 (m, R0)",
        f"{path}:3:47: sensors.south.postion: unknown key; did you mean 'position'? allowed are azimuth, k, position",
    ]


def test_outputs_that_nobody_reads_are_warnings(tmp_path: Path) -> None:
    graph = load(flow_in(tmp_path, FLOW.replace("results: [speed/speed, radar/imu]", "results: []")))

    assert graph.warnings == (
        f"{graph.path}:5:3: warning: nodes.speed: no node reads its output speed/speed (caneflow.GroundSpeed/1);"
        " wire it, or list it under results",
        f"{graph.path}:14:3: warning: nodes.radar: {NOBODY_LISTENS}",
        f"{graph.path}:14:3: warning: nodes.radar: no node reads its output radar/imu (caneflow.Imu/1);"
        " wire it, or list it under results",
    )


def test_anchors_aliases_and_merges_are_followed(tmp_path: Path) -> None:
    text = """
flow: demo
nodes:
  left: &device {run: drivers.bno055, restart: never, settings: {rate: 50}}
  right: {<<: *device, restart: always}
results: [left/imu, right/imu]
"""
    nodes = load(flow_in(tmp_path, text)).nodes

    assert [(node.restart.policy, node.settings.rate) for node in nodes.values()] == [
        ("never", 50),
        ("always", 50),
    ]


def test_the_canes_own_graph_is_sound() -> None:
    graph = load(ROOT / "dataflow.yaml")

    assert graph.warnings == ()
    assert graph.order() == ("imu", "radar", "ground_speed", "fusion")
    assert {f"{reader}.{port}": wire.stream for reader, port, wire in graph.wires} == {
        "ground_speed.frame": "radar/frame",
        "ground_speed.imu": "imu/imu",
        "fusion.imu": "imu/imu",
        "fusion.speed": "ground_speed/speed",
    }
    assert graph.nodes["fusion"].outputs == {"pose": Pose, "local": Pose}
    assert graph.rig["boresight"] == [0, 1, 0]


@pytest.mark.parametrize(
    ("modules", "heavy"),
    [
        ("runtime.dataflow.loading", {"scipy", "zenoh", "typer"}),
        ("tools.run, caneflow.drivers.p440, caneflow.tools.emulate, caneflow.tools.evaluate", {"scipy", "matplotlib"}),
        ("tools.simulate", {"scipy.signal", "scipy.stats", "matplotlib"}),  # a second
    ],
)
def test_nobody_waits_for_what_is_not_needed(modules: str, heavy: set[str]) -> None:
    code = f"import sys, caneflow.{modules}; print({heavy!r} & set(sys.modules) or 'none')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert done.stdout.strip() == "none"


@st.composite
def relays(draw: st.DrawFn) -> dict[str, list[str]]:
    """Who reads from whom, without a cycle, in an order that is not the topological one."""
    names = draw(st.permutations([f"n{i}" for i in range(draw(st.integers(1, 7)))]))
    reads: dict[str, list[str]] = {}
    for i, name in enumerate(names):
        reads[name] = draw(st.lists(st.sampled_from(names[:i]), unique=True)) if i else []
    return {name: reads[name] for name in draw(st.permutations(names))}


@given(relays())
@settings(max_examples=25, deadline=None)
def test_the_order_has_every_writer_before_its_readers(
    tmp_path_factory: pytest.TempPathFactory, reads: dict[str, list[str]]
) -> None:
    graph = relay_graph(tmp_path_factory.mktemp("order"), reads)

    order = graph.order()

    assert sorted(order) == sorted([*reads, "imu"])
    assert all(order.index(writer) < order.index(reader) for reader in reads for writer in reads[reader])


def relay_graph(folder: Path, reads: dict[str, list[str]]) -> Graph:
    """Relays that read from each other as told; the first ones read from an IMU."""
    lines = ["flow: demo", "nodes:", "  imu: {external: true, outputs: {imu: Imu}}"]
    for reader, writers in reads.items():
        wires = ", ".join(f"{writer}: {writer}/out" for writer in writers) or "imu: imu/imu"
        lines.append(f"  {reader}: {{run: my/relay.py, inputs: {{{wires}}}}}")
    return load(flow_in(folder, "\n".join(lines)))
