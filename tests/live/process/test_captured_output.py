from __future__ import annotations

import unicodedata

from hypothesis import given
from hypothesis import strategies as st

from workbench.live.process.captured_output import PrintedLine, PrintedLog
from workbench.machine.text import plain_text


def a_log() -> tuple[PrintedLog, list[PrintedLine]]:
    told: list[PrintedLine] = []
    return PrintedLog(lambda lines, dropped: told.extend(lines)), told


@given(
    st.lists(st.text(st.characters(exclude_characters="\r\n", codec="utf-8"), max_size=20), max_size=20),
    st.data(),
)
def test_lines_are_the_same_however_the_bytes_are_cut(lines: list[str], data: st.DataObject) -> None:
    log, told = a_log()
    raw = "".join(line + "\n" for line in lines).encode()
    while raw:
        cut = data.draw(st.integers(1, len(raw)))
        assert not log.feed("stdout", raw[:cut])
        raw = raw[cut:]
    assert list(log.view().texts) == [line.text for line in told]
    if not any("\x1b[" in line for line in lines):
        assert list(log.view().texts) == [plain_text(line, "\t") for line in lines]


def test_streams_are_told_apart_and_an_unfinished_line_comes_with_the_end() -> None:
    log, _ = a_log()
    log.feed("stdout", b"one\nhalf")
    log.feed("stderr", b"two\n")
    assert log.view().lines == (PrintedLine("stdout", "one"), PrintedLine("stderr", "two"))
    log.feed("stdout", b"")
    assert log.view().lines[-1] == PrintedLine("stdout", "half")


def test_of_a_flood_the_number_is_right_and_the_end_is_kept() -> None:
    log, told = a_log()
    count = 300_000
    raw = b"".join(b"line %d\n" % i for i in range(count))
    rested = [log.feed("stdout", raw[i : i + 2**16]) for i in range(0, len(raw), 2**16)]
    view = log.view()
    assert rested[-1] and len(told) + view.dropped == count
    assert view.texts[-1] == f"line {count - 1}"
    assert len(view.lines) <= 1000 and view.dropped > 290_000
    kept = [int(text.split()[1]) for text in view.texts]
    assert kept == sorted(kept)


def test_a_progress_bar_is_one_line_that_is_its_last_version() -> None:
    told: list[int] = []
    log = PrintedLog(lambda lines, dropped: told.append(len(lines)))
    log.feed("stderr", b"before\n")
    for percent in range(101):
        log.feed("stderr", f"\r{percent:3}%|{'#' * percent}".encode())
        assert log.view().texts == ("before", f"{percent:3}%|{'#' * percent}"), "also while it goes on"
    assert told[1:] == [0] * (len(told) - 1) and len(told) < 20, "the page hears of it, and not of each"
    log.feed("stderr", b"\rdone\n")
    assert log.view().texts == ("before", "done")


@given(st.lists(st.binary(max_size=40), max_size=10))
def test_whatever_is_printed_the_log_holds_no_control(pieces: list[bytes]) -> None:
    log, told = a_log()
    for piece in pieces:
        log.feed("stdout", b"\x1b]0;" + piece + b"\x9b\n" + piece)
    text = "".join((*log.view().texts, *(line.text for line in told)))
    assert not [c for c in text if unicodedata.category(c) == "Cc" and c != "\t"]
