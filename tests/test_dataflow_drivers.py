"""The drivers: what they send, and what may be set."""

from pathlib import Path

import numpy as np
import pytest

from caneflow.messages import DopplerBlock, Imu, RadarFrame
from caneflow.runtime.dataflow.programs import load_program, validated_settings
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.program import Source

BIN_PS = 1000 / (512 * 1.024)  # ps: the radar's time grid
SCAN_STEP = 32  # bins of the grid between two samples of a scan
QUANTUM = 96  # samples: the radar rounds its window up to a multiple


def driver(name: str) -> type[Source]:
    program = load_program(f"drivers.{name}", Path())
    assert issubclass(program, Source)
    return program


def test_drivers_say_what_they_send() -> None:
    assert driver("bno055").outputs == {"imu": Imu}
    assert driver("p440").outputs == {"frame": RadarFrame}
    assert driver("mpu9250").outputs == {"imu": Imu}
    assert driver("doppler_adc").outputs == {"block": DopplerBlock}


def test_the_radars_default_window_is_480_bins() -> None:
    settings = validated_settings(driver("p440"), {})

    bins = settings.scan_stop_ps // BIN_PS - settings.scan_start_ps // BIN_PS
    assert np.ceil(bins / SCAN_STEP / QUANTUM) * QUANTUM == 480


@pytest.mark.parametrize(
    ("name", "settings", "said"),
    [
        ("bno055", {"baud": 9600}, "settings.baud: is 9600; it takes one of 115200"),
        ("bno055", {"mode": "amg"}, "settings.mode: is 'amg'; it takes one of ndof, imu"),
        ("bno055", {"rate": 200}, "settings.rate: is 200; it takes a number, at least 0.01 and at most 100"),
        (
            "p440",
            {"scan_start_ps": -500_000},
            "settings.scan_start_ps: is -500000; it takes a whole number, at least",
        ),
        (
            "p440",
            {"integration_index": 5},
            "settings.integration_index: is 5; it takes a whole number, at least 6",
        ),
        (
            "p440",
            {"scan_stop_ps": 10_000},
            "settings.scan_stop_ps: is 10000; the scan stops after it starts, at 10000",
        ),
        ("p440", {"carrier": "4.3 GHz"}, "settings.carrier: is '4.3 GHz'; it takes a number, at least 1000000"),
    ],
)
def test_settings_that_the_device_does_not_have_are_mistakes(name: str, settings: dict[str, object], said: str) -> None:
    with pytest.raises(DataflowError) as caught:
        validated_settings(driver(name), settings)

    assert str(caught.value).startswith(said)
