"""The door of the `caneflow` command: ready for Ctrl-C before anything that takes time to import is there."""

import gc
import os
import sys
from typing import NoReturn

from caneflow import dispatch, interrupts, standard_streams

COMPLETING = "_CANEFLOW_COMPLETE"  # in the environment where a shell asks what may follow: that computes nothing
# Words that are for their output alone: without a reader they end. The work of all others goes on.
OUTPUT_ALONE = frozenset({"echo", "hz", "top", "info", "logs"})


def program() -> NoReturn:
    """The `caneflow` program: the command line in an interpreter whose numerical kernels are pinned."""
    interrupts.hold()  # for the interpreter that begins again
    if COMPLETING not in os.environ:
        dispatch.restart_with_pinned_mathematics()
    interrupts.end_at_once()
    gc.disable()  # until the word's tool is there: imports leave hardly any rubbish, and make much to look through
    main()


def main() -> NoReturn:
    """Run the command line's word; exit status 2 and one line for an expected error, a traceback for a bug."""
    standard_streams.outlive_readers(end=not OUTPUT_ALONE.isdisjoint(sys.argv[1:2]))
    with interrupts.handled():
        from caneflow.words import run  # here, as typer takes its time

        run()


if __name__ == "__main__":
    program()
