"""The phone's page in a real browser: cues heard, felt and said, its motion as samples, a lost link told as blind."""

import math
import os
import re
import ssl
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caneflow.algorithms.rotations import rotate
from caneflow.errors import CaneflowError
from caneflow.messages import Cue, Imu
from caneflow.messages.rig import Guidance, Rig
from caneflow.protocols.device_motion import orientation_of
from caneflow.runtime import Context, Quiet
from drivers.phone import Phone, PhoneSettings
from tests.browser import DEADLINE, running_browser, until  # noqa: F401 - the fixture `browser`
from tests.flows import launchers

phone_server = pytest.importorskip("caneflow.viewing.phone_server", reason="the extra `view` is not installed here")
from playwright.sync_api import Browser, Page  # noqa: E402

MOTION = """(rate) => {
  window.sentAt = [];
  window.moving = setInterval(() => {
    window.sentAt.push(performance.timeOrigin + performance.now());
    window.dispatchEvent(new DeviceOrientationEvent('deviceorientation', { alpha: 90, beta: 0, gamma: 0 }));
    window.dispatchEvent(new DeviceMotionEvent('devicemotion', {
      acceleration: { x: 0, y: 0.5, z: 0 }, accelerationIncludingGravity: { x: 0, y: 0.5, z: 9.81 },
      rotationRate: { alpha: 90, beta: 10, gamma: 20 }, interval: 1000 / rate }));
  }, 1000 / rate);
}"""

CUES = '''
"""A cue, 15 times a second."""
import time
from caneflow.messages import Cue
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Cues(Source):
    outputs = {"cue": Cue}

    def __init__(self, settings, context): ...

    def samples(self):
        while True:
            time.sleep(1 / 15)
            stamp = time.time_ns()
            yield "cue", Cue(stamp=stamp, since=stamp, kind="drop", level="drop", distance=0.9, azimuth=0, urgency=0.9)

if __name__ == "__main__":
    run(Cues)
'''
PHONE_FLOW = """
flow: {flow}
nodes:
  cues: {{run: ./cues.py}}
  page: {{run: tools.phone, inputs: {{cue: cues/cue}}}}
"""


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    opened = browser.new_page(viewport={"width": 390, "height": 844})
    opened.set_default_timeout(1e3 * DEADLINE)
    problems: list[str] = []
    opened.on("pageerror", lambda error: problems.append(str(error)))
    asked: list[str] = []
    opened.on("request", lambda request: asked.append(request.url))
    yield opened
    opened.close()
    assert problems == []
    assert {re.match(r"http://127\.0\.0\.1:\d+/", url) is not None or url == "data:," for url in asked} <= {True}


def served(**how: bool) -> Any:
    return phone_server.PhoneServer(
        Guidance(), **{"hears": True, "senses": False, **how}, listen="127.0.0.1", port=0, tls=None
    )


def head(distance: float = 2.0, azimuth: float = 0.3) -> Cue:
    return Cue(
        stamp=time.time_ns(), since=0, kind="obstacle", level="head", distance=distance, azimuth=azimuth, urgency=0.4
    )


def test_a_cue_is_written_heard_and_felt_and_a_lost_link_is_blind(page: Page) -> None:
    page.add_init_script("navigator.vibrate = (how) => { (window.felt ||= []).push(how); return true; }")
    with served() as server:
        page.goto(server.address)
        until(lambda: page.is_visible("#sound"))
        page.get_by_role("button", name="Sound").focus()
        page.keyboard.press("Enter")
        page.get_by_role("button", name="Vibration").press("Space")

        def told() -> bool:
            server.tell(head())
            return bool(page.inner_text("#cue") == "Head high, 2 metres, left")

        until(told)
        until(lambda: told() and page.evaluate("caneflow.played.filter((tone) => tone.pitch === 1320).length") >= 3)
        times = page.evaluate("caneflow.played.filter((tone) => tone.pitch === 1320).map((tone) => tone.at)")
        assert np.diff(times).min() > 1e3 * (0.12 + 0.83 * 0.6) - 5  # as sonification.interval(2.0), never sooner
        assert page.evaluate("caneflow.audio.state") == "running"
        assert 40 in page.evaluate("window.felt")
        assert page.get_attribute("#cue", "aria-live") == "polite"
        page.get_by_role("button", name="Speak aloud").click()
        assert page.get_attribute("#cue", "aria-live") == "off"  # a screen reader and a voice never say it both
        until(lambda: page.inner_text("#cue") == "Not seeing: nothing comes from the cane")  # no cue for 1 s
    until(lambda: page.inner_text("#cue") == "Not seeing: the link is lost")
    assert page.evaluate("caneflow.blind")


