"""A real browser without a screen, for tests of pages; they are skipped where there is none."""

import io
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

__all__ = ["headless_browser", "near", "picture", "wait_for"]

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_FLAGS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--webgl-antialiasing-mode=none",
    "--webgl-msaa-sample-count=0",
]
_LONG = 90  # s, after which a page does not come up any more


@contextmanager
def headless_browser() -> Iterator[Any]:
    """A browser by Playwright: one that is installed on the machine, or else its own."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    with playwright.sync_playwright() as runner:
        if found is None and not Path(runner.chromium.executable_path).exists():
            pytest.skip("needs a browser: chromium, chrome, or 'playwright install chromium'")
        browser = runner.chromium.launch(executable_path=found, args=_FLAGS)
        try:
            yield browser
        finally:
            browser.close()


def picture(page: Any) -> np.ndarray:
    """What a page shows, (height, width, 3), 0 to 255."""
    image = pytest.importorskip("PIL.Image", reason="needs pillow")
    return np.asarray(image.open(io.BytesIO(page.screenshot(timeout=1000 * _LONG))).convert("RGB")).astype(
        int
    )


def near(seen: np.ndarray, colour: str, tolerance: int = 24) -> np.ndarray:
    """Pixels (height, width) that have nearly a colour "#rrggbb"; viewers change it a little."""
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    there: np.ndarray = np.abs(seen - wanted).max(axis=-1) <= tolerance
    return there


def wait_for(what: Callable[[], bool]) -> None:
    """Wait until something is so."""
    deadline = time.monotonic() + _LONG
    while not what():
        assert time.monotonic() < deadline, "the page does not come up"
        time.sleep(0.25)
