"""The table of envs and the inspectors in a real Chromium, used as by a user."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.drive.page import open_tab, page_on
from tests.drive.waiting import until

pytestmark = [pytest.mark.browser, pytest.mark.slow]
ENVS = 6


@pytest.fixture(scope="module")
def page(task_file: Path, browser: Browser) -> Iterator[Page]:
    # From its fifth step env 4 reports NaN for `height`, which nothing else in the task uses.
    good, lost = '"cube_height": height', "(self.elapsed_steps >= 5) & (torch.arange(len(height)) == 4)"
    text = task_file.read_text()
    assert text.count(good) == 1
    task_file.write_text(text.replace(good, f"{good}.masked_fill({lost}, torch.nan)"))
    # Without pictures there are no shaders to compile.
    arguments = ("--num-envs", str(ENVS), "--env", "render_backend=none")
    with page_on(task_file, *arguments, browser=browser) as (page, errors, _):
        open_tab(page, "Inspect")
        expect(page.get_by_role("cell", name="panda_joint7", exact=True)).to_be_visible()
        until(lambda: envs(page) == list(range(ENVS)), "the rows")
        open_tab(page, "Run")
        page.get_by_role("button", name="Play", exact=True).click()
        until(lambda: int(cell(page, 0, 2)) > 6, "steps in the table")
        page.get_by_role("button", name="Pause", exact=True).click()
        expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible()
        yield page
        assert not errors


def press(page: Page, selector: str) -> None:
    """Click at the element's current place: while envs play, the rows are replaced all the time."""
    at = page.evaluate(
        """s => {
            const element = document.querySelector(s);
            element.scrollIntoView({block: 'nearest'});
            const r = element.getBoundingClientRect();
            return [r.x + 8, r.y + r.height / 2];
        }""",
        selector,
    )
    page.mouse.click(*at)


def envs(page: Page) -> list[int]:
    return page.evaluate(
        "() => [...document.querySelectorAll('tr[data-env]')].map(r => Number(r.dataset.env))"
    )


def selected(page: Page) -> list[int]:
    return page.evaluate(
        "() => [...document.querySelectorAll('tr[data-env].wb-selected')].map(r => Number(r.dataset.env))"
    )


def cell(page: Page, env: int, column: int) -> str:
    return page.evaluate(
        "([e, c]) => document.querySelector(`tr[data-env='${e}']`).cells[c].innerText", [env, column]
    )


def test_a_press_on_a_row_selects_its_env_also_while_playing(page: Page) -> None:
    open_tab(page, "Run")
    page.get_by_role("button", name="Play", exact=True).click()
    for env in (3, 1, 5):
        press(page, f"tr[data-env='{env}']")
        until(lambda env=env: selected(page) == [env], f"env {env} selected")
    expect(page.get_by_text(re.compile(r"^env 5: step")).first).to_be_visible()
    page.get_by_role("button", name="Pause", exact=True).click()


def test_an_outlier_env_is_flagged_with_its_reason_and_found_by_the_filter(page: Page) -> None:
    until(lambda: page.locator("tr[data-why='4']").count() == 1, "the flag")
    filtered = page.get_by_label("Show", exact=True).first
    filtered.select_option(label="flagged")
    until(lambda: envs(page) == [4], "the filter")
    assert "cube_height is NaN (" in page.locator("tr[data-why='4']").inner_text()
    filtered.select_option(label="all envs")
    until(lambda: len(envs(page)) == ENVS, "all rows again")
    page.keyboard.press("Shift+E")
    until(lambda: selected(page) == [4], "the flagged env selected by its key")
    press(page, "tr[data-env='0']")
    until(lambda: selected(page) == [0], "another env")
    mark = page.locator(".wb-marks .wb-sight-flagged")
    assert "cube_height is NaN" in f"{mark.inner_text()} {mark.get_attribute('title')}"
    press(page, ".wb-marks .wb-sight-flagged")
    until(lambda: selected(page) == [4], "the flagged env selected by the mark above the tabs")


def test_a_pose_is_copied(page: Page) -> None:
    open_tab(page, "Inspect")
    page.get_by_label("Show", exact=True).locator("visible=true").last.select_option(label="bodies")
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    expect(page.locator(".wb-leaves").get_by_text("cube", exact=True)).to_be_visible()
    page.locator(".wb-leaves tr", has=page.get_by_text("cube", exact=True)).locator(".wb-pill").click()
    until(lambda: page.evaluate("navigator.clipboard.readText()").startswith("sapien.Pose(p=["), "the copy")


def columns(page: Page) -> list[str]:
    """The visible columns."""
    return page.evaluate(
        "() => [...document.querySelector('.wb-env-table').tHead.rows[0].cells].filter(c => c.offsetWidth).map(c => c.textContent.trim())"
    )


def overhang(page: Page) -> float:
    """Pixels by which the table is wider than its panel."""
    return page.evaluate(
        "() => { const table = document.querySelector('.wb-env-table'); return table.getBoundingClientRect().right - table.closest('.wb-envs').getBoundingClientRect().right }"
    )


def test_the_view_keeps_half_of_the_page_and_omitted_columns_are_named(page: Page) -> None:
    view = page.evaluate("() => document.querySelector('canvas[data-engine]').getBoundingClientRect().width")
    assert view >= 1280 / 2 - 10
    assert overhang(page) < 1
    note = page.get_by_text(re.compile(r"^\d hidden$")).locator("visible=true")
    before = columns(page)
    (count,) = (int(text.split()[0]) for text in note.all_inner_texts())
    named = note.get_attribute("title") or ""
    assert not [name for name in before if f" {name}," in named]
    edge = page.locator('[data-dock-region-resize="left"] > *').first.bounding_box()
    assert edge is not None
    page.mouse.move(edge["x"] + edge["width"] / 2, 400)
    page.mouse.down()
    page.mouse.move(edge["x"] + 300, 400, steps=5)
    page.mouse.up()
    expect(note).to_have_count(0)
    assert len(columns(page)) == len(before) + count
    assert overhang(page) < 1
