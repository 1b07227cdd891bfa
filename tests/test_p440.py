"""The P440 driver in virtual time, face to face with the emulated radar; its links over real sockets and ports."""

import itertools
import logging
import math
import os
import pty
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from annotated_types import Le
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.messages import RadarFrame, decode, numbered
from caneflow.messages.rig import read_rig
from caneflow.protocols import mrm
from caneflow.protocols.mrm_emulator import Faults, Moment, RadarEmulator, moments_of_log
from caneflow.protocols.mrm_logs import parse_log
from caneflow.protocols.mrm_scans import Scan, ScanAssembler, range_start, range_step, split_scan
from caneflow.protocols.mrm_serial import SerialDeframer, framed
from caneflow.runtime import Context, Quiet
from caneflow.runtime.errors import DataflowError
from drivers.p440 import P440, Clock, Framing, Link, P440Settings, SerialLink, UdpLink

LOGS = Path(__file__).parents[1].parent / "shared" / "data" / "p440-udp-loss"
CONFIG = mrm.RadarConfig(node_id=9, scan_start_ps=9998, scan_stop_ps=39295)
EPOCH = 1_700_000_000 * 10**9  # ns
SECOND = 10**9  # ns
DELAY = 300_000  # ns on the way, each way
BOOTED = 1_000_000.0  # s of the virtual clock


class Ended(BaseException):
    """What SIGTERM raises in a source, wherever it is."""


class World(Clock):
    """A clock that goes on only when someone waits."""

    def __init__(self) -> None:
        self.time = round(BOOTED * SECOND)  # ns

    def now(self) -> int:
        return self.time

    def epoch(self, instant: int) -> int:
        return EPOCH + instant - round(BOOTED * SECOND)

    def sleep(self, seconds: float) -> None:
        self.time += round(seconds * SECOND)


class VirtualLink(Link):
    """A link to an emulated radar; `calls` counts what was asked of it, `end_at` ends the world at that call."""

    def __init__(self, world: World, radar: RadarEmulator) -> None:
        self._world = world
        self._radar = radar
        self._coming: deque[tuple[int, bytes]] = deque()  # when, what
        self.end_at: int | None = None
        self.calls = 0

    def send(self, message: bytes) -> None:
        self._count()
        self._post(self._radar.receive(message, self._world.time / SECOND))

    def receive(self, timeout: float) -> bytes | None:
        self._count()
        world, deadline = self._world, self._world.time + max(round(timeout * SECOND), 1)
        while True:
            self._post(self._radar.send_due(world.time / SECOND))
            if self._coming and self._coming[0][0] <= world.time:
                return self._coming.popleft()[1]
            if world.time >= deadline:
                return None
            due = self._radar.next_due(world.time / SECOND)
            times = [deadline, *(time for time, _ in list(self._coming)[:1])]
            if due is not None:
                times.append(round(due * SECOND) + 1)
            world.time = max(min(times), world.time + 1)

    def close(self) -> None:
        pass

    def _post(self, messages: list[bytes]) -> None:
        self._coming += [(self._world.time + DELAY, message) for message in messages]

    def _count(self) -> None:
        self.calls += 1
        if self.end_at is not None and self.calls >= self.end_at:
            self.end_at = None
            raise Ended


class VirtualP440(P440):
    """The driver in a virtual world."""

    def __init__(self, link: Link, world: World, **options: object) -> None:
        self.link = link
        self.world = world
        context = Context(node="radar", rig=read_rig({}), ports={"frame": RadarFrame}, random=np.random.default_rng(0))
        super().__init__(P440Settings(**options), context)  # type: ignore[arg-type]

    def make_clock(self) -> Clock:
        return self.world

    def open_link(self) -> Link:
        return self.link


