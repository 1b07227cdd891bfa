"""What the live page costs and how late it is: a real flow, the page in a real Chromium, a frozen tab.

Run it as `python benchmarks/view_page.py WALK.mcap`; it needs the extra `view`, playwright and Debian's chromium.
The page itself notes for each pose how long it took from its stamp to the end of the frame that shows it. How busy the
machine was is told beside it: flow and browser alone keep two cores two thirds busy, and what else runs on them adds to
the latency.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright

CANEFLOW = [sys.executable, "-m", "caneflow.command"]
CHROMIUM = "/usr/bin/chromium"
WARM_UP = 8.0  # s
FLOW = """
flow: viewed
rig: {{boresight: [0, 1, 0], hand_height: 0.95, aperture: 0.87, pivot: [0, -0.3, 0], step_length: 0.42}}
nodes:
  walk: {{run: {source}, settings: {{recording: {walk}}}}}
  ground_speed: {{run: operators.ground_speed, inputs: {{frame: walk/frame, imu: walk/imu}}}}
  fusion: {{run: operators.fusion, inputs: {{imu: walk/imu, speed: ground_speed/speed}}, settings: {{method: kalman}}}}
  view: {{run: tools.view, inputs: {{imu: walk/imu, frame: walk/frame, speed: ground_speed/speed, pose: fusion/pose}}}}
results: [fusion/pose]
"""


def main() -> None:
    """Print the figures as one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("walk", type=Path)
    parser.add_argument("--seconds", type=float, default=30.0, help="s to measure, and s that the tab is frozen")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "viewed.yaml"
        file.write_text(FLOW.format(source=Path(__file__).parent / "walk_source.py", walk=options.walk.resolve()))
        flow = subprocess.Popen([*CANEFLOW, "run", str(file)], stderr=subprocess.PIPE, text=True)
        try:
            print(json.dumps(measured(address_of(flow), options.seconds), indent=2))
        finally:
            flow.terminate()
            flow.wait()


def address_of(flow: "subprocess.Popen[str]") -> str:
    """Where the view's node says that the page is."""
    assert flow.stderr is not None
    for line in flow.stderr:
        if found := re.search(r"http://\S+", line):
            return found.group()
    raise SystemExit("the flow ended before it said where the page is")


def measured(address: str, seconds: float) -> dict[str, Any]:
    """Latencies with the page in sight, then losses with it frozen."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1440, "height": 1000})
        page.goto(address)
        time.sleep(WARM_UP)
        page.evaluate("window.caneflow.latencies.length = 0")
        idle, begin = idle_s(), time.monotonic()
        time.sleep(seconds)
        busy = 1.0 - (idle_s() - idle) / (time.monotonic() - begin) / (os.cpu_count() or 1)
        latencies = sorted(page.evaluate("[...window.caneflow.latencies]"))
        before = counted()
        page.context.new_cdp_session(page).send("Page.setWebLifecycleState", {"state": "frozen"})
        time.sleep(seconds)
        after = counted()
        thawed = thaw(page)
        browser.close()
    share = len(latencies) / 100
    return {
        "poses": len(latencies),
        "median_ms": round(1e3 * latencies[int(50 * share)], 1),
        "p99_ms": round(1e3 * latencies[int(99 * share)], 1),
        "machine_busy_percent": round(100 * busy),
        "load_average": os.getloadavg()[0],
        "lost_with_the_page": before["lost"],
        "lost_with_the_frozen_page": after["lost"] - before["lost"],
        "received_while_frozen": after["received"] - before["received"],
        "cpu_of_view_percent": after["cpu"],
        "after_thawing": thawed,
    }


def thaw(page: Page) -> str:
    """Let the frozen page go on; what it says of what it missed."""
    page.context.new_cdp_session(page).send("Page.setWebLifecycleState", {"state": "active"})
    time.sleep(3.0)
    return str(page.evaluate("document.getElementById('skipped').textContent"))


def idle_s() -> float:
    """Processor time, over all cores, in which nothing ran since the machine started."""
    idle, waiting = Path("/proc/stat").read_text().split()[4:6]
    return (int(idle) + int(waiting)) / os.sysconf("SC_CLK_TCK")


def counted() -> dict[str, Any]:
    """Samples received and lost over all edges of the flow, and what the view's process costs."""
    said = subprocess.run([*CANEFLOW, "status", "viewed", "--json"], capture_output=True, text=True, check=True)
    status = json.loads(said.stdout)
    cpu = status["nodes"]["view"]["cpu"]
    return {
        "received": sum(edge["received"] for edge in status["edges"]),
        "lost": sum(sum(edge["lost"].values()) for edge in status["edges"]),
        "cpu": None if cpu is None else round(100 * cpu),
    }


if __name__ == "__main__":
    main()
