"""The page that a benchmark writes, and its figures beside it: nothing that exists is lost without `--overwrite`."""

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from caneflow.outputs import OutputError, whole

USAGE_STATUS = 2


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add `--write` and `--overwrite`."""
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the tables there, and all figures beside it")
    parser.add_argument("--overwrite", action="store_true", help="replace what exists under these names")


@contextmanager
def written_at_the_end(
    options: argparse.Namespace, inputs: Sequence[Path] = (), picture: Path | None = None
) -> Iterator[list[Path] | None]:
    """Paths for the page, its figures and the picture, which get their names when the block ends well; None: no page.

    To be entered before hours of measuring: what may not be replaced ends the program here.
    """
    if options.write is None:
        yield None
        return
    paths = [options.write, options.write.with_suffix(".json"), *([] if picture is None else [picture])]
    with ExitStack() as files:
        try:
            fresh = [files.enter_context(whole(path, inputs=inputs, overwrite=options.overwrite)) for path in paths]
        except OutputError as error:
            print(error, file=sys.stderr)
            sys.exit(USAGE_STATUS)
        yield fresh
