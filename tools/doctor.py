"""`caneflow doctor`: what is wrong, and what to try next: with a running flow, or with the devices (`--devices`)."""

import json
import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from caneflow.device_checks import a121, bno055, doppler_adc, mpu9250, p440, sonar, ti_mmwave, tof
from caneflow.device_checks.samples import examine_samples
from caneflow.errors import CaneflowError
from caneflow.options import At, Keys
from caneflow.printable import printable
from caneflow.runtime import Source
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.hosts.attached.diagnosis import diagnosed
from caneflow.runtime.hosts.attached.way_to import Finding
from caneflow.runtime.site import DEFAULT_KEYS

TROUBLE_STATUS = 1
CHECKS: dict[str, Callable[[Node], Iterator[Finding]]] = {
    "drivers.bno055": bno055.examine,
    "drivers.p440": p440.examine,
    "drivers.mpu9250": mpu9250.examine,
    "drivers.doppler_adc": doppler_adc.examine,
    "drivers.sonar": sonar.examine,
    "drivers.vl53l5cx": partial(tof.examine, tof.VL53L5CX),
    "drivers.vl53l1x": partial(tof.examine, tof.VL53L1X),
    "drivers.a121": a121.examine,
    "drivers.ti_mmwave": ti_mmwave.examine,
}


def command(
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="FLOW|FILE",
            help="The running flow; by default the only one here. With --devices the file; by default dataflow.yaml.",
        ),
    ] = None,
    devices: Annotated[
        bool, typer.Option("--devices", help="Look at the devices; the flow must not be running.")
    ] = False,
    at: At = None,
    keys: Keys = DEFAULT_KEYS,
    machine: Annotated[str | None, typer.Option(metavar="NAME", help="Only those at this machine.")] = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="s of samples to judge a device by.")] = 3.0,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NODE.KEY=VALUE", help="Override a setting (may be given again)."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON list.")] = False,
) -> None:
    """Say what is wrong with a running flow: links, nodes, wires, clocks (ms); or with the devices; and what to try.

    Of a flow (without its name, of each that runs here): who listens, who dials, who is denied, versions and clocks of
    its machines, where samples are lost. Of each device (--devices): whether it is there, answers, how often it
    measures (Hz) and how it is calibrated.
    Exit status 0: nothing is bad. 1: something is.

    Example: caneflow doctor cane

    Example: caneflow doctor --devices dataflow.yaml --set imu.port=/dev/ttyUSB0
    """
    if not devices:
        if settings or machine:
            raise CaneflowError("--set and --machine are for devices; add --devices")
        _told(diagnosed(what, at, keys), as_json=as_json)
    file = Path(what or "dataflow.yaml")
    graph = load(file, settings or ())
    nodes = [node for node in graph.nodes.values() if _is_source(node) and machine in (None, node.machine)]
    if not nodes:
        raise CaneflowError(f"{file}: no node{f' at {machine}' if machine else ''} brings samples in")
    logging.disable()  # a driver says in its own words what is said here
    try:
        _told((finding for node in nodes for finding in examined(node, seconds, graph.rig)), as_json=as_json)
    finally:
        logging.disable(logging.NOTSET)


def _told(found: Iterable[Finding], *, as_json: bool) -> NoReturn:
    """Print the findings as they come, or all together as JSON."""
    findings = []
    for finding in found:
        findings.append(finding)
        if not as_json:
            print("\n".join(_lines(finding)), flush=True)
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    raise typer.Exit(TROUBLE_STATUS if any(finding.state == "bad" for finding in findings) else 0)


def examined(node: Node, seconds: float, rig: dict[str, Any]) -> Iterator[Finding]:
    """What there is to say of one device; a finding that is bad is the last."""
    for check in (CHECKS.get(node.run, _nothing), lambda found: examine_samples(found, seconds, rig)):
        for finding in check(node):
            yield finding
            if finding.state == "bad":
                return


def _is_source(node: Node) -> bool:
    return node.program is not None and issubclass(node.program, Source)


def _nothing(node: Node) -> Iterator[Finding]:
    yield from ()


def _lines(finding: Finding) -> Iterator[str]:
    yield printable(f"{finding.node}: {finding.state:4} {finding.text}")
    for attempt in finding.attempts:
        yield f"{'':{len(finding.node) + 2}}try  {printable(attempt)}"
