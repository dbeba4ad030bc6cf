"""A real browser without a screen, for tests of pages; skips with its reason where there is none.

    from browser import launched, watched

    def test_a_page(tmp_path: Path):
        with launched() as browser, watched(browser, width=640, height=480) as (page, heard):
            page.goto(f"file://{tmp_path}/page.html")
            page.get_by_role("button", name="mug").click()
            pixels = screenshot(page.locator("canvas"))
        assert heard.errors == [] and heard.asked == []

Needs `pip install 'vlgs[e2e]'` and a Chromium (`apt-get install chromium`); nothing is downloaded. Its graphics are drawn by
SwiftShader on the CPU, so that WebGL 2 is there on any machine; `launched(graphics=False)` takes it away.
"""

import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_SOFTWARE = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_NONE = ("--disable-gpu", "--disable-3d-apis", "--disable-software-rasterizer")
_INSIDE = ("file:", "data:", "blob:", "about:", "chrome-error:")
"""Addresses that no network is needed for."""


def find_chromium() -> Path:
    """The browser of this machine; skips the test where there is none."""
    found = next((path for name in _NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip("needs a browser: apt-get install chromium")
    return Path(found)


@contextmanager
def launched(graphics: bool = True, *flags: str) -> Iterator[Any]:
    """A browser of playwright, closed in the end.

    Args:
        graphics: Whether there is WebGL.
        flags: Further ones of Chromium's command line.
    """
    chosen = [*(_SOFTWARE if graphics else _NONE), *flags]
    sandbox = os.getuid() != 0  # Chromium's own refuses to run as root
    with _driver() as playwright:
        browser = playwright.chromium.launch(
            executable_path=find_chromium(), args=chosen, chromium_sandbox=sandbox
        )
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def _driver() -> Iterator[Any]:
    """Playwright; there can be only one in a process, which all browsers share."""
    if find_spec("playwright") is None:
        pytest.skip("needs playwright: pip install 'vlgs[e2e]'")
    from playwright.sync_api import sync_playwright  # pyright: ignore[reportMissingImports]

    if _DRIVERS:
        yield _DRIVERS[-1]
        return
    with sync_playwright() as playwright:
        _DRIVERS.append(playwright)
        try:
            yield playwright
        finally:
            _DRIVERS.clear()


_DRIVERS: list[Any] = []
"""The one that runs, if one does."""


@dataclass
class Heard:
    """What a page said and asked for since it was opened."""

    errors: list[str] = field(default_factory=list)
    """Of the console, and those that no code caught."""
    asked: list[str] = field(default_factory=list)
    """Addresses that it wanted from the network."""


@contextmanager
def watched(browser: Any, width: int, height: int, **context: Any) -> Iterator[tuple[Any, Heard]]:
    """A new page of a size in pixels, with its own memory, and what is heard of it; `context` as of playwright's ``new_context``."""
    heard = Heard()
    opened = browser.new_context(viewport={"width": width, "height": height}, **context)
    try:
        page = opened.new_page()
        page.on("pageerror", lambda error: heard.errors.append(str(error)))
        page.on("console", lambda said: said.type == "error" and heard.errors.append(said.text))
        page.on("request", lambda it: it.url.startswith(_INSIDE) or heard.asked.append(it.url))
        page.on("websocket", lambda it: heard.asked.append(it.url))
        yield page, heard
    finally:
        opened.close()


def screenshot(what: Any) -> np.ndarray:
    """What a page, or a part of one, shows: uint8 [height, width, 3]."""
    return np.asarray(Image.open(io.BytesIO(what.screenshot())).convert("RGB"))
