"""Reads the reason and the remedy of a rule from the rule's page."""

from __future__ import annotations

import posixpath
import re
from dataclasses import dataclass
from functools import cache
from urllib.parse import urlsplit

from workbench.machine.folders import web_assets_folder

HELP = "/help/"
"""Prefix of the addresses of documents."""
_FOLDER = "docs/rules"
_HEADING = re.compile(r"^## +(.+?) *$", re.M)
_NAME = re.compile(r"[a-z][a-z0-9-]*")


@dataclass(frozen=True)
class RulePage:
    """The parts of a rule's page that the Checks tab shows, as HTML."""

    why: str
    fix: str
    address: str
    """Address of the whole page."""


@cache
def rule_page(rule: str) -> RulePage | None:
    """The page of a rule; None if the rule has no page."""
    if not _NAME.fullmatch(rule):
        return None
    file = web_assets_folder() / _FOLDER / f"{rule}.md"
    if not file.is_file():
        return None
    parts = sections(file.read_text(encoding="utf-8"))
    return RulePage(as_html(parts.get("Why", "")), as_html(parts.get("Fix", "")), f"{HELP}{rule}")


def sections(text: str) -> dict[str, str]:
    """The text below each heading of the second level."""
    _, *rest = _HEADING.split(text)
    return {heading: body.strip() for heading, body in zip(rest[::2], rest[1::2], strict=True)}


def as_html(markdown: str) -> str:
    """Markdown as HTML; HTML in it is shown as text. Links to other documents lead to their pages."""
    from markdown_it import MarkdownIt  # late: a page that shows no finding needs no parser

    parser = MarkdownIt("commonmark", {"html": False})
    tokens = parser.parse(markdown)
    for token in tokens:
        for child in token.children or ():
            if child.type == "link_open":
                child.attrSet("href", _address(str(child.attrGet("href"))))
                child.attrSet("target", "_blank")
                child.attrSet("rel", "noopener")
    return parser.renderer.render(tokens, parser.options, {})


def _address(link: str) -> str:
    parts = urlsplit(link)
    if parts.scheme or not parts.path.endswith(".md"):
        return link
    inside = f"#{parts.fragment}" if parts.fragment else ""
    return f"{HELP}{posixpath.basename(parts.path).removesuffix('.md')}{inside}"