def scan(number: int, *, samples: int = 480, period_ms: float = 10.0, boot_ms: float = 0.0) -> Scan:
    return Scan(
        source_id=9,
        message_id=number % 2**16,
        timestamp_ms=int(boot_ms + period_ms * number) % 2**32,
        scan_start_ps=9998,
        scan_stop_ps=39295,
        scan_step_bins=32,
        scan_type=1,
        antenna_id=1,
        operation_mode=1,
        samples=np.random.default_rng(number).integers(-(10**6), 10**6, samples, dtype=np.int32),
    )


def test_a_scan_from_where_no_radar_scans_is_left_out_and_counted() -> None:
    """A radar can be told to begin at -499 998 to 499 998 ps; a header that says 2^31 is damaged."""
    framing = Framing(P440Settings(), World())
    damaged = [replace(scan(number), scan_start_ps=start) for number, start in ((20, 2**31 - 1), (21, -600_000))]
    scans = [scan(number) for number in range(20)] + damaged + [scan(number) for number in range(22, 40)]
    frames = [frame for one in scans for frame in framing.frames(one, one.timestamp_ms * 1_000_000)]
    assert framing.unfit == 2
    assert len(frames) == 38
    assert len({frame.range_start for frame in frames}) == 1


def moments(scans: list[Scan], period: float = 0.01) -> Iterator[Moment]:
    for number, one in enumerate(scans):
        yield Moment(period * number, tuple(mrm.build(packet) for packet in split_scan(one)))


class Desk:
    """An emulated radar and a driver, and what the driver brought."""

    def __init__(
        self,
        scans: Iterator[Moment],
        *,
        faults: Faults | None = None,
        driver: dict[str, object] | None = None,
        **options: object,
    ) -> None:
        self.world = World()
        self.radar = RadarEmulator(
            scans,
            config=CONFIG,
            random=np.random.default_rng(4),
            faults=faults,
            **options,  # type: ignore[arg-type]
        )
        self.link = VirtualLink(self.world, self.radar)
        self.driver = VirtualP440(self.link, self.world, **(driver or {}))
        self.frames: list[RadarFrame] = []
        self.times: list[float] = []  # s since the world began, at which the frames came
        self.quiet_until = -1

    def run(self, until: Callable[[], bool] | None = None) -> "Desk":
        """Run the driver until the recording is over and no frame has come for a while, or `until` is true."""
        brought = self.driver.samples()
        over_at = None
        for item in brought:
            if isinstance(item, Quiet):
                self.quiet_until = item.until
            else:
                self._take(*item)
            if self.radar.over and over_at is None:
                over_at = self.world.time
            if until() if until else over_at is not None and isinstance(item, Quiet):
                break
        brought.close()
        return self

    def _take(self, port: str, frame: object) -> None:
        assert port == "frame"
        assert isinstance(frame, RadarFrame)
        assert frame.stamp > (self.frames[-1].stamp if self.frames else 0)
        assert frame.stamp > self.quiet_until
        assert frame.stamp <= self.world.epoch(self.world.time)
        self.frames.append(frame)
        self.times.append((self.world.time - BOOTED * SECOND) / SECOND)

    @property
    def samples(self) -> list[np.ndarray]:
        return [frame.scans[0] for frame in self.frames]


def same(a: list[np.ndarray], b: list[np.ndarray]) -> bool:
    return len(a) == len(b) and all(map(np.array_equal, a, b))


@pytest.mark.parametrize("boot_ms", [0, 2**32 - 2500], ids=["", "clock wraps"])
def test_every_scan_becomes_a_frame(boot_ms: int) -> None:
    scans = [scan(number, boot_ms=boot_ms) for number in range(500)]
    desk = Desk(moments(scans)).run()
    assert same(desk.samples, [s.samples for s in scans])
    first = desk.frames[0]
    assert first.scans.dtype == np.int32
    assert (first.scan_period, first.carrier, first.bandwidth) == (0.01, 4.3e9, 1.7e9)
    assert (first.range_start, first.range_step) == (range_start(9998), range_step())
    steps = np.diff([frame.stamp for frame in desk.frames])
    assert np.abs(steps - 10_000_000).max() < 50_000  # ns
    assert not desk.radar.scanning


