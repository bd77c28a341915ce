"""The help pages: every topic has one, links and pictures exist, and no other file is served."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest

from workbench.app import help_pages
from workbench.app.help_pages import ADDRESS, Topic, find_topic, html_of, reply, topics
from workbench.machine.folders import web_assets_folder

pytestmark = pytest.mark.thorough

ELSEWHERE = {"github.com"}
"""Hosts that pages link to."""


class PageParts(HTMLParser):
    """Collects a page's ids, and the addresses of its links and pictures."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: set[str] = set()
        self.pictures: set[str] = set()
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attrs}
        self.ids |= {found["id"]} if "id" in found else set()
        self.links |= {found["href"]} if tag == "a" else set()
        self.pictures |= {found[name] for name in ("src", "srcset") if name in found}


def page_of(topic: Topic) -> PageParts:
    status, kind, body = reply(topic.name, {})
    assert status == 200 and kind.startswith("text/html")
    return PageParts(body.decode())


@pytest.mark.parametrize("topic", topics(), ids=lambda topic: topic.name)
def test_every_link_has_a_target(topic: Topic) -> None:
    seen = page_of(topic)
    for link in seen.links:
        if link.startswith("https://"):
            assert link.split("/")[2] in ELSEWHERE
            continue
        address, _, inside = link.partition("#")
        to = topic if not address else find_topic(address.removeprefix(ADDRESS) or "overview")
        assert to is not None and (not address or address.startswith(ADDRESS)), link
        assert not inside or inside in page_of(to).ids, link


@pytest.mark.parametrize("topic", topics(), ids=lambda topic: topic.name)
def test_every_picture_exists_dark_and_light(topic: Topic) -> None:
    pictures = page_of(topic).pictures - {"/workbench/logo.svg"}
    assert all(address.startswith("/workbench/screenshots/") for address in pictures)
    missing = [
        one for one in pictures if not (web_assets_folder() / one.removeprefix("/workbench/")).is_file()
    ]
    assert missing == []
    dark = {one for one in pictures if "/dark/" in one}
    assert {one.replace("/dark/", "/light/") for one in dark} == {one for one in pictures if "/light/" in one}


@pytest.mark.parametrize(
    "name", ["../safety.md", "%2e%2e", "/etc/passwd", "docs/safety.md", "README.md/..", "\u202e"]
)
def test_an_unknown_topic_gives_the_list_and_no_file_content(name: str) -> None:
    status, _, body = reply(name, {})
    assert status == 404 and "safety" in body.decode() and "root:" not in body.decode()
    assert name not in body.decode()


def test_html_in_the_text_of_a_page_is_shown_as_text() -> None:
    topic = Topic(
        "x", "x", "Use it", "web_assets/docs/x.md", "# x\n\n`<b>` and\n\n```sh\necho '<script>'\n```\n"
    )
    made = html_of(topic)
    assert "<script>" not in made and "&lt;script&gt;" in made and "<code>&lt;b&gt;</code>" in made


def test_no_page_has_a_script_or_a_handler() -> None:
    for topic in topics():
        body = reply(topic.name, {})[2].decode()
        assert "<script" not in body and not re.search(r"<[^>]+\son\w+=", body)
    assert "script-src" not in help_pages.HEADERS["Content-Security-Policy"]


def test_a_search_lists_the_documents_with_all_words_and_shows_the_words_as_text() -> None:
    status, _, body = reply("", {"search": "force arrows"})
    found = body.decode().partition("<main>")[2]
    assert status == 200 and '<a href="/help/debugging">' in found and "Force arrows" in found
    assert "/help/install" not in found
    body = reply("", {"search": "<script> no-such-word"})[2]
    assert b"<script" not in body and b"No document has all of these words" in body
