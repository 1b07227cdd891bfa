"""From what `run:` says to the class that runs: modules of caneflow, and users' own files."""

import importlib
import importlib.util
import inspect
import pkgutil
import re
import sys
import traceback
from collections.abc import Hashable, Mapping
from contextlib import redirect_stdout, suppress
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from caneflow import messages
from caneflow.messages import NAME, NAME_RULE, MessageError, Sample
from caneflow.messages.codec import require_sound
from caneflow.runtime.dataflow.validation import Checked, Mistake
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.program import ANY_PORT, Operator, Program, Sink, Source
from caneflow.runtime.user_files import OURS, kind_at, module_of, place_of
from caneflow.runtime.wording import did_you_mean, dotted, listed, one_line, shown

ROOMS = ("drivers", "operators")
TOOLS = ("tools.view", "tools.ros2", "tools.foxglove", "tools.phone")  # that are programs of a graph as well
IN_A_ROOM = re.compile(rf"({'|'.join(ROOMS)})\.[A-Za-z_][A-Za-z0-9_]*")
NOT_THEIRS = ("<frozen", str(Path(messages.__file__).parent))  # in what users' code calls
FILES_NAMED = 8  # of a folder without the file that was asked for


class Located(NamedTuple):
    """Where a program is: a module for `python -m`, or a file."""

    module: str | None = None
    file: Path | None = None


def locate(run: str, base: Path) -> Located:
    """Where the program `run` is, a path being taken from the folder `base`; raises DataflowError if nowhere."""
    if "/" in run or run.endswith(".py"):
        return Located(file=_file(run, base))
    if (IN_A_ROOM.fullmatch(run) or run in TOOLS) and importlib.util.find_spec(f"caneflow.{run}") is not None:
        return Located(module=f"caneflow.{run}")
    there = available()
    hint = did_you_mean(run, there, likeness=0.75)  # all of them begin alike
    raise DataflowError(
        f"no program {shown(run)} in {_looked_in()};{hint} there are {listed(there)}; "
        "a program of your own is named by the path to its .py file"
    )


def available() -> list[str]:
    """What `run` may name without a path."""
    of_rooms = [f"{room}.{module.name}" for room in ROOMS for module in pkgutil.iter_modules(_room(room).__path__)]
    return [*of_rooms, *TOOLS]


def load_program(run: str, base: Path) -> Program:
    """The one program class in what `run` names; raises DataflowError when it cannot be had."""
    return program_at(locate(run, base), run)


def program_at(where: Located, run: str) -> Program:
    """The one program class there; `run`: what a person calls it. Raises DataflowError when it cannot be had."""
    module = _imported(where)
    programs = [
        value
        for value in vars(module).values()
        if inspect.isclass(value)
        and issubclass(value, (Operator, Source, Sink))
        and value.__module__ == module.__name__
    ]
    complete = [program for program in dict.fromkeys(programs) if not inspect.isabstract(program)]
    if len(complete) > 1:
        names = listed(program.__name__ for program in complete)
        raise DataflowError(f"{shown(run)} holds several programs: {names}; one file holds one")
    if not complete:
        raise DataflowError(_none_in(run, programs))
    _check_tables(run, complete[0])
    return complete[0]


def inputs_of(program: Program) -> Mapping[str, type[Sample]]:
    """The input ports of a program and their types; `*` stands for every port that is not named."""
    if issubclass(program, Operator):
        return program.inputs
    return {ANY_PORT: Sample} if issubclass(program, Sink) else {}


def outputs_of(program: Program) -> Mapping[str, type[Sample]]:
    """The output ports of a program and their types."""
    return {} if issubclass(program, Sink) else program.outputs


def require_message(kind: type[Sample]) -> None:
    """Raise MessageError or DataflowError unless messages of `kind` can travel between processes.

    Sample itself stands for any message.
    """
    if kind is not Sample and not kind.__module__.startswith(OURS):
        require_sound(kind)
        if kind_at(place_of(kind)) is not kind:
            raise DataflowError(f"{kind.__qualname__} is not what its file has under that name")


def validated_settings(program: Program, settings: Mapping[str, Any]) -> Any:
    """`settings` as the program's Settings; raises DataflowError, one line for each mistake."""
    made, mistakes = check_settings(program, settings)
    if mistakes:
        lines = (": ".join(filter(None, (dotted(("settings", *m.path)), m.text))) for m in mistakes)
        raise DataflowError("\n".join(lines))
    return made


