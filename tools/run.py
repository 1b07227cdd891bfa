"""`caneflow run`: a dataflow as processes, live or on a recording."""

import gc
import math
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from caneflow.errors import not_installed
from caneflow.messages.control import Counters
from caneflow.options import Overwrite
from caneflow.outputs import named_at, require_folder, require_no_input, reserved
from caneflow.printable import printable
from caneflow.recording.parts import Rotation, read_span
from caneflow.runtime.dataflow.graph import Graph
from caneflow.runtime.dataflow.loading import load, read_rig
from caneflow.runtime.dataflow.topology import NOBODY_LISTENS
from caneflow.runtime.deployment import Deployment, deploy
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.in_process import InProcess, failure_of
from caneflow.runtime.hosts.launcher.console import Console
from caneflow.runtime.hosts.launcher.replay_progress import ReplayProgress
from caneflow.runtime.outcome import Outcome, troubles
from caneflow.runtime.replayed import Replay
from caneflow.runtime.wording import listed

if TYPE_CHECKING:
    from caneflow.runtime.hosts.as_processes import AsProcesses

SLOWEST, FASTEST = 1e-3, 1e6  # times real time: 17 min for a second; a year in half a minute, faster than any computer
RECORDING = ".mcap"
LONGEST = 1e9  # s: 32 years


def command(
    file: Annotated[Path, typer.Argument(help="the dataflow, e.g. dataflow.yaml")],
    replay: Annotated[
        Path | None, typer.Option(metavar="REC", help="play this recording in the place of every driver")
    ] = None,
    speed: Annotated[
        str | None,
        typer.Option(metavar="X|max", help="of the replay, in times real time [default: 1; in-process: max]"),
    ] = None,
    start: Annotated[
        float, typer.Option(metavar="S", min=0, max=LONGEST, help="s into the recording at which the replay begins")
    ] = 0.0,
    duration: Annotated[
        float | None, typer.Option(metavar="S", min=0, max=LONGEST, help="s of the recording to play")
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="begin again at the end, with stamps that go on")] = False,
    without: Annotated[
        list[str] | None, typer.Option(metavar="NODE", help="leave this node out (may be given again)")
    ] = None,
    in_process: Annotated[
        bool, typer.Option("--in-process", help="all nodes in this process, as fast as the processor allows")
    ] = False,
    machine: Annotated[
        str | None, typer.Option(metavar="NAME", help="start what runs on this machine of the flow, with the others")
    ] = None,
    keys: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="with --machine: this machine's certificate [default: keys, beside the file]"),
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(metavar="tcp/HOST:PORT", help="let other programs attach here, beside where the file says"),
    ] = None,
    view: Annotated[bool, typer.Option("--view", help="open the flow's page in the browser; it ends with it")] = False,
    detach: Annotated[
        bool, typer.Option("--detach", help="go on in the background when every node is ready; `caneflow stop` ends it")
    ] = False,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT",
            help="write every stream to this recording; {time} in its name is the time in UTC, 20261130T140501Z",
        ),
    ] = None,
    overwrite: Overwrite = False,
    rotate: Annotated[
        str | None,
        typer.Option(metavar="100MB|10min", help="of --record: begin OUT_000, OUT_001 ... by size, time or both"),
    ] = None,
    keep: Annotated[int | None, typer.Option(metavar="N", min=1, help="of --rotate: keep only the newest N")] = None,
    record_last: Annotated[
        str | None,
        typer.Option(
            metavar="30s", help="of --record: keep the last 30 s in memory; `caneflow record --now` writes them"
        ),
    ] = None,
    rig: Annotated[
        Path | None, typer.Option(metavar="YAML", help="a rig to lay over the recording's and the file's")
    ] = None,
    one_process: Annotated[
        bool,
        typer.Option("--one-process", help="all nodes of a machine in one process, but the recorder and a view"),
    ] = False,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NODE.KEY=VALUE", help="override a setting (may be given again)"),
    ] = None,
) -> None:
    """Start every node of a dataflow as a process and follow it to its end; Ctrl-C ends everything.

    Exit status 0: a replay ran to its end and lost nothing. 1: a node failed for good, or samples were lost.
    2: the file, the recording or an option cannot be used. 130: Ctrl-C.

    Example: caneflow run dataflow.yaml --replay walk.mcap --speed max --record out.mcap --set fusion.method=kalman
    """
    _require_processes(in_process=in_process, view=view, detach=detach)
    processes = None if in_process else _processes(detach=detach)
    recorder = _recorder(record, rotate, keep, record_last, in_process=in_process)
    if record is not None:
        record = named_at(record, datetime.now(UTC))
    # The recording's name first, before any process; then the fork server: what is there now is there in every node.
    with (
        _kept(record, [file, replay, rig], overwrite=overwrite, parts=bool(recorder)),
        processes or nullcontext(),
    ):
        graph = load(file, settings or ())
        for warning in graph.warnings:
            if NOBODY_LISTENS not in warning or not (listen or replay):  # --listen does, a recording stands in for it
                print(warning, file=sys.stderr)
        if record is not None:
            require_no_input(record, [node.file for node in graph.nodes.values()])
            _require_name_of_recording(record)
        speed = speed or ("max" if in_process else "1")
        played = _replay(replay, speed, start, duration, loop=loop, without=without or [])
        _check_machine(graph, machine, everything_here=in_process or played is not None)
        deployment = deploy(
            graph,
            replay=played,
            record=record,
            recorder=recorder,
            rig=_rig(rig),
            machine=None if in_process else machine,
            one_process=one_process and not in_process,
            listen=_listen(listen, in_process=in_process),
        )
        started = time.monotonic()
        if processes is None:
            outcome = _run_here(graph, deployment)
        else:
            restarts = {name: node.restart for name, node in graph.nodes.items()}
            outcome = processes.run(deployment, restarts, keys or file.parent / "keys", view=view)
        summary(deployment, outcome, time.monotonic() - started)
        raise typer.Exit(outcome.status)


