"""A headless Chromium for tests of pages: the one that the system has (Debian's package chromium), with playwright.

The fixture ``browser`` of conftest.py is the one of ``launched``; it skips where no browser is installed.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
ARGUMENTS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
    "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",  # WebGL on the CPU
)  # fmt: skip
LOCAL = (
    "file:",
    "data:",
    "blob:",
    "about:",
    "http://localhost",
    "http://127.0.0.1",
    "ws://localhost",
    "ws://127.0.0.1",
)
"""What a page may load: the rest counts as a request to the network."""


@contextmanager
def launched() -> Iterator[Browser]:
    """The browser. Skips the test where the system has none."""
    program = next((found for found in map(shutil.which, NAMES) if found), None)
    if program is None:
        pytest.skip(f"no browser is installed: none of {', '.join(NAMES)} is on the PATH (apt-get install chromium)")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, headless=True, args=list(ARGUMENTS))
        try:
            yield browser
        finally:
            browser.close()


@dataclass
class Watched:
    """A page, and what it should not do: ``errors`` of the console and of scripts, ``requests`` to the network."""

    page: Page
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)


@contextmanager
def watched(browser: Browser, width: int = 1400, height: int = 900) -> Iterator[Watched]:
    """A new page of ``width`` by ``height`` CSS pixels. Requests to other machines are refused, and written down."""
    context = browser.new_context(viewport={"width": width, "height": height})
    try:
        seen = Watched(context.new_page())

        def allow(route, request):
            if request.url.startswith(LOCAL):
                return route.continue_()
            seen.requests.append(request.url)
            return route.abort()

        context.route("**/*", allow)
        seen.page.on("console", lambda message: seen.errors.append(message.text) if message.type == "error" else None)
        seen.page.on("pageerror", lambda error: seen.errors.append(str(error)))
        yield seen
    finally:
        context.close()
