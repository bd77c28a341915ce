"""The mark of broken rules, and its list."""

from __future__ import annotations

import pytest

from workbench.core.rules import Finding
from workbench.session.protocol.messages import RulesBroken
from workbench.ui.live.status_line import rules_html, times

ROW = Finding(
    "not-applied",
    "warn",
    "The pose of 'cube' was set <b>",
    "/home/me/task.py",
    24,
    "self.x(<i>)",
    "lift",
    12,
    3,
)


def test_the_mark_counts_and_names_a_line_and_no_more_while_it_is_closed() -> None:
    text = rules_html(RulesBroken((ROW, ROW)), open=False, press_id="here")
    assert "2 warnings" in text and "task.py:24 and 1 more" in text and 'data-press="here"' in text
    assert "was set" not in text
    assert "1 warning " in rules_html(RulesBroken((ROW,)), open=False, press_id="here")


def test_the_list_says_line_code_and_sentence_of_each_row_and_every_value_is_escaped() -> None:
    text = rules_html(RulesBroken((ROW,), more=5), open=True, press_id="here")
    for words in (
        "task.py:24",
        'title="/home/me/task.py"',
        "in lift",
        "self.x(&lt;i&gt;)",
        "was set &lt;b&gt;",
        "not-applied",
        "10 times and more",
        "first at step 3",
        "and 5 times at further lines",
    ):
        assert words in text


def test_a_row_without_a_line_is_said_without_one() -> None:
    row = Finding("not-applied", "warn", "lost", None, None, "", "", 1, 0)
    text = rules_html(RulesBroken((row,)), open=True, press_id="here")
    assert "lost" in text and "once" in text and "from the start" in text and "None" not in text


@pytest.mark.parametrize(
    ("count", "said"),
    [
        (1, "once"),
        (2, "2 times"),
        (9, "9 times"),
        (19, "10 times and more"),
        (12345, "10 000 times and more"),
    ],
)
def test_large_counts_are_said_by_their_first_digit(count: int, said: str) -> None:
    assert times(count) == said
