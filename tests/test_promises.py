"""What README and the docs promise, and the tests that hold it: ``promises.txt`` names for each a test, or why there is none.

A quote is words of one of these pages, under which stand ids of tests, or a line that begins with a dash: why none holds it.
In `WHOLE` every paragraph, point of a list and row of a table has a quote, so that whoever adds one thinks of its test; what
only leads to code with a colon has none.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
ROOT = TESTS.parent
DOCS = ROOT / "web_assets" / "docs"
README = ROOT / "README.md"
WHOLE = (
    README,
    *(
        DOCS / f"{name}.md"
        for name in ("install", "tasks", "debugging", "history", "cameras", "recordings", "limits")
    ),
)
QUOTED = {page: page.read_text() for page in (README, *sorted(DOCS.rglob("*.md")))}


ONLY_LINKS = re.compile(r"\| [^|]+ \| (\[[^]]+\]\([^)]+\)(, )?)+ \|")


def plain(text: str) -> str:
    return " ".join(text.split())


@cache
def promises() -> dict[str, list[str]]:
    """Quote to the lines under it."""
    found: dict[str, list[str]] = {}
    quote = ""
    for line in (TESTS / "promises.txt").read_text().splitlines():
        if line.startswith("> "):
            quote = plain(line[2:])
            assert quote not in found, f"twice: {quote}"
            found[quote] = []
        elif line and not line.startswith("## "):
            found[quote].append(line)
    return found


def passages(text: str) -> list[str]:
    """Paragraphs, points of lists and rows of tables, each on one line; headings, code and pictures are none."""
    text = re.sub(r"^```.*?^```$|^<picture>.*?^</picture>$", "", text, flags=re.DOTALL | re.MULTILINE)
    found: list[str] = []
    for block in re.split(r"\n\s*\n|\n(?=- )", text):
        lines = [line for line in block.splitlines() if not line.startswith(("#", "!["))]
        if lines and lines[0].startswith("|"):
            found += [plain(row) for row in lines[2:]]
        elif any(lines):
            found.append(plain("\n".join(lines)))
    return found


@cache
def names_in(file: Path) -> frozenset[str]:
    if not file.is_file():
        return frozenset()
    functions = (node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.FunctionDef))
    return frozenset(node.name for node in functions if node.name.startswith("test_"))


@pytest.mark.parametrize("page", WHOLE, ids=lambda page: page.stem)
def test_every_passage_is_quoted(page: Path) -> None:
    missing = [
        passage
        for passage in passages(page.read_text())
        if not passage.endswith(":")
        and not ONLY_LINKS.fullmatch(passage)
        and not any(quote in passage for quote in promises())
    ]
    assert not missing, "add to tests/promises.txt what holds:\n" + "\n\n".join(missing)


def test_every_quote_is_still_on_a_page() -> None:
    pages = [plain(text) for text in QUOTED.values()]
    gone = [quote for quote in promises() if not any(quote in page for page in pages)]
    assert not gone, "README and the docs say otherwise now:\n" + "\n".join(gone)


def test_every_promise_has_a_test_or_a_reason() -> None:
    assert [quote for quote, lines in promises().items() if not lines] == []
    named = [line for lines in promises().values() for line in lines if not line.startswith("- ")]
    unknown = []
    for line in named:
        file, _, name = line.partition("::")
        if name not in names_in(ROOT / file):
            unknown.append(line)
    assert not unknown, "no such test:\n" + "\n".join(unknown)


def test_a_script_that_is_named_as_a_reason_is_there() -> None:
    reasons = [line for lines in promises().values() for line in lines if line.startswith("- ")]
    scripts = [name for reason in reasons for name in re.findall(r"tests/[\w/]+\.py", reason)]
    assert scripts and [name for name in scripts if not (ROOT / name).is_file()] == []


def test_every_target_of_make_that_is_named_is_there() -> None:
    """A merge has lost three that README and ``make help`` still named."""
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^([a-z-]+):", makefile, flags=re.MULTILINE))
    pages = {
        page: set(re.findall(r"(?:`|\"|^|, )make ([a-z-]+)", text, re.M)) for page, text in QUOTED.items()
    }
    pages[ROOT / "Makefile"] = set(re.findall(r"\"make ([a-z-]+)", makefile))
    assert pages[README] and pages[ROOT / "Makefile"]
    assert {page.name: named - targets for page, named in pages.items() if named - targets} == {}
    (phony,) = re.findall(r"^\.PHONY: (.*)", makefile, flags=re.MULTILINE)
    assert set(phony.split()) - {"FORCE"} <= targets
