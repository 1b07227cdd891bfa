"""`caneflow echo`: the samples of a running flow, as they come."""

import json
import math
import queue
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import msgspec
import numpy as np
import typer

from caneflow.errors import CaneflowError
from caneflow.messages import SAMPLES, MessageError, Sample, decode
from caneflow.options import At, Keys
from caneflow.printable import printable
from caneflow.runtime.hosts.attached.attach import ANY, DEFAULT_KEYS, Heard, attached, parted

MOST_WAITING = 10_000  # samples that may wait to be printed
SHOWN = 3  # elements of an array on either side, on a line


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
    """One sample as a line; `kinds` are the schemas of the streams, for a writer that does not say its own."""
    stream = heard.key.partition("/")[2]
    kind = SAMPLES.get(heard.schema) or SAMPLES.get(kinds.get(stream, ""))
    try:
        if kind is None:
            raise MessageError(f"a message of unknown type {heard.schema!r}")
        message = decode(heard.payload, kind)
    except MessageError as error:
        if as_json:
            return json.dumps({"stream": stream, "refused": str(error), "bytes": len(heard.payload)})
        return f"{stream}  refused: {error} ({len(heard.payload)} bytes)"
    fields = {name: getattr(message, name) for name in message.__struct_fields__ if getattr(message, name) is not None}
    if as_json:
        return json.dumps({"stream": stream, "schema": kind.schema} | {k: _plain(v) for k, v in fields.items()})
    told = " ".join(f"{k}={_short(v)}" for k, v in fields.items() if k not in ("stamp", "seq"))
    return f"{stream}  {message.seq}  {_seconds(message)}  {told}"


def _seconds(message: Sample) -> str:
    return f"{message.stamp // 10**9}.{message.stamp % 10**9:09d}"


def _short(value: Any) -> str:
    match value:
        case float():
            return f"{value:.6g}"
        case tuple():
            return f"({', '.join(_short(each) for each in value)})"
        case np.ndarray():
            flat = value.ravel()
            ends = [*flat[:SHOWN], "...", *flat[-SHOWN:]] if flat.size > 2 * SHOWN else list(flat)
            elements = " ".join(each if isinstance(each, str) else f"{each:.6g}" for each in ends)
            return f"{value.dtype}{list(value.shape)}[{elements}]"
    return str(value)


def _plain(value: Any) -> Any:
    """As JSON has it: an infinite value is its name, a complex one its two parts."""
    match value:
        case float() if not math.isfinite(value):
            return str(value)
        case complex():
            return [value.real, value.imag]
        case np.ndarray():
            return _plain(value.tolist())
        case list() | tuple():
            return [_plain(each) for each in value]
    return msgspec.to_builtins(value)
