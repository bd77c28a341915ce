"""The docs in the browser: every page with its pictures, and the links to them from the workbench."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import At
from tests.drive.page import page_at
from workbench.app import help_pages
from workbench.page.door.gated_server import GatedServer, ServerOptions, open_server

pytestmark = pytest.mark.slow
BROKEN = (
    "[...document.images].filter(one => !one.complete || one.naturalWidth < 20).map(one => one.currentSrc)"
)
WIDER_THAN_THE_WINDOW = "document.documentElement.scrollWidth - innerWidth"


@pytest.fixture(scope="module")
def served(child_process: None) -> Iterator[GatedServer]:
    gated_server = open_server(ServerOptions(port=0))
    gated_server.add_route(help_pages.ADDRESS, help_pages.reply, help_pages.HEADERS)
    yield gated_server
    gated_server.close()


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_every_page_of_the_docs_opens_with_its_pictures(
    served: GatedServer, browser: Browser, theme: str
) -> None:
    address = served.addresses("/help/")[0]
    with page_at(browser, address) as (page, errors):
        address = address.partition("?")[0]  # the token is now a cookie
        page.emulate_media(color_scheme=theme)  # type: ignore[arg-type]
        listed = [topic for topic in help_pages.topics() if topic.group != help_pages.RULE_PAGES]
        entries = page.locator("nav li a")
        expect(entries).to_have_count(len(listed))
        # They have no pictures: what is too wide is so in both themes.
        rules = [topic.name for topic in help_pages.topics() if topic not in listed and theme == "dark"]
        for number, name in enumerate([*(topic.name for topic in listed), *rules]):
            if number < len(listed):
                entries.nth(number).click()
                page.wait_for_url(f"**/help/{name}")
                expect(page.locator("nav [aria-current=page]")).to_have_count(1)
            else:
                page.goto(f"{address}{name}")
            assert page.evaluate(BROKEN) == [], name
            assert page.evaluate(WIDER_THAN_THE_WINDOW) <= 0, name
            shown = page.evaluate(
                "[...document.images].map(one => one.currentSrc).filter(one => one.includes('screenshots/'))"
            )
            assert [one for one in shown if ("/light/" if theme == "dark" else "/dark/") in one] == []
        assert errors == []


def test_a_link_to_a_section_shows_that_section(served: GatedServer, browser: Browser) -> None:
    with page_at(browser, served.addresses("/help/tasks")[0]) as (page, errors):
        page.get_by_role("link", name="rules", exact=True).click()
        page.wait_for_url("**/help/batched_env#what-goes-wrong-on-a-gpu-goes-wrong-here")
        expect(
            page.get_by_role("heading", name="What goes wrong on a GPU goes wrong here")
        ).to_be_in_viewport()
        assert errors == []


def test_help_opens_the_docs_from_both_pages(example_without_pictures: At, browser: Browser) -> None:
    with example_without_pictures(browser) as desk:
        search = desk.page.get_by_placeholder("Search commands...")

        def leads_to_help(press: str, title: str = "Workbench", of_palette: str = "help: open") -> None:
            with desk.page.expect_popup() as opened:
                if press == "palette":
                    desk.press("Control+k")
                    search.fill(of_palette)
                    expect(desk.page.get_by_role("button", name=re.compile("^Help")).last).to_be_visible()
                    desk.press("Enter")
                else:
                    desk.page.get_by_role("link", name="Help", exact=True).click()
            expect(opened.value.get_by_role("heading", level=1)).to_have_text(title)
            opened.value.close()
            expect(search).to_have_count(0)  # a palette that is still closing takes the next key

        desk.tab("Checks")
        leads_to_help("link", "Checks")
        leads_to_help("palette")
        leads_to_help("palette", "Solve a task before training on it", "help: solve a task before")
        desk.leave_inputs()
        desk.switch_to("review")
        expect(desk.page.get_by_role("tab", name="Library")).to_be_visible()
        leads_to_help("link", "Record episodes and review them")
        leads_to_help("palette")
        desk.leave_inputs()
        desk.switch_to("live")
        expect(desk.button("Play")).to_be_visible()


def test_the_documents_can_be_searched(served: GatedServer, browser: Browser) -> None:
    with page_at(browser, served.addresses("/help/")[0]) as (page, errors):
        search = page.get_by_role("searchbox", name="Search the documents")
        search.fill("contact forces")
        search.press("Enter")
        page.wait_for_url("**/help/?search=contact+forces")
        page.locator("main").get_by_role("link").first.click()
        expect(page.locator("nav [aria-current=page]")).to_have_count(1)
        assert errors == []


def test_a_file_of_the_task_opens_in_the_editor_from_the_palette(
    example_without_pictures: At, browser: Browser
) -> None:
    with example_without_pictures(browser) as desk:
        desk.press("Control+k")
        desk.page.get_by_placeholder("Search commands...").fill(desk.file.name)
        expect(desk.page.get_by_role("button", name=re.compile("^File")).last).to_be_visible()
        desk.press("Enter")
        opens = desk.page.locator("[data-open-address]")
        expect(opens).to_have_attribute("data-open-address", f"vscode://file{desk.file}:1")
        expect(desk.button("Play")).to_be_visible()  # the page stayed
