"""Update rate of the page while the task plays, its CPU time, and the latency of controls.

    python tests/benchmarks/page_rate.py [--num-envs 16] [--speed "4 ×"] [--draw page] [--cameras] [--solve] [--orbit]

Runs ``workbench open`` on the example task in a real Chromium. *Applied updates* are counted in the page: animation
frames in which the poses of the robot's hands differ from the previous frame. *Click to effect* is the time from a
key or click to the resulting change of the page's text: ``Play`` becoming ``Pause``, and the S key (one control step,
through the session and the worker) changing the number of elapsed steps.

CPU time is printed per process: the worker (control steps and their snapshots), the server (panels, poses, viser's
encoding, the socket), the browser's page (viser's client) and its drawing. The workbench, the browser and other
processes share the cores: *others* is the CPU time of all other processes, except those in the idle class.

``--draw none``, the default, simulates a browser with a GPU: WebGL's draw calls do nothing, and the page is transparent,
so that Chromium does not composite it in software. ``--draw page`` only disables the draw calls. With ``--draw all``
Chromium rasterises everything on the CPU, which is then the limit on a machine without a GPU. ``--draw as-with-a-card``
does so too, but reports a GPU to the page, which then gets full shapes. Without ``--cameras`` the pictures are turned
off: without a GPU the renderer, the physics and the browser share the cores.

``--orbit`` measures again, paused, while the mouse turns the camera, as a person does to find a mistake. *Drawn* are the
frames of the 3-D view.

``--solve`` measures again, in the same page, while another process plans actions by rollouts. The envs then wait for
their plans, so steps and updates are rarer. The task never succeeds, because the planner would stop at a success.
"""

from __future__ import annotations

import os
import shutil
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import psutil
import tyro
from playwright.sync_api import Page, expect, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.drive.page import PRETEND_GPU_JS, TASK, launch, new_page, open_workbench, with_empty_settings
from workbench.machine.doctor import find_chromium, how_to_get_chromium

NO_DRAWING = """
for (const name of ['drawElements', 'drawArrays', 'drawElementsInstanced', 'drawArraysInstanced'])
    WebGL2RenderingContext.prototype[name] = function () {};
"""
COUNT_DRAWN = """
window.drawnFrames = 0;
const clear = WebGL2RenderingContext.prototype.clear;
WebGL2RenderingContext.prototype.clear = function (mask) {
    if (this.canvas.isConnected) window.drawnFrames += 1;
    return clear.call(this, mask);
};
"""
"""Each frame of the view begins with ``clear``."""
TRANSPARENT = "() => { document.documentElement.style.opacity = 0; }"
COUNT = """async (seconds) => {
    const nodes = () => window.__viserSceneTree.getState();
    const hand = Object.keys(nodes()).find((name) => name.includes('panda_hand'));
    let last = null, applied = 0, frames = 0;
    const drawn = window.drawnFrames;
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
    return [applied, frames, window.drawnFrames - drawn].map((count) => count / seconds);
}"""
ELAPSED = """() => {
    const row = [...document.querySelectorAll('tr')].find((r) => r.textContent.includes('elapsed steps'));
    return row ? row.children[1].textContent : '';
}"""


PACE = r"""() => {
    const found = document.body.innerText.match(/([0-9.]+) steps\/s/);
    return found ? found[1] : '';
}"""
FREE_PIXEL = 400, 420
"""A pixel (x, y) of the view that no panel covers."""
PROCESSES = ("worker", "server", "planner", "browser's page", "browser's drawing", "browser's rest")


@dataclass(frozen=True)
class Options:
    num_envs: int = 16
    speed: str = "4 ×"
    seconds: float = 6.0
    """Length of one window."""
    windows: int = 3
    clicks: int = 15
    draw: Literal["none", "page", "all", "as-with-a-card"] = "none"
    """What Chromium draws on the CPU: nothing, all but the 3-D view's triangles, or everything."""
    cameras: bool = False
    """Keep the default pictures on."""
    solve: bool = False
    """Measure again while actions are planned."""
    orbit: bool = False
    """Measure again while the camera turns around the paused scene."""


