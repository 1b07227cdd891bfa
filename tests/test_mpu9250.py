"""The MPU-9250: its registers by the data sheets, and its driver against an emulated chip on an emulated bus.

The bus is put in the place of smbus2's transfer, the one seam to the hardware; its clock goes on only when the driver
waits or talks. In a whole flow: test_mpu9250_flow.py.
"""

import logging
import math
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import pairwise, takewhile
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.messages import Imu
from caneflow.messages.rig import Rig
from caneflow.protocols import mpu9250
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mounting import mounting
from caneflow.protocols.mpu9250 import Scales, aligned, burst, measurement
from caneflow.protocols.mpu9250_chip import Setup
from caneflow.protocols.mpu9250_emulator import ADJUSTMENT, Bench, Emulator, Faults, Motion
from caneflow.runtime import Context, Quiet
from caneflow.runtime.dataflow.programs import validated_settings
from caneflow.runtime.errors import DataflowError
from drivers import mpu9250 as driver

EPOCH = 1_700_000_000_000_000_000  # ns, when the bench's clock began
SCALES = Scales.of(1000, 8, ADJUSTMENT)
Item = tuple[float, Imu | None]  # s on the bench's clock; None for a Quiet


# --- registers ---------------------------------------------------------------------------------------------------


def test_scales_are_the_data_sheets() -> None:
    """250 deg/s: 131 LSB; 2 g: 16384 LSB; 16 bits of 0.15 uT, 4912 uT being 32760 (PS 3.1 to 3.3)."""
    scales = Scales.of(250, 2, b"\x80\x80\x80")
    assert math.radians(1.0) / scales.gyro == pytest.approx(131, rel=1e-3)
    assert 9.80665 / scales.accel == 16384
    assert scales.mag == pytest.approx((0.15, 0.15, 0.15))
    assert 32760 * scales.mag[0] == pytest.approx(4912, rel=1e-3)
    assert Scales.of(2000, 16, b"\x80\x80\x80").gyro == pytest.approx(math.radians(1.0) / 16.4, rel=1e-3)
    assert 9.80665 / Scales.of(2000, 16, b"\x80\x80\x80").accel == 2048


def test_adjustment_of_the_magnetometer() -> None:
    """H (1 + (ASA - 128) 0.5 / 128): 0x80 is 1, 0x00 a half, 0xFF almost 1.5 (AK 8.3.11)."""
    assert Scales.of(250, 2, b"\x00\x80\xff").mag == pytest.approx((0.075, 0.15, 0.15 * (1 + 127 / 256)))
    with pytest.raises(ProtocolError, match="2 bytes of adjustment"):
        Scales.of(250, 2, b"\x80\x80")


def test_a_burst_lies_where_the_register_map_says() -> None:
    """Gyro and acceleration high byte first, the field low byte first, the second die's x and y changed (PS 9.1)."""
    data = bytes.fromhex("00 01 00 01 4000 C000 0001 0D05 0100 FFFF 7FFF 01 0A00 1400 1E00 10")
    said = measurement(data, Scales(gyro=1.0, accel=1.0, mag=(1.0, 1.0, 1.0)))
    assert said.accel == (16384, -16384, 1)
    assert said.gyro == (256, -1, 32767)
    assert said.temperature == pytest.approx(0x0D05 / 333.87 + 21)
    assert said.mag == (20, 10, -30)
    assert not said.was_reset
    assert said.magnetometer_works


def test_both_dies_see_one_field_in_one_frame() -> None:
    """The field in the body's frame, as the figures of PS 9.1 draw the dies: x of one along y of the other, z down."""
    x, y, z = np.eye(3)
    die = np.array([y, x, -z])  # rows: the magnetometer's axes in the body
    assert np.linalg.det(die) == pytest.approx(1.0), "right-handed as well"
    for field in (x, y, z, np.array([20.0, -5.0, 43.0])):
        assert aligned(tuple(die @ field)) == pytest.approx(tuple(field))


