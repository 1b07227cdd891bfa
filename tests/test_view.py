"""The view's half that needs no browser: what the page is told, who is let in, and that a slow page costs nothing."""

import asyncio
import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest

from caneflow.messages import Cue, GroundSpeed, Imu, Obstacles, Pose, RadarFrame, Sample, numbered, sample_key
from caneflow.messages.rig import Rig
from caneflow.physics import SPEED_OF_LIGHT
from caneflow.recording import RecordingWriter
from caneflow.viewing import live
from caneflow.viewing.columns import COLUMNS, ellipse, row_of
from caneflow.viewing.live import LiveStreams
from caneflow.viewing.radar_picture import DRAWN_COLUMNS, SCANS, TRANSFORM, RadarWindow
from caneflow.viewing.recorded import RecordedStreams

BORESIGHT = (0.0, 1.0, 0.0)
CARRIER, BANDWIDTH, PERIOD, STEP = 4.3e9, 1.7e9, 0.01, 0.009149


def pose(seq: int, *, covariance: bool = True) -> Pose:
    return Pose(
        stamp=1_000_000_000 + 10_000_000 * seq,
        seq=seq,
        position=(0.1 * seq, -0.2 * seq, 0.0),
        velocity=(0.5, 0.0, 0.0),
        orientation=(math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)),
        method="kalman",
        covariance=np.diag([0.04, 0.01, 1.0, 1.0, 1.0, 1.0]) if covariance else None,
    )


def told(packet: bytes | None) -> dict[str, Any]:
    """What a page reads of a packet, by an independent reader."""
    assert packet is not None
    unpacked: dict[str, Any] = msgpack.unpackb(packet)
    return unpacked


def numbers(raw: bytes) -> list[float]:
    return list(struct.unpack(f"<{len(raw) // 8}d", raw))


# --- columns ------------------------------------------------------------------------------------------------------


def test_the_ellipse_is_that_of_the_covariance() -> None:
    turn, sigma = 0.3, np.array([0.5, 0.1])
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = rotation @ np.diag(sigma**2) @ rotation.T
    assert ellipse(covariance) == pytest.approx((1.0, 0.2, 0.3))


def test_a_position_without_covariance_has_no_ellipse() -> None:
    assert all(map(math.isnan, ellipse(None)))


def test_yaw_is_that_of_the_boresight() -> None:
    row = dict(zip(COLUMNS[Pose], row_of(pose(0), BORESIGHT), strict=True))
    assert abs(row["yaw"]) == pytest.approx(math.pi)  # y_b points along y0, then turned by 90 degrees


@pytest.mark.parametrize(
    "message",
    [
        pose(3),
        Imu(stamp=1, seq=0, gyro=(0.1, -0.2, 0.3), accel=(1.0, 2.0, 9.81), orientation=(1.0, 0.0, 0.0, 0.0)),
        Imu(stamp=1, seq=0, gyro=(0.1, -0.2, 0.3)),
        GroundSpeed(stamp=1, seq=0, speed=0.7, quality=math.inf, rays=3, valid=False),
    ],
)
def test_a_row_begins_with_the_numbers_of_the_wire(message: Sample) -> None:
    row = row_of(message, BORESIGHT)
    assert len(row) == len(COLUMNS[type(message)])
    first = {Pose: "position", Imu: "gyro", GroundSpeed: "speed"}[type(message)]
    value = getattr(message, first)
    assert row[: np.size(value)] == (value if isinstance(value, tuple) else (value,))


# --- a running flow -----------------------------------------------------------------------------------------------


def test_every_sample_is_told_once_as_it_was_sent() -> None:
    streams = LiveStreams(flow="cane", rig=Rig())
    batches = []
    for seq in range(50):
        streams.take("fusion/pose", pose(seq), received=10**18)
        if seq % 7 == 0:
            batches.append(told(streams.batch()))
    batches.append(told(streams.batch()))

    parts = [batch["streams"]["fusion/pose"] for batch in batches if batch["streams"]]
    rows = [number for part in parts for number in numbers(part["rows"])]
    x = rows[:: len(COLUMNS[Pose])]
    assert x == [pose(seq).position[0] for seq in range(50)]
    assert [time for part in parts for time in numbers(part["times"])] == pytest.approx(np.arange(50) * 0.01)
    assert parts[1]["first_seq"] == 1
    assert parts[0]["columns"] == list(COLUMNS[Pose])
    assert batches[0]["origin"] == 1.0


