"""Hosts on a bad network: a replay comes out as on one machine; a live run goes on and says its losses."""

import logging
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from caneflow.recording import Recording
from caneflow.runtime.hosts.links.certificates import make_authority, make_certificate
from tests.flows import NODES, Launched, caneflow_here, launchers, results, spread_cane, wait_for, write_walk
from tests.networks import Faults, Network

Launch = Callable[..., Launched]

log = logging.getLogger(__name__)  # figures: --log-cli-level=INFO

pytestmark = pytest.mark.timeout(300)

SPLIT = {"imu": "gateway", "radar": "gateway", "ground_speed": "gateway", "fusion": "phone"}
THREE = {"imu": "gateway", "radar": "sensor", "ground_speed": "gateway", "fusion": "phone"}
SAMPLES = 800  # of each sensor: 8 s of event time
ALARM = 120.0  # s that a replay on a bad network may take


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "walk.mcap", SAMPLES)


@pytest.fixture(scope="module")
def undisturbed(walk: Path) -> dict[str, list[bytes]]:
    """What one machine makes of the walk."""
    out, file = walk.with_name("undisturbed.mcap"), walk.with_name("one.yaml")
    file.write_text(spread_cane("one", "  here: {}\n", dict.fromkeys(NODES, "here")))
    done = caneflow_here("run", file, "--replay", walk, "--in-process", "--record", out)
    assert done.returncode == 0, done.stderr
    return results(out)


@pytest.fixture
def launch() -> Iterator[Launch]:
    with launchers() as launch:
        yield launch


@pytest.fixture
def network(request: pytest.FixtureRequest) -> Iterator[Network]:
    """Hosts in namespaces: two, or those that the test names."""
    network = Network(getattr(request, "param", ("gateway", "phone")))
    try:
        with network.up():
            yield network
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no network namespaces or TUN devices for this user: {error}")


class Hosts:
    """A cane on the hosts of a network, with keys; the gateway leads and records."""

    def __init__(
        self, network: Network, folder: Path, launch: Launch, places: dict[str, str], *options: object
    ) -> None:
        self.network, self.folder, self._launch, self._options = network, folder, launch, options
        self.file = folder / "dataflow.yaml"
        flow = "f" + re.sub(r"\W", "", folder.name).lower()[-40:]
        at = f"tcp/{network.address('gateway')}:7447"
        others = [name for name in network.names if name != "gateway"]
        machines = f"  gateway: {{listen: [{at}], records: true}}\n"
        machines += "".join(f"  {name}: {{connect: [{at}]}}\n" for name in others)
        self.file.write_text(self.text(flow, machines, places))
        make_authority(folder / "keys")
        for name in network.names:
            make_certificate(folder / "keys", name)
        self.launched: dict[str, Launched] = {}
        for name in network.names:
            self.start(name)

    def text(self, flow: str, machines: str, places: dict[str, str]) -> str:
        return spread_cane(flow, machines, places)

    @property
    def out(self) -> Path:
        return self.folder / "out.mcap"

    def start(self, name: str) -> None:
        record = ("--record", self.out) if name == "gateway" else ()
        log = self.folder / f"{name}-{len(list(self.folder.glob(f'{name}*.log')))}.log"
        self.launched[name] = self._launch(
            *("run", self.file, "--machine", name, *self._options, *record),
            log=log,
            inside=self.network.command(name),
        )

    def wait_until_it_flows(self) -> None:
        """Until the phone has handled something."""
        wait_for(lambda: list(self.folder.glob("state-*-phone/*/fusion.snapshot")), "a snapshot of fusion", ALARM)

    def cut(self, seconds: float) -> None:
        self.network.faults.cut = True
        time.sleep(seconds)  # the fault itself
        self.network.faults.cut = False
        for each in self.launched.values():
            assert each.process.poll() is None, "the network was cut too late"

    def power_off(self, name: str) -> None:
        """Everything on the host is gone at once, and nobody hears of it."""
        self.network.faults.cut = True
        listed = subprocess.run(
            ["ip", "netns", "pids", self.network.namespace(name)], capture_output=True, text=True, check=True
        )
        for pid in map(int, listed.stdout.split()):
            os.kill(pid, signal.SIGKILL)
        self.launched[name].process.wait()
        self.network.faults.cut = False

    def end_well(self) -> None:
        for each in self.launched.values():
            assert each.ends(ALARM) == 0, each.said


FAULTS = {
    "none": Faults(),
    "50 ms": Faults(delay=0.05),
    "20 ms of jitter": Faults(delay=0.03, jitter=0.02),
    "5 % lost": Faults(delay=0.005, loss=0.05),
    "1 Mbit/s": Faults(delay=0.005, rate=1e6),
    "all of it": Faults(delay=0.05, jitter=0.02, loss=0.02, rate=1e6),
}


@pytest.mark.parametrize(
    "fault", [name if name == "50 ms" else pytest.param(name, marks=pytest.mark.long) for name in FAULTS]
)
def test_a_replay_on_a_bad_network_gives_the_bytes_of_one_machine(
    network: Network, tmp_path: Path, launch: Launch, walk: Path, undisturbed: dict[str, list[bytes]], fault: str
) -> None:
    network.faults = FAULTS[fault]

    hosts = Hosts(network, tmp_path, launch, SPLIT, "--replay", walk, "--speed", "max")

    hosts.end_well()
    assert results(hosts.out) == undisturbed
    if FAULTS[fault].loss:
        assert network.dropped > 10, "packets were lost, samples were not"


