"""Numbers, lengths and lists as text for people."""

from __future__ import annotations

import io

import pytest

from workbench.machine.text import (
    SafeStream,
    length,
    listed,
    mean_text,
    nonfinite_text,
    number_text,
    of,
    rate_text,
    short_line,
)

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        *[(number_text(value), text) for value, text in ((0.25, "0.25"), (NAN, "NaN"), (INF, "infinite"))],
        (number_text(-INF), "-infinite"),
        (number_text(1.23456, ".2f"), "1.23"),
        *[(rate_text(value), text) for value, text in (
            (5125.4, "5 125"), (1234567.0, "1 234 567"), (240.0, "240"), (9.95, "10"), (9.94, "9.9"),
            (0.93, "0.93"), (0.045, "0.045"), (0.0, "0"),
        )],
        (nonfinite_text([1.0, 2.0]), ""),
        (nonfinite_text([[NAN, INF], [-INF, 1.0]]), "NaN in 1, infinite in 2 of 4"),
        (nonfinite_text([NAN, NAN, 0.0]), "NaN in 2 of 3"),
        (mean_text([0.0, 0.5, NAN, NAN]), "0.25, NaN in 2 of 4"),
        (mean_text([1.0, 3.0], lambda mean: f"<{mean:.0f}>"), "<2>"),
        (mean_text([NAN]), "NaN in 1 of 1"),
        *[(length(metres), text) for metres, text in (
            (0.0, "0"), (INF, "infinite"), (2.0, "2 m"), (1.0, "1 m"), (0.032, "3.2 cm"), (0.0099, "9.9 mm"),
            (0.0001, "0.1 mm"), (0.00005, "50 µm"), (7e-8, "70 nm"),
        )],
        (of(3, 32, "seed"), "3 of 32 seeds"),
        (of(0, 1, "seed"), "0 of 1 seed"),
        (listed([1, 2, 3]), "1, 2, 3"),
        (listed(range(5)), "0, 1, 2, 3, 4"),
        (listed(range(6)), "0, 1, 2, 3, 4 ..."),
        (listed("abc", 2), "a, b ..."),
        (short_line("abcdef", 6), "abcdef"),
        (short_line("abcdefghij", 6), "abc ... hij"),
        (short_line("a\nb\x1b", 6), "a\\nb\\x1b"),
    ],
)  # fmt: skip
def test_values_are_shown_as_people_write_them(shown: str, expected: str) -> None:
    assert shown == expected


def test_a_safe_stream_escapes_each_line_and_is_its_stream_otherwise() -> None:
    raw = io.StringIO()
    stream = SafeStream(raw)
    assert stream.write("a\x1b[2J\n") == len("a\x1b[2J\n")
    stream.writelines(["\x1b[31mred\x1b[0m", "\x07"])
    assert stream.getvalue() == "a\\x1b[2J\n\x1b[31mred\x1b[0m\\x07"
