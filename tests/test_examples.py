"""The examples do what their first lines say: an operator with a message of its own, and a driver."""

import itertools
import json
import socket
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from caneflow.command import main
from caneflow.messages import SAMPLES, GroundSpeed, Imu, MessageError, decode, encode, with_number
from caneflow.recording import Recording
from caneflow.testing import run_operator, run_source

EXAMPLES = Path(__file__).parent.parent / "examples"
sys.path.insert(0, str(EXAMPLES))

from distance import FARTHEST, Distance  # noqa: E402 - examples are files of a user's own, in no package
from distance_walked import DistanceWalked  # noqa: E402
from udp_imu import UdpImu, sample  # noqa: E402

del SAMPLES[Distance.schema]  # for all tests of caneflow's own messages, which this import comes before


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """The example's message is one while its own tests run."""
    monkeypatch.setitem(SAMPLES, Distance.schema, Distance)


def speed(stamp: float, value: float, *, valid: bool = True) -> GroundSpeed:
    """`value` m/s at `stamp` s."""
    return GroundSpeed(stamp=int(stamp * 1e9), speed=value, quality=0.1, rays=3, valid=valid)


def walked(speeds: list[GroundSpeed]) -> list[Distance]:
    """What the operator makes of them."""
    made = run_operator(DistanceWalked, {"speed": speeds})["distance"]
    return [each for each in made if isinstance(each, Distance)]


def test_the_message_comes_back_as_it_was_and_refuses_what_cannot_be() -> None:
    sent = with_number(Distance(stamp=1, distance=12.5, unseen=0.0), 0)
    assert decode(encode(sent), Distance) == sent
    with pytest.raises((MessageError, ValueError)):
        Distance(stamp=1, distance=2 * FARTHEST, unseen=0.0)


def test_the_distance_of_a_ramp_is_that_of_the_formula() -> None:
    """Speed t from 0 to 2 s: t^2 / 2, which the trapezoidal rule has exactly."""
    ramp = [speed(1 + t, t) for t in np.linspace(0, 2, 21)]
    assert [each.distance for each in walked(ramp)] == pytest.approx([(m.stamp / 1e9 - 1) ** 2 / 2 for m in ramp])


def test_what_was_not_seen_is_said_and_not_taken_for_standing() -> None:
    given = [speed(1, 1), speed(2, 1), speed(3, 0, valid=False), speed(4, 1), speed(5, 1)]
    assert [(each.distance, each.unseen) for each in walked(given)] == [(0, 0), (1, 0), (1, 1), (1, 2), (2, 2)]


def test_the_flow_runs_on_a_walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    walk, out = tmp_path / "walk.mcap", tmp_path / "out.mcap"
    for line in (
        f"simulate walk --duration 6 -o {walk}",
        f"run {EXAMPLES / 'distance.yaml'} --replay {walk} --in-process --record {out}",
    ):
        monkeypatch.setattr(sys, "argv", ["caneflow", *line.split()])
        with pytest.raises(SystemExit) as end:
            main()
        assert not end.value.code
    with Recording(out) as recording:
        speeds = [decode(each.payload, GroundSpeed) for each in recording.samples([("ground_speed", "speed")])]
        (*_, last) = recording.samples([("walked", "distance")])
    seen = sum(
        (b.stamp - a.stamp) / 1e9 * (abs(a.speed) + abs(b.speed)) / 2
        for a, b in itertools.pairwise(speeds)
        if a.valid and b.valid
    )
    assert decode(last.payload, Distance).distance == pytest.approx(seen)
    assert seen > 1.0


def test_the_driver_brings_what_is_sent_and_leaves_out_what_is_no_reading() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    readings = [{"gyro": [0, 0, n / 10], "accel": [0, 0, 9.8]} for n in range(5)]
    ended = threading.Event()

    def send() -> None:
        """Again and again until the driver has what it waits for: it may not listen yet."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not ended.wait(0.05):
                for each in (b"no JSON", *(json.dumps(reading).encode() for reading in readings)):
                    sender.sendto(each, ("127.0.0.1", port))

    sending = threading.Thread(target=send)
    sending.start()
    try:
        brought = run_source(UdpImu, 5, settings={"port": port})
    finally:
        ended.set()
        sending.join()
    samples = [each for _, each in brought if isinstance(each, Imu)]
    assert [name for name, _ in brought] == ["imu"] * 5
    assert {each.gyro[2] for each in samples} <= {n / 10 for n in range(5)}
    assert all(a.stamp < b.stamp for a, b in itertools.pairwise(samples))


@pytest.mark.parametrize(
    "datagram", [b"", b"{}", b'{"gyro": [0, 0], "accel": [0, 0, 9.8]}', b'{"gyro": [1e9, 0, 0], "accel": [0, 0, 0]}']
)
def test_a_datagram_that_no_imu_would_send_is_no_sample(datagram: bytes) -> None:
    assert sample(datagram, 1) is None
