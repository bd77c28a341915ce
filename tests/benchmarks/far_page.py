"""Bytes that a page takes while the task plays, and how a page far away answers.

    python tests/benchmarks/far_page.py [--num-envs 16 64 256] [--against CHECKOUT] [--line]

``workbench open`` on the example task, with Chromium behind a relay on loopback that counts what passes
(all of it: websocket frames, their headers, panels and poses). *A second at 30 Hz* is the bytes of an applied
update times 30: a machine that cannot play so many envs fast enough sends fewer.

``--line`` puts the page behind 2 Mbit/s and a round trip of 80 ms, with room for 2 MB in the line (as
``ssh -L`` has), and measures the time from a click on Play or Pause to the button's answer, while playing,
and how many bytes wait in the line.

``--against`` measures another checkout (an older version) in turn, in the same run.
"""

from __future__ import annotations

import shutil
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from playwright.sync_api import Browser, Page, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.benchmarks.page_rate import COUNT, TASK, Options, prepare, timed_click
from tests.drive.far_line import FarLine, line_to
from tests.drive.page import launch, new_page, open_workbench
from workbench.machine.doctor import find_chromium, how_to_get_chromium

HERE = Path(__file__).parents[2]
BITS, DELAY = 2e6, 0.04


@dataclass(frozen=True)
class FarOptions:
    num_envs: tuple[int, ...] = (16, 64, 256)
    against: Path | None = None
    """Another checkout, measured first."""
    speed: str = "4 ×"
    seconds: float = 10.0
    clicks: int = 10
    line: bool = False
    """Also measure behind 2 Mbit/s and 80 ms."""
    cameras: bool = False
    """Leave the default pictures on."""


def play(page: Page, options: FarOptions, num_envs: int, url: str) -> None:
    prepare(page, Options(num_envs, options.speed, cameras=options.cameras), url)
    timed_click(page, "Play", "Pause")
    time.sleep(3.0)


def bytes_a_second(browser: Browser, options: FarOptions, num_envs: int, url: str) -> str:
    with line_to(url) as line:
        page, _ = new_page(browser)
        play(page, options, num_envs, line.address(url))
        before, start = line.down, time.monotonic()
        applied, _ = page.evaluate(COUNT, options.seconds)
        rate = (line.down - before) / (time.monotonic() - start)
        timed_click(page, "Pause", "Play")
        time.sleep(2.0)
        before = line.down
        time.sleep(3.0)
        still = (line.down - before) / 3.0
        page.close()
    each = rate / max(applied, 0.1)
    return (
        f"| {rate / 1e6:.3f} | {applied:.1f} | {each / 1e3:.1f} | {30 * each / 1e6:.3f} | {still / 1e3:.1f} |"
    )


def answers(browser: Browser, options: FarOptions, num_envs: int, url: str) -> str:
    with line_to(url, BITS, DELAY) as line:
        page, _ = new_page(browser)
        play(page, options, num_envs, line.address(url))
        applied, _ = page.evaluate(COUNT, options.seconds)
        times, most = [], 0
        for _ in range(options.clicks):
            times.append(timed_click(page, "Pause", "Play"))
            most = max(most, watched(line, 0.5))
            times.append(timed_click(page, "Play", "Pause"))
            most = max(most, watched(line, 1.0))
        page.close()
    return (
        f"| {1000 * statistics.median(times):.0f} | {1000 * max(times):.0f} | {applied:.1f} "
        f"| {8 * most / BITS:.2f} |"
    )


def watched(line: FarLine, seconds: float) -> int:
    """The most bytes that waited in the line in these seconds."""
    most, end = 0, time.monotonic() + seconds
    while time.monotonic() < end:
        most = max(most, line.waiting)
        time.sleep(0.01)
    return most


def main(options: FarOptions) -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    sides = [("now", HERE)] if options.against is None else [("before", options.against), ("now", HERE)]
    rows = []
    with sync_playwright() as playwright:
        browser = launch(playwright, chromium)
        for num_envs in options.num_envs:
            for side, checkout in sides:
                with tempfile.TemporaryDirectory() as name:
                    file = Path(shutil.copy(TASK, Path(name) / "push_cube.py"))
                    with open_workbench(
                        *(str(file), "--num-envs", str(num_envs), "--no-spare"),
                        cwd=Path(name),
                        env={"PYTHONPATH": str(checkout.resolve())},
                    ) as opened:
                        cells = bytes_a_second(browser, options, num_envs, opened.url)
                        if options.line:
                            cells += answers(browser, options, num_envs, opened.url)[1:]
                        rows.append(f"| {num_envs} | {side} {cells}")
                        print(rows[-1], file=sys.stderr, flush=True)
    head = "| envs | | MB a second | applied updates a second | kB an update | MB a second at 30 Hz | paused, kB a second |"
    if options.line:
        head += (
            " Play or Pause, ms: median | worst | applied updates a second | most that waits in the line, s |"
        )
    print(head, "|" + "---|" * (head.count("|") - 1), *rows, sep="\n")


if __name__ == "__main__":
    main(tyro.cli(FarOptions))
