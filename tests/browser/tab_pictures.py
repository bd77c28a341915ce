"""Takes pictures of every tab of both pages and compares those of two versions.

    git worktree add /tmp/old COMMIT
    PYTHONPATH=/tmp/old .venv/bin/python /tmp/old/tests/browser/tab_pictures.py take /tmp/before
    .venv/bin/python tests/browser/tab_pictures.py take /tmp/after
    .venv/bin/python tests/browser/tab_pictures.py compare /tmp/before /tmp/after --out /tmp/differences

Run them one after the other: both show the golden task and recordings (tests/golden), in the same folder, with the same seed and steps. The
page's text is saved with each picture. Numbers that differ between runs (times, rates, memory) are replaced by dots first. The comparison prints
the share of pixels of another colour and the lines of text that were added or removed, writes pictures of both and of the differences to --out,
and exits with 1 if a picture differs by more than --share or is in one folder only.
"""

from __future__ import annotations

import argparse
import difflib
import re
import shutil
import sys
import time
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page, expect, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.drive.page import close_notice, launch, new_page, open_workbench, with_empty_settings
from workbench.machine.doctor import find_chromium, how_to_get_chromium

GOLDEN = Path(__file__).parents[1] / "golden"
PLACE = Path("/tmp/golden")
LIVE_TABS = ("Run", "Cameras", "Reward", "Inspect", "Try", "Checks")
REVIEW_TABS = ("Review", "Cameras", "Curves", "Compare", "Rescore", "Share")
STEPS = 6
WIDTH, HEIGHT = 1280, 1000
SETTLE_TIMEOUT_SECONDS = 60.0
MIN_COLOUR_DIFFERENCE = 24
"""Out of 255, in any channel; smaller differences are antialiasing."""
MAX_SHARE = 0.002
"""Fraction of a picture's pixels; two runs of one version differ by less."""
DOTS = r"""() => {
    const own = /\d+(\.\d+)?(?= ?(ms|s|MB|GB|steps? a second|Hz|fps)\b)|\d\d:\d\d(:\d\d)?/g;
    const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    for (let node; (node = walk.nextNode()); )
        if (own.test(node.nodeValue)) node.nodeValue = node.nodeValue.replace(own, "··");
}"""


def take(folder: Path) -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(PLACE, ignore_errors=True)
    for name in ("tasks", "v1"):
        shutil.copytree(GOLDEN / name, PLACE / name, ignore=shutil.ignore_patterns("__pycache__"))
    task = str(PLACE / "tasks" / "push" / "push.py")
    with sync_playwright() as playwright:
        browser = launch(playwright, chromium)
        with open_workbench(task, "--num-envs", "4", cwd=PLACE) as opened:
            page, _ = new_page(browser, WIDTH, HEIGHT)
            page.goto(opened.url)
            take_live(page, folder)
            page.close()
        with open_workbench("v1", cwd=PLACE, what="review") as opened:
            page, _ = new_page(browser, WIDTH, HEIGHT)
            page.goto(opened.url)
            take_review(page, folder)
        browser.close()


def take_live(page: Page, folder: Path) -> None:
    expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
    close_notice(page)
    for step in range(1, STEPS + 1):
        page.get_by_role("button", name="Step", exact=True).click()
        expect(page.get_by_text(re.compile(rf"\bstep {step}\b")).first).to_be_visible(timeout=60_000)
    for name in LIVE_TABS:
        tab(page, name)
        if name == "Cameras":
            page.get_by_label("Camera", exact=True).select_option(label="eye · sensor")
            expect(page.get_by_text("Show the change", exact=True)).to_be_visible()
        shoot(page, folder, f"live-{name.lower()}")


def take_review(page: Page, folder: Path) -> None:
    rows = page.locator(".wb-library").get_by_text(re.compile("/Golden"))
    # The newest recording opens, and folds the library if the width of the page is known by then.
    expect(page.get_by_text(re.compile("step 0 /")).first).to_be_visible(timeout=120_000)
    close_notice(page)
    page.wait_for_timeout(3000)
    if not rows.first.is_visible():
        page.keyboard.press("b")
    expect(rows).to_have_count(7)
    page.locator(".wb-library").get_by_text(re.compile("^tagged/")).click()
    page.keyboard.down("Control")
    page.locator(".wb-library").get_by_text(re.compile("^cameras/")).click()
    page.keyboard.up("Control")
    shoot(page, folder, "review-library")
    page.keyboard.press("Enter")
    expect(page.get_by_text(re.compile("step 0 /")).first).to_be_visible(timeout=60_000)
    page.keyboard.press("Shift+ArrowRight")
    for name in REVIEW_TABS:
        tab(page, name)
        shoot(page, folder, f"review-{name.lower()}")


