"""The BNO055's protocol: registers against the data sheet, transactions and pacing against the emulator, in no time.

The emulator's clock is a number here, so 60 s at 100 Hz pass at once and the same way every time.
"""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.protocols import bno055, bno055_emulator
from caneflow.protocols.bno055 import (
    ACCEL_STEP,
    GYRO_STEP,
    MAG_STEP,
    QUATERNION_STEP,
    WHOLE,
    WITHOUT_ACCEL_AND_MAG,
    Axes,
    CalibrationProfile,
    Measurement,
    Mode,
    Register,
    axes,
    impossible,
    is_rotation,
    measurement,
    registers,
)
from caneflow.protocols.bno055_chip import Chip, Setup
from caneflow.protocols.bno055_emulator import Bench, Emulator, Faults, Motion
from caneflow.protocols.bno055_link import BYTE_TIME, UartLink, read_request, write_request
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.pacing import Pacing, Spacing, Verdict
from caneflow.protocols.register_link import I2cLink

PERIOD = 0.01  # s
PROFILE = CalibrationProfile(
    accel_offset=(5, -25, -45),
    mag_offset=(-2685, 3638, 8588),
    gyro_offset=(-1, 0, -2),
    accel_radius=1000,
    mag_radius=878,
)

counts = st.integers(-(2**15), 2**15 - 1)
vectors = st.tuples(counts, counts, counts)


def scaled(vector: tuple[int, int, int], step: float) -> tuple[float, float, float]:
    x, y, z = vector
    return x * step, y * step, z * step


class World(Bench):
    """A bench with a chip on it that can be talked to."""

    def __init__(self, emulator: Emulator) -> None:
        super().__init__(emulator)
        self.link = UartLink(self, self.pause, self.now_ns)
        self.chip = Chip(self.link, self.pause)


def noisy_motion(count: int, period: float = PERIOD) -> Motion:
    """Values that differ from each other, as those of a real sensor do."""
    rng = np.random.default_rng(4)

    def vector(sd: float) -> tuple[float, float, float]:
        x, y, z = rng.normal(0.0, sd, 3).tolist()
        return x, y, z

    blocks = [
        registers(
            Measurement(
                gyro=vector(1.0),
                orientation=(math.cos(0.001 * i), math.sin(0.001 * i), 0.0, 0.0),
                linear_accel=vector(0.5),
                gravity=(0.0, 0.0, 9.81),
                temperature=25,
                calibration=(3, 3, 3, 3),
                accel=vector(5.0),
                mag=vector(30.0),
            )
        )
        for i in range(count)
    ]
    return Motion(times=[i * period for i in range(count)], blocks=blocks)


def world(motion: Motion | None = None, faults: Faults = Faults(), *, started: bool = True) -> World:  # noqa: B008
    made = World(Emulator(motion or noisy_motion(100), faults, np.random.default_rng(7), now=0.0))
    if started:
        made.pause(bno055.START_UP)
    return made


# --- registers --------------------------------------------------------------------------------------------------


def test_scales_are_the_data_sheets() -> None:
    # 1 m/s^2 = 100 LSB, 1 uT = 16 LSB, 1 deg/s = 16 LSB, 1 = 2^14 LSB (DS p. 30, 33, 36)
    data = WHOLE.layout.pack(
        981, 0, -100, 16, 32, -16, 16, -32, 0, 0, 0, 0, 2**14, 0, 0, 0, 50, 0, 0, 0, 0, 981, 23, 0b11100100
    )
    said = measurement(WHOLE, data)
    assert said.accel == pytest.approx((9.81, 0.0, -1.0))
    assert said.mag == (1.0, 2.0, -1.0)
    assert said.gyro == pytest.approx((math.radians(1), math.radians(-2), 0.0))
    assert said.orientation == (1.0, 0.0, 0.0, 0.0)
    assert said.linear_accel == pytest.approx((0.5, 0.0, 0.0))
    assert said.gravity == pytest.approx((0.0, 0.0, 9.81))
    assert (said.temperature, said.calibration) == (23, (3, 2, 1, 0))
    short = measurement(WITHOUT_ACCEL_AND_MAG, data[12:])
    assert short == said._replace(accel=None, mag=None)
    assert (WHOLE.length, WITHOUT_ACCEL_AND_MAG.length) == (46, 34)


