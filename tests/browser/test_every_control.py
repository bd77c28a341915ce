"""Every part of the page that looks pressable does something when pressed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from tests.drive.page import TASK, close_notice, new_page, open_tab, open_workbench
from tests.drive.waiting import until

pytestmark = [pytest.mark.browser, pytest.mark.slow]
COUNTED = """
window.asked = 0;
const post = Worker.prototype.postMessage;
Worker.prototype.postMessage = function (message, ...rest) {
    // Not what viser sends by itself: where it looks from.
    if (message?.type === "send" && /Gui|Command/.test(message.message?.type)) window.asked += 1;
    return post.call(this, message, ...rest);
};
const send = WebSocket.prototype.send;
WebSocket.prototype.send = function (text) {
    if (typeof text === "string") window.asked += 1;
    return send.call(this, text);
};
navigator.clipboard.writeText = async () => { window.asked += 1; };
"""
LEAVES = "show_recordings", "show_live", "continue_live", "toggle_timeline", "open_task_list"
"""Commands that show another page or a dialog, or fold the timeline; their parts are not pressed."""
PRESSED = "[data-do]" + "".join(f":not([data-do*={name}])" for name in LEAVES) + ", [data-copy]"
MAX_PRESSES = 150
TRIES = 5
LIVE = ("Run", "Cameras", "Reward", "Inspect", "Try", "Checks", "Episodes", "Envs", "Log", "Timeline")
REVIEW = ("Review", "Cameras", "Share")


@dataclass
class Board:
    page: Page
    pressed: set[str]

    def unfold_all(self) -> None:
        """Open every fold, also those in other folds."""
        folded = self.page.locator("[data-fold][aria-expanded=false]")
        for _ in range(MAX_PRESSES):
            here = [heading for heading in folded.all() if heading.is_visible()]
            if not here:
                return
            here[0].click()
            self.page.wait_for_timeout(300)
        raise AssertionError("there are always more folds to open")

    def next_part(self) -> tuple[str, Locator] | None:
        """A visible part that was not pressed yet."""
        parts = self.page.locator(PRESSED)
        # In one script: a question for each part at each press took most of the test's time. A part that copies or that is
        # dragged counts once: joint positions and the number of steps change, and it would count as many.
        keys = parts.evaluate_all(
            """parts => parts.map(p => !p.checkVisibility({ visibilityProperty: true }) || !p.getClientRects().length ? ""
                : "copy" in p.dataset ? "copies " + p.dataset.copy.split(/[-\\d.]/)[0]
                : "along" in p.dataset ? JSON.parse(p.dataset.do)[0] + " along"
                : Object.entries(p.dataset).map(String).join() + p.textContent.slice(0, 20))"""
        )
        for at, key in enumerate(keys):
            if key and key not in self.pressed:
                self.pressed.add(key)
                return key, parts.nth(at)
        return None

    def close_dialog(self) -> None:
        dialog = self.page.locator(".mantine-Modal-overlay")
        if dialog.count():
            self.page.keyboard.press("Escape")
            expect(dialog).to_have_count(0)

    def press(self, part: Locator) -> bool:
        """Press the part; return whether a command was sent or a text copied."""
        self.close_dialog()
        before = self.page.evaluate("asked")
        # The elements that there are now: a locator would wait for a part that a redraw has just removed.
        elements = part.element_handles()
        if not elements or not elements[0].is_visible():
            return False
        # Playwright's own click would wait for the picture to be stable, and it is redrawn all the time.
        elements[0].evaluate("p => p.scrollIntoView({block: 'center'})")
        box = elements[0].bounding_box()
        if box is None:
            return False
        self.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + min(box["height"] / 2, 10))
        # A dragged part sends nothing until the command before it is answered: a rebuild of the envs takes seconds.
        for _ in range(40):
            self.page.wait_for_timeout(50)
            if self.page.evaluate("asked") > before:
                return True
        return False

    def press_all(self, where: str) -> list[str]:
        """Press every part; return the texts of those that did nothing."""
        dead: list[str] = []
        for _ in range(MAX_PRESSES):
            found = self.next_part()
            if found is None:
                return dead
            key, part = found
            # Try again: a part that is redrawn at that moment moves away from under the mouse.
            if not any(self.press(part) or not part.is_visible() for _ in range(TRIES)):
                dead.append(f"{where}: {key[:90]}")
            self.close_dialog()
        raise AssertionError(f"{where} there are always more parts to press")


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Board]:
    folder = tmp_path_factory.mktemp("author")
    file = Path(folder / TASK.name)
    file.write_text(TASK.read_text())
    given = (str(file), "--num-envs", "2", "--env", "control_mode=pd_joint_pos", "--no-spare")
    with open_workbench(*given, cwd=folder) as opened:
        page, errors = new_page(browser, 1280, 1400, drawn=False)
        page.add_init_script(COUNTED)
        page.goto(opened.url)
        expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
        close_notice(page)
        yield Board(page, set())
        assert not errors
        page.close()


def test_the_envs_are_rebuilt_with_the_tasks_own_options(board: Board) -> None:
    page = board.page
    status = page.locator(".wb-status")
    expect(status).to_contain_text("pd_joint_pos")
    page.locator("[data-fold='How the envs are made']").click()
    page.locator(".wb-env-options [data-do]").click()
    expect(status).to_contain_text("pd_joint_delta_pos")


def test_every_part_of_the_live_page_does_something(board: Board) -> None:
    page = board.page
    page.keyboard.press("Shift+C")
    for _ in range(2):
        page.keyboard.press("s")
    expect(page.locator(".wb-timeline")).to_contain_text("step 2 ")
    dead: list[str] = []
    for tab in LIVE:
        open_tab(page, tab)
        board.unfold_all()
        dead += board.press_all(tab)
    assert len(board.pressed) > 30 and dead == []


def test_every_part_of_the_review_does_something(board: Board) -> None:
    page = board.page
    page.keyboard.press("v")
    rows = page.locator(".wb-library [data-row]")
    until(lambda: rows.count() > 0, "a recording")
    rows.first.click()
    page.keyboard.press("Enter")
    expect(page.locator(".wb-facts")).to_be_visible()
    before, dead = len(board.pressed), board.press_all("Library")
    for tab in page.get_by_role("tab").all_inner_texts():
        if re.sub(r" \d+$", "", tab) in REVIEW:
            open_tab(page, tab)
            dead += board.press_all(tab)
    assert len(board.pressed) > before + 5 and dead == []
