"""What exists is not destroyed: the rules of an output, and that every option which names one goes by them."""

import errno
import os
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta, timezone
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from typer.models import OptionInfo

from benchmarks import peers, pipeline, scaling
from caneflow import command
from caneflow.errors import CaneflowError
from caneflow.messages import Imu, numbered
from caneflow.options import Overwrite
from caneflow.outputs import (
    PICTURES,
    OutputError,
    made_folder,
    named_at,
    require_free,
    reserved,
    share_lock,
    whole,
)
from caneflow.recording import RecordingWriter
from caneflow.words import TOOLS, WORDS

ROOT = Path(__file__).parents[1]
Run = tuple[int, str, str]  # exit status, standard output, standard error


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A file that exists, of this content."""
    path = tmp_path / "out.txt"
    path.write_text("old")
    return path


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


def names(folder: Path) -> list[str]:
    return sorted(each.name for each in folder.iterdir())


# --- a file that is written and then there


def test_a_file_appears_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    with whole(path) as fresh:
        fresh.write_text("new")
        assert not path.exists()
        assert fresh.suffix == ".txt", "libraries go by it"
        assert stat.S_IMODE(fresh.parent.stat().st_mode) == 0o700, "nobody else reads it meanwhile"
        assert fresh.stat().st_dev == path.parent.stat().st_dev
    assert path.read_text() == "new"
    assert names(tmp_path) == ["out.txt"]


@pytest.mark.parametrize("end", [ValueError(), KeyboardInterrupt(), SystemExit(3), CaneflowError("no")])
@pytest.mark.parametrize("overwrite", [False, True])
def test_nothing_is_left_of_a_block_that_ends_badly(tmp_path: Path, end: BaseException, overwrite: bool) -> None:
    path = tmp_path / "out.txt"
    if overwrite:
        path.write_text("old")
    with pytest.raises(type(end)), whole(path, overwrite=overwrite) as fresh:
        fresh.write_text("half")
        raise end
    assert names(tmp_path) == (["out.txt"] if overwrite else [])
    assert not overwrite or path.read_text() == "old"


def test_a_block_that_writes_nothing_makes_nothing(tmp_path: Path) -> None:
    with whole(tmp_path / "out.txt"):
        pass
    assert not names(tmp_path)


def test_no_path_is_no_file() -> None:
    with whole(None) as fresh:
        assert fresh is None


def test_what_exists_is_kept_unless_it_may_be_replaced(old: Path) -> None:
    with pytest.raises(OutputError, match=r"out\.txt: already exists; use --overwrite to replace it"):
        whole(old)
    with whole(old, overwrite=True) as fresh:
        fresh.write_text("new")
        assert old.read_text() == "old", "until the new one is whole"
    assert old.read_text() == "new"


def test_a_new_file_has_the_permissions_that_others_would_have(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        with whole(tmp_path / "a") as fresh:
            fresh.write_text("new")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


def test_a_private_file_stays_private_when_it_is_replaced(old: Path) -> None:
    old.chmod(0o600)
    with whole(old, overwrite=True) as fresh:
        fresh.write_text("new")
    assert stat.S_IMODE(old.stat().st_mode) == 0o600


def link(kind: str, at: Path, to: Path) -> Path:
    """Another name for a file."""
    if kind == "hard":
        at.hardlink_to(to)
    elif kind == "symbolic":
        at.symlink_to(to)
    else:
        return to.parent / "." / ".." / to.parent.name / to.name
    return at


@pytest.mark.parametrize("kind", ["hard", "symbolic", "another path"])
@pytest.mark.parametrize("overwrite", [False, True])
def test_an_input_is_never_an_output(old: Path, kind: str, overwrite: bool) -> None:
    named = link(kind, old.with_name("link"), old)
    for output, source in ((named, old), (old, named)):
        with pytest.raises(OutputError, match="is an input of this command"):
            whole(output, inputs=[None, source], overwrite=overwrite)
    assert old.read_text() == "old"


def test_a_link_stays_when_the_file_behind_it_is_replaced(old: Path) -> None:
    named = link("symbolic", old.with_name("link"), old)
    with pytest.raises(OutputError, match="already exists"):
        whole(named)
    with whole(named, overwrite=True) as fresh:
        fresh.write_text("new")
    assert named.is_symlink()
    assert old.read_text() == "new"


def test_a_link_to_nothing_is_filled(tmp_path: Path) -> None:
    named = tmp_path / "link"
    named.symlink_to(tmp_path / "out")
    with whole(named) as fresh:
        fresh.write_text("new")
    assert (tmp_path / "out").read_text() == "new"


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_is_no_file(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(OutputError, match="is an existing folder"):
        whole(tmp_path, overwrite=overwrite)


def test_a_folder_that_is_missing_or_closed_is_one_line_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"there is no folder .*nowhere"):
        whole(tmp_path / "nowhere" / "a.txt")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"there is no folder .*file"):
        whole(tmp_path / "file" / "a.txt")
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="no permission to write in the folder"):
        whole(tmp_path / "a.txt")


def test_a_loop_of_links_and_an_endless_name_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("loop", "x" * 300):
        with pytest.raises(OutputError, match="cannot be written: "):
            whole(tmp_path / name)
    longest = tmp_path / ("ä" * 127)
    with whole(longest) as fresh:
        fresh.write_text("new")
    assert longest.read_text() == "new"


def test_a_name_that_is_taken_during_the_work_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    with pytest.raises(OutputError, match="was made by another command meanwhile"), whole(path) as fresh:
        fresh.write_text("new")
        path.write_text("another's")
    assert path.read_text() == "another's"
    assert names(tmp_path) == ["out.txt"]


def test_a_file_system_without_hard_links_will_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(Path, "hardlink_to", refuse)
    with whole(tmp_path / "a") as fresh:
        fresh.write_text("new")
    assert (tmp_path / "a").read_text() == "new"


def test_errors_name_the_output_and_not_the_place_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    with pytest.raises(CaneflowError) as said, whole(path) as fresh:
        raise CaneflowError(f"{fresh}: cannot be written")
    assert str(said.value) == f"{path}: cannot be written"
    with pytest.raises(OutputError) as full, whole(path):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert str(full.value) == f"{path}: cannot be written: No space left on device"
    with pytest.raises(OSError, match="of another kind"), whole(path):
        raise OSError(errno.EBADF, "of another kind")


@pytest.mark.parametrize("name", ["/dev/null", "/dev/stdout", "/dev/fd/1"])
def test_devices_and_streams_are_written_directly(name: str) -> None:
    with whole(Path(name)) as fresh:
        assert fresh == Path(name)
    with reserved(Path(name)):
        pass
    assert Path(name).exists()


def test_a_stream_that_leads_to_a_file_is_written_as_it_is_open(tmp_path: Path) -> None:
    script = (
        "from pathlib import Path; from caneflow.outputs import whole\nwith whole(Path('/dev/stdout')) as f: print(f)"
    )
    with (tmp_path / "said").open("w") as said:
        subprocess.run([sys.executable, "-c", script], stdout=said, check=True)
    assert (tmp_path / "said").read_text() == "/dev/stdout\n"


def test_a_pipe_is_written_directly(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with whole(pipe) as fresh:
        assert fresh == pipe
    assert names(tmp_path) == ["pipe"]


# --- pictures and bags


BEGINNINGS = {
    "png": b"\x89PNG\r\n\x1a\n\0\0",
    "pdf": b"%PDF-1.4\n",
    "svg": b'<?xml version="1.0"?>\n<!DOCTYPE svg PUBLIC "-//W3C//"\n "x">\n<!-- by\n -->\n<svg width="1">',
    "mermaid": b'flowchart LR\n    node_a["a"]\n',
    "json": b'{\n  "flow": "cane",\n  "nodes": [\n',
}


@pytest.mark.parametrize("kind", PICTURES)
def test_a_picture_replaces_only_one_of_its_kind(tmp_path: Path, kind: str) -> None:
    for found, content in {**BEGINNINGS, "mcap": b"\x89MCAP0\r\n", "text": b"mine", "empty": b""}.items():
        path = tmp_path / f"x.{kind}"
        path.write_bytes(content)
        if found == kind:
            require_free(path, picture=kind)
            with pytest.raises(OutputError, match="is an input"):
                require_free(path, picture=kind, inputs=[path])
        else:
            with pytest.raises(OutputError, match="already exists"):
                require_free(path, picture=kind)


def test_a_folder_of_rosbag2_is_replaced_and_no_other(tmp_path: Path) -> None:
    bag = tmp_path / "bag"

    def write() -> None:
        with whole(bag, folder=True, overwrite=True) as fresh:
            fresh.mkdir()
            (fresh / "metadata.yaml").write_text("")
            (fresh / f"{fresh.name}.mcap").write_text("")

    write()
    (bag / "bag_1.mcap").write_text("old")
    with pytest.raises(OutputError, match="is an existing folder"):
        whole(bag, folder=True)
    write()
    assert names(bag) == ["bag.mcap", "metadata.yaml"]
    (bag / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match="is an existing folder"):
        write()
    assert names(tmp_path) == ["bag"]
    assert "mine.txt" in names(bag)
    with pytest.raises(OutputError, match="is an existing file"):
        whole(bag / "mine.txt", folder=True, overwrite=True)


def test_a_folder_that_stays_empty_goes_again(tmp_path: Path) -> None:
    for filled in (False, True):
        with made_folder(tmp_path / "new"):
            assert (tmp_path / "new").is_dir()
            if filled:
                (tmp_path / "new" / "a").write_text("")
        assert (tmp_path / "new").exists() == filled
    with pytest.raises(OutputError, match="there is no folder"), made_folder(tmp_path / "a" / "b"):
        pass


# --- a recording that is written while a flow runs


def test_a_reserved_name_is_nobody_elses(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    with reserved(path):
        for overwrite, said in ((False, "already exists"), (True, "is being written by a running flow")):
            with pytest.raises(OutputError, match=said), reserved(path, overwrite=overwrite):
                pass
            with pytest.raises(OutputError, match=said):
                whole(path, overwrite=overwrite)
    assert not path.exists(), "nothing was recorded"


def test_a_reserved_name_keeps_what_was_recorded(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    with reserved(path):
        path.write_text("recorded")
    assert path.read_text() == "recorded"
    with reserved(path, overwrite=True):
        assert path.read_text() == "recorded", "until the new recording begins"
    assert path.read_text() == "recorded"
    with reserved(path, overwrite=True), pytest.raises(OutputError, match="is an input"):
        require_free(path, inputs=[path], overwrite=True)


def test_a_recording_that_goes_on_is_replaced_by_nothing(tmp_path: Path) -> None:
    path = tmp_path / "walk_000.mcap"
    with RecordingWriter(path, flow="cane", source="live", rig={}) as writer:
        with pytest.raises(OutputError, match="is being written by a running flow"):
            whole(path, overwrite=True)
        writer.write("cane/imu/imu", Imu, numbered(Imu(stamp=1, gyro=(0, 0, 0)), 0), stamp=1, seq=0, log_time=1)
    require_free(path, overwrite=True)


def test_a_recording_that_begins_during_the_work_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    path.write_text("old")
    with (
        path.open("ab") as recording,
        pytest.raises(OutputError, match="is being written by a running flow"),
        whole(path, overwrite=True) as fresh,
    ):
        fresh.write_text("new")
        share_lock(recording.fileno())
    assert path.read_text() == "old"


def test_the_time_in_a_name_is_utc_and_its_file_is_new(tmp_path: Path) -> None:
    now = datetime(2026, 11, 30, 15, 5, 1, tzinfo=timezone(timedelta(hours=1)))
    template = tmp_path / "{time}" / "walk-{time}.mcap"
    first = named_at(template, now)
    assert first == tmp_path / "20261130T140501Z" / "walk-20261130T140501Z.mcap"
    first.parent.mkdir()
    first.write_text("")
    assert named_at(tmp_path / "20261130T140501Z" / "walk-{time}.mcap", now).name == "walk-20261130T140501Z-2.mcap"
    assert named_at(first, now) == first


# --- every option of every command


# By command and option: a call that would write `OUT`; in it `REC` is a recording and `YAML` a dataflow.
OUTPUTS: dict[tuple[str, str], list[object]] = {
    ("run", "record"): ["run", "YAML", "--replay", "REC", "--in-process", "--record", "OUT"],
    ("graph", "output"): ["graph", "YAML", "-o", "OUT"],
    ("simulate walk", "output"): ["simulate", "walk", "--duration", "1", "-o", "OUT"],
    ("simulate room", "output"): ["simulate", "room", "--part", "empty", "-o", "OUT"],
    ("simulate cane_in_room", "output"): ["simulate", "cane_in_room", "-o", "OUT"],
    ("recover", "output"): ["recover", "REC", "-o", "OUT"],
    ("import p440", "output"): ["import", "p440", "LOG", "-o", "OUT"],
    ("import imu-csv", "output"): ["import", "imu-csv", "LOG", "--columns", "time=t,gyro_x=x", "-o", "OUT"],
    ("import a121", "output"): ["import", "a121", "LOG", "-o", "OUT"],
    ("import mmwave", "output"): ["import", "mmwave", "LOG", "-o", "OUT"],
    ("import wav", "output"): ["import", "wav", "LOG", "-o", "OUT"],
    ("export", "output"): ["export", "REC", "--format", "csv", "--stream", "imu/imu", "-o", "OUT"],
    ("eval", "csv_file"): ["eval", "REC", "--flow", "YAML", "--csv", "OUT"],
    ("experiments", "output"): ["experiments", "--seeds", "1", "--only", "swing", "--flow", "YAML", "-o", "OUT"],
    ("ablation", "output"): ["ablation", "--seeds", "1", "--others", "0", "-o", "OUT"],
    ("calibrate room", "output"): ["calibrate", "room", "REC", "REC", "-o", "OUT"],
    ("plot", "output"): ["plot", "REC", "-o", "OUT"],
    ("mcu config", "output"): ["mcu", "config", "YAML", "-o", "OUT"],
    ("new operator", "folder"): ["new", "operator", "out", "--folder", "FOLDER"],
    ("new driver", "folder"): ["new", "driver", "out", "--folder", "FOLDER"],
    ("new message", "folder"): ["new", "message", "out", "--folder", "FOLDER"],
    ("new flow", "output"): ["new", "flow", "cane", "-o", "OUT"],
    ("import rosbag", "output"): ["import", "rosbag", "LOG", "-o", "OUT"],
}
MORE: dict[tuple[str, str], list[list[object]]] = {
    ("export", "output"): [
        ["export", "REC", "--format", form, "-o", "OUT"] for form in ("csv", "tum", "foxglove", "rosbag2")
    ],
    ("graph", "output"): [["graph", "YAML", "--format", form, "-o", "OUT"] for form in ("svg", "json")],
}
CALLS = [(named, call) for named, first in OUTPUTS.items() for call in (first, *MORE.get(named, []))]
# What only reads, has rules of its own (keys, results that continue, a link to a terminal), or is not a user's file.
OTHERS = {
    *(("run", name) for name in ("replay", "keys", "rig")),
    *((word, "keys") for word in ("status", "hz", "echo", "top", "record", "doctor", "view", "ros2", "foxglove")),
    *((f"keys {word}", "folder") for word in ("init", "add", "list", "router")),
    *((word, "flow") for word in ("eval", "experiments")),
    ("bench", "file"),
    ("check", "rig"),
    ("eval", "results_file"),
    ("experiments", "folder"),
    ("emulate bno055", "port"),
    ("emulate drv2605", "bus"),
    ("emulate mb1202", "bus"),
    ("emulate vl53l1x", "bus"),
    ("emulate vl53l5cx", "bus"),
    ("emulate vl53l5cx", "firmware"),
    ("emulate ti_mmwave", "cli"),
    ("emulate ti_mmwave", "data"),
    ("import mmwave", "config"),
    ("import rosbag", "rig"),
}


def functions() -> Iterator[tuple[str, Callable[..., object]]]:
    """The function behind every command, by its words."""
    for word, (module, _) in WORDS.items():
        tool = import_module(f"{TOOLS}.{module}")
        for name, each in getattr(tool, "commands", {"": getattr(tool, "command", None)}).items():
            yield f"{word} {name}".strip(), import_module(f"{TOOLS}.{each}").command if isinstance(each, str) else each


def options_with_paths() -> Iterator[tuple[str, str]]:
    for words, function in functions():
        for name, hint in get_type_hints(function, include_extras=True).items():
            is_option = any(isinstance(each, OptionInfo) for each in getattr(hint, "__metadata__", ()))
            if is_option and (getattr(hint, "__origin__", None) is Path or Path in get_args(hint.__origin__)):
                yield words, name


def test_every_option_that_names_a_file_is_known_here() -> None:
    """A new one belongs into OUTPUTS, with a call that proves it, or into OTHERS, if it writes nothing."""
    assert set(options_with_paths()) - OTHERS == set(OUTPUTS)
    assert set(options_with_paths()) >= OTHERS


def test_overwrite_is_where_an_output_is_and_nowhere_else() -> None:
    written = {words for words, _ in OUTPUTS}
    for words, function in functions():
        assert (get_type_hints(function, include_extras=True).get("overwrite") == Overwrite) == (words in written), (
            words
        )


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """What a call may name; OUT exists and is not a picture, no recording."""
    paths = {name: tmp_path / name.lower() for name in ("REC", "YAML", "LOG")}
    paths["OUT"] = tmp_path / "out.py"
    with RecordingWriter(paths["REC"], flow="cane", source="live", rig={}) as writer:
        writer.write("cane/imu/imu", Imu, numbered(Imu(stamp=1, gyro=(0, 0, 0)), 0), stamp=1, seq=0, log_time=1)
    paths["YAML"].write_bytes((ROOT / "dataflow.yaml").read_bytes())
    paths["LOG"].write_text("a log")
    paths["OUT"].write_text("mine")
    paths["FOLDER"] = tmp_path
    return paths


def filled(call: list[object], files: dict[str, Path], output: Path | None = None) -> list[object]:
    named: dict[str, object] = {**files, **({"OUT": output} if output else {})}
    return [named.get(str(each), each) for each in call]


def with_suffix_for(named: tuple[str, str], path: Path) -> Path:
    """The output under a name that the command takes."""
    suffix = {"plot": ".png", "simulate room": ".mcap"}.get(named[0])
    return path if suffix is None else path.rename(path.with_suffix(suffix))


@pytest.mark.parametrize(("named", "call"), CALLS, ids=lambda each: " ".join(map(str, each)))
def test_what_exists_is_refused_before_anything_starts(
    caneflow: Callable[..., Run], files: dict[str, Path], named: tuple[str, str], call: list[object]
) -> None:
    files["OUT"] = with_suffix_for(named, files["OUT"])
    before = names(files["FOLDER"])
    status, out, err = caneflow(*filled(call, files))
    assert (status, out, err.count("\n")) == (2, "", 1), err
    assert f"{files['OUT']}: already exists; use --overwrite to replace it" in err or (
        "rosbag2" in call and "is an existing file" in err
    )
    assert files["OUT"].read_text() == "mine"
    assert names(files["FOLDER"]) == before


INPUTS = [(named, call) for named, call in CALLS if {"REC", "YAML", "LOG"} & set(map(str, call))]


@pytest.mark.parametrize(("named", "call"), INPUTS, ids=lambda each: " ".join(map(str, each)))
@pytest.mark.parametrize("kind", ["itself", "hard", "symbolic"])
def test_an_input_is_left_alone_even_with_overwrite(
    caneflow: Callable[..., Run], files: dict[str, Path], named: tuple[str, str], call: list[object], kind: str
) -> None:
    for name in {"REC", "YAML", "LOG"} & set(map(str, call)):
        before = files[name].read_bytes()
        output = files[name] if kind == "itself" else link(kind, files["FOLDER"] / f"{name}.{kind}", files[name])
        if named[0] == "plot":
            files[name] = files[name].rename(files[name].with_suffix(".png"))
            output = files[name] if kind == "itself" else output.rename(output.with_suffix(".png"))
            if kind == "symbolic":
                output.unlink()
                output.symlink_to(files[name])
        status, out, err = caneflow(*filled(call, files, output), "--overwrite")
        assert (status, out, err.count("\n")) == (2, "", 1), err
        assert f"{output}: is an input of this command" in err
        assert files[name].read_bytes() == before


def test_a_folder_that_is_not_there_is_one_line(caneflow: Callable[..., Run], files: dict[str, Path]) -> None:
    for named, call in CALLS:
        if "OUT" in call:
            output = files["FOLDER"] / "nowhere" / "out.mcap"
            output = output.with_suffix(".png") if named[0] == "plot" else output
            status, out, err = caneflow(*filled(call, files, output))
            assert (status, out, err.count("\n")) == (2, "", 1), (named, err)
            assert "there is no folder" in err, named


def test_a_rig_and_a_program_of_the_flow_are_inputs_too(caneflow: Callable[..., Run], files: dict[str, Path]) -> None:
    rig, program = files["FOLDER"] / "rig.yaml", files["FOLDER"] / "mine.py"
    rig.write_text("boresight: [0, 1, 0]\n")
    caneflow("new", "operator", "mine", "--folder", files["FOLDER"])
    files["YAML"].write_text(
        "flow: cane\nnodes: {imu: {run: drivers.bno055}, mine: {run: ./mine.py, inputs: {imu: imu/imu}}}\n"
        "results: [mine/imu]"
    )
    for source in (rig, program):
        before = source.read_bytes()
        call = ["run", files["YAML"], "--replay", files["REC"], "--in-process", "--rig", rig, "--record", source]
        status, _, err = caneflow(*call, "--overwrite")
        assert (status, err) == (
            2,
            f"caneflow run: {source}: is an input of this command; expected another name for the output\n",
        )
        assert source.read_bytes() == before


def test_the_recording_of_a_run_that_cannot_start_leaves_no_file(
    caneflow: Callable[..., Run], files: dict[str, Path]
) -> None:
    new = files["FOLDER"] / "new.mcap"
    assert caneflow("run", files["LOG"], "--replay", files["REC"], "--in-process", "--record", new)[0] == 2
    assert not new.exists()
    call = ["run", files["LOG"], "--replay", files["REC"], "--in-process", "--record", files["OUT"], "--overwrite"]
    assert caneflow(*call)[0] == 2
    assert files["OUT"].read_text() == "mine"


def test_a_recording_is_named_after_the_time(caneflow: Callable[..., Run], files: dict[str, Path]) -> None:
    files["YAML"].write_text("flow: cane\nnodes: {imu: {run: drivers.bno055}}")
    call = [
        "run",
        files["YAML"],
        "--replay",
        files["REC"],
        "--in-process",
        "--record",
        files["FOLDER"] / "a-{time}.mcap",
    ]
    for number in (1, 2, 3):
        status, _, err = caneflow(*call)
        assert status == 0, err
        made = list(files["FOLDER"].glob("a-20*Z*.mcap"))
        assert len(made) == number, "whatever second it is"
        assert all(each.stat().st_size for each in made)


@pytest.mark.parametrize("module", [peers, pipeline, scaling])
@pytest.mark.parametrize("suffix", [".md", ".json"])
def test_a_benchmark_writes_over_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], module: Any, suffix: str
) -> None:
    (tmp_path / "pictures").mkdir()
    path = tmp_path / f"page{suffix}"
    path.write_text("mine")
    walk = ["walk.mcap"] if module is pipeline else []
    monkeypatch.setattr(sys, "argv", ["benchmark", *walk, "--write", str(tmp_path / "page.md")])
    with pytest.raises(SystemExit) as end:
        module.main()
    assert end.value.code == 2
    assert f"{path}: already exists; use --overwrite to replace it\n" in capsys.readouterr().err
    assert path.read_text() == "mine"
