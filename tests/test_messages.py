"""Messages on the wire: what goes out comes back, what breaks the contract is refused with one clear cause."""

import math
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from caneflow.messages import (
    MAX_PAYLOAD,
    SAMPLES,
    Cue,
    DopplerBlock,
    DopplerTarget,
    Grid,
    GroundSpeed,
    Imu,
    MessageError,
    Obstacles,
    Pose,
    RadarFrame,
    RadarPoints,
    RadarTargets,
    Ranges,
    Sample,
    control_key,
    decode,
    encode,
    json_schema,
    numbered,
    sample_key,
    stream_of,
)
from caneflow.messages.arrays import LITTLE_ENDIAN, from_bytes, to_bytes
from caneflow.messages.reference import with_tables

EXAMPLES: list[Sample] = [
    Imu(
        stamp=5,
        gyro=(0.1, -0.2, 0.3),
        accel=(0.0, 0.0, 9.81),
        mag=(20.0, 0.0, -40.0),
        orientation=(1.0, 0.0, 0.0, 0.0),
        linear_accel=(0.0, 0.0, 0.0),
        calibration=(3, 3, 3, 0),
    ),
    Imu(stamp=6, gyro=(0.0, 0.0, 0.0)),
    RadarFrame(
        stamp=7,
        scans=np.arange(12, dtype=np.int32).reshape(2, 6),
        scan_period=0.01,
        range_start=0.5,
        range_step=0.009149,
        carrier=4.3e9,
        bandwidth=1.7e9,
    ),
    GroundSpeed(stamp=8, speed=0.0, quality=math.inf, rays=0, valid=False),
    GroundSpeed(
        stamp=9, speed=1.1, quality=0.05, rays=12, valid=True, delay=0.32,
        velocity=(1.0, 0.1), velocity_cov=(0.01, 0.0, 1e6), velocity_delay=0.03, vertical=-0.02,
        vertical_sd=0.03, spread=0.4, spread_delay=0.13,
    ),
    Pose(
        stamp=10, position=(1.0, 2.0, 3.0), velocity=(0.0, 0.0, 0.0), orientation=(0.0, 0.0, 0.0, 1.0),
        method="luenberger", covariance=np.eye(6),
    ),
    DopplerBlock(
        stamp=11, samples=np.array([1 + 2j, 3 - 1j], dtype=np.complex64), sample_rate=4000.0, carrier=24.125e9
    ),
    DopplerTarget(
        stamp=12, range_rate=-1.2, signed=True, amplitude=0.01, snr=20.0, valid=True, range=4.0, delay=0.128
    ),
    Ranges(
        stamp=13, ranges=np.array([1.5, 0.0], np.float32), status=np.array([0, 1], np.uint8),
        sigma=np.array([0.02, 0.0], np.float32), signal=np.array([900.0, 3.0], np.float32),
        ambient=np.array([4.0, 4.0], np.float32), exposure=0.066, delay=0.033,
    ),
    RadarTargets(stamp=14),
    RadarTargets(
        stamp=14, range=np.array([1.2], np.float32), range_rate=np.array([-0.8], np.float32),
        snr=np.array([12.0], np.float32), above_floor=np.array([1], np.uint8),
    ),
    Grid(
        stamp=15, occupancy=np.full((8, 4, 6), 128, np.uint8), unit=1 / 32, cell=0.1, bottom=0.0, slice=0.25,
        origin=(-32, 4), pose_stamp=14, floor_missing=np.full((4, 6), 90, np.uint8),
    ),
    Obstacles(
        stamp=16, heading=-1.2, walking=True, nearest=np.zeros((3, 4), np.float32), known=np.ones((3, 4), np.float32),
        closing=np.zeros((3, 4), np.float32), place=np.zeros((3, 4, 2), np.float32),
    ),
    Cue(stamp=17, kind="none", since=17),
    Cue(stamp=18, kind="obstacle", level="head", distance=1.9, azimuth=-0.1, urgency=0.4, time=2.1, since=17),
    Cue(stamp=19, kind="blind", reason="tof_up/ranges", since=18),
    RadarPoints(
        stamp=20, position=np.zeros((0, 3), np.float32), doppler=np.zeros(0, np.float32), frame_time=0.0185,
        doppler_step=0.125, doppler_limit=2.0,
    ),
    RadarPoints(
        stamp=20, position=np.array([[2.0, -0.5, 0.1]], np.float32), doppler=np.array([0.5], np.float32),
        snr=np.array([14.0], np.float32), noise=np.array([31.0], np.float32), frame_time=0.0185, doppler_step=0.125,
        doppler_limit=2.0,
    ),
]  # fmt: skip


