"""Twenty pages at once, one that reads nothing, and one that reconnects: does anything stall or grow?

    python tests/sweeps/many_tabs.py [--tabs 19] [--seconds 120] [--reconnects 200] [--num-envs 16]

``workbench open`` plays the example task with camera pictures for one real Chromium (without draw calls, see
`tests/benchmarks/page_rate.py`) and many tabs without a browser. Each row prints the latency of a click in the real page,
its updates per second, the server's CPU, memory, threads and files, and the data sent to each tab.
"""

from __future__ import annotations

import shutil
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import psutil
import tyro
from playwright.sync_api import Page, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.benchmarks.page_rate import COUNT, TASK, play_to_pause, prepare, timed_click
from tests.benchmarks.page_rate import Options as PageOptions
from tests.drive.page import launch, new_page, open_workbench, with_empty_settings
from tests.drive.tabs import Tab, open_deaf_tab, tabs_of
from workbench.machine.doctor import find_chromium, how_to_get_chromium


@dataclass(frozen=True)
class Options:
    tabs: int = 19
    """Tabs in addition to the real page."""
    seconds: float = 120.0
    """Time for which all tabs play; a row is printed after each quarter."""
    reconnects: int = 200
    num_envs: int = 16
    clicks: int = 10


@dataclass
class Scene:
    options: Options
    page: Page
    server: psutil.Process
    worker: psutil.Process
    tabs: list[Tab]

    def row(self, what: str, seconds: float = 8.0) -> None:
        """Play for `seconds` and print a row with the measurements."""
        clicks = play_to_pause(self.page, self.options.clicks)
        timed_click(self.page, "Play", "Pause")
        time.sleep(1.0)
        for process in (self.server, self.worker):
            process.cpu_percent()  # starts the measurement
        before = [tab.megabytes for tab in self.tabs]
        applied, _ = self.page.evaluate(COUNT, seconds)
        cpu, theirs = self.server.cpu_percent(), self.worker.cpu_percent()
        timed_click(self.page, "Pause", "Play")
        sent = [tab.megabytes - had for tab, had in zip(self.tabs, before, strict=True)]
        each = f"{statistics.median(sent) / seconds:.2f} MB/s" if sent else "-"
        print(
            f"{what:32} click {1000 * statistics.median(clicks):4.0f} ms, worst {1000 * max(clicks):4.0f} | "
            f"{applied:4.1f} updates/s | server {cpu:3.0f} % (worker {theirs:3.0f} %), {self.holds()} | each tab {each}, "
            f"{sum(tab.open for tab in self.tabs)} open",
            flush=True,
        )

    def holds(self) -> str:
        memory = self.server.memory_info().rss / 2**20
        return f"{memory:.0f} MB, {self.server.num_threads()} threads, {self.server.num_fds()} files"


def main(options: Options) -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    with_empty_settings()
    with tempfile.TemporaryDirectory() as name:
        file = Path(shutil.copy(TASK, Path(name) / "push_cube.py"))
        with (
            open_workbench(
                str(file),
                "--num-envs",
                str(options.num_envs),
                "--no-spare",
                "--history",
                "16MB",
                cwd=Path(name),
            ) as opened,
            tabs_of(opened.url) as tabs,
            sync_playwright() as playwright,
        ):
            page, errors = new_page(launch(playwright, chromium))
            prepare(page, PageOptions(speed="1 ×", cameras=True), opened.url)
            server = psutil.Process(opened.process.pid)
            (worker,) = server.children()
            scene = Scene(options, page, server, worker, [])
            scene.row("the page alone")
            scene.tabs += [tabs.open() for _ in range(options.tabs)]
            for _ in range(4):
                scene.row(f"with {options.tabs} more", options.seconds / 4)
            idle = open_deaf_tab(opened.url)
            scene.row("and one that reads nothing")
            began = time.monotonic()
            opened.wait_for_line("has read nothing", 60)
            print(f"the server closed it after {time.monotonic() - began:.0f} s")
            idle.close()
            scene.row("without it")
            for tab in scene.tabs:
                tabs.close(tab)
            scene.tabs.clear()
            scene.row("the page alone")
            for part in range(4):
                for _ in range(options.reconnects // 4):
                    tab = tabs.open()
                    while not tab.open:
                        time.sleep(0.01)
                    tabs.close(tab)
                scene.row(f"after {(part + 1) * (options.reconnects // 4)} reconnects", 4.0)
            print("errors in the page:", errors or "none")
            print("printed:", *[line for line in opened.lines if "Closed" in line], sep="\n  ")


if __name__ == "__main__":
    main(tyro.cli(Options))
