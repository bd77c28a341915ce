"""The page in a real Firefox: opened, played, every tab pressed, measured and drawn."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.browser.layout import FAULTS, FIELD_FONTS, TAB_ROWS
from tests.browser.tab_pictures import LIVE_TABS
from tests.drive.firefox import Firefox, open_firefox, why_no_firefox
from tests.drive.page import TASK, open_workbench
from tests.drive.waiting import until

pytestmark = pytest.mark.slow
PICTURES = Path(__file__).parents[2] / "test-results" / "firefox"
"""A picture of each tab, for visual inspection."""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, child_process: None) -> Iterator[Firefox]:
    if why := why_no_firefox():
        pytest.skip(why)
    folder = tmp_path_factory.mktemp("author")
    task = shutil.copy(TASK, folder)
    PICTURES.mkdir(parents=True, exist_ok=True)
    with (
        open_workbench(str(task), "--num-envs", "4", "--no-spare", cwd=folder) as opened,
        open_firefox() as firefox,
    ):
        firefox.goto(opened.url)
        until(lambda: "paused" in firefox.text(), "the page", 120, firefox.text)
        close = ".mantine-Notification-closeButton"
        firefox.evaluate(f"document.querySelectorAll('{close}').forEach(e => e.click())")
        yield firefox


def test_it_plays(page: Firefox) -> None:
    page.click("[role=tab]", "Run")
    page.click("[role=button]", "Play")
    until(lambda: int(re.findall(r"env 0: step (\d+)", page.text())[0]) > 3, "steps", 120, page.text)
    page.click("[role=button]", "Pause")
    until(lambda: "paused" in page.text(), "the pause")


@pytest.mark.parametrize("tab", LIVE_TABS)
def test_each_tab_opens_and_nothing_is_cut_off_or_covered(page: Firefox, tab: str) -> None:
    page.click("[role=tab]", tab)
    active = (
        "document.querySelector('[data-dock-region=right] [role=tab][aria-selected=true]').innerText.trim()"
    )
    until(lambda: page.evaluate(active) == tab, f"the tab {tab}")
    if tab == "Cameras":
        until(
            lambda: page.evaluate("document.querySelectorAll('img[src^=\"blob:\"]').length") > 0,
            "a picture",
            120,
        )
    assert page.evaluate(f"({TAB_ROWS})()") == 1
    until(
        lambda: page.evaluate(f"({FAULTS})()") == [],
        "nothing cut or covered",
        30,
        lambda: page.evaluate(f"({FAULTS})()"),
    )
    file = PICTURES / f"{tab.lower()}.png"
    page.picture(file)
    with Image.open(file) as picture:
        assert picture.size == (1280, 720)
        view, panel = (
            np.asarray(picture.convert("L"))[50:480, 60:880],
            np.asarray(picture.convert("L"))[70:, 945:1260],
        )
    assert view.std() > 10 and panel.std() > 4, "the view and the tab are drawn"


def test_inputs_use_the_font_of_their_labels(page: Firefox) -> None:
    page.click("[role=tab]", "Run")
    fonts = page.evaluate(f"({FIELD_FONTS})()")
    assert len(fonts) > 6 and len(set(fonts)) == 1, set(fonts)


def test_the_console_shows_only_the_blocked_eval(page: Firefox) -> None:
    page.text()
    # viser's splat sorter creates functions from text on page load (browser.js); Firefox reports it anyway.
    assert [
        said for said in page.errors if not re.search("blocked a JavaScript eval|blocked by CSP", said)
    ] == []
