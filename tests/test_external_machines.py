"""A program of someone else's that feeds a flow on two machines, in the clear or with keys; what TLS lets it do."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh

from caneflow.messages import control_key, decode
from caneflow.messages.control import FlowStatus
from caneflow.recording import Recording
from caneflow.runtime.hosts.links.certificates import make_authority, make_certificate
from tests.flows import Launched, free_port, launchers, wait_for

PERIOD_NS = 10_000_000
FLOW = """
flow: {flow}
machines:
  gateway: {{listen: [tcp/127.0.0.1:{port}], records: true}}
  phone: {{connect: [tcp/127.0.0.1:{port}]}}
nodes:
  imu: {{external: true, machine: gateway, outputs: {{imu: Imu}}}}
  here: {{run: operators.attitude, machine: gateway, inputs: {{imu: imu/imu}}}}
  there: {{run: operators.attitude, machine: phone, inputs: {{imu: imu/imu}}}}
results: [here/imu, there/imu]
"""


@pytest.fixture
def launch() -> Iterator[Callable[..., Launched]]:
    with launchers() as launch:
        yield launch


@pytest.fixture
def flow(tmp_path: Path) -> str:
    """A flow's name that no other test uses."""
    return "x" + tmp_path.name.replace("_", "")[-30:].lower()


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flow") / "keys"
    make_authority(folder)
    for name in ("gateway", "phone"):
        make_certificate(folder, name)
    make_certificate(folder, "laptop", observer=True)
    return folder


@contextmanager
def client(port: int, keys: Path | None = None, name: str = "gateway") -> Iterator[zenoh.Session]:
    """As docs/how-to/attach.md has it: nothing of ours; with keys, it shows the certificate of `name`."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([f"{'tls' if keys else 'tcp'}/127.0.0.1:{port}"]))
    if keys is not None:
        tls = {
            "root_ca_certificate": str(keys / "ca.crt"),
            "enable_mtls": True,
            "connect_certificate": str(keys / f"{name}.crt"),
            "connect_private_key": str(keys / f"{name}.key"),
            "verify_name_on_connect": False,
        }
        config.insert_json5("transport/link/tls", json.dumps(tls))
    with zenoh.open(config) as session:
        yield session


def reading(seq: int, begin: int) -> bytes:
    fields = {"stamp": begin + PERIOD_NS * seq, "seq": seq, "gyro": [0.0, 0.0, 0.1], "accel": [0.0, 0.0, 9.81]}
    packed: bytes = msgpack.packb(fields)
    return packed


def statuses(session: zenoh.Session, flow: str) -> list[FlowStatus]:
    """What the launchers of all machines say. They answer under one key, of which a client is given one otherwise."""
    replies = session.get(control_key(flow, "status"), consolidation=zenoh.ConsolidationMode.NONE)
    return [decode(reply.ok.payload.to_bytes(), FlowStatus) for reply in replies if reply.ok is not None]


def are_handled(session: zenoh.Session, flow: str, count: int) -> bool:
    """Whether the readers on both machines have handled so many samples of the external node."""
    edges = [edge for status in statuses(session, flow) for edge in status.edges]
    return [edge.handled for edge in edges if edge.reader in ("here.imu", "there.imu")] == [count, count]


def fed(session: zenoh.Session, flow: str, begin: int) -> list[bytes]:
    """Put 50 samples, once the flow is there to read them."""
    publisher = session.declare_publisher(f"{flow}/imu/imu")
    wait_for(lambda: publisher.matching_status, "someone who reads it")
    wait_for(lambda: len(statuses(session, flow)) == 2, "both machines")
    sent = [reading(seq, begin) for seq in range(50)]
    for payload in sent:
        publisher.put(payload)
    return sent


@pytest.mark.parametrize("secure", [False, True], ids=["in the clear", "with keys"])
def test_its_samples_reach_both_machines_and_it_comes_back(
    launch: Callable[..., Launched], flow: str, keys: Path, tmp_path: Path, secure: bool
) -> None:
    port, file, out = free_port(), tmp_path / "flow.yaml", tmp_path / "out.mcap"
    file.write_text(FLOW.format(flow=flow, port=port))
    options = ("--keys", keys) if secure else ()
    gateway = launch("run", file, "--machine", "gateway", "--record", out, *options, log=tmp_path / "gateway.log")
    phone = launch("run", file, "--machine", "phone", *options, log=tmp_path / "phone.log")
    for each in (gateway, phone):
        each.wait_for("ready: ")
    begin, sent = time.time_ns() - 4000 * PERIOD_NS, list[bytes]()
    for turn in (1, 2):  # it goes, and comes back with seq 0
        with client(port, keys if secure else None) as session:
            sent += fed(session, flow, begin + turn * 1000 * PERIOD_NS)
            wait_for(partial(are_handled, session, flow, 50 * turn), "all to be handled on both machines")
            [node] = [node for each in statuses(session, flow) for node in each.nodes if node.node == "imu"]
            assert (node.state, node.machine, node.sent) == ("external", "gateway", {"imu": 50 * turn})
    gateway.process.terminate()
    assert gateway.ends() == 130
    assert phone.ends() == 130
    with Recording(out) as recording:
        assert [each.payload for each in recording.samples([("imu", "imu")])] == sent
        assert recording.streams["there", "imu"].count == recording.streams["here", "imu"].count == 100
    assert "restart" not in gateway.said


def test_by_tls_a_machine_feeds_and_an_observer_only_hears(
    launch: Callable[..., Launched], flow: str, keys: Path, tmp_path: Path
) -> None:
    """On the only machine of a flow. What else is put, also on keys of the machine's own programs, comes nowhere."""
    port, file = free_port(), tmp_path / "flow.yaml"
    lines = [line for line in FLOW.splitlines() if "phone" not in line]
    file.write_text("\n".join(lines).format(flow=flow, port=port).replace(", there/imu", ""))
    running = launch("run", file, "--keys", keys, log=tmp_path / "log")
    running.wait_for("who shows a certificate of this flow can read there")
    begin, heard, seq = time.time_ns() - 10**10, list[tuple[str, dict[str, Any]]](), 0

    def note(sample: zenoh.Sample) -> None:
        heard.append((str(sample.key_expr).partition("/")[2], msgpack.unpackb(sample.payload.to_bytes())))

    with client(port, keys, "laptop") as laptop, client(port, keys) as feeder:
        held = laptop.declare_subscriber(f"{flow}/*/*", note, allowed_origin=zenoh.Locality.REMOTE)
        wait_for(lambda: len(statuses(laptop, flow)) == 1, "an answer")

        def feed() -> bool:  # again and again, as it takes a moment until all know who reads what
            nonlocal seq
            laptop.put(f"{flow}/imu/imu", reading(10**6 + seq, begin))
            feeder.put(f"{flow}/here/imu", reading(10**6 + seq, begin))
            feeder.put(control_key(flow, "counters", "here"), reading(seq, begin))
            feeder.put(f"{flow}/imu/imu", reading(seq, begin))
            seq += 1
            return [stream for stream, _ in heard].count("here/imu") > 3

        wait_for(feed, "attitudes")
        assert {stream for stream, _ in heard} == {"imu/imu", "here/imu"}
        assert max(message["seq"] for _, message in heard) < 10**6, "of the forged ones none came through"
        assert all("orientation" in message for stream, message in heard if stream == "here/imu")
        assert held is not None, "one without a name would be gone"
    running.process.terminate()
    assert running.ends() == 130
