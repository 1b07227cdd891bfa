"""Who may take part in a flow of several machines: keys, access control from the graph, attempts to get around it."""

import re
import shutil
import stat
import subprocess
import time
from collections.abc import Callable, Iterator
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest
import zenoh
from ruamel.yaml import YAML

from caneflow.messages import Imu, control_key, numbered, sample_key, stream_of
from caneflow.runtime.dataflow.loading import examine, load
from caneflow.runtime.deployment import deploy
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.launcher.run_directory import running_flows
from caneflow.runtime.hosts.links.access import access_control, check_access_control, machine_grants
from caneflow.runtime.hosts.links.certificates import certificates, credentials, make_authority, make_certificate
from caneflow.runtime.hosts.links.session import open_session
from tests.flows import Launched, caneflow_here, free_port, launchers, spread_cane, wait_for

DATAFLOWS = Path(__file__).parents[1] / "dataflows"
SPLIT = {"imu": "gateway", "radar": "gateway", "ground_speed": "gateway", "fusion": "phone"}


def machines(port: int = 7447, host: str = "127.0.0.1") -> str:
    return f"  gateway: {{listen: [tcp/{host}:{port}]}}\n  phone: {{connect: [tcp/{host}:{port}]}}\n"


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority with two machines, an observer, and a machine that the flow does not know."""
    folder = tmp_path_factory.mktemp("flow") / "keys"
    make_authority(folder)
    for name in ("gateway", "phone", "stranger"):
        make_certificate(folder, name)
    make_certificate(folder, "laptop", observer=True)
    return folder


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another authority, which knows machines of the same names."""
    folder = tmp_path_factory.mktemp("foreign") / "keys"
    make_authority(folder)
    make_certificate(folder, "phone")
    return folder


# --- keys ------------------------------------------------------------------------------------------------------------


def test_keys_are_for_their_owner_only(keys: Path) -> None:
    files = [path for path in keys.iterdir() if not path.name.startswith(".")]

    assert stat.S_IMODE(keys.stat().st_mode) == 0o700
    assert len(files) == 10
    assert {stat.S_IMODE(path.stat().st_mode) for path in files} == {0o600}
    assert {(each.name, each.role) for each in certificates(keys)} == {
        ("ca", "authority"),
        ("gateway", "machine"),
        ("laptop", "observer"),
        ("phone", "machine"),
        ("stranger", "machine"),
    }


def test_the_command_makes_and_lists_keys(tmp_path: Path) -> None:
    def caneflow(*args: str) -> "subprocess.CompletedProcess[str]":
        return caneflow_here("keys", *args, cwd=tmp_path)

    assert caneflow("add", "gateway").returncode == 2
    assert caneflow("init").returncode == 0
    assert caneflow("add", "gateway").returncode == 0
    again = caneflow("add", "gateway")
    listed = caneflow("list")

    assert (again.returncode, again.stderr) == (2, "caneflow keys: keys/gateway.crt: is there; --anew makes another\n")
    assert re.search(r"^gateway  machine  holds until \d{4}-\d\d-\d\d \(\d+ days\)$", listed.stdout, re.MULTILINE)


@pytest.mark.parametrize("name", ["Gateway", "../phone", "", "observer", "ca"])
def test_a_name_that_no_machine_may_have_gets_no_key(keys: Path, name: str) -> None:
    with pytest.raises(DataflowError, match=r"not a valid name|is taken"):
        make_certificate(keys, name)


def test_an_authority_is_not_replaced(keys: Path) -> None:
    with pytest.raises(DataflowError, match="would make every existing key invalid"):
        make_authority(keys)