def independent(payload: bytes) -> Any:
    """The payload as another msgpack library reads it, arrays by the letter of the contract."""

    def array(code: int, data: bytes) -> Any:
        assert code == 1
        rank = data[1]
        shape = struct.unpack_from(f"<{rank}I", data, 2)
        widths = {"B": "u1", "h": "i2", "i": "i4", "q": "i8", "f": "f4", "d": "f8", "F": "c8", "D": "c16"}
        return np.frombuffer(data, "<" + widths[chr(data[0])], offset=2 + 4 * rank).reshape(shape)

    return msgpack.unpackb(payload, ext_hook=array)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_what_goes_out_comes_back_the_same(message: Sample) -> None:
    payload = numbered(message, 3)
    again = decode(payload, type(message))
    assert again.seq == 3
    assert encode(again) == payload


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_another_library_reads_the_same_map(message: Sample) -> None:
    found = independent(numbered(message, 3))
    assert isinstance(found, dict)
    for name, value in found.items():
        mine = getattr(message, name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, mine)
            assert value.dtype == mine.dtype
        else:
            assert value == (list(mine) if isinstance(mine, tuple) else mine)
    absent = {name for name in message.__struct_fields__ if getattr(message, name) is None}
    assert not absent & found.keys(), "absent optional fields are left out"


@pytest.mark.parametrize("kind", SAMPLES.values(), ids=lambda k: k.__name__)
def test_what_another_library_writes_is_read(kind: type[Sample]) -> None:
    message = next(m for m in EXAMPLES if type(m) is kind)
    fields = independent(numbered(message, 0))
    fields["unknown_to_us"] = {"deep": [1, 2]}  # a later version's field
    fields["seq"] = 7

    def default(value: object) -> msgpack.ExtType:
        assert isinstance(value, np.ndarray)
        return msgpack.ExtType(1, to_bytes(value))

    assert decode(msgpack.packb(fields, default=default), kind).seq == 7


def fields_of(message: Sample, **changes: object) -> bytes:
    fields = {**independent(numbered(message, 0)), **changes}
    fields = {name: value for name, value in fields.items() if value is not ...}
    return bytes(msgpack.packb(fields, default=lambda a: msgpack.ExtType(1, to_bytes(a))))


IMU, FRAME, SPEED, POSE, BLOCK, TARGET = (EXAMPLES[i] for i in (0, 2, 4, 5, 6, 7))
POINTS = EXAMPLES[-1]
NAN = float("nan")


