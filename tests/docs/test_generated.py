"""The files that are made from the code are what the code says today."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.version import Version

from tests.docs import generate
from workbench.checks.rule_pages import sections

AGAIN = "write it again: python -m tests.docs.generate"


@pytest.fixture(scope="module")
def made(child_process: None) -> dict[Path, str]:
    return generate.pages()


@pytest.mark.parametrize(
    "page",
    [
        generate.KEYS,
        pytest.param(
            generate.CLI,
            marks=pytest.mark.skipif(
                Version(version("tyro")) < Version("1.0.16"),
                reason="earlier versions of tyro draw help another way",
            ),
        ),
        generate.GPU_RULES_PAGE,
        generate.ALL_RULES,
        generate.RULES_FILE,
    ],
    ids=lambda page: page.name,
)
def test_a_page_says_what_the_code_says(page: Path, made: dict[Path, str]) -> None:
    assert page.read_text() == made[page], AGAIN


def test_each_rule_has_the_page_that_its_declaration_says_and_no_other_page_is_there(
    made: dict[Path, str],
) -> None:
    there = {page: page.read_text() for page in generate.RULE_PAGES.iterdir()}
    assert there == {path: text for path, text in made.items() if path.parent == generate.RULE_PAGES}, AGAIN


def test_each_rule_says_why_how_to_mend_it_and_how_it_is_checked() -> None:
    for rule in generate.declared_rules():
        assert list(sections(rule.page)) == ["Why", "Mend", "How it is checked"], rule.id
        assert rule.asks[-1] == rule.otherwise[-1] == ".", rule.id
