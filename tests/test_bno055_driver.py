"""The BNO055's driver against an emulated chip, on a clock that goes on only when the driver waits.

So seconds of unplugged cables and hung chips pass at once. That it works over a real port shows test_emulate_bno055.
"""

import json
import logging
import math
import re
import termios
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import pairwise, takewhile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from caneflow.messages import Imu
from caneflow.messages.rig import Rig
from caneflow.protocols import bno055 as chip_registers
from caneflow.protocols.bno055 import WHOLE, Measurement, Register, measurement, registers
from caneflow.protocols.bno055_emulator import LEARNT, Bench, Emulator, Faults, Motion
from caneflow.protocols.bno055_link import UartLink
from caneflow.runtime import Context, Quiet
from caneflow.runtime.dataflow.programs import validated_settings
from caneflow.runtime.errors import DataflowError
from drivers import bno055 as driver

EPOCH = 1_700_000_000_000_000_000  # ns, when the bench's clock began
Item = tuple[float, Imu | None]  # s on the bench's clock; None for a Quiet


class Desk(Bench):
    """A bench whose cable can be pulled."""

    def __init__(self, emulator: Emulator, outages: tuple[tuple[float, float], ...] = (), power: bool = True) -> None:
        super().__init__(emulator)
        self.outages = list(outages)  # (from, to), s
        self.power = power  # stays on without the cable
        self.opened = 0
        self.clock_set_back = 0  # ns

    def require_plug(self) -> None:
        if not self.outages or self.time < self.outages[0][0]:
            return
        if self.time < self.outages[0][1]:
            raise OSError(5, "Input/output error")
        _, plugged_in = self.outages.pop(0)
        if not self.power:
            self.emulator.power_on(plugged_in)

    def write(self, data: bytes, /) -> None:
        self.require_plug()
        super().write(data)

    def read(self, size: int = 1, /) -> bytes:
        self.require_plug()
        return super().read(size)

    def reset_input_buffer(self) -> None:
        try:
            self.require_plug()
        except OSError as error:
            raise termios.error(5, "Input/output error") from error  # which is no OSError
        super().reset_input_buffer()

    def now_ns(self) -> int:
        return EPOCH + super().now_ns() - self.clock_set_back


def motion(count: int, levels: tuple[int, int, int, int] = (3, 3, 3, 3)) -> Motion:
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
                calibration=levels,
                accel=vector(5.0),
                mag=vector(30.0),
            )
        )
        for i in range(count)
    ]
    return Motion(times=[0.01 * i for i in range(count)], blocks=blocks)


def desk(of: Motion, faults: Faults = Faults(), **options: Any) -> Desk:  # noqa: B008 - frozen
    return Desk(Emulator(of, faults, np.random.default_rng(7), now=0.0), **options)


