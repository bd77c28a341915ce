from __future__ import annotations

import re
import subprocess
import sys
import unicodedata

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rich.style import Style

from workbench.live.process.captured_output import PLAIN, StyledText, coloured_runs, for_terminal
from workbench.machine.text import only_colours, plain_text

COLOURS = re.compile("\x1b\\[[0-9;:]*m")
DIRECTIONS = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
PIECES = (
    "\x1b", "\x1b[", "\x9b", "\x1b[31m", "\x1b[38;5;208m", "\x1b[0m", "\x1b[8m", "\x1b[2J", "\x1b[m", "\x1b[38",
    "\x1b]0;title\x07", "\x1b]52;c;aGk=\x1b\\", "\x1b]8;;http://x\x1b\\", "\x1bc", "\r", "\n", "\x7f", "m", "31",
    "\x9b31m", "\x90q\x9c", "\u202e", "\u2066", "\u2028", "\udc80", "[", ";", ":",
)  # fmt: skip
EVIL = st.lists(st.text(st.characters(), max_size=8) | st.sampled_from(PIECES), max_size=12).map("".join)


def harmful(text: str) -> list[str]:
    """Return the characters that control a terminal or change a line's reading order."""
    return [
        c
        for c in text
        if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") or unicodedata.bidirectional(c) in DIRECTIONS
    ]


@given(EVIL)
@example("\x9b31m")
def test_plain_text_has_no_control_character(text: str) -> None:
    assert harmful(plain_text(text)) == []
    assert set(harmful(plain_text(text, "\n"))) <= {"\n"}
    assert plain_text(plain_text(text)) == plain_text(text)


@given(EVIL)
def test_only_colours_reach_the_terminal(text: str) -> None:
    assert set(harmful(COLOURS.sub("", only_colours(text)))) <= {"\n", "\t"}
    runs, _ = coloured_runs(text)
    assert set(harmful("".join(run.text for run in runs))) <= {"\t"}
    assert set(harmful(COLOURS.sub("", for_terminal(tuple(runs))))) <= {"\t"}
    assert all(run.text for run in runs)


@given(EVIL)
def test_coloured_runs_survive_a_round_trip_through_the_terminal_text(text: str) -> None:
    runs, style = coloured_runs(text)
    printed = for_terminal(tuple(runs))
    again, after = coloured_runs(printed)
    assert [(run.text, run.style) for run in again] == [(run.text, run.style) for run in runs]
    assert after == PLAIN, "a style must not leak into the workbench's next line"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("reward 0.5", "reward 0.5"),
        ("\x1b]0;mine\x07", "\\x1b]0;mine\\x07"),
        ("a\nb\tc\rd", "a\\nb\\tc\\rd"),
        ("evil\u202egpj.py", "evil\\u202egpj.py"),
        ("name\udcff", "name\\udcff"),
        ("\U000e0041", "\\U000e0041"),
    ],
)
def test_control_characters_are_shown_as_python_escapes(text: str, shown: str) -> None:
    assert plain_text(text) == shown


@pytest.mark.parametrize(
    ("numbers", "style"),
    [
        ("", PLAIN),
        ("31", Style(color="color(1)")),
        ("1;32", Style(color="color(2)", bold=True)),
        ("94;103", Style(color="color(12)", bgcolor="color(11)")),
        ("38;5;9", Style(color="color(9)")),
        ("38;5;208", Style(color="color(208)")),
        ("38;2;1;2;3;4", Style(color="#010203", underline=True)),
        ("38:2::1:2:3", Style(color="#010203")),
        ("38;2;999;2;3", Style(color="#ff0203")),
        ("8", PLAIN),
        ("31;8", Style(color="color(1)")),
        ("31;39", PLAIN),
        ("1;2;3;4;7;9;22;23;24;27;29", PLAIN),
        ("4:3", Style(underline=True)),
    ],
)
def test_colours_are_parsed_as_terminals_do(numbers: str, style: Style) -> None:
    runs, _ = coloured_runs(f"\x1b[{numbers}mx")
    assert runs == [StyledText("x", style)]


def test_a_style_continues_over_lines_and_hidden_text_is_shown() -> None:
    first, style = coloured_runs("\x1b[31mone")
    second, _ = coloured_runs("two\x1b[0m three", style)
    assert first == [StyledText("one", Style(color="color(1)"))]
    assert second == [StyledText("two", Style(color="color(1)")), StyledText(" three", PLAIN)]
    assert only_colours("\x1b[31;8msecret\x1b[0m") == "\\x1b[31;8msecret\x1b[0m"


def test_a_logged_traceback_has_bounded_lines_and_length(child_process: None) -> None:
    program = (
        "import logging\nfrom workbench.machine.text import guard_terminal\nguard_terminal()\n"
        "def deeper(n):\n    other(n)\ndef other(n):\n    if not n: raise ValueError('z' * 100_000)\n    deeper(n - 1)\n"
        "try:\n    deeper(150)\nexcept ValueError:\n    logging.getLogger('x').exception('failed')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    lines = done.stderr.splitlines()
    assert lines[0] == "failed" and "ValueError: zzz" in done.stderr
    assert len(lines) <= 100 and max(map(len, lines)) <= 600
