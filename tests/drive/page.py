"""Runs ``workbench open`` and similar commands as a user does, with a real Chromium on their page."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import (
    Browser,
    ConsoleMessage,
    Error,
    FloatRect,
    Page,
    Playwright,
    expect,
    sync_playwright,
)

from tests.drive.waiting import until
from workbench.machine.preferences import keep_check_after_save

TASK = Path(__file__).parents[2] / "tasks" / "push_cube.py"
"""The example task; tests edit copies of it."""
CHROMIUM_ARGUMENTS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    # As Chromium does without a graphics card. Otherwise the WebGL software renderer also composites the page: half of
    # the browser's CPU time.
    "--disable-gpu-compositing",
    # Without these Chromium looks up Google's hosts at every start.
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
START_SECONDS = 60.0
expect.set_options(timeout=60_000)
PRETEND_GPU_JS = """
const ask = WebGL2RenderingContext.prototype.getParameter, UNMASKED_RENDERER = 0x9246;
WebGL2RenderingContext.prototype.getParameter = function (what) {
    return what === UNMASKED_RENDERER ? 'NVIDIA GeForce RTX 3060' : ask.call(this, what);
};
"""
DRAW_ON_REQUEST_JS = """
[window.viewIsSeen, window.drawnInView] = [false, 0];
for (const name of ["drawElements", "drawArrays", "drawElementsInstanced", "drawArraysInstanced"]) {
    const draw = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...what) {
        if (!window.viewIsSeen) return;
        window.drawnInView += 1;
        draw.apply(this, what);
    };
}
// A frame that is cleared is laid under the page again, which takes as long.
for (const name of ["clear", "clearBufferfv", "clearBufferiv", "clearBufferuiv", "clearBufferfi", "blitFramebuffer"]) {
    const clear = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...what) {
        if (window.viewIsSeen) clear.apply(this, what);
    };
}
"""
"""Draws the 3-D view only on request: a frame takes 0.5 s of CPU in software, and keys wait for it."""


@dataclass
class Opened:
    """A running command with a page, such as ``workbench open``."""

    process: subprocess.Popen[str]
    url: str
    lines: list[str] = field(default_factory=list)
    """stdout and stderr so far."""

    def wait_for_line(self, pattern: str, seconds: float = 60.0) -> str:
        return until(
            lambda: [line for line in list(self.lines) if re.search(pattern, line)],
            f"a line like {pattern!r}",
            seconds,
            lambda: "it printed\n" + "\n".join(self.lines),
        )[0]


@dataclass(frozen=True)
class Sight:
    """What a page or a terminal (without a picture) showed when a test failed."""

    log: str
    picture: bytes | None = None


_pages: list[tuple[Page, list[str]]] = []
_commands: list[Opened] = []
_seen: list[Sight] = []
"""What pages and terminals showed when an exception closed them, until the test's failure is reported."""


def seen_at_failure(failed: bool) -> list[Sight]:
    """Open pages and terminals, and those that an exception closed since the last call; none if not `failed`."""
    _pages[:] = [(page, errors) for page, errors in _pages if not page.is_closed()]
    closed = list(_seen)
    _seen.clear()
    if not failed:
        return []
    shown = [_sight_of(page, errors) for page, errors in _pages]
    return [*closed, *shown, *(Sight("\n".join(opened.lines)) for opened in _commands)]


def with_empty_settings() -> None:
    """Use empty settings, for scripts: the user's trusted files, recent tasks and choices are neither shown nor changed."""
    for folder in ("XDG_CONFIG_HOME", "XDG_STATE_HOME"):
        os.environ[folder] = tempfile.mkdtemp(prefix="workbench-script-")


def _sight_of(page: Page, errors: list[str]) -> Sight:
    log = "\n".join([page.url, *errors])
    try:
        # `evaluate` would wait forever for a page that hangs.
        page.wait_for_function("() => (viewIsSeen = true)", timeout=10_000)
        page.wait_for_timeout(1500)  # viser draws once a second
        return Sight(log, page.screenshot(timeout=10_000))
    except Error as error:
        return Sight(f"{log}\nno picture: {error}")


@contextmanager
def open_workbench(
    *arguments: str,
    cwd: Path | None = None,
    what: str = "open",
    env: dict[str, str] | None = None,
    checks: bool = False,
) -> Iterator[Opened]:
    """Start ``workbench open``, or `what`, on a free port; stop it with SIGINT and fail if it does not exit.

    Args:
        checks: Check rules after each load, which takes a core for some seconds.
    """
    keep_check_after_save(checks)
    command = [sys.executable, "-m", "workbench.cli.main", what, *arguments, "--port", "0"]
    process = subprocess.Popen(
        command,
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "COLUMNS": "200", "PYTHONUNBUFFERED": "1", **(env or {})},
    )
    opened = Opened(process, "")
    stream = process.stdout
    assert stream is not None

    def read() -> None:
        for line in stream:
            opened.lines.append(line.rstrip())

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    _commands.append(opened)
    try:
        opened.url = opened.wait_for_line(r"page +http", START_SECONDS).split()[-1]
        yield opened
    except BaseException:
        _seen.append(Sight("\n".join(opened.lines)))
        raise
    finally:
        _commands.remove(opened)
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=30)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
        reader.join(timeout=5)