@settings(deadline=None)  # a busy machine is not a failure
@given(
    vectors,
    vectors,
    vectors,
    st.tuples(counts, counts, counts, counts),
    vectors,
    st.integers(-128, 127),
    st.integers(0, 255),
)
def test_registers_are_the_inverse_of_a_measurement(
    accel: tuple[int, int, int],
    mag: tuple[int, int, int],
    gyro: tuple[int, int, int],
    quaternion: tuple[int, int, int, int],
    linear: tuple[int, int, int],
    temperature: int,
    levels: int,
) -> None:
    w, x, y, z = quaternion
    said = Measurement(
        gyro=scaled(gyro, GYRO_STEP),
        orientation=(w * QUATERNION_STEP, x * QUATERNION_STEP, y * QUATERNION_STEP, z * QUATERNION_STEP),
        linear_accel=scaled(linear, ACCEL_STEP),
        gravity=scaled(accel, ACCEL_STEP),
        temperature=temperature,
        calibration=(levels >> 6, levels >> 4 & 3, levels >> 2 & 3, levels & 3),
        accel=scaled(accel, ACCEL_STEP),
        mag=scaled(mag, MAG_STEP),
    )
    assert measurement(WHOLE, registers(said)) == said


def test_values_beyond_the_registers_stay_at_their_ends() -> None:
    said = measurement(WHOLE, registers(measurement(WHOLE, bytes(46))._replace(gyro=(1e6, -1e6, 0.0))))
    assert said.gyro == pytest.approx(((2**15 - 1) * GYRO_STEP, -(2**15) * GYRO_STEP, 0.0))


@settings(deadline=None)  # a busy machine is not a failure
@given(st.binary(max_size=60))
def test_any_bytes_are_a_measurement_or_refused(data: bytes) -> None:
    for block in (WHOLE, WITHOUT_ACCEL_AND_MAG):
        if len(data) == block.length:
            assert isinstance(is_rotation(measurement(block, data).orientation), bool)
        else:
            with pytest.raises(ProtocolError, match="bytes of measurements"):
                measurement(block, data)


def test_a_chip_that_has_not_started_gives_no_rotation() -> None:
    assert not is_rotation((0.0, 0.0, 0.0, 0.0))
    assert is_rotation((1.0, 0.0, 0.0, 0.0))
    assert is_rotation((0.70709, 0.70709, 0.0, 0.0))  # rounded to the chip's steps
    assert not is_rotation((0.7, 0.7, 0.0, 0.0))


@pytest.mark.parametrize(
    ("placement", "text", "map_value", "sign"),
    [  # the data sheet's P0..P7 (DS 3.4)
        ("P0", "-y+x+z", 0x21, 0x04),
        ("P1", "+x+y+z", 0x24, 0x00),
        ("P2", "-x-y+z", 0x24, 0x06),
        ("P3", "+y-x+z", 0x21, 0x02),
        ("P4", "+x-y-z", 0x24, 0x03),
        ("P5", "+y+x-z", 0x21, 0x01),
        ("P6", "-y-x-z", 0x21, 0x07),
        ("P7", "-x+y-z", 0x24, 0x05),
    ],
)
def test_placements_of_the_data_sheet(placement: str, text: str, map_value: int, sign: int) -> None:
    assert axes(text) == Axes(map=map_value, sign=sign), placement


def test_24_ways_of_mounting_and_no_mirror() -> None:
    texts = [
        "".join(sign + axis for sign, axis in zip(signs, order, strict=True))
        for order in itertools.permutations("xyz")
        for signs in itertools.product("+-", repeat=3)
    ]
    accepted = []
    for text in texts:
        try:
            accepted.append(axes(text))
        except ProtocolError as error:
            assert "left-handed" in str(error)
    assert len(accepted) == len({(found.map, found.sign) for found in accepted}) == 24
    for text in ("", "xyz", "+x+x+z", "+x+y", "+x+y+z+z", "+X+Y+Z"):
        with pytest.raises(ProtocolError, match="each once, with sign"):
            axes(text)


@settings(deadline=None)  # a busy machine is not a failure
@given(st.binary(min_size=22, max_size=22))
def test_a_profile_comes_back_as_it_was(data: bytes) -> None:
    assert CalibrationProfile.from_bytes(data).to_bytes() == data


def test_requests_are_the_data_sheets() -> None:
    assert read_request(0x08, 46) == bytes.fromhex("AA 01 08 2E")
    assert write_request(0x3D, b"\x0c") == bytes.fromhex("AA 00 3D 01 0C")
    for length in (0, 129):
        with pytest.raises(ProtocolError, match=r"1\.\.128"):
            read_request(0, length)
        with pytest.raises(ProtocolError, match=r"1\.\.128"):
            write_request(0, bytes(length))