def test_without_the_key_nothing_is_told(page: Page) -> None:
    with served() as server:
        page.goto(server.address.partition("#")[0] + "#wrong")
        until(lambda: page.inner_text("#cue") == "Not seeing: the link is lost")
        assert page.evaluate("caneflow.hello === undefined")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing(page: Page, scheme: Any) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-playwright-python is not installed")
    page.emulate_media(color_scheme=scheme)
    with served(senses=True) as server:
        page.goto(server.address)
        until(lambda: page.is_visible("#sound"))
        page.get_by_role("button", name="Sound").click()
        found = axe.Axe().run(page)
    assert [each["id"] for each in found.response["violations"]] == []


def phone() -> Phone:
    context = Context(node="phone", rig=Rig(), ports={"imu": Imu}, random=np.random.default_rng(0))
    return Phone(PhoneSettings(), context)


def taken(driver: Phone, server: Any) -> list[Imu]:
    """The samples of what waits."""
    samples: list[Imu] = []
    while not server.readings.empty():
        came = server.readings.get()
        samples += driver.taken(came.said, came.arrival)
    return samples


def moved(page: Page, seconds: float, rate: float) -> tuple[list[Imu], list[float]]:
    """The samples of a phone that moves for `seconds`, and when (ms) the page gave each reading."""
    driver = Phone(
        PhoneSettings(), Context(node="phone", rig=Rig(), ports={"imu": Imu}, random=np.random.default_rng(0))
    )
    samples: list[Imu] = []
    with served(hears=False, senses=True) as server:
        page.goto(server.address)
        page.get_by_role("button", name="Send this phone's motion").click()
        until(lambda: page.evaluate("caneflow.trips.length") >= 3)
        page.evaluate(MOTION, rate)
        end = time.monotonic() + seconds
        while time.monotonic() < end:  # as the driver does: the queue is for what comes meanwhile
            page.wait_for_timeout(100)
            samples += taken(driver, server)
        page.evaluate("clearInterval(window.moving)")
        given: list[float] = page.evaluate("window.sentAt")
        until(lambda: page.evaluate("caneflow.waiting.length") == 0)
        while len(samples) < len(given):
            samples += until(lambda: taken(driver, server))
    assert driver.refused == {}
    return samples, given


def require_right(samples: list[Imu], given: list[float]) -> None:
    """Nothing lost that the browser gave, stamps within 10 ms (one machine: its clock is the truth), units, axes."""
    assert len(samples) == len(given)
    late = np.array([sample.stamp for sample in samples]) / 1e6 - np.array(given)
    assert np.abs(late).max() < 10
    assert samples[0].gyro == pytest.approx(np.radians([10, 20, 90]))
    assert samples[0].accel == pytest.approx((0, 0.5, 9.81))
    assert samples[0].linear_accel == pytest.approx((0, 0.5, 0))
    assert samples[-1].orientation == pytest.approx((math.sqrt(0.5), 0, 0, math.sqrt(0.5)))


def test_the_phones_motion_comes_as_samples(page: Page) -> None:
    require_right(*moved(page, 1.0, 60))


@pytest.mark.long
def test_a_minute_of_motion_at_60_hz(page: Page) -> None:
    samples, given = moved(page, 60.0, 60)
    require_right(samples, given)
    assert len(given) > 3300


def test_an_orientation_turns_the_body_into_the_world() -> None:
    assert rotate(orientation_of(90, 0, 0), (1.0, 0.0, 0.0)) == pytest.approx((0, 1, 0))  # counter-clockwise from above
    assert rotate(orientation_of(0, 90, 0), (0.0, 1.0, 0.0)) == pytest.approx((0, 0, 1))  # its upper edge points up
    assert rotate(orientation_of(0, 0, 90), (0.0, 0.0, 1.0)) == pytest.approx((1, 0, 0))  # its face to the right
    assert rotate(orientation_of(90, 90, 0), (0.0, 0.0, 1.0)) == pytest.approx((1, 0, 0))  # z first, then the new x


