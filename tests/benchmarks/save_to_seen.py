"""From saving a task's file to seeing the new version: the workbench against a cold restart.

    python tests/benchmarks/save_to_seen.py [--num-envs 16] [--saves 7] [--restarts 3]

The workbench side: ``workbench open`` with the cameras on and a real Chromium before it. Each save
changes the cube's colour and renames an entry of ``evaluate``; the clock runs from the end of the write
until the page shows both the new entry and a new picture of the sensor camera (every env is rebuilt).

The other side: what an author does without it, python started anew on the same file: import, stock
``gym.make`` of one env, reset, first picture. Both sides render with the same driver, in one run.
"""

from __future__ import annotations

import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from playwright.sync_api import Page, expect, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.browser.opened import launch, new_page, open_workbench
from workbench.machine.chromium import find_chromium, how_to_get_chromium

TASK = Path(__file__).parents[2] / "tasks" / "push_cube.py"
COLD = """
import runpy, sys
import gymnasium as gym
runpy.run_path(sys.argv[1], run_name="task")
env = gym.make("WorkbenchPushCube-v1", num_envs=1, render_mode="rgb_array", render_backend="cpu")
env.reset(seed=0)
picture = env.render()
assert picture.shape[-1] == 3 and float(picture.float().std()) > 1
"""


@dataclass(frozen=True)
class Options:
    num_envs: int = 16
    saves: int = 7
    restarts: int = 3


def cold_restart(file: Path) -> float:
    """Seconds from starting python to the first picture of stock ManiSkill."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-W", "ignore", "-c", COLD, str(file)], check=True, capture_output=True)
    return time.perf_counter() - start


def version(number: int) -> str:
    """The example task with another colour of the cube and another name of an entry."""
    text = TASK.read_text()
    blue = "base_color=[0.05, "
    assert '"cube_to_goal"' in text and text.count(blue) == 1
    shade = 0.1 + 0.8 * (number % 5) / 4
    text = text.replace('"cube_to_goal"', f'"seen_{number}"')
    return text.replace(blue, f"base_color=[{shade}, ")


def save_to_seen(page: Page, file: Path, number: int) -> float:
    """Seconds from the saved file to the new entry and a new picture on the page."""
    before = page.locator('img[src^="blob:"]').first.get_attribute("src")
    file.write_text(version(number))
    start = time.perf_counter()
    page.wait_for_function(
        """([entry, before]) => {
            const image = document.querySelector('img[src^="blob:"]');
            return document.body.textContent.includes(entry) && image && image.src !== before;
        }""",
        arg=[f"seen_{number}", before],
        polling=10,
    )
    return time.perf_counter() - start


def workbench_side(options: Options, folder: Path, chromium: str) -> list[float]:
    file = Path(shutil.copy(TASK, folder / "push_cube.py"))
    with (
        open_workbench(str(file), "--num-envs", str(options.num_envs), cwd=folder) as opened,
        sync_playwright() as playwright,
    ):
        page, _ = new_page(launch(playwright, chromium))
        page.goto(opened.url)
        expect(page.get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
        # Tabs that were opened once keep their content, so both the picture and the table are there.
        page.get_by_role("tab", name="Cameras").click()
        expect(page.get_by_text("rendered in").first).to_be_visible(timeout=60_000)
        page.get_by_role("tab", name="Reward").click()
        save_to_seen(page, file, 99)  # the first is slower: caches of the second version
        return [save_to_seen(page, file, number) for number in range(options.saves)]


def main(options: Options) -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seen = workbench_side(options, folder, chromium)
        cold = [cold_restart(folder / "push_cube.py") for _ in range(options.restarts)]
    print(f"push_cube.py, {options.num_envs} envs, cameras on, rebuilt")
    print("| side | median s | lowest | highest |")
    print("|---|---|---|---|")
    for side, values in (("save to seen", seen), ("cold restart, stock, 1 env", cold)):
        print(f"| {side} | {statistics.median(values):.2f} | {min(values):.2f} | {max(values):.2f} |")
    print(f"ratio: {statistics.median(cold) / statistics.median(seen):.1f}")


if __name__ == "__main__":
    main(tyro.cli(Options))
