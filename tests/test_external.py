"""A node that is someone else's program: it dials the flow, feeds it, is counted, goes and comes back."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh

from caneflow.messages import Imu, control_key, decode
from caneflow.messages.control import FlowStatus
from caneflow.recording import Recording
from tests.flows import Launched, caneflow_here, free_port, launchers, wait_for

FLOW = """
flow: {flow}
nodes:
  imu: {{external: true, outputs: {{imu: Imu}}}}
  attitude: {{run: operators.attitude, inputs: {{imu: imu/imu}}}}
results: [attitude/imu]
"""
ENCODINGS = [zenoh.Encoding("application/msgpack").with_schema("caneflow.Imu/1"), zenoh.Encoding("zenoh/bytes")]
PERIOD_NS = 10_000_000


@pytest.fixture
def launch() -> Iterator[Callable[..., Launched]]:
    with launchers() as launch:
        yield launch


@contextmanager
def client(endpoint: str) -> Iterator[zenoh.Session]:
    """As any program of another language would: nothing of ours, mode client."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    with zenoh.open(config) as session:
        yield session


def reading(seq: int, begin: int, **changes: Any) -> bytes:
    fields = {"stamp": begin + PERIOD_NS * seq, "seq": seq, "gyro": [0.0, 0.0, 0.1], "accel": [0.0, 0.0, 9.81]}
    packed: bytes = msgpack.packb({**fields, **changes})
    return packed


def began(
    launch: Callable[..., Launched], tmp_path: Path, *options: object, by_file: bool = False
) -> tuple[Launched, str, str]:
    """A flow that waits for its external node; its name, and where that dials, which the file or the command says."""
    flow = "x" + tmp_path.name.replace("_", "")[-30:].lower()
    file, at = tmp_path / "flow.yaml", f"tcp/127.0.0.1:{free_port()}"
    machines = f"machines: {{here: {{listen: [{at}]}}}}\n" if by_file else ""
    file.write_text(machines + FLOW.format(flow=flow))
    listen = () if by_file else ("--listen", at)
    running = launch("run", file, *listen, *options, log=tmp_path / "log")
    running.wait_for("other programs attach at")
    return running, flow, at


def status(session: zenoh.Session, flow: str) -> FlowStatus:
    for reply in session.get(control_key("*", "status")):
        assert reply.ok is not None
        assert str(reply.ok.key_expr) == control_key(flow, "status")
        assert str(reply.ok.encoding) == "application/msgpack;caneflow.FlowStatus/1"
        return decode(reply.ok.payload.to_bytes(), FlowStatus)
    raise AssertionError("nobody answers")


def handled(session: zenoh.Session, flow: str) -> int:
    return next((edge.handled for edge in status(session, flow).edges if edge.reader == "attitude.imu"), 0)


@pytest.mark.parametrize("encoding", ENCODINGS, ids=["with a schema", "without"])
def test_its_samples_reach_the_reader_and_the_recording_byte_for_byte(
    launch: Callable[..., Launched], tmp_path: Path, encoding: zenoh.Encoding
) -> None:
    out = tmp_path / "out.mcap"
    running, flow, at = began(launch, tmp_path, "--record", out, by_file=encoding is ENCODINGS[0])
    with client(at) as session:
        wait_for(lambda: {n.state for n in status(session, flow).nodes} == {"external", "ready"}, "the others")
        [external] = [node for node in status(session, flow).nodes if node.state == "external"]
        assert (external.node, external.pid, external.said) == ("imu", 0, "nothing was heard of it yet")
        publisher = session.declare_publisher(f"{flow}/imu/imu", encoding=encoding)
        wait_for(lambda: publisher.matching_status, "someone who reads it")
        begin = time.time_ns()
        sent = [reading(seq, begin) for seq in range(50)]
        for payload in sent:
            publisher.put(payload)
        wait_for(lambda: handled(session, flow) == 50, "all to be handled")
        [external] = [node for node in status(session, flow).nodes if node.state == "external"]
        assert external.sent == {"imu": 50}
    running.process.terminate()
    assert running.ends() == 130
    with Recording(out) as recording:
        assert [each.payload for each in recording.samples([("imu", "imu")])] == sent
        assert recording.streams["attitude", "imu"].count == 50
    assert "restart" not in running.said
    assert "warning" not in running.said, "it does listen"


