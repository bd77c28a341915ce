"""Rescoring the past in a real Chromium: after an edit the Reward tab shows what it would have changed."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Locator, expect

from tests.browser.conftest import At
from tests.drive.desk import Desk
from tests.drive.waiting import until

pytestmark = [pytest.mark.browser, pytest.mark.slow]
REWARD = "return self.compute_dense_reward(obs, action, info) / 3"
STEPS = 60


@pytest.fixture(scope="module")
def desk(example_without_pictures: At, browser: Browser) -> Iterator[Desk]:
    """Three envs after some sixty steps, paused, on the Reward tab."""
    with example_without_pictures(browser, height=1000) as desk:
        page = desk.page
        # The server is shared: it may still have the rescored past of an edit by another file's tests.
        page.get_by_text("Reload by hand", exact=True).click()
        page.get_by_role("button", name="Rebuild the scene", exact=True).click()
        until(lambda: desk.moments_kept() <= 2, "a new past")
        page.get_by_role("button", name="Play", exact=True).click()
        until(lambda: desk.moments_kept() > STEPS, "some steps")
        page.get_by_role("button", name="Pause", exact=True).click()
        expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible()
        page.get_by_role("button", name="Reset all", exact=True).click()
        page.get_by_role("tab", name="Reward").click()
        # Before there is a result.
        expect(page.locator(".wb-again")).to_have_count(0)
        expect(page.get_by_role("button", name="Stop rescoring")).to_have_count(0)
        yield desk


def says(desk: Desk, pattern: str) -> None:
    expect(desk.page.locator(".wb-again").get_by_text(re.compile(pattern)).first).to_be_visible()


def rows(desk: Desk) -> Locator:
    return desk.page.locator(".wb-again-table tbody tr")


def test_an_edited_reward_is_drawn_over_the_recorded_one_and_differences_are_listed(desk: Desk) -> None:
    desk.edit(REWARD, f"{REWARD} * 2")
    says(desk, r"(\d+) of \1 episodes differ\.")
    says(desk, "mean return: .* → ")
    says(desk, "exactly where it was recorded")
    expect(desk.page.get_by_text("reward of env 0, before and now")).to_be_visible()
    expect(desk.page.get_by_text("rescored", exact=True)).to_be_visible()
    until(lambda: rows(desk).count() >= 6, "the list")
    expect(desk.page.get_by_role("button", name="Stop rescoring")).to_have_count(0)
    above = desk.page.get_by_role("link", name=re.compile(r"rescored: (\d+) of \1 episodes differ"))
    desk.page.set_viewport_size({"width": 1280, "height": 600})
    expect(above).to_be_in_viewport()
    expect(rows(desk).last).not_to_be_in_viewport()
    above.click()
    expect(desk.page.locator(".wb-again")).to_be_in_viewport(ratio=0.9)
    desk.page.set_viewport_size({"width": 1280, "height": 1000})


def test_a_row_shows_its_env_and_moment_and_a_key_goes_to_the_next(desk: Desk) -> None:
    desk.edit(REWARD, f"{REWARD} * 2")
    until(lambda: rows(desk).count() >= 6, "the list")
    expect(desk.page.get_by_role("button", name="Stop rescoring")).to_have_count(0)
    row = rows(desk).nth(2)
    env = row.locator("td").first.inner_text().partition(",")[0]
    row.click()
    expect(desk.page.locator(".wb-timeline").get_by_text("past", exact=True)).to_be_visible()
    expect(desk.page.get_by_role("columnheader", name=f"env {env}")).to_be_visible()
    expect(desk.page.get_by_text(f"reward of env {env}, before and now")).to_be_visible()
    expect(rows(desk).nth(2)).to_have_class("wb-selected")
    desk.page.keyboard.press("j")
    expect(rows(desk).nth(3)).to_have_class("wb-selected")
    desk.page.keyboard.press("Shift+J")
    expect(rows(desk).nth(2)).to_have_class("wb-selected")
    desk.page.keyboard.press("End")
    expect(desk.page.locator(".wb-timeline").get_by_text("live", exact=True)).to_be_visible()
    desk.select_the_first_env()
