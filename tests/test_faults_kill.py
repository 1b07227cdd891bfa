"""An operator that is killed at any moment of a replay comes back, and the result is that of an undisturbed run."""

import logging
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh

from caneflow.messages import GroundSpeed, Pose, Sample, decode, sample_key
from caneflow.runtime.hosts.launcher.run_directory import RunningFlow, running_flows
from caneflow.runtime.hosts.links.session import open_session
from tests.flows import NODES, Launched, launchers, node_processes, results, spread_cane, wait_for, write_walk

Launch = Callable[..., Launched]

log = logging.getLogger(__name__)  # figures: --log-cli-level=INFO

pytestmark = pytest.mark.timeout(900)

SAMPLES = 1200  # of each sensor: 12 s of event time
OUTPUTS: dict[str, tuple[str, type[Sample]]] = {"ground_speed": ("speed", GroundSpeed), "fusion": ("pose", Pose)}
SETTLED = 0.1  # s after its death in which what a node had sent arrives
KILLS = 20  # runs, each with one kill at another moment


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "walk.mcap", SAMPLES)


@pytest.fixture
def launch() -> Iterator[Launch]:
    with launchers() as launch:
        yield launch


class Watched:
    """The newest output of a node, from outside."""

    def __init__(self, session: zenoh.Session, flow: str, node: str) -> None:
        self.seq = -1
        port, self._kind = OUTPUTS[node]

        def take(sample: zenoh.Sample) -> None:
            self.seq = max(self.seq, decode(sample.payload.to_bytes(), self._kind).seq)

        handler = zenoh.handlers.Callback(take, indirect=False)
        self._held = session.declare_subscriber(sample_key(flow, node, port), handler)

    def wait_for(self, seq: int) -> None:
        wait_for(lambda: self.seq >= seq, f"seq {seq}; it is at {self.seq}")


def running(launched: Launched) -> RunningFlow:
    def found() -> list[RunningFlow]:
        assert launched.process.poll() is None, launched.said
        return [each for each in running_flows() if each.pid == launched.process.pid]

    wait_for(found, "the flow's address")
    return found()[0]


def run_with_a_kill(launch: Launch, file: Path, walk: Path, out: Path, speed: str, node: str, at: int) -> float | None:
    """Replay `walk` and kill `node` once its output has come to seq `at`; s until it has gone on.

    None: the replay was over before the kill.
    """
    options = ("--replay", walk, "--speed", speed, "--record", out)
    launched = launch("run", file, *options, log=out.with_suffix(".log"))
    flow = running(launched)
    with open_session(mode="client", connect=[flow.endpoint]) as session:
        watched = Watched(session, flow.flow, node)
        watched.wait_for(at)
        victim = node_processes(flow.pid).get(node)
        if victim is None:
            return None
        victim.kill()
        killed = time.monotonic()
        victim.wait(10)
        time.sleep(SETTLED)  # what it had sent has come
        if watched.seq == SAMPLES - 1:
            return None
        reached = watched.seq
        wait_for(
            lambda: watched.seq > reached or launched.process.poll() is not None,
            f"more than seq {reached}: {launched.said}",
            deadline=60.0,
        )
        recovered = time.monotonic() - killed
    assert launched.ends() == 0, launched.said
    assert f"{node} | ended with killed by SIGKILL; restart 1 of" in launched.said
    return recovered


@pytest.mark.long
@pytest.mark.parametrize("speed", ["4", "max"])
@pytest.mark.parametrize("node", OUTPUTS)
def test_killed_at_twenty_moments_gives_the_undisturbed_track_twenty_times(
    launch: Launch, tmp_path: Path, walk: Path, node: str, speed: str
) -> None:
    flow = "k" + re.sub(r"\W", "", tmp_path.name).lower()[-40:]
    file = tmp_path / "dataflow.yaml"
    file.write_text(spread_cane(flow, "  here: {}\n", dict.fromkeys(NODES, "here")))
    undisturbed = tmp_path / "undisturbed.mcap"
    launched = launch("run", file, "--replay", walk, "--in-process", "--record", undisturbed, log=tmp_path / "calm.log")
    assert launched.ends() == 0, launched.said
    expected = results(undisturbed)

    chance, moments = np.random.default_rng(8), list[int]()
    recovered, equal = list[float](), 0
    while len(recovered) < KILLS:
        # Early enough to be a kill: with `max` the whole replay takes less than a second.
        moments.append(int(chance.integers(0, SAMPLES * 3 // 4)))
        out = tmp_path / f"out{len(moments)}.mcap"
        took = run_with_a_kill(launch, file, walk, out, speed, node, moments[-1])
        if took is not None:
            recovered.append(took)
            equal += results(out) == expected
    went_on = f"goes on after {np.median(recovered):.2f} s (median), {max(recovered):.2f} s (longest)"
    log.info("%s at speed %s: %d of %d tracks equal; %s", node, speed, equal, KILLS, went_on)

    assert equal == KILLS, f"killed at the samples {moments}"
