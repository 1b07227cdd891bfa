"""`caneflow mcu config`: what a dataflow says of the observer, as a header for the microcontroller's program."""

from pathlib import Path
from typing import Annotated

import typer

from caneflow.algorithms.cane.luenberger import LuenbergerSettings
from caneflow.algorithms.cane.luenberger_fixed import GAIN, METHOD, UNIT, ObserverConstants, observer_constants
from caneflow.errors import CaneflowError
from caneflow.messages.rig import read_rig
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.runtime.dataflow.graph import Graph, Node
from caneflow.runtime.dataflow.loading import load


def config(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The dataflow, e.g. dataflow.yaml.", show_default=False)],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="HEADER", help="C header to write; printed when left out."),
    ] = None,
    node: Annotated[
        str | None, typer.Option(metavar="NODE", help="The fusion, where the dataflow has several.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NODE.KEY=VALUE", help="Override a setting (may be given again)."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write the observer's gain and boresight in fixed point, as mcu/ compiles them in.

    They are the `luenberger` settings of the fusion (or of the gateway in its place) and the rig's boresight.

    Example: caneflow mcu config dataflow.yaml -o observer_config.h
    """
    with whole(output, inputs=[file], overwrite=overwrite) as path:
        graph = load(file, settings or ())
        fusion = fusion_of(graph, node)
        boresight = read_rig(graph.rig).boresight
        try:
            constants = observer_constants(fusion.settings.luenberger, boresight)
        except ValueError as error:
            raise CaneflowError(f"{file}: nodes.{fusion.name}.settings.luenberger: {error}") from error
        text = header(constants, f"{file.name}, node {fusion.name}")
        if path is None:
            print(text, end="")
        else:
            path.write_text(text)


commands = {"config": config}


def fusion_of(graph: Graph, name: str | None) -> Node:
    """The node whose observer is meant: `name`, else the one whose method is in fixed point, else any observer.

    Raises CaneflowError when there is none, or more than one.
    """
    observers = {
        node.name: node
        for node in graph.nodes.values()
        if isinstance(getattr(node.settings, "luenberger", None), LuenbergerSettings)
    }
    if name is not None:
        if name not in observers:
            there = ", ".join(observers) or "there is none"
            raise CaneflowError(f"node {name!r} has no settings of the luenberger observer; {there}")
        return observers[name]
    in_fixed_point = [node for node in observers.values() if getattr(node.settings, "method", None) == METHOD]
    found = in_fixed_point or list(observers.values())
    if len(found) != 1:
        there = f"there are {', '.join(node.name for node in found)}; say --node NAME" if found else "there is none"
        raise CaneflowError(f"{graph.flow}: no single node with the luenberger observer: {there}")
    return found[0]


def header(constants: ObserverConstants, source: str) -> str:
    """The C header with the constants; `source` is for the reader."""
    x, y, z = constants.boresight
    entries = [
        ("GAIN_AA", _integer(constants.gain_aa, GAIN, "Q2.29")),
        ("GAIN_AV", _integer(constants.gain_av, GAIN, "Q2.29, 1/s")),
        ("GAIN_VA", _integer(constants.gain_va, GAIN, "Q2.29, s")),
        ("GAIN_VV", _integer(constants.gain_vv, GAIN, "Q2.29")),
        ("FOLLOWS_INTERVAL", f"{constants.follows_interval} /* 1: GAIN_VA is the interval instead */"),
        ("BORESIGHT_X", _integer(x, UNIT, "Q1.30")),
        ("BORESIGHT_Y", _integer(y, UNIT, "Q1.30")),
        ("BORESIGHT_Z", _integer(z, UNIT, "Q1.30")),
        ("HEADING_AT_DELAY", f"{constants.heading_at_delay} /* 1: of a speed's stamp less its delay */"),
        ("DIGEST", f"UINT32_C(0x{constants.digest:08x}) /* the host compares it with its own */"),
    ]
    lines = [
        f"/* The observer's constants, by `caneflow mcu config` from {source}. */",
        "#ifndef OBSERVER_CONFIG_H",
        "#define OBSERVER_CONFIG_H",
        "",
        "#include <stdint.h>",
        "",
        *(f"#define OBSERVER_{name} {value}" for name, value in entries),
        "",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def _integer(value: int, fraction: int, what: str) -> str:
    literal = f"INT32_C({value})" if value >= 0 else f"(-INT32_C({-value}))"
    return f"{literal} /* {value / 2**fraction:.9g}; {what} */"
