"""The review in a real Chromium: open from the library, play, step, compare; and switch to it from the live page."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from tests.drive.episodes import made, write
from tests.drive.page import open_workbench, page_at
from tests.drive.waiting import until

pytestmark = pytest.mark.browser
LATE_UPDATE_ERROR = "Tried to update non-existent component"
"""Console error of viser's page when a component is removed while an update to it is in flight."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    write(folder, made(20, success_from=15, seed=1, written_at="2026-11-21T10:00:00+00:00"))
    write(folder, made(12, seed=2, speed=0.03, source_hash="1" * 12, source={"push.py": "reward = 2\n"}))
    return folder


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    """The address of ``workbench review``, which must exit on SIGINT."""
    with open_workbench(str(folder), what="review") as opened:
        yield opened.url
    assert opened.process.returncode == 0, "\n".join(opened.lines)


@pytest.fixture(scope="module")
def opened(address: str, browser: Browser) -> Iterator[tuple[Page, list[str]]]:
    with page_at(browser, address) as (page, errors):
        # The newest recording, with the library open: a library that folds after opening would swallow a click.
        expect(page.locator(".wb-status")).to_contain_text("paused")
        expect(page.locator(".wb-status")).to_contain_text("seed0002")
        says(page, "step 0 / 12")
        expect(page.locator(".wb-library")).to_be_visible()
        yield page, errors
        assert [error for error in errors if LATE_UPDATE_ERROR not in error] == []


@pytest.fixture
def page(opened: tuple[Page, list[str]]) -> Page:
    return opened[0]


def row(page: Page, seed: int) -> None:
    page.get_by_text(re.compile(f"seed000{seed}")).first.click()


def unfold_library(page: Page) -> None:
    if page.locator(".wb-library").count() == 0:
        page.keyboard.press("b")
    expect(page.locator(".wb-library")).to_be_visible()


def open_both(page: Page) -> None:
    """Open and select both recordings, with the library folded."""
    page.get_by_role("tab", name="Review").click()
    # The library folds itself when another selection is opened, also if only the order differs. An extra key press
    # would unfold it again.
    opened = page.locator(".wb-opened-list tr", has=page.locator(".wb-letter"))
    seeds = [text.split("\t") for text in opened.all_inner_texts()]
    was_open = ["1" in cells for cells in seeds] == [True, False] and "2" in seeds[1]
    unfold_library(page)
    row(page, 1)
    page.keyboard.down("Control")
    row(page, 2)
    page.keyboard.up("Control")
    page.keyboard.press("Enter")
    expect(page.locator(".wb-opened-list .wb-letter")).to_have_count(2)
    if was_open:
        page.keyboard.press("b")
    expect(page.locator(".wb-library")).to_have_count(0)


def says(page: Page, text: str) -> None:
    expect(page.locator(".wb-timeline").get_by_text(re.compile(text)).first).to_be_visible()


def cubes(page: Page) -> list[float]:
    """x of every cube that the view draws."""
    return page.evaluate(
        """() => Object.entries(window.__viserSceneTree.getState())
            .filter(([name, node]) => name.startsWith('/envs') && name.includes('cube')
                && (node.effectiveVisibility ?? node.visibility ?? true))
            .flatMap(([, node]) => {
                const p = node.message.props.batched_positions;
                const f = new Float32Array(p.buffer.slice(p.byteOffset, p.byteOffset + p.byteLength));
                return Array.from(f).filter((_, i) => i % 3 === 0);
            })"""
    )


def test_a_recording_opens_from_the_library_and_keys_step_through_it(page: Page) -> None:
    page.get_by_role("tab", name="Review").click()
    unfold_library(page)
    row(page, 1)
    page.keyboard.press("Enter")
    says(page, "step 0 / 20")
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    says(page, "step 3 / 20")
    until(lambda: any(abs(x - 0.03) < 1e-4 for x in cubes(page)), "the cube at its place")
    page.keyboard.press("Shift+ArrowRight")
    says(page, "step 15 / 20")
    expect(page.locator(".wb-status").get_by_text("success", exact=True)).to_be_visible()
    remark = page.locator(".wb-opened-list .wb-small").first.evaluate(
        """it => {
            const size = (of) => parseFloat(getComputedStyle(of).fontSize);
            const note = document.createElement("div");
            note.className = "wb-note";
            it.closest(".wb-opened-list").parentElement.append(note);
            const both = [size(it), size(note)];
            note.remove();
            return both;
        }"""
    )
    assert remark[0] == pytest.approx(remark[1], abs=0.1), "the font size of other remarks"
    page.keyboard.press("Home")
    says(page, "step 0 / 20")
    page.keyboard.press("Space")
    says(page, "step 20 / 20")
    page.get_by_role("tab", name="Cameras").click()
    expect(page.locator('img[src^="blob:"]').first).to_be_visible()


