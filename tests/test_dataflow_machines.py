"""Samples reach every reader: machines that share a wire have a link of their own, which one of them dials."""

from pathlib import Path

import pytest

from caneflow.runtime.dataflow.loading import examine, load

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

CHAIN = """\
flow: demo
machines:
  sensor: {%s}
  gateway: {%s}
  phone: {%s}
nodes:
  imu: {run: drivers.bno055, machine: sensor}
  relay: {run: relay.py, machine: gateway, inputs: {imu: imu/imu}}
  view: {run: relay.py, machine: phone, inputs: {relay: relay/out}}
results: [view/out]
"""


def said(folder: Path, text: str) -> list[str]:
    """Mistakes and warnings, without the file's name."""
    (folder / "relay.py").write_text(RELAY)
    path = folder / "flow.yaml"
    path.write_text(text)
    return [str(problem).removeprefix(f"{path}:") for problem in examine(path)[1]]


# What the three machines of the chain sensor -> gateway -> phone say of themselves, and which wires are dead.
LINKS = {
    "everybody dials the gateway": (
        "connect: [tcp/gateway.local:7447]",
        "listen: [tcp/0.0.0.0:7447]",
        "connect: [tcp/gateway.local:7447]",
        [],
    ),
    "the gateway dials everybody": (
        "listen: [tcp/0.0.0.0:7447]",
        "connect: [tcp/sensor.local:7447, tcp/phone:7447]",
        'listen: ["tcp/[::]:7447"]',
        [],
    ),
    "by address": (
        "connect: [tcp/10.0.0.2:7000]",
        "listen: [tcp/10.0.0.2:7000, tcp/127.0.0.1:7001]",
        "connect: [tcp/127.0.0.1:7001]",
        [],
    ),
    "a listener with a name of its own": (
        "connect: [tcp/cane.home:7000]",
        "listen: [tcp/10.0.0.2:7000]",
        "connect: [tcp/cane.home:7000]",
        [],
    ),
    "nobody dials the phone": (
        "connect: [tcp/gateway.local:7447]",
        "listen: [tcp/0.0.0.0:7447]",
        "listen: [tcp/0.0.0.0:7447]",
        ["view"],
    ),
    "another port": (
        "connect: [tcp/gateway.local:7448]",
        "listen: [tcp/0.0.0.0:7447]",
        "connect: [tcp/gateway.local:7447]",
        ["relay"],
    ),
    "another address": (
        "connect: [tcp/10.0.0.3:7447]",
        "listen: [tcp/10.0.0.2:7447]",
        "connect: [tcp/10.0.0.2:7447]",
        ["relay"],
    ),
    "a listener that only its own machine reaches": (
        "connect: [tcp/gateway.local:7447]",
        "listen: [tcp/127.0.0.1:7447]",
        "connect: [tcp/gateway.local:7447]",
        ["relay", "view"],
    ),
    "the sensor would have to relay": (
        "listen: [tcp/0.0.0.0:7447]",
        "connect: [tcp/sensor.local:7447]",
        "connect: [tcp/sensor.local:7447]",
        ["view"],
    ),
    "nothing at all": ("", "", "", ["relay", "view"]),
}


@pytest.mark.parametrize("name", LINKS)
def test_a_wire_between_machines_needs_a_link(tmp_path: Path, name: str) -> None:
    *machines, dead = LINKS[name]

    lines = [line for line in said(tmp_path, CHAIN % tuple(machines)) if "warning" not in line]

    wires = {"relay": "8:58: nodes.relay.inputs.imu: ", "view": "9:57: nodes.view.inputs.relay: "}
    assert len(lines) == len(dead)
    for line, reader in zip(lines, dead, strict=True):
        assert line.startswith(wires[reader] + "leads from machine ")


def test_the_advice_says_who_should_dial_whom(tmp_path: Path) -> None:
    listening = said(tmp_path, CHAIN % ("", "listen: [tcp/0.0.0.0:7000]", ""))
    silent = said(tmp_path, CHAIN % ("", "", ""))

    assert listening == [
        "8:58: nodes.relay.inputs.imu: leads from machine 'sensor' to machine 'gateway', and neither dials the "
        "other; e.g. sensor: {connect: [tcp/gateway.local:7000]} (a third machine does not relay)",
        "9:57: nodes.view.inputs.relay: leads from machine 'gateway' to machine 'phone', and neither dials the "
        "other; e.g. phone: {connect: [tcp/gateway.local:7000]} (a third machine does not relay)",
    ]
    assert silent[0].endswith(
        "e.g. sensor: {listen: [tcp/0.0.0.0:7447]}, gateway: {connect: [tcp/sensor.local:7447]} "
        "(a third machine does not relay)"
    )


def test_machines_that_dial_each_other_are_a_warning(tmp_path: Path) -> None:
    both = "listen: [tcp/0.0.0.0:7447], connect: [tcp/gateway.local:7447]"
    gateway = "listen: [tcp/0.0.0.0:7447], connect: [tcp/sensor.local:7447]"

    assert said(tmp_path, CHAIN % (both, gateway, "connect: [tcp/gateway.local:7447]")) == [
        "3:49: warning: machines.sensor.connect: gateway and sensor dial each other; one of the two should: "
        "a link dialled from both ends may stay split after a loss"
    ]


def test_dialling_nobody_and_running_nothing_are_warnings(tmp_path: Path) -> None:
    text = """\
flow: demo
machines:
  here: {connect: [tcp/other.local:7447]}
  there: {}
nodes:
  imu: {run: drivers.bno055, machine: here}
results: [imu/imu]
"""
    assert said(tmp_path, text) == [
        "3:20: warning: machines.here.connect.0: no other machine listens there",
        "4:3: warning: machines.there: no node runs here",
    ]


def test_machines_are_named_where_there_are_several(tmp_path: Path) -> None:
    text = """\
flow: demo
machines: {here: {}, there: {}}
nodes:
  imu: {run: drivers.bno055}
  radar: {run: drivers.p440, machine: ther}
results: [imu/imu, radar/frame]
"""
    assert said(tmp_path, text) == [
        "4:3: nodes.imu.machine: is missing; there are several: here, there",
        "5:39: nodes.radar.machine: no machine 'ther'; did you mean 'there'? there are here, there",
    ]


def test_a_single_machine_need_not_be_named(tmp_path: Path) -> None:
    path = tmp_path / "flow.yaml"
    path.write_text("flow: demo\nmachines: {here: {}}\nnodes: {imu: {run: drivers.bno055}}\nresults: [imu/imu]\n")

    assert load(path).nodes["imu"].machine == "here"


@pytest.mark.parametrize(
    ("endpoint", "start"),
    [
        ("udp/0.0.0.0:7447", "is 'udp/0.0.0.0:7447'; it takes text such as tcp/0.0.0.0:7447"),
        ("tcp/0.0.0.0", "is 'tcp/0.0.0.0'; it takes text such as tcp/0.0.0.0:7447"),
        ("tcp/0.0.0.0:70000", "has port 70000; ports are 1..65535"),
    ],
)
def test_an_endpoint_is_tcp_with_a_port(tmp_path: Path, endpoint: str, start: str) -> None:
    text = f"flow: demo\nmachines: {{a: {{listen: [{endpoint}]}}}}\nnodes: {{imu: {{run: drivers.bno055}}}}\n"

    (line,) = said(tmp_path, text)

    assert line == f"2:25: machines.a.listen.0: {start}"