def test_with_loss_the_complete_scans_go_on_and_the_others_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    scans = [scan(number) for number in range(1500)]
    with caplog.at_level(logging.INFO):
        desk = Desk(moments(scans), faults=Faults(loss=0.02)).run()
    by_first_sample = {s.samples[0]: s for s in scans}
    assert all(np.array_equal(got, by_first_sample[got[0]].samples) for got in desk.samples), "no mixtures"
    came = [by_first_sample[got[0]].message_id for got in desk.samples]
    assert came == sorted(came)
    missing = 1500 - len(came)
    assert missing == pytest.approx(1500 * 0.04, rel=0.4)
    lost = int(caplog.records[-1].getMessage().split()[1])
    edges = came[0] + 1499 - came[-1]  # before the first and after the last frame, nobody can tell
    assert lost == missing - edges
    assert max(np.diff(desk.times)) < 0.08, "the frames go on"


@pytest.mark.parametrize("samples", [288, 480])
def test_reordered_and_doubled_packets_lose_nothing(samples: int) -> None:
    scans = [scan(number, samples=samples) for number in range(1000)]
    desk = Desk(moments(scans), faults=Faults(reorder=0.1, duplicate=0.1)).run()
    assert desk.radar.counts.reordered > 80
    assert same(desk.samples, [s.samples for s in scans])
    lags = np.array(desk.times) - np.array([(f.stamp - EPOCH) / SECOND for f in desk.frames])
    assert lags.max() < 0.055
    assert np.abs(np.diff([f.stamp for f in desk.frames]) - 10_000_000).max() < 200_000  # ns


@pytest.mark.parametrize("name", ["test_scan2.txt", "test_scan711_1000.txt"])
def test_recorded_packets_give_the_frames_of_the_importer(name: str) -> None:
    if not (LOGS / name).exists():
        pytest.skip("the recorded packets are not here")
    data = (LOGS / name).read_bytes()
    parsed = parse_log(data)
    _, played = moments_of_log(data)
    desk = Desk(played, driver={"scan_period_us": 0}).run()
    assert same(desk.samples, [s.samples for s in parsed.scans])
    assert {f.range_start for f in desk.frames} == {parsed.scans[0].range_start()}
    (period,) = {f.scan_period for f in desk.frames}
    assert period == pytest.approx(0.0215 if "2.txt" in name else 0.02057, rel=3e-3)
    elapsed = [s.timestamp_ms - parsed.scans[0].timestamp_ms for s in parsed.scans]
    stamped = [(f.stamp - desk.frames[0].stamp) / 1e6 for f in desk.frames]
    assert stamped == pytest.approx(elapsed, abs=2.0)


def test_a_radar_slower_than_asked_is_found_out(caplog: pytest.LogCaptureFixture) -> None:
    scans = [scan(number, period_ms=17.28) for number in range(200)]
    desk = Desk(moments(scans, 0.01728)).run()
    assert [f.scan_period for f in desk.frames[-100:]] == pytest.approx([0.01728] * 100, rel=5e-3)
    assert len({f.scan_period for f in desk.frames}) == 2, "what depends on the period begins again once"
    assert "scans every 17.2" in caplog.text
    assert "asked for every 10 ms" in caplog.text
    assert "lost" not in caplog.text


def test_a_silent_radar_is_started_anew(caplog: pytest.LogCaptureFixture) -> None:
    scans = [scan(number) for number in range(400)]
    desk = Desk(moments(scans), faults=Faults(freezes=((2.0, math.inf),))).run()
    gap = max(np.diff([f.stamp for f in desk.frames])) / SECOND
    assert 0.5 < gap < 1.1
    assert len(desk.frames) == pytest.approx(400 - 100 * gap, abs=2)
    assert caplog.text.count("no scan for 0.5 s; asking on") == 2  # the freeze, and the end