def launch(playwright: Playwright, chromium: str) -> Browser:
    return playwright.chromium.launch(executable_path=chromium, args=list(CHROMIUM_ARGUMENTS))


@contextmanager
def browser_at(chromium: str) -> Iterator[Browser]:
    """A Chromium; a process can have one at a time."""
    with sync_playwright() as playwright:
        browser = launch(playwright, chromium)
        yield browser
        browser.close()


BLOCKED_RERUN_HOSTS = re.compile(r"fonts\.googleapis\.com|rerun-io/rerun/releases|tel\.rerun\.io")
"""Requests of rerun's viewer to other servers, which our content policy rightly blocks."""
RERUN_CUT_OFF = re.compile(r"Failed to fetch.*/rerun/viewer-", re.DOTALL)
"""What rerun's viewer throws where its frame is closed while it fetches. A refused fetch has a response instead."""


def new_page(
    browser: Browser, width: int = 1280, height: int = 720, drawn: bool = True, timeline: bool = True
) -> tuple[Page, list[str]]:
    """A page, and the console errors and uncaught exceptions that it has so far.

    Args:
        timeline: Open the timeline under the view.
        drawn: Draw the 3-D view continuously; otherwise only for `picture_of_view`.
    """
    page = browser.new_page(viewport={"width": width, "height": height})
    if timeline:
        page.add_init_script(
            "addEventListener('DOMContentLoaded', () => document.documentElement.setAttribute('data-timeline-open', ''))"
        )
    if not drawn:
        page.add_init_script(DRAW_ON_REQUEST_JS)
    errors: list[str] = []

    def on_console(message: ConsoleMessage) -> None:
        if message.type == "error" and not BLOCKED_RERUN_HOSTS.search(message.text):
            errors.append(message.text)

    def on_exception(error: Error) -> None:
        if not RERUN_CUT_OFF.search(f"{error} {error.stack}"):
            errors.append(str(error))

    page.on("console", on_console)
    page.on("pageerror", on_exception)
    page.set_default_timeout(60_000)
    _pages.append((page, errors))
    return page, errors


@contextmanager
def page_at(
    browser: Browser, url: str, width: int = 1280, height: int = 720, drawn: bool = False
) -> Iterator[tuple[Page, list[str]]]:
    """`new_page` at an address, closed at the end."""
    page, errors = new_page(browser, width, height, drawn)
    try:
        page.goto(url)
        yield page, errors
    except BaseException:
        _seen.append(_sight_of(page, errors))
        raise
    finally:
        page.close()


@contextmanager
def page_on(
    file: Path,
    *arguments: str,
    browser: Browser,
    width: int = 1280,
    height: int = 720,
    drawn: bool = False,
    spare: bool = False,
    checks: bool = False,
) -> Iterator[tuple[Page, list[str], Opened]]:
    """A page that shows the file's task, paused; the list of its errors; and the running command.

    Args:
        spare: Warm up a spare worker, which takes a core for some ten seconds.
        checks: As in `open_workbench`.
    """
    arguments = arguments if spare else (*arguments, "--no-spare")
    with (
        open_workbench(str(file), *arguments, cwd=file.parent, checks=checks) as opened,
        page_at(browser, opened.url, width, height, drawn) as (page, errors),
    ):
        expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
        yield page, errors, opened


def picture_of_view(page: Page, clip: FloatRect) -> NDArray[np.uint8]:
    """Screenshot of that part of the 3-D view, as RGB."""
    before = page.evaluate("viewIsSeen = true, drawnInView")
    # viser redraws once a second even without changes.
    page.wait_for_function("before => drawnInView > before", arg=before)
    shot = page.screenshot(clip=clip)
    page.evaluate("viewIsSeen = false")
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))


def open_tab(page: Page, name: str) -> None:
    """Click the tab until it is open. One in the left dock is not there while the dock is closed."""
    tab = page.get_by_role("tab", name=name)
    if name in ("Envs", "Episodes") and not tab.is_visible():
        page.keyboard.press("b")

    def opened() -> bool:
        tab.click()
        return tab.get_attribute("aria-selected") == "true"

    until(opened, f"the tab {name}")


def close_notice(page: Page) -> None:
    """Close viser's notice about software rendering: it covers other controls."""
    # By script: Playwright would wait for a notice that disappears on its own.
    page.evaluate(
        "for (const close of document.querySelectorAll('.mantine-Notification-closeButton')) close.click()"
    )