@pytest.mark.long
@pytest.mark.parametrize("seconds", [2, 10])
def test_a_replay_whose_network_is_cut_gives_the_bytes_of_one_machine(
    network: Network, tmp_path: Path, launch: Launch, walk: Path, undisturbed: dict[str, list[bytes]], seconds: float
) -> None:
    hosts = Hosts(network, tmp_path, launch, SPLIT, "--replay", walk, "--speed", "1")
    hosts.wait_until_it_flows()
    hosts.cut(seconds)

    hosts.end_well()
    assert results(hosts.out) == undisturbed


@pytest.mark.long
def test_a_host_that_loses_its_power_in_a_replay_goes_on_where_it_was(
    network: Network, tmp_path: Path, launch: Launch, walk: Path, undisturbed: dict[str, list[bytes]]
) -> None:
    hosts = Hosts(network, tmp_path, launch, SPLIT, "--replay", walk, "--speed", "0.5")
    hosts.wait_until_it_flows()
    hosts.power_off("phone")
    hosts.start("phone")

    hosts.end_well()
    assert "goes on from its snapshot" in hosts.launched["phone"].said
    assert results(hosts.out) == undisturbed


@pytest.mark.long
@pytest.mark.parametrize("network", [("sensor", "gateway", "phone")], indirect=True)
def test_three_hosts_with_a_cut_give_the_bytes_of_one_machine(
    network: Network, tmp_path: Path, launch: Launch, walk: Path, undisturbed: dict[str, list[bytes]]
) -> None:
    network.faults = Faults(delay=0.02, jitter=0.01, loss=0.01)
    hosts = Hosts(
        network,
        tmp_path,
        launch,
        THREE,
        "--replay",
        walk,
        "--speed",
        "1",
    )
    hosts.wait_until_it_flows()
    hosts.cut(3)

    hosts.end_well()
    assert results(hosts.out) == undisturbed


TICKER = '''
"""A live source: an IMU that ticks at 100 Hz."""
import time
from caneflow.messages import Imu
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Ticker(Source):
    outputs = {"imu": Imu}

    def __init__(self, settings, context): ...

    def samples(self):
        while True:
            time.sleep(0.01)
            yield "imu", Imu(stamp=time.time_ns(), gyro=(0.0, 0.0, 0.0))

if __name__ == "__main__":
    run(Ticker)
'''

COUNT = '''
"""A live operator: says how many samples came before."""
from caneflow.messages import Imu
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class Count(Operator):
    inputs = {"imu": Imu}
    outputs = {"imu": Imu}

    def __init__(self, settings, context):
        self.count = 0

    def handle(self, port, message):
        self.count += 1
        yield "imu", Imu(stamp=message.stamp, gyro=(float(self.count), 0.0, 0.0))

if __name__ == "__main__":
    run(Count)
'''


class LiveHosts(Hosts):
    """A ticker on the gateway and a counter on the phone."""

    def __init__(self, network: Network, folder: Path, launch: Launch) -> None:
        (folder / "ticker.py").write_text(TICKER)
        (folder / "count.py").write_text(COUNT)
        super().__init__(network, folder, launch, {})

    def text(self, flow: str, machines: str, places: dict[str, str]) -> str:
        return (
            f"flow: {flow}\nmachines:\n{machines}nodes:\n"
            "  ticker: {run: ./ticker.py, machine: gateway}\n"
            "  count: {run: ./count.py, machine: phone, inputs: {imu: ticker/imu}}\n"
            "results: [count/imu]\n"
        )

    def last_snapshot(self) -> float:
        """When the counter last wrote down that it went on (s, wall clock)."""
        found = [path.stat().st_mtime for path in self.folder.glob("state-*-phone/*/count.snapshot")]
        return max(found, default=0.0)

    def wait_until_it_flows(self) -> None:
        began = time.time()
        wait_for(lambda: self.last_snapshot() > began, "the counter to go on", ALARM)

    def end_live(self) -> None:
        self.launched["gateway"].process.send_signal(signal.SIGINT)
        for each in self.launched.values():
            assert each.ends() == 130, each.said


@pytest.mark.long
@pytest.mark.parametrize("what", ["cut 3 s", "cut 10 s", "power off", "another address"])
def test_a_live_run_goes_on_after_a_fault_and_its_recording_says_what_was_left_out(
    network: Network, tmp_path: Path, launch: Launch, what: str
) -> None:
    network.faults.delay = 0.005
    hosts = LiveHosts(network, tmp_path, launch)
    hosts.wait_until_it_flows()
    if what == "power off":
        hosts.power_off("phone")
        hosts.start("phone")
    elif what == "another address":
        network.change_address("phone", "10.77.0.77")
    else:
        hosts.cut(float(what.split()[1]))
    healed = time.time()
    hosts.wait_until_it_flows()
    log.info("%s: flows again after %.2f s", what, hosts.last_snapshot() - healed)
    time.sleep(3)  # of the run after it
    hosts.end_live()

    with Recording(hosts.out) as recording:
        assert recording.complete, hosts.launched["gateway"].said
        sent, counted = (recording.streams[stream].count for stream in (("ticker", "imu"), ("count", "imu")))
    log.info("%s: %d sent, %d of them counted", what, sent, counted)
    assert 200 < counted <= sent
    assert sent - counted < 100, "what was sent while the network was cut is sent again"
    verified = caneflow_here("verify", hosts.file, hosts.out)
    assert verified.returncode == 0, verified.stdout + verified.stderr
