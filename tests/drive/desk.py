"""What a user has open: the page, the task file, the terminal."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from playwright.sync_api import FloatRect, Locator, Page, expect

from tests.drive.page import TASK, Opened, open_tab
from tests.drive.waiting import until


@dataclass
class Desk:
    page: Page
    errors: list[str]
    """Errors on the page so far."""
    file: Path
    opened: Opened

    def tab(self, name: str) -> None:
        open_tab(self.page, name)

    def pause(self) -> None:
        """Pause, also if the page has not drawn yet that the run is paused: a click would wait for *Pause* then."""
        self.page.evaluate("wb.ask(['pause_run', {}])")
        expect(self.button("Play")).to_be_visible()

    def button(self, name: str) -> Locator:
        return self.page.get_by_role("button", name=name, exact=True)

    def press(self, *keys: str) -> None:
        for key in keys:
            self.page.keyboard.press(key)

    def switch_to(self, page: Literal["live", "review"]) -> None:
        """Show the other page by its key, and wait until keys work there: a page gets them last."""
        self.press("v")
        expect(self.page.locator(f'.wb-all-keys[data-contexts~="{page}"]')).to_be_attached()

    def leave_inputs(self) -> None:
        """Blur the focused input, so that no slider takes the keys. A click on the view could select an env instead."""
        self.page.evaluate("document.activeElement?.blur()")

    def edit(self, old: str, new: str) -> None:
        """Write the example's text into the file, with `old` replaced by `new`."""
        text = TASK.read_text()
        assert old in text
        self.file.write_text(text.replace(old, new))

    def row(self, name: str) -> list[str]:
        """The cells of a row of the numbers table on the Reward tab."""
        row = self.page.locator(
            ".wb-numbers:not(.wb-env-table) tr", has=self.page.get_by_text(name, exact=True)
        )
        return [cell.strip() for cell in row.first.locator("td, th").all_inner_texts()]

    def elapsed(self) -> int:
        """Elapsed steps of the selected env, as the Reward tab shows them."""
        return int(self.row("elapsed steps")[1].split("/")[0])

    def comes_to(self, steps: int) -> None:
        until(lambda: self.elapsed() == steps, f"step {steps}", seen=self.elapsed)

    def timeline_says(self, text: str) -> None:
        expect(self.page.locator(".wb-timeline").get_by_text(re.compile(text)).first).to_be_visible()

    def select_the_first_env(self) -> None:
        timeline = self.page.locator(".wb-timeline")
        expect(timeline).to_contain_text("env ")
        while (now := re.search(r"env (\d+)", timeline.inner_text())) and now[1] != "0":
            self.press("p")
            expect(timeline).not_to_contain_text(f"env {now[1]}")

    def moments_kept(self) -> int:
        """Control steps in the history, as the timeline shows them."""
        found = re.search(r"history: (\d+) steps?,", self.page.locator(".wb-legend-row").inner_text())
        return 0 if found is None else int(found[1])

    def choose(self, field: str, option: str) -> None:
        """Choose an option of the field whose command is `field`."""
        self.page.locator(f"select[name*='{field}']").select_option(label=option)

    def select_body(self, body: str) -> None:
        """Select a body on the Inspect tab."""
        self.tab("Inspect")
        self.choose("choose_inspected", "bodies")
        self.page.get_by_text(body, exact=True).filter(visible=True).first.click()
        expect(self.page.locator(".wb-body b").first).to_have_text(body)
        self.leave_inputs()

    def body_position(self) -> list[float]:
        """(3,) position of the selected body in the env's frame, metres, as the Inspect tab shows it."""
        first = self.page.locator(".wb-body .wb-num").first.inner_text().splitlines()[0]
        return [float(value) for value in first.removeprefix("p ").split(",")]

    def box(self, what: str) -> FloatRect:
        """Bounding box of the last element that the selector `what` finds, in page pixels."""
        place = self.page.locator(what).last
        # An element that is redrawn is missing for a moment.
        return until(place.bounding_box, f"{what} on the page")
