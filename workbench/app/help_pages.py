"""Lists, finds and renders the documents for ``workbench help`` and the page's *Help*."""

from __future__ import annotations

import html
import posixpath
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from workbench.machine.folders import web_assets_folder
from workbench.page.widgets.templates import render

if TYPE_CHECKING:
    from collections.abc import Sequence

    from markdown_it.token import Token

ADDRESS = "/help/"
"""Prefix of the route of `reply`."""
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'self'; img-src 'self'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'self'",
    "Cache-Control": "no-cache",
}
_INTRODUCTION_CHARACTERS = 1000
"""Number of characters at the start of a page that count as its introduction. In a search, pages whose
introduction contains the words come first."""
_LITTLE_WORDS = frozenset("a an and for how i in is it my of on or the to with your".split())
OVERVIEW = "overview"
"""The topic made of the README."""
GROUPS = (
    ("", "Use it"),
    ("jobs", "Let it run for long"),
    ("reference", "Look something up"),
    ("developers", "Change the workbench"),
)
"""(folder of documents, its heading in the list of topics): the heading states the reader's goal."""
RULE_PAGES = "rules"
"""Folder with a page for each rule of `checks`. The list of topics omits these pages; the topic ``rules``
lists them in a table."""
FIRST = (
    OVERVIEW, "install", "tutorial", "start_page", "tasks", "debugging", "history", "hands", "cameras", "recordings", "checks", "solve",
    "sweep", "cluster", "batched_env", "safety", "limits", "gallery", "rules", "keys", "cli",
)  # fmt: skip
"""Order of the topics. All other topics follow, sorted by name."""
_DOCS = "web_assets/docs/"
_SCREENSHOTS = "web_assets/screenshots/"


@dataclass(frozen=True)
class Topic:
    name: str
    title: str
    group: str
    """One of `GROUPS`, or `RULE_PAGES`."""
    path: str
    """Path from the root of a checkout. Links on the page are relative to the folder of this path."""
    text: str
    """Markdown."""

    def link(self, address: str) -> tuple[str, str]:
        """Resolve a link on this page. Returns the target's path from the root of a checkout, and its
        ``#fragment`` (empty if there is none)."""
        parts = urlsplit(address)
        inside = f"#{parts.fragment}" if parts.fragment else ""
        return posixpath.normpath(
            posixpath.join(posixpath.dirname(self.path), parts.path)
        ) if parts.path else self.path, inside


@cache
def topics() -> tuple[Topic, ...]:
    """All topics, in the order in which they are listed."""
    folder = web_assets_folder()
    found = [(OVERVIEW, "", "README.md", _overview_file(folder))]
    for file in (folder / "docs").rglob("*.md"):
        below = file.relative_to(folder / "docs")
        found.append(
            (file.stem, below.parent.as_posix().removeprefix("."), f"{_DOCS}{below.as_posix()}", file)
        )
    folders = [*(name for name, _ in GROUPS), RULE_PAGES]

    def place(one: tuple[str, str, str, Path]) -> tuple[int, int, str]:
        name, group, *_ = one
        return folders.index(group), FIRST.index(name) if name in FIRST else len(FIRST), name

    return tuple(_topic(*one) for one in sorted(found, key=place))


def _overview_file(folder: Path) -> Path:
    """Path of README.md: in `folder` in a wheel, next to `folder` in a checkout."""
    inside = folder / "README.md"
    return inside if inside.is_file() else folder.parent / "README.md"


def _topic(name: str, group: str, path: str, file: Path) -> Topic:
    text = file.read_text(encoding="utf-8")
    title = "The first ten minutes" if name == OVERVIEW else text.partition("\n")[0].removeprefix("# ")
    return Topic(name, title, dict(GROUPS).get(group, RULE_PAGES), path, text)


def find_topic(name: str) -> Topic | None:
    """The topic of this name; None if there is none. Case is ignored, and spaces and ``-`` count as ``_``:
    ``Batched env`` and ``batched-env`` both find ``batched_env``."""
    wanted = _as_named(name.strip().lower().removesuffix(".md"))
    return next((topic for topic in topics() if _as_named(topic.name) == wanted), None)


def _as_named(name: str) -> str:
    return re.sub(r"[\s-]+", "_", name)


def topics_about(words: str) -> list[Topic]:
    """Topics whose text contains each of these words; upper and lower case and the order of the words are
    ignored. Topics with the words in their introduction come first. Pages of rules are returned only if no
    other topic matches."""
    wanted = _words(words)
    if not wanted:
        return []

    def holds(text: str) -> bool:
        return all(word in text.lower() for word in wanted)

    found = [topic for topic in topics() if holds(topic.text)]
    found = [topic for topic in found if topic.group != RULE_PAGES] or found
    return sorted(found, key=lambda topic: not holds(topic.text[:_INTRODUCTION_CHARACTERS]))


def _words(text: str) -> list[str]:
    """The words to search for, in lower case."""
    return [word for word in re.findall(r"[\w-]+", text.lower()) if word not in _LITTLE_WORDS]