@pytest.mark.parametrize(
    ("head", "status", "works", "field", "was_reset"),
    [
        ("00 01", 0x10, True, True, False),
        ("00 01", 0x18, True, False, False),  # HOFL: too strong
        ("00 01", 0x00, False, False, False),  # the master has read nothing yet
        ("00 00", 0x00, False, False, True),
        ("02 01", 0x10, True, True, True),  # the magnetometer is on the host's bus
    ],
)
def test_states_of_a_burst(head: str, status: int, works: bool, field: bool, was_reset: bool) -> None:
    said = measurement(bytes.fromhex(head) + bytes(mpu9250.BURST - 3) + bytes([status]), SCALES)
    assert (said.magnetometer_works, said.mag is not None, said.was_reset) == (works, field, was_reset)


@settings(deadline=None)  # a busy machine is not a failure
@given(st.binary(max_size=40))
def test_any_bytes_are_a_measurement_or_refused(data: bytes) -> None:
    try:
        said = measurement(data, SCALES)
    except ProtocolError:
        assert len(data) != mpu9250.BURST
        return
    Imu(stamp=1, gyro=said.gyro, accel=said.accel, mag=said.mag)


@settings(deadline=None)  # a busy machine is not a failure
@given(st.binary(min_size=mpu9250.BURST, max_size=mpu9250.BURST))
def test_bursts_come_back_as_they_were(data: bytes) -> None:
    said = measurement(data, SCALES)
    again = measurement(burst(said, SCALES), SCALES)
    assert again.gyro == pytest.approx(said.gyro)
    assert again.accel == pytest.approx(said.accel)
    assert again._replace(gyro=said.gyro, accel=said.accel, temperature=said.temperature) == said


def test_the_setup_in_registers() -> None:
    """SMPLRT_DIV, CONFIG, GYRO_CONFIG, ACCEL_CONFIG, ACCEL_CONFIG_2 (RM 4.3 to 4.8)."""
    assert Setup().registers() == bytes([9, 3, 2 << 3, 2 << 3, 3])
    assert Setup(rate=1000, gyro_range=250, accel_range=16, bandwidth=184).registers() == bytes([0, 1, 0, 3 << 3, 1])
    assert Setup(rate=4).divider == 250
    assert Setup(rate=300).chip_rate == pytest.approx(1000 / 3)


# --- the driver --------------------------------------------------------------------------------------------------


def motion(seconds: float, rate: float = 100.0) -> Motion:
    rng = np.random.default_rng(4)
    count = round(seconds * rate)

    def vectors(sd: float) -> list[Any]:
        return [tuple(row) for row in rng.normal(0.0, sd, (count, 3)).tolist()]

    return Motion(times=[i / rate for i in range(count)], gyro=vectors(1.0), accel=vectors(5.0), mag=vectors(30.0))


def bench(seconds: float = 10.0, faults: Faults = Faults(), **options: Any) -> Bench:  # noqa: B008 - frozen
    return Bench(Emulator(motion(seconds), faults, np.random.default_rng(7), now=0.0, **options))