def test_a_key_that_others_may_read_is_refused(keys: Path, tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    shutil.copytree(keys, folder)
    (folder / "phone.key").chmod(0o640)

    with pytest.raises(DataflowError, match="others may read it"):
        credentials(folder, "phone")


# --- rules -----------------------------------------------------------------------------------------------------------


def test_a_machine_may_send_what_its_nodes_write_and_others_read(tmp_path: Path) -> None:
    file = tmp_path / "flow.yaml"
    file.write_text(spread_cane("cane", machines(), SPLIT))
    deployment = deploy(load(file), machine="gateway")
    assert deployment.site is not None
    from_gateway = machine_grants(deployment, deployment.site, "gateway", "phone")
    from_phone = machine_grants(deployment, deployment.site, "phone", "gateway")

    samples = {word: [key for key in from_gateway[word] if "@" not in key] for word in ("put", "declare_subscriber")}
    assert samples == {"put": ["cane/ground_speed/speed", "cane/imu/imu"], "declare_subscriber": []}
    assert [key for key in from_phone["put"] if "@" not in key] == []  # nobody there reads a pose
    assert {"cane/@/start", "cane/@/end", "cane/@/window"} <= set(from_gateway["put"])
    assert not {"cane/@/start", "cane/@/end", "cane/@/window", "cane/@/late"} & set(from_phone["put"])
    assert from_phone["query"][:2] == ["cane/@/history/ground_speed/speed", "cane/@/history/imu/imu"]
    assert "cane/@/ready/fusion" in from_phone["liveliness_token"]
    assert "cane/@/ready/imu" not in from_phone["liveliness_token"]


def test_a_machine_that_records_may_read_every_stream(tmp_path: Path) -> None:
    file = tmp_path / "flow.yaml"
    file.write_text(spread_cane("cane", machines().replace("gateway: {", "gateway: {records: true, "), SPLIT))
    deployment = deploy(load(file), machine="gateway")
    assert deployment.site is not None
    from_phone = machine_grants(deployment, deployment.site, "phone", "gateway")

    assert "cane/fusion/pose" in from_phone["put"]
    assert "cane/@/late" in from_phone["put"]


@pytest.mark.parametrize("records", [False, True])
@pytest.mark.parametrize("name", ["dataflow.yaml", *(f"dataflows/{path.name}" for path in DATAFLOWS.glob("*.yaml"))])
def test_past_samples_are_granted_where_the_samples_are(name: str, records: bool, tmp_path: Path) -> None:
    yaml = YAML(typ="safe", pure=True)
    graph = yaml.load(DATAFLOWS.parent / name)
    graph["machines"] = {
        "gateway": {"listen": ["tcp/127.0.0.1:7447"], "records": records},
        "phone": {"connect": ["tcp/127.0.0.1:7447"]},
    }
    for node, machine in zip(graph["nodes"].values(), cycle(graph["machines"])):
        node["machine"] = machine
        node.pop("process", None)  # runs on one machine
    file = tmp_path / "flow.yaml"
    yaml.dump(graph, file)
    deployment = deploy(load(file), machine="gateway")
    site = deployment.site
    assert site is not None

    for writer, reader in (("gateway", "phone"), ("phone", "gateway")):
        gives, takes = (machine_grants(deployment, site, *ends) for ends in ((writer, reader), (reader, writer)))
        history = control_key(deployment.flow, "history")
        past = {control_key(deployment.flow, "history", *stream_of(key)) for key in gives["put"] if "@" not in key}
        assert past, "the machines share wires"
        for granted in (gives["reply"], gives["declare_queryable"], takes["query"]):
            assert {key for key in granted if key.startswith(history)} == past


@pytest.mark.parametrize(("links", "own", "observed"), [("unix", ["unixsock-stream"], True), ("tcp", ["tcp"], False)])
def test_within_a_machine_all_is_allowed_by_its_own_links_and_reading_by_others(
    tmp_path: Path, links: str, own: list[str], observed: bool
) -> None:
    file = tmp_path / "flow.yaml"
    file.write_text(spread_cane("cane", machines(), SPLIT, more=f"links: {links}\n"))
    deployment = deploy(load(file), machine="gateway")
    assert deployment.site is not None
    control = access_control(deployment, deployment.site)
    by_link = {tuple(each["link_protocols"]): each["id"] for each in control["subjects"] if "link_protocols" in each}
    allowed = {
        (policy["subjects"][0], flow, message)
        for policy in control["policies"]
        for rule in control["rules"]
        if rule["id"] in policy["rules"]
        for flow in rule["flows"]
        for message in rule["messages"]
    }

    assert {("ingress", "put"), ("egress", "put"), ("ingress", "reply")} <= {
        (flow, message) for who, flow, message in allowed if who == by_link[tuple(own)]
    }
    assert (("tcp",) in by_link and links == "unix") == observed
    if observed:
        may_say = {message for who, flow, message in allowed if who == by_link["tcp",] and flow == "ingress"}
        assert may_say == {"declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"}


def broken(change: Callable[[dict[str, Any]], None], tmp_path: Path) -> dict[str, Any]:
    file = tmp_path / "flow.yaml"
    file.write_text(spread_cane("cane", machines(), SPLIT))
    deployment = deploy(load(file), machine="gateway")
    assert deployment.site is not None
    control = access_control(deployment, deployment.site)
    check_access_control(control)
    change(control)
    return control


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda control: control["policies"][1]["rules"].append("nothing"), "names 'nothing'; no such rule"),
        (lambda control: control["policies"][1]["subjects"].append("nobody"), "names 'nobody'; no such subject"),
        (lambda control: control["rules"][0]["messages"].append("shout"), "names the message 'shout'"),
        (lambda control: control["rules"].append(control["rules"][0]), "two rules have one id"),
        (lambda control: control.update(default_permission="allow"), "does not deny"),
        (lambda control: control["subjects"].append({"id": "all"}), "'all' would be everybody"),
    ],
)
def test_rules_that_zenoh_would_take_and_not_keep_are_refused(
    change: Callable[[dict[str, Any]], None], said: str, tmp_path: Path
) -> None:
    control = broken(change, tmp_path)

    with pytest.raises(DataflowError, match=said):
        check_access_control(control)