def prepare(page: Page, options: Options, url: str) -> None:
    if options.draw in ("none", "page"):
        page.add_init_script(NO_DRAWING)
    if options.draw == "as-with-a-card":
        page.add_init_script(PRETEND_GPU_JS)
    page.add_init_script(COUNT_DRAWN)
    page.goto(url)
    expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
    page.get_by_role("tab", name="Cameras").click()
    page.get_by_text("All pictures", exact=True).click()
    expect(page.get_by_text("rendered in").first).to_be_visible(timeout=60_000)
    if not options.cameras:
        for tick in page.locator("input[type=checkbox]:visible").all():
            if tick.is_checked():
                tick.uncheck(force=True)
    page.get_by_role("tab", name="Run").click()
    page.get_by_label("Speed", exact=True).select_option(label=options.speed)
    page.mouse.click(5, 690)  # keys are ignored inside an input
    if options.draw == "none":
        page.evaluate(TRANSPARENT)


def play_to_pause(page: Page, clicks: int) -> list[float]:
    """Seconds from each click on Play until the button says Pause."""
    times = []
    for _ in range(clicks):
        times.append(timed_click(page, "Play", "Pause"))
        time.sleep(0.2)
        timed_click(page, "Pause", "Play")
        time.sleep(0.2)
    return times


def timed_click(page: Page, label: str, effect: str) -> float:
    """Seconds from a click on the button `label` until there is a button `effect`."""
    # Timed inside the page, so that the latency between this script and Chromium does not count.
    return page.evaluate(
        """([label, effect]) => new Promise((done) => {
            const nameOf = (button) => button.getAttribute('aria-label') ?? button.textContent.trim();
            // Few elements: the look itself, every 2 ms, must not delay the page.
            const find = (name) => [...document.querySelectorAll('button, .wb-transport [role=button]')].find((button) => nameOf(button) === name);
            const start = performance.now();
            find(label).click();
            const look = () => find(effect) ? done((performance.now() - start) / 1000) : setTimeout(look, 2);
            look();
        })""",
        [label, effect],
    )


def key_to_step(page: Page, presses: int) -> list[float]:
    """Seconds from each press of S until the number of elapsed steps changes, through server, worker and back."""
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


@dataclass(frozen=True)
class Window:
    """Rates measured in one window, per second."""

    applied: float
    frames: float
    drawn: float
    processor: dict[str, float]
    """Cores used by each of `PROCESSES`."""
    others: float
    pace: str
    """Control steps per second, as shown on the page."""


def used(server: int) -> tuple[dict[int, tuple[str, float]], dict[int, float]]:
    """CPU seconds so far: of the workbench's and browser's processes by kind, and of all others except the idle class."""
    mine, rest = {}, {}
    family = {process.pid for process in psutil.Process().children(recursive=True)}
    for process in psutil.process_iter():
        try:
            times, command, niceness = process.cpu_times(), " ".join(process.cmdline()), process.nice()
            idle = os.sched_getscheduler(process.pid) == os.SCHED_IDLE
        except (psutil.Error, ProcessLookupError):
            continue
        seconds = times.user + times.system
        if process.pid in family:
            mine[process.pid] = name_of(process.pid == server, command, niceness), seconds
        elif process.pid != os.getpid() and not idle:
            rest[process.pid] = seconds
    return mine, rest


def name_of(is_server: bool, command: str, niceness: int) -> str:
    if is_server:
        return "server"
    if "workbench.app.worker." in command:
        # Background processes have a lower priority than the playing worker.
        return "planner" if niceness else "worker"
    drawing = "browser's drawing" if "--type=gpu-process" in command else "browser's rest"
    return "browser's page" if "--type=renderer" in command else drawing


def watch(page: Page, server: int, seconds: float, orbit: bool = False) -> Window:
    (before, rest), begun = used(server), time.perf_counter()
    counting = page.evaluate_handle(f"(seconds) => ({{ counted: ({COUNT})(seconds) }})", seconds)
    if orbit:
        turn_camera(page, seconds)
    applied, frames, drawn = counting.evaluate("({ counted }) => counted")
    (after, rest_after), took = used(server), time.perf_counter() - begun
    cores: defaultdict[str, float] = defaultdict(float)
    for pid, (name, spent) in after.items():
        cores[name] += (spent - before.get(pid, (name, 0.0))[1]) / took
    others = sum(spent - rest[pid] for pid, spent in rest_after.items() if pid in rest) / took
    return Window(applied, frames, drawn, dict(cores), others, page.evaluate(PACE))


