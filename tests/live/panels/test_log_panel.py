from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.color import Color
from rich.style import Style

from tests.drive.live import Live
from tests.drive.scenes import running
from workbench.live.panels.log_panel import (
    DARK_PAGE,
    LIGHT_PAGE,
    LINES_SHOWN,
    MIN_CONTRAST,
    contrast,
    log_html,
    readable_on,
    spans_of_lines,
)
from workbench.live.process.captured_output import (
    NOTHING_PRINTED,
    Printed,
    PrintedLine,
    PrintedLog,
    StyledText,
)
from workbench.live.process.supervisor import ProcessMemory

LINES = (
    PrintedLine("stdout", "reward 0.5"),
    PrintedLine("stderr", "a Warning"),
    PrintedLine("stdout", "done"),
)


@pytest.mark.parametrize(
    ("wanted", "kept"),
    [
        *(("", range(5)), ("WARN", [1]), ("done", [2, 3]), ("nothing like it", [])),
        *(("stderr:", [1, 3]), ("stdout: done", [2]), ("a stderr", [4]), ("stdin:", [])),
    ],
)
def test_a_filter_is_of_one_stream_and_a_text_in_any_case_and_counts_its_lines(
    wanted: str, kept: Sequence[int]
) -> None:
    lines = (*LINES, PrintedLine("stderr", "done too"), PrintedLine("stdout", "a stderr: line"))
    html = log_html(Printed(1, lines, 0), wanted)
    assert [at for at, line in enumerate(lines) if f">{line.text}<" in html] == [*kept]
    assert re.findall(r"\d+ of \d+", html) == ([f"{len(kept)} of 5"] if kept else [])


def test_of_too_many_colours_the_newest_lines_have_theirs() -> None:
    red = StyledText("x", Style(color=Color.from_ansi(1)))
    lines = [(str(at), (red,) * 500) for at in range(5)]
    spans = spans_of_lines(lines)
    assert [[one.text for one in line] for line in spans] == [["0"], ["1"], *[["x"] * 500] * 3]


def test_a_log_that_only_dropped_lines_has_controls_and_memory_is_shown(live_page: Live) -> None:
    log = live_page.part("Log")
    live_page.show(running(2, printed=Printed(1, (), 12), vitals=ProcessMemory(3 * 2**30, 8 * 2**30, 2**29)))
    assert log.shows("Clear") and log.shows("Filter") and "12" in log.html()
    assert re.findall(r"[\d.]+ [MG]B", log.html("Memory")) == ["3.0 GB", "8.0 GB", "512 MB"]
    live_page.show(running(2, printed=Printed(1, (), 12), vitals=ProcessMemory(2**29)))
    assert re.findall(r"[\d.]+ [MG]B", log.html("Memory")) == ["512 MB"]


def test_a_paused_log_shows_its_switch_and_follows_again(live_page: Live) -> None:
    log = live_page.part("Log")
    live_page.show(running(2, printed=Printed(1, LINES[:1], 0)))
    log.set("Pause", True)
    live_page.again()
    assert log.typed("Pause") is True
    for serial, shown in ((2, False), (3, False)):
        live_page.show(running(2, printed=Printed(serial, LINES, 0)))
        assert ("Warning" in log.html()) == shown
    log.press("Clear")
    live_page.show(running(2, printed=Printed(4, LINES, 0)))
    assert "Warning" in log.html(), "a cleared log is drawn"
    live_page.show(running(2, printed=Printed(5, LINES[:1], 0)))
    assert "Warning" in log.html(), "and paused again"
    log.set("Pause", False)
    live_page.again()
    assert "Warning" not in log.html() and log.typed("Pause") is False


def test_a_flood_is_shown_as_its_last_lines_and_a_count() -> None:
    lines = tuple(PrintedLine("stdout", f"line {i}.") for i in range(1000))
    html = log_html(Printed(1, lines, 1234567), "")
    assert html.count('title="stdout"') == LINES_SHOWN and "line 999." in html and "line 0." not in html
    assert "1 234 567 more" in html and "lines. <" in html


