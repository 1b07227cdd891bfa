"""Checks the processes that several nodes share: one machine, one restart policy, a name that means nothing else."""

from collections.abc import Mapping

from caneflow.runtime.dataflow.wiring import Part
from caneflow.runtime.dataflow.yaml_file import Document


def check_processes(document: Document, parts: Mapping[str, Part], places: Mapping[str, str | None]) -> None:
    """Note what is wrong; `places`: the machine of every node."""
    groups: dict[str, list[str]] = {}
    for name, part in parts.items():
        if part.shape.process is not None and not part.shape.external:
            groups.setdefault(part.shape.process, []).append(name)
    for process, members in groups.items():
        first = members[0]
        namesake = parts.get(process)
        if namesake is not None and process not in members:
            document.problem(
                ("nodes", first, "process"),
                f"{process!r} is a node outside it; write `process: {process}` there too, or another name here",
            )
        for name in members[1:]:
            _check_alike(document, first, name, parts, places)


def _check_alike(
    document: Document, first: str, name: str, parts: Mapping[str, Part], places: Mapping[str, str | None]
) -> None:
    """Note in what a member of a process differs from the first, and must not."""
    here, there = places[name], places[first]
    if here is not None and there is not None and here != there:
        document.problem(
            ("nodes", name, "process"),
            f"is shared with {first}, which runs on {there}, and {name} on {here}; a process runs on one machine",
        )
    if parts[name].shape.restart != parts[first].shape.restart:
        document.problem(
            ("nodes", name, "process"),
            f"is shared with {first}, which has another `restart`; a process starts again as a whole: write the same",
        )
