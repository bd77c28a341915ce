"""Texts of a rule on the Checks tab: links lead to pages of the help, and HTML in a text is text."""

from __future__ import annotations

import re
from typing import Any

import pytest

from workbench.checks.rule_pages import as_html, rule_page, sections
from workbench.checks.rule_table import RULES, degree_of_each, did_you_mean
from workbench.envs.gpu_rules import GPU_RULES


@pytest.mark.parametrize(
    ("link", "address"),
    [
        ("same-seed.md", "/help/same-seed"),
        ("../rewards.md#terms", "/help/rewards#terms"),
        ("#here", "#here"),
        ("https://maniskill.ai/a.md", "https://maniskill.ai/a.md"),
        ("picture.png", "picture.png"),
    ],
)
def test_a_link_opens_its_page_in_another_tab(link: str, address: str) -> None:
    html = as_html(f"See [it]({link}).")
    assert f'href="{address}"' in html and 'target="_blank"' in html


def test_html_in_a_text_is_shown_as_text() -> None:
    html = as_html("<b>x</b> and `a < b`\n\n```python\ny = 1\n```")
    assert "<b>" not in html and "&lt;b&gt;" in html and "<code>a &lt; b</code>" in html and "<pre>" in html


def test_each_rule_has_its_own_reason_and_remedy() -> None:
    pages = {rule: rule_page(rule) for rule in RULES}
    for rule, page in pages.items():
        assert page is not None and page.why and page.fix and page.address == f"/help/{rule}", rule
    assert len({page.fix for page in pages.values() if page is not None}) == len(RULES)
    for name in ("no-such-rule", "../rules/same-seed", "Same-seed", ""):
        assert rule_page(name) is None


def test_sections_are_divided_at_headings_of_the_second_level() -> None:
    text = "before\n## Why\none\n\n### not one\n## Fix \n\ntwo\n"
    assert sections(text) == {"Why": "one\n\n### not one", "Fix": "two"}


def test_each_rule_has_the_degree_that_was_asked_for() -> None:
    solved = {rule.id for rule in RULES.values() if rule.solve}
    default = degree_of_each()
    assert list(default) == list(RULES) and {rule for rule in default if default[rule] == "off"} == solved
    assert {default[rule] for rule in GPU_RULES} == {"stop", "warn"}
    for choice in ("stop", "warn", "off"):
        degrees = degree_of_each(ignore=("same-seed",), choice=choice)
        assert {degrees[rule] for rule in RULES.keys() - solved - {"same-seed"}} == {choice}
        assert degrees["same-seed"] == "off"
    only = degree_of_each(select=("same-seed", "reward-flat"), ignore=("reward-flat",))
    assert {rule for rule in only if only[rule] != "off"} == {"same-seed"}
    wrongs: tuple[dict[str, Any], ...] = ({"select": ["same_seed"]}, {"ignore": ["nothing-like-it"]})
    for wrong in wrongs:
        with pytest.raises(ValueError, match=re.escape(repr(*wrong.values()).strip("[]"))):
            degree_of_each(**wrong)


@pytest.mark.parametrize(
    ("written", "meant"), [("reward_rows", "reward-rows"), ("Same-Seed", "same-seed"), ("zzz", "")]
)
def test_a_similar_rule_is_named(written: str, meant: str) -> None:
    assert (meant in did_you_mean(written)) if meant else did_you_mean(written) == ""
