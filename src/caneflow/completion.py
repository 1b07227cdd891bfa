"""What a shell completes after a word of the command: names of flows, nodes, streams, machines, settings, methods.

Quick, as someone waits: names are read from the folders of runs, from dataflow files and from the sources of programs,
of which none is imported. Paths the shell completes itself.
"""

import ast
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeAlias

from caneflow.errors import CaneflowError

Names: TypeAlias = Callable[[Sequence[str]], Iterable[str]]  # from what stands between the word and the cursor

LONGEST_NAMES = 1_000_000  # bytes of a file with names
USUAL_FLOW = "dataflow.yaml"  # the usual file
# Options without a value: what follows is not a value of theirs.
FLAGS = frozenset(
    (
        *("--json", "--follow", "-f", "--open", "--ended", "--devices", "--endpoint", "--in-process", "--loop"),
        *("--overwrite", "--view", "--detach", "--now", "--full", "--one-process"),
    )
)


def candidates(words: Sequence[str], incomplete: str) -> list[str] | None:
    """What may stand at the cursor, behind `words` (the command's first word in front) and with `incomplete` begun.

    None: it is not known here, e.g. for an option's own name.
    """
    word, before = words[0], words[1:]
    begun, option, value_of = _setting(before, incomplete)
    if option == "--set":
        return _fitting(settings(before) if value_of is None else values(before, value_of), begun)
    if incomplete.startswith("-"):
        return None
    if before and before[-1].startswith("-") and before[-1] not in FLAGS:
        source = VALUES.get((word, before[-1])) or VALUES.get(("", before[-1]))
        if source is None:
            return None
    else:
        source = POSITIONALS.get(word, paths)
    listed, _, last = incomplete.rpartition(",")
    if before[-1:] == ["--methods"] and listed:
        return [f"{listed},{name}" for name in _fitting(source(before), last)]
    return _fitting(source(before), incomplete)


def _fitting(names: Iterable[str], begun: str) -> list[str]:
    return [name for name in dict.fromkeys(names) if name.startswith(begun)]


def _setting(before: Sequence[str], incomplete: str) -> tuple[str, str, str | None]:
    """What of a setting is begun, the option it belongs to, and of which key it is the value; None: it has its key too.

    A bash hands over `fusion.method=b` as three words and has the third completed; without the `b` as two, or three.
    """
    words = list(before)
    if words[-1:] == ["="]:
        words.pop()
    if len(words) > 1 and words[-2].startswith("-") and "." in words[-1] and "=" not in words[-1]:
        return incomplete.removeprefix("="), words[-2], words[-1]
    return incomplete, words[-1] if words else "", None


def positionals(before: Sequence[str]) -> list[str]:
    """What of `before` is neither an option nor an option's value."""
    found, skip = [], False
    for each in before:
        if skip:
            skip = False
        elif each.startswith("-"):
            skip = each not in FLAGS
        else:
            found.append(each)
    return found


def paths(_: Sequence[str]) -> list[str]:
    """None: those the shell knows."""
    return []


# --- of flows that run -------------------------------------------------------------------------------------------


def flows(before: Sequence[str]) -> list[str]:
    """The flows that run here, while none is named yet."""
    from caneflow.runtime.hosts.launcher.run_directory import running_flows  # here: few words need it

    return [] if positionals(before) else [flow.flow for flow in running_flows()]


def logged_flows(before: Sequence[str]) -> list[str]:
    """Those whose log is kept."""
    from caneflow.runtime.hosts.attached.run_logs import kept_logs

    return [] if positionals(before) else [log.run.flow for log in kept_logs()]


def nodes(before: Sequence[str]) -> list[str]:
    """The nodes of the flow that is named, or of the only one."""
    return list(_names(before))


def logged_nodes(before: Sequence[str]) -> list[str]:
    """The same, with the launcher."""
    return ["caneflow", *nodes(before)]


def flow_or_node(before: Sequence[str]) -> list[str]:
    """Of a word that takes both: a flow, then a node of it."""
    return [*flows(before), *(nodes(before) if len(positionals(before)) < 2 else [])]


def flow_or_streams(before: Sequence[str]) -> list[str]:
    """Of a word that takes both: a flow, and streams of it."""
    return [*flows(before), *(f"{node}/{port}" for node, ports in _names(before).items() for port in ports)]


def _names(before: Sequence[str]) -> dict[str, list[str]]:
    """By node of the flow the ports that it writes."""
    from caneflow.runtime.hosts.launcher.run_directory import NAMES, running_flows

    named = positionals(before)[:1]
    running = [flow for flow in running_flows() if not named or flow.flow == named[0]]
    if len(running) != 1:
        return {}
    with suppress(OSError, ValueError), (Path(running[0].folder) / NAMES).open("rb") as file:
        found = json.loads(file.read(LONGEST_NAMES))
        return {str(node): [str(port) for port in ports] for node, ports in found.items()}
    return {}


# --- of a file ---------------------------------------------------------------------------------------------------


def _file(before: Sequence[str]) -> Path:
    given = [each for each in positionals(before) if each.endswith((".yaml", ".yml"))]
    return Path(given[0] if given else USUAL_FLOW)


def _graph(before: Sequence[str]) -> dict[str, Any]:
    from caneflow.runtime.dataflow.yaml_file import read_yaml

    with suppress(CaneflowError):
        graph = read_yaml(_file(before)).value
        return graph if isinstance(graph, dict) else {}
    return {}


