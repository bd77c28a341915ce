"""Takes the README's screenshots: python tests/browser/take_screenshots.py [NAME ...]

Not a test. It writes ``web_assets/screenshots/*.jpg``.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from io import BytesIO
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, expect, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.drive.page import close_notice, launch, new_page, open_workbench
from workbench.machine.doctor import find_chromium, how_to_get_chromium

ROOT = Path(__file__).parents[2]
OUT = ROOT / "web_assets" / "screenshots"
TASK = ROOT / "tasks" / "push_cube.py"


def shoot(page: Page, name: str) -> None:
    if sys.argv[1:] and name not in sys.argv[1:]:
        return
    time.sleep(4.0)  # a browser that draws in software needs some seconds for a frame
    page.screenshot(path=OUT / f"{name}.jpg", type="jpeg", quality=82)
    print(OUT / f"{name}.jpg")


def tab(page: Page, name: str) -> None:
    page.get_by_role("tab", name=name).click()


def shoot_branch(page: Page) -> None:
    """The selected env goes back 30 steps and on from there; then a moment of that branch is looked at."""
    tab(page, "Run")
    page.get_by_role("button", name="Reset all", exact=True).click()
    for play in ("Play", "Pause"):
        page.get_by_role("button", name=play, exact=True).click()
        time.sleep(2.0)
    for _ in range(18):
        page.get_by_role("button", name="‹ step", exact=True).click()
    page.get_by_role("button", name=re.compile("Continue from here")).click()
    for play in ("Play", "Pause"):
        page.get_by_role("button", name=play, exact=True).click()
        time.sleep(1.0)
    tab(page, "Reward")
    for _ in range(5):
        page.get_by_role("button", name="‹ step", exact=True).click()
    shoot(page, "branch")
    page.get_by_role("button", name="live", exact=True).click()


def shoot_busy(page: Page, file: Path) -> None:
    """A loop that does not end, in the reward of a new version."""
    lines = TASK.read_text().splitlines()
    place = next(i for i, line in enumerate(lines) if line.strip().startswith("def compute_dense_reward"))
    while not lines[place].rstrip().endswith(":"):
        place += 1
    lines[place + 1 : place + 1] = ["        while self.elapsed_steps.max() >= 0:", "            continue"]
    file.write_text("\n".join(lines) + "\n")
    expect(page.get_by_role("button", name="Interrupt", exact=True)).to_be_visible(timeout=60_000)
    tab(page, "Log")
    shoot(page, "busy")


def shoot_reloads(page: Page, file: Path) -> None:
    """The Run tab's account of a patched and of a rebuilt version, side by side."""
    tab(page, "Run")
    folder = page.get_by_text("Code version", exact=True)
    good, taken = TASK.read_text(), []
    edits = [
        ("patched in", "return reward\n", "return reward + 1\n"),
        ("rebuilt in", 'name="goal")', 'name="target")'),
    ]
    for level, old, new in edits:
        file.write_text(good.replace(old, new, 1))
        expect(page.get_by_text(level).first).to_be_visible(timeout=60_000)
        folder.scroll_into_view_if_needed()
        page.get_by_role("button", name="Rebuild", exact=True).scroll_into_view_if_needed()
        time.sleep(4.0)
        box = page.locator(".wb-status").bounding_box()
        assert box is not None
        clip = {"x": box["x"] - 10, "y": 0, "width": 1280 - box["x"] + 10, "height": 720}
        taken.append(Image.open(BytesIO(page.screenshot(clip=clip))))  # type: ignore[arg-type]
    both = Image.new("RGB", (sum(image.width for image in taken), 720))
    for i, image in enumerate(taken):
        both.paste(image, (i * taken[0].width, 0))
    both.save(OUT / "reload.jpg", quality=82)
    print(OUT / "reload.jpg")
    file.write_text(good)
    time.sleep(4.0)