def test_a_page_that_comes_later_is_told_what_was_before_and_nothing_twice() -> None:
    streams = LiveStreams(flow="cane", rig=Rig())
    for seq in range(20):
        streams.take("fusion/pose", pose(seq), received=0)
    streams.batch()
    streams.take("fusion/pose", pose(20), received=0)

    (before,) = (told(packet) for packet in streams.so_far())
    after = told(streams.batch())

    times = numbers(before["streams"]["fusion/pose"]["times"]) + numbers(after["streams"]["fusion/pose"]["times"])
    assert times == pytest.approx(np.arange(21) * 0.01)
    assert before["streams"]["fusion/pose"]["first_seq"] == 0


def test_gaps_are_counted() -> None:
    streams = LiveStreams(flow="cane", rig=Rig())
    for seq in (5, 6, 9, 10):
        streams.take("fusion/pose", pose(seq), received=0)
    assert told(streams.batch())["traffic"]["fusion/pose"]["gaps"] == 2


def test_what_is_kept_is_bounded_and_what_is_left_out_counted() -> None:
    streams = LiveStreams(flow="cane", rig=Rig())
    for seq in range(live.MOST_PENDING + 10):
        streams.take("fusion/pose", pose(seq, covariance=False), received=0)
    batch = told(streams.batch())
    assert len(numbers(batch["streams"]["fusion/pose"]["times"])) == live.MOST_PENDING
    assert batch["traffic"]["fusion/pose"]["left_out"] == 10


def test_the_age_of_a_replayed_sample_is_not_known() -> None:
    streams = LiveStreams(flow="cane", rig=Rig(), live=False)
    streams.take("fusion/pose", pose(0), received=10**18)
    assert told(streams.batch())["traffic"]["fusion/pose"]["age_p50"] is None
    assert told(streams.hello())["source"] == "replay"


# --- the map ------------------------------------------------------------------------------------------------------


def echo(speed: float, distance: float) -> list[RadarFrame]:
    """Complex scans of one target at `distance` m with the Doppler of `speed` m/s, in noise."""
    rng = np.random.default_rng(5)
    frames = []
    ranges = 0.3 + STEP * np.arange(300)
    for scan in range(SCANS):
        at = distance - speed * scan * PERIOD
        pulse = np.exp(-(((ranges - distance) / 0.05) ** 2)) * np.exp(-4j * np.pi * at * CARRIER / SPEED_OF_LIGHT)
        noise = 0.01 * (rng.normal(size=300) + 1j * rng.normal(size=300))
        frames.append(
            RadarFrame(
                stamp=scan, seq=scan, scans=(pulse + noise)[None].astype(np.complex64), scan_period=PERIOD,
                range_start=0.3, range_step=STEP, carrier=CARRIER, bandwidth=BANDWIDTH,
            )
        )  # fmt: skip
    return frames


def test_the_map_shows_a_target_where_it_is() -> None:
    window = RadarWindow()
    assert window.picture() is None
    for frame in echo(speed=0.6, distance=1.8):
        window.take(frame)
    picture = window.picture()
    assert picture is not None
    distance, speed, level = picture.strongest
    column = 2 * picture.speed_limit / DRAWN_COLUMNS
    assert distance == pytest.approx(1.8, abs=0.04)
    assert speed == pytest.approx(0.6, abs=column)
    assert level > 20
    assert picture.levels.shape[1] == DRAWN_COLUMNS
    row = round((distance - picture.range_start) / picture.range_step)
    cell = 2 * picture.speed_limit / SCANS
    assert picture.edges[row] == pytest.approx(0.6, abs=0.25 * cell)
    assert np.isnan(picture.edges[-1])  # noise has no edge


def test_a_running_flow_gives_its_map_beside_the_samples() -> None:
    streams = LiveStreams(flow="cane", rig=Rig())
    for frame in echo(0.6, 1.8):
        streams.take("radar/frame", frame, received=0)
    assert "pictures" not in told(streams.batch())
    (picture,) = told(streams.picture())["pictures"]
    assert picture["stream"] == "radar/frame"
    assert picture["time"] == pytest.approx((SCANS - 1) * 1e-9)
    assert picture["strongest"][0] == pytest.approx(1.8, abs=0.04)
    assert streams.picture() is None, "not yet time for another"


def test_scans_that_come_while_a_map_is_made_are_not_in_it() -> None:
    window = RadarWindow()
    first, *frames = echo(0.6, 1.8)
    for frame in frames:
        window.take(frame)
    before = window.copy()
    window.take(first)
    assert before.picture() is None
    assert window.picture() is not None


def test_a_radar_of_another_make_begins_anew() -> None:
    window = RadarWindow()
    for frame in echo(0.6, 1.8):
        window.take(frame)
    window.take(msgspec.structs.replace(frame, scans=np.zeros((1, 64), np.complex64)))
    assert window.picture() is None


def test_the_window_fits_the_transform() -> None:
    assert TRANSFORM % DRAWN_COLUMNS == 0


