"""Reads README and the docs: pages, and the fences of a page."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "web_assets" / "docs"
PAGES = (ROOT / "README.md", *sorted(DOCS.rglob("*.md")))
_FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Fence:
    page: Path
    line: int
    """Line number of its first line of text, from 1."""
    language: str
    mark: str
    """The word after the language: ``slow``, ``fragment``, ``wrong``, or empty."""
    text: str

    @property
    def place(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


@cache
def fences(page: Path) -> tuple[Fence, ...]:
    text = page.read_text()
    found = []
    for match in _FENCE.finditer(text):
        language, _, mark = match[1].partition(" ")
        found.append(Fence(page, text.count("\n", 0, match.start(2)) + 1, language, mark, match[2]))
    return tuple(found)


def without_fences(page: Path) -> str:
    return _FENCE.sub("", page.read_text())
