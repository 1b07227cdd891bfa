"""`caneflow verify`: a recording run again and compared with the outputs that it holds."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from caneflow.errors import CaneflowError
from caneflow.printable import printable
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.dataflow.shipped import flow_for
from caneflow.runtime.replays.verification import ACROSS_PLATFORMS, Verdict, verify


def command(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="[FILE] REC",
            help="The dataflow, by default the folder's dataflow.yaml or else the one of caneflow's own that fits; "
            "and a recording with the outputs of a run.",
            show_default=False,
        ),
    ],
    tolerance: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Largest difference of a number, in its own SI unit; 0: equal bytes. "
            f"Default: 0, or {ACROSS_PLATFORMS:g} for a recording from another platform.",
            show_default=False,
        ),
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="NODE.KEY=VALUE", help="Override a setting.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Run a recording again, in this process, and compare each operator's output with the recorded one.

    What a recorded live run did not handle in time is left out, as it was then. A recording that was computed on
    another platform (architecture, C library, numpy, scipy), or does not say on which, is compared within a tolerance,
    after a line that names the differences. Exit status 0: every stream is as
    it was recorded. 1: one is not; its first difference is named. 2: the file or the recording cannot be used.

    Example: caneflow verify dataflow.yaml field.mcap --tolerance 1e-9
    """
    if len(files) > 2:
        raise CaneflowError(f"verify takes one dataflow and one recording, not {len(files)} files")
    recording = files[-1]
    file = flow_for([recording], files[0] if len(files) == 2 else None)
    verification = verify(load(file, settings or ()), recording, tolerance=tolerance)
    if as_json:
        streams = {verdict.stream: _plain(verdict) for verdict in verification.verdicts}
        about = {"holds": verification.holds, "tolerance": verification.tolerance}
        print(json.dumps({**about, "platform_differences": verification.differences, "streams": streams}, indent=2))
    else:
        if verification.differences:
            print(f"perhaps another platform: {'; '.join(verification.differences)}")
            print(f"numbers may differ by {verification.tolerance:g}, each in its own SI unit")
        for verdict in verification.verdicts:
            print(printable(f"{verdict.stream}: {_said(verdict)}"))
    raise typer.Exit(0 if verification.holds else 1)


def _plain(verdict: Verdict) -> dict[str, object]:
    return {"holds": verdict.holds, **asdict(verdict)}


def _said(verdict: Verdict) -> str:
    if verdict.first is not None:
        return f"differs at {verdict.first}"
    close = f", {verdict.close} within the tolerance (largest {verdict.largest:.3g})" if verdict.close else ""
    tail = (
        f"; {verdict.now - verdict.recorded} more now, after the recording's end"
        if verdict.now > verdict.recorded
        else ""
    )
    return f"{verdict.equal} of {verdict.recorded} samples equal in every byte{close}{tail}"
