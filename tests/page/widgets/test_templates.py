from __future__ import annotations

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.scenes import running
from workbench.live.panels.banners import banner_html
from workbench.page.widgets.templates import render
from workbench.task.problem import Problem


def test_a_name_that_is_not_valid_utf8_is_shown() -> None:
    problem = Problem(
        "import", "name\udcff and \x1b[31m", "/tmp/a\u202egpj.py", 1, "x = 1\t# tab", "one\ntwo\udcff"
    )
    html = banner_html(problem, running(2))
    assert "name\\udcff and \\x1b[31m" in html and "a\\u202egpj.py" in html
    assert "one\ntwo\\udcff" in html and "x = 1\t# tab" in html, "newlines and tabs are kept"
    msgspec.msgpack.encode(html)


@given(st.text(st.characters()))
def test_any_rendered_text_can_be_sent_to_a_page(text: str) -> None:
    html = render("warning", text=text)
    msgspec.msgpack.encode(html)
    assert not {"\x1b", "\u202e", "\x9b", "\x00"} & set(html)
