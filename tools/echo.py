"""`caneflow echo`: the samples of a running flow, as they come."""

import json
import math
import queue
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import numpy as np
import typer

from caneflow.errors import CaneflowError
from caneflow.messages import SAMPLES, MessageError, Sample, decode
from caneflow.messages.codec import fields_in, plain
from caneflow.messages.registry import SCHEMA
from caneflow.options import At, Keys
from caneflow.printable import printable
from caneflow.runtime.hosts.attached.attach import ANY, Heard, attached, parted
from caneflow.runtime.site import DEFAULT_KEYS

MOST_WAITING = 10_000  # samples that may wait to be printed
SHOWN = 3  # elements of an array or a list on either side, on a line


def command(
    what: Annotated[
        list[str] | None,
        typer.Argument(metavar="FLOW|NODE/PORT", help="The flow, and which streams of it; by default all."),
    ] = None,
    at: At = None,
    keys: Keys = DEFAULT_KEYS,
    count: Annotated[int | None, typer.Option(min=1, help="Samples to print; by default until Ctrl-C.")] = None,
    seconds: Annotated[float | None, typer.Option(metavar="S", min=0.1, help="s to listen at most.")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print each as a JSON object on a line, arrays in full; stamps in ns.")
    ] = False,
) -> None:
    """Print the samples of a running flow, a line each: stream, number, stamp in s, then the message's fields.

    Values are in SI units and radians, as in docs/messages.md; arrays are shortened to their shape and ends. What
    cannot be decoded is printed with the reason. Exit status 1: nothing came within the time that was given.

    Example: caneflow echo cane fusion/pose --count 3
    """
    name, streams = parted(what or [])
    with attached(name, at, keys) as here:
        kinds = {edge.writer: edge.schema for edge in here.status().edges}
        inbox: queue.SimpleQueue[Heard] = queue.SimpleQueue()

        def hear(heard: Heard) -> None:
            if inbox.qsize() < MOST_WAITING:
                inbox.put(heard)

        until = math.inf if seconds is None else time.monotonic() + seconds
        printed = 0
        with here.samples(streams or [(ANY, ANY)], hear), missed_told() as missed:
            while (count is None or printed < count) and time.monotonic() < until:
                try:
                    heard = inbox.get(timeout=min(0.2, max(0.0, until - time.monotonic())))
                except queue.Empty:
                    continue
                print(printable(told(heard, kinds, as_json=as_json)), flush=True)
                printed += 1
                missed.take(heard)
        if not printed:
            named = ", ".join("/".join(stream) for stream in streams) or here.flow
            raise CaneflowError(f"nothing came of {named} in {seconds:g} s; `caneflow status {here.flow}` shows why")


class Missed:
    """Counts the samples between those that came, by their numbers."""

    def __init__(self) -> None:
        self.count = 0
        self._last: dict[str, int] = {}  # by key the seq of the newest

    def take(self, heard: Heard) -> None:
        """Note a sample that came."""
        try:
            seq = decode(heard.payload, Sample).seq
        except MessageError:
            return
        last = self._last.get(heard.key, seq - 1)
        self.count += max(0, seq - last - 1)
        self._last[heard.key] = max(last, seq)


@contextmanager
def missed_told() -> Iterator[Missed]:
    """Tell at the end, also after Ctrl-C, what was missed: a flow does not wait for a tool."""
    missed = Missed()
    try:
        yield missed
    finally:
        if missed.count:
            print(f"{missed.count} samples missed: they came faster than this command took them", file=sys.stderr)


def told(heard: Heard, kinds: dict[str, str], *, as_json: bool) -> str:
    """One sample as a line; `kinds` are the schemas of the streams, for a writer that does not say its own.

    Of a type that this program does not know, as a user's own, the fields are as msgpack has them.
    """
    stream = heard.key.partition("/")[2]
    schema = heard.schema if SCHEMA.fullmatch(heard.schema) else kinds.get(stream, "")
    try:
        fields = fields_in(heard.payload, SAMPLES.get(schema))
    except MessageError as error:
        if as_json:
            return json.dumps({"stream": stream, "refused": str(error), "bytes": len(heard.payload)})
        return f"{stream}  refused: {error} ({len(heard.payload)} bytes)"
    there = {name: value for name, value in fields.items() if value is not None}
    if as_json:
        return json.dumps({"stream": stream, "schema": schema} | {name: plain(value) for name, value in there.items()})
    shown = " ".join(f"{name}={_short(value)}" for name, value in there.items() if name not in ("stamp", "seq"))
    return f"{stream}  {fields['seq']}  {_seconds(fields['stamp'])}  {shown}"


def _seconds(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


def _short(value: Any) -> str:
    match value:
        case float():
            return f"{value:.6g}"
        case tuple() | list():
            return f"({', '.join(_ends(value, _short))})"
        case dict():
            return f"{{{', '.join(_ends(list(value), lambda key: f'{key}={_short(value[key])}'))}}}"
        case np.ndarray():
            return f"{value.dtype}{list(value.shape)}[{' '.join(_ends(value.ravel(), lambda each: f'{each:.6g}'))}]"
    return str(value)


def _ends(values: Any, show: Callable[[Any], str]) -> list[str]:
    """The elements as text; of many only the first and the last."""
    if len(values) <= 2 * SHOWN:
        return [show(each) for each in values]
    return [*map(show, values[:SHOWN]), "...", *map(show, values[-SHOWN:])]
