"""A real browser without a screen, for the tests of the pages."""

import shutil
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

pytest.importorskip("playwright", reason="playwright is not installed here (pip install 'caneflow[dev]')")
from playwright.sync_api import Browser, sync_playwright

CHROMIUM = shutil.which("chromium")
DEADLINE = 30.0  # s for anything that is waited for
ARGUMENTS = ["--no-sandbox", "--autoplay-policy=no-user-gesture-required"]


@pytest.fixture(scope="module", name="browser")
def running_browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("chromium is not here (apt-get install chromium)")
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield running
        running.close()


def until(condition: Callable[[], Any]) -> Any:
    """What `condition` gives as soon as that is true."""
    deadline = time.monotonic() + DEADLINE
    while not (found := condition()):
        assert time.monotonic() < deadline, "waited for in vain"
        time.sleep(0.02)
    return found
