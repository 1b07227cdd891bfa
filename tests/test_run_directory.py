"""The folder of a run: this user's alone or not used; and what tools believe of the folders that they find."""

import fcntl
import json
import os
import pwd
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.attached import attach
from caneflow.runtime.hosts.launcher.run_directory import (
    RunDirectory,
    RunningFlow,
    refused_addresses,
    remove_state_folder,
    running_flows,
    state_folder,
)
from tests.flows import STRANGER, as_stranger

NO_PID = 2**31 - 1
ME = os.getuid()
HERE = "tcp/127.0.0.1:20000"
ROOT_ONLY = pytest.mark.skipif(ME != 0, reason="only root can give a folder to another user")


@pytest.fixture
def common(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A temporary folder of everybody, as /tmp is, that this user and strangers can enter."""
    # Those of pytest are closed to other users.
    folder = Path(tempfile.mkdtemp(prefix="common-", dir="/tmp"))
    folder.chmod(0o1777)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setattr("caneflow.runtime.hosts.launcher.run_directory._roots", lambda: list(folder.glob("caneflow-*")))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def process_of(user: int) -> Iterator[int]:
    """The pid of a process of another user."""
    # `cat`, as the interpreter may lie where only root comes to.
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE, user=user) as process:
        yield process.pid
        process.kill()


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


# --- of a launcher ---------------------------------------------------------------------------------------------------


def test_a_run_has_a_folder_that_is_its_users_alone_and_held(common: Path) -> None:
    before = os.umask(0)
    try:
        with RunDirectory("cane") as run, run.announced(HERE):
            root = common / f"caneflow-{ME}"
            assert run.path == root / f"cane-{os.getpid()}"
            assert (run.remark, mode_of(root), mode_of(run.path), mode_of(run.path / "flow.json")) == (
                "",
                0o700,
                0o700,
                0o600,
            )
            for folder in (root, run.path):  # a cleaner that respects locks leaves it
                descriptor = os.open(folder, os.O_RDONLY)
                with pytest.raises(BlockingIOError):
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.close(descriptor)
            assert running_flows() == [RunningFlow("cane", os.getpid(), HERE, folder=str(run.path))]
        assert not list(root.iterdir())
    finally:
        os.umask(before)


def test_a_long_name_of_a_flow_does_not_make_the_folders_name_long(common: Path) -> None:
    name = "a_flow_with_a_name_of_many_letters" * 10
    with RunDirectory(name) as run, run.announced(HERE):
        assert len(run.path.name) < 30
        assert [flow.flow for flow in running_flows()] == [name]


def squatted(folder: Path, how: str) -> Path:
    """Someone was first at `folder`; where whatever is written into it would come."""
    trap = folder.parent / "trap"
    trap.mkdir()
    if how == "link":
        folder.symlink_to(trap)
        return trap
    if how == "file":
        folder.write_text("")
        return trap
    folder.mkdir()
    folder.chmod(int(how, 8) if how.isdigit() else 0o755)
    if how == "stranger":
        os.chown(folder, STRANGER, STRANGER)
    return folder


SQUATS = ["link", "file", "777", "770", "733", "755", pytest.param("stranger", marks=ROOT_ONLY)]


@pytest.mark.parametrize("how", SQUATS)
def test_a_folder_that_is_not_ours_is_not_used_and_the_run_is_found_elsewhere(common: Path, how: str) -> None:
    usual = common / f"caneflow-{ME}"
    trap = squatted(usual, how)
    paths = []
    for _ in range(2):
        with RunDirectory("cane") as run, run.announced(HERE):
            assert run.remark.startswith(f"{usual}: ") == (how != "755"), "one that others only read says nothing"
            assert (run.path.parent.parent, mode_of(run.path.parent)) == (common, 0o700)
            assert not list(trap.iterdir())
            assert running_flows() == [RunningFlow("cane", os.getpid(), HERE, folder=str(run.path))]
            paths.append(run.path)
    assert paths[0] == paths[1], "the next run takes the folder that the first one made"


def test_a_common_folder_in_which_anybody_may_rename_is_refused(common: Path) -> None:
    common.chmod(0o777)
    with pytest.raises(DataflowError, match=r"anybody may exchange folders in it .*; set XDG_RUNTIME_DIR to"):
        RunDirectory("cane").__enter__()


@pytest.mark.parametrize("where", ["", "/deeper/still"])
def test_a_parent_that_is_not_there_is_made_private(common: Path, monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", f"{common}/run{where}")
    with RunDirectory("cane") as run:
        parents = [parent for parent in run.path.parents if common in parent.parents]
        assert {mode_of(parent) for parent in parents} == {0o700}


def test_where_no_folder_can_be_made_is_said(common: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (common / "file").write_text("")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(common / "file"))
    with pytest.raises(DataflowError, match=rf"{common}/file/caneflow-.*; set XDG_RUNTIME_DIR to a folder"):
        RunDirectory("cane").__enter__()


def test_what_dead_launchers_left_is_swept_and_nothing_else(common: Path) -> None:
    root, kept = common / f"caneflow-{ME}", common / "kept"
    root.mkdir(mode=0o700)
    (kept / "cane-1").mkdir(parents=True)
    (root / f"dead-{NO_PID}").mkdir()
    (root / f"dead-{NO_PID}" / "0").write_text("")
    (root / f"link-{NO_PID}").symlink_to(kept)
    (root / f"held-{NO_PID}").mkdir()  # by a process in another namespace, say
    (root / f"alive-{os.getppid()}").mkdir()
    (root / "state-cane-gateway").mkdir()
    held = os.open(root / f"held-{NO_PID}", os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_SH)
    with RunDirectory("cane"):
        left = {path.name for path in root.iterdir()} - {f"cane-{os.getpid()}", f"link-{NO_PID}"}
    os.close(held)
    assert left == {f"held-{NO_PID}", f"alive-{os.getppid()}", "state-cane-gateway"}
    assert (kept / "cane-1").exists()


def test_a_folder_that_was_removed_is_known(common: Path) -> None:
    with RunDirectory("cane") as run, run.announced(HERE):
        assert run.is_there
        (run.path / "flow.json").unlink()
        run.path.rmdir()
        assert not run.is_there
        run.path.mkdir()
        assert not run.is_there, "one of the same name is another one"


# --- of a machine of several -----------------------------------------------------------------------------------------


def test_a_state_folder_is_private_and_keeps_the_runs_own(common: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", f"{common}/state:/other")
    (common / "state").mkdir(mode=0o700)
    (common / "state" / "state-cane-phone").mkdir(mode=0o755)  # as a version before this made it
    (common / "state" / "state-cane-phone" / "old").symlink_to(common)
    folder = state_folder("cane", "phone", "4711")
    assert folder.path == common / "state" / "state-cane-phone" / "4711"
    assert [mode_of(folder.path), mode_of(folder.path.parent)] == [0o700, 0o700]
    assert [path.name for path in folder.path.parent.iterdir()] == ["4711"]
    remove_state_folder(folder)
    assert not list((common / "state").iterdir())
    assert common.exists()


@pytest.mark.parametrize("how", ["link", "file", "777", pytest.param("stranger", marks=ROOT_ONLY)])
@pytest.mark.parametrize("where", ["state/state-cane-phone", "state/state-cane-phone/4711"])
def test_a_state_folder_that_is_not_ours_is_refused(
    common: Path, monkeypatch: pytest.MonkeyPatch, how: str, where: str
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", f"{common}/state")
    (common / where).parent.mkdir(mode=0o700, parents=True)
    squatted(common / where, how)
    with pytest.raises(DataflowError, match=rf"^{common / where}: "):
        state_folder("cane", "phone", "4711")


@pytest.mark.parametrize("how", ["777", pytest.param("stranger", marks=ROOT_ONLY)])
def test_a_given_folder_that_others_may_write_is_refused(
    common: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", f"{common}/state")
    squatted(common / "state", how)
    with pytest.raises(DataflowError, match=rf"^{common}/state: "):
        state_folder("cane", "phone", "4711")


@pytest.mark.parametrize("run", ["..", ".", "", "a/b", "x" * 300])
def test_a_run_of_another_machine_cannot_lead_out_of_the_folder(
    common: Path, monkeypatch: pytest.MonkeyPatch, run: str
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(common / "state"))
    (common / "state").mkdir(mode=0o700)
    with pytest.raises(DataflowError):
        state_folder("cane", "phone", run)


# --- of tools --------------------------------------------------------------------------------------------------------


def write_address(root: Path, pid: int, owner: int = ME, **other: object) -> Path:
    """A run folder as a launcher of `pid` makes it, but for `other`."""
    folder = root / f"cane-{pid}"
    folder.mkdir(parents=True)
    (folder / "flow.json").write_text(json.dumps({"flow": "cane", "pid": pid, "endpoint": HERE, **other}))
    for path in (root, folder, folder / "flow.json"):
        os.chown(path, owner, owner)
        path.chmod(0o700)
    return folder


@pytest.mark.parametrize(
    "endpoint",
    [
        *("", "x", "tcp/", "tcp/10.0.0.1:1", "tcp/127.0.0.1:99999", "tls/127.0.0.1:1", "\0", "a\n" * 999),
        *("unixsock-stream/", "unixsock-stream//run/other/0"),
        *("unixsock-stream/{folder}/flow.json", "unixsock-stream/{folder}/../../0"),
    ],
)
def test_an_endpoint_of_a_strange_form_is_refused_in_one_line(common: Path, endpoint: str) -> None:
    folder = common / f"caneflow-{ME}" / f"cane-{os.getpid()}"
    write_address(folder.parent, os.getpid(), endpoint=endpoint.format(folder=folder))
    assert running_flows() == []
    with pytest.raises(DataflowError) as refused:
        attach.endpoint_of("cane")
    assert f"{folder}/flow.json: " in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


DAMAGES: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "huge": lambda path: path.write_text('{"flow": "' + "x" * 10_000_000),
    "no text": lambda path: path.write_bytes(b"\xff\xfe{"),
    "deep": lambda path: path.write_text("[" * 4000),
    "of another process": lambda path: path.write_text(json.dumps({"flow": "cane", "pid": 1, "endpoint": HERE})),
    "of no flow": lambda path: path.write_text(json.dumps({"flow": "\x1b[2J", "pid": os.getpid(), "endpoint": HERE})),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_an_address_that_is_damaged_is_refused_in_one_line(common: Path, damage: str) -> None:
    DAMAGES[damage](write_address(common / f"caneflow-{ME}", os.getpid()) / "flow.json")
    assert running_flows() == []
    (line,) = refused_addresses()
    assert line.startswith(f"{common}/caneflow-{ME}/cane-{os.getpid()}/flow.json: ")
    assert line.isprintable()


@pytest.mark.parametrize("what", ["link", "pipe", "folder"])
def test_an_address_that_is_not_a_file_is_not_read(common: Path, what: str) -> None:
    file = write_address(common / f"caneflow-{ME}", os.getpid()) / "flow.json"
    file.rename(common / "elsewhere")
    match what:
        case "link":
            file.symlink_to(common / "elsewhere")
        case "pipe":
            os.mkfifo(file)
        case "folder":
            file.mkdir()
    assert (running_flows(), refused_addresses()) == ([], [])


@pytest.mark.parametrize("what", ["caneflow-{me}", "caneflow-{me}/cane-{pid}"])
def test_a_folder_that_others_may_write_or_that_is_a_link_is_not_believed(common: Path, what: str) -> None:
    path = common / what.format(me=ME, pid=os.getpid())
    write_address(common / f"caneflow-{ME}", os.getpid())
    assert len(running_flows()) == 1
    path.chmod(0o777)
    assert running_flows() == []
    path.chmod(0o700)
    path.rename(common / "elsewhere")
    path.symlink_to(common / "elsewhere")
    assert running_flows() == []


@ROOT_ONLY
def test_root_sees_the_flow_of_another_user_and_says_whose(common: Path, caplog: pytest.LogCaptureFixture) -> None:
    name = pwd.getpwuid(STRANGER).pw_name
    with process_of(STRANGER) as theirs:
        folder = write_address(common / "caneflow-65534", theirs, owner=STRANGER)
        assert running_flows() == [RunningFlow("cane", theirs, HERE, name, str(folder))]
        assert attach.endpoint_of("cane") == HERE
        assert caplog.messages == [f"cane (pid {theirs}), of user {name}"]
        own = "tcp/127.0.0.1:20001"
        write_address(common / f"caneflow-{ME}", os.getpid(), endpoint=own)
        assert attach.endpoint_of("cane") == own, "another user's flow never stands in the place of one's own"


@ROOT_ONLY
def test_flows_of_other_users_are_told_apart_by_whose_they_are(common: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    running = [RunningFlow("cane", 1, "tcp/127.0.0.1:1", "ann"), RunningFlow("cane", 2, "tcp/127.0.0.1:1", "bob")]
    monkeypatch.setattr(attach, "running_flows", lambda: running)
    with pytest.raises(DataflowError, match=r"--at tcp/127.0.0.1:1 \(pid 1, of user ann\), --at .*of user bob\)"):
        attach.endpoint_of("cane")


@ROOT_ONLY
def test_a_folder_cannot_speak_for_the_process_of_another_user(common: Path) -> None:
    write_address(common / "caneflow-65534", os.getpid(), owner=STRANGER)
    assert running_flows() == []


@ROOT_ONLY
@pytest.mark.parametrize("part", ["", "cane-{pid}", "cane-{pid}/flow.json"])
def test_what_a_stranger_made_is_not_believed_by_anybody_else(common: Path, part: str) -> None:
    root = common / f"caneflow-{ME}"
    write_address(root, os.getpid())
    for path in (root, *root.rglob("*")):
        path.chmod(0o755)
    changed = root / part.format(pid=os.getpid())
    os.chown(changed, STRANGER, STRANGER)
    assert running_flows() == []


def test_a_stranger_neither_reads_the_address_nor_sees_the_flow(common: Path) -> None:
    with RunDirectory("cane") as run, run.announced(HERE):
        assert as_stranger(lambda: (run.path / "flow.json").read_bytes()) == "PermissionError"
        assert as_stranger(lambda: list(run.path.parent.iterdir())) == "PermissionError"
        assert as_stranger(running_flows) == "[]"