@pytest.fixture
def source(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes a driver on a desk."""

    def make(on: Desk, **settings: Any) -> driver.Bno055:
        @contextmanager
        def opened(_: object) -> Iterator[UartLink]:
            on.require_plug()
            on.opened += 1
            yield UartLink(on, on.pause, on.now_ns)

        clock = SimpleNamespace(monotonic=lambda: on.time, sleep=on.pause, time_ns=on.now_ns)
        monkeypatch.setattr(driver, "time", clock)
        monkeypatch.setattr(driver, "opened", opened)
        context = Context(node="imu", rig=Rig(), ports={"imu": Imu}, random=np.random.default_rng(0))
        return driver.Bno055(validated_settings(driver.Bno055, settings), context)

    return make


def brought(made: driver.Bno055, on: Desk, seconds: float) -> list[Item]:
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


def test_the_samples_are_what_the_chip_measured(source: Any) -> None:
    moved = motion(300)
    on = desk(moved)
    got = [sample for _, sample in samples_of(brought(source(on), on, 3.0))]
    for sample, block in zip(got, moved.blocks, strict=False):
        said = measurement(WHOLE, block)
        assert sample.gyro == said.gyro
        assert sample.accel == said.accel
        assert sample.mag == said.mag
        assert sample.orientation == said.orientation
        assert sample.linear_accel == said.linear_accel
        assert sample.calibration == (3, 3, 3, 3)
    assert len(got) > 220  # of 3 s, with the start of chip, clock and fusion
    steps = [(b.stamp - a.stamp) * 1e-9 for a, b in pairwise(got)]
    assert min(steps) > 0.005
    assert max(steps) < 0.015
    assert np.mean(steps) == pytest.approx(0.01, abs=2e-4)


def test_what_is_set_is_what_the_chip_gets(source: Any) -> None:
    on = desk(motion(100))
    made = source(on, mode="imu", axes="+y-x+z", external_crystal=False, accel_and_mag=False, rate=50)
    got = samples_of(brought(made, on, 1.4))
    assert all(sample.accel is None and sample.mag is None for _, sample in got)
    assert {round((b.stamp - a.stamp) * 1e-6) for (_, a), (_, b) in pairwise(got)} == {20}
    link = UartLink(on, on.pause, on.now_ns)
    assert link.read(Register.AXIS_MAP, 2).data == b"\x21\x02"
    assert link.read(Register.MODE, 1).data[0] & 0x0F == 0x08
    assert link.read(Register.TRIGGER, 1).data == b"\0"


def test_imu_mode_gives_no_magnetic_field(source: Any) -> None:
    on = desk(motion(100))
    got = samples_of(brought(source(on, mode="imu"), on, 1.0))
    assert got
    assert all(sample.mag is None and sample.accel is not None for _, sample in got)


def test_before_the_fusion_has_begun_there_is_no_sample(source: Any, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    on = desk(motion(100))
    brought(source(on), on, 1.2)
    assert " without orientation" in caplog.messages[-1]


def test_a_chip_left_on_page_1_is_found(source: Any) -> None:
    on = desk(motion(200), Faults(page=1))
    assert len(samples_of(brought(source(on), on, 2.0))) > 120


def test_what_the_chip_cannot_measure_is_dropped_counted_and_said_once(
    source: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """One reading in ten with a value at the end of its register, with zeros, or with 0xFF throughout."""
    caplog.set_level(logging.INFO)
    moved = motion(2000)
    on = desk(moved, Faults(glitches=0.1))
    got = [sample for _, sample in samples_of(brought(source(on), on, 20.0))]
    true = {measurement(WHOLE, block).gyro: measurement(WHOLE, block) for block in moved.blocks}
    for sample in got:
        said = true[sample.gyro]
        assert (sample.accel, sample.mag, sample.orientation) == (said.accel, said.mag, said.orientation)
        assert sample.linear_accel == said.linear_accel
    assert on.emulator.tally.glitches > 150
    assert len(got) > 1650
    warned = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(set(warned)) == len(warned), "each cause once"
    assert {text.split(" beyond")[0].rpartition(" ")[2] for text in warned} == {
        "gyro",
        "accel",
        "linear_accel",
        "mag",
        "temperature",
    }
    dropped = re.search(r"(\d+) without orientation, (\d+) dropped as impossible", caplog.messages[-1])
    assert dropped
    before_the_fusion = 20
    assert abs(sum(map(int, dropped.groups())) - on.emulator.tally.glitches) < before_the_fusion


def test_an_unplugged_chip_comes_back_within_a_second_and_the_gap_is_told(
    source: Any, caplog: pytest.LogCaptureFixture
) -> None:
    on = desk(motion(1000), outages=((3.0, 6.0),), power=False)
    items = brought(source(on), on, 9.0)
    got = samples_of(items)
    before, after = (max(time for time, _ in got if time < 6.0), min(time for time, _ in got if time > 6.0))
    assert before == pytest.approx(3.0, abs=0.02)
    assert after - 6.0 < 1.0
    quiet = [time for time, sample in items if sample is None and 3.0 < time < after]
    assert max(b - a for a, b in pairwise([3.0, *quiet, after])) < 0.4, "readers of other streams need not wait"
    stamps = [sample.stamp for _, sample in got]
    assert all(a < b for a, b in pairwise(stamps))
    assert max(b - a for a, b in pairwise(stamps)) == pytest.approx((after - before) * 1e9, abs=10e6)
    assert caplog.messages[0] == "BNO055 on /dev/serial0: Input/output error; tries again"
    assert len(caplog.messages) < 4, "it does not repeat itself"


def test_a_cable_that_is_back_soon_does_not_restart_the_fusion(source: Any) -> None:
    on = desk(motion(600), outages=((3.0, 3.2),))
    got = samples_of(brought(source(on), on, 4.0))
    after = min(time for time, _ in got if time > 3.2)
    assert after - 3.2 < 0.1  # a new start of the fusion would take 0.08 s, that of the clock 0.1 s
    assert on.opened == 2


def test_a_chip_that_resets_itself_is_set_up_anew(source: Any, caplog: pytest.LogCaptureFixture) -> None:
    on = desk(motion(800), Faults(resets=(2.0,)))
    got = samples_of(brought(source(on, axes="-x-y+z"), on, 5.0))
    assert on.emulator.begin is not None
    reset = on.emulator.begin + 2.0
    after = min(time for time, _ in got if time > reset + 0.02)
    assert after - reset - chip_registers.RESET < 1.0
    assert UartLink(on, on.pause, on.now_ns).read(Register.AXIS_MAP, 2).data == b"\x24\x06"
    assert any("tries again" in message for message in caplog.messages)


def test_values_that_stand_still_are_not_believed(source: Any, caplog: pytest.LogCaptureFixture) -> None:
    on = desk(motion(1200), Faults(freezes=((2.0, 2.5),)))
    got = samples_of(brought(source(on), on, 6.5))
    begin = on.emulator.begin
    assert begin is not None
    false = [time for time, _ in got if begin + 2.02 < time < begin + 4.48]
    assert max(false) < begin + 3.2, "for a second they might be true"
    assert min(time for time, _ in got if time > begin + 4.5) < begin + 4.6
    assert any("the values stand still" in message for message in caplog.messages)


def test_a_hung_fusion_is_reset(source: Any) -> None:
    on = desk(motion(1200), Faults(freezes=((2.0, 100.0),)))
    got = samples_of(brought(source(on), on, 9.0))
    begin = on.emulator.begin
    assert begin is not None
    back = min(time for time, _ in got if time > begin + 3.2)
    assert back < begin + driver.REVIVAL_PERIOD + 1.5  # counted from the set-up, and the reset's time
    assert len([time for time, _ in got if time > back]) > 90 * (9.0 - back)


def test_a_silent_chip_gets_its_port_opened_anew(source: Any) -> None:
    on = desk(motion(800), Faults(silences=((2.0, 1.5),)))
    got = samples_of(brought(source(on), on, 5.0))
    begin = on.emulator.begin
    assert begin is not None
    assert min(time for time, _ in got if time > begin + 2.1) < begin + 3.5 + 0.3
    assert on.opened >= 2


def test_a_chip_that_was_switched_off_by_others_is_set_up_anew(source: Any) -> None:
    on = desk(motion(800))
    times = []
    with closing(source(on).samples()) as samples:
        for item in takewhile(lambda _: on.time < 5.0, samples):
            if not isinstance(item, Quiet):
                times.append(on.time)
                if len(times) == 200:
                    UartLink(on, on.pause, on.now_ns).write(Register.MODE, b"\0")
    gap = max(b - a for a, b in pairwise(times))
    assert 0.2 < gap < 0.8


def test_short_answers_and_overruns_cost_no_sample(source: Any) -> None:
    moved = motion(1000)
    on = desk(moved, Faults(overruns=0.03, short=0.005))
    got = [sample.gyro for _, sample in samples_of(brought(source(on), on, 10.0))]
    recorded = [measurement(WHOLE, block).gyro for block in moved.blocks]
    first, last = recorded.index(got[0]), recorded.index(got[-1])
    # an answer cut short costs the timeout of 30 ms, and with it up to three values
    assert last - first + 1 - len(got) < 3 * on.emulator.tally.short + 5
    assert len(got) > 900


def test_a_clock_that_is_set_back_never_makes_a_stamp_go_back(source: Any, caplog: pytest.LogCaptureFixture) -> None:
    on = desk(motion(600))
    stamps: list[int] = []
    with closing(source(on).samples()) as samples:
        for item in takewhile(lambda _: on.time < 5.0, samples):
            if isinstance(item, Quiet):
                assert not stamps or item.until >= stamps[-1]
            else:
                stamps.append(item[1].stamp)
            on.clock_set_back = 500_000_000 if on.time > 2.0 else 0
    assert all(a < b for a, b in pairwise(stamps))
    assert len(caplog.messages) == 1
    assert re.match(r"the clock was set back by 0\.4\d\d s: no samples", caplog.messages[0])
    assert max(b - a for a, b in pairwise(stamps)) < 40_000_000
    assert stamps[-1] > EPOCH + 4_400_000_000


def test_a_chip_that_is_never_there_is_an_error_with_the_next_step(source: Any) -> None:
    on = desk(motion(10), outages=((0.0, math.inf),))
    with pytest.raises(
        DataflowError, match=r"^imu: BNO055 on /dev/serial0: no sample within 2 s: .*--devices.*--replay"
    ):
        brought(source(on, start_timeout_s=2), on, 10.0)
    assert 2.0 < on.time < 2.2


def test_a_chip_whose_fusion_never_begins_is_an_error_too(source: Any) -> None:
    on = Desk(Emulator(motion(10), Faults(), np.random.default_rng(1), now=0.0, begin=1e9))
    said = r"no sample within 3 s: the chip gives no orientation: fusion runs, mode NDOF;"
    with pytest.raises(DataflowError, match=said):
        brought(source(on, start_timeout_s=3), on, 10.0)
    assert 3.0 < on.time < 3.6


def test_calibration_is_saved_at_the_end_and_given_back(source: Any, tmp_path: Path) -> None:
    path = tmp_path / "bno055.json"
    on = desk(motion(100))
    brought(source(on, calibration_file=str(path)), on, 1.3)
    saved = json.loads(path.read_text())
    assert saved == {
        "accel_offset": [-6, 3, 17],
        "mag_offset": [-2, 395, 112],
        "gyro_offset": [0, 1, 0],
        "accel_radius": 1000,
        "mag_radius": 832,
    }
    saved["mag_radius"] = 777
    path.write_text(json.dumps(saved))
    on = desk(motion(100, levels=(0, 3, 1, 2)))
    brought(source(on, calibration_file=str(path)), on, 1.3)
    link = UartLink(on, on.pause, on.now_ns)
    profile = link.read(Register.PROFILE, chip_registers.PROFILE_BYTES).data
    assert profile == LEARNT.to_bytes()[:-2] + (777).to_bytes(2, "little")
    assert json.loads(path.read_text()) == saved, "a chip that is not calibrated has nothing to save"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"accel_offset": [1, 2]}', "\0", '{"mag_radius": 1e9}'])
def test_a_file_without_a_calibration_is_refused(source: Any, tmp_path: Path, text: str) -> None:
    path = tmp_path / "bno055.json"
    path.write_text(text)
    with pytest.raises(DataflowError, match=r"bno055\.json: holds no calibration of a BNO055"):
        source(desk(motion(1)), calibration_file=str(path))


def test_it_tells_once_a_minute(source: Any, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    on = desk(motion(6500), Faults(overruns=0.02))
    brought(source(on), on, 62.0)
    lines = [message for message in caplog.messages if "samples every" in message]
    assert len(lines) == 2, "after a minute, and at the end"
    assert re.match(r"59\d\d samples every (9\.99|10\.00)\d ms, jitter 0\.\d\d, ", lines[0])
    assert "overruns" in lines[0]
    assert "missed" not in lines[0]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"axes": "+x+y-z"}, "left-handed"),
        ({"axes": "xyz"}, "each once, with sign"),
        ({"bus": "i2c"}, "an I2C bus, e.g. /dev/i2c-1"),
        ({"port": "/dev/i2c-1"}, "a serial port, e.g. /dev/serial0"),
        ({"address": 0x30}, "address"),
    ],
)
def test_settings_that_no_chip_can_have_are_refused(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(DataflowError, match=said):
        validated_settings(driver.Bno055, settings)
