"""The pages of Help: every topic is one, links and pictures lead somewhere, and no other file is given out."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest

from tests.docs.pages import PAGES, ROOT
from workbench.cli.help import show_help
from workbench.machine.folders import web_assets_folder
from workbench.ui.app import help_pages
from workbench.ui.app.help_pages import ADDRESS, Topic, find_topic, html_of, reply, topics
from workbench.ui.widgets.templates import render

ELSEWHERE = {"github.com"}
"""Hosts that pages link to."""


class Seen(HTMLParser):
    """Ids, addresses of links, and addresses of pictures of a page."""

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


def page_of(topic: Topic) -> Seen:
    status, kind, body = reply(topic.name)
    assert status == 200 and kind.startswith("text/html")
    return Seen(body.decode())


def test_the_start_page_leads_to_the_tutorial() -> None:
    linked = Seen(render("start_head", version="1")).links
    assert linked == {f"{ADDRESS}tutorial"} and find_topic("tutorial") is not None


def test_every_page_of_the_docs_is_a_topic() -> None:
    paths = {topic.path for topic in topics()}
    assert paths == {page.relative_to(ROOT).as_posix() for page in PAGES}
    names = [topic.name for topic in topics()]
    assert len(set(names)) == len(names) and names[:2] == ["overview", "install"]
    assert [topic.title for topic in topics() if topic.title.startswith("#") or not topic.title] == []


@pytest.mark.parametrize("topic", topics(), ids=lambda topic: topic.name)
def test_every_link_leads_somewhere(topic: Topic) -> None:
    seen = page_of(topic)
    for link in seen.links:
        if link.startswith("https://"):
            assert link.split("/")[2] in ELSEWHERE
            continue
        address, _, inside = link.partition("#")
        to = topic if not address else find_topic(address.removeprefix(ADDRESS) or "overview")
        assert to is not None and (not address or address.startswith(ADDRESS)), link
        assert not inside or inside in page_of(to).ids, link


def test_a_path_or_a_long_name_in_a_table_may_go_on_in_another_line() -> None:
    """Else its column takes the room of the one that says what is wrong."""
    topic = find_topic("checked_tasks")
    assert topic is not None
    made = html_of(topic)
    assert "<td>dexterity/<wbr>rotate_<wbr>valve.py:150" in made
    assert "<td>Rotate<wbr>Single<wbr>Object<wbr>In<wbr>Hand<wbr>Level0, 1</td>" in made
    assert '<td class="sentence">The reset replaces <code>self.rotate_direction</code>' in made


@pytest.mark.parametrize("topic", topics(), ids=lambda topic: topic.name)
def test_every_picture_is_there_dark_and_light(topic: Topic) -> None:
    pictures = page_of(topic).pictures - {"/workbench/logo.svg"}
    assert all(address.startswith("/workbench/screenshots/") for address in pictures)
    gone = [one for one in pictures if not (web_assets_folder() / one.removeprefix("/workbench/")).is_file()]
    assert gone == []
    dark = {one for one in pictures if "/dark/" in one}
    assert {one.replace("/dark/", "/light/") for one in dark} == {one for one in pictures if "/light/" in one}


def test_no_picture_is_left_over() -> None:
    shown = {name for page in PAGES for name in re.findall(r"screenshots/([\w/]+\.\w+)", page.read_text())}
    shown |= {name.replace("dark/", "light/") for name in shown}
    folder = web_assets_folder() / "screenshots"
    assert {file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()} == shown


@pytest.mark.parametrize(
    "name", ["../safety.md", "%2e%2e", "/etc/passwd", "docs/safety.md", "README.md/..", "\u202e"]
)
def test_a_name_that_is_no_topic_gives_the_list_and_nothing_of_a_file(name: str) -> None:
    status, _, body = reply(name)
    assert status == 404 and "There is no such page" in body.decode() and "root:" not in body.decode()
    assert name not in body.decode()


def test_what_looks_like_html_in_the_text_of_a_page_is_shown() -> None:
    topic = Topic(
        "x", "x", "Use it", "web_assets/docs/x.md", "# x\n\n`<b>` and\n\n```sh\necho '<script>'\n```\n"
    )
    made = html_of(topic)
    assert "<script>" not in made and "&lt;script&gt;" in made and "<code>&lt;b&gt;</code>" in made


def test_lines_of_a_diff_are_told_apart_and_shown_as_text() -> None:
    text = "# x\n\n```diff\n a = <b>\n-c = <d>\n+e = <f>\n```\n\n```text\n-not <g>\n```\n"
    made = html_of(Topic("x", "x", "Use it", "web_assets/docs/x.md", text))
    assert '\n<span class="gone">-c = &lt;d&gt;\n</span><span class="come">+e = &lt;f&gt;\n</span>' in made
    assert " a = &lt;b&gt;\n" in made and "-not &lt;g&gt;\n" in made and made.count("<span") == 2


def test_no_page_has_a_script_or_a_handler() -> None:
    for topic in topics():
        body = reply(topic.name)[2].decode()
        assert "<script" not in body and not re.search(r"<[^>]+\son\w+=", body)
    assert "script-src" not in help_pages.HEADERS["Content-Security-Policy"]


@pytest.mark.parametrize(
    "named", ["batched_env", "Batched env", "batched-env", "BATCHED_ENV.md", " batched_env "]
)
def test_a_topic_is_found_as_people_write_it(named: str) -> None:
    found = find_topic(named)
    assert found is not None and found.name == "batched_env"


def test_the_page_of_a_rule_is_found_by_its_name_and_in_no_list(capsys: pytest.CaptureFixture[str]) -> None:
    for named in ("reward-rows", "reward_rows", "Reward rows"):
        found = find_topic(named)
        assert found is not None and found.path == "web_assets/docs/rules/reward-rows.md"
    assert "reward-rows" not in reply("overview")[2].decode()
    assert "<h1" in reply("reward-rows")[2].decode()
    assert show_help("reward-rows") == 0 and show_help("") == 0
    page, listed = capsys.readouterr().out.split("Use it\n")
    assert "Mend" in page and "reward-rows" not in listed and "rules" in listed
