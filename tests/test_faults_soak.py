"""Minutes of a looped replay whose nodes are killed and frozen at random: nothing is lost, nothing grows, none is left.

CANEFLOW_SOAK_MINUTES says how many minutes; 10 when it is not set.
"""

import logging
import os
import re
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

from caneflow.recording import Recording
from caneflow.runtime.hosts.launcher.run_directory import running_flows
from tests.flows import CANEFLOW, NODES, Launched, launchers, node_processes, results, spread_cane, wait_for, write_walk

Launch = Callable[..., Launched]

MINUTES = float(os.environ.get("CANEFLOW_SOAK_MINUTES", "10"))
LONGEST_FREEZE = 4.0  # s
PAUSE = (1.0, 5.0)  # s between two faults

pytestmark = [pytest.mark.long, pytest.mark.timeout(60 * MINUTES + 600)]

log = logging.getLogger(__name__)  # figures: --log-cli-level=INFO

KEEP_TRYING = "restart: {max_restarts: 1000, delay_s: 0.1, max_delay_s: 0.1}"


@pytest.fixture
def launch() -> Iterator[Launch]:
    with launchers() as launch:
        yield launch


class Growth:
    """Descriptors and memory of the processes that live as long as the run."""

    def __init__(self, processes: dict[str, psutil.Process]) -> None:
        self._processes = processes
        self._began = time.monotonic()
        self._rows: list[tuple[float, ...]] = []

    def look(self) -> None:
        now = time.monotonic() - self._began
        costs = [(each.num_fds(), each.memory_info().rss / 2**20) for each in self._processes.values()]
        self._rows.append((now / 60, *(number for pair in costs for number in pair)))

    def ends(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The first and last look: minutes, then descriptors and MiB of each."""
        return tuple(round(x, 1) for x in self._rows[0]), tuple(round(x, 1) for x in self._rows[-1])

    def per_minute(self) -> dict[str, tuple[float, float]]:
        """By process the slopes of descriptors and MiB, over the second half of the run."""
        rows = np.array(self._rows[len(self._rows) // 2 :])  # shape (n, 1 + 2 * processes)
        slopes = np.polyfit(rows[:, 0], rows[:, 1:], 1)[0].reshape(-1, 2)
        return {name: (float(a), float(b)) for name, (a, b) in zip(self._processes, slopes, strict=True)}


def test_random_kills_and_freezes_lose_nothing_and_leave_nothing(launch: Launch, tmp_path: Path) -> None:
    flow = "s" + re.sub(r"\W", "", tmp_path.name).lower()[-40:]
    walk, out, file = write_walk(tmp_path / "walk.mcap", 1000), tmp_path / "out.mcap", tmp_path / "dataflow.yaml"
    text = spread_cane(flow, "  here: {}\n", dict.fromkeys(NODES, "here"))
    file.write_text(text.replace("machine: here}", f"machine: here, {KEEP_TRYING}}}"))
    launched = launch("run", file, "--replay", walk, "--loop", "--record", out, log=tmp_path / "run.log")
    wait_for(lambda: len(node_processes(launched.process.pid)) == len(NODES) + 1, "all nodes")
    wait_for(lambda: any(each.pid == launched.process.pid for each in running_flows()), "the flow's address")
    chance, done = np.random.default_rng(int(MINUTES * 10)), Counter[str]()
    lasting = {
        "launcher": psutil.Process(launched.process.pid),
        "recorder": node_processes(launched.process.pid)["recorder"],
    }
    growth, end = Growth(lasting), time.monotonic() + 60 * MINUTES

    while time.monotonic() < end:
        assert launched.process.poll() is None, launched.said
        growth.look()
        time.sleep(chance.uniform(*PAUSE))
        running = {name: each for name, each in node_processes(launched.process.pid).items() if name in NODES}
        if not running:
            continue
        victim = running[str(chance.choice(sorted(running)))]
        try:
            if chance.random() < 0.5:
                victim.kill()
                done["killed"] += 1
            else:
                victim.suspend()
                time.sleep(chance.uniform(0.2, LONGEST_FREEZE))
                victim.resume()
                done["frozen"] += 1
        except psutil.NoSuchProcess:
            continue  # it was just being started again
    wait_for(lambda: len(node_processes(launched.process.pid)) == len(NODES) + 1, "all nodes to be back")
    launched.process.send_signal(signal.SIGINT)
    status = launched.ends()
    slopes = growth.per_minute()
    log.info("%g min, %s; per minute (descriptors, MiB): %s", MINUTES, dict(done), slopes)
    log.info("first and last look (min, descriptors, MiB, ...): %s", growth.ends())

    assert status == 130, launched.said
    assert not node_processes(launched.process.pid), "left behind"
    with Recording(out) as recording:
        assert recording.complete
        for stream in recording.streams:
            seqs = [sample.seq for sample in recording.samples([stream])]
            assert seqs == list(range(len(seqs))), stream
    # Ctrl-C cuts the operators off somewhere; up to there they gave what an undisturbed run of the same inputs gives.
    again = tmp_path / "again.mcap"
    run = [*CANEFLOW, "run", str(file), "--replay", str(out), "--in-process", "--record", str(again)]
    subprocess.run(run, capture_output=True, check=True)
    expected = results(again)
    for name, payloads in results(out).items():
        assert payloads == expected[name][: len(payloads)], name
        assert len(expected[name]) - len(payloads) < 600, "no further behind than the window of a replay"
    for name, (descriptors, memory) in slopes.items():
        assert descriptors < 1, f"{name}: {descriptors:.2f} more descriptors a minute"
        assert memory < 2, f"{name}: {memory:.2f} MiB more a minute"
