"""Words aloud, through espeak-ng as a program beside this process: one utterance at a time, the newest wins."""

import shutil
import subprocess
from contextlib import suppress

from caneflow.runtime.errors import DataflowError

PROGRAM = "espeak-ng"


class Speech:
    """Says texts; a new one cuts the one before."""

    def __init__(self, words_per_minute: int) -> None:
        """Raises DataflowError when espeak-ng is not installed."""
        program = shutil.which(PROGRAM)
        if program is None:
            raise DataflowError(f"{PROGRAM} is not installed (e.g. apt-get install {PROGRAM})")
        self._command = [program, "-s", str(words_per_minute), "--stdin"]
        self._speaking: subprocess.Popen[bytes] | None = None

    def say(self, text: str) -> None:
        """Say a text, at once."""
        self.close()
        self._speaking = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        assert self._speaking.stdin is not None
        with suppress(OSError):  # it ended at once: nothing is said, and the next text is tried
            self._speaking.stdin.write(text.encode())
            self._speaking.stdin.close()

    def close(self) -> None:
        """Be silent."""
        if self._speaking is not None:
            self._speaking.kill()
            self._speaking.wait()
            self._speaking = None
