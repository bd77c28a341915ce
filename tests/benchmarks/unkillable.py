"""Every way to hang or kill the worker under an open page: latency of the page, and time until the task is back.

    python tests/benchmarks/unkillable.py [--num-envs 4] [--ways loop segfault ...] [--screenshot FILE] [--write]

Runs ``workbench open`` on a task that misbehaves on demand (`tests/live/hazards.py`), in a real Chromium, with a warm
spare worker. A single step triggers each way. Until the task is back, a control of the page (*next env*) is used
repeatedly, and the time until the page shows the next env is measured inside the page. A worker that ignores *Interrupt*
is ended by *Restart*. *Back* is the time from the death of the process (or the click) until another worker has the task
paused, or the page says that the task was interrupted. The browser has no GPU, and shares the cores with the server, the
worker and this script.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import psutil
import tyro
from playwright.sync_api import Page, expect, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.benchmarks.page_rate import NO_DRAWING
from tests.benchmarks.table import Row, keep
from tests.drive.page import launch, new_page, open_workbench, with_empty_settings
from tests.drive.processes import workers_of
from tests.live.hazards import calm, provocation, provoke, write_task
from workbench.machine.doctor import find_chromium, how_to_get_chromium

HANGS = {"loop": "Interrupt", "slow": "Interrupt", "catch": "Restart", "native": "Restart"}
DEATHS = ("exit", "segfault", "abort", "kill", "children", "memory")
OTHERS = ("flood", "read")
NEXT_ENV = """async () => {
    const shown = () => document.querySelector('.wb-timeline').innerText.match(/env \\d+/)?.[0];
    const before = shown(), start = performance.now();
    document.querySelector('[role=button][aria-label="Next env"]').click();
    while (shown() === before && performance.now() - start < 10000) await new Promise((done) => setTimeout(done, 2));
    return performance.now() - start;
}"""
"""Returns the milliseconds from a press on *Next env* until the page shows that env."""


@dataclass(frozen=True)
class Options:
    num_envs: int = 4
    ways: tuple[str, ...] = (*HANGS, *DEATHS, *OTHERS)
    screenshot: Path | None = None
    """File for a screenshot of the banner of the first way that hangs."""
    write: bool = False
    """Write a row of the table of benchmarks."""


@dataclass
class Desk:
    page: Page
    file: Path
    server: psutil.Process
    options: Options

    def workers(self) -> list[psutil.Process]:
        return workers_of(self.server)

    def says(self, text: str) -> bool:
        return text in self.page.evaluate("() => document.body.textContent")

    def is_back(self, before: psutil.Process) -> bool:
        """Whether another worker than `before` has the task, paused."""
        workers = self.workers()
        paused = self.page.evaluate(
            "() => /\\bpaused\\b/.test(document.querySelector('.wb-status').innerText)"
        )
        return paused and bool(workers) and workers[0] != before

    def click(self, name: str) -> None:
        self.page.get_by_role("button", name=name, exact=True).click()

    def poke_until(self, reached: Callable[[], bool], trips: list[float], timeout: float = 90.0) -> float:
        """Use the control until `reached`; returns the seconds."""
        start = time.perf_counter()
        while not reached():
            if time.perf_counter() - start > timeout:
                raise TimeoutError(page_text(self.page)[:1000])
            trips.append(self.page.evaluate(NEXT_ENV))
            time.sleep(0.05)
        return time.perf_counter() - start


def page_text(page: Page) -> str:
    """The visible text; `Desk.says` also searches the other tabs."""
    return page.inner_text("body")


def one_way(desk: Desk, way: str) -> tuple[str, float]:
    """Trigger one way and wait for the task; returns the line to print, and the seconds until the task was back."""
    desk.poke_until(lambda: desk.says("the spare worker") and not desk.says("warming up"), [], 180.0)
    worker, trips = desk.workers()[0], list[float]()
    usage = desk.server.cpu_times()
    provoke(desk.file, "evaluate", way)
    desk.click("Step")
    outcome = ""
    if way in HANGS:
        busy = desk.poke_until(lambda: desk.says("has been in evaluate for"), trips)
        outcome = f"busy banner after {busy:.1f} s; "
        if desk.options.screenshot is not None and way == "loop":
            time.sleep(3.0)
            desk.page.screenshot(path=desk.options.screenshot, type="jpeg", quality=82)
        desk.click("Interrupt")
        if HANGS[way] == "Restart":
            deaf = desk.poke_until(lambda: desk.says("did not stop when it was interrupted"), trips)
            outcome += f"deaf after {deaf:.1f} s; "
            calm(desk.file)
            desk.click("Restart")
            back = desk.poke_until(lambda: desk.is_back(worker), trips)
        else:
            back = desk.poke_until(lambda: desk.says("was interrupted in evaluate"), trips)
        outcome += f"{HANGS[way]}"
    elif way in DEATHS:
        dying = desk.poke_until(lambda: not worker.is_running() or worker.status() == "zombie", trips)
        outcome = f"dead after {dying:.1f} s"
        calm(desk.file)
        back = desk.poke_until(lambda: desk.is_back(worker), trips)
    else:
        word = "EOFError" if way == "read" else "they came too fast"
        back = desk.poke_until(lambda: desk.says(word) and "busy" not in page_text(desk.page), trips)
        if way == "flood":
            # The task removes the provocation file when it ends, and would remove that of the next way.
            desk.poke_until(lambda: not provocation(desk.file).exists(), trips)
    calm(desk.file)
    now = desk.server.cpu_times()
    cpu = now.user + now.system - usage.user - usage.system
    memory = desk.server.memory_info().rss / 2**20
    desk.click("Step")
    time.sleep(1.0)
    line = (
        f"| {way} | {outcome} | {back:.2f} | {median_and_worst(trips)} "
        f"| {len(trips)} | {cpu:.1f} | {memory:.0f} |"
    )
    return line, back


def median_and_worst(times: list[float]) -> str:
    return f"{statistics.median(times):.0f} | {max(times):.0f}" if times else "- | -"


def main(options: Options) -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    with_empty_settings()
    with tempfile.TemporaryDirectory() as name:
        file = write_task(Path(name))
        arguments = (str(file), "--num-envs", str(options.num_envs), "--memory-limit", "3GB")
        with open_workbench(*arguments, cwd=Path(name)) as opened, sync_playwright() as playwright:
            page, _ = new_page(launch(playwright, chromium))
            page.add_init_script(NO_DRAWING)
            page.goto(opened.url)
            expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible(
                timeout=120_000
            )
            page.get_by_role("tab", name="Log").click()
            page.get_by_role("tab", name="Run").click()
            desk = Desk(page, file, psutil.Process(opened.process.pid), options)
            print(f"{options.num_envs} envs; round trips in ms, CPU of the server in s, its memory in MB")
            print("| way | what happened | back after s | trip median | worst | trips | CPU | memory |")
            print("|" + "---|" * 8, flush=True)
            slowest = 0.0
            for way in options.ways:
                line, back = one_way(desk, way)
                slowest = max(slowest, back)
                print(line, flush=True)
            if options.write:
                what = (
                    f"Worker that hangs or dies: until the page has the task back, {options.num_envs} envs, "
                )
                what += f"slowest of {len(options.ways)} ways"
                keep([Row(what, slowest, None, "s", "less", "unkillable.py")])


if __name__ == "__main__":
    main(tyro.cli(Options))