def test_it_is_counted_goes_and_comes_back(launch: Callable[..., Launched], tmp_path: Path) -> None:
    running, flow, at = began(launch, tmp_path)
    key, begin = f"{flow}/imu/imu", time.time_ns() - 2000 * PERIOD_NS

    def edge(session: zenoh.Session) -> tuple[int, int, int]:
        found = next(edge for edge in status(session, flow).edges if edge.reader == "attitude.imu")
        return found.handled, found.wire, found.decode

    with client(at) as session:
        wait_for(lambda: {n.state for n in status(session, flow).nodes} == {"external", "ready"}, "the others")
        for seq in (1000, 1001, 1004):  # it was there before the flow; then two are lost
            session.put(key, reading(seq, begin))
        for seq in range(1005, 1105):
            session.put(key, reading(seq, begin, gyro=["north", 0, 0]))
        session.put(key, reading(1105, begin))
        wait_for(lambda: edge(session) == (4, 2, 100), "what was sent to be counted")
    with client(at) as session:
        for seq in range(3):  # started again, it counts again
            session.put(key, reading(seq, begin + 1200 * PERIOD_NS))
        wait_for(lambda: edge(session) == (7, 2, 100), "the new one to be taken up")
    assert running.said.count("refused: ") == 1, "each cause once"
    assert running.process.poll() is None
    running.process.terminate()
    assert running.ends() == 130


def test_who_comes_by_tcp_writes_only_what_is_external(launch: Callable[..., Launched], tmp_path: Path) -> None:
    running, flow, at = began(launch, tmp_path)
    begin = time.time_ns()
    with client(at) as session, client(at) as other:
        wait_for(lambda: {n.state for n in status(session, flow).nodes} == {"external", "ready"}, "the others")
        heard: list[zenoh.Sample] = []
        held = other.declare_subscriber(f"{flow}/**", heard.append)
        forged = [f"{flow}/attitude/imu", control_key(flow, "counters", "attitude"), control_key(flow, "start")]
        for key in forged:
            session.put(key, reading(7, begin))
        session.put(f"{flow}/imu/imu", reading(0, begin))
        wait_for(lambda: any(str(each.key_expr) == f"{flow}/attitude/imu" for each in heard), "the attitude")
        assert {str(each.key_expr) for each in heard} == {f"{flow}/imu/imu", f"{flow}/attitude/imu"}
        assert len(heard) == 2, "of the forged ones none came through"
        assert all(each.timestamp is not None for each in heard)
        assert held is not None, "one without a name would be gone"
    running.process.terminate()
    assert running.ends() == 130


def test_where_nobody_listens_check_warns_and_a_live_run_says_what_to_write(tmp_path: Path) -> None:
    file = tmp_path / "flow.yaml"
    file.write_text(FLOW.format(flow="nobody"))
    checked = caneflow_here("check", file)
    assert checked.returncode == 0
    assert "warning: nodes.imu: is a program of someone else's, and this machine does not listen" in checked.stdout
    run = caneflow_here("run", file)
    assert run.returncode == 2
    assert "or give --listen tcp/127.0.0.1:7447" in run.stderr.splitlines()[-1]
    assert "Traceback" not in run.stderr


def test_a_port_that_is_taken_is_one_line_before_anything_starts(
    launch: Callable[..., Launched], tmp_path: Path
) -> None:
    _, _, at = began(launch, tmp_path)
    file = tmp_path / "flow.yaml"
    file.write_text(FLOW.format(flow="second"))
    run = caneflow_here("run", file, "--listen", at)
    assert run.returncode == 2
    assert at in run.stderr.splitlines()[-1]
    assert "Traceback" not in run.stderr


def test_the_examples_of_the_page_feed_and_hear(launch: Callable[..., Launched], tmp_path: Path) -> None:
    running, flow, at = began(launch, tmp_path)
    with client(at) as session:
        wait_for(lambda: {n.state for n in status(session, flow).nodes} == {"external", "ready"}, "the others")
    examples = Path(__file__).parent.parent / "examples"
    text = (examples / "print_poses.py").read_text().replace('["position"]', '["orientation"]')
    (tmp_path / "listener.py").write_text(text)
    hear = [sys.executable, str(tmp_path / "listener.py"), at, f"{flow}/attitude/imu", "20"]
    feed = [sys.executable, str(examples / "feed_imu.py"), at, f"{flow}/imu/imu", "1000"]
    with subprocess.Popen(hear, stdout=subprocess.PIPE, text=True) as hearing, subprocess.Popen(feed) as feeding:
        printed, _ = hearing.communicate(timeout=60)
        feeding.terminate()
    lines = [json.loads(line) for line in printed.splitlines()]
    assert len(lines) == 20
    assert all(abs(sum(part * part for part in line) - 1.0) < 1e-6 for line in lines)
    running.process.terminate()
    assert running.ends() == 130


