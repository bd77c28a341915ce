from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from workbench.session.printed import PrintedLine, PrintedLog


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
    assert list(log.view().texts) == [line.text for line in told] == lines


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


def test_a_megabyte_without_an_end_of_line_is_cut() -> None:
    log, _ = a_log()
    for _ in range(5):
        log.feed("stdout", b"x" * 2**20)
    assert 0 < len(log.view().lines) <= 6
    assert all(len(text) <= 2001 for text in log.view().texts)


def test_cleared_is_empty_and_goes_on() -> None:
    log, _ = a_log()
    log.feed("stdout", b"one\n")
    before = log.view()
    log.clear()
    assert log.view().lines == () and log.view().serial > before.serial
    log.feed("stdout", b"two\n")
    assert log.view().texts == ("two",)
