"""A side of the spawn range dragged with the real mouse in a real Chromium, and written into the author's file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.drive.desk import Desk
from tests.drive.page import page_on
from tests.drive.studio import HEIGHT, WIDTH, end_of_the_left_arrow, numbers, press
from tests.drive.waiting import until

pytestmark = [pytest.mark.browser, pytest.mark.slow]
OLD = "cube[:, :2] = (2 * torch.rand((b, 2)) - 1) * SPAWN_HALF_WIDTH"
NEW = "cube[:, :2] = torch.rand((b, 2)) * 0.2 - 0.1"


@pytest.fixture(scope="module")
def desk(task_file: Path, browser: Browser) -> Iterator[Desk]:
    text = task_file.read_text()
    assert OLD in text
    task_file.write_text(text.replace(OLD, NEW))
    with page_on(task_file, browser=browser, width=WIDTH, height=HEIGHT) as (page, errors, opened):
        yield Desk(page, errors, task_file, opened)
        assert not errors


def test_a_dragged_side_is_written_to_the_file_checked_and_reverted(desk: Desk) -> None:
    page, text = desk.page, desk.file.read_text()
    desk.select_body("cube")
    press(page, "Spawn range")
    expect(page.get_by_text("y from, to", exact=True)).to_be_visible(timeout=120_000)
    until(lambda: numbers(page, "y from, to") == [-0.1, 0.1], "the range in the file")
    until(lambda: end_of_the_left_arrow(page) is not None, "the handles")
    x, y = end_of_the_left_arrow(page) or (0, 0)
    page.mouse.move(x, y)
    page.mouse.down()
    for i in range(1, 5):
        page.mouse.move(x + 8 * i, y)
    # While the mouse button is still down.
    until(lambda: numbers(page, "y from, to")[1] > 0.12, "the number")
    page.mouse.up()
    assert numbers(page, "x from, to") == [-0.1, 0.1] and numbers(page, "y from, to")[0] == -0.1
    press(page, "Write the range into the file")
    save = page.get_by_text(re.compile("^Save to"))
    expect(save).to_be_visible(timeout=120_000)
    assert desk.file.read_text() == text, "nothing is written yet"
    far = numbers(page, "y from, to")[1]
    save.click()
    expect(page.get_by_text(re.compile("written and verified"))).to_be_visible(timeout=120_000)
    written = re.search(
        r"torch.rand\(\(b, 2\)\) \* torch.tensor\(\[0.2, ([\d.]+)\]\) - 0.1", desk.file.read_text()
    )
    assert written is not None, desk.file.read_text()
    assert float(written[1]) == pytest.approx(far + 0.1, abs=1e-4)
    press(page, "Revert in the file")
    until(lambda: desk.file.read_text() == text, "the old text")
