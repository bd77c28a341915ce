from __future__ import annotations

import viser

from tests.ui.scenes import running
from workbench.session.kept_worker import Vitals
from workbench.session.printed import NOTHING_PRINTED, Printed, PrintedLine
from workbench.ui.log_panel import LINES_SHOWN, LogPanel, log_html, vitals_html

LINES = (
    PrintedLine("stdout", "reward 0.5"),
    PrintedLine("stderr", "a Warning"),
    PrintedLine("stdout", "done"),
)


def draw(panel: LogPanel, printed: Printed) -> str:
    panel._drawn_at = 0.0
    panel.draw(running(2, printed=printed))
    return panel._html.content


def test_lines_stand_in_order_with_their_stream() -> None:
    html = log_html(Printed(1, LINES, 0), "")
    assert html.index("reward 0.5") < html.index("a Warning") < html.index("done")
    assert html.count("wb-stderr") == 1 and "too fast" not in html


def test_the_filter_takes_text_in_any_case_or_a_stream() -> None:
    def kept(wanted: str) -> list[str]:
        html = log_html(Printed(1, LINES, 0), wanted)
        return [line.text for line in LINES if f">{line.text}<" in html]

    assert kept("WARN") == ["a Warning"]
    assert kept("stderr:") == ["a Warning"]
    assert kept("stdout: done") == ["done"]
    assert kept("nothing like it") == []


def test_a_flood_is_shown_by_its_end_and_its_number() -> None:
    lines = tuple(PrintedLine("stdout", f"line {i}.") for i in range(1000))
    html = log_html(Printed(1, lines, 1234567), "")
    assert html.count('title="stdout"') == LINES_SHOWN and "line 999." in html and "line 0." not in html
    assert "1 234 567 more" in html and "lines. <" in html


def test_what_was_printed_is_text() -> None:
    evil = "<script>alert(1)</script>"
    html = log_html(Printed(1, (PrintedLine("stdout", evil),), 0), evil)
    assert "<script" not in html


def test_held_still_it_waits_and_cleared_it_does_not(server: viser.ViserServer) -> None:
    cleared: list[bool] = []
    panel = LogPanel(server, lambda: cleared.append(True))
    draw(panel, NOTHING_PRINTED)
    assert not panel._filter.visible and not panel._clear.visible
    assert "reward" in draw(panel, Printed(1, LINES[:1], 0))
    panel._hold.value = True
    assert "Warning" not in draw(panel, Printed(2, LINES[:2], 0))
    panel._on_clear(lambda: cleared.append(True))
    assert panel._filter.visible
    assert cleared and "Nothing printed" in draw(panel, Printed(3, (), 0))


def test_memory_is_said_of_both_processes() -> None:
    html = vitals_html(Vitals(700 * 2**20, 8 * 2**30, 800 * 2**20, False))
    assert all(part in html for part in ("700 MB of 8.0 GB", "spare worker 800 MB", "being warmed up"))
    assert "spare" not in vitals_html(Vitals(700 * 2**20, None, None, False))