def test_what_is_no_reading_is_counted_and_named() -> None:
    driver = Phone(
        PhoneSettings(), Context(node="phone", rig=Rig(), ports={"imu": Imu}, random=np.random.default_rng(0))
    )
    good = {"t": 1000.0, "rate": [0, 0, 0]}
    fast, later, ahead = {"t": 1100.0, "rate": [1e9, 0, 0]}, {**good, "t": 1200.0}, {**good, "t": 2000.0}
    assert len(driver.taken({"readings": [good, good], "offset": 0.0}, 1_000_000_000)) == 1  # once
    assert driver.taken({"readings": "x", "offset": 0.0}, 1_000_000_000) == []
    assert driver.taken({"readings": [ahead], "offset": 0.0}, 1_500_000_000) == []
    assert driver.taken({"readings": [fast], "offset": 0.0}, 2_000_000_000) == []
    assert driver.taken({"readings": [later], "offset": 0.0, "delay": 50.0}, 2_000_000_000) == []  # clocks
    assert sum(driver.refused.values()) == 5
    wilder = [{"t": 1300.0, "rate": [number, 0, 0]} for number in range(10**9, 10**9 + 50)]
    causes = set(driver.refused)
    assert driver.taken({"readings": wilder, "offset": 0.0}, 2_000_000_000) == []
    assert sum(driver.refused.values()) == 55
    assert set(driver.refused) == causes, "a phone that finds ever new values does not fill the memory"


def test_a_silent_phone_says_how_far_time_has_come() -> None:
    driver = Phone(
        PhoneSettings(), Context(node="phone", rig=Rig(), ports={"imu": Imu}, random=np.random.default_rng(0))
    )
    source = driver.samples()
    assert isinstance(next(source), Quiet)
    source.close()


def test_over_tls_by_the_flows_own_authority(tmp_path: Path) -> None:
    certificates = pytest.importorskip("caneflow.runtime.hosts.links.certificates")
    pytest.importorskip("cryptography", reason="the extra `secure` is not installed here")
    certificates.make_authority(tmp_path)
    certificates.make_certificate(tmp_path, "page", addresses=["127.0.0.1", "gateway.local"])
    tls = phone_server.certificate_in(tmp_path)
    how = {"hears": True, "senses": False, "listen": "127.0.0.1", "port": 0}
    with phone_server.PhoneServer(Guidance(), **how, tls=tls) as server:
        trusting = ssl.create_default_context(cafile=str(tmp_path / "ca.crt"))
        with urllib.request.urlopen(server.address.partition("#")[0], context=trusting) as answer:  # noqa: S310 - ours
            assert "caneflow on this phone" in answer.read().decode()


def test_beyond_this_machine_only_over_tls() -> None:
    with pytest.raises(CaneflowError, match="needs TLS"):
        phone_server.PhoneServer(Guidance(), hears=True, senses=False, listen="0.0.0.0", port=0, tls=None)  # noqa: S104


def test_the_address_is_drawn_in_squares() -> None:
    pytest.importorskip("segno", reason="the extra `phone` is not installed here")
    assert "\N{FULL BLOCK}" in phone_server.in_squares("https://192.168.1.5:8443/#key")


def test_a_running_flows_cues_are_told_by_its_node_and_by_the_command(page: Page, tmp_path: Path) -> None:
    name = f"p{os.getpid()}"
    (tmp_path / "cues.py").write_text(CUES)
    (tmp_path / "flow.yaml").write_text(PHONE_FLOW.format(flow=name))
    with launchers() as launch:
        flow = launch("run", tmp_path / "flow.yaml", log=tmp_path / "flow.log")
        flow.wait_for("the phone's page is at")
        flow.wait_for("ready")
        view = launch("view", name, "--phone", log=tmp_path / "view.log")
        view.wait_for("Ctrl-C ends it")
        for said in (flow.said, view.said):
            found = re.search(r"http://\S+#\S+", said)
            assert found is not None
            page.goto(found.group())
            until(lambda: page.inner_text("#cue") == "Drop, 0.9 metres, ahead")
