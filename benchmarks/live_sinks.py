"""What it costs to show a live cane to ROS 2 and to Foxglove: CPU a sample, and what a client misses.

    python -m benchmarks.live_sinks WALK.mcap [--rounds 3] [--seconds 10]

A cane at 100 Hz (IMU, radar, ground speed, `best`) with `tools.ros2` and `tools.foxglove` as nodes, both wired to all
four streams. In turn nobody listens; a client of each takes every topic; both clients are stopped (SIGSTOP), as dead as
a client can be without saying so. The clients speak the protocols alone. The cost is that of the sink's process over
the samples that come to it. Prints one JSON object a round.
"""

import argparse
import contextlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

from benchmarks.canes import WARM_UP, EndedByItselfError, graph, running, wait_until_ready
from benchmarks.measuring import family
from caneflow.recording import Recording

STREAMS = {"imu": "imu/imu", "frame": "radar/frame", "speed": "ground_speed/speed", "pose": "fusion/pose"}
RATE = 100.0  # Hz, of each
SINKS = """
  ros2: {{ run: tools.ros2, inputs: {{ {inputs} }}, settings: {{ listen: tcp/127.0.0.1:{ros2}, domain: 7 }} }}
  foxglove: {{ run: tools.foxglove, inputs: {{ {inputs} }}, settings: {{ port: {foxglove} }} }}
results:"""
TOPICS = {"ros2": "fusion/pose/odom", "foxglove": "/fusion/pose/odom"}  # one message a sample: what is counted


def main() -> None:
    """Run the rounds, print what came of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("walk", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=10.0, help="s that are measured of each")
    parser.add_argument("--client", choices=CLIENTS, help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.client:
        CLIENTS[options.client](options.port)
        return
    for _ in range(options.rounds):
        print(json.dumps(measured(options.walk, options.seconds)), flush=True)


def measured(walk: Path, seconds: float) -> dict[str, Any]:
    """One flow: unheard, heard, with dead clients."""
    ports = {"ros2": free_port(), "foxglove": free_port()}
    inputs = ", ".join(f"{port}: {stream}" for port, stream in STREAMS.items())
    text = graph(walk, "best").replace("results:", SINKS.format(inputs=inputs, **ports).lstrip())
    text = text.replace("\nros2:", "\n  ros2:")
    found: dict[str, Any] = {"cpu_us_a_sample": {}}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with running(folder, text, 1) as (launcher,):
            wait_until_ready(folder, 1)
            time.sleep(WARM_UP)
            sinks = {each.name(): each for each in family(launcher) if each.name() in ports}
            found["cpu_us_a_sample"]["unheard"] = cost(sinks, seconds)
            with clients(ports) as started:
                time.sleep(2.0)
                found["cpu_us_a_sample"]["heard"] = cost(sinks, seconds)
                heard = {each: json.loads(said(client)) for each, client in started.items()}
                for client in started.values():
                    client.send_signal(signal.SIGSTOP)
                begun = time.time_ns()
                found["cpu_us_a_sample"]["dead clients"] = cost(sinks, seconds)
                ended = time.time_ns()
        poses = recorded_poses(folder / "cane_0.mcap")
    found["lost_by_client"] = {each: missing(poses, stamps) for each, stamps in heard.items()}
    within = [stamp for stamp in poses if begun < stamp < ended]
    found["poses_a_second_with_dead_clients"] = round(len(within) / (ended - begun) * 1e9, 2)
    return found


def cost(sinks: dict[str, psutil.Process], seconds: float) -> dict[str, float]:
    """CPU of each sink over the samples that came to it meanwhile, us."""
    before, begun = {each: cpu_s(process) for each, process in sinks.items()}, time.monotonic()
    time.sleep(seconds)
    samples = len(STREAMS) * RATE * (time.monotonic() - begun)
    return {each: round((cpu_s(process) - before[each]) / samples * 1e6, 1) for each, process in sinks.items()}


def cpu_s(process: psutil.Process) -> float:
    """User and system time of a process, s."""
    times = process.cpu_times()
    return float(times.user + times.system)


def recorded_poses(path: Path) -> list[int]:
    """Stamps of the poses."""
    with Recording(path) as recording:
        return [sample.stamp for sample in recording.samples([("fusion", "pose")])]


def missing(poses: list[int], heard: list[int]) -> int:
    """How many poses between the first and the last that a client heard it did not hear."""
    if not heard:
        return len(poses)
    return len({each for each in poses if heard[0] <= each <= heard[-1]} - set(heard))


@contextlib.contextmanager
def clients(ports: dict[str, int]) -> Iterator[dict[str, "subprocess.Popen[str]"]]:
    """A process for each client."""
    command = [sys.executable, "-m", "benchmarks.live_sinks", "none"]
    started = {
        each: subprocess.Popen(
            [*command, "--client", each, "--port", str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for each, port in ports.items()
    }
    try:
        yield started
    finally:
        for client in started.values():
            client.kill()
            client.wait()


def said(client: "subprocess.Popen[str]") -> str:
    """What a client answers to a line: the stamps of the poses that it has heard."""
    assert client.stdin is not None and client.stdout is not None
    client.stdin.write("what did you hear?\n")
    client.stdin.flush()
    return client.stdout.readline()


def hear_ros2(port: int) -> None:
    """A client that takes every topic by rmw_zenoh's keys; answers each line with the stamps of the poses."""
    import zenoh

    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    stamps: list[int] = []
    count = Counter[str]()

    def take(sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        count[key] += 1
        if key.startswith(f"7/{TOPICS['ros2']}/"):  # CDR: a header of 4 bytes, then the stamp of the message's header
            seconds, nanoseconds = struct.unpack_from("<iI", sample.payload.to_bytes(), 4)
            stamps.append(seconds * 1_000_000_000 + nanoseconds)

    with zenoh.open(config) as session:
        session.declare_subscriber("7/**", take)
        answer(stamps)


def hear_foxglove(port: int) -> None:
    """A viewer that shows every topic; answers each line with the stamps of the poses."""
    import threading

    from websockets.sync.client import connect

    stamps: list[int] = []
    topics: dict[int, str] = {}
    with connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None) as viewer:  # type: ignore[list-item]

        def read() -> None:
            for message in viewer:
                if isinstance(message, str):
                    words = json.loads(message)
                    if words["op"] == "advertise":
                        topics.update({each["id"]: each["topic"] for each in words["channels"]})
                        ids = [{"id": each["id"], "channelId": each["id"]} for each in words["channels"]]
                        viewer.send(json.dumps({"op": "subscribe", "subscriptions": ids}))
                elif message[0] == 1:
                    channel, _ = struct.unpack_from("<IQ", message, 1)
                    if topics[channel] == TOPICS["foxglove"]:
                        seconds, nanoseconds = struct.unpack_from("<iI", message, 13 + 4)
                        stamps.append(seconds * 1_000_000_000 + nanoseconds)

        threading.Thread(target=read, daemon=True).start()
        answer(stamps)


def answer(stamps: list[int]) -> None:
    """Say what was heard, whenever someone asks."""
    for _ in sys.stdin:
        print(json.dumps(stamps), flush=True)
    os._exit(0)


def free_port() -> int:
    """A port of loopback that nobody has."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


CLIENTS = {"ros2": hear_ros2, "foxglove": hear_foxglove}

if __name__ == "__main__":
    try:
        main()
    except EndedByItselfError as error:
        sys.exit(f"live_sinks: {error}")
