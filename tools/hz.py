"""`caneflow hz`: how often the samples of a running flow come."""

import json
import queue
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Any

import typer

from caneflow.errors import CaneflowError
from caneflow.messages import MessageError, Sample, decode
from caneflow.options import At, Keys
from caneflow.runtime.hosts.attached.attach import ANY, Attached, Heard, attached, parted
from caneflow.runtime.site import DEFAULT_KEYS
from caneflow.runtime.wording import in_columns

WINDOW = 10.0  # s that the figures of a live table are over
REFRESH = 0.5  # s


@dataclass
class Arrivals:
    """When the samples of one stream came, and what they say of themselves."""

    times: list[float] = field(default_factory=list)  # s, monotonic
    stamps: list[int] = field(default_factory=list)  # ns
    seqs: list[int] = field(default_factory=list)
    unreadable: int = 0

    def take(self, time_s: float, heard: Heard) -> None:
        """Note a sample."""
        try:
            head = decode(heard.payload, Sample)
        except MessageError:
            self.unreadable += 1
            return
        self.times.append(time_s)
        self.stamps.append(head.stamp)
        self.seqs.append(head.seq)

    def forget_before(self, time_s: float) -> None:
        """Keep what came since."""
        keep = next((i for i, at in enumerate(self.times) if at >= time_s), len(self.times))
        del self.times[:keep], self.stamps[:keep], self.seqs[:keep]

    def figures(self) -> dict[str, Any]:
        """Rate in Hz, the steps between arrivals in s, samples missing by their numbers."""
        steps = [later - earlier for earlier, later in pairwise(self.times)]
        span, stamped = sum(steps), [(later - earlier) / 1e9 for earlier, later in pairwise(self.stamps)]
        return {
            "count": len(self.times),
            "rate": len(steps) / span if span > 0 else None,
            "stamped_rate": len(stamped) / sum(stamped) if sum(stamped) > 0 else None,
            "shortest": min(steps, default=None),
            "longest": max(steps, default=None),
            "jitter": statistics.pstdev(steps) if len(steps) > 1 else None,
            "missing": sum(max(0, later - earlier - 1) for earlier, later in pairwise(self.seqs)),
            "unreadable": self.unreadable,
        }


def command(
    what: Annotated[
        list[str] | None,
        typer.Argument(metavar="FLOW|NODE/PORT", help="The flow, and which streams of it; by default all."),
    ] = None,
    at: At = None,
    keys: Keys = DEFAULT_KEYS,
    seconds: Annotated[
        float | None,
        typer.Option(metavar="S", min=0.1, help="s to listen; by default 2, and in a terminal until Ctrl-C."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object; Hz and s.")] = False,
) -> None:
    """Show how often the samples of a running flow come: rates in Hz, steps between two arrivals in ms.

    What it counts is what comes to this command: `caneflow status` shows what each node got. The stamps' rate is
    that of the measurements; it differs from the rate of arrival in a replay that is faster than real time.

    Example: caneflow hz cane imu/imu radar/frame --seconds 5
    """
    name, streams = parted(what or [])
    with attached(name, at, keys) as here:
        if seconds is None and not as_json and sys.stdout.isatty():
            _show(here, streams)
            return
        figures = measured(here, streams, 2.0 if seconds is None else seconds)
        print(json.dumps(figures, indent=2) if as_json else "\n".join(lines(figures)))
        if not figures:
            raise CaneflowError(f"nothing came of {here.flow}; `caneflow status {here.flow}` shows its nodes")


def measured(here: Attached, streams: list[tuple[str, str]], seconds: float) -> dict[str, dict[str, Any]]:
    """The figures of each stream, `node/port`, over `seconds`."""
    for arrivals in _listening(here, streams, seconds, refresh=seconds):
        last = arrivals
    return {stream: each.figures() for stream, each in sorted(last.items())}


def lines(figures: dict[str, dict[str, Any]]) -> Iterator[str]:
    """The same for people."""
    rows: list[tuple[str, ...]] = [
        ("stream", "count", "rate", "stamped", "steps", "jitter", "missing", "bad"),
        ("", "", "Hz", "Hz", "ms", "ms", "", ""),
    ]
    for stream, of in figures.items():
        steps = "-" if of["longest"] is None else f"{_ms(of['shortest'])} .. {_ms(of['longest'])}"
        rates = ("-" if rate is None else f"{rate:.2f}" for rate in (of["rate"], of["stamped_rate"]))
        rows.append(
            (stream, str(of["count"]), *rates, steps, _ms(of["jitter"]), str(of["missing"]), str(of["unreadable"]))
        )
    yield from in_columns(rows, right=range(1, 8))


def _listening(
    here: Attached, streams: list[tuple[str, str]], seconds: float | None, refresh: float
) -> Iterator[dict[str, Arrivals]]:
    """What has come so far, every `refresh` s, for `seconds`."""
    arrivals: dict[str, Arrivals] = defaultdict(Arrivals)
    inbox: queue.SimpleQueue[tuple[float, Heard]] = queue.SimpleQueue()
    began = time.monotonic()
    with here.samples(streams or [(ANY, ANY)], lambda heard: inbox.put((time.monotonic(), heard))):
        while seconds is None or time.monotonic() < began + seconds:
            time.sleep(refresh)
            while not inbox.empty():
                at, heard = inbox.get()
                arrivals[heard.key.partition("/")[2]].take(at, heard)
            yield arrivals


def _show(here: Attached, streams: list[tuple[str, str]]) -> None:
    from rich.live import Live  # here, as it takes 0.1 s to import
    from rich.text import Text

    try:
        with Live(auto_refresh=False) as table:
            for arrivals in _listening(here, streams, None, REFRESH):
                for each in arrivals.values():
                    each.forget_before(time.monotonic() - WINDOW)
                figures = {stream: each.figures() for stream, each in sorted(arrivals.items())}
                table.update(Text("\n".join(lines(figures)), no_wrap=True, overflow="crop"), refresh=True)
    except KeyboardInterrupt:  # the way to end it
        return


def _ms(seconds: float | None) -> str:
    return "-" if seconds is None else f"{1e3 * seconds:.2f}"
