"""The output of ``workbench rescore`` on wide and narrow terminals."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from workbench.cli.rescore import print_verdicts
from workbench.episodes.row import Source
from workbench.rescore.verdict import Verdict

NAME = "WorkbenchPushCube-v1_seed626610453_env00_2026-11-22T01-07-22"
VERDICTS = [
    Verdict(
        Source(Path("a.json"), None, "a", NAME), seed=626610453, length=30, returns=(3.268, 4.902), metres=0.0
    ),
    Verdict(Source(Path("b.json"), None, "b", NAME + "-2"), why_not="it does not hold the text of its task"),
]


@pytest.mark.parametrize("width", [60, 80, 200])
def test_names_are_not_truncated_on_a_terminal_of_any_width(width: int) -> None:
    out = io.StringIO()
    print_verdicts(VERDICTS, Console(file=out, width=width))
    lines = out.getvalue().splitlines()
    beginnings = [line for line in lines if line.startswith("Workbench")]
    assert [line.split()[0] for line in beginnings] == [NAME, NAME + "-2"]
    assert "3.268 → 4.902" in out.getvalue() and "626610453" in out.getvalue()
    assert (lines[0].split()[0] == "episode") == (width == 200), "a table where there is room for one"