PICO = """
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
typedef int z_owned_config_t, z_owned_session_t, z_view_keyexpr_t;
typedef struct { const uint8_t *data; size_t size; } z_owned_bytes_t;
#define Z_CONFIG_MODE_KEY 1
#define Z_CONFIG_CONNECT_KEY 2
#define z_loan(x) (&(x))
#define z_loan_mut(x) (&(x))
#define z_move(x) (&(x))
#define z_drop(x) (void)(x)
#define z_config_default(config) (*(config) = 0)
#define zp_config_insert(config, key, value) (printf("%d %s\\n", key, value))
#define z_open(session, config, options) (*(session) = 0)
#define zp_start_read_task(session, options) (void)(session)
#define zp_start_lease_task(session, options) (void)(session)
#define z_view_keyexpr_from_str(key, text) (*(key) = 0, puts(text))
#define z_bytes_copy_from_buf(bytes, from, length) ((bytes)->data = (from), (bytes)->size = (length))
#define z_put(session, key, bytes, options) put(bytes)
#define z_sleep_ms(duration) (void)(duration)
static void put(const z_owned_bytes_t *bytes) {
    for (size_t i = 0; i < bytes->size; i++) printf("%02x", bytes->data[i]);
    puts("");
}
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_c_example_writes_samples_of_the_wire(tmp_path: Path) -> None:
    """Against a stand-in for zenoh-pico that prints what is put."""
    (tmp_path / "zenoh-pico.h").write_text(PICO)
    source = Path(__file__).parent.parent / "examples" / "feed_imu.c"
    flags = ["-std=c11", "-Wall", "-Wno-unused-variable", "-Wno-unused-but-set-variable", "-Werror"]
    subprocess.run(["cc", *flags, f"-I{tmp_path}", source, "-o", tmp_path / "feed"], check=True)
    said = subprocess.run([tmp_path / "feed", "tcp/a:1", "f/imu/imu", "3"], capture_output=True, text=True, check=True)
    mode, endpoint, key, *payloads = said.stdout.splitlines()
    assert (mode, endpoint, key) == ("1 client", "2 tcp/a:1", "f/imu/imu")
    samples = [decode(bytes.fromhex(payload), Imu) for payload in payloads]
    assert [(each.seq, each.gyro, each.accel) for each in samples] == [(n, (0, 0, 0.1), (0, 0, 9.81)) for n in range(3)]
    assert abs(samples[0].stamp - time.time_ns()) < 60 * 10**9, "s since then"


def zenoh_pico() -> list[str]:
    """What a compiler needs for zenoh-pico; skips where there is none."""
    if shutil.which("cc") is None or shutil.which("pkg-config") is None:
        pytest.skip("no C compiler with pkg-config here")
    found = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "zenohpico"], capture_output=True, text=True, check=False
    )
    if found.returncode:
        pytest.skip("no zenoh-pico here: pkg-config does not know zenohpico, and no package index has it")
    return found.stdout.split()


def test_the_c_example_feeds_a_flow(launch: Callable[..., Launched], tmp_path: Path) -> None:
    libraries = zenoh_pico()
    source = Path(__file__).parent.parent / "examples" / "feed_imu.c"
    subprocess.run(["cc", "-std=c11", source, *libraries, "-o", tmp_path / "feed"], check=True)
    running, flow, at = began(launch, tmp_path)
    with client(at) as session:
        wait_for(lambda: {n.state for n in status(session, flow).nodes} == {"external", "ready"}, "the others")
        subprocess.run([tmp_path / "feed", at, f"{flow}/imu/imu", "100"], check=True)
        wait_for(lambda: handled(session, flow) == 100, "all to be handled")
    running.process.terminate()
    assert running.ends() == 130
