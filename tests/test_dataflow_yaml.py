"""Whatever the file holds, the answer is a graph or lines that say what is wrong: never a traceback."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.dataflow.yaml_file import MAX_BYTES, compose
from caneflow.runtime.errors import DataflowError

FLOW = """\
# a comment
flow: demo
seed: 3
rig: {boresight: [0, 1, 0], hand_height: 0.95, sensors: {south: {position: [1, 2, 3], azimuth: 0.5}}}
machines:
  gateway: {listen: ["tcp/0.0.0.0:7447"]}
  phone: {connect: [tcp/gateway.local:7447]}
nodes:
  imu:
    run: drivers.bno055
    machine: gateway
    restart: {policy: always, delay_s: 0.5}
    settings: &settings {port: /dev/serial0, rate: 50}
  radar: {run: drivers.p440, machine: gateway, settings: {host: 192.168.1.100, carrier: 4.3e9}}
  belt: {external: true, machine: phone, outputs: {imu: Imu}}
results: [imu/imu, radar/frame, belt/imu]
"""


def said(path: Path, data: bytes) -> list[str]:
    path.write_bytes(data)
    with pytest.raises(DataflowError) as caught:
        load(path)
    return [line.removeprefix(f"{path}:") for line in str(caught.value).splitlines()]


BROKEN: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "1:1: is empty; a dataflow starts with `flow: NAME` and `nodes:`"),
    "only a comment": (b"# nothing\n\n", "1:1: is empty; a dataflow starts with `flow: NAME` and `nodes:`"),
    "a list": (b"# x\n- flow: demo\n", "2:1: is a list, not a mapping; a dataflow starts with "),
    "a word": (b"demo\n", "1:1: is the value 'demo', not a mapping; a dataflow starts with "),
    "a tab": (b"flow: demo\nnodes:\n\timu: {}\n", "3:1: not YAML: found character '\\t' that cannot start "),
    "an open bracket": (b"flow: demo\nnodes: {imu: {run: x\n", "3:1: not YAML: expected ',' or '}', but got "),
    "an open quote": (b"flow: 'demo\nnodes: {}\n", "3:1: not YAML: found unexpected end of stream"),
    "two colons": (b"flow: demo: x\n", "1:11: not YAML: mapping values are not allowed here"),
    "an unknown alias": (b"flow: *name\n", "1:7: not YAML: found undefined alias 'name'"),
    "two documents": (b"flow: demo\n---\nflow: demo\n", "2:1: not YAML: but found another document; one "),
    "a control character": (b"flow: demo\nseed: \x07\n", "2:7: not YAML: character 0x0007 is not allowed"),
    "binary": (b"\x7fELF\x02\x01\x01\x00", "1:1: not YAML: character 0x007f is not allowed"),
    "a recording": (b"\x89MCAP0\r\n" + bytes(MAX_BYTES), " a recording, not a dataflow; expected e.g. caneflow run "),
    "indented astray": (
        b"flow: demo\nnodes:\n  a:\n    run: x\n   b: 1\n",
        "5:4: not YAML: expected <block end>, but found '<block mapping start>'; check the indentation of this line",
    ),
    "UTF-16": ("flow: demo".encode("utf-16"), "1:1: byte 0xff not UTF-8; save the file as UTF-8 text"),
    "Latin 1": ("flow: demo\nx: ab\xe9".encode("latin-1"), "2:6: byte 0xe9 not UTF-8; save "),
    "too long": (b"#" * (MAX_BYTES + 1), f" larger than {MAX_BYTES} bytes, the limit for a dataflow file"),
    "too deep": (b"flow: demo\nx: " + b"[" * 500, "1:1: is nested more than 32 deep"),
    "deep": (
        b"flow: demo\nx: " + b"[" * 40 + b"]" * 40,
        "1:1: is nested more than 32 deep, the limit for a dataflow file"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_no_dataflow_is_one_line(tmp_path: Path, name: str) -> None:
    data, start = BROKEN[name]

    (line,) = said(tmp_path / "flow.yaml", data)

    assert line.startswith(start)


def test_a_bomb_of_aliases_is_refused(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]  # 10^12 values

    assert said(tmp_path / "flow.yaml", "\n".join(lines).encode()) == [
        "1:1: stands for more than 50000 values, the limit for a dataflow file"
    ]


def test_a_file_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DataflowError, match=r"^\S+nosuch\.yaml: cannot be read: No such file or directory$"):
        load(tmp_path / "nosuch.yaml")
    with pytest.raises(DataflowError, match=r"cannot be read: Is a directory$"):
        load(tmp_path)


def test_what_yaml_lets_pass_and_we_do_not_is_found_all_at_once(tmp_path: Path) -> None:
    text = """\
flow: demo
seed: 3
seed: 4
rig: {hand_height: .nan, aperture: !!float wide}
nodes:
  imu: {run: drivers.bno055, settings: !python/object {rate: 50}}
  7: {run: drivers.bno055}
  imu: {run: drivers.p440}
  loop: &loop {run: *loop}
  <<: 3