@pytest.mark.parametrize(
    ("message", "changes", "cause"),
    [
        (IMU, {"gyro": ...}, "missing required field `gyro`"),
        (IMU, {"seq": ...}, "seq is missing"),
        (IMU, {"seq": -4}, "seq is -4"),
        (IMU, {"seq": 1.5}, "Expected `int`, got `float` - at `$.seq`"),
        (IMU, {"stamp": -1}, "Expected `int` >= 0 - at `$.stamp`"),
        (IMU, {"stamp": 2**63}, "stamp"),
        (IMU, {"stamp": "now"}, "Expected `int`, got `str` - at `$.stamp`"),
        (IMU, {"gyro": [1.0, 2.0]}, "Expected `array` of length 3"),
        (IMU, {"gyro": [1.0, 2.0, "x"]}, "Expected `float`, got `str`"),
        (IMU, {"gyro": [1.0, NAN, 2.0]}, "gyro is (1.0, nan, 2.0); NaN and infinity are not allowed"),
        (IMU, {"accel": [math.inf, 0, 0]}, "accel is (inf, 0.0, 0.0)"),
        (IMU, {"orientation": [1.0, 1.0, 0.0, 0.0]}, "orientation has norm 1.41421"),
        (IMU, {"orientation": [NAN, 0.0, 0.0, 0.0]}, "orientation has norm nan"),
        (IMU, {"calibration": [3, 3, 3, 9]}, "levels are 0..3"),
        (FRAME, {"scans": np.zeros((2, 6))}, "scans is of dtype float64; allowed are int16, int32, float32"),
        (FRAME, {"scans": np.zeros(6, np.int32)}, "scans has shape (6,); it takes 2 dimensions"),
        (FRAME, {"scans": np.zeros((0, 6), np.int32)}, "none of them empty"),
        (FRAME, {"scans": np.full((1, 2), np.nan, np.float32)}, "scans has elements that are NaN"),
        (FRAME, {"scans": [1, 2]}, "Expected `numpy.ndarray`, got `list` - at `$.scans`"),
        (FRAME, {"scan_period": 0.0}, "scan_period is 0.0; expected 1e-06 to 60 s"),
        (FRAME, {"range_start": NAN}, "range_start"),
        (SPEED, {"quality": NAN}, "quality is nan"),
        (SPEED, {"quality": -0.1}, "quality is -0.1"),
        (SPEED, {"speed": math.inf}, "speed is inf; NaN and infinity are not allowed"),
        (SPEED, {"valid": 1}, "Expected `bool`, got `int`"),
        (SPEED, {"velocity_cov": [-1.0, 0.0, 1.0]}, "variances are 0 or more"),
        (SPEED, {"velocity_cov": [1.0, 2.0, 1.0]}, "expected xy^2 to be at most xx times yy"),
        (SPEED, {"quality": 1e4}, "quality is 10000.0; it is 0 to 1000 m/s, or +inf"),
        (POSE, {"covariance": np.eye(5)}, "covariance has shape (5, 5), not (6, 6)"),
        (POSE, {"method": None}, "Expected `str`, got `None`"),
    ],
)  # fmt: skip
def test_what_breaks_the_contract_is_refused_by_name(message: Sample, changes: dict[str, Any], cause: str) -> None:
    with pytest.raises(MessageError) as caught:
        decode(fields_of(message, **changes), type(message))
    assert cause in str(caught.value)


