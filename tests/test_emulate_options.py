"""The faults of `caneflow emulate` are asked for in one form, whatever the device."""

import inspect

import pytest
import typer
from typer.testing import CliRunner

from tools import emulate

SAME = {"stream", "loss", "freeze", "unplug", "begin", "seed"}


def test_both_devices_take_the_same_options_alike() -> None:
    chip, radar = (inspect.signature(of).parameters for of in (emulate.bno055, emulate.p440))
    assert set(chip) & set(radar) >= SAME
    for name in SAME - {"stream", "loss"}:  # their help names the device
        if name not in {"freeze", "unplug"}:
            assert chip[name].annotation == radar[name].annotation
        assert chip[name].default == radar[name].default


@pytest.mark.parametrize(("text", "value"), [("0.02", 0.02), ("2%", 0.02), ("100%", 1.0), ("0", 0.0), ("1", 1.0)])
def test_a_part_of_a_whole(text: str, value: float) -> None:
    assert emulate.share(text) == pytest.approx(value)


@pytest.mark.parametrize("text", ["", "2", "-0.1", "101%", "nan", "two", "%"])
def test_what_is_no_part(text: str) -> None:
    with pytest.raises(typer.BadParameter, match="not a share"):
        emulate.share(text)


def test_a_span() -> None:
    assert emulate.span("10:3") == (10.0, 3.0)
    assert emulate.span("0:0.5") == (0.0, 0.5)


@pytest.mark.parametrize("text", ["", "3", "3:", ":3", "1:2:3", "-1:3", "1:0", "1:nan", "a:b"])
def test_what_is_no_span(text: str) -> None:
    with pytest.raises(typer.BadParameter, match="is not an AT:FOR"):
        emulate.span(text)


@pytest.mark.parametrize("device", ["bno055", "p440"])
@pytest.mark.parametrize("wrong", [("--loss", "2"), ("--freeze", "3"), ("--unplug", "3")])
def test_both_say_what_is_wrong_before_they_begin(device: str, wrong: tuple[str, str], tmp_path: object) -> None:
    app = typer.Typer()
    app.command()(emulate.bno055 if device == "bno055" else emulate.p440)
    result = CliRunner().invoke(app, [f"{tmp_path}/none.mcap", *wrong])
    assert result.exit_code != 0
    assert "Invalid value" in result.output or "e.g. " in str(result.exception)