# --- transactions -----------------------------------------------------------------------------------------------


class Babbler:
    """A port that says what it likes."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def read(self, size: int = 1) -> bytes:
        said, self.data = self.data[:size], self.data[size:]
        return said

    def write(self, data: bytes) -> None:
        assert data[0] == 0xAA

    def reset_input_buffer(self) -> None:
        """Let all of it come after the request."""


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.binary(max_size=60),
            st.builds(lambda status: bytes([0xEE, status]), st.integers(0, 255)),
            st.builds(lambda data: bytes([0xBB, 46]) + data, st.binary(max_size=50)),
        ),
        max_size=6,
    ).map(b"".join)
)
def test_any_bytes_are_an_answer_or_refused(data: bytes) -> None:
    link = UartLink(Babbler(data), lambda _: None, lambda: 0)
    chip = Chip(link, lambda _: None)
    for action in (
        lambda: chip.read(WHOLE),
        lambda: chip.set_up(Setup(profile=PROFILE)),
        chip.profile,
        chip.identity,
        lambda: str(chip.state()),
    ):
        try:
            action()
        except ProtocolError as error:
            assert str(error)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.binary(min_size=1, max_size=40), max_size=20))
def test_the_emulator_takes_any_bytes_and_still_answers(requests: list[bytes]) -> None:
    made = world()
    for request in requests:
        made.write(request)
        made.pause(0.02)
    made.pause(bno055.RESET + 0.1)  # it may have been told to reset
    made.reset_input_buffer()
    made.link.write(Register.PAGE_ID, b"\0")
    made.chip.require()


@pytest.mark.parametrize(
    ("answers", "count"),
    [
        ([b"\xee\x07", b"\xbb\x01\xa0"], "1 overruns"),
        ([b"\xee\x02", b"\xbb\x01\xa0"], "1 refused"),
        ([b"", b"\xbb\x01\xa0"], "1 silent"),
        ([b"\xbb\x01", b"", b"\xbb\x01\xa0"], "1 short"),
        ([b"\xbb\x02\xa0\xa0", b"\xbb\x01\xa0"], "1 short"),
        ([b"\x00\xff", b"\xbb\x01\xa0"], "1 garbled"),
    ],
)
def test_a_read_that_fails_is_tried_again_and_counted(answers: list[bytes], count: str) -> None:
    port = Scripted(answers)
    link = UartLink(port, lambda _: None, lambda: 0)
    assert link.read(Register.CHIP_ID, 1).data == b"\xa0"
    assert str(link.faults) == count


class Scripted:
    """A port with an answer ready for each request, and each `read` that comes back short."""

    def __init__(self, answers: list[bytes]) -> None:
        self.answers = answers
        self.now = b""

    def write(self, data: bytes) -> None:
        self.now = self.answers.pop(0)

    def read(self, size: int = 1) -> bytes:
        said, self.now = self.now[:size], self.now[size:]
        if not said and self.answers and not self.answers[0]:
            self.answers.pop(0)
        return said

    def reset_input_buffer(self) -> None:
        self.now = b""


def test_what_cannot_be_written_is_not_tried_again() -> None:
    made = world()
    with pytest.raises(ProtocolError, match=r"EE 05, write disabled \(1 tries\)"):
        made.link.write(Register.CHIP_ID, b"\0")
    assert made.emulator.tally.requests == 1


def test_an_answer_that_came_too_late_is_not_taken_for_the_next_one() -> None:
    made = world()
    made.timeout = 0.001  # shorter than any answer
    with pytest.raises(ProtocolError, match="no answer"):
        made.link.read(Register.CHIP_ID, 7)
    made.timeout = 0.03
    made.pause(0.05)
    assert made.link.read(Register.AXIS_MAP, 1).data == b"\x24"


def test_a_burst_takes_its_time_on_the_wire() -> None:
    made = world()
    made.chip.set_up(Setup())
    began = made.time
    made.chip.read(WHOLE)
    assert made.time - began == pytest.approx((4 + 2 + 46) * BYTE_TIME, abs=1e-6)  # 4.5 ms


def test_i2c_reads_the_same_and_survives_a_bus_that_does_not_acknowledge() -> None:
    errors = iter([OSError(121, "Remote I/O error"), None, OSError(121, "Remote I/O error"), None])

    def transfer(data: bytes, length: int) -> bytes:
        error = next(errors)
        if error:
            raise error
        return bytes(range(length)) if length else b""

    link = I2cLink(transfer, lambda _: None, lambda: 5)
    assert link.read(Register.ACCEL, 46) == (bytes(range(46)), 5)
    link.write(Register.MODE, b"\x0c")
    assert str(link.faults) == "2 failed"
    dead = I2cLink(lambda *_: bytes(3), lambda _: None, lambda: 0)
    with pytest.raises(ProtocolError, match="the bus gave 3 of 46 bytes"):
        dead.read(Register.ACCEL, 46)


# --- the chip ---------------------------------------------------------------------------------------------------


def test_set_up_from_any_state() -> None:
    wanted = Setup(mode=Mode.IMU, axes=axes("-y+x+z"), external_crystal=True, profile=PROFILE)
    for before in (None, Setup(), wanted):
        made = world()
        if before is not None:
            made.chip.set_up(before)
        made.chip.set_up(wanted)
        assert made.chip.works_as(wanted)
        assert not made.chip.works_as(Setup())
        assert made.link.read(Register.AXIS_MAP, 2).data == b"\x21\x04"
        assert made.link.read(Register.TRIGGER, 1).data == b"\x80"
        made.pause(0.1)
        made.chip.read(WHOLE)
        assert str(made.chip.state()) == "fusion runs, mode IMU"
        assert made.chip.profile() == PROFILE
        assert str(made.chip.state()) == "idle, mode CONFIG"  # where telling the profile leaves it


def test_a_chip_says_who_it_is() -> None:
    identity = world().chip.identity()
    assert (identity.chip, identity.accel, identity.mag, identity.gyro) == (0xA0, 0xFB, 0x32, 0x0F)
    assert (identity.software, identity.self_test) == ("3.11", 0x0F)


def test_a_chip_does_not_answer_before_it_has_started() -> None:
    made = world(started=False)
    with pytest.raises(ProtocolError, match="no answer"):
        made.chip.require()
    made.pause(bno055.START_UP)
    made.chip.require()


def test_another_chip_is_refused() -> None:
    link = UartLink(Scripted([b"\xee\x01", b"\xbb\x01\x71"]), lambda _: None, lambda: 0)
    with pytest.raises(ProtocolError, match="chip id 0x71; a BNO055 has 0xA0"):
        Chip(link, lambda _: None).require()


def test_a_chip_that_another_program_left_on_page_1_is_found() -> None:
    made = world(faults=Faults(page=1))
    assert made.link.read(Register.CHIP_ID, 1).data == b"\0", "there it has no id"
    made.chip.require()
    assert made.chip.identity().chip == 0xA0


def test_what_the_chip_cannot_measure() -> None:
    """DS 3.5: 4 g, 2000 deg/s, 1300 uT along x and y and 2500 along z; each with the counts just within and beyond."""
    good = Measurement(
        gyro=(0.0, 0.0, 0.0),
        orientation=(1.0, 0.0, 0.0, 0.0),
        linear_accel=(0.0, 0.0, 0.0),
        gravity=(0.0, 0.0, 9.81),
        temperature=25,
        calibration=(3, 3, 3, 3),
        accel=(0.0, 0.0, 9.81),
        mag=(20.0, 0.0, -40.0),
    )
    within: dict[str, Any] = {
        "gyro": (0.0, math.radians(2000.0), -math.radians(2000.0)),
        "accel": (-41.0, 41.0, 41.0),
        "linear_accel": (51.0, -51.0, 0.0),
        "gravity": (0.0, -10.2, 0.0),
        "mag": (1350.0, -1350.0, 2047.0),
        "temperature": 85,
    }
    beyond: dict[str, Any] = {
        "gyro": (0.0, 0.0, -math.radians(2001.0)),
        "accel": (0.0, -41.5, 0.0),
        "linear_accel": (52.0, 0.0, 0.0),
        "gravity": (0.0, 0.0, 10.4),
        "mag": (0.0, -1400.0, 0.0),
        "temperature": -102,
    }
    for name, value in within.items():
        assert impossible(good._replace(**{name: value}), axes("+x+y+z")) == ""
    for name, value in beyond.items():
        assert impossible(good._replace(**{name: value}), axes("+x+y+z")).startswith(f"{name} beyond")
    assert impossible(good._replace(mag=None, accel=None), axes("+x+y+z")) == ""
    turned = good._replace(mag=(0.0, -2000.0, 0.0))
    assert impossible(turned, axes("+x+z-y")) == "", "the chip's z lies along the body's y"


def test_set_up_goes_through_overruns() -> None:
    made = world(faults=Faults(overruns=0.2))
    made.chip.set_up(Setup(profile=PROFILE))
    assert made.link.faults.overruns > 0


def test_in_imu_mode_the_magnetometer_says_nothing() -> None:
    made = world()
    made.chip.set_up(Setup(mode=Mode.IMU))
    made.pause(0.2)
    said = made.chip.read(WHOLE).said
    assert said.mag == (0.0, 0.0, 0.0)
    assert any(said.gyro)


# --- pacing -----------------------------------------------------------------------------------------------------


class Taken:
    """What a driver would have published, in the world's time."""

    def __init__(self, made: World, rate: float = 100.0, jitter: float = 0.0) -> None:
        self.values: list[bytes] = []
        self.stamps: list[int] = []
        self.at: list[float] = []  # s, when it was there
        self.pacing = Pacing(rate, made.time, chip_rate=100.0)
        rng = np.random.default_rng(11)
        early = None
        while not made.emulator.ended(made.time):
            made.time = max(made.time, self.pacing.due) + abs(rng.normal(0.0, jitter))
            reading = made.chip.read(WHOLE)
            if not is_rotation(reading.said.orientation):
                self.pacing.failed(made.time)
                continue
            verdict = self.pacing.took(reading.values, made.time)
            if verdict is Verdict.REPEATED:
                early = reading.stamp
            elif verdict is Verdict.NEW:
                self.values.append(reading.values)
                self.stamps.append(early or reading.stamp)
                self.at.append(made.time)
                early = None