@pytest.mark.parametrize(
    ("message", "changes", "cause"),
    [
        (IMU, {"gyro": [1e200, 0.0, 0.0]}, "gyro is (1e+200, 0.0, 0.0); expected -1e+06 to 1e+06 rad/s"),
        (IMU, {"gyro": [0.0, -1e10, 0.0]}, "gyro is (0.0, -10000000000.0, 0.0); expected -1e+06 to 1e+06 rad/s"),
        (IMU, {"accel": [0.0, 0.0, 9806.65]}, "accel is (0.0, 0.0, 9806.65); expected -4000 to 4000 m/s^2"),
        (IMU, {"linear_accel": [0.0, 1e10, 0.0]}, "expected -4010 to 4010 m/s^2"),
        (IMU, {"mag": [1e30, 0.0, 0.0]}, "expected -10000 to 10000 uT"),
        (FRAME, {"scans": np.array([[0, -1e30]], np.float32)}, "1e+30; expected -4.29497e+09 to 4.29497e+09"),
        (FRAME, {"scans": np.array([[0, 1e10j]], np.complex64)}, "scans has an element of 1e+10; expected"),
        (FRAME, {"scan_period": 1e-300}, "scan_period is 1e-300; expected 1e-06 to 60 s"),
        (FRAME, {"range_step": 1e200}, "range_step is 1e+200; expected 1e-05 to 1000 m"),
        (FRAME, {"range_start": -1e200}, "range_start is -1e+200; expected -1e+06 to 1e+06 m"),
        (FRAME, {"carrier": 1e200}, "carrier is 1e+200; expected 1e+06 to 1e+12 Hz"),
        (FRAME, {"bandwidth": 1e-200}, "bandwidth is 1e-200; expected 1 to 1e+12 Hz"),
        (SPEED, {"speed": 1e30}, "speed is 1e+30; expected -100 to 100 m/s"),
        (SPEED, {"velocity": [0.0, -1e200]}, "velocity is (0.0, -1e+200); expected -100 to 100 m/s"),
        (SPEED, {"delay": 1e308}, "delay is 1e+308; expected 0 to 60 s"),
        (SPEED, {"velocity_delay": -0.1}, "velocity_delay is -0.1; expected 0 to 60 s"),
        (SPEED, {"velocity_cov": [1e200, 0.0, 1.0]}, "expected -1e+12 to 1e+12 m^2/s^2"),
        (SPEED, {"rays": 10**9}, "rays is 1000000000; expected 0 to 1e+06"),
        (POSE, {"position": [1e200, 0.0, 0.0]}, "expected -4.1e+07 to 4.1e+07 m"),
        (POSE, {"velocity": [0.0, 0.0, 1e30]}, "velocity is (0.0, 0.0, 1e+30); expected -1000 to 1000 m/s"),
        (POSE, {"covariance": np.eye(6) * 1e200}, "covariance has an element of 1e+200; expected -1e+16 to 1e+16"),
        (POSE, {"covariance": -np.eye(6)}, "variances are 0 or more"),
        (BLOCK, {"samples": np.array([1e30], np.float32)}, "an element of 1e+30; expected -100000 to 100000"),
        (BLOCK, {"samples": np.array([0, -1e6j], np.complex64)}, "samples has an element of 1e+06; expected"),
        (BLOCK, {"sample_rate": 1e200}, "sample_rate is 1e+200; expected 10 to 1e+06 Hz"),
        (TARGET, {"range_rate": 1e200}, "range_rate is 1e+200; expected -1000 to 1000 m/s"),
        (TARGET, {"amplitude": 1e30}, "amplitude is 1e+30; expected 0 to 1e+06"),
        (TARGET, {"amplitude": -1e-3}, "amplitude is -0.001; expected 0 to 1e+06"),
        (TARGET, {"snr": -math.inf}, "snr is -inf; NaN and infinity are not allowed"),
        (TARGET, {"snr": 1e9}, "snr is 1000000000.0; expected -400 to 400 dB"),
        (TARGET, {"range": 1e30}, "range is 1e+30; expected 0 to 1e+06 m"),
        (TARGET, {"delay": 1e308}, "delay is 1e+308; expected 0 to 60 s"),
        (POINTS, {"position": np.full((1, 3), 1e5, np.float32)}, "position has an element of 100000; expected -10000"),
        (POINTS, {"position": np.zeros((1, 2), np.float32)}, "position has shape (1, 2); expected (n, 3)"),
        (POINTS, {"position": np.zeros((1, 3))}, "position is of dtype float64; allowed are float32"),
        (POINTS, {"doppler": np.zeros(0, np.float32)}, "doppler has 0 elements for 1 points; expected one for each"),
        (POINTS, {"doppler": np.array([np.nan], np.float32)}, "doppler has elements that are NaN or infinite"),
        (POINTS, {"snr": np.array([1e9], np.float32)}, "snr has an element of 1e+09; expected -400 to 400"),
        (POINTS, {"doppler_step": 0.0}, "doppler_step is 0.0; expected 1e-06 to 1000 m/s"),
    ],
)  # fmt: skip
def test_what_no_sensor_can_say_is_refused(message: Sample, changes: dict[str, Any], cause: str) -> None:
    with pytest.raises(MessageError) as caught:
        decode(fields_of(message, **changes), type(message))
    assert cause in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_a_sensor_says_when_it_is_wild_is_taken() -> None:
    """The ends of a BNO055's and an MPU9250's numbers, sound in counts of 16 bits, a velocity that is not observed."""
    for message in (
        Imu(stamp=1, gyro=(35.7, -35.8, 0.0), accel=(327.67, -327.68, 0.0), linear_accel=(-327.68, 0.0, 0.0)),
        Imu(stamp=1, gyro=(70.0, 0.0, 0.0), mag=(4912.0, -4912.0, 0.0)),
        RadarFrame(
            stamp=1, scans=np.full((1, 2), 2**31, np.float32), scan_period=0.01, range_start=-0.5, range_step=0.009,
            carrier=4.3e9, bandwidth=1.7e9,
        ),
        GroundSpeed(
            stamp=1, speed=0.0, quality=math.inf, rays=0, valid=False, velocity=(0.0, 0.0), velocity_cov=(1e6, 0.0, 1e6)
        ),
        DopplerBlock(stamp=1, samples=np.full(3, -32768, np.float32), sample_rate=4000.0, carrier=24.125e9),
    ):  # fmt: skip
        assert encode(decode(numbered(message, 0), type(message))) == encode(message)