# --- a recording --------------------------------------------------------------------------------------------------


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "some.mcap"
    with RecordingWriter(path, flow="cane", source="simulated", rig={}) as writer:
        for frame in echo(0.6, 1.8):
            frame = msgspec.structs.replace(frame, stamp=1_000_000_000 + 10_000_000 * frame.seq)
            _write(writer, "radar", "frame", frame)
        for seq in range(SCANS):
            _write(writer, "fusion", "pose", pose(seq))
    return path


def _write(writer: RecordingWriter, node: str, port: str, message: Sample) -> None:
    payload = numbered(message, message.seq)
    key = sample_key("cane", node, port)
    writer.write(key, type(message), payload, stamp=message.stamp, seq=message.seq, log_time=message.stamp)


def test_a_recording_is_told_whole_and_answers_for_any_instant(recording: Path) -> None:
    with RecordedStreams(recording) as streams:
        streams.read()
        packets = packets_of(streams)
        answer = told(streams.answer({"at": 0.455}))
        later = told(streams.answer({"at": 0.63}))
    x = [
        number
        for packet in packets
        if "fusion/pose" in packet.get("streams", {})
        for number in numbers(packet["streams"]["fusion/pose"]["rows"])[:: len(COLUMNS[Pose])]
    ]
    assert x == [pose(seq).position[0] for seq in range(SCANS)]
    assert packets[-1] == {"kind": "read", "problem": ""}
    assert answer["values"]["fusion/pose"]["seq"] == 45
    assert numbers(answer["values"]["fusion/pose"]["row"])[:2] == [pose(45).position[0], pose(45).position[1]]
    assert answer["pictures"] == []  # too few scans yet
    assert later["pictures"][0]["stream"] == "radar/frame"


def packets_of(streams: RecordedStreams) -> list[dict[str, Any]]:
    packets = []
    while (packet := streams.batch(watched=True)) is not None:
        packets.append(told(packet))
    assert [told(packet) for packet in streams.so_far()] == packets, "a page that comes later is told the same"
    return packets


@pytest.mark.parametrize("request_", [{}, {"at": "x"}, {"at": math.nan}, {"at": None}])
def test_a_question_that_makes_no_sense_has_no_answer(recording: Path, request_: dict[str, Any]) -> None:
    with RecordedStreams(recording) as streams:
        assert streams.answer(request_) is None


# --- the server ---------------------------------------------------------------------------------------------------


@pytest.fixture
def served() -> Iterator[tuple[LiveStreams, Any]]:
    server = pytest.importorskip("caneflow.viewing.server", reason="the extra `view` is not installed here")
    streams = LiveStreams(flow="cane", rig=Rig())
    with server.PageServer(streams) as page:
        yield streams, page


def answered(port: int, request: str) -> bytes:
    async def ask() -> bytes:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(request.encode())
        answer = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 10)
        writer.close()
        return answer

    return asyncio.run(ask())