@pytest.fixture
def source(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes a driver on a bench."""

    def make(on: Bench, **chosen: Any) -> driver.Mpu9250:
        @contextmanager
        def opened_bus(number: int) -> Iterator[driver.Transfer]:
            assert number == 1
            yield on.transfer

        clock = SimpleNamespace(monotonic=lambda: on.time, sleep=on.pause, time_ns=lambda: EPOCH + round(on.time * 1e9))
        monkeypatch.setattr(driver, "time", clock)
        monkeypatch.setattr(driver, "opened_bus", opened_bus)
        context = Context(node="imu", rig=Rig(), ports={"imu": Imu}, random=np.random.default_rng(0))
        return driver.Mpu9250(validated_settings(driver.Mpu9250, chosen), context)

    return make


def brought(made: driver.Mpu9250, on: Bench, seconds: float) -> list[Item]:
    """What comes until the bench's clock says `seconds`."""
    items: list[Item] = []
    with closing(made.samples()) as samples:
        for item in takewhile(lambda _: on.time < seconds, samples):
            sample = None if isinstance(item, Quiet) else item[1]
            assert sample is None or isinstance(sample, Imu)
            items.append((on.time, sample))
    return items


def samples_of(items: list[Item]) -> list[tuple[float, Imu]]:
    return [(time, sample) for time, sample in items if sample is not None]


def places(moved: Motion, got: list[Imu]) -> list[int]:
    """Which of the motion's values each sample is, by its gyro; within half a count."""
    recorded = np.array(moved.gyro)
    found = []
    for sample in got:
        distance = np.abs(recorded - np.array(sample.gyro)).max(axis=1)
        place = int(distance.argmin())
        assert distance[place] <= 0.5001 * SCALES.gyro
        found.append(place)
    return found


def test_the_samples_are_what_the_chip_measured(source: Any) -> None:
    on = bench(5.0)
    got = [sample for _, sample in samples_of(brought(source(on), on, 4.5))]
    moved = on.emulator._motion
    at = places(moved, got)
    assert at == list(range(at[0], at[-1] + 1)), "each value once"
    assert len(got) > 420
    for sample, place in zip(got, at, strict=True):
        assert sample.accel == pytest.approx(moved.accel[place], abs=0.5001 * SCALES.accel)
        assert sample.mag == pytest.approx(moved.mag[place], abs=0.5001 * max(SCALES.mag))
    # once it has found the chip's beat
    late = [sample.stamp - EPOCH - moved.times[place] * 1e9 for sample, place in zip(got, at, strict=True)][100:]
    # a reading that came too early keeps its stamp
    assert min(late) >= -5.9e6 - 0.3e6, "the filter's delay is taken off"
    assert max(late) < -5.9e6 + 3e6
    steps = np.diff([sample.stamp for sample in got]) * 1e-9
    assert steps.std() < 1e-3


def test_what_is_at_the_end_of_its_range_is_dropped_counted_and_said_once(
    source: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """A swing of 40 rad/s at a range of 1000 deg/s, a blow of 20 g at one of 8, and bits lost on the way."""
    caplog.set_level(logging.INFO)
    moved = motion(5.0)
    for index, (gyro, accel) in {
        200: ((0.0, 40.0, 0.0), None),
        300: (None, (-200.0, 0.0, 9.81)),
        301: (None, (0.0, 0.0, 200.0)),
    }.items():
        if gyro:
            moved.gyro[index] = gyro  # type: ignore[index]  # a list here
        if accel:
            moved.accel[index] = accel  # type: ignore[index]  # likewise
    on = Bench(Emulator(moved, Faults(), np.random.default_rng(7), now=0.0))
    got = [sample for _, sample in samples_of(brought(source(on), on, 4.5))]
    at = places(moved, got)
    assert sorted(set(range(at[0], at[-1] + 1)) - set(at)) == [200, 300, 301]
    warned = [text for text in caplog.messages if "at the end of its range: the reading is dropped" in text]
    assert [text.partition(":")[0] for text in warned] == [
        "gyro at the end of its range",
        "accel at the end of its range",
    ]
    assert "3 dropped as saturated" in caplog.messages[-1]


def test_a_chip_at_the_end_of_its_range_for_long_is_set_up_anew(source: Any, caplog: pytest.LogCaptureFixture) -> None:
    moved = motion(12.0)
    moved.accel[200:1000] = [(200.0, 0.0, 0.0)] * 800  # type: ignore[index]  # a list here
    on = Bench(Emulator(moved, Faults(), np.random.default_rng(7), now=0.0))
    got = samples_of(brought(source(on), on, 11.5))
    assert max(time for time, _ in got) > 11.0
    assert any("nothing but accel at the end of its range; tries again" in text for text in caplog.messages)


def test_what_is_set_is_what_the_chip_gets(source: Any) -> None:
    on = bench(5.0)
    got = samples_of(brought(source(on, rate=50, gyro_range=2000, accel_range=16, bandwidth=92), on, 2.0))
    assert {round((b.stamp - a.stamp) * 1e-6) for (_, a), (_, b) in pairwise(got)} <= {19, 20, 21, 22}
    registers = on.transfer(0x68, b"\x19", 5)
    assert registers == bytes([19, 2, 3 << 3, 3 << 3, 2])


def test_the_body_may_lie_otherwise_and_steel_is_taken_off(source: Any) -> None:
    on, straight = bench(2.0), bench(2.0)
    turned = samples_of(brought(source(on, axes="+y-x+z", mag_offset=[1.0, 2.0, 3.0]), on, 1.0))
    plain = samples_of(brought(source(straight), straight, 1.0))
    for (_, a), (_, b) in zip(turned, plain, strict=True):
        for got, was, offset in ((a.gyro, b.gyro, (0, 0, 0)), (a.accel, b.accel, (0, 0, 0)), (a.mag, b.mag, (1, 2, 3))):
            assert got is not None
            assert was is not None
            assert got == pytest.approx((was[1] - offset[0], -was[0] - offset[1], was[2] - offset[2]))


def test_without_magnetometer_a_chip_that_has_none_will_do(source: Any) -> None:
    on = bench(3.0, identity=0x70)
    got = samples_of(brought(source(on, magnetometer=False), on, 2.0))
    assert len(got) > 150
    assert all(sample.mag is None for _, sample in got)
    on = bench(3.0, identity=0x70)
    with pytest.raises(DataflowError, match=r"is an MPU-6500, which has no magnetometer; with `magnetometer: false`"):
        brought(source(on, start_timeout_s=1.0), on, 3.0)


def test_another_chip_is_refused(source: Any) -> None:
    on = bench(3.0, identity=0x12)
    with pytest.raises(DataflowError, match=r"WHO_AM_I is 0x12; an MPU-9250 says 0x71; .*--devices"):
        brought(source(on, start_timeout_s=1.0), on, 3.0)


@pytest.mark.parametrize("clock", [0.99, 1.01])
def test_a_chip_whose_clock_is_off_loses_nothing(source: Any, clock: float) -> None:
    """The chip samples a smooth motion by its own clock: as many samples as it took."""
    on = Bench(Emulator(motion(12.0, 1000.0), Faults(), np.random.default_rng(1), now=0.0, clock=clock))
    got = samples_of(brought(source(on), on, 11.0))
    took = (got[-1][1].stamp - got[0][1].stamp) * 1e-9
    assert len(got) - 1 == pytest.approx(100.0 * clock * took, abs=1.5)


def test_refused_and_short_transfers_cost_no_sample(source: Any, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    on = bench(13.0, Faults(refusals=0.05, short=0.02))
    got = [sample for _, sample in samples_of(brought(source(on), on, 12.0))]
    at = places(on.emulator._motion, got)
    assert at == sorted(set(at))
    assert at[-1] - at[0] + 1 - len(at) <= 3
    assert on.emulator.tally.refused > 40
    assert "failed" in caplog.messages[-1]
    assert "short" in caplog.messages[-1]


def test_a_chip_that_resets_itself_is_set_up_anew_and_no_value_is_of_the_wrong_scale(
    source: Any, caplog: pytest.LogCaptureFixture
) -> None:
    on = bench(10.0, Faults(resets=(3.0,)))
    got = samples_of(brought(source(on, axes="+x+y+z"), on, 6.0))
    places(on.emulator._motion, [sample for _, sample in got])
    after = min(time for time, _ in got if time > 3.02)
    assert after - 3.0 < 0.5
    assert any("the chip was reset; tries again" in message for message in caplog.messages)


def test_a_reset_without_magnetometer_is_seen_as_well(source: Any) -> None:
    on = bench(10.0, Faults(resets=(3.0,)))
    got = samples_of(brought(source(on, magnetometer=False), on, 6.0))
    places(on.emulator._motion, [sample for _, sample in got])
    assert len(got) > 500


def test_an_unplugged_chip_comes_back_within_a_second_and_the_gap_is_told(source: Any) -> None:
    on = bench(12.0, Faults(unplugs=((3.0, 3.0),)))
    items = brought(source(on), on, 9.0)
    got = samples_of(items)
    before, after = max(time for time, _ in got if time < 6.0), min(time for time, _ in got if time > 6.0)
    assert before == pytest.approx(3.0, abs=0.02)
    assert after - 6.0 < 1.0
    quiet = [time for time, sample in items if sample is None and 3.0 < time < after]
    assert max(b - a for a, b in pairwise([3.0, *quiet, after])) < 0.5, "readers of other streams need not wait"
    stamps = [sample.stamp for _, sample in got]
    assert all(a < b for a, b in pairwise(stamps))
    assert max(b - a for a, b in pairwise(stamps)) > 3e9


def test_values_that_stand_still_are_not_believed(source: Any) -> None:
    on = bench(12.0, Faults(freezes=((2.0, 2.5),)))
    got = samples_of(brought(source(on), on, 6.0))
    false = [time for time, _ in got if 2.02 < time < 4.48]
    assert max(false) < 3.2, "for a second they might be true"
    assert min(time for time, _ in got if time > 4.5) < 4.6


def test_a_hung_chip_is_reset(source: Any) -> None:
    on = bench(20.0, Faults(freezes=((2.0, 100.0),)))
    got = samples_of(brought(source(on), on, 12.0))
    back = min(time for time, _ in got if time > 3.2)
    assert back < driver.REVIVAL_PERIOD + 2.0


def test_a_magnet_that_is_too_near_leaves_the_rest(source: Any) -> None:
    on = bench(5.0, Faults(overflows=((2.0, 1.0),)))
    got = samples_of(brought(source(on), on, 4.0))
    without = [time for time, sample in got if sample.mag is None]
    assert 90 <= len(without) <= 110
    assert min(without) > 1.9
    assert max(without) < 3.1


def test_a_chip_that_is_never_there_is_an_error_with_the_next_step(source: Any) -> None:
    on = bench(1.0, Faults(unplugs=((0.0, 1e9),)))
    said = r"^imu: MPU-9250 on /dev/i2c-1, address 0x68: no sample within 2 s: .*Remote I/O error.*--devices.*--replay"
    with pytest.raises(DataflowError, match=said):
        brought(source(on, start_timeout_s=2), on, 10.0)
    assert 2.0 < on.time < 2.3


class Babbler:
    """A bus that answers anything to anything."""

    def __init__(self, said: list[bytes]) -> None:
        self.time = 0.0
        self.said = said
        self.turn = 0

    def pause(self, seconds: float) -> None:
        self.time += max(seconds, 0.0)

    def transfer(self, address: int, data: bytes, length: int) -> bytes:
        self.time += 1e-4
        self.turn += 1
        said = self.said[self.turn % len(self.said)]
        if not said:
            raise OSError(121, "Remote I/O error")
        # at first the chip's own name, so that the rest is asked as well
        known = {b"\x75": b"\x71", b"\x00": b"\x48"}.get(data, b"") if self.turn % 3 else b""
        return (known + said)[:length] if self.turn % 5 else said


@settings(deadline=None, max_examples=60)
@given(st.lists(st.binary(max_size=40), min_size=1, max_size=12))
def test_no_bytes_upset_the_driver(said: list[bytes]) -> None:
    on = Babbler(said)
    with pytest.MonkeyPatch.context() as patch:

        @contextmanager
        def opened_bus(number: int) -> Iterator[driver.Transfer]:
            yield on.transfer

        clock = SimpleNamespace(monotonic=lambda: on.time, sleep=on.pause, time_ns=lambda: round(on.time * 1e9) + 1)
        patch.setattr(driver, "time", clock)
        patch.setattr(driver, "opened_bus", opened_bus)
        context = Context(node="imu", rig=Rig(), ports={"imu": Imu}, random=np.random.default_rng(0))
        made = driver.Mpu9250(validated_settings(driver.Mpu9250, {"start_timeout_s": 100.0}), context)
        with closing(made.samples()) as items:
            for _, _item in zip(range(30), items, strict=False):
                assert on.time < 100.0


@pytest.mark.parametrize(
    ("chosen", "said"),
    [
        ({"axes": "+x+y-z"}, "left-handed"),
        ({"gyro_range": 300}, "gyro_range"),
        ({"bandwidth": 50}, "bandwidth"),
        ({"mag_offset": [1.0, 2.0]}, "mag_offset"),
        ({"rate": 2000}, "rate"),
    ],
)
def test_settings_that_no_chip_can_have_are_refused(chosen: dict[str, Any], said: str) -> None:
    with pytest.raises(DataflowError, match=said):
        validated_settings(driver.Mpu9250, chosen)


def test_a_mounting_is_a_rotation() -> None:
    """-y+x+z: the body's x is the chip's -y."""
    assert mounting("-y+x+z").turned((1.0, 2.0, 3.0)) == (-2.0, 1.0, 3.0)
