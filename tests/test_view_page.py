"""The live page in a real browser: what it shows is what is on the wire, and one needs neither mouse nor eyes."""

import math
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from caneflow.messages import Cue, GroundSpeed, Imu, Obstacles, Pose, RadarFrame, Sample, decode, numbered, sample_key
from caneflow.messages.rig import Rig
from caneflow.recording import RecordingWriter
from caneflow.runtime.hosts.attached.attach import ANY, Heard, attached
from caneflow.viewing.columns import row_of
from caneflow.viewing.live import LiveStreams
from tests.browser import DEADLINE, running_browser, until  # noqa: F401 - the fixture `browser`

server = pytest.importorskip("caneflow.viewing.server", reason="the extra `view` is not installed here")
from playwright.sync_api import Browser, Page, expect  # noqa: E402

CANEFLOW = [sys.executable, "-m", "caneflow.command"]
BORESIGHT = (0.0, 1.0, 0.0)
MINUS = "\N{MINUS SIGN}"
AA = 4.5  # contrast of text

WALKER = '''
"""A pose, a speed, an IMU sample and a radar frame, 50 times a second."""
import math
import time
import numpy as np
from caneflow.messages import GroundSpeed, Imu, Pose, RadarFrame
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Walker(Source):
    outputs = {"pose": Pose, "speed": GroundSpeed, "imu": Imu, "frame": RadarFrame}

    def __init__(self, settings, context):
        self._random = context.random

    def samples(self):
        at = 0
        while True:
            time.sleep(0.02)
            at += 1
            stamp = time.time_ns()
            angle = 0.01 * at
            yield "pose", Pose(
                stamp=stamp, position=(3 * math.sin(angle), 3 - 3 * math.cos(angle), 0.0), velocity=(0.5, 0.1, 0.0),
                orientation=(math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)), method="walker",
                covariance=np.diag([1e-4 * at, 5e-5 * at, 1, 1, 1, 1]),
            )
            yield "speed", GroundSpeed(stamp=stamp, speed=0.5 + 0.1 * math.sin(at), quality=0.07, rays=12, valid=True)
            yield "imu", Imu(stamp=stamp, gyro=tuple(self._random.normal(size=3).tolist()), accel=(0.0, 0.1, 9.81))
            yield "frame", RadarFrame(
                stamp=stamp, scans=self._random.integers(-999, 999, (1, 96), dtype=np.int32), scan_period=0.02,
                range_start=0.5, range_step=0.009149, carrier=4.3e9, bandwidth=1.7e9,
            )

if __name__ == "__main__":
    run(Walker)
'''
FLOW = """
flow: {flow}
nodes:
  walker: {{run: ./walker.py}}
  view: {{run: tools.view, inputs: {{pose: walker/pose, speed: walker/speed, imu: walker/imu, frame: walker/frame}}}}
"""


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    opened = browser.new_page(viewport={"width": 1280, "height": 900})
    opened.set_default_timeout(1e3 * DEADLINE)
    problems: list[str] = []
    opened.on("pageerror", lambda error: problems.append(str(error)))
    opened.on("console", lambda line: problems.append(line.text) if line.type == "error" else None)
    yield opened
    opened.close()
    assert [each for each in problems if "WebSocket" not in each] == []


def pose(seq: int, sd: float = 0.1) -> Pose:
    return Pose(
        stamp=1_000_000_000 + 20_000_000 * seq,
        seq=seq,
        position=(0.01 * seq, -0.02 * seq, 0.0),
        velocity=(0.5, 0.0, 0.0),
        orientation=(1.0, 0.0, 0.0, 0.0),
        method="kalman",
        covariance=np.diag([sd**2, sd**2, 1.0, 1.0, 1.0, 1.0]),
    )


@pytest.fixture
def shown(page: Page) -> Iterator[tuple[Page, LiveStreams]]:
    """A page with 2 s of everything on it, of a flow that goes on when the test says so."""
    streams = LiveStreams(flow="cane", rig=Rig())
    with server.PageServer(streams) as serving:
        for seq in range(100):
            walk(streams, seq)
        page.goto(serving.address)
        until(lambda: page.evaluate("window.caneflow?.state.pictures.length > 0"))
        until(lambda: page.inner_text("#at-seq") == "99")
        yield page, streams


