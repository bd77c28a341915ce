"""``workbench open`` as a person types it, and a real Chromium in front of it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from playwright.sync_api import Browser, ConsoleMessage, Page, Playwright, expect, sync_playwright

TASK = Path(__file__).parents[2] / "tasks" / "push_cube.py"
"""The example task; what is edited is a copy of it."""
CHROMIUM_ARGUMENTS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    # Without these Chromium looks up its maker's hosts at every start.
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
START_SECONDS = 60.0


@dataclass
class Opened:
    """A running ``workbench open``."""

    process: subprocess.Popen[str]
    url: str
    lines: list[str] = field(default_factory=list)
    """What it printed so far, stdout and stderr."""

    def wait_for_line(self, pattern: str, seconds: float = 60.0) -> str:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            for line in list(self.lines):
                if re.search(pattern, line):
                    return line
            time.sleep(0.05)
        raise AssertionError(
            f"no line like {pattern!r} within {seconds} s; it printed:\n" + "\n".join(self.lines)
        )


@contextmanager
def open_workbench(*arguments: str, cwd: Path, what: str = "open") -> Iterator[Opened]:
    """Start ``workbench open``, or `what`, on a free port; end it with Ctrl-C's signal and insist that it ends."""
    command = [sys.executable, "-m", "workbench.cli", what, *arguments, "--port", "0"]
    process = subprocess.Popen(
        command,
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "COLUMNS": "200", "PYTHONUNBUFFERED": "1"},
    )
    opened = Opened(process, "")
    stream = process.stdout
    assert stream is not None

    def read() -> None:
        for line in stream:
            opened.lines.append(line.rstrip())

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        opened.url = opened.wait_for_line(r"page +http", START_SECONDS).split()[-1]
        yield opened
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
        reader.join(timeout=5)


def launch(playwright: Playwright, chromium: str) -> Browser:
    return playwright.chromium.launch(executable_path=chromium, args=list(CHROMIUM_ARGUMENTS))


def new_page(browser: Browser, width: int = 1280, height: int = 720) -> tuple[Page, list[str]]:
    """A page, and the console errors and uncaught exceptions that it has so far."""
    page = browser.new_page(viewport={"width": width, "height": height})
    errors: list[str] = []

    def on_console(message: ConsoleMessage) -> None:
        if message.type == "error":
            errors.append(message.text)

    page.on("console", on_console)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.set_default_timeout(60_000)
    return page, errors


@contextmanager
def page_on(
    file: Path, *arguments: str, chromium: str, width: int = 1280, height: int = 720
) -> Iterator[tuple[Page, list[str], Opened]]:
    """A page that shows the file's task, paused; what is wrong on it so far; and the terminal."""
    with (
        open_workbench(str(file), *arguments, cwd=file.parent) as opened,
        sync_playwright() as playwright,
    ):
        browser = launch(playwright, chromium)
        page, errors = new_page(browser, width, height)
        page.goto(opened.url)
        expect(page.get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
        yield page, errors, opened
        browser.close()


def until(reached: Callable[[], bool], what: str, seconds: float = 60.0) -> None:
    """Wait for what Playwright's own ``expect`` cannot say."""
    deadline = time.monotonic() + seconds
    while not reached():
        assert time.monotonic() < deadline, f"{what} did not come within {seconds} s"
        time.sleep(0.05)


def close_notice(page: Page) -> None:
    """Press away viser's notice that the browser draws in software: it lies over what is below it."""
    notice = page.locator(".mantine-Notification-closeButton")
    if notice.count():
        notice.first.click()
