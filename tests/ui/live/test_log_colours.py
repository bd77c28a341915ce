from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.color import Color
from rich.style import Style

from workbench.session.process.captured_output import Printed, PrintedLine, PrintedLog, Run, coloured_runs
from workbench.ui.live.log_panel import (
    DARK_PAGE,
    LIGHT_PAGE,
    MOST_SPANS,
    READABLE,
    contrast,
    log_html,
    readable_on,
    spans_of_lines,
)

CSS = (Path(__file__).parents[3] / "web_assets" / "panels" / "page.css").read_text()
BYTE = st.integers(0, 255)


def shown(*raw: bytes) -> str:
    log = PrintedLog(lambda lines, dropped: None)
    for piece in raw:
        log.feed("stdout", piece)
    return log_html(log.view(), "")


def test_colours_become_spans_and_all_else_is_shown() -> None:
    html = shown(b"\x1b[1;31mred\x1b[0m plain \x1b[38;2;10;20;30mown\x1b[0m \x1b]0;title\x07\n")
    assert '<span class="wb-ansi-bold wb-ansi-1">red</span> plain ' in html
    assert 'class="wb-ansi-rgb" style="--on-light:#0a141e;--on-dark:#' in html
    assert "\\x1b]0;title\\x07" in html and "\x1b" not in html


def test_what_is_printed_in_colour_is_text() -> None:
    html = shown(b"\x1b[31m<script>alert(1)</script>\x1b[0m\" onmouseover='x'\n")
    assert "<script" not in html and "&lt;script" in html and '" onmouseover' not in html


@given(st.tuples(BYTE, BYTE, BYTE))
def test_every_colour_can_be_read_on_both_pages(colour: tuple[int, int, int]) -> None:
    for page in (LIGHT_PAGE, DARK_PAGE):
        assert contrast(readable_on(colour, page), page) >= READABLE
    assert readable_on((0, 0, 0), LIGHT_PAGE) == (0, 0, 0)


@pytest.mark.parametrize(
    ("scheme", "page"), [("", LIGHT_PAGE), ('[data-mantine-color-scheme="dark"] ', DARK_PAGE)]
)
def test_the_sixteen_colours_of_the_page_can_be_read(scheme: str, page: tuple[int, int, int]) -> None:
    for number in range(16):
        found = re.search(rf"(?:^|\s){re.escape(scheme)}\.wb-ansi-{number} {{ color: #(\w{{6}}); }}", CSS)
        assert found is not None, number
        red, green, blue = bytes.fromhex(found[1])
        assert contrast((red, green, blue), page) >= READABLE, (number, found[1])
    stderr = re.search(rf"(?:^|\n){re.escape(scheme)}\.wb-log \.wb-stderr {{ color: #(\w{{6}}); }}", CSS)
    assert stderr is not None
    red, green, blue = bytes.fromhex(stderr[1])
    assert contrast((red, green, blue), page) >= READABLE


@given(
    st.builds(
        Style,
        color=st.one_of(st.none(), st.builds(Color.from_ansi, st.integers(0, 15))),
        bgcolor=st.one_of(st.builds(Color.from_ansi, BYTE), st.builds(Color.from_rgb, BYTE, BYTE, BYTE)),
    )
)
def test_text_can_be_seen_on_any_background(style: Style) -> None:
    ((span,),) = spans_of_lines([("x", (Run("x", style),))])
    colours = re.fullmatch(r"color:#(\w{6});background:#(\w{6})", span.css)
    assert colours is not None
    text, behind = (tuple(bytes.fromhex(colour)) for colour in colours.groups())
    assert contrast(text, behind) >= READABLE / 2  # type: ignore[arg-type]


def test_a_flood_of_colours_is_bounded_and_its_text_is_whole() -> None:
    runs, _ = coloured_runs("".join(f"\x1b[{31 + i % 2}m{i % 10}" for i in range(300)))
    text = "".join(run.text for run in runs)
    line = PrintedLine("stdout", text, tuple(runs))
    html = log_html(Printed(1, (line,) * 200, 0), "")
    assert html.count("<span class=") <= MOST_SPANS
    assert re.sub("<[^>]*>", "", html).count(text) == 200


def test_the_filter_is_of_the_text_that_is_seen() -> None:
    log = PrintedLog(lambda lines, dropped: None)
    log.feed("stdout", b"re\x1b[31mward\x1b[0m 0.5\nother\n")
    html = log_html(log.view(), "reward")
    assert "1 of 2 lines" in html and "other" not in html