def walk(streams: LiveStreams, seq: int, sd: float = 0.1) -> None:
    stamp = 1_000_000_000 + 20_000_000 * seq
    random = np.random.default_rng(seq)
    frame = RadarFrame(
        stamp=stamp, seq=seq, scans=random.integers(-999, 999, (1, 96), dtype=np.int32), scan_period=0.02,
        range_start=0.5, range_step=0.009149, carrier=4.3e9, bandwidth=1.7e9,
    )  # fmt: skip
    streams.take("fusion/pose", pose(seq, sd), stamp)
    streams.take(
        "ground_speed/speed", GroundSpeed(stamp=stamp, seq=seq, speed=0.4, quality=0.05, rays=9, valid=True), stamp
    )
    streams.take("imu/imu", Imu(stamp=stamp, seq=seq, gyro=(0.1, 0.2, 0.3), accel=(0.0, 0.5, 9.8)), stamp)
    streams.take("radar/frame", frame, stamp)


def held(page: Page, name: str) -> list[list[float]]:
    """Time and numbers of each sample that the page holds of a stream."""
    rows: list[list[float]] = page.evaluate(
        """(name) => {
          const series = window.caneflow.state.series.get(name);
          return Array.from({ length: series.length }, (_, i) =>
            [series.times[i], ...series.rows.slice(i * series.width, (i + 1) * series.width)]);
        }""",
        name,
    )
    return rows


def count_since(page: Page, stamp: int) -> int:
    """Poses on the page that were sent after `stamp` (ns)."""
    origin = page.evaluate("window.caneflow.state.origin")
    return sum((origin + row[0]) * 1e9 >= stamp for row in held(page, "walker/pose"))


def has_come(page: Page, seq: int) -> bool:
    return bool(page.evaluate("window.caneflow.state.series.get('fusion/pose').lastSeq") == seq)


# --- what is shown is what was sent -------------------------------------------------------------------------------


def test_the_page_of_a_running_flow_shows_what_is_on_the_wire(page: Page, tmp_path: Path) -> None:
    name = "t" + re.sub(r"\W", "", tmp_path.name).lower()[-40:]
    (tmp_path / "walker.py").write_text(WALKER)
    (tmp_path / "flow.yaml").write_text(FLOW.format(flow=name))
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    flow = subprocess.Popen([*CANEFLOW, "run", str(tmp_path / "flow.yaml")], stderr=subprocess.PIPE, text=True)
    try:
        assert flow.stderr is not None
        address = next(found.group() for line in flow.stderr if (found := re.search(r"http://\S+", line)))
        sent: dict[str, dict[int, Sample]] = {"walker/pose": {}, "walker/speed": {}, "walker/imu": {}}
        kinds: dict[str, type[Sample]] = {"walker/pose": Pose, "walker/speed": GroundSpeed, "walker/imu": Imu}

        def hear(heard: Heard) -> None:
            stream = heard.key.partition("/")[2]
            if stream in kinds:
                sample = decode(heard.payload, kinds[stream])
                sent[stream][sample.stamp] = sample

        with attached(name) as here, here.samples([(ANY, ANY)], hear):
            page.goto(address)
            begin = until(lambda: max(sent["walker/pose"], default=0))
            until(lambda: page.inner_text("#edges").count("walker/pose → view.pose"))
            until(lambda: count_since(page, begin) > 40)
            page.keyboard.press("Space")
            until(lambda: page.inner_text("#connection") == "❚❚ paused")
            page.keyboard.press("ArrowLeft")
            until(
                lambda: (
                    page.evaluate("window.caneflow.state.newestTime") > page.evaluate("window.caneflow.state.cursor")
                )
            )
            rows = {stream: held(page, stream) for stream in sent}
            origin = page.evaluate("window.caneflow.state.origin")
            shown = page.inner_text("#at-x"), page.inner_text("#at-y"), page.evaluate("window.caneflow.state.cursor")
            until(lambda: page.inner_text("#nodes").count("● ready") == 2)
        for stream, samples in rows.items():
            compared = 0
            stamps = np.array(sorted(sent[stream]))
            for time_s, *numbers in samples:
                stamp = int(stamps[np.abs(stamps - (origin + time_s) * 1e9).argmin()])
                if begin <= stamp and abs(stamp * 1e-9 - origin - time_s) < 1e-6:  # both were there already
                    expected = row_of(sent[stream][stamp], BORESIGHT)
                    assert numbers == pytest.approx(expected, rel=0, abs=0, nan_ok=True)
                    compared += 1
            assert compared > 30, stream
        last = [row for row in rows["walker/pose"] if row[0] <= shown[2] + 1e-9][-1]
        assert shown[:2] == tuple(f"{last[i]:.2f} m".replace("-", MINUS) for i in (1, 2))
    finally:
        flow.terminate()
        flow.communicate(timeout=DEADLINE)
    assert {re.match(r"http://127\.0\.0\.1:\d+/", url) is not None or url == "data:," for url in asked} == {True}


