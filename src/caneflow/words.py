"""The words of the `caneflow` command: finds the tool for one, and turns an expected error into one line."""

import gc
import sys
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from inspect import cleandoc
from typing import Annotated, Any, NoReturn, cast

import typer
from typer.core import TyperCommand, TyperGroup

import caneflow
from caneflow import completion, interrupts
from caneflow.errors import CaneflowError
from caneflow.printable import printable

TOOLS = "caneflow.tools"
# What running flows take, and where one of it is missing, what works all the same.
OF_LINUX = frozenset({"zenoh", "fcntl", "resource", "pwd", "termios", "setproctitle"})
ANYWHERE = "recordings work anywhere: `caneflow run FILE --replay REC --in-process`, eval, plot, view REC"
USAGE_STATUS = 2  # exit status of an expected error, as of a misspelt option
# UsageError, which typer does not name: of click, or of its own copy of click.
MISUSE = cast(type[Exception], typer.BadParameter.__mro__[1])

# Word -> module in tools, one line of help. A tool has `command`, a function whose annotations are its options, or
# `commands`, such functions by word. It is imported when its word is used: `caneflow check` needs no matplotlib.
# Docstrings are the help, in rich's markup: [this] would vanish from it.
WORDS: dict[str, tuple[str, str]] = {
    "run": ("run", "Run a flow: live, or from a recording."),
    "check": ("check", "Find every mistake in a dataflow file; start nothing."),
    "graph": ("graph", "Draw a flow."),
    "verify": ("verify", "Run a recording again and compare with the outputs that it holds."),
    "status": ("status", "Show the nodes and edges of a running flow."),
    "hz": ("hz", "Show how often the samples of a running flow come."),
    "echo": ("echo", "Print the samples of a running flow."),
    "top": ("top", "Show what each node of a running flow costs."),
    "record": ("record_now", "Write the last seconds of a running flow to a file."),
    "doctor": ("doctor", "Say what is wrong with a running flow."),
    "list": ("list_flows", "Show the flows that run on this machine, or did."),
    "logs": ("logs", "Print what the nodes of a flow have said."),
    "restart": ("restart", "End a node of a running flow and start it again."),
    "stop": ("stop", "End a running flow in order."),
    "simulate": ("simulate", "Simulate a walk and write it as a recording."),
    "info": ("info", "Say what is in a recording."),
    "recover": ("recover", "Make a sound recording of one that was cut short or damaged."),
    "import": ("import_recording", "Make a recording of a device's own log."),
    "export": ("export", "Write a stream of a recording for other programs."),
    "emulate": ("emulate", "Play a device from a recording, for a driver to talk to."),
    "eval": ("evaluate", "Compare methods over recordings with ground truth."),
    "experiments": ("experiments", "Make the paper's experiments on simulated walks."),
    "ablation": ("ablation", "Find what each measurement of the room tracker is worth."),
    "bench": ("bench", "Measure how fast a recording runs, and where the time goes."),
    "calibrate": ("calibrate", "Fit the rig to recordings."),
    "plot": ("plot", "Draw a recording's track and speed."),
    "view": ("view", "Show a running flow, or a recording, in the browser."),
    "ros2": ("ros2", "Show a running flow to ROS 2, without ROS."),
    "foxglove": ("foxglove", "Show a running flow, or a recording, to Foxglove."),
    "schema": ("schema", "Print the JSON Schema of a message or of a dataflow file."),
    "new": ("new", "Start a program of your own."),
    "keys": ("keys", "Make the keys of a secured flow."),
    "mcu": ("mcu", "Prepare a microcontroller's program."),
}


class Word(TyperCommand):
    """A word of the command in the place of its tool, which is imported when the word is used."""

    def __init__(self, word: str, module: str, summary: str) -> None:
        super().__init__(word, help=summary)
        self._module = module
        self._before: list[str] = []  # what stands between the word and the cursor

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """The context of the tool itself, to which typer hands over; for a shell that completes its own."""
        if extra.get("resilient_parsing"):
            self._before = list(args)
            return super().make_context(info_name, [], parent, **extra)
        tool = _tool(self._module)
        if not gc.isenabled():
            gc.freeze()  # what is imported stays, and need not be looked through again
            gc.enable()
        context = tool.make_context(info_name, args, parent, **extra)
        interrupts.begin_work()
        return context

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """What a shell may complete: names, without the tool; else what the tool itself says, its options."""
        # Not by name, as MISUSE: the part of click, or of typer's copy of it, that completes.
        completing = import_module(type(ctx).__module__.rpartition(".")[0] + ".shell_completion")
        found = completion.candidates([str(self.name), *self._before], incomplete)
        if found is not None:
            return [completing.CompletionItem(each) for each in found]
        context = completing._resolve_context(_tool(self._module), {}, str(self.name), [*self._before])
        part, incomplete = completing._resolve_incomplete(context, [*self._before], incomplete)
        return list(part.shell_complete(context, incomplete))