def taken(motion: Motion, faults: Faults = Faults(), **options: float) -> tuple[Taken, World]:  # noqa: B008
    made = world(motion, faults)
    made.chip.set_up(Setup())
    return Taken(made, **options), made


@pytest.mark.parametrize(
    ("seconds", "period", "jitter"),  # s: the chip's clock is not the host's, and the host wakes up late
    [(60, 0.01, 0.0005), (20, 0.01, 0.0), (20, 0.00995, 0.0005), (20, 0.0101, 0.0005)],
)
def test_at_100_hz_every_value_is_read_once(seconds: int, period: float, jitter: float) -> None:
    motion = noisy_motion(round(seconds / period), period)
    got, made = taken(motion, jitter=jitter)
    assert got.values == [block[: bno055.VALUES_END] for block in motion.blocks]
    assert got.pacing.missed == 0
    assert all(a < b for a, b in itertools.pairwise(got.stamps))
    assert made.emulator.begin is not None
    lag = [
        stamp * 1e-9 - made.emulator.begin - time
        for stamp, time in zip(got.stamps[500:], motion.times[500:], strict=True)
    ]
    assert min(lag) > -0.0015
    assert max(lag) < 0.006  # once in step, a stamp is within half a period of the change of the values


def test_with_5_percent_overruns_no_sample_is_late() -> None:
    motion = noisy_motion(6000)
    got, made = taken(motion, Faults(overruns=0.05), jitter=0.0005)
    assert made.link.faults.overruns > 200
    number = {block[: bno055.VALUES_END]: i for i, block in enumerate(motion.blocks)}
    assert made.emulator.begin is not None
    delays = [
        at - made.emulator.begin - motion.times[number[values]] for at, values in zip(got.at, got.values, strict=True)
    ]
    assert max(delays[500:]) < 0.020  # from when the chip had it; 4.5 ms of it on the wire
    assert len(set(got.values)) > 0.998 * 6000  # a second overrun in a row may cost the chip's next value its turn