def by_path(path: str) -> Topic | None:
    return next((topic for topic in topics() if topic.path == path), None)


# --- in the browser -----------------------------------------------------------------------------------


def reply(path: str, query: Mapping[str, str]) -> tuple[int, str, bytes]:
    """Returns (status, content type, page). If the query has a ``search``, the page lists the topics about
    its words. If not, it shows the topic named `path`; the overview if `path` is empty. `path` is only
    compared with topic names, so a browser cannot read other files."""
    words = query.get("search", "").strip()
    topic = None if words else find_topic(path or OVERVIEW)
    groups = [(group, [one for one in topics() if one.group == group]) for _, group in GROUPS]
    page = render(
        "help_page",
        topic=topic,
        groups=groups,
        body="" if topic is None else html_of(topic),
        words=words,
        found=[(one, _first_line_about(one, words)) for one in topics_about(words)],
        address=ADDRESS,
    )
    return 200 if topic is not None or words else 404, "text/html; charset=utf-8", page.encode()


def _first_line_about(topic: Topic, words: str) -> str:
    """The first line below a topic's title that contains one of the words; empty if no line does. Marks of
    Markdown are removed."""
    wanted = _words(words)
    lines = topic.text.splitlines()[1:]
    line = next((line for line in lines if any(word in line.lower() for word in wanted)), "")
    return re.sub(r"[`*|#]", "", re.sub(r"!?\[([^\]]*)\]\([^)]*\)?", r"\1", line)).strip()


def html_of(topic: Topic) -> str:
    """The text as HTML, with links and pictures resolved to addresses on this server."""
    from markdown_it import MarkdownIt  # imported late: only an opened help page needs it

    # HTML in the text is our own: README's <picture>.
    markdown = MarkdownIt("commonmark", {"html": True, "highlight": _coloured}).enable("table")
    tokens = markdown.parse(topic.text)
    for token in _all(tokens):
        if token.type == "link_open":
            token.attrSet("href", _address(topic, str(token.attrGet("href"))))
        elif token.type == "image":
            token.attrSet("src", _address(topic, str(token.attrGet("src"))))
        elif token.attrGet("style") == "text-align:right":
            # The Content-Security-Policy forbids inline styles.
            token.attrs = {"class": "number"}
        elif token.type == "html_block":
            token.content = re.sub(
                r'(src|srcset)="([^"]+)"', lambda m: f'{m[1]}="{_address(topic, m[2])}"', token.content
            )
    for opened, inline in zip(tokens, tokens[1:]):
        if opened.type == "heading_open":
            opened.attrSet("id", _anchor(inline.content))
        elif opened.type == "td_open":
            if inline.content.endswith("."):
                opened.attrJoin("class", "sentence")
            for part in inline.children or ():
                if part.type == "text":
                    part.type, part.content = "html_inline", _breakable(part.content)
    made = markdown.renderer.render(tokens, markdown.options, {})
    # In its own container, so that a wide table scrolls instead of the page.
    made = made.replace("<table>", '<div class="wide"><table>').replace("</table>", "</table></div>")
    # Each screenshot exists in a dark and a light version.
    return re.sub(r'<img src="(/workbench/screenshots/)dark/([\w.]+)" alt="([^"]*)" />', _PICTURE, made)


def _coloured(code: str, language: str, attributes: str) -> str:
    """HTML of a diff, with a CSS class on added and on removed lines. Empty for other languages: markdown-it
    then escapes the code."""
    if language != "diff":
        return ""
    kinds = {"-": "gone", "+": "come"}
    return "".join(
        f'<span class="{kinds[line[0]]}">{html.escape(line)}</span>'
        if line[0] in kinds
        else html.escape(line)
        for line in code.splitlines(keepends=True)
    )


_PICTURE = (
    r'<picture><source media="(prefers-color-scheme: light)" srcset="\1light/\2">'
    r'<img src="\1dark/\2" alt="\3"></picture>'
)


def _breakable(text: str) -> str:
    """The text as HTML with line-break opportunities in paths and long names: without them, a long word makes
    a table too wide."""
    path = re.sub(r"(?<=\w)([/_])(?=\w)", r"\1<wbr>", html.escape(text, quote=False))
    return re.sub(r"[A-Za-z0-9]{20,}", lambda name: re.sub(r"(?<=[a-z])(?=[A-Z])", "<wbr>", name[0]), path)


def _all(tokens: Sequence[Token]) -> Iterator[Token]:
    for token in tokens:
        yield token
        yield from _all(token.children or ())


def _address(topic: Topic, link: str) -> str:
    if urlsplit(link).scheme:
        return link
    path, inside = topic.link(link)
    if path.startswith(_SCREENSHOTS):
        return f"/workbench/screenshots/{path.removeprefix(_SCREENSHOTS)}"
    to = by_path(path)
    if to is None:
        return link
    return inside if to is topic and inside else f"{ADDRESS}{to.name}{inside}"


def _anchor(heading: str) -> str:
    """The id of a heading, as git hosts make it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