def test_a_paused_log_does_not_update_and_a_cleared_one_does(live_page: Live) -> None:
    log = live_page.part("Log")

    def drawn(printed: Printed) -> str:
        live_page.show(running(2, printed=printed))
        return log.html()

    drawn(NOTHING_PRINTED)
    assert "data-field" not in log.html() and not log.shows("Clear")
    evil = PrintedLine("stdout", "<script>alert(1)</script>")
    shown = drawn(Printed(1, (*LINES, evil), 0))
    assert (
        shown.index("reward 0.5") < shown.index("a Warning") < shown.index("done") and "<script" not in shown
    )
    drawn(Printed(2, LINES[:1], 0))
    log.set("Pause", True)
    assert "Warning" not in drawn(Printed(3, LINES[:2], 0))
    log.type("Filter", "Warn")
    assert "Warning" in drawn(Printed(3, LINES[:2], 0)), "the filter applies to the lines on the page"
    assert "data-field" in log.html()
    log.press("Clear")
    drawn(Printed(4, (), 0))
    assert live_page.asked == [("clear_printed",)] and "data-field" not in log.html()


CSS = (Path(__file__).parents[3] / "web_assets" / "panels" / "page.css").read_text()
BYTE = st.integers(0, 255)


def shown(*raw: bytes) -> str:
    log = PrintedLog(lambda lines, dropped: None)
    for piece in raw:
        log.feed("stdout", piece)
    return log_html(log.view(), "")


def test_colours_become_spans_and_all_other_text_is_shown() -> None:
    html = shown(b"\x1b[1;31mred\x1b[0m plain \x1b[38;2;10;20;30mown\x1b[0m \x1b]0;title\x07\n")
    assert '<span class="wb-ansi-bold wb-ansi-1">red</span> plain ' in html
    assert 'class="wb-ansi-rgb" style="--on-light:#0a141e;--on-dark:#' in html
    assert "\\x1b]0;title\\x07" in html and "\x1b" not in html


@given(st.tuples(BYTE, BYTE, BYTE))
def test_every_colour_can_be_read_on_both_pages(colour: tuple[int, int, int]) -> None:
    for page in (LIGHT_PAGE, DARK_PAGE):
        assert contrast(readable_on(colour, page), page) >= MIN_CONTRAST
    assert readable_on((0, 0, 0), LIGHT_PAGE) == (0, 0, 0)


@pytest.mark.parametrize(
    ("scheme", "page"), [("", LIGHT_PAGE), ('[data-mantine-color-scheme="dark"] ', DARK_PAGE)]
)
def test_the_sixteen_colours_of_the_page_can_be_read(scheme: str, page: tuple[int, int, int]) -> None:
    for number in range(16):
        found = re.search(rf"(?:^|\s){re.escape(scheme)}\.wb-ansi-{number} {{ color: #(\w{{6}}); }}", CSS)
        assert found is not None, number
        red, green, blue = bytes.fromhex(found[1])
        assert contrast((red, green, blue), page) >= MIN_CONTRAST, (number, found[1])
    stderr = re.search(rf"(?:^|\n){re.escape(scheme)}\.wb-log \.wb-stderr {{ color: #(\w{{6}}); }}", CSS)
    assert stderr is not None
    red, green, blue = bytes.fromhex(stderr[1])
    assert contrast((red, green, blue), page) >= MIN_CONTRAST


@given(
    st.builds(
        Style,
        color=st.one_of(st.none(), st.builds(Color.from_ansi, st.integers(0, 15))),
        bgcolor=st.one_of(st.builds(Color.from_ansi, BYTE), st.builds(Color.from_rgb, BYTE, BYTE, BYTE)),
    )
)
def test_text_is_readable_on_any_background(style: Style) -> None:
    ((span,),) = spans_of_lines([("x", (StyledText("x", style),))])
    colours = re.fullmatch(r"color:#(\w{6});background:#(\w{6})", span.css)
    assert colours is not None
    text, behind = (tuple(bytes.fromhex(colour)) for colour in colours.groups())
    assert contrast(text, behind) >= MIN_CONTRAST / 2  # type: ignore[arg-type]
