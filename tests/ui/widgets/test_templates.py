from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.ui.scenes import running
from workbench.authoring.problem import Problem
from workbench.ui.live.banners import banner_html
from workbench.ui.widgets.templates import counted, letter, percent, place, render, size


def test_a_name_that_cannot_be_sent_is_shown() -> None:
    problem = Problem(
        "import", "name\udcff and \x1b[31m", "/tmp/a\u202egpj.py", 1, "x = 1\t# tab", "one\ntwo\udcff"
    )
    html = banner_html(problem, running(2))
    assert "name\\udcff and \\x1b[31m" in html and "a\\u202egpj.py" in html
    assert "one\ntwo\\udcff" in html and "x = 1\t# tab" in html, "lines and tabs are as they were"
    msgspec.msgpack.encode(html)


@given(st.text(st.characters()))
def test_whatever_is_rendered_can_be_sent_to_a_page(text: str) -> None:
    html = render("warning", text=text)
    msgspec.msgpack.encode(html)
    assert not {"\x1b", "\u202e", "\x9b", "\x00"} & set(html)


@pytest.mark.parametrize(
    ("count", "words"),
    [(0, "0 B"), (999, "999 B"), (2_500_000, "2.5 MB"), (999_700, "1 MB"), (1.234e9, "1.23 GB")],
)
def test_a_size_has_three_digits_and_the_unit_that_fits(count: float, words: str) -> None:
    assert size(count) == words


def test_parts_and_counts_are_said_as_a_person_says_them() -> None:
    assert [percent(1, 3), percent(3, 3), percent(0, 0)] == [33, 100, 0]
    assert [counted(number, "step") for number in (0, 1, 7)] == ["0 steps", "1 step", "7 steps"]
    nowhere = Problem("step", "it failed", None, None, None, "")
    assert [place(one) for one in (None, nowhere, replace(nowhere, file="/a/push.py"))] == ["", "", "push.py"]
    assert place(replace(nowhere, file="/a/push.py", line=8)) == "push.py:8"


def test_recordings_are_lettered_as_columns_of_a_sheet() -> None:
    assert [letter(index) for index in (0, 3, 4, 25, 26, 63)] == ["A", "D", "E", "Z", "AA", "BL"]
