"""The animation of README: a user at work on the page, in twenty seconds."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image, ImageDraw, ImageFont
from playwright.sync_api import expect

if TYPE_CHECKING:
    from tests.browser.take_screenshots import Desk

SIZE = (960, 540)
"""Size of the page in the film, in pixels; it is taken at 1280 x 720."""
STRIP = 64
"""Height in pixels of the caption strip below the page."""
MAX_BYTES = 3_000_000
QUALITIES = (80, 70, 60, 50, 40)
REWARD = ("reach = 1 - torch.tanh(5 * distance)", "reach = 1 - torch.tanh(3 * distance)")


@dataclass
class Film:
    desk: Desk
    frames: list[Image.Image] = field(default_factory=list)
    milliseconds: list[int] = field(default_factory=list)

    def scene(
        self,
        says: str,
        seconds: float,
        frames: int,
        then: Callable[[int], None] = lambda frame: None,
        code: tuple[str, str] | None = None,
    ) -> None:
        """Take `frames` frames that are shown for `seconds` in all; call `then` with the number of each."""
        for number in range(frames):
            shot = Image.open(BytesIO(self.desk.page.screenshot())).convert("RGB")
            self.frames.append(with_caption(shot.resize(SIZE, Image.Resampling.LANCZOS), says, code))
            self.milliseconds.append(round(1000 * seconds / frames))
            then(number)

    def save(self, path: Path) -> None:
        """Save an animated WebP of the best quality below `MAX_BYTES`."""
        for quality in QUALITIES:
            self.frames[0].save(
                path, save_all=True, append_images=self.frames[1:], duration=self.milliseconds, loop=0, quality=quality, method=5,
            )  # fmt: skip
            size = path.stat().st_size
            if size < MAX_BYTES:
                seconds = sum(self.milliseconds) / 1000
                print(
                    f"{path}: {len(self.frames)} frames, {seconds:.1f} s, {size / 1e6:.2f} MB, quality {quality}"
                )
                return
        raise ValueError(f"{path} has {size} bytes at the lowest quality: take fewer frames")


def with_caption(picture: Image.Image, says: str, code: tuple[str, str] | None) -> Image.Image:
    made = Image.new("RGB", (SIZE[0], SIZE[1] + STRIP), "#16181c")
    made.paste(picture, (0, 0))
    draw = ImageDraw.Draw(made)
    draw.text((24, SIZE[1] + STRIP / 2), says, "#ffffff", ImageFont.load_default(24), anchor="lm")
    if code is not None:
        small = ImageFont.load_default(18)
        draw.text((SIZE[0] - 24, SIZE[1] + STRIP / 2 - 13), f"- {code[0]}", "#ff8787", small, anchor="rm")
        draw.text((SIZE[0] - 24, SIZE[1] + STRIP / 2 + 13), f"+ {code[1]}", "#69db7c", small, anchor="rm")
    return made


def take_film(desk: Desk, path: Path) -> None:
    """The page plays a policy that overshoots in every fifth env."""
    film, page = Film(desk), desk.page
    desk.tab("Reward")
    desk.press("o", "f", "Space")  # all envs
    time.sleep(4)
    film.scene("Sixteen environments run your file", 3.0, 9)
    film.scene("Change the reward and save", 1.5, 2, code=REWARD)
    desk.edit(*REWARD)
    film.scene("New numbers at once", 2.0, 6, code=REWARD)
    time.sleep(5)
    desk.press("Space")
    expect(page.locator(".wb-again-table tbody tr").first).to_be_visible(timeout=120_000)
    film.scene("The past is rescored too", 2.0, 2)

    def find(frame: int) -> None:
        if frame == 0:
            page.get_by_label("Show", exact=True).first.select_option(label="last episode without success")
        elif frame == 1:
            desk.press("e")
        elif frame == 2:
            desk.press("o", "f")
        time.sleep(4)

    film.scene("Find the env that failed", 3.5, 5, find)
    desk.tab("Cameras")
    desk.choose("Camera", "base_camera · sensor")
    expect(page.get_by_text("Show the change", exact=True)).to_be_visible()
    time.sleep(4)

    def move(frame: int) -> None:
        desk.press(*3 * ["Alt+ArrowLeft"], *3 * ["Alt+Shift+ArrowRight"])
        time.sleep(1.5)

    film.scene("Place a camera", 2.5, 8, move)
    page.get_by_role("button", name="Show the change").click()
    save = page.get_by_role("button", name="Save to")
    save.evaluate("e => e.scrollIntoView({block: 'end'})")
    time.sleep(2)
    film.scene("... and save it to the file", 1.5, 2, lambda frame: time.sleep(1))
    save.click()
    expect(page.locator(".wb-sight-moved")).to_have_count(0)
    desk.tab("Episodes")
    desk.press("Shift+C", "Space")
    film.scene("Record episodes", 1.5, 5, lambda frame: time.sleep(1.5))
    desk.press("Shift+C", "Space", "v")
    row = page.locator(".wb-library [data-row]").first
    expect(row).to_be_visible(timeout=60_000)
    row.click()
    time.sleep(2)
    film.scene("... and review them", 0.8, 1)
    desk.press("Enter")
    expect(page.get_by_text(re.compile("step 0 /")).first).to_be_visible(timeout=60_000)
    time.sleep(4)

    def walk(frame: int) -> None:
        desk.press("ArrowRight", "ArrowRight")
        time.sleep(2)

    film.scene("... and review them", 2.2, 7, walk)
    film.save(path)
