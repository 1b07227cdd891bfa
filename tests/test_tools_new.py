"""`caneflow new`: what it writes works as it is, passes its own test and fits into a flow by the printed line."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from caneflow import command
from caneflow.runtime.dataflow.loading import examine

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


def test_programs_pass_their_own_tests_and_make_a_flow(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    lines = []
    for kind, name in (("driver", "my_gyro"), ("operator", "smooth")):
        status, out, err = caneflow("new", kind, name, "--folder", tmp_path)
        assert (status, err) == (0, "")
        assert out.startswith(f"{tmp_path / name}.py: edit it; ")
        lines.append(out.splitlines()[-1].replace("imu/imu", "my_gyro/imu"))
    assert caneflow("new", "message", "my_range", "--folder", tmp_path)[1].endswith("  from my_range import MyRange\n")
    file = tmp_path / "mine.yaml"
    file.write_text("\n".join(["flow: mine", "nodes:", *lines, "results: [smooth/imu]", ""]))
    graph, problems = examine(file)
    assert graph is not None, problems
    assert not problems
    assert [node.program.__name__ for node in graph.nodes.values() if node.program] == ["MyGyro", "Smooth"]
    for check in (
        ["-m", "pytest", "-q", "-p", "no:cacheprovider", "."],
        ["-m", "ruff", "check", "--line-length", "120", "--select", "B,E,F,UP", "."],
    ):
        done = subprocess.run(
            [sys.executable, *check], cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr


def test_a_message_is_not_called_as_a_module_of_python(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    status, _, err = caneflow("new", "message", "random", "--folder", tmp_path)
    assert (status, list(tmp_path.iterdir())) == (2, [])
    assert err.startswith("caneflow new: 'random' is a module of Python itself")


def test_what_is_there_is_not_written_over(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    mine = tmp_path / "test_smooth.py"
    mine.write_text("mine")
    said = f"caneflow new: {mine}: already exists; use --overwrite to replace it\n"
    assert caneflow("new", "operator", "smooth", "--folder", tmp_path) == (2, "", said)
    assert [path.name for path in tmp_path.iterdir()] == ["test_smooth.py"]


def test_a_word_of_python_is_no_name_for_a_file(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    status, _, err = caneflow("new", "operator", "class", "--folder", tmp_path)
    assert status == 2
    assert "'class' is a word of Python's own" in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["json", "struct", "numpy", "pytest"])
def test_a_file_hides_no_installed_module(caneflow: Callable[..., Run], tmp_path: Path, name: str) -> None:
    said = f"caneflow new: {name!r} is the name of an installed module, which a file of this name would hide\n"
    assert caneflow("new", "operator", name, "--folder", tmp_path) == (2, "", said)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["Smooth", "9x", "a-b", "../x", "a.b"])
def test_a_name_that_is_no_nodes_is_refused(caneflow: Callable[..., Run], tmp_path: Path, name: str) -> None:
    status, out, err = caneflow("new", "driver", name, "--folder", tmp_path)
    assert (status, out) == (2, "")
    assert err.startswith(f"caneflow new: {name!r} is not a valid name: ")
    assert not list(tmp_path.iterdir())
