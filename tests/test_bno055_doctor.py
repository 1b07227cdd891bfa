"""`caneflow doctor --devices` where something is wrong: what is said, and what is advised."""

import json
import os
import socket
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from caneflow.device_checks import p440
from caneflow.protocols import mrm
from tools import doctor

FLOW = """
flow: doctored
nodes:
  {node}
results: [{result}]
"""


@pytest.fixture
def look(tmp_path: Path) -> Any:
    """Runs the command on one node; its findings and the exit status."""

    def run(node: str, result: str, *options: str) -> tuple[list[dict[str, Any]], int]:
        file = tmp_path / "flow.yaml"
        file.write_text(FLOW.format(node=node, result=result))
        app = typer.Typer()
        app.command()(doctor.command)
        said = CliRunner().invoke(app, [str(file), "--devices", "--json", *options])
        return json.loads(said.output), said.exit_code

    return run


@pytest.fixture
def terminal() -> Iterator[str]:
    """A serial port at which nobody listens."""
    ends = os.openpty()
    tty.setraw(ends[1])
    yield os.ttyname(ends[1])
    for end in ends:
        os.close(end)


def imu(port: str, **settings: object) -> str:
    more = "".join(f", {key}: {value}" for key, value in settings.items())
    return f"imu: {{run: drivers.bno055, settings: {{port: {port}{more}}}}}"


def test_a_port_that_is_not_there(look: Any) -> None:
    (finding,), status = look(imu("/nowhere/serial0"), "imu/imu")
    assert status == 1
    assert finding["text"] == "/nowhere/serial0 is not there"
    assert "raspi-config" in finding["attempts"][0]
    assert "--set imu.port=" in finding["attempts"][1]


def test_a_bus_that_is_not_there(look: Any) -> None:
    (finding,), _ = look(imu("/dev/i2c-77", bus="i2c"), "imu/imu")
    assert "switch I2C on" in finding["attempts"][0]


def test_a_port_that_may_not_be_opened(look: Any, terminal: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, *_, **__: Path(path) != Path(terminal))
    (finding,), status = look(imu(terminal), "imu/imu")
    assert status == 1
    assert "may not be opened by" in finding["text"]
    assert any(f"usermod -aG {Path(terminal).group()} " in attempt for attempt in finding["attempts"])


def test_a_port_at_which_nobody_answers(look: Any, terminal: str) -> None:
    (finding,), status = look(imu(terminal), "imu/imu")
    assert status == 1
    assert finding["text"].startswith(f"no BNO055 on {terminal}: ")
    assert "cross the wires" in finding["attempts"][0]
    assert "PS1 high, PS0 low" in finding["attempts"][1]


def test_a_port_that_another_program_holds(look: Any, terminal: str) -> None:
    import serial

    with serial.Serial(terminal, exclusive=True):
        (finding,), _ = look(imu(terminal), "imu/imu")
    holder, otherwise = finding["attempts"]
    assert f"(process {os.getpid()}) holds it: end that" in holder
    assert otherwise == "end the flow that uses it: it holds the port alone"


def test_a_file_that_is_no_port(look: Any, tmp_path: Path) -> None:
    (tmp_path / "tty").write_text("")
    (finding,), _ = look(imu(str(tmp_path / "tty")), "imu/imu")
    assert finding["attempts"] == [f"is {tmp_path / 'tty'} the right one?"]


@pytest.fixture
def udp() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        yield made


def radar(port: int) -> str:
    return f"radar: {{run: drivers.p440, settings: {{host: 127.0.0.1, port: {port}}}}}"


def test_a_host_without_a_radar(look: Any, udp: socket.socket) -> None:
    port = udp.getsockname()[1]
    udp.close()
    (finding,), status = look(radar(port), "radar/frame")
    assert status == 1
    assert "--set radar.host=" in finding["attempts"][0]


def test_a_radar_whose_answers_do_not_come(look: Any, udp: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(p440, "ANSWER_TIME", 0.02)
    port = udp.getsockname()[1]
    (finding,), _ = look(radar(port), "radar/frame")
    assert finding["text"] == f"no P440 at 127.0.0.1, UDP port {port}: no answer, asked 4 times"
    assert finding["attempts"][-1].endswith(f"sudo ufw allow proto udp from 127.0.0.1 port {port}")
    udp.setblocking(False)
    asked = [mrm.parse(udp.recv(100)) for _ in range(4)]
    assert all(isinstance(request, mrm.GetStatusRequest) for request in asked)


def test_options_of_the_devices_need_devices(look: Any, tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(doctor.command)
    assert "add --devices" in str(CliRunner().invoke(app, ["--set", "imu.rate=50"]).exception)
