"""Every way to hang or kill the worker under an open page: does the page answer, and when is the task back?

    python tests/benchmarks/unkillable.py [--num-envs 4] [--ways loop segfault ...] [--screenshot FILE]

``workbench open`` on a task that misbehaves on demand (`tests/session/hazards.py`), a real Chromium before it, the
spare worker warm. For each way the task is put into it by a single step; until it is back, a control of the page
is used again and again (*next env*) and the time until the page shows the next env is taken, inside
the page. What cannot be left by *Interrupt* is ended by *Restart*. *Back* is the time from the death of the
process (or the click) until the page says that the last good version is back, or that it was interrupted.
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
from tests.browser.opened import launch, new_page, open_workbench
from tests.session.hazards import calm, provocation, provoke, write_task
from workbench.machine.chromium import find_chromium, how_to_get_chromium

HANGS = {"loop": "Interrupt", "slow": "Interrupt", "catch": "Restart", "native": "Restart"}
DEATHS = ("exit", "segfault", "abort", "kill", "children", "memory")
OTHERS = ("flood", "read")
NEXT_ENV = """() => new Promise((done) => {
    const shown = () => [...document.querySelectorAll('input')].map((i) => i.value).join('|');
    const before = shown(), start = performance.now();
    [...document.querySelectorAll('button')].find((b) => b.innerText.trim() === 'next ›').click();
    const look = () => shown() !== before || performance.now() - start > 10000
        ? done(performance.now() - start) : setTimeout(look, 2);
    look();
})"""


@dataclass(frozen=True)
class Options:
    num_envs: int = 4
    ways: tuple[str, ...] = (*HANGS, *DEATHS, *OTHERS)
    screenshot: Path | None = None
    """Where to leave a picture of the banner of the first way that hangs."""


@dataclass
class Desk:
    page: Page
    file: Path
    server: psutil.Process
    options: Options

    def workers(self) -> list[psutil.Process]:
        found = [
            p for p in self.server.children() if "workbench.session.worker_start" in " ".join(p.cmdline())
        ]
        return sorted(found, key=lambda process: process.create_time())

    def says(self, text: str) -> bool:
        return text in self.page.evaluate("() => document.body.textContent")

    def click(self, name: str) -> None:
        self.page.get_by_role("button", name=name, exact=True).click()

    def poke_until(self, reached: Callable[[], bool], trips: list[float], patience: float = 90.0) -> float:
        """Use the control until `reached`; the seconds that it took."""
        start = time.perf_counter()
        while not reached():
            if time.perf_counter() - start > patience:
                raise TimeoutError(page_text(self.page)[:1000])
            trips.append(self.page.evaluate(NEXT_ENV))
            time.sleep(0.05)
        return time.perf_counter() - start


def page_text(page: Page) -> str:
    """What can be seen; `Desk.says` also finds what stands on the other tabs."""
    return page.inner_text("body")


def one_way(desk: Desk, way: str) -> str:
    """Provoke it, see it through, and the row of the table."""
    desk.poke_until(lambda: desk.says("the spare worker") and not desk.says("being warmed up"), [], 180.0)
    worker, trips = desk.workers()[0], []
    usage = desk.server.cpu_times()
    provoke(desk.file, "evaluate", way)
    desk.click("Step")
    said = ""
    if way in HANGS:
        busy = desk.poke_until(lambda: desk.says("has been in evaluate for"), trips)
        said = f"busy banner after {busy:.1f} s; "
        if desk.options.screenshot is not None and way == "loop":
            time.sleep(3.0)
            desk.page.screenshot(path=desk.options.screenshot, type="jpeg", quality=82)
        desk.click("Interrupt")
        if HANGS[way] == "Restart":
            deaf = desk.poke_until(lambda: desk.says("was interrupted and goes on"), trips)
            said += f"deaf after {deaf:.1f} s; "
            calm(desk.file)
            desk.click("Restart")
            back = desk.poke_until(lambda: desk.says("is back where it was"), trips)
        else:
            back = desk.poke_until(lambda: desk.says("was interrupted in evaluate"), trips)
        said += f"{HANGS[way]}"
    elif way in DEATHS:
        dying = desk.poke_until(lambda: not worker.is_running() or worker.status() == "zombie", trips)
        said = f"dead after {dying:.1f} s"
        calm(desk.file)
        back = desk.poke_until(lambda: desk.says("is back where it was"), trips)
    else:
        word = "EOFError" if way == "read" else "came too fast to be kept"
        back = desk.poke_until(lambda: desk.says(word) and "busy" not in page_text(desk.page), trips)
        if way == "flood":
            # It takes its provocation away when it ends, and would take the next one's.
            desk.poke_until(lambda: not provocation(desk.file).exists(), trips)
    calm(desk.file)
    now = desk.server.cpu_times()
    cpu = now.user + now.system - usage.user - usage.system
    memory = desk.server.memory_info().rss / 2**20
    desk.click("Step")
    time.sleep(1.0)
    return (
        f"| {way} | {said} | {back:.2f} | {statistics.median(trips):.0f} | {max(trips):.0f} | {len(trips)} "
        f"| {cpu:.1f} | {memory:.0f} |"
    )


def main(options: Options) -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    with tempfile.TemporaryDirectory() as name:
        file = write_task(Path(name))
        arguments = (str(file), "--num-envs", str(options.num_envs), "--memory-limit", "3GB")
        with open_workbench(*arguments, cwd=Path(name)) as opened, sync_playwright() as playwright:
            page, _ = new_page(launch(playwright, chromium))
            page.add_init_script(NO_DRAWING)
            page.goto(opened.url)
            expect(page.get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
            page.get_by_role("tab", name="Log").click()
            page.get_by_role("tab", name="Run").click()
            desk = Desk(page, file, psutil.Process(opened.process.pid), options)
            print(f"{options.num_envs} envs; round trips in ms, CPU of the server in s, its memory in MB")
            print("| way | what happened | back after s | trip median | worst | trips | CPU | memory |")
            print("|---|---|---|---|---|---|---|---|", flush=True)
            for way in options.ways:
                print(one_way(desk, way), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
