"""Folds and the palette, operated with the keyboard only."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.browser.conftest import At

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def choose(page: Page, words: str) -> None:
    """Type words into the palette and press Enter once its first command contains them all."""
    page.keyboard.press("Control+k")
    expect(page.get_by_placeholder("Search commands...")).to_be_focused()
    page.keyboard.type(words)
    expect(page.locator(".mantine-Spotlight-action").first).to_contain_text(
        re.compile(re.escape(words), re.I)
    )
    page.keyboard.press("Enter")
    expect(page.locator(".mantine-Spotlight-content")).to_be_hidden()


def test_every_fold_is_reached_by_tab_and_toggled_by_enter_and_space(example: At, browser: Browser) -> None:
    with example(browser) as desk:
        page = desk.page
        for tab in ("Run", "Try"):
            desk.tab(tab)
            folded = page.locator("div[role=button][aria-expanded=false]:has(> svg)").filter(
                has_text=re.compile("."), visible=True
            )
            expect(folded.first).to_be_visible()
            for label in folded.all_inner_texts():
                heading = page.get_by_role("button", name=label, exact=True)
                for _ in range(150):
                    page.keyboard.press("Tab")
                    if heading.evaluate("one => one === document.activeElement"):
                        break
                expect(heading).to_be_focused()
                page.keyboard.press("Enter")
                expect(heading).to_have_attribute("aria-expanded", "true")
                page.keyboard.press("Space")
                expect(heading).to_have_attribute("aria-expanded", "false")
                expect(heading).to_be_focused()
        expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible()
        # The page is redrawn with the fold open: the focus stays.
        choose(page, "how the envs are made")
        heading = page.get_by_role("button", name="How the envs are made")
        expect(heading).to_be_focused()
        desk.switch_to("review")
        expect(page.get_by_role("tab", name="Library")).to_be_visible()
        desk.switch_to("live")
        expect(page.get_by_role("button", name="How the envs are made")).to_be_visible()
        assert desk.errors == []


def test_the_palette_finds_places_envs_cameras_and_control_modes(example: At, browser: Browser) -> None:
    with example(browser) as desk:
        page = desk.page
        choose(page, "reward tab")
        expect(page.get_by_role("tab", name="Reward")).to_have_attribute("aria-selected", "true")
        choose(page, "solve many seeds")
        fold = page.get_by_role("button", name="Solve many seeds")
        expect(fold).to_have_attribute("aria-expanded", "true")
        expect(fold).to_be_in_viewport()
        expect(fold).to_be_focused()
        choose(page, "env 1")
        desk.timeline_says("env 1")
        choose(page, "base_camera")
        expect(page.get_by_role("tab", name="Cameras")).to_have_attribute("aria-selected", "true")
        expect(page.get_by_role("combobox", name="Camera")).to_have_value(re.compile("base_camera"))
        choose(page, "pd_ee_delta_pose")
        status = page.locator(".wb-status")
        expect(status).to_contain_text("pd_ee_delta_pose")
        choose(page, "pd_joint_delta_pos")
        expect(status).to_contain_text("pd_joint_delta_pos")
        # The search also finds keys by their usual names.
        page.keyboard.press("Control+k")
        expect(page.get_by_placeholder("Search commands...")).to_be_focused()
        page.keyboard.type("left arrow")
        first = page.locator(".mantine-Spotlight-action").first
        expect(first).to_contain_text("One step back")
        expect(first).to_contain_text("Left arrow")
        expect(page.locator(".mantine-Spotlight-actionsList")).not_to_contain_text("arrowleft")
        page.keyboard.press("Escape")
        expect(page.get_by_placeholder("Search commands...")).to_have_count(0)
        assert desk.errors == []
