"""Every word of the command explains itself: what it does, in which units, with an example; and shells complete it."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from caneflow import command, words

# As options are spelled out: `s of samples`, `in Hz`, `(MB)`, `times real time`.
UNIT = re.compile(r"\b(s|ms|us|ns|Hz|m|m/s|m/s\^2|rad|rad/s|deg|dB|%|uT|MB|times|unit|quantile|part)\b|%|\bSI\b")


def _commands() -> Iterator[tuple[str, Any]]:
    for word, (module, _) in words.WORDS.items():
        if find_spec(f"{words.TOOLS}.{module}") is None:
            continue
        tool = words._tool(module)
        below = getattr(tool, "commands", None)
        if below:
            yield from ((f"{word} {name}", each) for name, each in below.items())
        else:
            yield word, tool


COMMANDS = dict(_commands())


def test_numbers_are_found_by_their_type() -> None:
    """Else the next test would hold no unit of theirs: typer's names for types have changed before."""
    floats = {
        f"{word} --{option.name}"
        for word, each in COMMANDS.items()
        for option in each.params
        if option.type_descriptor.annotation is float
    }
    assert {"run --start", "import wav --carrier", "emulate p440 --loss"} <= floats


@pytest.mark.parametrize("word", COMMANDS)
def test_a_command_explains_itself(
    word: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    told = " ".join((COMMANDS[word].help or "").split())
    assert re.search(rf"Example[^:]*: caneflow {word} ?", told)
    for option in COMMANDS[word].params:
        if option.name == "help":
            continue
        told = getattr(option, "help", None) or ""
        assert told, f"{option.name} has no help"
        if option.type_descriptor.annotation is float:
            assert UNIT.search(told), f"{option.name}: {told!r} names no unit"
    status, out, _ = _run(monkeypatch, capsys, *word.split(), "--help")
    assert status == 0
    assert f"Usage: caneflow {word} " in out
    assert "bool" not in out, "an option that takes no value has no type"
    status, out, err = _run(monkeypatch, capsys, *word.split(), "--no-such-option")
    assert (status, out) == (2, "")
    assert "--no-such-option" in err
    assert "--help" in err, "the next step"


def _run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["caneflow", *arguments])
    with pytest.raises(SystemExit) as end:
        command.main()
    said = capsys.readouterr()
    return int(end.value.code or 0), said.out, said.err


def test_completion_is_installed_and_completes_in_bash(tmp_path: Path) -> None:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    env = {**os.environ, "HOME": str(tmp_path), "PATH": path, "SHELL": "/bin/bash"}
    env["_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION"] = "1"  # which looks at the parent process
    done = subprocess.run(
        ["caneflow", "--install-completion", "bash"], env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "bash completion installed in" in done.stdout
    ask = (
        "source ~/.bashrc; COMP_WORDS=(caneflow rec); COMP_CWORD=1; _caneflow_completion caneflow; echo ${COMPREPLY[@]}"
    )
    done = subprocess.run(["bash", "-c", ask], env=env, capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == {word for word in words.WORDS if word.startswith("rec")}