def test_a_lower_rate_leaves_values_out_evenly() -> None:
    got, _ = taken(noisy_motion(1000), rate=25.0)
    steps = {round((b - a) * 1e-6) for a, b in itertools.pairwise(got.stamps)}
    assert steps == {40}
    assert len(got.values) == pytest.approx(250, abs=1)


def test_values_that_stay_the_same_are_samples_for_a_second_then_frozen() -> None:
    pacing = Pacing(100.0, 0.0, chip_rate=100.0)
    now, verdicts = 0.0, []
    for _ in range(400):
        now = max(now, pacing.due) + 0.0047
        verdicts.append((now, pacing.took(b"same", now)))
    new = [time for time, verdict in verdicts if verdict is Verdict.NEW]
    frozen = [time for time, verdict in verdicts if verdict is Verdict.FROZEN]
    assert len(new) == pytest.approx(1.0 / (0.0047 + 0.001 + 0.0047), abs=2)  # each is read twice
    assert max(new) == pytest.approx(1.0, abs=0.02)
    assert min(frozen) > max(new)
    now = max(now, pacing.due)
    assert pacing.took(b"other", now) is Verdict.NEW


def test_a_reading_that_took_too_long_is_counted_and_the_beat_is_kept() -> None:
    pacing = Pacing(50.0, 0.0, chip_rate=100.0)
    pacing.took(b"0", 0.005)
    pacing.took(b"1", 0.085)  # three periods late
    assert pacing.missed == 2
    assert pacing.due == pytest.approx(0.08)
    pacing.took(b"2", 0.086)
    assert pacing.due == pytest.approx(0.1)


