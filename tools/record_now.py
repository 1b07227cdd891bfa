"""`caneflow record --now`: the last seconds of a running flow, which its recorder holds in memory, into a file."""

import json
from typing import Annotated, Any

import msgspec
import typer

from caneflow.errors import CaneflowError
from caneflow.options import At, Keys
from caneflow.printable import printable
from caneflow.recording.parts import WRITE_NOW
from caneflow.runtime.hosts.attached.attach import attached
from caneflow.runtime.site import DEFAULT_KEYS


def command(
    flow: Annotated[
        str | None, typer.Argument(metavar="FLOW", help="Its name; by default the only one that runs here.")
    ] = None,
    now: Annotated[bool, typer.Option("--now", help="Write what is in memory to a file, now.")] = False,
    at: At = None,
    keys: Keys = DEFAULT_KEYS,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON list; spans in s.")] = False,
) -> None:
    """Have a flow that was started with `--record OUT --record-last 30s` write its last 30 s to a file of its own.

    The flow goes on, and so does its memory: the next file may hold some of the same samples. Exit status 1: a
    recorder could not write.

    Example: caneflow record --now cane
    """
    if not now:
        raise CaneflowError("say --now; a whole run is recorded by `caneflow run FILE --record OUT`")
    with attached(flow, at, keys) as here:
        answers = [_read(answer) for answer in here.ask("*", WRITE_NOW)]
    if not answers:
        raise CaneflowError(
            f"no recorder of {here.flow} keeps its last seconds; start it with --record OUT --record-last 30s"
        )
    if as_json:
        print(json.dumps(answers))
    else:
        for answer in answers:
            said = answer.get("error") or f"{answer['path']}: {answer['samples']} samples, {answer['span']:.1f} s"
            print(printable(said))
    if any("error" in answer for answer in answers):
        raise typer.Exit(1)


def _read(answer: bytes) -> dict[str, Any]:
    try:
        return msgspec.json.decode(answer, type=dict[str, Any])
    except msgspec.DecodeError as error:
        return {"error": f"a recorder answers in another way: {error}"}
