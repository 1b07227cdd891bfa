"""What the doctor says of the way to a flow, of links that TLS or access control denies, and of what answers."""

import json
import platform
import socket
import ssl
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh

from caneflow import __version__, command
from caneflow.messages import control_key, encode
from caneflow.messages.control import Delays, EdgeStatus, FlowStatus, NodeStatus
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.attached import attach, diagnosis
from caneflow.runtime.hosts.attached.diagnosis import diagnosed
from caneflow.runtime.hosts.attached.way_to import Finding, way_to
from caneflow.runtime.hosts.launcher.run_directory import RunningFlow
from caneflow.runtime.hosts.links.certificates import credentials
from caneflow.runtime.hosts.links.session import Ports, open_session


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A loopback endpoint that nobody listens on."""
    ports = Ports()
    yield ports.endpoint()
    ports.release()


def keys_of(folder: Path, authority: Path | None = None) -> Path:
    """A folder with a machine and an observer, of an own authority or of the one in `authority`."""
    pytest.importorskip("cryptography", reason="cryptography is not installed: pip install caneflow[secure]")
    from caneflow.runtime.hosts.links.certificates import make_authority, make_certificate

    if authority is None:
        make_authority(folder)
    make_certificate(folder, "gateway")
    make_certificate(folder, "laptop", observer=True)
    return folder


def only(findings: list[Finding], state: str) -> Finding:
    (finding,) = [finding for finding in findings if finding.state == state]
    return finding


@contextmanager
def tls_server(keys: Path, trusted: Path) -> Iterator[str]:
    """A TLS listener with the machine's certificate of `keys` that takes clients of `trusted`'s authority."""
    own = credentials(keys, "gateway")
    assert own is not None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(own.certificate, own.key)
    context.load_verify_locations(trusted / "ca.crt")
    context.verify_mode = ssl.CERT_REQUIRED
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            with suppress(OSError):
                link, _ = listener.accept()
                with suppress(ssl.SSLError), context.wrap_socket(link, server_side=True) as secured:
                    secured.recv(1)

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"tls/127.0.0.1:{listener.getsockname()[1]}"
    thread.join()


def test_an_endpoint_that_nobody_listens_on(endpoint: str) -> None:
    (finding,) = way_to(endpoint)
    assert (finding.state, finding.text) == (
        "bad",
        f"127.0.0.1 is there, but nobody listens on port {endpoint.rpartition(':')[2]}",
    )
    assert finding.attempts[0].startswith("on 127.0.0.1: caneflow status")


@pytest.mark.parametrize(
    ("endpoint", "said"),
    [
        ("tcp/no-such-machine.invalid:7447", "no machine is called no-such-machine.invalid"),
        ("gateway", "gateway: not an endpoint"),
        ("tcp/gateway:x", "tcp/gateway:x: not an endpoint"),
    ],
)
def test_an_address_that_leads_nowhere(endpoint: str, said: str) -> None:
    (finding,) = way_to(endpoint)
    assert (finding.state, finding.text) == ("bad", said)
    assert finding.attempts


def test_a_certificate_that_is_taken(tmp_path: Path) -> None:
    keys = keys_of(tmp_path / "keys")
    with tls_server(keys, trusted=keys) as where:
        findings = list(way_to(where, keys))
    assert [finding.text for finding in findings] == ["someone listens", "TLS, and it takes laptop.crt"]


def test_a_certificate_of_another_authority_is_denied_and_by_whom_is_said(tmp_path: Path) -> None:
    ours, theirs = keys_of(tmp_path / "ours"), keys_of(tmp_path / "theirs")
    with tls_server(theirs, trusted=theirs) as where:
        here = only(list(way_to(where, ours)), "bad")
    assert here.text.startswith("denied by TLS, on this side: ")
    assert "copy the ca.crt of the flow" in here.attempts[0]
    with tls_server(ours, trusted=theirs) as where:
        there = only(list(way_to(where, ours)), "bad")
    assert there.text.startswith("denied by TLS, on the other side: ")
    assert "laptop.crt" in there.attempts[0]


def test_no_key_and_no_tls_are_told_apart(tmp_path: Path, endpoint: str) -> None:
    with open_session(mode="router", listen=[endpoint]):
        where = endpoint.replace("tcp/", "tls/")
        assert only(list(way_to(where, tmp_path / "none")), "bad").text == (
            f"takes a certificate, and {tmp_path / 'none'} holds none"
        )
        found = only(list(way_to(where, keys_of(tmp_path / "keys"))), "bad")
    assert "TLS" in found.text


def test_access_control_that_denies_is_named(tmp_path: Path, endpoint: str) -> None:
    """To Zenoh it looks as if nobody were there: the link is up, and the question is dropped."""
    keys = keys_of(tmp_path / "keys")
    own = credentials(keys, "gateway")
    assert own is not None
    where = endpoint.replace("tcp/", "tls/")
    secured: dict[str, Any] = {
        "transport/link/tls": {
            "root_ca_certificate": str(own.authority),
            "enable_mtls": True,
            "listen_certificate": str(own.certificate),
            "listen_private_key": str(own.key),
        },
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": [
                {
                    "id": "own",
                    "permission": "allow",
                    "flows": ["ingress", "egress"],
                    "messages": ["query", "reply", "declare_queryable"],
                    "key_exprs": ["cane/@/**"],
                }
            ],
            "subjects": [{"id": "gateway", "cert_common_names": ["gateway"]}],
            "policies": [{"rules": ["own"], "subjects": ["gateway"]}],
        },
    }
    with open_session(mode="router", listen=[where], more=secured) as session, answering(session, STATUS):
        findings = list(diagnosed("cane", where, keys))
    assert [finding.state for finding in findings] == ["ok", "ok", "bad"]
    assert findings[-1].text.startswith("linked, but nothing of cane comes through: denied by access control")


NODE = NodeStatus(
    node="fusion",
    program="caneflow.operators.fusion",
    state="ready",
    pid=0,
    restarts=0,
    uptime=60.0,
    cpu=0.1,
    memory=1,
    sent={"pose": 100},
    rates={"pose": 100.0},
    counted=0.5,
    said="",
)
EDGE = EdgeStatus(
    writer="imu/imu",
    reader="fusion.imu",
    schema="caneflow.Imu/1",
    sent=100,
    received=100,
    handled=100,
    waiting=0,
    rate=100.0,
    sender=0,
    wire=0,
    decode=0,
    queue=0,
    late=0,
    repeated=0,
    delays=Delays(),
)
STATUS = FlowStatus(
    flow="cane",
    version=__version__,
    host="phone.local",
    pid=1,
    uptime=60.0,
    replay=False,
    clock=0,
    machine="phone",
    nodes=[NODE, msgspec.structs.replace(NODE, node="imu", sent={"imu": 100}, rates={"imu": 100.0})],
    edges=[EDGE],
)


@contextmanager
def answering(session: zenoh.Session, status: FlowStatus, clock_ahead: float = 0.0) -> Iterator[None]:
    """A launcher that says `status`, on a machine whose clock is `clock_ahead` s ahead."""

    def answer(query: zenoh.Query) -> None:
        now = time.time_ns() + round(clock_ahead * 1e9)
        with query:
            query.reply(query.key_expr, encode(msgspec.structs.replace(status, clock=now)))

    queryable = session.declare_queryable(control_key("cane", "status"), answer)
    yield
    queryable.undeclare()  # type: ignore[no-untyped-call]  # the stub lacks its types


def findings_of(endpoint: str, status: FlowStatus, clock_ahead: float = 0.0) -> list[Finding]:
    with open_session(mode="router", listen=[endpoint]) as session, answering(session, status, clock_ahead):
        return list(diagnosed("cane", endpoint))


def test_a_flow_that_is_well(endpoint: str) -> None:
    findings = findings_of(endpoint, STATUS)
    assert {finding.state for finding in findings} == {"ok"}
    assert f"cane, live, up 60 s, caneflow {__version__}, pid 1" in [finding.text for finding in findings]


def test_clocks_and_versions_that_differ(endpoint: str) -> None:
    old = msgspec.structs.replace(STATUS, version="0.0.1")
    found = {finding.text.partition(" ")[0]: finding for finding in findings_of(endpoint, old, clock_ahead=2.5)}
    assert found["runs"].text == f"runs caneflow 0.0.1, here is {__version__}"
    clock = found["its"]
    assert (clock.state, clock.node) == ("look", "phone")
    assert float(clock.text.split()[3]) == pytest.approx(2500, abs=200)
    assert " ms ahead (+-" in clock.text


def test_losses_are_told_by_place_with_what_to_try(endpoint: str) -> None:
    lossy = msgspec.structs.replace(EDGE, wire=3, queue=7)
    looks = [
        finding
        for finding in findings_of(endpoint, msgspec.structs.replace(STATUS, edges=[lossy]))
        if finding.state == "look"
    ]
    assert [finding.node for finding in looks] == ["imu/imu > fusion.imu"] * 2
    assert looks[0].text.startswith("3 samples lost (wire): ")
    assert looks[1].text.startswith("7 samples lost (queue): ")
    assert all(finding.attempts for finding in looks)


def test_samples_that_come_late_though_none_is_lost_are_bad(endpoint: str) -> None:
    old = msgspec.structs.replace(EDGE, delays=Delays(handled=3.2))
    (bad,) = (
        finding
        for finding in findings_of(endpoint, msgspec.structs.replace(STATUS, edges=[old]))
        if finding.state != "ok"
    )
    assert (bad.node, bad.state) == ("imu/imu > fusion.imu", "bad")
    assert bad.text.startswith("samples are 3.2 s old when they are handled")


@pytest.mark.parametrize("age", [0.9, 1.7e9])
def test_samples_of_now_or_of_another_clock_are_not(endpoint: str, age: float) -> None:
    well = msgspec.structs.replace(EDGE, delays=Delays(handled=age))
    assert {each.state for each in findings_of(endpoint, msgspec.structs.replace(STATUS, edges=[well]))} == {"ok"}


@pytest.mark.parametrize(
    ("node", "said"),
    [
        ({"state": "waiting", "said": "no port"}, "is waiting; it said: no port"),
        ({"counted": 9.0, "pid": 77}, "has said nothing for 9 s, pid 77 is there"),
    ],
)
def test_nodes_that_are_not_well(endpoint: str, node: dict[str, Any], said: str) -> None:
    ill = msgspec.structs.replace(NODE, **node)
    finding = only(findings_of(endpoint, msgspec.structs.replace(STATUS, nodes=[ill, STATUS.nodes[1]])), "bad")
    assert (finding.node, finding.text) == ("fusion", said)


def test_nothing_that_arrives_is_named_with_whether_the_reader_hears(endpoint: str) -> None:
    deaf = msgspec.structs.replace(STATUS, edges=[msgspec.structs.replace(EDGE, received=0, handled=0)])
    finding = only(findings_of(endpoint, deaf), "bad")
    assert finding.text == "100 samples were sent and none came; the reader is heard by nobody here"
    silent = msgspec.structs.replace(NODE, node="imu", sent={"imu": 0}, rates={"imu": 0.0})
    nothing = msgspec.structs.replace(deaf, nodes=[NODE, silent])
    assert only(findings_of(endpoint, nothing), "look").text == "nothing was sent yet"


def test_a_link_that_is_missing_on_this_machine_is_named(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process of this test stands for a node that should listen on one port and dial another."""
    import os

    ports = Ports()
    listen, connect = ports.endpoint(), ports.endpoint()
    ports.release()
    own = msgspec.structs.replace(NODE, pid=os.getpid(), listen=(listen,), connect=(connect,))
    here = msgspec.structs.replace(STATUS, host=platform.node(), nodes=[own, STATUS.nodes[1]])
    told = [finding.text for finding in findings_of(endpoint, here) if finding.state == "bad"]
    assert told == [
        f"should listen on port {listen.rpartition(':')[2]}, and does not: its readers get nothing",
        f"dials its launcher on port {connect.rpartition(':')[2]}, without success",
    ]