def upgrade(page: Any, *, key: str | None = None, origin: str | None = None, host: str | None = None) -> str:
    here = f"127.0.0.1:{page.port}"
    key = page.address.partition("#")[2] if key is None else key
    return (
        f"GET /samples?key={key} HTTP/1.1\r\nHost: {host or here}\r\nOrigin: {origin or f'http://{here}'}\r\n"
        "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    )


def test_the_page_lets_nothing_in_from_outside(served: tuple[LiveStreams, Any]) -> None:
    _, page = served
    head = answered(page.port, f"GET / HTTP/1.1\r\nHost: localhost:{page.port}\r\n\r\n").decode().lower()
    assert head.startswith("http/1.1 200")
    assert "default-src 'none'" in head
    assert "unsafe" not in head
    assert "cache-control: no-store" in head


@pytest.mark.parametrize(
    "path",
    [
        "/../server.py",
        "/%2e%2e/server.py",
        "/%2e%2e%2fserver.js",
        "/nothing.js",
        "/uplot-LICENSE.txt/..",
        "/.html",
        "//index.html",
        "/%00.js",
        "/%ff.js",
        pytest.param("/" + 5_000 * "a", id="longer than a file's name may be"),
        pytest.param("/" + 5_000 * "a" + ".js", id="the same of a known kind"),
        pytest.param("/" + 3_000 * "%41" + ".html", id="the same in escapes"),
        pytest.param("/" + 3_000 * "a/" + "x.js", id="deeper than a path may be"),
    ],
)
def test_only_the_files_of_the_page_are_served(served: tuple[LiveStreams, Any], path: str) -> None:
    head = answered(served[1].port, f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 404")


def test_who_has_the_key_and_is_this_page_is_let_in(served: tuple[LiveStreams, Any]) -> None:
    assert answered(served[1].port, upgrade(served[1])).startswith(b"HTTP/1.1 101")


def test_nothing_is_compressed_for_a_page_on_the_same_machine(served: tuple[LiveStreams, Any]) -> None:
    offer = "Sec-WebSocket-Extensions: permessage-deflate\r\n\r\n"
    answer = answered(served[1].port, upgrade(served[1]).removesuffix("\r\n") + offer)
    assert answer.startswith(b"HTTP/1.1 101")
    assert b"permessage-deflate" not in answer


@pytest.mark.parametrize(
    "wrong",
    [
        {"key": "guess"},
        {"key": ""},
        {"key": "%00%ff"},
        {"origin": "http://evil.example"},
        {"origin": "http://["},
        {"host": "evil.example"},
        {"host": "["},
        {"host": "[localhost]"},
    ],
)
def test_others_are_not(served: tuple[LiveStreams, Any], wrong: dict[str, str]) -> None:
    assert answered(served[1].port, upgrade(served[1], **wrong)).startswith(b"HTTP/1.1 403")


@pytest.mark.parametrize("host", ["evil.example", "[", "[localhost]", "]"])
def test_a_name_that_is_not_this_machines_is_refused(served: tuple[LiveStreams, Any], host: str) -> None:
    head = answered(served[1].port, f"GET / HTTP/1.1\r\nHost: {host}:{served[1].port}\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 403")


def test_a_page_that_does_not_read_misses_the_oldest_and_is_told() -> None:
    server = pytest.importorskip("caneflow.viewing.server", reason="the extra `view` is not installed here")

    async def read() -> list[bytes]:
        client = server._Client(lossless=False)
        for number in range(server.MOST_WAITING + 5):
            client.offer(bytes([number]))
        return [await client.next() for _ in range(server.MOST_WAITING + 1)]

    first, *rest = asyncio.run(read())
    assert told(first) == {"kind": "skipped", "batches": 5}
    assert rest == [bytes([number]) for number in range(5, server.MOST_WAITING + 5)]


class Torrent:
    """Batches of 1 MB, far more than any socket holds."""

    lossless = False

    def __init__(self) -> None:
        self.given = 0

    def hello(self) -> bytes:
        return b""

    def so_far(self) -> list[bytes]:
        return []

    def batch(self, *, watched: bool) -> bytes:
        self.given += watched
        return bytes(2**20)

    def picture(self) -> None: ...

    def answer(self, request: dict[str, Any]) -> None: ...


def test_a_page_that_is_frozen_holds_up_nobody_and_nothing_piles_up() -> None:
    server = pytest.importorskip("caneflow.viewing.server", reason="the extra `view` is not installed here")
    torrent = Torrent()

    async def freeze(page: Any) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", page.port)
        writer.write(upgrade(page).encode())
        assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 101")
        while torrent.given < 3 * server.MOST_WAITING:  # reads nothing any more
            await asyncio.sleep(server.BEAT)
        (client,) = page._clients
        assert client._skipped > server.MOST_WAITING
        assert len(client._waiting) == server.MOST_WAITING
        writer.transport.abort()

    with server.PageServer(torrent) as page:
        asyncio.run(asyncio.wait_for(freeze(page), 30))


def test_the_page_asks_for_nothing_from_elsewhere() -> None:
    page = Path(live.__file__).parent / "page"
    for file in page.iterdir():
        if file.suffix in (".html", ".css") or (file.suffix == ".js" and file.stem != "uplot"):
            text = file.read_text()
            assert "https://" not in text, file
            assert "http://" not in text, file
    assert json.dumps((page / "uplot-LICENSE.txt").read_text()).count("Leon Sorokin") == 1


def test_obstacles_and_cues_keep_their_numbers() -> None:
    nearest, known = np.zeros((3, 4), np.float32), np.ones((3, 4), np.float32)
    nearest[1, 2], known[0, 3] = 2.5, 0.125
    obstacles = Obstacles(stamp=1, heading=0.5, walking=True, nearest=nearest, known=known)
    row = dict(zip(COLUMNS[Obstacles], row_of(obstacles, BORESIGHT), strict=True))
    assert (row["heading"], row["walking"]) == (0.5, 1.0)
    assert {name: value for name, value in row.items() if value == 2.5} == {"ahead_head": 2.5}
    assert row["known_left_drop"] == 0.125
    cue = Cue(stamp=1, kind="obstacle", level="head", distance=2.5, azimuth=0.1, urgency=0.2, since=1)
    assert row_of(cue, BORESIGHT) == (1.0, 2.0, 2.5, 0.1, 0.2)
    kind, *rest = row_of(Cue(stamp=1, kind="blind", reason="pose: no sample", since=1), BORESIGHT)
    assert kind == 3.0
    assert all(math.isnan(each) for each in rest)
