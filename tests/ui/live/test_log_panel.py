from __future__ import annotations

from tests.drive.panels import Clock, Panels
from tests.ui.scenes import running
from workbench.session.process.captured_output import NOTHING_PRINTED, Printed, PrintedLine
from workbench.session.process.supervisor import Vitals
from workbench.ui.live.log_panel import LINES_SHOWN, LogPanel, log_html, vitals_html
from workbench.ui.widgets.parts import Parts

LINES = (
    PrintedLine("stdout", "reward 0.5"),
    PrintedLine("stderr", "a Warning"),
    PrintedLine("stdout", "done"),
)


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


def test_held_still_it_waits_and_cleared_it_does_not(panels: Panels, clock: Clock) -> None:
    cleared: list[bool] = []
    panel = LogPanel(panels.server, lambda: cleared.append(True))

    parts = Parts((panel,), clock)

    def drawn(printed: Printed) -> str:
        clock.passes()
        parts.draw(running(2, printed=printed))
        return panels.html()

    drawn(NOTHING_PRINTED)
    assert not panels.shows("Filter") and not panels.shows("Clear")
    assert "reward" in drawn(Printed(1, LINES[:1], 0))
    panels.set("Pause", True)
    assert "Warning" not in drawn(Printed(2, LINES[:2], 0))
    panels.set("Filter", "Warn")
    assert "Warning" in drawn(Printed(2, LINES[:2], 0)), "the filter is of what stands there"
    assert panels.shows("Filter")
    panels.press("Clear")
    assert cleared and "Nothing printed" in drawn(Printed(3, (), 0))


def test_memory_is_said_of_both_processes() -> None:
    html = vitals_html(Vitals(700 * 2**20, 8 * 2**30, 800 * 2**20, False))
    assert all(part in html for part in ("700 MB of 8.0 GB", "spare worker 800 MB", "warming up"))
    assert "spare" not in vitals_html(Vitals(700 * 2**20, None, None, False))
