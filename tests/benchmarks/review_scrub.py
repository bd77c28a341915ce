"""Positions per second shown while the time slider is dragged: over recordings, and over a live session's past.

    python tests/benchmarks/review_scrub.py [--envs 64] [--seconds 8] [--software]

A recording holds one env, so a review of 64 envs is 64 recordings opened side by side, made here by ``workbench record``.
It is compared with the live page over the history of as many envs, through the same kind of slider in the same run: compare
the ratio. Real mouse events drag the slider back and forth in a real Chromium; animation frames are counted in which the
poses of the robots' hands differ from the previous frame. Draw calls do nothing, to simulate a browser with a GPU
(``--software`` lets Chromium rasterise on the CPU).
"""

from __future__ import annotations

import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import tyro
from playwright.sync_api import Browser, Page, expect, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.benchmarks.page_rate import NO_DRAWING
from tests.drive.page import launch, new_page
from tests.drive.waiting import until
from workbench.machine.doctor import find_chromium, how_to_get_chromium

TASK = Path(__file__).parents[2] / "tasks" / "push_cube.py"
expect.set_options(timeout=180_000)
STEPS = 50
REPEATS = 3
WATCH = """() => {
    const nodes = () => window.__viserSceneTree.getState();
    const hand = Object.keys(nodes()).find((name) => name.includes('panda_hand'));
    window.__seen = {applied: 0, frames: 0, last: null, running: true};
    const look = () => {
        const seen = window.__seen;
        seen.frames += 1;
        const poses = nodes()[hand].message.props.batched_positions;
        if (poses !== seen.last) { seen.applied += 1; seen.last = poses; }
        if (seen.running) requestAnimationFrame(look);
    };
    requestAnimationFrame(look);
}"""


@dataclass
class Options:
    envs: int = 64
    seconds: float = 8.0
    software: bool = False


@contextmanager
def command(*arguments: str) -> Iterator[str]:
    """Run a workbench command that opens a page; yields its address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "workbench.cli.main", *arguments, "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "COLUMNS": "200", "PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    for line in process.stdout:
        if re.search(r"page +http", line):
            break
    else:
        raise SystemExit("the command ended before it opened a page")
    try:
        yield line.split()[-1]
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)


def scrub(page: Page, seconds: float) -> tuple[float, float]:
    """Positions and animation frames per second while the slider is dragged back and forth."""
    box = page.locator("input[type=range]:visible").last.bounding_box()
    assert box is not None
    y, low, high = box["y"] + box["height"] / 2, box["x"] + 4, box["x"] + box["width"] - 4
    page.mouse.move(low, y)
    page.mouse.down()
    page.evaluate(WATCH)
    began, n = time.monotonic(), 0
    while time.monotonic() - began < seconds:
        # One pass takes 1.5 s, at whatever rate the browser accepts the events.
        phase = (time.monotonic() - began) / 1.5
        page.mouse.move(low + (high - low) * (1 - abs(1 - phase % 2)), y)
        n += 1
    took = time.monotonic() - began
    seen = page.evaluate("() => { window.__seen.running = false; return window.__seen; }")
    page.mouse.up()
    return seen["applied"] / took, seen["frames"] / took


def review(browser: Browser, folder: Path, options: Options) -> list[tuple[float, float]]:
    with command("review", str(folder)) as url:
        page = opened_page(browser, url, options)
        expect(page.get_by_text(f"all {options.envs}").first).to_be_visible()
        page.keyboard.press("Control+a")
        began = time.monotonic()
        page.get_by_text("Side by side", exact=True).click()
        expect(page.locator(".wb-timeline")).to_be_visible()
        first = time.monotonic() - began
        expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible()
        opened = time.monotonic() - began
        print(f"  {options.envs} recordings: the first seen after {first:.1f} s, all after {opened:.1f} s")
        return measured(page, options)


def live(browser: Browser, options: Options) -> list[tuple[float, float]]:
    with command("open", str(TASK), "--num-envs", str(options.envs), "--no-spare") as url:
        page = opened_page(browser, url, options)
        expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible(timeout=180_000)
        untick(page)
        page.keyboard.press("Space")
        slider = page.locator(".wb-timeline")
        until(lambda: (m := re.search(r"(\d+) steps$", slider.inner_text().strip())) is not None
              and int(m[1]) > STEPS, "the past", 180)  # fmt: skip
        page.keyboard.press("Space")
        expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible()
        return measured(page, options)


def opened_page(browser: Browser, url: str, options: Options) -> Page:
    page, _ = new_page(browser)
    if not options.software:
        page.add_init_script(NO_DRAWING)
    page.goto(url)
    return page


def untick(page: Page) -> None:
    """Turn the pictures off: without a GPU they would take most of the time."""
    page.get_by_role("tab", name="Cameras").click()
    for box in page.get_by_role("checkbox").all():
        if box.is_checked():
            box.click()
    page.get_by_role("tab", name="Run").click()


def measured(page: Page, options: Options) -> list[tuple[float, float]]:
    time.sleep(3.0)
    scrub(page, 2.0)
    found = []
    for _ in range(REPEATS):
        page.wait_for_timeout(500)
        found.append(scrub(page, options.seconds))
    page.close()
    return found


def print_rates(what: str, found: list[tuple[float, float]]) -> float:
    rates = [rate for rate, _ in found]
    frames = statistics.median(frames for _, frames in found)
    median = statistics.median(rates)
    print(f"  {what}: {median:.1f} positions/s ({min(rates):.1f} to {max(rates):.1f}), {frames:.0f} frames/s")
    return median


def main(options: Options) -> None:
    chromium = find_chromium()
    if chromium is None:
        raise SystemExit(how_to_get_chromium())
    with tempfile.TemporaryDirectory() as name, sync_playwright() as playwright:
        folder = Path(name)
        envs = str(options.envs)
        subprocess.run(
            [sys.executable, "-m", "workbench.cli.main", "record", str(TASK), "--episodes", envs, "--num-envs", envs,
             "--no-pictures", "--out", str(folder)],
            check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        browser = launch(playwright, chromium)
        print(f"{envs} envs, {'software drawing' if options.software else 'no drawing'}")
        of_review = print_rates("review     ", review(browser, folder, options))
        of_live = print_rates("live's past", live(browser, options))
        print(f"  review / live {of_review / of_live:.2f}")
        browser.close()


if __name__ == "__main__":
    main(tyro.cli(Options))