def check_settings(program: Program, settings: Mapping[str, Any]) -> tuple[Any, list[Mistake]]:
    """`settings` as the program's Settings, or None and what is wrong with them."""
    if not settings:  # as most nodes have it: nothing to be checked, which takes pydantic longer than most starts
        with suppress(Exception):  # then the check says what is missing
            return program.Settings(), []
    try:
        return _checked(program)(settings)
    except Exception as error:  # a check of its own that breaks: users' code may raise anything
        return None, [Mistake((), f"{program.Settings.__qualname__} breaks on these: {_cause(error)}")]


def _checked(program: Program) -> Checked[Any]:
    kind: Any = program.Settings
    return _checked_kind(kind)


@lru_cache(maxsize=64)  # preparing a check costs as much as the rest of a load
def _checked_kind(kind: Hashable) -> Checked[Any]:
    return Checked(kind)


def _file(run: str, base: Path) -> Path:
    file = base / Path(run)
    try:
        if file.is_file() and file.suffix == ".py":
            return file.resolve()
        folder = file.parent
        there = sorted(f"{Path(run).parent / found.name}" for found in folder.glob("*.py"))[:FILES_NAMED]
    except (OSError, ValueError) as error:  # a name that no file can have
        raise DataflowError(f"no Python file {shown(run)}: {one_line(error)}") from error
    raise DataflowError(f"no Python file {str(file)!r};{did_you_mean(run, there)} there are {listed(there)}")


def _room(room: str) -> ModuleType:
    return importlib.import_module(f"caneflow.{room}")


def _looked_in() -> str:
    return listed(str(Path(path)) for room in ROOMS for path in _room(room).__path__)


def _imported(where: Located) -> ModuleType:
    try:
        with redirect_stdout(sys.stderr):  # what a program prints is not an answer of ours
            return importlib.import_module(str(where.module)) if where.file is None else module_of(where.file)
    except (Exception, SystemExit) as error:  # a program may do anything while it is imported
        raise DataflowError(f"{where.file or where.module} cannot be imported: {_cause(error)}") from error


def _cause(error: BaseException) -> str:
    """The error and the line of users' code that raised it."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith(NOT_THEIRS)]
    where = f" (line {frames[-1].lineno} of {frames[-1].filename})" if frames else ""
    if isinstance(error, SyntaxError):
        where = f" (line {error.lineno} of {error.filename})"
        error_text = error.msg
    else:
        error_text = one_line(error)
    return f"{type(error).__name__}: {error_text}{where}"


def _none_in(run: str, unfinished: list[Program]) -> str:
    if not unfinished:
        return f"{shown(run)} holds no program; that is a class derived from Operator, Source or Sink"
    program = unfinished[0]
    missing = listed(sorted(program.__abstractmethods__))
    return f"{shown(run)}: {program.__name__} does not define {missing}"


def _check_tables(run: str, program: Program) -> None:
    """Raise DataflowError unless ports and Settings of the class are what the runtime works with."""
    tables: dict[str, Any] = {"inputs": inputs_of(program), "outputs": outputs_of(program)}
    for table, ports in tables.items():
        where = f"{shown(run)}: {program.__name__}.{table}"
        if not isinstance(ports, Mapping):
            raise DataflowError(f"{where} not a table of ports; expected e.g. {{'imu': Imu}}")
        for port, kind in ports.items():
            if not (isinstance(port, str) and (NAME.fullmatch(port) or port == ANY_PORT)):
                raise DataflowError(f"{where}: {shown(port)}: not a valid port name; expected {NAME_RULE}")
            if not (inspect.isclass(kind) and issubclass(kind, Sample)):
                raise DataflowError(f"{where}[{shown(port)}] is {shown(kind)}; it takes a class of messages")
            try:
                require_message(kind)
            except (MessageError, DataflowError) as error:
                raise DataflowError(f"{where}[{shown(port)}]: {error}") from error
    try:
        _checked(program)
    except Exception as error:  # pydantic has a dozen ways to say that it cannot check a type
        raise DataflowError(
            f"{shown(run)}: {program.__name__}.Settings cannot be checked: {one_line(error)}"
        ) from error
