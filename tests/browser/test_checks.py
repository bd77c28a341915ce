"""The checks in a real Chromium: a broken save is found with file and line, and a fix clears the list."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.drive.desk import Desk
from tests.drive.page import TASK, page_on

pytestmark = [pytest.mark.browser, pytest.mark.slow]
GOOD, BAD = "(distance < GOAL_RADIUS)", "(distance < 1)"
RULE = "[data-rule=success-at-reset]"


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Desk]:
    file = Path(shutil.copy(TASK, tmp_path_factory.mktemp("author")))
    arguments = ("--num-envs", "2", "--env", "render_backend=none")
    with page_on(file, *arguments, browser=browser, checks=True) as (page, errors, opened):
        yield Desk(page, errors, file, opened)


def test_a_broken_save_is_found_with_its_line_and_a_fix_clears_the_list(desk: Desk) -> None:
    page, text = desk.page, TASK.read_text()
    line = text[: text.index(GOOD)].count("\n") + 1
    page.get_by_role("tab", name="Run").click()
    desk.edit(GOOD, BAD)
    expect(page.locator(".wb-rules-mark")).to_contain_text(re.compile(r"\d findings?"))
    desk.press("w")
    expect(page.get_by_role("tab", name=re.compile(r"^Checks \d+$"))).to_have_attribute(
        "aria-selected", "true"
    )
    card = page.locator(RULE)
    expect(card).to_contain_text(f"push_cube.py:{line}")
    expect(card).to_contain_text(f'"success": {BAD}')
    expect(card.locator(".wb-tag")).to_have_text("stop")
    link = card.locator("a.wb-at-line")
    expect(link).to_have_attribute("href", re.compile(rf"push_cube\.py:{line}$"))
    card.get_by_text("Why, fix").click()
    expect(card.locator(".wb-check-page")).to_contain_text("Why")
    # The fold stays open while results arrive.
    expect(page.get_by_text(re.compile(r"^\d+ rules checked in "))).to_be_visible(timeout=180_000)
    expect(card.locator(".wb-check-page")).to_be_visible()
    desk.file.write_text(text)
    expect(card).to_have_count(0)