def bounds_of(spec: dict[str, Any]) -> Iterator[tuple[float, float]]:
    """The bounds of a field's numbers, by its JSON Schema; raises KeyError where there are none."""
    if spec.get("type") in ("number", "integer"):
        yield spec["minimum"], spec["maximum"]
    for inner in (*spec.get("anyOf", ()), *spec.get("prefixItems", ())):
        yield from bounds_of(inner)


@pytest.mark.parametrize("message", [IMU, FRAME, SPEED, POSE, BLOCK, TARGET, POINTS], ids=lambda m: type(m).__name__)
def test_every_number_of_every_message_has_bounds_that_its_schema_says(message: Sample) -> None:
    """At a bound a number is taken, just beyond it is not: a new field without bounds fails here."""
    for name, spec in json_schema(type(message))["properties"].items():
        if name in ("stamp", "seq", "quality", "orientation", "velocity_cov"):  # quality may be +inf; the others: above
            continue
        found = list(bounds_of(spec))
        for i, (least, most) in enumerate(found):
            step = 1 if isinstance(most, int) else max(1e-9, abs(most) * 1e-9)
            for value, right in ((least, True), (most, True), (least - step, False), (most + step, False)):
                old = getattr(message, name)
                new = (*old[:i], value, *old[i + 1 :]) if isinstance(old, tuple) else value
                payload = fields_of(message, **{name: new})
                if right:
                    assert getattr(decode(payload, type(message)), name) == new
                else:
                    with pytest.raises(MessageError, match=name):
                        decode(payload, type(message))
        old = getattr(message, name)
        numbers = (
            len(old) if isinstance(old, tuple) else int(isinstance(old, int | float) and not isinstance(old, bool))
        )
        assert len(found) == numbers, f"{name} is not bounded"


def test_truncated_trailing_oversized_and_foreign_bytes_are_refused() -> None:
    good = numbered(IMU, 0)
    for bad in (good[:-1], good + b"\x00", b"", bytes(MAX_PAYLOAD + 1), b"\x90", encode(IMU)[1:], b"\x81" * 5000):
        with pytest.raises(MessageError):
            decode(bad, Imu)


def test_a_sample_of_another_type_is_refused() -> None:
    with pytest.raises(MessageError, match="missing required field"):
        decode(numbered(POSE, 0), Imu)


@given(st.binary(max_size=300))
def test_no_bytes_raise_anything_but_a_message_error(payload: bytes) -> None:
    for kind in SAMPLES.values():
        with pytest.raises(MessageError):
            decode(payload, kind)