def test_spacing_knows_jitter_from_gaps() -> None:
    spacing = Spacing(0.01)
    times = [0.0, 0.010, 0.021, 0.030, 3.030, 3.040]
    for time in times:
        spacing.take(round(time * 1e9))
    steps = [0.010, 0.011, 0.009, 0.010]
    mean = sum(steps) / 4
    assert spacing.gaps == 1
    assert spacing.mean == pytest.approx(mean)
    assert spacing.jitter == pytest.approx(math.sqrt(sum((step - mean) ** 2 for step in steps) / 4))
    assert spacing.longest == pytest.approx(0.011)
    spacing.clear()
    spacing.take(round(3.052 * 1e9))
    assert spacing.count == 1
    assert spacing.mean == pytest.approx(0.012)


# --- the emulator's faults --------------------------------------------------------------------------------------


def bursts(made: World, seconds: float) -> Iterator[tuple[float, bytes | None]]:
    """Time of the motion and values of readings at 100 Hz; None where there was none."""
    end = made.time + seconds
    while made.time < end:
        made.pause(PERIOD)
        begin = made.emulator.begin
        time = -1.0 if begin is None else made.time - begin
        try:
            yield time, made.chip.read(WHOLE).values
        except ProtocolError:
            yield time, None


def test_faults_come_when_they_are_asked_for() -> None:
    motion = noisy_motion(600)
    faults = Faults(freezes=((1.0, 0.5),), silences=((2.0, 0.5),), resets=(3.0,), short=0.0)
    made = world(motion, faults)
    made.chip.set_up(Setup())
    said = list(bursts(made, 4.5))
    frozen = {values for time, values in said if 1.02 < time < 1.48}
    assert frozen == {motion.blocks[100][: bno055.VALUES_END]}
    assert all(values is None for time, values in said if 2.02 < time < 2.3)
    assert all(values for time, values in said if 2.6 < time < 2.98)
    assert all(values is None for time, values in said if 3.02 < time < 3.4)
    after = [values for time, values in said if time > 3.8]
    assert set(after) == {bytes(44)}, "a chip that was reset is in CONFIG mode, where all values are 0"
    assert not made.chip.works_as(Setup())


def test_requests_that_get_lost_are_asked_again() -> None:
    made = world(noisy_motion(300), Faults(loss=0.05))
    made.chip.set_up(Setup())
    assert all(values for _, values in bursts(made, 1.0))
    assert made.link.faults.silent == made.emulator.tally.lost > 2


def test_answers_cut_short_are_counted_and_asked_for_again() -> None:
    made = world(noisy_motion(300), Faults(short=0.1))
    made.chip.set_up(Setup())
    assert all(values for _, values in bursts(made, 1.0))
    assert made.link.faults.short == made.emulator.tally.short > 3


def test_a_motion_may_begin_at_a_given_time() -> None:
    motion = noisy_motion(10)
    made = World(Emulator(motion, bno055_emulator.Faults(), np.random.default_rng(1), now=0.0, begin=2.0))
    made.pause(bno055.START_UP)
    made.chip.set_up(Setup())
    assert made.chip.read(WHOLE).values == bytes(44)
    made.time = 2.0 + 0.0551 - 4 * BYTE_TIME
    assert made.chip.read(WHOLE).values == motion.blocks[5][: bno055.VALUES_END]
    assert made.emulator.ended(2.1)
    assert not made.emulator.ended(2.09)
