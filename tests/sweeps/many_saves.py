"""Save a task's file again and again while a page plays it: does the page keep showing the current state?

    python tests/sweeps/many_saves.py [--saves 30] [--every 10] [--num-envs 16] [--pictures FOLDER]

A real Chromium shows the Reward tab of ``tasks/push_cube.py`` while versions are saved: good ones, some with a syntax error,
some with a reward that is NaN in every third env, and some that rebuild all envs. Between two saves the canvas's pixels are
checked several times for the reward curve; after each save a line prints the memory of the server, its processes and
the page. The last line counts the checks with an empty chart and prints the server's growth.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import psutil
import tyro
from playwright.sync_api import Page, expect

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.drive.page import TASK, browser_at, page_on
from workbench.machine.doctor import find_chromium

Kind = Literal["good", "NaN", "rebuilding", "broken"]
CHART_CHECKS = 4
"""Checks of the chart between two saves."""
RETURN_REWARD = "return reward\n"
SCENE = "CUBE_HALF_SIZE = 0.02\n"


@dataclass(frozen=True)
class Options:
    saves: int = 30
    every: float = 10.0
    """Seconds between two saves."""
    num_envs: int = 16
    pictures: Path | None = None
    """Folder for a screenshot of the page after each save."""


def kind_of(number: int) -> Kind:
    if number % 7 == 6:
        return "rebuilding"
    if number % 5 == 2:
        return "NaN"
    return "broken" if number % 6 == 4 else "good"


def version(text: str, number: int) -> str:
    """Return the file's text for save `number`; its scene is that of the last rebuilding save."""
    assert RETURN_REWARD in text and SCENE in text
    kind, scene = kind_of(number), sum(kind_of(n) == "rebuilding" for n in range(number + 1))
    text = text.replace(SCENE, f"CUBE_HALF_SIZE = {0.02 + 1e-4 * scene:.4f}\n", 1)
    reward = f"reward = reward + {number} * 1e-6\n        "
    if kind == "NaN":
        reward += "reward[::3] = torch.nan\n        "
    text = text.replace(RETURN_REWARD, reward + RETURN_REWARD, 1)
    return text + (f"\ndef broken(:  # {number}\n" if kind == "broken" else "")


def megabytes(process: psutil.Process) -> float:
    return process.memory_info().rss / 2**20


def memory_of(page: Page, pid: int) -> str:
    server = psutil.Process(pid)
    workers = server.children(recursive=True)
    heap = page.evaluate("performance.memory?.usedJSHeapSize ?? 0") / 2**20
    others = ", ".join(f"{megabytes(worker):.0f}" for worker in workers if worker.is_running())
    return f"server {megabytes(server):.0f} MB, its processes {others} MB, the page's heap {heap:.0f} MB"


def main(options: Options) -> None:
    chromium = find_chromium()
    assert chromium is not None
    empty, checks = 0, 0
    with tempfile.TemporaryDirectory() as name:
        file = Path(shutil.copy(TASK, name))
        good = file.read_text()
        with (
            browser_at(chromium) as browser,
            page_on(file, "--num-envs", str(options.num_envs), browser=browser, drawn=True, spare=True) as (
                page,
                errors,
                opened,
            ),
        ):
            page.get_by_role("button", name="Play", exact=True).click()
            page.get_by_role("tab", name="Reward").click()
            expect(page.locator(".wb-chart-area:visible").first).to_be_visible(timeout=300_000)
            before = megabytes(psutil.Process(opened.process.pid))
            for number in range(options.saves):
                kind, saved_at = kind_of(number), time.monotonic()
                file.write_text(version(good, number))
                line_counts = []
                for check in range(1, CHART_CHECKS + 1):
                    page.wait_for_timeout(
                        max(0.0, 1000 * (saved_at + check * options.every / CHART_CHECKS - time.monotonic()))
                    )
                    line_counts.append(page.locator(".wb-chart-area:visible polyline").count())
                empty, checks = (
                    empty + sum(not lines for lines in line_counts),
                    checks + len(line_counts),
                )
                print(
                    f"{number + 1} {kind}: {line_counts} lines drawn | {memory_of(page, opened.process.pid)}",
                    flush=True,
                )
                if options.pictures is not None:
                    page.screenshot(path=options.pictures / f"save_{number + 1:02}_{kind}.png")
            after = megabytes(psutil.Process(opened.process.pid))
            print(
                f"empty in {empty} of {checks} checks; the server grew from {before:.0f} to {after:.0f} MB; console: {errors}"
            )


if __name__ == "__main__":
    main(tyro.cli(Options))
