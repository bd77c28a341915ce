"""How often the page is really updated while the task plays, and how soon a control has its effect.

    python tests/benchmarks/page_rate.py [--num-envs 16] [--speed "4 ×"] [--cameras] [--software]

``workbench open`` on the example task with a real Chromium before it. *Applied updates* are counted in
the page: animation frames on which the robot's hand has poses that the frame before did not have. *Click
to effect* is the time from a key or a click to the change that the person asked for in the page's text:
``Play`` becoming ``Pause``, and the S key (one control step, through the session and the worker)
changing the number of elapsed steps.

By default WebGL's draw calls are replaced by nothing, as a stand-in for a browser with a graphics card:
the server, the worker and all else in the browser are as always. ``--software`` lets Chromium rasterise
on the processor, which then is the limit on a machine without a card. Without ``--cameras`` the pictures
are unticked: on such a machine the renderer, the physics and the browser share the cores.
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
from playwright.sync_api import Page, expect, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.drive.page import launch, new_page, open_workbench
from workbench.machine.doctor import find_chromium, how_to_get_chromium

TASK = Path(__file__).parents[2] / "tasks" / "push_cube.py"
NO_DRAWING = """
for (const name of ['drawElements', 'drawArrays', 'drawElementsInstanced', 'drawArraysInstanced'])
    WebGL2RenderingContext.prototype[name] = function () {};
"""
COUNT = """async (seconds) => {
    const nodes = () => window.__viserSceneTree.getState();
    const hand = Object.keys(nodes()).find((name) => name.includes('panda_hand'));
    let last = null, applied = 0, frames = 0;
    const start = performance.now();
    await new Promise((done) => {
        const look = () => {
            frames += 1;
            const poses = nodes()[hand].message.props.batched_positions;
            if (poses !== last) { applied += 1; last = poses; }
            if (performance.now() - start < 1000 * seconds) requestAnimationFrame(look); else done();
        };
        requestAnimationFrame(look);
    });
    return [applied / seconds, frames / seconds];
}"""
ELAPSED = """() => {
    const row = [...document.querySelectorAll('tr')].find((r) => r.textContent.includes('elapsed steps'));
    return row ? row.children[1].textContent : '';
}"""


@dataclass(frozen=True)
class Options:
    num_envs: int = 16
    speed: str = "4 ×"
    seconds: float = 8.0
    clicks: int = 15
    cameras: bool = False
    """Leave the default pictures on."""
    software: bool = False
    """Let Chromium draw, on the processor."""


def prepare(page: Page, options: Options, url: str) -> None:
    if not options.software:
        page.add_init_script(NO_DRAWING)
    page.goto(url)
    expect(page.get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
    page.get_by_role("tab", name="Cameras").click()
    expect(page.get_by_text("rendered in").first).to_be_visible(timeout=60_000)
    if not options.cameras:
        for tick in page.locator("input[type=checkbox]:visible").all()[1:]:
            if tick.is_checked():
                tick.uncheck(force=True)
    page.get_by_role("tab", name="Run").click()
    page.locator('input[role="combobox"][value="1 ×"]').click()
    page.get_by_role("option", name=options.speed, exact=True).click()
    page.mouse.click(5, 690)  # keys are ignored inside an input


def play_to_pause(page: Page, clicks: int) -> list[float]:
    """Seconds from clicking Play to the button that says Pause."""
    times = []
    for _ in range(clicks):
        times.append(timed_click(page, "Play", "Pause"))
        time.sleep(0.2)
        timed_click(page, "Pause", "Play")
        time.sleep(0.2)
    return times


def timed_click(page: Page, label: str, effect: str) -> float:
    """Seconds from a click on this button to the button that it becomes."""
    # Timed inside the page, so that the way between this script and Chromium does not count.
    return page.evaluate(
        """([label, effect]) => new Promise((done) => {
            const find = (text) => [...document.querySelectorAll('button')].find((b) => b.innerText.trim() === text);
            const start = performance.now();
            find(label).click();
            const look = () => find(effect) ? done((performance.now() - start) / 1000) : setTimeout(look, 2);
            look();
        })""",
        [label, effect],
    )


def key_to_step(page: Page, presses: int) -> list[float]:
    """Seconds from the S key to another number of elapsed steps: through server, worker and back."""
    page.get_by_role("tab", name="Reward").click()
    page.mouse.click(5, 690)
    times = []
    for _ in range(presses):
        before = page.evaluate(ELAPSED)
        start = time.perf_counter()
        page.keyboard.press("s")
        page.wait_for_function(f"(before) => ({ELAPSED})() !== before", arg=before, polling=2)
        times.append(time.perf_counter() - start)
        time.sleep(0.2)
    return times


def main(options: Options) -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    with tempfile.TemporaryDirectory() as name:
        file = Path(shutil.copy(TASK, Path(name) / "push_cube.py"))
        with (
            open_workbench(str(file), "--num-envs", str(options.num_envs), cwd=Path(name)) as opened,
            sync_playwright() as playwright,
        ):
            page, _ = new_page(launch(playwright, chromium))
            prepare(page, options, opened.url)
            clicks = play_to_pause(page, options.clicks)
            steps = key_to_step(page, options.clicks)
            page.get_by_role("tab", name="Run").click()
            timed_click(page, "Play", "Pause")
            time.sleep(2.0)
            applied, frames = page.evaluate(COUNT, options.seconds)
    drawing = "Chromium draws in software" if options.software else "draw calls replaced by nothing"
    cameras = "on" if options.cameras else "off"
    print(f"push_cube.py, {options.num_envs} envs, speed {options.speed}, cameras {cameras}; {drawing}")
    print(f"applied updates a second: {applied:.1f} (animation frames a second: {frames:.1f})")
    for what, times in (("Play to Pause", clicks), ("S key to the step's numbers", steps)):
        median, worst = 1000 * statistics.median(times), 1000 * max(times)
        print(f"{what}: median {median:.0f} ms, worst {worst:.0f} ms of {len(times)}")


if __name__ == "__main__":
    main(tyro.cli(Options))