def test_an_unplugged_radar_is_back_within_a_second_of_its_return(caplog: pytest.LogCaptureFixture) -> None:
    scans = [scan(number) for number in range(800)]
    desk = Desk(moments(scans), faults=Faults(unplugs=((2.0, 3.0),))).run()
    begin = desk.times[0]
    assert 3.0 < max(np.diff(desk.times)) < 4.0
    assert max(np.diff([f.stamp for f in desk.frames])) / SECOND > 3.0, "the gap is visible"
    assert desk.times[-1] - begin > 7.9
    assert len(caplog.records) == 3, "silent, gone, and silent at the end"


def test_a_radar_that_may_be_silent_for_long_is_said_to_be_so_twice_a_second() -> None:
    desk = Desk(moments([scan(number) for number in range(20)]), driver={"silence_s": 30.0})
    times: list[int] = []
    for item in desk.driver.samples():
        if desk.radar.over and isinstance(item, Quiet):
            times.append(desk.world.time)
            if len(times) == 20:
                break
    assert max(b - a for a, b in itertools.pairwise(times)) <= 0.6 * SECOND
    assert times[-1] - times[0] < 20 * SECOND, "it is not given up"


def test_an_absent_radar_is_asked_on_and_time_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    world = World()
    link = UnpluggedLink(world)
    brought = VirtualP440(link, world).samples()
    quiet = [item for item, _ in zip(brought, range(40), strict=False)]
    assert all(isinstance(item, Quiet) for item in quiet)
    assert max(b.until - a.until for a, b in itertools.pairwise(quiet)) <= SECOND  # type: ignore[union-attr]
    assert [r.getMessage() for r in caplog.records] == [
        "radar: radar at 192.168.1.100, UDP port 21210: no answer within 0.25 s; asking on",
        "radar: radar at 192.168.1.100, UDP port 21210: Network is unreachable; asking on",
    ]
    brought.close()


def test_scans_of_one_packet_come_out_in_order_from_the_first_on() -> None:
    """Where nothing of a scan has come, only the rhythm tells that it is missing."""
    packets = [split_scan(scan(number, samples=96))[0] for number in (1, 0, 3, 2, 6, 5, 4, 7, 9, 10, 11, 12, 13, 8)]
    assembler = ScanAssembler(patience_ms=40, period_ms=10)
    out = [[s.message_id for s in assembler.feed(packet)] for packet in packets]
    assert [number for numbers in out for number in numbers] == [0, 1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13]
    assert out[-2] == [9, 10, 11, 12, 13], "8 is given up"
    assert out[-1] == []
    assert assembler.counts.late_packets == 1


