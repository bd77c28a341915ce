"""Small texts of the page: sizes, shares, letters, keys, and the names of commands."""

# A `SimpleNamespace` has any attribute.
# pyright: reportArgumentType=false

from __future__ import annotations

from types import SimpleNamespace

import pytest

from workbench.commands import COMMANDS
from workbench.live.commands import ResetAll, Step
from workbench.live.env_commands import SelectEnv
from workbench.page.command import SHORT_NAMES, Command, CommandList, is_key, key_in_words, name_of
from workbench.page.commands import (
    AnswerDialog,
    CloseDialog,
    ShowLive,
    ShowRecordings,
    TellOpenTab,
    ToggleTable,
)
from workbench.page.widgets.keys_and_palette import key_rows, with_key
from workbench.page.widgets.templates import (
    COLOURS,
    colour,
    counted,
    letter,
    percent,
    place,
    sentence,
    short_text,
    size,
)


@pytest.mark.parametrize(
    ("made", "text"),
    [
        (size(0), "0 B"),
        (size(999), "999 B"),
        (size(999.6), "1 kB"),
        (size(2_500_000), "2.5 MB"),
        (size(999_400_000), "999 MB"),
        (size(1_234_000_000), "1.23 GB"),
        (letter(0), "A"),
        (letter(25), "Z"),
        (letter(26), "AA"),
        (letter(27), "AB"),
        (letter(52), "BA"),
        (short_text("x" * 120), "x" * 120),
        (short_text("x" * 121), "x" * 119 + "…"),
        (short_text("abcdef", 4), "abc…"),
        (sentence("why not"), "Why not."),
        (sentence("Why not?"), "Why not?"),
        (sentence(""), ""),
        (counted(0, "step"), "0 steps"),
        (counted(1, "step"), "1 step"),
        (counted(7, "step"), "7 steps"),
        (place(SimpleNamespace(file="/home/me/push.py", line=88)), "push.py:88"),
        (place(SimpleNamespace(file="/home/me/push.py", line=None)), "push.py"),
        (place(SimpleNamespace(file=None, line=3)), ""),
        (place(None), ""),
        (key_in_words("shift+r"), "Shift+R"),
        (key_in_words("ctrl+alt+arrowleft"), "Ctrl+Alt+Left arrow"),
        (key_in_words("arrowleft", SHORT_NAMES), "←"),
        (key_in_words("space"), "Space"),
        (key_in_words(""), ""),
        (name_of(ShowRecordings), "show_recordings"),
        (with_key(ToggleTable), f"{ToggleTable.help()} (B)"),
        (with_key(ToggleTable, "Table"), "Table (B)"),
        (with_key(SelectEnv, "Env 3"), "Env 3"),
    ],
)
def test_a_text_of_the_page_is_as_a_user_expects_it(made: str, text: str) -> None:
    assert made == text


def test_a_share_is_rounded_and_nothing_while_the_total_is_unknown() -> None:
    assert [percent(1, 3), percent(2, 3), percent(5, 5), percent(5, 0)] == [33, 67, 100, 0]
    assert [colour(index) for index in range(6)] == [*COLOURS, *COLOURS[:2]]


@pytest.mark.parametrize(
    ("key", "normal"),
    [
        ("s", True),
        ("?", True),
        ("shift+arrowleft", True),
        ("ctrl+alt+shift+x", True),
        ("S", False),
        ("alt+ctrl+x", False),
        ("cmd+x", False),
        ("left", False),
        ("ctrl+", False),
    ],
)
def test_a_key_has_one_normal_form(key: str, normal: bool) -> None:
    assert is_key(key) is normal


def test_the_palette_has_what_needs_no_value_and_no_dialog() -> None:
    listed = {
        kind: kind.is_in_palette() for kind in (Step, SelectEnv, CloseDialog, AnswerDialog, TellOpenTab)
    }
    assert listed == {
        Step: True,
        SelectEnv: False,
        CloseDialog: False,
        AnswerDialog: False,
        TellOpenTab: False,
    }


def test_the_list_of_keys_has_the_keys_of_the_pages_own_commands() -> None:
    commands = CommandList({"One": (ToggleTable, ShowRecordings), "Two": (SelectEnv, ResetAll)})
    rows = key_rows(commands, (ToggleTable, SelectEnv, ResetAll))
    assert rows == {
        "One": [("B", ToggleTable.help())],
        "Two": [(key_in_words(ResetAll.key), ResetAll.help())],
    }
    assert key_rows(commands, (SelectEnv,)) == {}


class AlsoB(Command, frozen=True):
    """Another command with a taken key."""

    key = "b"


def test_a_name_or_a_key_cannot_belong_to_two_commands() -> None:
    for kinds in ((ToggleTable, ToggleTable), (ToggleTable, AlsoB)):
        with pytest.raises(AssertionError):
            CommandList({"One": kinds})
    CommandList({"One": (ShowLive, ShowRecordings)})  # one key, but each in its own context


def test_a_command_is_read_from_what_it_is_sent_as() -> None:
    for command in (SelectEnv(env=3), Step(), TellOpenTab(tab="Run")):
        assert COMMANDS.decode(*command.encode()) == command
    with pytest.raises(KeyError):
        COMMANDS.decode("no_such_command", {})
    assert "select_env" in COMMANDS and "no_such_command" not in COMMANDS
