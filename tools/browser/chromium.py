"""The browser of the system, driven from tests: pages that keep account of their errors and requests.

With `HEMOSTREAM_PAGE=src/edge/dashboard/web/page` scripts and styles come from that folder instead of from the binary.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from hemostream_process import missing, program

try:
    from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright
except ImportError as error:
    raise missing(f"{error}: pip install -r tools/browser/requirements.txt") from error

ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
SIZE = {"width": 800, "height": 600}
PATIENCE_MS = 60_000
"""Bounds a wait on a page that does not do what it should."""


class Chromium:
    """A headless browser; `close` ends it."""

    def __init__(self) -> None:
        executable = program("chromium")
        self._playwright = sync_playwright().start()
        try:
            self.browser: Browser = self._playwright.chromium.launch(executable_path=executable, args=ARGUMENTS)
        except Exception:
            self._playwright.stop()
            raise

    def close(self) -> None:
        self.browser.close()
        self._playwright.stop()


class Visitor:
    """A person with a browser window: a context of its own, and everything that its pages complained about."""

    def __init__(self, chromium: Chromium, **options: Any) -> None:
        # A small window: six waveforms painted without a graphics card cost a core on a large one.
        self.context: BrowserContext = chromium.browser.new_context(**{"viewport": SIZE, **options})
        self.context.set_default_timeout(PATIENCE_MS)
        self.errors: list[str] = []
        self.hosts: set[str] = set()
        self.context.on("request", lambda request: self._note_host(request.url))
        if folder := os.environ.get("HEMOSTREAM_PAGE"):
            self._serve_page_from(Path(folder).resolve())

    def open(self, url: str) -> Page:
        """A new tab."""
        page = self.context.new_page()
        page.on("console", lambda message: self.errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("websocket", lambda socket: self._note_host(socket.url))
        page.goto(url)
        return page

    def _serve_page_from(self, folder: Path) -> None:
        # Not the document: a browser lets one that came from elsewhere open no line to loopback.
        types = {".js": "text/javascript", ".css": "text/css"}

        def answer(route: Any) -> None:
            file = folder / urlsplit(route.request.url).path.lstrip("/")
            if file.parent == folder and file.suffix in types and file.is_file():
                route.fulfill(body=file.read_bytes(), content_type=types[file.suffix])
            else:
                route.continue_()

        self.context.route("**/*", answer)

    def _note_host(self, url: str) -> None:
        parts = urlsplit(url)
        # `data:` and `blob:` go nowhere.
        if parts.scheme in ("http", "https", "ws", "wss"):
            self.hosts.add(parts.netloc)

    def close(self) -> None:
        self.context.close()


def account(page: Page) -> dict[str, Any]:
    """What the page says of itself: frames drawn, view, event time, and what was painted of each quantity."""
    script = "() => { const h = window.hemostream; return { frames: h.frames, view: h.view, bed: h.bed, " \
             "newest_ns: h.newest_ns, drawn: h.drawn }; }"
    return page.evaluate(script)