def unix(path: Path) -> str:
    return f"unixsock-stream/{path}"


def test_a_socket_that_is_missing_on_this_machine_is_named(endpoint: str, tmp_path: Path) -> None:
    """As above, by Unix sockets: one that it should listen at, and two writers of which one has taken its link."""
    import os

    deaf, taken, alone = (unix(tmp_path / name) for name in ("1", "2", "3"))
    me = msgspec.structs.replace(NODE, pid=os.getpid())
    reader = msgspec.structs.replace(me, listen=(deaf,), connect=(taken, alone))
    writers = [
        msgspec.structs.replace(me, node=name, listen=(listen,), sent={"imu": 100}, rates={"imu": 100.0})
        for name, listen in (("imu", taken), ("radar", alone))
    ]
    here = msgspec.structs.replace(STATUS, host=platform.node(), nodes=[reader, *writers])
    with open_session(listen=[taken]), open_session(listen=[alone]), open_session(mode="client", connect=[taken]):
        findings = findings_of(endpoint, here)
    assert [finding.text for finding in findings if finding.state == "bad"] == [
        "should listen on socket 1, and does not: its readers get nothing",
        "dials radar on socket 3, without success",
    ]
    assert "listens on socket 2; linked to none" in [finding.text for finding in findings]


def test_the_way_to_a_socket(tmp_path: Path) -> None:
    path = tmp_path / "0"
    (nobody,) = way_to(unix(path))
    assert (nobody.state, nobody.text) == ("bad", "no answer: No such file or directory")
    with open_session(listen=[unix(path)]):
        (someone,) = way_to(unix(path))
    assert (someone.state, someone.text) == ("ok", "someone listens")
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    (left,) = way_to(unix(path))
    assert (left.state, left.text) == ("bad", "nobody listens: the flow was killed")
    (strange,) = way_to("unixsock-stream/\0")
    assert strange.state == "bad"
    (too_long,) = way_to(unix(tmp_path / ("x" * 200)))
    assert too_long.state == "bad"


