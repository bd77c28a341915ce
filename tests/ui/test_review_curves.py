"""The numbers beside the curves of a recording."""

from __future__ import annotations

from workbench.ui.review_curves import known


def test_a_nan_that_the_task_returned_is_shown_and_what_the_first_state_lacks_is_not() -> None:
    assert known("nan", 0) == "—"
    assert known("nan", 7) == "NaN"
    assert known("0.50", 0) == known("0.50", 7) == "0.50"
