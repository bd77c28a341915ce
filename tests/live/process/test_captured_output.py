from __future__ import annotations

import unicodedata

from hypothesis import given
from hypothesis import strategies as st

from workbench.live.process.captured_output import PrintedLine, PrintedLog
from workbench.machine.text import plain_text


def a_log() -> tuple[PrintedLog, list[PrintedLine]]:
    reported: list[PrintedLine] = []
    return PrintedLog(lambda lines, dropped: reported.extend(lines)), reported


@given(
    st.lists(st.text(st.characters(exclude_characters="\r\n", codec="utf-8"), max_size=20), max_size=20),
    st.data(),
)
def test_lines_do_not_depend_on_how_the_bytes_are_split(lines: list[str], data: st.DataObject) -> None:
    log, reported = a_log()
    raw = "".join(line + "\n" for line in lines).encode()
    while raw:
        cut = data.draw(st.integers(1, len(raw)))
        assert not log.feed("stdout", raw[:cut])
        raw = raw[cut:]
    assert list(log.view().texts) == [line.text for line in reported]
    if not any("\x1b[" in line for line in lines):
        assert list(log.view().texts) == [plain_text(line, "\t") for line in lines]


def test_streams_are_separate_and_an_unfinished_line_arrives_at_the_end() -> None:
    log, _ = a_log()
    log.feed("stdout", b"one\nhalf")
    log.feed("stderr", b"two\n")
    assert log.view().lines == (PrintedLine("stdout", "one"), PrintedLine("stderr", "two"))
    log.feed("stdout", b"")
    assert log.view().lines[-1] == PrintedLine("stdout", "half")


def test_a_flood_is_counted_and_its_last_lines_kept() -> None:
    log, reported = a_log()
    count = 300_000
    raw = b"".join(b"line %d\n" % i for i in range(count))
    rested = [log.feed("stdout", raw[i : i + 2**16]) for i in range(0, len(raw), 2**16)]
    view = log.view()
    assert rested[-1] and len(reported) + view.dropped == count
    assert view.texts[-1] == f"line {count - 1}"
    assert len(view.lines) <= 1000 and view.dropped > 290_000
    kept = [int(text.split()[1]) for text in view.texts]
    assert kept == sorted(kept)
    log.clear()
    assert log.view().dropped == 0, "a clear forgets it"


def test_a_progress_bar_is_one_line_in_its_last_version() -> None:
    counts: list[int] = []
    log = PrintedLog(lambda lines, dropped: counts.append(len(lines)))
    log.feed("stderr", b"before\n")
    for percent in range(101):
        log.feed("stderr", f"\r{percent:3}%|{'#' * percent}".encode())
        assert log.view().texts == ("before", f"{percent:3}%|{'#' * percent}"), "also while the bar moves"
    assert counts[1:] == [0] * (len(counts) - 1) and len(counts) < 20, (
        "the page is notified, but not of each update"
    )
    log.feed("stderr", b"\rdone\n")
    assert log.view().texts == ("before", "done")


@given(st.lists(st.binary(max_size=40), max_size=10))
def test_the_log_contains_no_control_character(pieces: list[bytes]) -> None:
    log, reported = a_log()
    for piece in pieces:
        log.feed("stdout", b"\x1b]0;" + piece + b"\x9b\n" + piece)
    text = "".join((*log.view().texts, *(line.text for line in reported)))
    assert not [c for c in text if unicodedata.category(c) == "Cc" and c != "\t"]


def test_an_ansi_style_carries_over_lines_until_its_stream_ends() -> None:
    log, reported = a_log()
    log.feed("stdout", b"\x1b[31mred\nstill\n")
    log.feed("stderr", b"plain\n")
    log.feed("stdout", b"\x1b[1mbold\x1b[0m plain\n\x1b[32m")
    log.feed("stdout", b"")
    log.feed("stdout", b"the next worker\n")
    styles = [
        [(run.text, run.style.color and run.style.color.number, run.style.bold) for run in line.runs]
        for line in reported
    ]
    assert styles[:4] == [
        [("red", 1, None)],
        [("still", 1, None)],
        [],
        [("bold", 1, True), (" plain", None, None)],
    ]
    assert styles[-1] == [] and reported[-1].text == "the next worker"


def test_a_cleared_log_is_empty_and_goes_on() -> None:
    log, reported = a_log()
    for number in range(3):
        log.feed("stdout", b"line %d\n" % number)
    assert log.tail(2) == "line 1\nline 2"
    before = log.view()
    log.clear()
    assert log.view().lines == () and log.view().serial > before.serial
    log.feed("stdout", b"after\n")
    assert log.view().texts == ("after",) and len(reported) == 4 and before.texts[-1] == "line 2"


def test_an_endless_line_is_cut() -> None:
    log, reported = a_log()
    for _ in range(10):
        log.feed("stdout", b"x" * 1000)
    log.feed("stdout", b"\nend\n")
    assert reported[-1].text == "end" and len(reported) > 2
    assert max(len(line.text) for line in reported) <= 2001