"""
    assert said(tmp_path / "flow.yaml", text.encode()) == [
        "3:1: seed: is written twice, first in line 2; keep one",
        "4:20: rig.hand_height: is not a number; nothing can be set to that",
        "4:36: rig.aperture: 'wide' is not of type float: could not convert string to float: 'wide'",
        "6:40: nodes.imu.settings: has the tag !python/object; only plain values are read",
        "7:3: nodes.7: not a key; expected text, in quotes if need be",
        "8:3: nodes.imu: is written twice, first in line 6; keep one",
        "9:9: nodes.loop.run: contains itself; an alias may not lead to what it stands in",
        "10:3: nodes.<<: merges what is not a mapping",
    ]


def test_a_date_is_text_and_a_byte_order_mark_is_nothing() -> None:
    document = compose("\ufeffa: 2020-01-01\nb: 1_000\nc: 0x10\nd: yes\ne: 1e3\nf: ~\n".lstrip("\ufeff"), "x")

    assert document.value == {"a": "2020-01-01", "b": 1000, "c": 16, "d": "yes", "e": 1000.0, "f": None}
    assert document.problems == []


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "flow.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + FLOW.encode())

    assert load(path).flow == "demo"


snippets = st.one_of(
    st.text(max_size=6),
    st.sampled_from(
        ["\t", "\n", "- ", ": ", "{", "}", "[", "]", "&a ", "*a", "<<: ", "!!int ", "? ", "|", ">", "'", '"', "#",
         "%YAML 1.1\n---\n", "...\n", "null", ".nan", "-.inf", "1e999", "0x", "radar/frame", "../", "drivers.",
         "\x00", "\udc80", "\u2028", '"\\ud800"', "external: true, ", "inputs: {x: imu/imu}, "]
    ),
)  # fmt: skip


@st.composite
def mutated(draw: st.DrawFn) -> str:
    """FLOW with a few pieces cut out, put in or put elsewhere."""
    text = FLOW
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(text)))
        end = min(len(text), start + draw(st.integers(0, 30)))
        match draw(st.sampled_from(["cut", "put", "replace", "move"])):
            case "cut":
                text = text[:start] + text[end:]
            case "put":
                text = text[:start] + draw(snippets) + text[start:]
            case "replace":
                text = text[:start] + draw(snippets) + text[end:]
            case _:
                to = draw(st.integers(0, len(text)))
                text = text[:to] + text[start:end] + text[to:]
    return text


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from(["imu/imu", "a"]),
    lambda inside: st.lists(inside, max_size=3) | st.dictionaries(st.text(max_size=8), inside, max_size=3),
    max_leaves=8,
)


@st.composite
def misshapen(draw: st.DrawFn) -> str:
    """The values of FLOW, one of them replaced by anything; JSON is YAML."""
    values: Any = {"all": compose(FLOW, "").value}
    inside, key = values, "all"
    while isinstance(inside[key], dict | list) and inside[key] and draw(st.integers(0, 5)):
        inside = inside[key]
        key = draw(st.sampled_from(sorted(inside) if isinstance(inside, dict) else range(len(inside))))
    inside[key] = draw(json_values)
    return json.dumps(values["all"], ensure_ascii=draw(st.booleans()))


overrides = st.one_of(
    st.text(max_size=12),
    st.builds(
        "{}.{}={}".format,
        st.sampled_from(["imu", "radar", "belt", "nobody"]),
        st.sampled_from(["rate", "port", "carrier.x", "x", "a" + ".b" * 500]),
        snippets,
    ),
)


def must_be_lines_or_a_graph(path: Path, text: str, sets: list[str]) -> None:
    path.write_bytes(text.encode(errors="surrogatepass"))
    try:
        load(path, sets, rig={"hand_height": 1})
    except DataflowError as error:
        lines = str(error).split("\n")
        assert len(lines) == len(error.problems) >= 1
        for line in lines:
            assert re.match(rf"{re.escape(str(path))}:(\d+:\d+:)? \S|--set |rig of the recording", line)
            line.encode()  # can be printed
            assert "Traceback" not in line


@given(mutated(), st.lists(overrides, max_size=1))
@settings(max_examples=60, deadline=None)
@example(text=FLOW, sets=["imu.x\n=1"])
@example(text='flow: "a\\ud800"', sets=[])
@example(text="%\n", sets=[])
@example(text="? [a]\n: b", sets=[])
def test_no_text_is_answered_by_anything_but_lines(
    tmp_path_factory: pytest.TempPathFactory, text: str, sets: list[str]
) -> None:
    must_be_lines_or_a_graph(tmp_path_factory.getbasetemp() / "mutated.yaml", text, sets)


@given(misshapen(), st.lists(overrides, max_size=1))
@settings(max_examples=60, deadline=None)
def test_no_values_are_answered_by_anything_but_lines(
    tmp_path_factory: pytest.TempPathFactory, text: str, sets: list[str]
) -> None:
    must_be_lines_or_a_graph(tmp_path_factory.getbasetemp() / "misshapen.yaml", text, sets)


@given(st.binary(max_size=200))
@settings(max_examples=100, deadline=None)
def test_no_bytes_are_answered_by_anything_but_lines(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "bytes.yaml"
    path.write_bytes(data)

    with pytest.raises(DataflowError):
        load(path)
