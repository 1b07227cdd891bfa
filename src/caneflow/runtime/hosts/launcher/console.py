"""What `caneflow run` prints while a flow runs: its nodes' lines, and how far a replay is."""

import os
import shutil
import sys
import time
from typing import TextIO

from caneflow.printable import printable
from caneflow.runtime.hosts.launcher.background import Background

LINE_PERIOD = 10.0  # s between two lines about a replay where there is no terminal
BAR = 24  # characters
IN_BACKGROUND = """{flow} runs (pid {pid})
to look:    caneflow view {flow}, caneflow status {flow}, caneflow logs {flow} --follow
to end it:  caneflow stop {flow}"""
NARROW = 60  # columns of a terminal in which a bar has no room


class Console:
    """Prints to the standard error; a context manager, at whose end the last line is free again.

    On a terminal the last line is a replay's progress, rewritten. Not by rich: that takes 0.1 s to import, and hides
    the cursor, which a killed command would never show again.
    """

    def __init__(self, flow: str, background: Background | None = None, stream: TextIO | None = None) -> None:
        """`background`: where the command that started the run waits for it to be settled."""
        self._flow, self._background = flow, background
        self._stream = stream or sys.stderr
        self._redraws = self._stream.isatty() and os.environ.get("TERM", "dumb") != "dumb"
        self._began = self._said_at = time.monotonic()
        self._shown = ""  # on the last line of the terminal

    def __enter__(self) -> "Console":
        return self

    def __exit__(self, *_: object) -> None:
        self._show("")

    def line(self, node: str, line: str) -> None:
        """Print a node's line under its name; its indentation stays."""
        shown = self._shown
        self._show("")
        print(f"{node} | {printable(line.expandtabs())}", file=self._stream, flush=True)
        self._show(shown)

    def settled(self) -> None:
        """From here on the pace of a replay counts; who only waited for the start is told how to go on."""
        if self._background is not None:
            self._background.let_go(IN_BACKGROUND.format(flow=self._flow, pid=os.getpid()))
            self._redraws = False
        self._began = self._said_at = time.monotonic()

    def played(self, played_s: float, of_s: float | None) -> None:
        """Show that `played_s` s of a replay of `of_s` s are done."""
        now = time.monotonic()
        if self._redraws:
            columns = shutil.get_terminal_size().columns
            self._show(_progress(played_s, of_s, now - self._began, bar=columns > NARROW)[: columns - 1])
        elif now >= self._said_at + LINE_PERIOD:
            self._said_at = now
            self.line("caneflow", _progress(played_s, of_s, now - self._began, bar=False))

    def _show(self, text: str) -> None:
        """Have `text` as the last line of a terminal."""
        if text or self._shown:
            self._stream.write(f"\r\x1b[K{text}")
            self._stream.flush()
        self._shown = text


def _progress(played_s: float, of_s: float | None, took_s: float, *, bar: bool) -> str:
    """How far a replay is, in one line."""
    pace = played_s / took_s if took_s > 0 else 0.0
    if of_s is None:
        return f"{played_s:.1f} s played, {pace:.3g} x real time, in a loop"
    share = played_s / of_s if of_s > 0 else 1.0
    drawn = f" [{'#' * round(BAR * share):.<{BAR}}]" if bar else ""
    left = f", {(of_s - played_s) / pace:.0f} s left" if pace > 0 else ""
    return f"{100 * share:3.0f} %{drawn} {played_s:.1f} of {of_s:.1f} s, {pace:.3g} x real time{left}"