def _require_name_of_recording(record: Path) -> None:
    if record.suffix not in ("", RECORDING):  # a device has none
        raise DataflowError(f"--record: {record}: a recording's name ends with {RECORDING}")


def _processes(*, detach: bool) -> "AsProcesses":
    # Imported here, as it takes Linux and Zenoh; --in-process takes neither.
    from caneflow.runtime.hosts.as_processes import AsProcesses

    return AsProcesses(detach=detach)


def _run_here(graph: Graph, deployment: Deployment) -> Outcome:
    programs = {name: node.program for name, node in graph.nodes.items() if node.program is not None}
    host = InProcess(deployment, programs)
    gc.freeze()  # the operators and the graph stay until the end: not to be looked through again and again
    try:
        with Console(deployment.flow) as console:
            progress = ReplayProgress(deployment.origin, deployment.last, console.played)
            return host.run_until_interrupted(lambda stamp: progress.look((stamp,)))
    except Exception as error:
        failure = failure_of(error)
        if failure is None:
            raise
        for line in failure.lines:
            print(line, file=sys.stderr)
        print(f"caneflow run: {failure.node} failed at {failure.at}: {failure.error}", file=sys.stderr)
        raise typer.Exit(1) from error
    finally:
        gc.unfreeze()


def _kept(
    record: Path | None, inputs: Sequence[Path | None], *, overwrite: bool, parts: bool
) -> AbstractContextManager[None]:
    """The recording's name is free, and this run's alone until its end; parts number themselves after what exists."""
    if record is None:
        return nullcontext()
    if parts:
        require_folder(record)
        return nullcontext()
    return reserved(record, inputs=inputs, overwrite=overwrite)


def summary(deployment: Deployment, outcome: Outcome, took_s: float) -> None:
    """Print how the run ended: what each node gave, what was refused or lost, what failed."""
    for node, counters in outcome.counters.items():
        if text := _counted(counters):
            print(f"{node}: {text}", flush=True)  # before the failures, wherever both go
    for failure in (*outcome.unrecorded, *outcome.failures):
        print(f"caneflow run: {printable(failure)}", file=sys.stderr)
    if not outcome.failures and not outcome.interrupted:
        print(f"{deployment.flow}: ran to its end in {took_s:.1f} s")


def _counted(counters: Counters) -> str:
    given = [f"{sent} x {port}" for port, sent in counters.outputs.items()]
    return "; ".join(filter(None, [", ".join(given), *troubles(counters)]))


def _recorder(
    record: Path | None, rotate: str | None, keep: int | None, last: str | None, *, in_process: bool
) -> dict[str, Any]:
    """The recorder's settings that the options ask for."""
    if record is None and (rotate or keep or last):
        raise DataflowError("--rotate, --keep and --record-last say how to record; add --record OUT")
    if last is not None and (rotate or keep):
        raise DataflowError(
            "--record-last writes a file whenever it is asked to; --rotate and --keep do not go with it"
        )
    if last is not None and in_process:
        raise DataflowError("--record-last needs a flow that can be asked: leave --in-process out")
    if keep is not None and rotate is None:
        raise DataflowError(f"--keep {keep}: says how many files of --rotate are kept; add e.g. --rotate 100MB")
    if last is not None:
        return {"last_s": read_span(last)}
    if rotate is None:
        return {}
    rotation = Rotation.read(rotate, keep)
    return {"rotate_bytes": rotation.size, "rotate_s": rotation.span_s, "keep": rotation.keep}


def _require_processes(*, in_process: bool, view: bool, detach: bool) -> None:
    """Raise an error for what a run in this process does not have, and for a page that cannot be had."""
    if in_process and (view or detach):
        option = "--view" if view else "--detach"
        raise DataflowError(f"{option}: nobody can attach to a flow in one process; leave --in-process out")
    if view and find_spec("uvicorn") is None:
        raise DataflowError(f"--view: {not_installed('uvicorn', 'view')}")


def _listen(endpoint: str | None, *, in_process: bool) -> str | None:
    if endpoint is not None and in_process:
        raise DataflowError("--listen: nobody can attach to a flow in one process; leave --in-process out")
    return endpoint


def _check_machine(graph: Graph, machine: str | None, *, everything_here: bool) -> None:
    """A live flow of several machines needs to know which one this is; a replay may run as a whole anywhere."""
    used = {node.machine for node in graph.nodes.values()}
    if machine is None and len(used) > 1 and not everything_here:
        raise DataflowError(f"{graph.path}: runs on several machines; give --machine, one of {listed(graph.machines)}")


def _replay(
    recording: Path | None, speed: str, start: float, duration: float | None, *, loop: bool, without: list[str]
) -> Replay | None:
    if recording is None:
        return None
    return Replay(
        recording=recording,
        speed=_speed(speed),
        start_s=start,
        duration_s=duration,
        loop=loop,
        without=frozenset(without),
    )


def _speed(text: str) -> float:
    if text == "max":
        return math.inf
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not SLOWEST <= value <= FASTEST:
        raise DataflowError(
            f"--speed {text}: not a speed; expected times real time, {SLOWEST:g} to {FASTEST:g} (1, 2.5), or max"
        )
    return value


def _rig(path: Path | None) -> dict[str, Any] | None:
    return None if path is None else read_rig(path)
