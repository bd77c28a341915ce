"""Counts the files that three actions pass, by running them on the page with a tracer in every process.

    python -m tests.walks          # prints the tables of web_assets/docs/developers/architecture.md

A file is on the way if one of its functions is on the stack where the action is handed on: to another process, to the
author's code or ManiSkill, to the state of the session, to the browser, to the disk. A function that is called on the way and has
returned by then is not counted, nor is a file that only starts a process or a thread (`STARTS`).
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = f"{ROOT / 'workbench'}{os.sep}"
FOLDER, FILE = "WORKBENCH_WALKS", "WORKBENCH_WALKS_FILE"
"""Variables: the folder in which each process writes its hand-overs, and the author's file."""
STARTS = frozenset({"session/worker/start.py", "machine/processes/watched_thread.py"})
POINTS = {
    "send": ("session/process/worker_process.py", "machine/processes/wire.py"),
    "_handle": ("session/live/session.py",),
    "step": ("mani_skill/envs/sapien_env.py",),
    "loaded": ("session/live/live_state.py",),
    "add": ("session/history/history.py",),
    "queue_message": ("viser/infra/_infra.py",),
}
"""Functions that hand on, and how their files' paths end."""


@dataclass(frozen=True)
class HandOver:
    """One hand-over of one process."""

    at: float
    """`time.monotonic`, which all processes share."""
    what: str
    """The function, and the type of its argument (``send Load``); ``author evaluate``; ``disk``."""
    files: tuple[str, ...]
    """Of the package, outermost first."""