def test_a_click_on_a_body_shows_its_pose_until_that_is_closed(page: Page) -> None:
    page.get_by_role("tab", name="Review").click()
    body = page.locator(".wb-body")
    expect(body).to_have_count(0)
    view = page.locator("canvas[data-engine]").bounding_box()
    assert view is not None
    page.mouse.click(view["x"] + view["width"] / 2, view["y"] + view["height"] / 2)
    expect(body).to_contain_text("pose")
    body.get_by_text("✕").click()
    expect(body).to_have_count(0)


def test_two_recordings_are_compared_and_their_first_difference_shown(page: Page) -> None:
    open_both(page)
    page.get_by_role("tab", name="Compare").click()
    expect(page.get_by_text(re.compile("They diverge at step 1"))).to_be_visible()
    page.locator("tr", has=page.get_by_text("bodies", exact=True)).click()
    says(page, "step 1 /")
    page.get_by_role("button", name="Swap A and B").click()
    page.get_by_role("tab", name="Review").click()
    rows = page.locator(".wb-opened-list tr", has=page.locator(".wb-letter"))
    expect(rows.last).to_contain_text("210.00")  # the older recording, which was A: the sum of 1 to 20


@pytest.mark.slow
def test_a_shared_file_is_named_made_and_downloaded(page: Page) -> None:
    open_both(page)
    page.get_by_role("tab", name="Share").click()
    expect(page.get_by_text("Selected in the library, 2 recordings")).to_be_visible()
    page.get_by_label("Make", exact=True).select_option(label="Sheet of pictures (png)")
    expect(page.get_by_text(re.compile("Makes 2 files"))).to_be_visible()
    page.get_by_role("button", name="Make", exact=True).click()
    links = page.locator("a[download]")
    expect(links).to_have_count(2)
    for link in links.all():
        address = link.evaluate("link => link.href")
        sheet = Image.open(io.BytesIO(page.request.get(address).body()))
        assert sheet.format == "PNG" and sheet.width > 100
        assert address.endswith(str(link.get_attribute("title"))) and ".sheet.png" in address


@pytest.mark.slow
def test_without_room_for_both_unfolding_rerun_or_the_library_folds_the_other(
    opened: tuple[Page, list[str]],
) -> None:
    page, errors = opened
    before = len(errors)
    open_both(page)
    # Its width is a fraction of the view's, which the server learns shortly after the library was folded.
    until(lambda: page.locator("canvas[data-engine]").evaluate("c => c.clientWidth") > 800, "the wide view")
    page.get_by_role("tab", name="Share").click()
    # rerun reloads each time, which takes a core for some seconds; tests/share/test_rerun_view.py checks its content.
    page.route("**/rerun/viewer-*/*.wasm", lambda route: route.abort())
    library, rerun = page.locator(".wb-library"), page.locator("iframe.wb-rerun")
    unfold = page.get_by_role("button", name="Expand column").first
    page.get_by_role("button", name="Open in rerun").click()
    expect(rerun).to_be_visible()
    expect(library).to_have_count(0)
    until(lambda: page.locator("canvas[data-engine]").evaluate("c => c.clientWidth") < 400, "the narrow view")
    tops = [page.get_by_role("button", name=name, exact=True) for name in ("First step", "Play", "Last step")]
    until(
        lambda: len({top.evaluate("b => Math.round(b.offsetTop + b.offsetHeight / 2)") for top in tops}) == 1,
        "the buttons in one row",
    )
    unfold.click()  # viser's own button, which does not notify the server
    expect(library).to_be_visible()
    expect(rerun).to_have_count(0)
    unfold.click()
    expect(rerun).to_be_visible()
    expect(library).to_have_count(0)
    page.keyboard.press("b")
    expect(library).to_be_visible()
    expect(rerun).to_have_count(0)
    page.keyboard.press("b")
    expect(library).to_have_count(0)
    page.get_by_role("button", name="Close rerun").click()
    expect(rerun).to_have_count(0)
    del errors[before:]  # rerun's errors about the file that it did not get