# --- what is refused before anything starts ----------------------------------------------------------------------


def test_nothing_listens_beyond_this_computer_without_keys(tmp_path: Path) -> None:
    file = tmp_path / "flow.yaml"
    file.write_text(spread_cane("cane", machines(host="0.0.0.0"), SPLIT))  # noqa: S104 - is refused

    done = caneflow_here("run", file, "--machine", "gateway")

    assert done.returncode == 2
    assert "gateway: no keys for tcp/0.0.0.0:7447 in" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_machines_in_the_clear_are_a_warning(tmp_path: Path) -> None:
    file = tmp_path / "flow.yaml"
    file.write_text(spread_cane("cane", machines(host="10.0.0.1"), SPLIT, more="insecure: true\n"))

    (warning,) = examine(file)[1]

    assert "machines talk in the clear" in str(warning)


def test_recording_with_keys_has_to_be_allowed(tmp_path: Path, keys: Path) -> None:
    file = tmp_path / "flow.yaml"
    file.write_text(spread_cane("cane", machines(free_port()), SPLIT))

    done = caneflow_here("run", file, "--machine", "gateway", "--keys", keys, "--record", tmp_path / "out.mcap")

    assert done.returncode == 2
    assert "gateway may not read every stream; write machines.gateway.records" in done.stderr


# --- attempts --------------------------------------------------------------------------------------------------------


class Target:
    """A gateway that waits for its phone: its door is open to those with the right key."""

    def __init__(self, flow: str, launched: Launched, port: int, keys: Path) -> None:
        self.flow = flow
        self.launched = launched
        self.address = f"tls/127.0.0.1:{port}"
        self.keys = keys
        wait_for(
            lambda: [each for each in running_flows() if each.pid == launched.process.pid], "the gateway's address"
        )
        self.inside = next(each for each in running_flows() if each.pid == launched.process.pid).endpoint

    def local(self) -> zenoh.Session:
        """As the gateway's own nodes and tools are."""
        return open_session(mode="client", connect=[self.inside])

    def session(self, name: str | None, keys: Path | None = None) -> zenoh.Session:
        """With the certificate of `name`; raises DataflowError when there is no link."""
        tls: dict[str, Any] = {
            "root_ca_certificate": str(self.keys / "ca.crt"),
            "enable_mtls": name is not None,
            "verify_name_on_connect": False,
        }
        if name is not None:
            folder = keys or self.keys
            tls |= {
                "connect_certificate": str(folder / f"{name}.crt"),
                "connect_private_key": str(folder / f"{name}.key"),
            }
        return open_session(mode="client", connect=[self.address], more={"transport/link/tls": tls})


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory, keys: Path) -> Iterator[Target]:
    folder, flow, port = tmp_path_factory.mktemp("target"), f"sec{time.time_ns()}", free_port()
    file = folder / "flow.yaml"
    file.write_text(spread_cane(flow, machines(port), SPLIT))
    with launchers() as launch:
        launched = launch("run", file, "--machine", "gateway", "--keys", keys, log=folder / "gateway.log")
        launched.wait_for("waits for phone")
        yield Target(flow, launched, port, keys)


class Heard:
    """What a session hears from others on some keys."""

    def __init__(self, session: zenoh.Session, *keys: str) -> None:
        self.keys: list[str] = []

        def note(sample: zenoh.Sample) -> None:
            self.keys.append(str(sample.key_expr))

        handler = zenoh.handlers.Callback(note, indirect=False)
        others = zenoh.Locality.REMOTE
        self._held = [session.declare_subscriber(key, handler, allowed_origin=others) for key in keys]

    def wait_for(self, key: str) -> list[str]:
        wait_for(lambda: key in self.keys, f"{key} among {self.keys}")
        return self.keys


