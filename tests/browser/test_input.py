"""The page's input: presses, keys and fields become commands, each once and in order."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.drive.far_line import FarLine, line_to
from tests.drive.page import close_notice, page_at
from tests.drive.panels import drop_viser
from tests.drive.served import redrawn, served
from tests.drive.waiting import until
from workbench.cameras.commands import PickPixel
from workbench.library.commands import OpenRow, PressRow
from workbench.live.commands import PauseLog, ResetAll, SetSeed, Step, TogglePlay
from workbench.live.env_commands import SelectEnv
from workbench.live.timeline_commands import Seek, StepBack
from workbench.page.command import Command, Refused
from workbench.page.commands import FrameScene
from workbench.page.door.gated_server import GatedServer
from workbench.page.widgets.fields import Field, tick
from workbench.page.widgets.keys_and_palette import register
from workbench.page.widgets.templates import asks
from workbench.page.widgets.visitors import Visitor

pytestmark = pytest.mark.browser
ROWS = 12
DELAY_SECONDS = 0.2
"""One-way delay of the far line, in seconds."""
MAX_SEED = 99


def part(command: Command, text: str, **more: str) -> str:
    """HTML of a pressable part."""
    data = "".join(f" data-{name}='{value}'" for name, value in more.items())
    return f"<div data-do='{asks(command)}'{data} tabindex='0' role='button' style='height:24px'>{text}</div>"


@dataclass
class SmallPage:
    """A small page with constantly redrawn rows, a seed, a strip and a picture; and the commands that it sent."""

    gated_server: GatedServer
    page: Page
    far: FarLine
    came: list[Command] = field(default_factory=list)
    seed: int = 7
    swapped: bool = False
    """Whether the rows are in another order."""
    still: bool = False
    """Whether the rows are not redrawn."""
    drawn_pause: bool = False
    """The value that the page gets for the *Pause* checkbox."""

    def do(self, command: Command, visitor: Visitor) -> None:
        if isinstance(command, SetSeed):
            if command.seed > MAX_SEED:
                raise Refused(f"The seed goes up to {MAX_SEED}.")
            self.seed = command.seed
        self.came.append(command)

    def has(self, *commands: Command) -> None:
        until(lambda: len(self.came) >= len(commands), f"{commands}", seen=lambda: self.came)
        assert self.came == list(commands)

    def row(self, env: int) -> str:
        return f"[data-do='{asks(SelectEnv(env=env))}']"


@pytest.fixture(scope="module")
def opened(browser: Browser) -> Iterator[SmallPage]:
    with served() as (gated_server, visitors), line_to(gated_server.url, delay=DELAY_SECONDS) as far:
        server = gated_server.server
        seed = Field(server, "Seed", SetSeed, "seed", "7")
        pause = tick(server, "Pause", PauseLog, "on", False)
        strip = part(Seek(step=0), "strip", along='["step", 0, 100]')
        picture = part(PickPixel(x=0.0, y=0.0), "picture", place="")
        recording = part(PressRow(id="a"), "recording", held="held", twice=asks(OpenRow(id="a")))
        server.gui.add_html(strip + picture + recording)
        rows = server.gui.add_html("")
        register(server, visitors, {Step, StepBack, ResetAll, TogglePlay, FrameScene}, "live page")
        count = 0

        def draw() -> None:
            nonlocal count
            if not small.still:
                count += 1
                order = range(ROWS - 1, -1, -1) if small.swapped else range(ROWS)
                rows.content = "".join(
                    part(SelectEnv(env=env), f"env {env}, drawing {count}") for env in order
                )
            seed.show(str(small.seed))
            pause.show(small.drawn_pause)

        with page_at(browser, gated_server.url) as (page, errors):
            small = SmallPage(gated_server, page, far)
            visitors.do = small.do
            with redrawn(draw, 1 / 60):
                page.wait_for_selector("[data-page]", state="attached")
                expect(page.get_by_text("recording")).to_be_visible()
                yield small
            assert not errors


@pytest.fixture
def small(opened: SmallPage) -> SmallPage:
    opened.page.evaluate("document.activeElement.blur()")
    opened.seed, opened.swapped, opened.still, opened.drawn_pause = 7, False, False, False
    expect(opened.page.get_by_label("Seed")).to_have_value("7")
    opened.came.clear()
    return opened


def press_for_a_while(page: Page, x: float, y: float) -> None:
    page.mouse.move(x, y)
    page.mouse.down()
    page.wait_for_timeout(50)  # duration of a press, during which the row is redrawn three times
    page.mouse.up()


def middle_of(page: Page, selector: str) -> tuple[float, float]:
    box = until(lambda: page.locator(selector).bounding_box(), selector)
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_presses_on_redrawn_rows_count_once_each(small: SmallPage) -> None:
    wanted = [(7 * k) % ROWS for k in range(8)]
    for env in wanted:
        press_for_a_while(small.page, *middle_of(small.page, small.row(env)))
    small.has(*(SelectEnv(env=env) for env in wanted))


def test_a_press_acts_on_the_part_under_the_pointer_at_mouse_down(small: SmallPage) -> None:
    small.page.mouse.move(*middle_of(small.page, small.row(2)))
    small.page.mouse.down()
    small.swapped = True
    until(
        lambda: small.page.get_by_text("drawing").first.inner_text().startswith(f"env {ROWS - 1}"),
        "the other order",
    )
    small.page.mouse.up()
    small.has(SelectEnv(env=2))


def test_a_press_that_is_dragged_off_its_part_does_nothing(small: SmallPage) -> None:
    x, y = middle_of(small.page, small.row(3))
    small.page.mouse.move(x, y)
    small.page.mouse.down()
    small.page.mouse.move(x - 400, y - 100)
    small.page.mouse.up()
    small.page.keyboard.press("s")
    small.has(Step())


def test_typed_input_is_committed_before_the_following_command(browser: Browser, small: SmallPage) -> None:
    """Over a line with 200 ms delay each way."""
    small.came.clear()
    with page_at(browser, small.far.address(small.gated_server.url)) as (page, errors):
        page.set_default_timeout(120_000)
        page.wait_for_selector("[data-page]", state="attached")  # until then viser may redraw the panel
        field = page.get_by_label("Seed")
        expect(field).to_have_value("7")
        for seed in (12, 34, 5):
            field.fill("")
            field.type(str(seed))
            page.keyboard.press("Enter")
            page.keyboard.press("Shift+R")
        small.has(*(command for seed in (12, 34, 5) for command in (SetSeed(seed=seed), ResetAll())))
        field.fill("8")
        x, y = middle_of(page, small.row(1))
        press_for_a_while(page, x, y)
        until(lambda: len(small.came) == 8, "the press", seen=lambda: small.came)
        assert small.came[6:] == [SetSeed(seed=8), SelectEnv(env=1)], "the press blurs the field first"
        assert not errors


@pytest.mark.parametrize(
    ("typed", "why"),
    [
        ("5000000000", "2147483647"),
        ("1.5", "1.5 is not"),
        ("-1", "from 0"),
        ("NaN", "NaN"),
        ("100", str(MAX_SEED)),
        ("abc", "abc"),
        ("", "empty"),
    ],
)
def test_an_invalid_seed_is_refused_with_a_reason_and_the_field_restored(
    small: SmallPage, typed: str, why: str
) -> None:
    field = small.page.get_by_label("Seed")
    field.fill(typed)
    small.page.keyboard.press("Enter")
    refusal = small.page.locator(".mantine-Notification-root, .wb-not-taken").filter(has_text=why)
    expect(refusal.last).to_be_visible()
    expect(field).to_have_value("7")
    small.page.keyboard.press("s")
    small.has(Step())


def test_a_late_refusal_keeps_what_was_typed_meanwhile(browser: Browser, small: SmallPage) -> None:
    small.came.clear()
    with page_at(browser, small.far.address(small.gated_server.url)) as (page, errors):
        page.set_default_timeout(120_000)
        page.wait_for_selector("[data-page]", state="attached")
        field = page.get_by_label("Seed")
        field.fill(str(MAX_SEED + 1))
        page.keyboard.press("Enter")
        field.fill("55")
        expect(page.locator(".mantine-Notification-root").filter(has_text="seed").last).to_be_visible()
        page.wait_for_timeout(500)  # the reply arrives separately from the notification
        expect(field).to_have_value("55")
        page.keyboard.press("Enter")
        small.has(SetSeed(seed=55))
        assert not errors


@pytest.mark.parametrize("taken", [True, False])
def test_an_entered_value_stays_until_redrawn_and_reverts_if_it_is_not(small: SmallPage, taken: bool) -> None:
    box = small.page.get_by_label("Pause")
    expect(box).not_to_be_checked()
    box.click()
    small.has(PauseLog(on=True))
    for _ in range(8):
        small.page.wait_for_timeout(50)  # the redraw may be this much later than the reply
        assert box.is_checked()
    small.drawn_pause = taken
    small.page.wait_for_timeout(1500)
    # On a busy machine the redraw comes even later.
    expect(box).to_be_checked(checked=taken)


def test_a_value_changed_by_another_command_is_shown_as_soon_as_it_is_drawn(small: SmallPage) -> None:
    field = small.page.get_by_label("Seed")
    drawn = small.page.locator("[data-shows*='seed']")
    field.fill("55")
    small.page.keyboard.press("Enter")
    small.has(SetSeed(seed=55))
    expect(drawn).to_have_attribute("data-shows", re.compile('"55"'))
    small.seed = 66
    expect(drawn).to_have_attribute("data-shows", re.compile('"66"'))
    assert field.input_value() == "66"


def test_a_number_is_entered_once_it_is_complete_and_stepped_by_the_arrow_keys(small: SmallPage) -> None:
    field = small.page.get_by_label("Seed")
    field.fill("12")
    small.page.wait_for_timeout(1000)  # longer than any debounce
    expect(field).to_have_value("12")
    assert small.came == []
    small.page.keyboard.press("ArrowUp")
    small.has(SetSeed(seed=13))
    expect(field).to_have_value("13")
    field.blur()
    small.page.keyboard.press("s")
    small.has(SetSeed(seed=13), Step())
    field.fill("1e1")
    small.page.keyboard.press("ArrowDown")
    small.has(SetSeed(seed=13), Step(), SetSeed(seed=9))


def test_escape_restores_a_field(small: SmallPage) -> None:
    field = small.page.get_by_label("Seed")
    field.fill("55")
    small.page.keyboard.press("Escape")
    expect(field).to_have_value("7")
    small.page.keyboard.press("f")
    small.has(FrameScene())


def test_a_held_key_repeats_where_that_makes_sense(small: SmallPage) -> None:
    for key in ("s", "s", "s", "f", "f"):
        small.page.keyboard.down(key)  # again without up: the browser marks it as a repeat
    small.page.keyboard.up("s")
    small.page.keyboard.up("f")
    small.has(Step(), Step(), Step(), FrameScene())


@pytest.mark.parametrize(
    ("event", "commands"),
    [
        ("{key: 'S', code: 'KeyS'}", [Step()]),  # CapsLock
        ("{key: '\u044b', code: 'KeyS'}", [Step()]),  # a Cyrillic layout
        ("{key: 's', code: 'KeyO'}", [Step()]),  # Dvorak
        ("{key: 'R', code: 'KeyR', shiftKey: true}", [ResetAll()]),
        ("{key: 'r', code: 'KeyR'}", []),
        ("{key: 's', code: 'KeyS', isComposing: true}", []),  # an input method
        ("{key: 's', code: 'KeyS', altKey: true}", []),
        ("{key: 's', code: 'KeyS', ctrlKey: true}", []),
    ],
)
def test_a_key_is_its_letter_in_any_layout(small: SmallPage, event: str, commands: list[Command]) -> None:
    small.page.evaluate(
        f"document.body.dispatchEvent(new KeyboardEvent('keydown', {{bubbles: true, ...{event}}}))"
    )
    small.page.keyboard.press("f")
    small.has(*commands, FrameScene())


HOLD_FRAMES_JS = """() => {
    [window.heldFrames, window.frameOf] = [[], requestAnimationFrame];
    window.requestAnimationFrame = (then) => window.heldFrames.push(then);
}"""
RELEASE_FRAMES_JS = """() => {
    window.requestAnimationFrame = frameOf;
    for (const then of window.heldFrames) requestAnimationFrame(then);
}"""


def test_command_keys_do_not_move_the_view(small: SmallPage) -> None:
    page = small.page
    (client,) = small.gated_server.server.get_clients().values()
    until(lambda: client.camera.image_width > 300, "the view")
    close_notice(page)  # it stands where the view is dragged
    before = client.camera.position.copy()
    for key in ("s", "ArrowLeft", "w", "e", "ArrowUp"):
        page.keyboard.down(key)
        page.wait_for_timeout(300)  # viser moves its view while a key is down
        page.keyboard.up(key)
    until(lambda: {*map(type, small.came)} == {Step, StepBack}, "the commands", seen=lambda: small.came)
    # View updates arrive in order: after that of a drag, all earlier ones have arrived.
    np.testing.assert_allclose(client.camera.position, before, atol=1e-6)
    page.mouse.move(200, 400)
    page.mouse.down()
    page.mouse.move(260, 400, steps=6)
    page.mouse.up()
    until(lambda: not np.allclose(client.camera.position, before), "the view that is dragged")
    assert client.camera.position[2] == pytest.approx(before[2], abs=1e-3), "a key moved the view"


def test_letters_typed_before_the_palette_has_opened_go_into_its_field(small: SmallPage) -> None:
    page = small.page
    palette = page.get_by_placeholder("Search commands...")
    page.evaluate(HOLD_FRAMES_JS)  # as in a browser that needs seconds for a frame
    page.keyboard.press("Control+k")
    page.keyboard.type("sf")
    page.keyboard.press("Control+k")
    page.keyboard.type("xs")
    page.keyboard.press("Backspace")
    assert not palette.is_visible()
    page.evaluate(RELEASE_FRAMES_JS)
    expect(palette).to_be_focused()
    page.keyboard.type("f")
    expect(palette).to_have_value("sfxf")
    page.keyboard.press("Escape")
    expect(palette).to_have_count(0)
    page.keyboard.press("f")
    small.has(FrameScene())


def test_escape_before_the_palette_has_opened_drops_what_was_typed(small: SmallPage) -> None:
    page = small.page
    palette = page.get_by_placeholder("Search commands...")
    page.evaluate(HOLD_FRAMES_JS)
    page.keyboard.press("Control+k")
    page.keyboard.type("s")
    page.keyboard.press("Escape")
    page.evaluate(RELEASE_FRAMES_JS)

    def acts() -> bool:
        page.keyboard.press("f")  # into the palette's field while it comes and goes
        return FrameScene() in small.came

    until(acts, "a command by its key, once the palette has gone", seen=lambda: small.came)
    page.keyboard.press("Control+k")
    expect(palette).to_be_focused()
    expect(palette).to_have_value("")
    page.keyboard.press("Escape")
    expect(palette).to_have_count(0)


def test_the_palette_key_in_a_field_opens_nothing_and_holds_no_keys(small: SmallPage) -> None:
    small.page.get_by_label("Pause").focus()
    small.page.keyboard.press("Control+k")
    small.page.keyboard.press("f")
    small.has(FrameScene())


def test_a_part_can_be_pressed_by_key_and_keeps_the_focus_when_redrawn(small: SmallPage) -> None:
    small.page.evaluate(f"document.querySelector(`{small.row(4)}`).click()")
    small.has(SelectEnv(env=4))
    small.page.keyboard.press("Tab")
    small.page.evaluate(f"document.querySelector(`{small.row(5)}`).focus()")
    small.page.wait_for_timeout(300)  # it is redrawn about twenty times
    small.page.keyboard.press("Enter")
    small.has(SelectEnv(env=4), SelectEnv(env=5))
    small.page.keyboard.press("Space")
    small.has(SelectEnv(env=4), SelectEnv(env=5), SelectEnv(env=5))


def test_a_click_releases_the_focus_so_that_space_plays(small: SmallPage) -> None:
    press_for_a_while(small.page, *middle_of(small.page, small.row(0)))
    small.page.keyboard.press("Space")
    small.has(SelectEnv(env=0), TogglePlay())


def test_a_drag_along_a_strip_ends_at_the_pointer(small: SmallPage) -> None:
    box = until(lambda: small.page.get_by_text("strip", exact=True).bounding_box(), "the strip")
    y = box["y"] + 5
    small.page.mouse.move(box["x"] + box["width"] / 20, y)
    small.page.mouse.down()
    for k in range(1, 11):
        small.page.mouse.move(box["x"] + box["width"] * k / 20, y)
    small.page.mouse.up()
    until(lambda: small.came and small.came[-1] == Seek(step=50), "its middle", seen=lambda: small.came)
    steps = [command.step for command in small.came if isinstance(command, Seek)]
    assert steps == sorted(steps) and len(steps) == len(small.came) <= 11


def test_a_press_on_a_picture_sends_its_position(small: SmallPage) -> None:
    box = until(lambda: small.page.get_by_text("picture", exact=True).bounding_box(), "the picture")
    small.page.mouse.click(box["x"] + box["width"] / 4, box["y"] + box["height"] / 2)
    until(lambda: small.came, "the place")
    (picked,) = small.came
    assert isinstance(picked, PickPixel) and picked.x == pytest.approx(0.25, abs=0.01)
    assert picked.y == pytest.approx(0.5, abs=0.05)


def test_a_row_gets_shift_and_ctrl_and_is_opened_by_a_double_press(small: SmallPage) -> None:
    row = small.page.get_by_text("recording", exact=True)
    row.click(modifiers=["Shift"])
    row.click(modifiers=["Control"])
    small.page.wait_for_timeout(600)  # later presses are not part of this double press
    row.click()
    row.click()
    small.has(
        PressRow(id="a", held="shift"), PressRow(id="a", held="ctrl"), PressRow(id="a"), OpenRow(id="a")
    )


def test_a_lost_command_channel_reconnects_and_sends_nothing_twice(small: SmallPage) -> None:
    small.page.evaluate(
        """() => new Promise((done) => {
            const send = WebSocket.prototype.send;
            WebSocket.prototype.send = function (text) {
                if (typeof text !== "string") return send.call(this, text);
                WebSocket.prototype.send = send;
                this.addEventListener("close", done);
                this.close();
            };
            document.body.dispatchEvent(new KeyboardEvent("keydown", {key: "f", code: "KeyF", bubbles: true}));
        })"""
    )
    expect(small.page.get_by_text("may not have been carried out")).to_be_visible()
    deadline = time.monotonic() + 60
    while not small.came and time.monotonic() < deadline:
        small.page.keyboard.press("s")
        small.page.wait_for_timeout(200)  # the channel takes a moment to reconnect
    assert set(small.came) == {Step()}, "a lost command is reported, and not sent again"


def test_commands_work_after_only_viser_reconnects(small: SmallPage) -> None:
    page = small.page
    name = page.locator("[data-page]").get_attribute("data-page")
    drop_viser(small.gated_server)
    expect(page.locator("[data-page]")).not_to_have_attribute("data-page", name or "")
    deadline = time.monotonic() + 60
    while not small.came and time.monotonic() < deadline:
        page.keyboard.press("s")
        page.wait_for_timeout(200)  # the channel takes a moment to reconnect
    small.came.clear()
    page.keyboard.press("f")
    small.has(FrameScene())
    press_for_a_while(page, *middle_of(page, small.row(2)))
    small.has(FrameScene(), SelectEnv(env=2))
    assert len(page.locator("[data-page]").all()) == 1