def turn_camera(page: Page, seconds: float) -> None:
    page.mouse.move(*FREE_PIXEL)
    page.mouse.down()
    end = time.perf_counter() + seconds
    while (left := end - time.perf_counter()) > 0:
        page.mouse.move(FREE_PIXEL[0] + 60 * np.sin(2 * left), FREE_PIXEL[1] + 10 * np.cos(2 * left))
        time.sleep(1 / 60)
    page.mouse.up()


def view_report(windows: list[Window]) -> str:
    """Describe the window with the most frames of the view, and the cost per frame."""
    best = max(windows, key=lambda window: window.drawn)
    counts = ", ".join(f"{window.drawn:.1f}" for window in windows)
    drawing = ", ".join(
        f"{1000 * w.processor.get(PROCESSES[4], 0.0) / max(w.drawn, 1e-9):.0f}" for w in windows
    )
    return f"drawn frames per second: {best.drawn:.1f} (of windows: {counts}); CPU ms of drawing per frame: {drawing}"


def update_report(windows: list[Window]) -> str:
    """Describe the window with the most updates, with the counts of all windows."""
    best = max(windows, key=lambda window: window.applied)
    counts = ", ".join(f"{window.applied:.1f}" for window in windows)
    pace = f", {best.pace} control steps" if best.pace else ""
    cores = ", ".join(f"{name} {best.processor.get(name, 0.0):.2f}" for name in PROCESSES)
    an_update = 1000 / max(best.applied, 1e-9)
    stages = ", ".join(
        f"{name} {an_update * best.processor.get(name, 0.0):.1f}"
        for name in PROCESSES
        if name in best.processor
    )
    return (
        f"applied updates per second: {best.applied:.1f} (of windows: {counts}; animation frames {best.frames:.1f}{pace})\n"
        f"cores: {cores}; others {best.others:.2f}\n"
        f"CPU ms per update: {stages}"
    )


def without_success(file: Path) -> None:
    text = file.read_text()
    test = "(distance < GOAL_RADIUS)"
    if test not in text:
        sys.exit(f"{TASK} has no {test}: change `without_success`.")
    file.write_text(text.replace(test, "(distance < 0)"))


def choose_source(page: Page, wanted: str) -> None:
    page.get_by_label("Source", exact=True).select_option(label=wanted)
    page.mouse.click(5, 690)


def main(options: Options) -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    with_empty_settings()
    drawing = {
        "none": "nothing is drawn",
        "page": "draw calls do nothing",
        "all": "Chromium draws in software",
        "as-with-a-card": "Chromium draws in software, and the page is sent as with a GPU",
    }[options.draw]
    cameras = "on" if options.cameras else "off"
    print(f"push_cube.py, {options.num_envs} envs, speed {options.speed}, cameras {cameras}; {drawing}")
    with tempfile.TemporaryDirectory() as name:
        file = Path(shutil.copy(TASK, Path(name) / "push_cube.py"))
        if options.solve:
            without_success(file)
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
            server = opened.process.pid
            windows = [watch(page, server, options.seconds) for _ in range(options.windows)]
            print(f"{update_report(windows)}\n{view_report(windows)}", flush=True)
            print_clicks(clicks, steps)
            if options.orbit:
                timed_click(page, "Pause", "Play")
                time.sleep(2.0)
                windows = [watch(page, server, options.seconds, orbit=True) for _ in range(options.windows)]
                print(f"paused, while the camera turns: {view_report(windows)}", flush=True)
                timed_click(page, "Play", "Pause")
            if options.solve:
                choose_source(page, "solve")
                # Wait for the rollout envs and the first plan.
                page.wait_for_function(
                    f"() => ({PACE})() === '' && /plan/.test(document.body.innerText)", timeout=60_000
                )
                time.sleep(10.0)
                print("while actions are planned (solve):")
                print(
                    update_report([watch(page, server, options.seconds) for _ in range(options.windows)]),
                    flush=True,
                )
                print_clicks(pauses(page, options.clicks), [])


def pauses(page: Page, clicks: int) -> list[float]:
    """Like `play_to_pause`, for a page that is playing."""
    timed_click(page, "Pause", "Play")
    time.sleep(0.2)
    return play_to_pause(page, clicks)


def print_clicks(clicks: list[float], steps: list[float]) -> None:
    for what, times in (("Play to Pause", clicks), ("S key to the step's numbers", steps)):
        if times:
            median, worst = 1000 * statistics.median(times), 1000 * max(times)
            print(f"{what}: median {median:.0f} ms, worst {worst:.0f} ms of {len(times)}")


if __name__ == "__main__":
    main(tyro.cli(Options))
