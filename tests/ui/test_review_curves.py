"""The numbers beside the curves of a recording."""

from __future__ import annotations

from workbench.ui.fragments import render
from workbench.ui.numbers_table import NumberRow
from workbench.ui.review_curves import compared, known


def test_a_nan_that_the_task_returned_is_shown_and_what_the_first_state_lacks_is_not() -> None:
    assert known("NaN", 0) == "—"
    assert known("NaN", 7) == "NaN"
    assert known("0.50", 0) == known("0.50", 7) == "0.50"


def test_what_only_another_recording_has_is_in_the_table() -> None:
    old = [NumberRow("reward", "0.50", ""), NumberRow("success", "true", "", "good")]
    new = [*old[:1], NumberRow("slope", "0.10", ""), NumberRow("success", "false", "")]
    assert compared(old, [(old, 3), (new, 3)]) == [
        {"name": "reward", "mood": "", "whole": False, "hint": "", "values": ["0.50", "0.50"]},
        {"name": "success", "mood": "good", "whole": False, "hint": "", "values": ["true", "false"]},
        {"name": "slope", "mood": "", "whole": False, "hint": "", "values": ["—", "0.10"]},
    ]


def test_what_is_not_per_env_is_marked() -> None:
    phase = NumberRow("phase", "", "", whole="<b>reach", hint="not per env: str")
    other = NumberRow("phase", "", "", whole="push", hint="not per env: str")
    (row,) = table = compared([phase], [([phase], 1), ([other], 2)])
    assert (row["values"], row["whole"], row["hint"]) == (["<b>reach", "push"], True, "not per env: str")
    html = render("review_numbers", rows=table, heads=[("A", ""), ("B", "")])
    assert "not per env</span>" in html and "&lt;b&gt;reach" in html
