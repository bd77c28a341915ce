"""Each rule has a page that says what the table says, why, how to mend it, and how it is checked."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.docs.pages import DOCS, fences
from workbench.checks.rules import RULES

PAGES = DOCS / "rules"
FORM = re.compile(
    r"# (?P<id>[\w-]+)\n\n"
    r"(?P<asks>[^\n]+(?:\n[^\n]+)*)\n\n"
    r"\*(?P<degree>stop|warn)\* · `(?P<hook>\w+)`\n\n"
    r"## Why\n\n?(?P<why>.+?)\n\n"
    r"## Mend\n\n?(?P<mend>.+?)\n\n```python fragment\n.+?\n```\n\n"
    r"## How it is checked\n\n?(?P<checked>.+?)\n",
    re.DOTALL,
)


def test_each_rule_has_a_page_and_no_other_page_is_there() -> None:
    assert sorted(page.stem for page in PAGES.iterdir()) == sorted(RULES)


@pytest.mark.parametrize("page", sorted(PAGES.glob("*.md")), ids=lambda page: page.stem)
def test_a_page_has_the_form_of_all_and_says_what_the_table_says(page: Path) -> None:
    text = page.read_text()
    found = FORM.fullmatch(text)
    assert found is not None, f"{page.name} has another form"
    rule = RULES[page.stem]
    # Names may be set as code there.
    said = " ".join(found["asks"].replace("`", "").split())
    assert (found["id"], said) == (rule.id, rule.asks.replace("`", ""))
    assert (found["degree"], found["hook"]) == (rule.degree, rule.hook)
    assert [fence.mark for fence in fences(page)] == ["fragment"]
