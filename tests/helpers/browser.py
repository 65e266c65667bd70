"""A page in a headless Chromium, by Playwright, for the tests of what a page's script does."""

from __future__ import annotations

import importlib.util
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

FLAGS = "--enable-unsafe-swiftshader --disable-background-networking --disable-component-update --disable-sync".split()
TIME_LIMIT_MS = 90_000
DESKTOP, PHONE = (1280, 900), (390, 844)
"""Windows, in pixels."""


def chromium() -> str | None:
    """The browser's command, None where there is none: the one LIMN_CHROMIUM names, or one on the path."""
    names = (os.environ.get("LIMN_CHROMIUM", ""), "chromium", "chromium-browser", "google-chrome")
    return next((found for found in map(shutil.which, filter(None, names)) if found), None)


MISSING = [
    *(["the package playwright (requirements-browser.lock)"] if not importlib.util.find_spec("playwright") else []),
    *(["Chromium on the path or in LIMN_CHROMIUM"] if chromium() is None else []),
]
needs_browser = pytest.mark.skipif(bool(MISSING), reason=f"needs {' and '.join(MISSING)}; make test-all installs it")


@dataclass
class Visit:
    """An open page (playwright.sync_api.Page). problems: what its console or its script complained of; requests: every
    address that it asked for."""

    page: object
    problems: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.page.on("console", lambda said: _is_complaint(said) and self.problems.append(said.text))
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))

    def drag(self, selector: str, x: float, y: float = 0.0, start: tuple[float, float] = (0.0, 0.0)) -> None:
        """The pointer goes down at the middle of the element plus `start`, moves by (x, y) px, and goes up."""
        self.page.evaluate("selector => document.querySelector(selector).scrollIntoView({block: 'center', "
                           "behavior: 'instant'})", selector)
        box = self.page.locator(selector).bounding_box()
        middle = box["x"] + box["width"] / 2 + start[0], box["y"] + box["height"] / 2 + start[1]
        self.page.mouse.move(*middle)
        self.page.mouse.down()
        self.page.mouse.move(middle[0] + x, middle[1] + y)
        self.page.mouse.up()


def _is_complaint(said) -> bool:
    """Whether a message of the console is one; what the graphics driver remarks on its own speed is none."""
    return said.type in ("error", "warning", "assert") and "GL Driver Message (OpenGL, Performance" not in said.text


@contextmanager
def visit(path: Path, window: tuple[int, int] = DESKTOP) -> Iterator[Visit]:
    """The page of a file, loaded. A phone's window comes with a phone's way to lay pages out."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=FLAGS)
        size = {"width": window[0], "height": window[1]}
        page = browser.new_page(viewport=size, is_mobile=window == PHONE)
        page.set_default_timeout(TIME_LIMIT_MS)
        visited = Visit(page)
        page.goto(path.resolve().as_uri())
        yield visited
        browser.close()