def trace(out: Path, authors: str) -> None:
    """Write the hand-overs of this process, of this thread and all that start from now on, as lines to a file."""

    def called(frame: FrameType, event: str, argument: Any) -> None:
        if event != "call":
            return
        code = frame.f_code
        if code.co_filename == authors:
            note(frame, f"author {code.co_name}")
        elif (ends := POINTS.get(code.co_name)) and code.co_filename.endswith(ends):
            given = frame.f_locals.get(code.co_varnames[1]) if code.co_argcount > 1 else None
            note(frame, f"{code.co_name} {type(given).__name__}")

    def note(frame: FrameType | None, what: str) -> None:
        files: list[str] = []
        while frame is not None:
            name = frame.f_code.co_filename
            if name.startswith(PACKAGE):
                files.append(name.removeprefix(PACKAGE))
            frame = frame.f_back
        line = json.dumps([time.monotonic(), what, list(dict.fromkeys(reversed(files)))])
        with out.open("a") as stream:
            stream.write(line + "\n")

    def audited(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "os.rename" and str(arguments[1]) == authors:
            note(sys._getframe(1), "disk")

    sys.addaudithook(audited)
    threading.setprofile(called)
    sys.setprofile(called)


SITE = f"""\
import os, sys
sys.path.append({str(ROOT)!r})
from pathlib import Path
from tests.walks import FILE, FOLDER, trace
trace(Path(os.environ[FOLDER]) / f"{{os.getpid()}}.txt", os.environ[FILE])
"""
"""A ``sitecustomize.py``: every Python process of the page begins with it."""


@dataclass(frozen=True)
class Point:
    """One hand-over of a walk."""

    says: str
    what: str
    """How `HandOver.what` begins."""
    through: tuple[str, ...] = ()
    """Files that must be on the stack."""


@dataclass(frozen=True)
class Walk:
    """One action, and what belongs to its way."""

    name: str
    most: int
    """Files that it may pass."""
    points: tuple[Point, ...]
    """In their order."""


WIRE, LOOP = ("machine/processes/wire.py",), ("session/worker/loop.py",)
HOOKS = ("authoring/camera_source/run_hooks.py",)
WALKS = (
    Walk(
        "Save → new numbers",
        20,
        (
            Point(
                "The watcher sees the save; the server asks for a load",
                "send Load",
                ("authoring/loading/watch.py",),
            ),
            Point("The request goes to the worker", "send Load", WIRE),
            Point("The worker imports the author's file", "author <module>", LOOP),
            Point(
                "and asks the changed task for its numbers", "author compute_normalized_dense_reward", LOOP
            ),
            Point("They go to the server", "send Loaded", WIRE),
            Point("The session takes them", "loaded Loaded"),
            Point("The Reward panel is drawn", "queue_message GuiUpdateMessage", ("ui/live/reward.py",)),
        ),
    ),
    Walk(
        "Step → view",
        15,
        (
            Point("The button asks the session for a step", "send SingleStep", ("ui/live/run_panel.py",)),
            Point("The request goes to the worker", "send SingleStep", WIRE),
            Point("The worker calls ManiSkill's `step`", "step ", LOOP),
            Point("The new moment goes to the server", "send Stepped", WIRE),
            Point("It becomes the last of the history", "add Stepped"),
            Point(
                "The bodies are moved in the 3-D view",
                "queue_message SceneNodeUpdateMessage",
                ("ui/scene/bodies.py",),
            ),
        ),
    ),
    Walk(
        "Gizmo → picture → written",
        35,
        (
            Point("The gizmo is dragged: the camera is placed", "send PlaceCamera", ("ui/cameras/gizmo.py",)),
            Point("The request goes to the worker", "send PlaceCamera", WIRE),
            Point("It places the camera and sends its picture", "send Pictures", WIRE),
            Point("The session takes it", "_handle Pictures"),
            Point(
                "The picture is shown",
                "queue_message GuiUpdateMessage",
                ("ui/cameras/studio.py", "ui/cameras/panel.py"),
            ),
            Point(
                "*Show the change* plans an edit, and asks what the file's hooks give",
                "send Call",
                ("authoring/camera_source/plan.py",),
            ),
            Point("The worker calls the author's hook", "author _default_sensor_configs", HOOKS),
            Point("and reads the values of its text", "author <module>", HOOKS),
            Point("The answer comes back", "send Answer", WIRE),
            Point("The change is shown", "queue_message GuiUpdateMessage", ("ui/cameras/write_to_file.py",)),
            Point("*Write* replaces the file", "disk"),
        ),
    ),
)


@dataclass(frozen=True)
class Walked:
    walk: Walk
    stacks: tuple[tuple[str, ...], ...]
    """The files at each of the walk's points, outermost first."""
    messages: tuple[str, ...]
    """Types of what was sent to the worker meanwhile, without what no one waits for."""

    def files(self) -> list[str]:
        """Each once, in the order in which they are passed."""
        return list(dict.fromkeys(file for stack in self.stacks for file in stack if file not in STARTS))


def walked(walk: Walk, found: Sequence[HandOver]) -> Walked:
    """
    Args:
        found: The hand-overs since the action began.

    Raises:
        LookupError: A point of the walk was not passed, or not in its order.
    """
    stacks: list[tuple[str, ...]] = []
    rest = iter(found)
    for point in walk.points:
        for one in rest:
            if one.what.startswith(point.what) and set(point.through) <= set(one.files):
                stacks.append(one.files)
                break
        else:
            raise LookupError(f"{point} was not seen")
    sent = (one.what.split()[1] for one in found if one.files[-1:] == ("session/process/worker_process.py",))
    return Walked(walk, tuple(stacks), tuple(sent))


def hand_overs(folder: Path, since: float) -> list[HandOver]:
    """Of all processes from a moment on, in their order."""
    found: list[HandOver] = []
    for file in folder.glob("*.txt"):
        lines = file.read_text().split("\n")[:-1]  # the last one may be half written
        found += [
            HandOver(at, what, tuple(files)) for at, what, files in map(json.loads, lines) if at >= since
        ]
    return sorted(found, key=lambda one: one.at)


@contextmanager
def traced_page(
    browser: Browser, folder: Path
) -> Iterator[tuple[Page, Path, Callable[[float], list[HandOver]]]]:
    """A page on a copy of the example task, with two envs; that copy; and what was handed over since a moment."""
    from playwright.sync_api import expect

    from tests.drive.page import TASK, open_workbench, page_at
    from tests.drive.studio import HEIGHT, WIDTH

    site, out = folder / "site", folder / "out"
    site.mkdir()
    out.mkdir()
    (site / "sitecustomize.py").write_text(SITE)
    file = Path(shutil.copy(TASK, folder))
    env = {FOLDER: str(out), FILE: str(file), "PYTHONPATH": str(site)}
    with (
        open_workbench(str(file), "--num-envs", "2", "--no-spare", cwd=folder, env=env) as opened,
        page_at(browser, opened.url, WIDTH, HEIGHT) as (page, _),
    ):
        expect(page.get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
        yield page, file, lambda since: hand_overs(out, since)


def walk_all(browser: Browser, folder: Path) -> list[Walked]:
    """Run the three actions on one page."""
    from playwright.sync_api import expect

    from tests.drive.studio import choose, end_of_the_left_arrow, numbers, picture
    from tests.drive.waiting import until

    with traced_page(browser, folder) as (page, file, since):

        def watch(walk: Walk, act: Callable[[], None]) -> Walked:
            began = time.monotonic()
            act()
            last: list[str] = []

            def complete() -> Walked | None:
                try:
                    return walked(walk, since(began))
                except LookupError as error:
                    last[:] = [str(error)]
                    return None

            return until(complete, walk.name, seen=lambda: last)

        def save() -> None:
            file.write_text(file.read_text().replace("return reward", "return 2 * reward", 1))

        def drag() -> None:
            at = until(lambda: end_of_the_left_arrow(page), "the gizmo")
            before = until(lambda: picture(page), "the picture")
            page.mouse.move(*at)
            page.mouse.down()
            page.mouse.move(at[0] + 20, at[1], steps=4)
            until(lambda: picture(page) not in ("", before), "another picture")
            page.mouse.up()
            until(lambda: numbers(page, "Position")[1] == numbers(page, "Looks at")[1], "both numbers")
            page.get_by_role("button", name="Show the change").click()
            expect(page.locator(".wb-diff-add")).to_contain_text("look_at(")
            page.get_by_role("button", name="Save to push_cube.py").click()

        saving, stepping, placing = WALKS
        page.get_by_role("tab", name="Reward").click()
        walks = [watch(saving, save)]
        page.get_by_role("tab", name="Run").click()
        walks.append(watch(stepping, page.get_by_role("button", name="Step", exact=True).click))
        page.get_by_role("tab", name="Studio").click()
        choose(page, "base_camera · sensor")
        walks.append(watch(placing, drag))
        return walks


def table(one: Walked) -> str:
    """The walk as the page has it."""
    lines = [f"### {one.walk.name}: {len(one.files())} files", ""]
    lines += ["| what happens | files that it passes first there |", "| --- | --- |"]
    passed: set[str] = set()
    for point, stack in zip(one.walk.points, one.stacks, strict=True):
        files = [f"`{file}`" for file in stack if file not in STARTS | passed]
        passed.update(stack)
        lines.append(f"| {point.says} | {', '.join(files)} |")
    return "\n".join(lines)


def main() -> None:
    import tempfile

    from tests.drive.page import browser_at
    from workbench.machine.doctor import find_chromium, how_to_get_chromium

    chromium = find_chromium()
    if chromium is None:
        raise SystemExit(how_to_get_chromium())
    with browser_at(str(chromium)) as browser, tempfile.TemporaryDirectory() as folder:
        for one in walk_all(browser, Path(folder)):
            print(table(one), end="\n\n")
            print("sent to the worker:", *one.messages, end="\n\n", file=sys.stderr)


if __name__ == "__main__":
    main()