@given(st.data())
def test_no_damage_to_a_good_sample_raises_anything_but_a_message_error(data: st.DataObject) -> None:
    message = data.draw(st.sampled_from(EXAMPLES))
    payload = bytearray(numbered(message, 1))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    try:
        again = decode(bytes(payload), type(message))
    except MessageError:
        return
    decode(encode(again), type(message))  # whatever was taken can be sent on


arrays = st.sampled_from(sorted(LITTLE_ENDIAN)).flatmap(
    lambda letter: hnp.arrays(LITTLE_ENDIAN[letter], hnp.array_shapes(min_dims=1, max_dims=4, max_side=4))
)


@given(arrays)
def test_arrays_come_back_bit_by_bit(array: np.ndarray[Any, Any]) -> None:
    again = from_bytes(memoryview(to_bytes(array)))
    assert again.dtype == array.dtype
    assert again.shape == array.shape
    assert again.tobytes() == array.tobytes()


def test_arrays_in_other_orders_come_back_in_c_order() -> None:
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    for view in (array.T, array[::-1], array.astype(">f4")):
        np.testing.assert_array_equal(from_bytes(memoryview(to_bytes(view))), view)


def test_arrays_that_the_wire_lacks_are_not_sent() -> None:
    for bad in (np.zeros(3, np.uint16), np.array(["x"]), np.zeros((1, 1, 1, 1, 1)), np.float64(3.0)):
        with pytest.raises(MessageError):
            to_bytes(np.asarray(bad))


@given(st.binary(max_size=60))
def test_no_bytes_make_an_array_that_is_not_there(data: bytes) -> None:
    try:
        array = from_bytes(memoryview(data))
    except MessageError:
        return
    assert array.nbytes <= len(data)


def test_a_number_that_numpy_made_is_no_plain_number() -> None:
    careless: Any = np.float32(1.0)
    with pytest.raises(MessageError, match=r"call \.item\(\)"):
        encode(GroundSpeed(stamp=1, speed=careless, quality=0.0, rays=1, valid=True))


@pytest.mark.parametrize("kind", SAMPLES.values(), ids=lambda k: k.__name__)
def test_the_json_schema_names_every_field_and_demands_the_required_ones(kind: type[Sample]) -> None:
    schema = json_schema(kind)
    assert schema["title"] == kind.schema
    assert set(schema["properties"]) == set(kind.__struct_fields__)
    assert {"stamp", "seq"} <= set(schema["required"])
    optional = {name for name, spec in schema["properties"].items() if "default" in spec}
    assert optional == set(kind.__struct_fields__) - set(schema["required"])


def test_keys_are_built_and_taken_apart() -> None:
    assert sample_key("cane", "imu", "imu") == "cane/imu/imu"
    assert control_key("cane", "progress", "imu") == "cane/@/progress/imu"
    assert stream_of("elsewhere/radar/frame") == ("radar", "frame")
    with pytest.raises(ValueError, match="not a sample's key"):
        stream_of("cane/@/start")


@pytest.mark.parametrize("message", [IMU, FRAME], ids=["Imu", "RadarFrame"])
def test_encode_cost(benchmark: Any, message: Sample) -> None:
    benchmark(numbered, message, 1)


@pytest.mark.parametrize("message", [IMU, FRAME], ids=["Imu", "RadarFrame"])
def test_decode_cost(benchmark: Any, message: Sample) -> None:
    benchmark(decode, numbered(message, 1), type(message))


def test_the_page_of_messages_says_what_the_code_does() -> None:
    page = (Path(__file__).parents[1] / "docs" / "messages.md").read_text(encoding="utf-8")
    assert page == with_tables(page), "run: make docs"
    assert set(re.findall(r"<!-- table (\w+) -->", page)) == {kind.__name__ for kind in SAMPLES.values()}