def shoot_envs(chromium: str) -> None:
    """The table of envs, while a policy that is careless in every fifth env plays, one of which loses a number."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "push_cube.py"
        good, lost = '"cube_height": height', "(self.elapsed_steps >= 20) & (torch.arange(len(height)) == 11)"
        file.write_text(TASK.read_text().replace(good, f"{good}.masked_fill({lost}, torch.nan)"))
        policy = f"{Path(__file__).parent / 'pusher.py'}:act"
        arguments = (str(file), "--num-envs", "16", "--env", "control_mode=pd_ee_delta_pos")
        with open_workbench(*arguments, cwd=Path(folder)) as opened, sync_playwright() as playwright:
            page, _ = new_page(launch(playwright, chromium))
            page.goto(opened.url)
            expect(page.get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
            close_notice(page)
            page.locator("input[aria-haspopup=listbox]:visible").nth(2).click()
            page.get_by_role("option", name="policy", exact=True).click()
            field = page.locator("div", has=page.get_by_text("Policy", exact=True)).last
            field.locator("xpath=../../..").locator("input").last.fill(policy)
            time.sleep(3)
            page.get_by_role("button", name="Play", exact=True).click()
            tab(page, "Reward")
            time.sleep(10)
            page.evaluate("document.activeElement.blur()")  # or the space would press what has the focus
            page.keyboard.press("Space")
            page.keyboard.press("b")
            page.keyboard.press("Shift+E")
            time.sleep(3)
            page.keyboard.press("f")
            shoot(page, "envs")


def shoot_studio(chromium: str) -> None:
    """A camera is chosen, moved with keys, and the change is shown."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(shutil.copy(TASK, Path(folder) / "push_cube.py"))
        with (
            open_workbench(str(file), "--num-envs", "4", cwd=file.parent) as opened,
            sync_playwright() as playwright,
        ):
            page, _ = new_page(launch(playwright, chromium), height=900)
            page.goto(opened.url)
            expect(page.get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
            close_notice(page)
            tab(page, "Studio")
            page.locator("input[aria-haspopup=listbox]:visible").first.click()
            page.get_by_role("option", name="base_camera · sensor", exact=True).click()
            expect(page.get_by_role("button", name="Show the change")).to_be_visible()
            page.evaluate("document.activeElement.blur()")
            for key in 12 * ["Alt+ArrowLeft"] + 12 * ["Alt+Shift+ArrowRight"]:
                page.keyboard.press(key)
                time.sleep(0.1)
            page.get_by_role("button", name="Show the change").click()
            page.get_by_role("button", name="Save to push_cube.py").scroll_into_view_if_needed()
            shoot(page, "studio")


def record(file: Path, folder: Path, *arguments: str) -> None:
    """Eight episodes of a policy that is careless in some."""
    policy = f"{Path(__file__).parent / 'pusher.py'}:act"
    command = [
        sys.executable,
        "-m",
        "workbench.cli.main",
        "record",
        str(file),
        "--actions",
        policy,
        "--out",
        str(folder),
    ]
    subprocess.run([*command, "--env", "control_mode=pd_ee_delta_pos", *arguments], check=True)


def shoot_review(chromium: str) -> None:
    """The library; one episode; and one seed under two versions of the task, over each other."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(shutil.copy(TASK, Path(folder) / "push_cube.py"))
        recordings = Path(folder) / "recordings"
        record(file, recordings, "--episodes", "8", "--num-envs", "8")
        file.write_text(TASK.read_text().replace("CUBE_HALF_SIZE = 0.02", "CUBE_HALF_SIZE = 0.025"))
        record(file, recordings, "--episodes", "2", "--num-envs", "8", "--no-pictures")
        with (
            open_workbench(str(recordings), cwd=Path(folder), what="review") as opened,
            sync_playwright() as playwright,
        ):
            page, _ = new_page(launch(playwright, chromium))
            page.goto(opened.url)
            rows = page.locator(".wb-library").get_by_text(re.compile("seed0000"))
            expect(rows).to_have_count(2, timeout=120_000)
            close_notice(page)
            rows.last.click()
            shoot(page, "library")
            page.keyboard.press("Enter")
            expect(page.get_by_text(re.compile("step 0 /")).first).to_be_visible(timeout=60_000)
            for _ in range(2):
                page.keyboard.press("Shift+ArrowRight")
                time.sleep(1.0)
            tab(page, "Cameras")
            shoot(page, "review")
            page.keyboard.press("b")
            rows.first.click()
            page.keyboard.down("Control")
            rows.last.click()
            page.keyboard.up("Control")
            page.keyboard.press("Enter")
            tab(page, "Compare")
            expect(page.get_by_text(re.compile("They diverge at"))).to_be_visible(timeout=60_000)
            page.keyboard.press("End")
            shoot(page, "compare")


def shoot_measured_camera(page: Page) -> None:
    """What a camera sees of all envs: the table, the depths, and the pictures."""
    tab(page, "Studio")
    page.locator("input[aria-haspopup=listbox]:visible").first.click()
    page.get_by_role("option", name="base_camera · sensor", exact=True).click()
    page.get_by_text("Measure", exact=True).click()
    page.get_by_role("button", name="Measure this camera").click()
    expect(page.locator(".wb-planes")).to_be_visible()
    page.get_by_role("button", name="Pictures of all envs").click()
    envs = page.locator(".wb-sheet figure")
    expect(envs).to_have_count(16)
    envs.first.click()
    page.get_by_role("button", name="Measure this camera").evaluate("e => e.scrollIntoView({block: 'start'})")
    shoot(page, "measured_camera")
    page.locator("input[aria-haspopup=listbox]:visible").first.click()
    page.get_by_role("option", name="none", exact=True).click()


def shoot_rescored(page: Page, file: Path) -> None:
    """A reward that asks for less is saved: what it says of the episodes so far, and one moment of them."""
    good = file.read_text()
    asked = "reach = 1 - torch.tanh(5 * distance)"
    assert asked in good
    tab(page, "Reward")
    file.write_text(good.replace(asked, asked.replace("5", "3")))
    expect(page.get_by_text("episodes differ.")).to_be_visible(timeout=120_000)
    rows = page.locator(".wb-again-table tbody tr")
    rows.nth(1).click()
    expect(rows.nth(1)).to_have_class("wb-selected")
    time.sleep(2.0)
    page.locator(".wb-again-more").scroll_into_view_if_needed()
    shoot(page, "rescored")
    page.get_by_role("button", name="live", exact=True).click()
    file.write_text(good)
    expect(page.get_by_text("Nothing differs").first).to_be_visible(timeout=120_000)


def main() -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    OUT.mkdir(exist_ok=True)
    shoot_envs(chromium)
    shoot_studio(chromium)
    shoot_review(chromium)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(shutil.copy(TASK, Path(folder) / "push_cube.py"))
        with (
            open_workbench(str(file), "--num-envs", "16", cwd=Path(folder)) as opened,
            sync_playwright() as playwright,
        ):
            page, _ = new_page(launch(playwright, chromium))
            page.goto(opened.url)
            expect(page.get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
            tab(page, "Cameras")
            expect(page.get_by_text("rendered in").first).to_be_visible(timeout=60_000)
            close_notice(page)
            tab(page, "Run")
            page.get_by_role("button", name="Play", exact=True).click()
            tab(page, "Reward")
            time.sleep(25)
            shoot(page, "page")
            tab(page, "Run")
            shoot(page, "run")
            page.get_by_role("button", name="Pause", exact=True).click()
            shoot_branch(page)
            shoot_rescored(page, file)
            tab(page, "Cameras")
            for tick in page.locator("input[type=checkbox]:visible").all()[1:4]:
                tick.check(force=True)
            time.sleep(4)
            shoot(page, "cameras")
            shoot_measured_camera(page)
            shoot_reloads(page, file)
            lines = TASK.read_text().splitlines()
            place = next(i for i, line in enumerate(lines) if '"cube_to_goal": distance' in line)
            lines[place] = lines[place].replace("distance", "distanec")
            file.write_text("\n".join(lines) + "\n")
            expect(page.get_by_text("NameError").first).to_be_visible(timeout=60_000)
            tab(page, "Reward")
            shoot(page, "banner")
            shoot_busy(page, file)


if __name__ == "__main__":
    main()
