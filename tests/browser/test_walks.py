"""The way of three actions through the files, traced on the real page."""

from __future__ import annotations

import pytest
from playwright.sync_api import Browser

from tests.walks import ROOT, Walked, table, walk_all

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture(scope="module")
def walks(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> list[Walked]:
    return walk_all(browser, tmp_path_factory.mktemp("walks"))


def test_no_action_passes_more_files_than_it_may(walks: list[Walked]) -> None:
    assert [(one.walk.name, len(one.files())) for one in walks if len(one.files()) > one.walk.most] == []


def test_a_step_is_one_message(walks: list[Walked]) -> None:
    (step,) = (one for one in walks if one.walk.name.startswith("Step"))
    assert step.messages == ("SingleStep",)


def test_the_page_tells_the_ways_as_they_are(walks: list[Walked]) -> None:
    page = (ROOT / "web_assets/docs/developers/architecture.md").read_text()
    for one in walks:
        assert table(one) in page, (
            f"not so in architecture.md (make it with python -m tests.walks):\n{table(one)}"
        )