class UnpluggedLink(Link):
    """Silence, and after a while not even a network."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._sent = 0

    def send(self, message: bytes) -> None:
        self._sent += 1
        if self._sent > 20:
            raise OSError(101, "Network is unreachable")

    def receive(self, timeout: float) -> bytes | None:
        self._world.sleep(timeout)
        return None

    def close(self) -> None:
        pass


@pytest.mark.parametrize("end_at", [*range(1, 25), 30, 41, 60, 99])
def test_ended_anywhere_it_leaves_the_radar_stopped(end_at: int) -> None:
    desk = Desk(moments([scan(number) for number in range(100)]))
    desk.link.end_at = end_at
    with pytest.raises(Ended):
        desk.run()
    assert not desk.radar.scanning


class FailingLink(VirtualLink):
    """A network that fails for a while, under a radar that scans on; when it is back the flow has just been ended."""

    fails_at = round((BOOTED + 1.0) * SECOND)
    failing = True

    def send(self, message: bytes) -> None:
        if self.failing and self._world.time >= self.fails_at:  # the stop, after a long silence
            self.failing = False
            raise Ended
        super().send(message)

    def receive(self, timeout: float) -> bytes | None:
        if self.failing and self._world.time >= self.fails_at:
            self._world.sleep(timeout)
            return None
        return super().receive(timeout)


def test_ended_while_it_stops_the_radar_it_still_does() -> None:
    world = World()
    radar = RadarEmulator(moments([scan(n) for n in range(300)]), config=CONFIG, random=np.random.default_rng(1))
    with pytest.raises(Ended):
        deque(VirtualP440(FailingLink(world, radar), world).samples(), maxlen=0)
    assert world.time >= FailingLink.fails_at
    assert not radar.scanning
    assert not radar.over


def test_closed_at_a_frame_it_leaves_the_radar_stopped_in_spite_of_loss() -> None:
    for cut in range(1, 40, 3):
        desk = Desk(moments([scan(number) for number in range(200)]), faults=Faults(loss=0.3))
        desk.run(lambda desk=desk, cut=cut: len(desk.frames) >= cut)  # type: ignore[misc]  # bound now
        assert not desk.radar.scanning


def test_a_radar_that_was_left_scanning_is_stopped_first() -> None:
    desk = Desk(moments([scan(number) for number in range(300)]))
    desk.radar.receive(
        mrm.build(mrm.ControlRequest(message_id=77, scan_count=mrm.SCAN_COUNT_FOREVER)), desk.world.time / SECOND
    )
    desk.run(lambda: len(desk.frames) == 100)
    number = round((desk.frames[0].stamp - EPOCH) / SECOND / 0.01)
    assert number > 5, "what it saw before is dropped"
    assert same(desk.samples, [scan(n).samples for n in range(number, number + 100)])


@pytest.mark.parametrize("options", [{"confirms_stop": False}, {"mode": 0}, {"sleep": 3}])
def test_radars_that_keep_silent_sleep_or_do_something_else(options: dict[str, Any]) -> None:
    desk = Desk(moments([scan(number) for number in range(100)]), **options).run()
    assert len(desk.frames) == 100
    assert not desk.radar.scanning


class Taciturn(RadarEmulator):
    """Starts to scan, and its word that it does gets lost on the way."""

    def _control(self, number: int, count: int, now: float) -> mrm.Message | None:
        said = super()._control(number, count, now)
        return None if count else said


def test_scans_that_come_while_the_start_is_not_confirmed_are_stamped_as_they_came() -> None:
    desk = Desk(iter(()))
    desk.radar = Taciturn(
        moments([scan(number) for number in range(200)]), config=CONFIG, random=np.random.default_rng(4)
    )
    desk.link._radar = desk.radar
    desk.run()
    assert len(desk.frames) == 200
    begun = desk.frames[-1].stamp - 199 * 10_000_000
    late = [frame.stamp - begun - 10_000_000 * number for number, frame in enumerate(desk.frames)]
    assert max(map(abs, late)) < 2_000_000, "ns; an answer is waited for 250 ms"


class Stubborn(RadarEmulator):
    """Refuses every configuration."""

    def _set(self, config: mrm.RadarConfig) -> int:
        return mrm.STATUS_UNSUPPORTED


def test_refused_settings_end_the_driver_with_the_reason() -> None:
    world = World()
    radar = Stubborn(moments([scan(0)]), config=CONFIG, random=np.random.default_rng(0))
    with pytest.raises(DataflowError, match=r"radar: the radar at 192.* refuses its settings: unsupported value"):
        next(VirtualP440(VirtualLink(world, radar), world).samples())


def test_the_read_back_is_told_and_what_differs_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        Desk(moments([scan(number) for number in range(5)])).run()
    assert "scans 9998 to 39295 ps, integration index 11, code channel 6, gain 63, antenna mode 2" in caplog.text
    assert "instead of" not in caplog.text
    Desk(moments([scan(number) for number in range(5)]), driver={"scan_start_ps": 12_000}).run()
    assert "took a window of 9998 to 39295 ps instead of 12000 to 39297 ps" in caplog.text


class HostileLink(VirtualLink):
    """Says other things in between, then ends."""

    def __init__(self, world: World, radar: RadarEmulator, said: list[bytes]) -> None:
        super().__init__(world, radar)
        self._said = said
        self._turn = 0

    def receive(self, timeout: float) -> bytes | None:
        self._turn += 1
        if self._turn % 3 == 0:
            if not self._said:
                raise Ended
            return self._said.pop()
        return super().receive(timeout)


def garbled(draw: st.DrawFn) -> bytes:
    """A packet of a scan with some of its header's bytes changed."""
    packet = bytearray(mrm.build(split_scan(scan(draw(st.integers(0, 20)), samples=100))[0]))
    for at, value in draw(st.lists(st.tuples(st.integers(0, 51), st.integers(0, 255)), max_size=6)):
        packet[at] = value
    return bytes(packet)