def test_a_recording_is_scrubbed_to_the_very_sample(page: Page, tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    with RecordingWriter(path, flow="cane", source="simulated", rig={}) as writer:
        for seq in range(500):
            message = pose(seq)
            key = sample_key("cane", "fusion", "pose")
            writer.write(key, Pose, numbered(message, seq), stamp=message.stamp, seq=seq, log_time=message.stamp)
    viewing = subprocess.Popen([*CANEFLOW, "view", str(path)], stdout=subprocess.PIPE, text=True)
    try:
        assert viewing.stdout is not None
        page.goto(viewing.stdout.readline().split()[0])
        until(lambda: page.evaluate("window.caneflow?.state.series.get('fusion/pose')?.length === 500"))
        until(lambda: page.inner_text("#at-x") == "4.99 m")  # it opens at the end
        assert page.inner_text("#words").startswith("At 10 s: 11.2 metres from the start")
        page.locator("#cursor").fill("4.36")
        until(lambda: page.inner_text("#at-x") == "2.18 m")  # sample 218
        assert page.inner_text("#at-y") == f"{MINUS}4.36 m"
        assert page.inner_text("#time") == "4.36 of 9.98 s"
        page.get_by_role("button", name="Play").click()
        until(lambda: page.evaluate("window.caneflow.state.cursor") > 4.4)
    finally:
        viewing.terminate()
        viewing.communicate(timeout=DEADLINE)


SPIKY = """async () => {
  const { Series } = await import("./series.js");
  const series = new Series("imu/imu", "Imu", ["gyro_x", "valid"]);
  const times = Float64Array.from({ length: 10000 }, (_, i) => 0.01 * i + (i >= 6000 ? 5 : 0));
  const rows = new Float64Array(20000);
  for (let i = 0; i < 10000; i += 1) rows.set([Math.sin(i), 1], 2 * i);
  rows[2 * 4321] = 9;
  rows[2 * 4322] = -9;
  for (let i = 2000; i < 2400; i += 1) rows[2 * i + 1] = 0;
  series.append(times, rows, false);
  const valid = (rows, at) => (rows[at + 1] ? rows[at] : NaN);
  return series.between(0, 1000, [(rows, at) => rows[at], valid], 200);
}"""


def test_a_chart_of_many_samples_keeps_every_peak_and_every_gap(shown: tuple[Page, LiveStreams]) -> None:
    page, _ = shown
    times, drawn, valid = page.evaluate(SPIKY)
    assert len(times) == len(drawn) == len(valid) <= 210
    assert all(np.diff(times) > 0)
    assert times[-1] == pytest.approx(0.01 * 9999 + 5), "up to the newest"
    assert drawn.index(-9) - drawn.index(9) == 1, "in the order in which they came"
    at = [time for time, value in zip(times, drawn, strict=True) if value is None]
    assert at == pytest.approx([65.0], abs=1e-3), "the silence"
    gap = [time for time, value in zip(times, valid, strict=True) if value is None and time < 60]
    assert (min(gap), max(gap)) == (pytest.approx(20.0, abs=1.0), pytest.approx(24.0, abs=1.0))


def remember_plan(page: Page) -> None:
    page.evaluate("""() => {
      const plan = document.getElementById("plan");
      const pixels = () => plan.getContext("2d").getImageData(0, 0, plan.width, plan.height).data;
      const before = pixels();
      window.changed = () =>
        pixels().reduce((sum, value, i) => sum + (Math.abs(value - before[i]) > 30), 0) / before.length;
    }""")


def test_the_track_that_knows_how_sure_it_is_is_the_one_that_is_told(page: Page) -> None:
    streams = LiveStreams(flow="cane", rig=Rig())
    with server.PageServer(streams) as serving:
        for seq in range(3):
            unsure = msgspec.structs.replace(pose(seq), covariance=None, position=(9.0, 9.0, 0.0))
            streams.take("a/pose", unsure, unsure.stamp)
            streams.take("fusion/pose", pose(seq), pose(seq).stamp)
        page.goto(serving.address)
        until(lambda: page.input_value("#primary") == "fusion/pose")
        until(lambda: page.inner_text("#at-x") == "0.02 m")
        page.select_option("#primary", "a/pose")
        until(lambda: page.inner_text("#at-x") == "9.00 m")
        assert "Its uncertainty is not known." in page.inner_text("#words")


def test_on_a_small_screen_the_whole_plan_stands_above_the_time_bar(shown: tuple[Page, LiveStreams]) -> None:
    page, _ = shown
    page.set_viewport_size({"width": 800, "height": 600})
    bar = page.locator("footer").bounding_box()
    plan = page.locator("#plan").bounding_box()
    assert bar is not None
    assert plan is not None
    assert plan["height"] >= 200
    assert plan["y"] + plan["height"] <= bar["y"]


def test_a_track_that_was_drawn_bit_by_bit_looks_like_one_drawn_at_once(shown: tuple[Page, LiveStreams]) -> None:
    page, streams = shown
    page.keyboard.press("-")  # a scale that stays
    for seq in range(100, 180):
        walk(streams, seq, sd=0.1 + 0.004 * (seq - 100))
        until(partial(has_come, page, seq))
    page.keyboard.press("Space")
    until(lambda: page.inner_text("#at-seq") == "at 3.58 s")
    remember_plan(page)
    page.select_option("#theme", "dark")
    until(lambda: page.evaluate("window.changed()") > 0.5)
    page.select_option("#theme", "light")
    until(lambda: page.evaluate("window.changed()") < 0.01)


def test_all_that_is_owed_is_drawn_when_nothing_comes_any_more(shown: tuple[Page, LiveStreams]) -> None:
    page, streams = shown
    walk(streams, 100)
    until(lambda: page.inner_text("#time") == "2.00 s")
    until(lambda: page.inner_text("#gyro-words") == "x 0.10, y 0.20, z 0.30 rad/s")
    until(lambda: page.inner_text("#radar-words").startswith("strongest return"))


def test_an_uncertain_position_is_said_to_be(shown: tuple[Page, LiveStreams]) -> None:
    page, streams = shown
    assert page.inner_text("#at-sure") == "±0.20 m"
    assert not page.eval_on_selector("#at-sure", "place => place.classList.contains('unsure')")
    walk(streams, 100, sd=3.0)
    until(lambda: page.inner_text("#at-sure") == "±6.00 m")
    assert page.eval_on_selector("#at-sure", "place => getComputedStyle(place).textDecorationStyle") == "dashed"
    page.keyboard.press("w")
    until(lambda: "This is uncertain, by 6.0 metres." in page.inner_text("#words"))


def test_what_stands_around_is_a_table_and_words(shown: tuple[Page, LiveStreams]) -> None:
    page, streams = shown
    assert page.locator("#obstacles-card").is_hidden()
    nearest, known = np.zeros((3, 4), np.float32), np.ones((3, 4), np.float32)
    nearest[1, 2], nearest[0, 0], known[2, 3] = 2.3, 0.8, 0.1
    stamp = 3_000_000_000
    found = Obstacles(stamp=stamp, heading=0.0, walking=True, nearest=nearest, known=known)
    cue = Cue(stamp=stamp, kind="obstacle", level="head", distance=2.3, azimuth=0.0, urgency=0.4, since=stamp)
    streams.take("surroundings/obstacles", found, stamp)
    streams.take("surroundings/cue", cue, stamp)
    walk(streams, 100)
    said = "Told of: head, 2.3 m ahead. Beside, left: low 0.8 m; right: nothing."
    until(lambda: page.inner_text("#obstacles-words") == said)
    rows = [row.split() for row in page.inner_text("#obstacles").splitlines()]
    none = "\N{EN DASH}"
    assert rows == [
        ["left", "0.8", "m", none, none, none],
        ["ahead", none, none, "2.3", "m", none],
        ["right", none, none, none, "?"],
    ]


def test_a_position_that_does_not_come_any_more_is_said_to_be_old(shown: tuple[Page, LiveStreams]) -> None:
    page, _ = shown
    until(lambda: page.evaluate("performance.now() - window.caneflow.state.cameAt") > 2000)
    page.keyboard.press("w")
    assert re.match(r"No new position for \d+ seconds\.", page.inner_text("#words"))


def test_a_page_that_is_opened_without_the_key_says_so(page: Page) -> None:
    with server.PageServer(LiveStreams(flow="cane", rig=Rig())) as serving:
        page.goto(serving.address.partition("#")[0])
        until(lambda: "lacks its key" in page.inner_text("[role=alert]"))


# --- without a mouse, without eyes --------------------------------------------------------------------------------


def test_everything_can_be_done_by_keys(shown: tuple[Page, LiveStreams]) -> None:
    page, streams = shown
    page.keyboard.press("Space")
    assert page.inner_text("#pause") == "Go on"
    at = page.evaluate("window.caneflow.state.cursor")
    page.keyboard.press("Shift+ArrowLeft")
    assert page.evaluate("window.caneflow.state.cursor") == pytest.approx(at - 1.0)
    until(lambda: page.inner_text("#at-x") == f"{0.01 * 49:.2f} m")
    walk(streams, 100)
    until(lambda: page.evaluate("window.caneflow.state.newestTime") == pytest.approx(2.0))
    assert page.inner_text("#at-x") == "0.49 m", "held"
    page.keyboard.press("End")
    until(lambda: page.inner_text("#at-x") == "1.00 m")
    page.keyboard.press("f")
    assert page.get_attribute("#follow", "aria-pressed") == "true"
    page.keyboard.press("?")
    expect(page.get_by_role("dialog", name="Keys")).to_be_visible(timeout=1e3 * DEADLINE)
    page.keyboard.press("Escape")


def test_the_focus_reaches_every_control_and_shows(shown: tuple[Page, LiveStreams]) -> None:
    page, _ = shown
    wanted = set(page.eval_on_selector_all(
        "button, select, input, canvas[tabindex], .scroll",
        "all => all.filter((each) => each.checkVisibility()).map((each) => each.id || each.className)",
    ))  # fmt: skip
    reached = set()
    for _ in range(len(wanted) + 3):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.className"))
        if page.evaluate("document.activeElement !== document.body"):  # else: round to the browser's own
            assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    assert wanted <= reached


def test_what_is_shown_has_roles_and_names(shown: tuple[Page, LiveStreams]) -> None:
    page, _ = shown
    roles: list[tuple[Any, str | None]] = [
        ("main", None), ("heading", "caneflow cane"), ("heading", "Plan"), ("img", "Plan of the track"),
        ("img", "Speed over ground m/s; band: quality"), ("img", "Range and Doppler white line: superior edge"),
        ("img", "Turn rate rad/s, body"), ("slider", "Time cursor"), ("button", "Pause"), ("button", "Zoom in"),
        ("combobox", "Say the position"), ("table", None), ("row", "fusion/pose → this page"),
        ("columnheader", "Latency, median"), ("region", "Edges"),
    ]  # fmt: skip
    for role, name in roles:
        found = page.get_by_role(role, name=name) if name else page.get_by_role(role)
        expect(found.first).to_be_visible(timeout=1e3 * DEADLINE)  # waits for the next drawing
    unnamed = page.eval_on_selector_all(
        "button, select, input, [role=img], [role=region]",
        """all => all.filter((each) => !(each.ariaLabel || each.textContent.trim() || each.labels?.length
          || each.getAttribute("aria-labelledby"))).map((each) => each.outerHTML)""",
    )
    assert unnamed == []
    described = page.eval_on_selector_all("[aria-labelledby], [aria-describedby]", """all => all.flatMap((each) =>
        [each.getAttribute("aria-labelledby"), each.getAttribute("aria-describedby")])
        .filter((id) => id && !document.getElementById(id))""")  # fmt: skip
    assert described == []
    assert page.get_attribute("html", "lang") == "en"
    assert page.get_attribute("#said", "aria-live") == "polite"


def test_the_position_is_said_at_a_calm_rate_and_shown_at_once(shown: tuple[Page, LiveStreams]) -> None:
    page, streams = shown
    page.evaluate("""() => {
      window.said = 0;
      const said = document.getElementById("said");
      new MutationObserver(() => { window.said += 1; }).observe(said, { childList: true });
    }""")
    for seq in range(100, 160):
        walk(streams, seq)
        until(partial(has_come, page, seq))
    until(lambda: page.inner_text("#words").startswith("At 3 s: 3.6 metres from"))
    assert page.evaluate("window.said") <= 1
    page.select_option("#calm", "0")
    walk(streams, 160)
    until(partial(has_come, page, 160))
    assert page.evaluate("window.said") <= 1


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_text_stands_out_from_what_lies_behind_it(shown: tuple[Page, LiveStreams], theme: str) -> None:
    page, _ = shown
    page.select_option("#theme", theme)
    colours = page.evaluate(
        """() => [...document.querySelectorAll("body *")].filter((each) => each.checkVisibility()
          && [...each.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim())).map((each) => {
          let behind = each;
          const back = (place) => getComputedStyle(place).backgroundColor;
          while (behind && back(behind) === "rgba(0, 0, 0, 0)") behind = behind.parentElement;
          return [each.id || each.outerHTML.slice(0, 60), getComputedStyle(each).color,
            back(behind ?? document.body)];
        })"""
    )
    assert len(colours) > 30
    names = ["ink", "muted", "blue", "orange", "green", "purple", "good", "wait", "bad"]
    card, *drawn = page.evaluate(
        """(names) => ["card", ...names].map((name) =>
          getComputedStyle(document.documentElement).getPropertyValue(`--${name}`))""",
        names,
    )
    colours += [(name, colour, card) for name, colour in zip(names, drawn, strict=True)]
    for what, colour, behind in colours:
        assert contrast(colour, behind) >= AA, (what, colour, behind)


def contrast(one: str, other: str) -> float:
    """As WCAG 2 defines it."""
    light, dark = sorted((luminance(one), luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def luminance(colour: str) -> float:
    text = colour.strip()
    parts = (
        [int(text[i : i + 2], 16) for i in (1, 3, 5)] if text[0] == "#" else map(float, re.findall(r"[\d.]+", text)[:3])
    )
    linear = [c / 12.92 if (c := part / 255) <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for part in parts]
    return sum(math.prod(pair) for pair in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def test_who_wants_no_motion_gets_two_pictures_a_second(shown: tuple[Page, LiveStreams]) -> None:
    page, streams = shown
    page.emulate_media(reduced_motion="reduce")
    page.evaluate("window.caneflow.costs.length = 0")
    begin = page.evaluate("performance.now()")
    for seq in range(100, 150):
        walk(streams, seq)
        until(partial(has_come, page, seq))
    drawn, took_s = page.evaluate(
        "(begin) => [window.caneflow.costs.length, (performance.now() - begin) / 1000]", begin
    )
    assert drawn <= 2 * took_s + 1
