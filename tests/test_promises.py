"""README's promises and the tests that hold them: ``promises.txt`` names for each a test, or why there is none.

A quote is words of README, under which stand ids of tests, or a line that begins with a dash: why none holds it. Every
paragraph and every row of a table has a quote, so what is added to README is thought of here; what only leads to code with a
colon has none.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

TESTS = Path(__file__).parent
README = (TESTS.parent / "README.md").read_text()


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
    """Paragraphs and rows of tables, each on one line; headings, code and pictures are none."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    found: list[str] = []
    for block in re.split(r"\n\s*\n", text):
        lines = [line for line in block.splitlines() if not line.startswith(("    ", "#", "!["))]
        if lines and lines[0].startswith("|"):
            found += [plain(row) for row in lines[2:]]
        elif lines:
            found.append(plain("\n".join(lines)))
    return found


@cache
def names_in(file: Path) -> frozenset[str]:
    if not file.is_file():
        return frozenset()
    functions = (node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.FunctionDef))
    return frozenset(node.name for node in functions if node.name.startswith("test_"))


def test_every_passage_is_quoted() -> None:
    missing = [
        passage
        for passage in passages(README)
        if not passage.endswith(":") and not any(quote in passage for quote in promises())
    ]
    assert not missing, "add to tests/promises.txt what holds:\n" + "\n\n".join(missing)


def test_every_quote_is_still_in_it() -> None:
    whole = plain(README)
    gone = [quote for quote in promises() if quote not in whole]
    assert not gone, "README says otherwise now:\n" + "\n".join(gone)


def test_every_promise_has_a_test_or_a_reason() -> None:
    assert [quote for quote, lines in promises().items() if not lines] == []
    named = [line for lines in promises().values() for line in lines if not line.startswith("- ")]
    unknown = []
    for line in named:
        file, _, name = line.partition("::")
        if name not in names_in(TESTS.parent / file):
            unknown.append(line)
    assert not unknown, "no such test:\n" + "\n".join(unknown)


def test_a_script_that_is_named_as_a_reason_is_there() -> None:
    reasons = [line for lines in promises().values() for line in lines if line.startswith("- ")]
    scripts = [name for reason in reasons for name in re.findall(r"tests/[\w/]+\.py", reason)]
    assert scripts and [name for name in scripts if not (TESTS.parent / name).is_file()] == []


def test_every_target_of_make_that_is_named_is_there() -> None:
    """A merge has lost three that README and ``make help`` still named."""
    makefile = (TESTS.parent / "Makefile").read_text()
    targets = set(re.findall(r"^([a-z-]+):", makefile, flags=re.MULTILINE))
    for text in (README, makefile):
        named = set(re.findall(r"(?:`|\"|, )make ([a-z-]+)", text))
        assert named and named <= targets, named - targets
    (phony,) = re.findall(r"^\.PHONY: (.*)", makefile, flags=re.MULTILINE)
    assert set(phony.split()) - {"FORCE"} <= targets