HOSTILE = st.lists(
    st.one_of(
        st.binary(max_size=80),
        st.builds(
            lambda code, tail: code.to_bytes(2) + tail,
            st.sampled_from([0x1101, 0x1102, 0x1103, 0xF101, 0xF201, 0xF202]),
            st.binary(max_size=80),
        ),
        st.composite(garbled)(),
    ),
    max_size=60,
)


@settings(deadline=None, max_examples=60)  # a busy machine is not a failure
@given(HOSTILE)
def test_no_bytes_upset_the_driver(said: list[bytes]) -> None:
    world = World()
    radar = RadarEmulator(moments([scan(n) for n in range(30)]), config=CONFIG, random=np.random.default_rng(1))
    driver = VirtualP440(HostileLink(world, radar, said), world)
    with pytest.raises(Ended):
        for seq, item in enumerate(driver.samples()):
            if not isinstance(item, Quiet):
                _, frame = item
                assert isinstance(frame, RadarFrame)
                assert decode(numbered(frame, seq), RadarFrame).stamp == frame.stamp


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="the scan stops after it starts"):
        P440Settings(scan_start_ps=10_000, scan_stop_ps=10_000)
    with pytest.raises(ValueError, match="silent as long"):
        P440Settings(scan_period_us=400_000)
    assert Le(63) in P440Settings.__annotations__["transmit_gain"].__metadata__


def test_a_udp_link_hears_nobody_but_the_radar() -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radar,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        radar.bind(("127.0.0.1", 0))
        link = UdpLink("localhost", radar.getsockname()[1])
        link.send(b"who is there")
        message, driver = radar.recvfrom(100)
        assert message == b"who is there"
        stranger.sendto(b"me", driver)
        radar.sendto(b"the radar", driver)
        assert link.receive(5.0) == b"the radar"
        assert link.receive(0.0) is None
        link.close()


@pytest.mark.parametrize("crc", [False, True], ids=["usb", "uart"])
def test_a_serial_link_carries_a_dialogue(crc: bool) -> None:
    master, slave = pty.openpty()
    radar = RadarEmulator(moments([scan(0)]), config=CONFIG, random=np.random.default_rng(1))

    def answer() -> None:
        deframer = SerialDeframer(crc=crc)
        for _ in range(2):
            for request in deframer.feed(os.read(master, 4096)):
                for message in radar.receive(request, 0.0):
                    os.write(master, b"noise" + framed(message, crc=crc))

    thread = threading.Thread(target=answer)
    thread.start()
    link = SerialLink(os.ttyname(slave), crc=crc)
    try:
        for number in (1, 2):
            link.send(mrm.build(mrm.GetConfigRequest(message_id=number)))
            answered = link.receive(5.0)
            assert answered is not None
            assert mrm.parse(answered) == mrm.GetConfigConfirm(message_id=number, config=CONFIG, timestamp_ms=0)
        assert link.receive(0.01) is None
    finally:
        link.close()
        thread.join()
        os.close(master)
        os.close(slave)


def test_a_serial_port_that_is_not_there_is_an_absent_radar(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No such file"):
        SerialLink(str(tmp_path / "ttyACM0"), crc=False)
