"""The tutorial, as it stands: its files written, its commands run in order, what they print held against the page."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

TUTORIAL = Path(__file__).parents[1] / "docs" / "tutorial.md"
MARK = "--- block {} ---"


class Block(NamedTuple):
    """A fenced block of the page."""

    language: str
    text: str


def blocks() -> list[Block]:
    found = re.findall(r"^```(\w+)\n(.*?)^```$", TUTORIAL.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return [Block(language, text) for language, text in found]


def as_script(page: list[Block]) -> str:
    """One shell for all of the page, as a reader has one: jobs in the background go on from block to block."""
    parts = ["set -e -m"]
    for number, block in enumerate(page):
        parts.append(f"echo '{MARK.format(number)}'")
        if block.language == "sh":
            parts.append(block.text)
        elif named := re.match(r"# file: (\S+)\n", block.text):
            parts.append(f"cat > {named[1]} <<'END OF FILE'\n{block.text}END OF FILE")
    return "\n".join(parts)


def is_printed(line: str, output: list[str]) -> bool:
    """Whether a line of the page is among those of `output`; `...` stands for anything, runs of spaces for one."""
    pattern = ".*".join(re.escape(" ".join(part.split())) for part in line.split("..."))
    return any(re.fullmatch(rf"\s*{pattern}\s*".replace(r"\ ", r"\s+"), printed) for printed in output)


@pytest.mark.timeout(300)  # some 15 processes, one after the other
def test_the_page_does_what_it_says(tmp_path: Path) -> None:
    page = blocks()
    assert {block.language for block in page} == {"sh", "text", "yaml", "python"}, (
        "the test knows what to do with all of them"
    )
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", as_script(page)],
        cwd=tmp_path,
        env={**os.environ, "PATH": path, "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for number, block in enumerate(page):
        if block.language != "text":
            continue
        before = done.stdout.partition(MARK.format(number - 1))[2].partition(MARK.format(number))[0]
        for line in block.text.splitlines():
            assert is_printed(line, before.splitlines()), f"the page says {line!r}; printed was:\n{before}"
    assert not [line for line in done.stderr.splitlines() if "Traceback" in line], done.stderr
