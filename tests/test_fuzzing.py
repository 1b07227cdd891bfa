"""Bytes that nobody would send, to everything that reads bytes: an answer, or one line of an expected error.

In CI each target has a few seconds. `make soak` gives it CANEFLOW_FUZZ_TIMES as many examples, 100 when it is not set;
one target by hand: `pytest -m long tests/test_fuzzing.py -k recording`.
"""

import io
import os
import re
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import msgpack
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import Writer

from caneflow.messages import SAMPLES, Imu, MessageError, decode, encode, json_schema, numbered
from caneflow.messages.control import Clock, Counters, FlowStatus, LeftOut, Progress, Window
from caneflow.protocols import bno055, mrm
from caneflow.protocols.bno055_chip import Chip, Setup
from caneflow.protocols.bno055_emulator import Bench, Emulator, Faults, Motion
from caneflow.protocols.bno055_link import UartLink
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm_logs import parse_log
from caneflow.protocols.mrm_scans import Scan, ScanAssembler, split_scan
from caneflow.protocols.mrm_serial import SerialDeframer, framed
from caneflow.recording import Recording, RecordingError, RecordingWriter, recover, writer
from caneflow.recording.layout import MAGIC, MAX_CHUNK, RECORD
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.errors import DataflowError

ROOT = Path(__file__).parents[1]
TIMES = int(os.environ.get("CANEFLOW_FUZZ_TIMES", "100"))


def budget(examples: int) -> pytest.MarkDecorator:
    """So many examples in CI, and TIMES as many by hand."""
    long = pytest.param(examples * TIMES, marks=[pytest.mark.long, pytest.mark.timeout(7200)], id="long")
    return pytest.mark.parametrize("examples", [pytest.param(examples, id="short"), long])


def for_all(examples: int, *strategies: st.SearchStrategy[Any]) -> Callable[[Callable[..., None]], None]:
    """Run the function under it on so many draws of the strategies."""

    def run(holds: Callable[..., None]) -> None:
        checks = list(HealthCheck)  # a busy machine is not a failure
        settings(max_examples=examples, deadline=None, suppress_health_check=checks)(given(*strategies)(holds))()

    return run


