"""Time from saving a task file to new numbers on the screen, by reload level, against a cold restart.

    python tests/benchmarks/reload.py [--num-envs 16] [--saves 7] [--restarts 3] [--write]

Runs ``workbench open`` with the cameras on in a real Chromium. For each level the same file is saved repeatedly with
another edit, and the time runs from the end of the write until the page shows the change:

    patched     another name of an entry of ``evaluate``       the entry is in the table
    cameras     another width of the sensor camera             there is a picture of that width
    rebuilt     another colour of the cube, another entry      the entry and a new picture, with all envs rebuilt

The episode's state is the same before and after; the last column is the duration that the worker reports. The other side
is the work without a workbench: a new Python process on the same file, stock ``gym.make`` of one env, reset, first
picture. The limits are 300 ms, 600 ms and 2 s at 16 envs.
"""

from __future__ import annotations

import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from playwright.sync_api import Page, expect

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.benchmarks.table import Row, keep
from tests.drive.page import TASK, browser_at, page_on
from workbench.machine.doctor import find_chromium, how_to_get_chromium

WIDTH_PIXELS = 100
LIMIT_SECONDS = {"patched": 0.3, "cameras": 0.6, "rebuilt": 2.0}

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
    write: bool = False
    """Write rows of the table of benchmarks."""


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


def edited(level: str, number: int) -> tuple[str, str | None, bool]:
    """A version of the task, the new entry of the table, and whether the picture changes."""
    good = TASK.read_text()
    if level == "patched":
        return good.replace('"cube_to_goal"', f'"patch_{number}"'), f"patch_{number}", False
    if level == "cameras":
        size = "width=128, height=128"
        assert good.count(size) == 1
        return good.replace(size, f"width={WIDTH_PIXELS + number}, height=128"), None, True
    return version(number), f"seen_{number}", True


def save_to_seen(page: Page, file: Path, level: str, number: int) -> tuple[float, float]:
    """Seconds from the save until the page shows the change, and the milliseconds that the page reports."""
    text, entry, picture = edited(level, number)
    before = page.locator('img[src^="blob:"]').first.get_attribute("src")
    file.write_text(text)
    start = time.perf_counter()
    page.wait_for_function(
        """([entry, picture, before, width]) => {
            const image = document.querySelector('img[src^="blob:"]');
            return (!entry || document.body.textContent.includes(entry))
                && (!picture || (image && image.src && image.src !== before))
                && (!width || (image && image.naturalWidth === width));
        }""",
        arg=[entry, picture, before, WIDTH_PIXELS + number if level == "cameras" else 0],
        polling=10,
    )
    seconds = time.perf_counter() - start
    # The note is on the Run tab, which is hidden but in the document.
    note = page.locator(".wb-note", has_text=re.compile(rf"^\s*{level} in")).first.text_content() or ""
    found = re.search(rf"{level} in ([\d.]+) (m?s)", note)
    assert found is not None, note
    milliseconds = float(found[1]) * (1 if found[2] == "ms" else 1000)
    time.sleep(1.0)  # like an author's pause; later work of a reload must not slow down the next one
    return seconds, milliseconds


def workbench_side(options: Options, folder: Path, chromium: str) -> dict[str, list[tuple[float, float]]]:
    file = Path(shutil.copy(TASK, folder / "push_cube.py"))
    with (
        browser_at(chromium) as browser,
        page_on(file, "--num-envs", str(options.num_envs), browser=browser, drawn=True, spare=True) as (
            page,
            _,
            _,
        ),
    ):
        # Tabs keep their content once opened, so both the picture and the table are in the document.
        page.get_by_role("tab", name="Cameras").click()
        page.get_by_text("All pictures", exact=True).click()
        expect(page.get_by_text("rendered in").first).to_be_visible(timeout=60_000)
        page.get_by_role("tab", name="Reward").click()
        seen: dict[str, list[tuple[float, float]]] = {}
        for level in LIMIT_SECONDS:
            file.write_text(TASK.read_text())
            time.sleep(4.0)
            seen[level] = [save_to_seen(page, file, level, number) for number in range(options.saves)]
        return seen


def main(options: Options) -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seen = workbench_side(options, folder, chromium)
        cold = [cold_restart(folder / "push_cube.py") for _ in range(options.restarts)]
    print(f"push_cube.py, {options.num_envs} envs, cameras on")
    print("| save to seen | median s | lowest | highest | limit | worker, median ms |")
    print("|---|---|---|---|---|---|")
    for level, values in seen.items():
        seconds = [value[0] for value in values]
        reported = statistics.median(value[1] for value in values)
        spread = f"{min(seconds):.2f} | {max(seconds):.2f} | {LIMIT_SECONDS[level]}"
        print(f"| {level} | {statistics.median(seconds):.2f} | {spread} | {reported:.0f} |")
    if cold:
        spread = f"{min(cold):.2f} | {max(cold):.2f} | | |"
        print(f"| cold restart, stock, 1 env | {statistics.median(cold):.2f} | {spread}")
    if cold and options.write:
        keep(
            [
                Row(
                    f"Reload, {level}: from saving `push_cube.py` to the result in Chromium, {options.num_envs} envs, "
                    "against the stock script started again",
                    statistics.median(value[0] for value in seen[level]),
                    statistics.median(cold),
                    "s",
                    "less",
                    "reload.py",
                )
                for level in ("patched", "rebuilt")
            ]
        )


if __name__ == "__main__":
    main(tyro.cli(Options))