class Door(TyperGroup):
    """The command itself."""

    def invoke(self, ctx: Any) -> None:
        """Run the word's tool; what a tool returns is not for the shell."""
        super().invoke(ctx)


def run() -> NoReturn:
    """Run the command line's word; exit status 2 and one line for an expected error, a traceback for a bug."""
    try:
        status = _command().main(prog_name="caneflow", standalone_mode=False)
    except MISUSE as error:
        _explain(error)
    except CaneflowError as error:
        if getattr(error, "problems", ()):  # each line begins with its own file:line:column
            print("\n".join(map(printable, str(error).split("\n"))), file=sys.stderr)
            sys.exit(USAGE_STATUS)
        _fail(str(error))
    except OSError as error:
        if error.filename is None:
            raise
        _fail(f"{error.filename}: {error.strerror}")
    except ModuleNotFoundError as error:
        if error.name not in OF_LINUX:
            raise
        _fail(f"needs Linux and Zenoh (there is no {error.name} here); {ANYWHERE}")
    except KeyboardInterrupt:
        sys.exit(interrupts.INTERRUPTED_STATUS)
    sys.exit(status)  # of a typer.Exit, or None


def _explain(error: Any) -> NoReturn:
    """What is wrong with the command line, in one line; or the help, when nothing was said at all."""
    context = error.ctx
    if len(sys.argv) == 1 or context is None:
        error.show()
    else:
        words = " ".join(error.format_message().split()).removesuffix(".")
        joint = " See" if words.endswith("?") else "; see"
        print(f"{context.command_path}: {printable(words)}{joint} `{context.command_path} --help`", file=sys.stderr)
    sys.exit(USAGE_STATUS)


def _fail(message: str) -> NoReturn:
    word = next((argument for argument in sys.argv[1:] if argument in WORDS), None)
    said = printable(message)
    print(f"caneflow {word}: {said}" if word else f"caneflow: {said}", file=sys.stderr)
    sys.exit(USAGE_STATUS)


def _command() -> TyperGroup:
    app = _typer(no_args_is_help=True, cls=Door)
    app.callback()(_caneflow)
    group = typer.main.get_command(app)
    assert isinstance(group, TyperGroup)
    for word, (module, summary) in WORDS.items():
        if find_spec(f"{TOOLS}.{module}"):
            group.add_command(Word(word, module, summary))
    _without_types_of_flags(group)
    return group


def commands() -> Iterator[tuple[str, Any]]:
    """Every command that there is, by its words, with its tool imported: for pages that are written from it."""
    for word, (module, _) in WORDS.items():
        if find_spec(f"{TOOLS}.{module}"):
            tool = _tool(module)
            within = getattr(tool, "commands", None)
            yield from ((f"{word} {name}", each) for name, each in within.items()) if within else [(word, tool)]


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"caneflow {caneflow.__version__}")
        raise typer.Exit


def _caneflow(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Where a smart white cane is: radar and IMU as a distributed dataflow over Zenoh."""


def _tool(module: str) -> Any:
    """The command that the tool's functions make."""
    tool = import_module(f"{TOOLS}.{module}")
    app = _typer(add_completion=False)
    if hasattr(tool, "commands"):
        app.callback(help=tool.__doc__)(_no_options)
        for word, function in tool.commands.items():
            # A second word may have a module of its own: programs do not import each other.
            chosen = import_module(f"{TOOLS}.{function}").command if isinstance(function, str) else function
            app.command(word, help=_flowing(chosen.__doc__))(chosen)
    else:
        app.command(help=_flowing(tool.command.__doc__))(tool.command)
    return _without_types_of_flags(typer.main.get_command(app))


def _without_types_of_flags(command: Any) -> Any:
    """The command; its help says no type of what takes no value."""
    for each in getattr(command, "commands", {}).values():
        _without_types_of_flags(each)
    for parameter in (*command.params, command.get_help_option(typer.Context(command))):
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""
    return command


def _flowing(text: str | None) -> str | None:
    """A docstring for any width of the terminal: its lines end where the source's did, paragraph by paragraph."""
    if text is None:
        return None
    paragraphs = cleandoc(text).split("\n\n")
    kept = ("\n ", "\\\n", "\b")  # lines that are indented, or go on on the next: laid out by hand
    return "\n\n".join(each if any(mark in each for mark in kept) else " ".join(each.split()) for each in paragraphs)


def _no_options() -> None:
    """With a callback, typer asks for the second word even where there is only one."""


def _typer(**settings: Any) -> typer.Typer:
    return typer.Typer(pretty_exceptions_enable=False, rich_markup_mode="rich", **settings)


if __name__ == "__main__":
    run()
