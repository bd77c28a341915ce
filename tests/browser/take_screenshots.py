"""Takes the README's screenshots anew, from the running page: python tests/browser/take_screenshots.py

Not a test: pictures are looked at by people. It writes ``web_assets/screenshots/*.jpg``.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from pathlib import Path

from playwright.sync_api import Page, expect, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.browser.opened import launch, new_page, open_workbench
from workbench.machine.chromium import find_chromium, how_to_get_chromium

ROOT = Path(__file__).parents[2]
OUT = ROOT / "web_assets" / "screenshots"
TASK = ROOT / "tasks" / "push_cube.py"


def shoot(page: Page, name: str) -> None:
    time.sleep(4.0)  # a browser that draws in software needs some seconds for a frame
    page.screenshot(path=OUT / f"{name}.jpg", type="jpeg", quality=82)
    print(OUT / f"{name}.jpg")


def tab(page: Page, name: str) -> None:
    page.get_by_role("tab", name=name).click()


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


def close_notice(page: Page) -> None:
    notice = page.locator(".mantine-Notification-closeButton")
    if notice.count():
        notice.first.click()


def main() -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    OUT.mkdir(exist_ok=True)
    shoot_envs(chromium)
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
            tab(page, "Cameras")
            for tick in page.locator("input[type=checkbox]:visible").all()[1:4]:
                tick.check(force=True)
            time.sleep(4)
            shoot(page, "cameras")
            lines = TASK.read_text().splitlines()
            place = next(i for i, line in enumerate(lines) if '"cube_to_goal": distance' in line)
            lines[place] = lines[place].replace("distance", "distanec")
            file.write_text("\n".join(lines) + "\n")
            expect(page.get_by_text("NameError").first).to_be_visible(timeout=60_000)
            tab(page, "Reward")
            shoot(page, "banner")


if __name__ == "__main__":
    main()