@st.composite
def damage(draw: st.DrawFn, whole: bytes) -> bytes:
    """`whole` with a few bytes flipped, cut out, put in, written over or changed for others."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 5))):
        start = draw(st.integers(0, len(data)))
        end = min(len(data), start + draw(st.integers(1, 40)))
        match draw(st.sampled_from(["flip", "cut", "put", "write over", "swap", "repeat", "end"])):
            case "flip" if start < len(data):
                data[start] ^= 1 << draw(st.integers(0, 7))
            case "cut":
                del data[start:end]
            case "put":
                data[start:start] = draw(st.binary(min_size=1, max_size=20))
            case "write over":
                data[start:end] = draw(st.sampled_from([b"\0", b"\xff", b"\x7f", b"\x80"])) * (end - start)
            case "swap":
                piece = data[start:end]
                del data[start:end]
                to = draw(st.integers(0, len(data)))
                data[to:to] = piece
            case "repeat":
                data[start:start] = data[start:end] * draw(st.integers(1, 20))
            case "end":
                del data[end:]
    return bytes(data)


# --- messages -------------------------------------------------------------------------------------------------------

KINDS: list[Any] = [*SAMPLES.values(), Clock, Counters, FlowStatus, LeftOut, Progress, Window]
SIZES = st.sampled_from([0, 1, 2, 3, 6, 255, 2**16, 2**31, 2**32 - 1])


def an_array(letter: bytes, shape: list[int], elements: bytes) -> msgpack.ExtType:
    return msgpack.ExtType(1, letter + bytes([len(shape)]) + struct.pack(f"<{len(shape)}I", *shape) + elements)


scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.sampled_from([-1, 2**31, 2**53, 2**63 - 1, 2**63, 2**64 - 1]),
    st.floats(),
    st.text(max_size=6),
    st.binary(max_size=6),
    st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=20)),
    st.builds(
        an_array,
        st.sampled_from([bytes([c]) for c in b"BhiqfdFDlO"]),
        st.lists(SIZES, max_size=5),
        st.binary(max_size=9),
    ),
    st.builds(lambda n: an_array(b"d", [6, 6], struct.pack("<d", n) * 36), st.floats()),
)
values = st.recursive(
    scalars,
    lambda inside: st.one_of(
        st.lists(inside, max_size=7), st.dictionaries(st.text(max_size=4) | st.integers(-9, 2**63), inside, max_size=3)
    ),
    max_leaves=10,
)


@st.composite
def messages(draw: st.DrawFn) -> tuple[Any, bytes]:
    """A kind of message, and a map with its keys; most values are of the right type, and some of those are hostile."""
    kind = draw(st.sampled_from(KINDS))
    fields = {}
    for name, schema in json_schema(kind)["properties"].items():
        like = draw(st.integers(0, 3)) > 0
        if like or draw(st.booleans()):
            fields[name] = draw(fitting(schema) if like else values)
    return kind, msgpack.packb(fields)


def fitting(schema: dict[str, Any]) -> st.SearchStrategy[Any]:
    """Values of about the type that the schema asks for."""
    alternatives = [one for one in schema.get("anyOf", [schema]) if one.get("type") != "null"]
    numbers: dict[str, st.SearchStrategy[Any]] = {
        "integer": st.integers(-1, 2**64 - 1) | st.integers(0, 3),
        "number": st.floats() | st.floats(0, 2) | st.integers(-3, 3),
        "string": st.text(max_size=4),
        "boolean": st.booleans(),
        "array": st.integers(2, 4).flatmap(lambda n: st.lists(st.floats(-1, 1) | st.floats(), min_size=n, max_size=n)),
        "object": st.dictionaries(st.text(max_size=4), values, max_size=2),
    }
    array = st.builds(
        lambda letter, shape, fill: an_array(letter, shape, bytes([fill]) * (4 * int(np.prod(shape)))),
        st.sampled_from([b"i", b"f"]),
        st.lists(st.integers(1, 3), min_size=1, max_size=2),
        st.integers(0, 255),
    )
    return st.one_of(*(numbers.get(str(one.get("type")), array) for one in alternatives))


@budget(120)
def test_no_map_is_answered_by_anything_but_a_message_or_its_refusal(examples: int) -> None:
    @for_all(examples, messages())
    def holds(drawn: tuple[Any, bytes]) -> None:
        kind, payload = drawn
        try:
            message = decode(payload, kind)
        except MessageError as error:
            assert str(error)
        else:
            decode(encode(message), kind)  # what was taken can be sent on


@pytest.mark.parametrize(
    "head", [b"\xdf\xff\xff\xff\xff", b"\x81\xdb\xff\xff\xff\xff", b"\x81\xa1a\xc9\xff\xff\xff\xff\x01", b"\x91" * 9999]
)
def test_a_message_that_announces_more_than_it_has_takes_no_memory(head: bytes) -> None:
    tracemalloc.start()
    try:
        for kind in KINDS:
            with pytest.raises(MessageError):
                decode(head, kind)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


# --- dataflow.yaml --------------------------------------------------------------------------------------------------

SOUND_FLOWS = [path.read_text() for path in (ROOT / "dataflow.yaml", *sorted((ROOT / "dataflows").glob("*.yaml")))]
BOMB = "[&a0 [x, x, x, x], " + ", ".join(f"&a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]" for i in range(1, 30)) + "]"
MERGES = "[&m0 {x: 1}, " + ", ".join(f"&m{i} {{<<: [*m{i - 1}, *m{i - 1}, *m{i - 1}]}}" for i in range(1, 30)) + "]"
HOSTILE = [
    "0x" + "f" * 9000, "-0o" + "7" * 9000, "9" * 5000, "1" + "0" * 400, "1e999", "-.inf", ".nan", "0b1", "1:30:00",
    "[" * 40 + "]" * 40, "{a: " * 40 + "}" * 40, '"\\0"', '"\\ud800"', '"\\U00110000"', "!!int x", "!!float [1]",
    "!!binary aGk=", "!!set {a}", "!!omap [a: b]", "!!python/object:os.system {}", "! x", "{? [a] : b, ? {c: d} : e}",
    "{a: 1, a: 2, a: 3}", "{7: 1, null: 2, true: 3, 1.5: 4}", '{"\\ud800": 1}', '{<<: {"\\ud800": 1, 7: 2}}', "{<<: x}",
    "&self [*self]", "&me {<<: *me}", "&me {x: {<<: *me}}", BOMB, MERGES, "[]", "{}", "''", "~", "yes", "|\n  x", "=",
    "drivers.bno055", "./nosuch.py", "/dev/zero", "..", "a/" * 3000, "imu/imu", "tcp/[::1]:99999", "2020-13-45",
]  # fmt: skip


@st.composite
def hostile_flows(draw: st.DrawFn) -> str:
    """A dataflow of this repository, with hostile values in the place of some of its own."""
    text = draw(st.sampled_from(SOUND_FLOWS))
    for _ in range(draw(st.integers(1, 3))):
        found = list(re.finditer(r"(?<=[:\[,] )[^\s,{}\[\]#]+|(?<=: )[\[{].*[\]}]$|^ *\w+(?=:)", text, re.MULTILINE))
        if found:
            at = draw(st.sampled_from(found))
            text = text[: at.start()] + draw(st.sampled_from(HOSTILE)) + text[at.end() :]
    return text


rigs = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**400), 10**400) | st.floats() | st.text(max_size=4),
    lambda inside: st.one_of(
        st.lists(inside, max_size=4),
        st.dictionaries(st.text(max_size=4) | st.sampled_from(["boresight", "sensors", "k"]), inside, max_size=3),
    ),
    max_leaves=8,
)


def must_be_lines(error: DataflowError, path: Path) -> None:
    lines = str(error).split("\n")
    assert len(lines) == len(error.problems) >= 1
    for line in lines:
        assert re.match(rf"{re.escape(str(path))}:\d+:\d+: \S|rig of the recording", line), line
        line.encode()  # can be printed
        assert len(line) < 20_000


@budget(40)
def test_no_dataflow_is_answered_by_anything_but_a_graph_or_lines(examples: int, tmp_path: Path) -> None:
    path = tmp_path / "dataflow.yaml"

    @for_all(
        examples, hostile_flows(), st.dictionaries(st.sampled_from(["boresight", "sensors", "x"]), rigs, max_size=2)
    )
    def holds(text: str, rig: dict[str, Any]) -> None:
        path.write_text(text)
        try:
            load(path, rig=rig)
        except DataflowError as error:
            must_be_lines(error, path)


KEYS = ", ".join(f"k{i}: 1" for i in range(3000))
BOMBS = {
    "aliases of aliases": f"flow: demo\nrig: {BOMB}\n",
    "merges of merges": f"flow: demo\nrig: {MERGES}\n",
    "a large mapping, merged often": f"b: &b {{{KEYS}}}\na: {{<<: [{', '.join(['*b'] * 5_000)}]}}\n",
    "wires that dangle": "flow: demo\nnodes:\n"
    + "".join(f"  n{i}: {{run: operators.attitude, inputs: {{imu: x{i}/imu}}}}\n" for i in range(300)),
    "unknown keys": f"flow: demo\nnodes: {{imu: {{run: drivers.bno055, settings: {{{KEYS}}}}}}}\n",
    "the same key": "flow: demo\n" * 3_000,
    "brackets": "flow: " + "[" * 1_200,
    "dashes": "- " * 100_000,
    "question marks": "? " * 100_000,
    "quotes": "flow: '" + "''" * 100_000,
    "anchors": "flow: [" + "".join(f"&a{i} x, " for i in range(5000)) + "]\n",
}


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", BOMBS)
def test_a_dataflow_that_stands_for_too_much_ends_soon(tmp_path: Path, name: str) -> None:
    path = tmp_path / "dataflow.yaml"
    path.write_text(BOMBS[name])
    with pytest.raises(DataflowError) as caught:
        load(path)
    must_be_lines(caught.value, path)


def test_a_number_of_thousands_of_digits_may_be_set_nowhere(tmp_path: Path) -> None:
    path = tmp_path / "dataflow.yaml"
    path.write_text(SOUND_FLOWS[0])
    with pytest.raises(DataflowError, match=r"^--set imu\.rate=0xf+: is a number that is too large for any setting"):
        load(path, [f"imu.rate=0x{'f' * 9000}"])


def test_what_is_merged_brings_what_was_merged_there(tmp_path: Path) -> None:
    path = tmp_path / "dataflow.yaml"
    path.write_text(
        "flow: demo\nnodes:\n"
        "  one: &one {run: drivers.bno055, settings: &settings {port: /dev/ttyS1}}\n"
        "  two: &two {<<: *one, ready_timeout_s: 5}\n"
        "  three: {<<: *two, settings: {<<: *settings}}\n"
    )
    three = load(path).nodes["three"]
    assert (three.run, three.ready_timeout_s, three.settings_map) == ("drivers.bno055", 5.0, {"port": "/dev/ttyS1"})


# --- the radar's and the IMU's protocols ----------------------------------------------------------------------------


def a_scan(number: int) -> Scan:
    return Scan(
        source_id=7,
        message_id=number,
        timestamp_ms=1000 + 10 * number,
        scan_start_ps=23342,
        scan_stop_ps=81935,
        scan_step_bins=32,
        scan_type=1,
        antenna_id=2,
        operation_mode=1,
        samples=np.random.default_rng(number).integers(-(10**6), 10**6, 400, dtype=np.int32),
    )


SCANS = [a_scan(number) for number in range(8)]
PACKETS = [[mrm.build(packet) for packet in split_scan(scan)] for scan in SCANS]
OTHERS = [mrm.build(mrm.ReadyInfo(message_id=1)), mrm.build(mrm.ControlConfirm(message_id=2))]


def on_the_wire(packets: list[bytes], *, crc: bool) -> bytes:
    return b"".join(framed(packet, crc=crc) for packet in packets)


def scans_in(stream: bytes, *, crc: bool, cut: int) -> list[Scan]:
    """What a driver makes of a serial stream that comes in pieces of `cut` bytes."""
    deframer, assembler = SerialDeframer(crc=crc), ScanAssembler()
    found: list[Scan] = []
    for at in range(0, len(stream), cut):
        for data in deframer.feed(stream[at : at + cut]):
            try:
                message = mrm.parse(data)
            except ProtocolError as error:
                assert "\n" not in str(error)
                continue
            if isinstance(message, mrm.ScanInfo):
                found += assembler.feed(message)
    return [*found, *assembler.finish()]


@budget(80)
def test_a_damaged_serial_stream_gives_scans_that_were_sent_and_goes_on_after_it(examples: int) -> None:
    damaged = damage(on_the_wire([*PACKETS[0], OTHERS[0], *PACKETS[1], OTHERS[1], *PACKETS[2]], crc=True))
    # A length that was damaged may take the first packet after it along; those that follow come through.
    rest = on_the_wire([packet for each in PACKETS[3:] for packet in each], crc=True)

    @for_all(examples, damaged, st.integers(1, 3000))
    def holds(stream: bytes, cut: int) -> None:
        found = scans_in(stream + rest, crc=True, cut=cut)
        sent = {scan.message_id: scan for scan in SCANS}
        for scan in found:
            assert np.array_equal(scan.samples, sent[scan.message_id].samples)
        assert [scan.message_id for scan in found][-3:] == [5, 6, 7]


@budget(80)
def test_without_checksums_no_stream_raises_anything(examples: int) -> None:
    @for_all(examples, damage(on_the_wire([packet for each in PACKETS for packet in each], crc=False)))
    def holds(stream: bytes) -> None:
        for scan in scans_in(stream, crc=False, cut=1000):
            assert scan.samples.dtype == np.int32


@budget(80)
def test_a_damaged_log_is_read_or_refused(examples: int) -> None:
    packets = b"".join(packet.ljust(mrm.SCAN_INFO_BYTES, b"\0") for each in PACKETS[:3] for packet in each)

    @for_all(examples, damage(bytes(32) + packets))
    def holds(data: bytes) -> None:
        try:
            parse_log(data)
        except ProtocolError as error:
            assert "\n" not in str(error)


class NoisyBench(Bench):
    """A chip at the end of a line that changes bytes, or loses them, as long as there is damage left."""

    def __init__(self, emulator: Emulator, damages: list[tuple[bool, int, int]]) -> None:
        super().__init__(emulator, time=bno055.START_UP)
        self._damages = damages  # whether of the answer; which byte; its new value, negative: it is lost

    def write(self, data: bytes, /) -> None:
        super().write(self._damaged(data, answer=False))

    def read(self, size: int = 1, /) -> bytes:
        return self._damaged(super().read(size), answer=True)

    def _damaged(self, data: bytes, *, answer: bool) -> bytes:
        if not (data and self._damages and self._damages[-1][0] == answer):
            return data
        _, at, value = self._damages.pop()
        at %= len(data)
        return data[:at] + (b"" if value < 0 else bytes([value])) + data[at + 1 :]


STILL = bno055.registers(
    bno055.Measurement(
        gyro=(0.1, 0.0, 0.0),
        orientation=(1.0, 0.0, 0.0, 0.0),
        linear_accel=(0.0, 0.0, 0.0),
        gravity=(0.0, 0.0, 9.81),
        temperature=25,
        calibration=(3, 3, 3, 3),
        accel=(0.0, 0.0, 9.81),
        mag=(20.0, 0.0, -40.0),
    )
)


@budget(60)
def test_a_chip_on_a_bad_line_is_refused_or_read_and_works_again_when_the_line_does(examples: int) -> None:
    @for_all(examples, st.lists(st.tuples(st.booleans(), st.integers(0, 50), st.integers(-80, 255)), max_size=30))
    def holds(damages: list[tuple[bool, int, int]]) -> None:
        motion = Motion(times=[0.0, 1000.0], blocks=[STILL, STILL])
        bench = NoisyBench(Emulator(motion, Faults(), np.random.default_rng(1), now=0.0), damages)
        chip = Chip(UartLink(bench, bench.pause, bench.now_ns), bench.pause)
        for action in (
            lambda: chip.set_up(Setup()),
            *[lambda: chip.read(bno055.WHOLE)] * 5,
            chip.identity,
            chip.profile,
        ):
            try:
                action()
            except ProtocolError as error:
                assert "\n" not in str(error)
        damages.clear()
        bench.pause(2 * bno055.START_UP)
        chip.set_up(Setup())
        bench.pause(1.0)
        assert chip.read(bno055.WHOLE).values == STILL[: bno055.VALUES_END]


# --- recordings -----------------------------------------------------------------------------------------------------

KEY = "cane/imu/imu"


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """The bytes of small recordings with many chunks, packed in each of the ways there are."""
    folder = tmp_path_factory.mktemp("sound")
    made = []
    for packing in ("zstd", "lz4", "none"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(writer, "CHUNK_SIZE", 300)
            with RecordingWriter(
                folder / packing, flow="cane", source="live", rig={"hand_height": 0.95}, compression=packing
            ) as recording:
                for seq in range(30):
                    payload = numbered(Imu(stamp=seq, gyro=(0.1, 0.2, seq)), seq)
                    recording.write(KEY, Imu, payload, stamp=seq, seq=seq, log_time=seq)
                    if seq % 7 == 0:
                        recording.write_control("cane/@/late", "caneflow.LeftOut/1", b"\x80", log_time=seq)
        made.append((folder / packing).read_bytes())
    return made


def records_of(whole: bytes) -> list[bytes]:
    found, at = [], len(MAGIC)
    while at + RECORD.size <= len(whole) - len(MAGIC):
        _, length = RECORD.unpack_from(whole, at)
        found.append(whole[at : at + RECORD.size + length])
        at += RECORD.size + length
    return found


NUMBERS = st.sampled_from([0, 1, 2**16 - 1, 2**31, 2**32 - 1, 2**33, 2**40, 2**63 - 1, 2**63, 2**64 - 1])


@st.composite
def with_other_records(draw: st.DrawFn, whole: bytes) -> bytes:
    """The file with whole records changed for others, left out, repeated, or with other numbers in them."""
    records = records_of(whole)
    places = st.integers(0, len(records) - 1)
    for _ in range(draw(st.integers(1, 3))):
        one, other = draw(places), draw(places)
        match draw(st.sampled_from(["swap", "repeat", "leave out", "kind", "number", "number"])):
            case "swap":
                records[one], records[other] = records[other], records[one]
            case "repeat":
                records[one] += records[other]
            case "leave out":
                records[one] = b""
            case "kind" if records[one]:
                records[one] = bytes([draw(st.integers(0, 20))]) + records[one][1:]
            case "number" if len(records[one]) > 20:
                width = draw(st.sampled_from([2, 4, 8]))
                at = draw(st.integers(1, len(records[one]) - width))
                number = draw(NUMBERS) % 2 ** (8 * width)
                records[one] = records[one][:at] + number.to_bytes(width, "little") + records[one][at + width :]
    changed = MAGIC + b"".join(records) + MAGIC
    return with_right_checksum(changed) if draw(st.booleans()) else changed


def with_right_checksum(whole: bytes) -> bytes:
    """The file with the check sum that its summary has now, or else the summary is not looked at."""
    at = len(whole) - len(MAGIC) - RECORD.size - 20
    if at < len(MAGIC) or whole[at] != Opcode.FOOTER:
        return whole
    (start,) = struct.unpack_from("<Q", whole, at + RECORD.size)
    if not len(MAGIC) <= start <= at:
        return whole
    checksum = zlib.crc32(whole[start : at + RECORD.size + 16])
    return whole[: at + RECORD.size + 16] + struct.pack("<I", checksum) + MAGIC


def read_all(path: Path) -> int:
    """Read everything that is in a recording in every way there is; how many messages there are."""
    with Recording(path) as recording:
        samples = list(recording.samples())
        for sample in samples:
            try:
                sample.decoded()
            except RecordingError as error:
                assert "\n" not in str(error)
        between = list(recording.samples(start_ns=5, end_ns=20))
        assert len(between) <= len(samples)
        recording.span()
        said = sum(len(list(recording.said(key))) for key in recording.control)
        return len(samples) + said


def must_be_read_or_refused(path: Path) -> None:
    """Either all of it can be read, or one line says why not; what can be saved is counted and sound."""
    saved = path.with_name("saved.mcap")
    try:
        read_all(path)
    except RecordingError as error:
        assert "\n" not in str(error)
    try:
        found = recover(path, saved)
    except RecordingError as error:
        assert "\n" not in str(error)
        return
    try:
        assert read_all(saved) == sum(found.messages.values())
    except RecordingError as error:
        assert re.search("no metadata record|both .* are in it|the rig in it|no stream|a sample is msgpack", str(error))


@budget(150)
@pytest.mark.parametrize("how", [damage, with_other_records])
def test_a_damaged_recording_is_read_or_refused_and_what_is_saved_of_it_is_counted(
    examples: int, tmp_path: Path, recordings: list[bytes], how: Callable[[bytes], st.SearchStrategy[bytes]]
) -> None:
    path = tmp_path / "walk.mcap"

    @for_all(examples, st.sampled_from(recordings).flatmap(how))
    def holds(data: bytes) -> None:
        path.write_bytes(data)
        must_be_read_or_refused(path)


def a_chunk(packing: str, packed: bytes, says: int) -> bytes:
    name = packing.encode()
    body = struct.pack("<QQQII", 0, 1, says, 0, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    return RECORD.pack(Opcode.CHUNK, len(body)) + body


NOTHING = bytes(4 * MAX_CHUNK)  # a few kB when it is packed
SECRETIVE = zstandard.ZstdCompressor(write_content_size=False)


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    ("packing", "pack", "says"),
    [
        ("zstd", zstandard.compress, len(NOTHING)),
        ("zstd", zstandard.compress, 1000),
        ("zstd", SECRETIVE.compress, len(NOTHING)),
        ("zstd", SECRETIVE.compress, 1000),
        ("zstd", lambda _: zstandard.compress(b"x"), 2**62),
        ("lz4", lz4.frame.compress, len(NOTHING)),
        ("lz4", lz4.frame.compress, 1000),
        ("lz4", lambda _: lz4.frame.compress(b"x"), 2**62),
        ("none", lambda _: b"x", 2**40),
    ],
)
def test_a_chunk_that_unpacks_to_gigabytes_is_damaged(
    tmp_path: Path, recordings: list[bytes], packing: str, pack: Callable[[bytes], bytes], says: int
) -> None:
    head = b"".join(record for record in records_of(recordings[2]) if record[0] in (Opcode.HEADER, Opcode.METADATA))
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MAGIC + head + a_chunk(packing, pack(NOTHING), says))
    tracemalloc.start()
    try:
        with pytest.raises(RecordingError, match=r"damaged at byte \d+; `caneflow recover"):
            Recording(path)
        assert tracemalloc.get_traced_memory()[1] < MAX_CHUNK // 8
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "rig", ['{"a":' * 500 + "1" + "}" * 500, '{"a": ' + "[" * 100_000, '{"a": "\\ud800"}', "[]", "", "9" * 5000, "{"]
)
def test_a_rig_that_is_none_is_one_line(tmp_path: Path, rig: str) -> None:
    path = tmp_path / "walk.mcap"
    text = io.BytesIO()
    made = Writer(text)
    made.start()
    made.add_metadata("caneflow", {"flow": "cane"})
    made.add_metadata("rig", {"json": rig})
    made.finish()  # type: ignore[no-untyped-call]  # mcap leaves it without a return type
    path.write_bytes(text.getvalue())
    with pytest.raises(RecordingError, match=r"^[^\n]*: the rig in it [^\n]*$"):
        Recording(path)