def tab(page: Page, name: str) -> None:
    page.get_by_role("tab", name=name, exact=True).click()


def shoot(page: Page, folder: Path, name: str) -> None:
    """Save a picture once two in a row are equal: a software-rendering browser needs seconds for a frame."""
    page.mouse.move(2, HEIGHT - 2)  # away from anything that reacts
    before = b""
    for _ in until_timeout():
        page.evaluate(DOTS)
        picture = page.screenshot(animations="disabled", caret="hide")
        if picture == before:
            break
        before = picture
        page.wait_for_timeout(1000)
    else:
        print(f"{name} keeps changing")
    Image.open(BytesIO(before)).convert("RGB").save(folder / f"{name}.png", optimize=True)
    (folder / f"{name}.txt").write_text(page.locator("body").inner_text() + "\n")
    print(folder / f"{name}.png", flush=True)


def until_timeout() -> Iterator[None]:
    end = time.monotonic() + SETTLE_TIMEOUT_SECONDS
    while time.monotonic() < end:
        yield


def compare(old: Path, new: Path, out: Path | None, share: float) -> int:
    names = sorted({path.name for folder in (old, new) for path in folder.glob("*.png")})
    if not names:
        sys.exit(f"neither {old} nor {new} has pictures")
    failed = False
    for name in names:
        if missing := [folder for folder in (old, new) if not (folder / name).is_file()]:
            print(f"{name:28} is not in {missing[0]}")
            failed = True
            continue
        before, after = (read_picture(folder / name) for folder in (old, new))
        differs = differing_pixels(before, after)
        found = float(differs.mean())
        failed |= found > share
        print(f"{name:28} {found:8.3%}" + (f"  more than {share:.3%}" if found > share else ""))
        for line in changed_lines(*(folder / Path(name).with_suffix(".txt") for folder in (old, new))):
            print(f"    {line}")
        if out is not None and differs.any():
            out.mkdir(parents=True, exist_ok=True)
            side_by_side(before, after, differs).save(out / name)
    return int(failed)


def read_picture(path: Path) -> NDArray[np.uint8]:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def differing_pixels(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W) mask of differing pixels, of the larger size; pixels that only one picture has differ."""
    height, width = (max(before.shape[axis], after.shape[axis]) for axis in (0, 1))
    differs = np.ones((height, width), bool)
    h, w = (min(before.shape[axis], after.shape[axis]) for axis in (0, 1))
    apart = np.abs(before[:h, :w].astype(int) - after[:h, :w].astype(int)).max(axis=2)
    differs[:h, :w] = apart > MIN_COLOUR_DIFFERENCE
    return differs


def changed_lines(before: Path, after: Path) -> Iterator[str]:
    old, new = (path.read_text().splitlines() if path.is_file() else [] for path in (before, after))
    for line in difflib.unified_diff(old, new, lineterm="", n=0):
        if line.strip("+-") and not line.startswith(("---", "+++", "@@")):
            yield line


def side_by_side(
    before: NDArray[np.uint8], after: NDArray[np.uint8], differs: NDArray[np.bool_]
) -> Image.Image:
    """Before, after, and after in grey with red where they differ."""
    height, width = differs.shape
    sheet = np.zeros((height, 3 * width, 3), np.uint8)
    for place, picture in enumerate((before, after)):
        sheet[: picture.shape[0], place * width : place * width + picture.shape[1]] = picture
    grey = sheet[:, width : 2 * width].mean(axis=2, keepdims=True) * 0.5 + 100
    sheet[:, 2 * width :] = np.where(differs[..., None], (255, 0, 0), grey).astype(np.uint8)
    return Image.fromarray(sheet)


def main() -> None:
    with_empty_settings()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    taking = commands.add_parser("take", help="pictures and texts of every tab, into a folder")
    taking.add_argument(
        "folder", type=Path, help="output folder; created if missing, existing pictures are overwritten"
    )
    comparing = commands.add_parser("compare", help="two such folders")
    comparing.add_argument("old", type=Path, help="folder of the old version")
    comparing.add_argument("new", type=Path, help="folder of the new version")
    comparing.add_argument(
        "--out", type=Path, help="folder for pictures of both versions and their differences"
    )
    comparing.add_argument(
        "--share", type=float, default=MAX_SHARE, help=f"fraction of pixels that may differ ({MAX_SHARE})"
    )
    asked = parser.parse_args()
    if asked.command == "take":
        take(asked.folder)
    else:
        sys.exit(compare(asked.old, asked.new, asked.out, asked.share))


if __name__ == "__main__":
    main()
