"""Each rule has a page that says what the table says, why, how to mend it, and how it is checked."""

from __future__ import annotations

from tests.docs.pages import DOCS
from workbench.checks.rules import RULES

PAGES = DOCS / "rules"


def test_each_rule_has_a_page_and_no_other_page_is_there() -> None:
    assert sorted(page.stem for page in PAGES.iterdir()) == sorted(RULES)
