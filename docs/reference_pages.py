"""Pages written from the code as the site is built: commands with their options, programs with their settings."""

import ast
import dataclasses
import importlib
import inspect
import pkgutil
import re
import textwrap
import typing
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
from typer.core import TyperArgument, TyperOption

from caneflow.runtime import Operator, Sink, Source
from caneflow.words import commands

ROOMS = ("operators", "drivers")

# What is public, by its docstrings: these modules' `__all__`, and the families' modules. All else may change unsaid.
PUBLIC = ("messages", "runtime", "recording", "evaluation", "attach", "testing")
FAMILIES = ("algorithms", "simulation")


def write(folder: Path) -> None:
    """Write all pages of this kind into `folder`."""
    folder.mkdir(exist_ok=True)
    pages = {"commands": commands_page(), "programs": programs_page(), "api": api_page(), "library": library_page()}
    for name, lines in pages.items():
        text = "\n".join(lines) + "\n"
        page = folder / f"{name}.md"
        if not page.exists() or page.read_text(encoding="utf-8") != text:  # an untouched page is not built again
            page.write_text(text, encoding="utf-8")


def commands_page() -> Iterator[str]:
    """Every word of the command, with its arguments and options."""
    yield "# Commands\n"
    yield "`caneflow WORD --help` says the same in a terminal.\n"
    for words, command in sorted(commands()):
        yield f"## caneflow {words}\n"
        yield f"{_prose(command.help or '')}\n"
        parameters = [p for p in command.params if "--help" not in p.opts]
        if parameters:
            yield "| argument or option | default | meaning |\n|---|---|---|"
            yield from (f"| {_name(p)} | {_default(p)} | {_cell(getattr(p, 'help', '') or '')} |" for p in parameters)
            yield ""


def programs_page() -> Iterator[str]:
    """Every operator and driver, with its ports and settings."""
    yield "# Programs and their settings\n"
    yield "What `run:` may name. Settings stand under `settings:`; `--set NODE.KEY=VALUE` overrides.\n"
    for room in ROOMS:
        package = importlib.import_module(f"caneflow.{room}")
        for found in sorted(pkgutil.iter_modules(package.__path__), key=lambda each: each.name):
            module = importlib.import_module(f"caneflow.{room}.{found.name}")
            program = _program(module)
            yield f"## {room}.{found.name}\n"
            yield f"{_blocks(module.__doc__ or '')}\n"
            if dataclasses.fields(program.Settings):
                yield "| setting | takes | default | meaning |\n|---|---|---|---|"
                yield from _settings(program.Settings, "")
                yield ""


def api_page() -> Iterator[str]:
    """The public names of the library: what `__all__` of its modules lists, each with its signature and docstring."""
    yield "# Python\n"
    yield "Public names change only with a new version and a line in the changelog. What stands neither here nor on the"
    yield "[next page](library.md) is private, whatever its name. How to use them:"
    yield "[From Python](../how-to/python.md). Fields of messages: [messages](../messages.md).\n"
    for name in PUBLIC:
        module = importlib.import_module(f"caneflow.{name}")
        yield f"## caneflow.{name}\n\n{_blocks(module.__doc__ or '')}\n"
        for each in module.__all__:
            yield from _entry(each, getattr(module, each))


def library_page() -> Iterator[str]:
    """What the families of algorithms and the simulators offer, module by module."""
    yield "# Algorithms and simulators\n"
    yield "Arrays and tuples in, arrays and tuples out; no message, file or clock. SI units, radians.\n"
    for name in FAMILIES:
        package = importlib.import_module(f"caneflow.{name}")
        for found in pkgutil.walk_packages(package.__path__, f"caneflow.{name}."):
            module = importlib.import_module(found.name)
            title = "##" if found.ispkg or name == "simulation" else "###"
            yield f"{title} {found.name.removeprefix('caneflow.')}\n\n{_blocks(module.__doc__ or '')}\n"
            for each, value in vars(module).items():
                if not each.startswith("_") and getattr(value, "__module__", None) == module.__name__:
                    yield from _entry(each, value)


