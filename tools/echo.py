"""`caneflow echo`: the samples of a running flow, as they come."""

import json
import math
import queue
import sys
import time
from typing import Annotated, Any

import msgspec
import numpy as np
import typer

from caneflow.errors import CaneflowError
from caneflow.messages import SAMPLES, MessageError, Sample, decode
from caneflow.options import At, Keys
from caneflow.runtime.hosts.attach import ANY, DEFAULT_KEYS, Heard, attached, parted

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
        left_out = 0

        def hear(heard: Heard) -> None:
            nonlocal left_out
            if inbox.qsize() < MOST_WAITING:
                inbox.put(heard)
            else:
                left_out += 1

        until = math.inf if seconds is None else time.monotonic() + seconds
        printed = 0
        with here.samples(streams or [(ANY, ANY)], hear):
            while (count is None or printed < count) and time.monotonic() < until:
                try:
                    heard = inbox.get(timeout=min(0.2, max(0.0, until - time.monotonic())))
                except queue.Empty:
                    continue
                print(told(heard, kinds, as_json=as_json), flush=True)
                printed += 1
        if left_out:
            print(f"{left_out} samples left out: they came faster than they could be printed", file=sys.stderr)
        if not printed:
            named = ", ".join("/".join(stream) for stream in streams) or here.flow
            raise CaneflowError(f"nothing came of {named} in {seconds:g} s; `caneflow status {here.flow}` shows why")


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
