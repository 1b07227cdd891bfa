"""`caneflow recover`: a sound recording of one that was cut short or damaged."""

from pathlib import Path
from typing import Annotated

import typer

from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.recording import recover


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

    Example: caneflow recover walk.mcap -o walk_sound.mcap
    """
    target = output or recording.with_suffix(".recovered.mcap")
    with whole(target, inputs=[recording], overwrite=overwrite) as sound:
        found = recover(recording, sound)
    for key, count in found.messages.items():
        print(f"{count:8d}  {key}")
    state = "had not been cut" if found.complete else "was cut"
    damage = f"; {found.damaged} damaged chunks left out" if found.damaged else ""
    print(f"{target}: {sum(found.messages.values())} messages; {recording} {state}{damage}")