def _mapping(before: Sequence[str], key: str) -> dict[str, Any]:
    found = _graph(before).get(key)
    return {str(name): value for name, value in found.items()} if isinstance(found, dict) else {}


def written_nodes(before: Sequence[str]) -> list[str]:
    """The nodes of the dataflow file."""
    return list(_mapping(before, "nodes"))


def machines(before: Sequence[str]) -> list[str]:
    """The machines of the dataflow file."""
    return list(_mapping(before, "machines"))


def settings(before: Sequence[str]) -> Iterator[str]:
    """What `--set` takes: `node.key=`, with each value where there are few."""
    for node, about in _mapping(before, "nodes").items():
        for key, chosen in _settings_of(_source(before, about)).items():
            yield from (f"{node}.{key}={value}" for value in chosen or [""])


def values(before: Sequence[str], setting: str) -> list[str]:
    """The values that `node.key` may have, where there are few."""
    node, _, key = setting.partition(".")
    return _settings_of(_source(before, _mapping(before, "nodes").get(node))).get(key, [])


def methods(before: Sequence[str]) -> list[str]:
    """The methods that `eval` compares."""
    return [*_settings_of(_module("operators.fusion")).get("method", []), "smoothed"]


def _source(before: Sequence[str], about: Any) -> Path | None:
    """The file of a node's program."""
    run = str(about.get("run", "")) if isinstance(about, dict) else ""
    return _file(before).parent / run if run.endswith(".py") else _module(run)


def _module(name: str) -> Path | None:
    """The source of a program that is installed."""
    with suppress(ImportError, ValueError):
        spec = find_spec(f"caneflow.{name}")
        if spec is not None and spec.origin is not None:
            return Path(spec.origin)
    return None


# --- of a source, which is read and not run ----------------------------------------------------------------------


def _settings_of(file: Path | None) -> dict[str, list[str]]:
    """By setting of the program in `file` the values that it may have; none: any."""
    body = _parsed(file)
    aliases = {}
    for each in body:
        if isinstance(each, ast.AnnAssign | ast.Assign) and each.value is not None:
            target = each.target if isinstance(each, ast.AnnAssign) else each.targets[0]
            aliases[ast.unparse(target)] = each.value
    found: dict[str, list[str]] = {}
    for each in body:
        if isinstance(each, ast.ClassDef) and each.name.endswith("Settings"):
            fields = [field for field in each.body if isinstance(field, ast.AnnAssign)]
            found.update({ast.unparse(field.target): _choices(field.annotation, aliases) for field in fields})
    return found


def _choices(kind: ast.expr, aliases: dict[str, ast.expr]) -> list[str]:
    """The values of a type, if they are written down: of a Literal or a bool."""
    kind = aliases.get(ast.unparse(kind), kind)
    if ast.unparse(kind) == "bool":
        return ["true", "false"]
    if isinstance(kind, ast.Subscript) and ast.unparse(kind.value) == "Literal":
        return [str(each.value) for each in ast.walk(kind.slice) if isinstance(each, ast.Constant)]
    return []


def keys_of(file: Path | None, name: str) -> list[str]:
    """The keys of the mapping that `file` calls `name`."""
    for each in _parsed(file):
        if isinstance(each, ast.AnnAssign | ast.Assign) and each.value is not None:
            target = each.target if isinstance(each, ast.AnnAssign) else each.targets[0]
            tables = [part for part in ast.walk(each.value) if isinstance(part, ast.Dict)]
            if ast.unparse(target) == name and tables:
                return [str(key.value) for key in tables[0].keys if isinstance(key, ast.Constant)]
    return []


def _parsed(file: Path | None) -> list[ast.stmt]:
    if file is not None:
        with suppress(OSError, ValueError, SyntaxError):
            return ast.parse(file.read_text(encoding="utf-8")).body
    return []


def within(tool: str) -> Names:
    """The second words that a tool of several takes."""

    def second_words(before: Sequence[str]) -> list[str]:
        return [] if positionals(before) else keys_of(_module(f"tools.{tool}"), "commands")

    return second_words


def scenarios(_: Sequence[str]) -> list[str]:
    """The walks that `simulate walk` knows."""
    return keys_of(_module("simulation.scenario"), "SCENARIOS")


# --- of a recording ----------------------------------------------------------------------------------------------


def streams(before: Sequence[str]) -> list[str]:
    """The streams of the recording that is named."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    for name in positionals(before):
        with suppress(OSError, McapError, ValueError), Path(name).open("rb") as file:
            summary = make_reader(file).get_summary()
            topics = [channel.topic for channel in summary.channels.values()] if summary else []
            return sorted("/".join(topic.split("/")[1:]) for topic in topics if "/@/" not in topic)
    return []


POSITIONALS: dict[str, Names] = {
    **dict.fromkeys(("status", "top", "doctor", "view", "stop", "record"), flows),
    **dict.fromkeys(("echo", "hz"), flow_or_streams),
    "logs": logged_flows,
    "restart": flow_or_node,
    **{word: within(word) for word in ("simulate", "emulate", "keys", "mcu", "new", "calibrate")},
    "import": within("import_recording"),
}
VALUES: dict[tuple[str, str], Names] = {  # by word ("": any) and option
    ("logs", "--node"): logged_nodes,
    ("", "--without"): written_nodes,
    ("", "--machine"): machines,
    ("eval", "--methods"): methods,
    ("simulate", "--scenario"): scenarios,
    ("export", "--stream"): streams,
    ("run", "--speed"): lambda _: ["1", "max"],
}