@pytest.mark.parametrize("parts_of_one", [True, False])
def test_launchers_of_one_flow_on_one_machine_are_taken_as_one(
    endpoint: str, monkeypatch: pytest.MonkeyPatch, parts_of_one: bool
) -> None:
    """Two machines tried out on one: either launcher answers for both. Two runs of one file do not."""
    running = [RunningFlow("cane", 1, endpoint), RunningFlow("cane", 2, "tcp/127.0.0.1:1")]
    monkeypatch.setattr(attach, "running_flows", lambda: running)
    other = msgspec.structs.replace(STATUS, pid=2 if parts_of_one else 3)
    with (
        open_session(mode="router", listen=[endpoint]) as session,
        answering(session, STATUS),
        answering(session, other),
    ):
        if parts_of_one:
            assert attach.endpoint_of("cane") == endpoint
        else:
            with pytest.raises(DataflowError, match="2 flows 'cane' run on this machine; choose by --at"):
                attach.endpoint_of("cane")


def test_the_command_says_where_what_and_what_to_try(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["caneflow", "doctor", "--at", "tcp/127.0.0.1:1"])
    with pytest.raises(SystemExit) as end:
        command.main()
    assert end.value.code == 1
    out = capsys.readouterr().out
    assert out.startswith("tcp/127.0.0.1:1: bad  127.0.0.1 is there, but nobody listens on port 1\n")
    assert "\n                 try  on 127.0.0.1: caneflow status; does the flow run?\n" in out


def test_of_several_flows_each_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    running = [RunningFlow("cane", 1, "tcp/127.0.0.1:1"), RunningFlow("room", 2, "tcp/127.0.0.1:2")]
    for module in (attach, diagnosis):
        monkeypatch.setattr(module, "running_flows", lambda: running)
    assert [finding.node for finding in diagnosed()] == ["cane: tcp/127.0.0.1:1", "room: tcp/127.0.0.1:2"]
    assert [finding.node for finding in diagnosed("room")] == ["tcp/127.0.0.1:2"]
    (finding,) = diagnosed("roam")
    assert (finding.text, finding.attempts) == ("no flow 'roam' runs on this machine; did you mean 'room'?", ())


def test_a_flow_that_does_not_run(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (attach, diagnosis):
        monkeypatch.setattr(module, "running_flows", list)
    (finding,) = diagnosed()
    assert finding.state == "bad"
    assert finding.text.startswith("no flow runs on this machine; ")
    assert json.dumps(finding.attempts)