REFUSED = (
    r"no Zenoh session on tls/[\d.:]+: nobody answers there, or one side refuses the other's certificate; `caneflow"
)
SAMPLE = numbered(Imu(stamp=1, gyro=(0.0, 0.0, 0.0)), 0)


def say_until(condition: Callable[[], object], *puts: Callable[[], None]) -> None:
    """Publish again and again, since a fresh subscription takes a moment, until `condition`."""
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, "nothing came, not even what is allowed"
        for put in puts:
            put()
        time.sleep(0.05)


def test_without_a_certificate_nothing_connects(target: Target) -> None:
    with pytest.raises(DataflowError, match=REFUSED):
        target.session(None)


def test_with_a_certificate_of_another_authority_nothing_connects(target: Target, foreign: Path) -> None:
    with pytest.raises(DataflowError, match=REFUSED):
        target.session("phone", foreign)


def test_in_the_clear_nothing_connects(target: Target) -> None:
    with pytest.raises(DataflowError, match="no Zenoh session"):
        open_session(mode="client", connect=[target.address.replace("tls/", "tcp/")])


def test_a_machine_reads_what_its_nodes_read_and_nothing_else(target: Target) -> None:
    imu, frame = sample_key(target.flow, "imu", "imu"), sample_key(target.flow, "radar", "frame")
    with target.session("phone") as phone, target.local() as inside:
        heard = Heard(phone, imu, frame, f"{target.flow}/radar/*", f"{target.flow}/**", "**")
        say_until(lambda: heard.keys.count(imu) > 3, lambda: inside.put(frame, SAMPLE), lambda: inside.put(imu, SAMPLE))

        assert set(heard.keys) == {imu}


def test_a_machine_writes_what_is_its_own_and_nothing_else(target: Target) -> None:
    flow = target.flow
    own = control_key(flow, "counters", "fusion")
    forbidden = [
        sample_key(flow, "imu", "imu"),
        sample_key(flow, "radar", "frame"),
        sample_key(flow, "ground_speed", "speed"),
        *(control_key(flow, word) for word in ("start", "end", "window", "late")),
        *(control_key(flow, word, "imu") for word in ("progress", "marks", "counters")),
        control_key(flow, "failed", "gateway"),
    ]
    with target.session("phone") as phone, target.local() as inside:
        heard = Heard(inside, f"{flow}/**", control_key(flow, "**"))
        attempts = [lambda key=key: phone.put(key, SAMPLE) for key in (*forbidden, own)]
        say_until(lambda: heard.keys.count(own) > 3, *attempts)

        assert set(heard.keys) == {own}


def test_a_machine_does_not_speak_for_another_ones_nodes(target: Target) -> None:
    flow = target.flow
    with target.session("phone") as phone, target.local() as inside:
        # The tokens by which the leader knows that a node is ready, and answers to those who ask for samples again.
        own = phone.liveliness().declare_token(control_key(flow, "ready", "fusion"))
        false = phone.liveliness().declare_token(control_key(flow, "ready", "imu"))
        tokens = control_key(flow, "ready", "*")
        seen: set[str] = set()

        def look() -> bool:
            seen.update(str(reply.ok.key_expr) for reply in inside.liveliness().get(tokens, timeout=1.0) if reply.ok)
            return control_key(flow, "ready", "fusion") in seen

        wait_for(look, "the phone's own token")
        look()
        del own, false  # an undeclared token is one that no variable holds
        assert seen == {control_key(flow, "ready", "fusion")}
        list(phone.get(control_key(flow, "status"), timeout=60.0))  # a round trip: the ends of the tokens have come
        assert "zenoh" not in target.launched.said, "what Zenoh says of a token that it does not know is no news"


