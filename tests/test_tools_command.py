"""The door: words find their tools without importing the others; expected errors are one line."""

import os
import subprocess
import sys
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import pytest
import typer

from caneflow import __version__, command, words
from caneflow.errors import CaneflowError

Run = tuple[int, str, str]  # exit status, standard output, standard error


@pytest.fixture
def caneflow(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Run]:
    """The command, run in this process."""

    def run(*arguments: object) -> Run:
        monkeypatch.setattr(sys, "argv", ["caneflow", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            command.main()
        said = capsys.readouterr()
        return int(end.value.code or 0), said.out, said.err

    return run


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A tool of the word `fake`, for a test to fill."""
    module = ModuleType("caneflow.tools.fake")
    module.__spec__ = ModuleSpec(module.__name__, None)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(words.WORDS, "fake", ("fake", "Pretend."))
    return module


def raising(error: BaseException) -> Callable[[], None]:
    def tool_that_fails() -> None:
        raise error

    return tool_that_fails


def test_help_has_a_line_for_every_word_that_has_a_tool(caneflow: Callable[..., Run]) -> None:
    status, out, _ = caneflow("--help")
    assert status == 0
    for word, (module, summary) in words.WORDS.items():
        listed = any(f" {word} " in line and summary[:20] in line for line in out.splitlines())
        assert listed == (Path(__file__).parents[1] / "tools" / f"{module}.py").exists(), word


def test_version(caneflow: Callable[..., Run]) -> None:
    assert caneflow("--version") == (0, f"caneflow {__version__}\n", "")


def test_a_misspelt_word_is_corrected(caneflow: Callable[..., Run]) -> None:
    status, _, err = caneflow("infoo", "walk.mcap")
    assert status == 2
    assert "Did you mean 'info'?" in err


def test_options_come_from_the_annotations(caneflow: Callable[..., Run], tool: ModuleType) -> None:
    def greet(name: str, times: int = 1) -> None:
        sys.stdout.write(" ".join(["hello", name] * times))

    tool.__dict__["command"] = greet
    assert caneflow("fake", "world", "--times", "2") == (0, "hello world hello world", "")
    status, _, err = caneflow("fake", "world", "--times", "many")
    assert status == 2
    assert "--times" in err


def test_a_tool_may_have_words_of_its_own(caneflow: Callable[..., Run], tool: ModuleType) -> None:
    tool.__dict__["commands"] = {"only": lambda: sys.stdout.write("only one")}
    assert caneflow("fake", "only") == (0, "only one", "")


def test_an_expected_error_is_one_line_and_status_2(caneflow: Callable[..., Run], tool: ModuleType) -> None:
    tool.__dict__["command"] = raising(CaneflowError("walk.mcap: is empty"))
    assert caneflow("fake") == (2, "", "caneflow fake: walk.mcap: is empty\n")


def test_a_file_that_is_not_there_is_an_expected_error(
    caneflow: Callable[..., Run], tool: ModuleType, tmp_path: Path
) -> None:
    tool.__dict__["command"] = lambda: (tmp_path / "nothing").read_text()
    assert caneflow("fake") == (2, "", f"caneflow fake: {tmp_path / 'nothing'}: No such file or directory\n")


def test_the_status_that_a_tool_chose_is_kept(caneflow: Callable[..., Run], tool: ModuleType) -> None:
    tool.__dict__["command"] = raising(typer.Exit(1))
    assert caneflow("fake") == (1, "", "")


def test_ctrl_c_is_status_130(caneflow: Callable[..., Run], tool: ModuleType) -> None:
    tool.__dict__["command"] = raising(KeyboardInterrupt())
    assert caneflow("fake") == (130, "", "")


@pytest.mark.parametrize("bug", [ZeroDivisionError("division by zero"), OSError("something without a file")])
def test_a_bug_keeps_its_traceback(tool: ModuleType, monkeypatch: pytest.MonkeyPatch, bug: Exception) -> None:
    tool.__dict__["command"] = raising(bug)
    monkeypatch.setattr(sys, "argv", ["caneflow", "fake"])
    with pytest.raises(type(bug)):
        command.main()


def test_the_door_imports_no_tool_and_nothing_heavy() -> None:
    look = "import sys, caneflow.words as c; c._command(); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    heavy = {"numpy", "scipy", "matplotlib", "zenoh", "mcap", "msgspec", "pydantic", "ruamel"}
    loaded = done.stdout.split()
    assert not heavy & set(loaded)
    assert not [name for name in loaded if name.startswith("caneflow.tools.")]


@pytest.mark.parametrize(("typed", "offered"), [("caneflow inf", "info"), ("caneflow export --for", "--format")])
def test_the_shell_completes_words_and_options(typed: str, offered: str) -> None:
    asked = {"_CANEFLOW_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" "))}
    start = [sys.executable, "-m", "caneflow.command"]
    done = subprocess.run(start, env={**os.environ, **asked}, capture_output=True, text=True, check=False)
    assert done.stdout.split() == [offered]


def test_status_imports_little_as_it_has_to_answer_at_once() -> None:
    look = "import sys, caneflow.tools.status; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    assert not {"numpy", "pydantic", "scipy", "ruamel", "mcap", "rich.live"} & set(done.stdout.split())
