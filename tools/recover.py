"""`caneflow recover`: a sound recording of one that was cut short or damaged."""

import sys
from itertools import islice
from pathlib import Path
from typing import Annotated

import typer

from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.printable import printable
from caneflow.recording import NothingLeftError, recover

MOST_KEYS = 50  # that are listed


def command(
    recording: Annotated[
        Path, typer.Argument(metavar="REC", help="Recording that was cut or damaged.", show_default=False)
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Sound recording to write; by default REC.recovered.mcap beside it."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Copy all that can be read of a recording into a sound one, with its metadata.

    Metadata that was lost is made up: the flow's name from the keys, an empty rig. Exit status 1: nothing is left that
    makes a recording; no file is written.

    Example: caneflow recover walk.mcap -o walk_sound.mcap
    """
    target = output or recording.with_suffix(".recovered.mcap")
    try:
        with whole(target, inputs=[recording], overwrite=overwrite) as sound:
            found = recover(recording, sound)
    except NothingLeftError as error:
        print(f"caneflow recover: {printable(str(error))}", file=sys.stderr)
        raise typer.Exit(1) from None
    for key, count in islice(found.messages.items(), MOST_KEYS):
        print(f"{count:8d}  {key}")
    if len(found.messages) > MOST_KEYS:
        print(f"{'':8}  and {len(found.messages) - MOST_KEYS} more")
    state = "had not been cut" if found.complete else "was cut"
    damage = f"; {found.damaged} damaged chunks left out" if found.damaged else ""
    made_up = f"; no metadata {' or '.join(found.replaced)} was left, it is made up" if found.replaced else ""
    print(printable(f"{target}: {sum(found.messages.values())} messages; {recording} {state}{damage}{made_up}"))