def test_past_samples_are_sent_for_wired_ports_only(target: Target) -> None:
    asked: list[str] = []

    def history(node: str, port: str) -> str:
        return control_key(target.flow, "history", node, port)

    def answer(query: zenoh.Query) -> None:
        asked.append(str(query.key_expr))
        with query:
            query.reply(query.key_expr, SAMPLE)

    handler = zenoh.handlers.Callback(answer, indirect=False)
    wired = [history("imu", "imu"), history("ground_speed", "speed")]
    unwired = [history("radar", "frame"), history("ground_speed", "other"), history("imu", "*"), history("*", "*")]
    with (
        target.session("phone") as phone,
        target.session("laptop") as laptop,
        target.local() as nodes,
        target.local() as inside,
    ):
        held = [nodes.declare_queryable(key, handler) for key in (*wired, *unwired[:2])]
        held.append(phone.declare_queryable(history("fusion", "pose"), handler))  # which nobody on the gateway reads

        def answers(session: zenoh.Session, key: str) -> int:
            others = zenoh.Locality.REMOTE
            replies = session.get(key, timeout=1.0, target=zenoh.QueryTarget.ALL, allowed_destination=others)
            return sum(reply.ok is not None for reply in replies)

        wait_for(lambda: all(answers(phone, key) for key in wired), "what the phone's nodes may ask")
        wait_for(lambda: [answers(inside, key) for key in unwired[:2]] == [1, 1], "what is there")
        asked.clear()
        assert [answers(phone, key) for key in unwired] == [0] * 4
        assert [answers(laptop, key) for key in (*wired, *unwired)] == [0] * 6
        assert answers(inside, history("fusion", "pose")) == 0
        assert asked == [], "nor do questions get there"
        del held


def test_a_machine_that_the_flow_does_not_know_neither_reads_nor_writes(target: Target) -> None:
    imu = sample_key(target.flow, "imu", "imu")
    own = control_key(target.flow, "counters", "fusion")
    with target.session("stranger") as stranger, target.session("phone") as phone, target.local() as inside:
        read, written = Heard(stranger, imu, "**"), Heard(inside, control_key(target.flow, "**"), f"{target.flow}/**")
        known = Heard(phone, imu)
        say_until(
            lambda: known.keys.count(imu) > 3 and written.keys.count(own) > 3,
            lambda: stranger.put(own.replace("fusion", "stranger"), SAMPLE),
            lambda: stranger.put(sample_key(target.flow, "fusion", "pose"), SAMPLE),
            lambda: phone.put(own, SAMPLE),
            lambda: inside.put(imu, SAMPLE),
        )

        assert read.keys == []
        assert set(written.keys) == {own}


def test_an_observer_reads_everything_and_writes_nothing(target: Target) -> None:
    flow = target.flow
    frame, own = sample_key(flow, "radar", "frame"), control_key(flow, "counters", "fusion")
    everything = (f"{flow}/**", control_key(flow, "**"))
    with target.session("laptop") as laptop, target.session("phone") as phone, target.local() as inside:
        read, written = Heard(laptop, *everything), Heard(inside, *everything)
        say_until(
            lambda: read.keys.count(frame) > 3 and written.keys.count(own) > 3,
            lambda: laptop.put(sample_key(flow, "imu", "imu"), SAMPLE),
            lambda: laptop.put(control_key(flow, "end"), SAMPLE),
            lambda: inside.put(frame, SAMPLE),
            lambda: phone.put(own, SAMPLE),
        )
        status = [reply.ok for reply in laptop.get(control_key(flow, "status"), timeout=60.0) if reply.ok]

        assert set(read.keys) == {frame, own}
        assert set(written.keys) == {own}
        assert len(status) == 1, "a tool is answered"


@pytest.mark.long
def test_a_listener_with_another_name_is_named_and_not_believed(keys: Path, tmp_path: Path) -> None:
    flow, port = f"sec{time.time_ns()}", free_port()
    file = tmp_path / "flow.yaml"
    file.write_text(spread_cane(flow, machines(port), SPLIT))
    own = {"certificate": str(keys / "stranger.crt"), "private_key": str(keys / "stranger.key")}
    tls = {"root_ca_certificate": str(keys / "ca.crt"), "enable_mtls": True} | {
        f"{side}_{what}": path for side in ("listen", "connect") for what, path in own.items()
    }
    with (
        open_session(mode="router", listen=[f"tls/127.0.0.1:{port}"], more={"transport/link/tls": tls}) as false,
        launchers() as launch,
    ):
        launched = launch("run", file, "--machine", "phone", "--keys", keys, log=tmp_path / "phone.log")
        launched.wait_for("there is a link with stranger, by its certificate")
        with Target(flow, launched, port, keys).local() as inside:
            heard = Heard(inside, f"{flow}/**", control_key(flow, "**"))
            for _ in range(20):
                false.put(sample_key(flow, "imu", "imu"), SAMPLE)
                false.put(control_key(flow, "end"), SAMPLE)
                list(inside.get(control_key(flow, "status"), timeout=1.0))  # a round trip: time for it to come

        assert heard.keys == []
        assert launched.process.poll() is None
