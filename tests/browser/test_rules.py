"""A rule that only warns, in a real browser: a standing mark, its list, and the end of both when the file is mended."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.drive.page import TASK, page_on

pytestmark = pytest.mark.browser
DRAWN = "        self.drawn = torch.rand((self.num_envs, 2))\n"


def test_the_mark_stands_until_the_file_is_mended(tmp_path: Path, browser: Browser) -> None:
    text = TASK.read_text()
    def_line = next(line for line in text.splitlines() if "def _initialize_episode" in line)
    hook = text.index(def_line)
    body = text.index("        with torch.device(self.device):\n", hook)
    broken = text[:body] + DRAWN + text[body:]
    file = tmp_path / "push_cube.py"
    file.write_text(broken)
    line = broken[: broken.index(DRAWN)].count("\n") + 1
    arguments = ("--num-envs", "3", "--env", "render_backend=none")
    with page_on(file, *arguments, browser=browser) as (page, errors, opened):
        mark = page.locator(".wb-rules-mark")
        expect(mark).to_contain_text("1 warning")
        opened.wait_for_line(rf"warning .*push_cube\.py:{line}: self\.drawn is changed in envs 1, 2")
        expect(page.get_by_role("tab", name="Reward")).to_be_visible()
        mark.click()
        row = page.locator(".wb-rules-row")
        expect(row).to_contain_text(f"push_cube.py:{line}")
        expect(row).to_contain_text("self.drawn = torch.rand((self.num_envs, 2))")
        expect(page.get_by_role("tab", name="Reward")).to_be_visible()
        mark.click()
        expect(row).to_be_hidden()
        file.write_text(text)
        expect(mark).to_be_hidden()
        expect(page.get_by_text("paused", exact=True)).to_be_visible()
        assert errors == []
    assert sum("self.drawn is changed" in printed for printed in opened.lines) == 1