def _entry(name: str, value: object) -> Iterator[str]:
    """A class with its methods, a function, or what a plain value is."""
    if not (inspect.isclass(value) or inspect.isfunction(value)):
        yield f"**`{name}`**" + (f" = `{value!r}`\n" if isinstance(value, str | int | float) else "\n")
        return
    yield f"**`{name}{_signature(value)}`**\n\n{_blocks(_doc(value))}\n"
    if inspect.isclass(value):
        for method, function in vars(value).items():
            if inspect.isfunction(function) and not method.startswith("_") and function.__doc__:
                yield f"`{name}.{method}{_signature(function)}`\n\n{_blocks(_doc(function))}\n"


def _doc(value: Any) -> str:
    """A docstring; not the one that a dataclass or named tuple makes of its signature."""
    doc = value.__doc__ or ""
    return "" if doc.startswith(f"{value.__name__}(") else doc


def _signature(value: Any) -> str:
    """The parameters with their defaults: units and shapes are said in words; a message's fields have a page."""
    if inspect.isclass(value) and issubclass(value, msgspec.Struct | Exception):
        return ""
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):  # some classes made in C have none
        return ""
    plain = [each.replace(annotation=inspect.Parameter.empty) for each in signature.parameters.values()]
    return str(signature.replace(parameters=plain, return_annotation=inspect.Signature.empty)).replace("`", "'")


def _settings(kind: type[Any], prefix: str) -> Iterator[str]:
    """A line for each field of a settings class, those of nested classes by their path."""
    comments, hints = _comments(kind), typing.get_type_hints(kind)
    for each in dataclasses.fields(kind):
        hint, default = hints[each.name], each.default
        if default is dataclasses.MISSING and each.default_factory is not dataclasses.MISSING:
            default = each.default_factory()
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            yield from _settings(hint, f"{prefix}{each.name}.")
            continue
        shown = "required" if default is dataclasses.MISSING else f"`{_plain(default)}`"
        yield f"| `{prefix}{each.name}` | {_cell(_takes(hint))} | {shown} | {_cell(comments.get(each.name, ''))} |"


def _comments(kind: type[Any]) -> dict[str, str]:
    """The comment beside each field: its unit and meaning; a comment of its own line belongs to the field below."""
    lines = textwrap.dedent(inspect.getsource(kind)).splitlines()
    body = ast.parse("\n".join(lines)).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for statement in body.body:
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            beside = re.search(r"#\s*(.*)$", lines[(statement.end_lineno or statement.lineno) - 1])
            above = re.match(r"\s*#\s*(.*)$", lines[statement.lineno - 2])
            said = [match[1] for match in (above, beside) if match and not match[1].startswith(("noqa", "type:"))]
            found[statement.target.id] = "; ".join(said)
    return found


def _takes(hint: Any) -> str:
    if typing.get_origin(hint) is typing.Literal:
        return ", ".join(str(choice) for choice in typing.get_args(hint))
    return str(hint.__name__ if inspect.isclass(hint) and not typing.get_args(hint) else hint).replace("typing.", "")


def _plain(value: object) -> str:
    text = str(list(value)) if isinstance(value, tuple) else str(value)
    return {"True": "true", "False": "false", "None": "null"}.get(text, text)


def _program(module: ModuleType) -> Any:
    return next(
        value
        for value in vars(module).values()
        if inspect.isclass(value)
        and issubclass(value, (Operator, Source, Sink))
        and value.__module__ == module.__name__
    )


def _name(parameter: TyperArgument | TyperOption) -> str:
    if isinstance(parameter, TyperArgument):
        return f"`{parameter.metavar}`"
    names = ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))
    return names if parameter.is_flag else f"{names} {parameter.metavar or ''}".strip()


def _default(parameter: TyperArgument | TyperOption) -> str:
    if parameter.required:
        return "required"
    default = parameter.default
    return "" if default in (None, False, ()) or callable(default) else f"`{default}`"


def _prose(text: str) -> str:
    """Help as Markdown: paragraphs as they are, the example as code."""
    before, example, after = text.partition("Example: ")
    code = f"```sh\n{after.strip()}\n```" if example else ""
    return f"{_cell(inspect.cleandoc(before), newline=chr(10))}\n\n{code}".strip()


def _blocks(doc: str) -> str:
    """A program's docstring: the paragraph in front as prose, the table of ports as it stands."""
    first, _, rest = inspect.cleandoc(doc).partition("\n\n")
    return f"{first}\n\n```text\n{rest}\n```" if rest else first


def _cell(text: str, newline: str = " ") -> str:
    return re.sub(r"(?<!\\)\|", r"\\|", text.replace("\n", newline)).replace("<", "&lt;").replace("[", r"\[")
