"""What ``workbench rescore`` prints, on terminals that are wide and narrow."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from workbench.cli.jobs.rescore import print_verdicts
from workbench.jobs.rescore.verdict import Verdict
from workbench.recording.episode.row import Source

NAME = "WorkbenchPushCube-v1_seed626610453_env00_2026-11-22T01-07-22"
VERDICTS = [
    Verdict(
        Source(Path("a.json"), None, "a", NAME), seed=626610453, length=30, returns=(3.268, 4.902), metres=0.0
    ),
    Verdict(Source(Path("b.json"), None, "b", NAME + "-2"), why_not="it does not hold the text of its task"),
]


@pytest.mark.parametrize("width", [60, 80, 200])
def test_names_are_whole_on_a_terminal_of_any_width(width: int) -> None:
    out = io.StringIO()
    print_verdicts(VERDICTS, Console(file=out, width=width))
    lines = out.getvalue().splitlines()
    beginnings = [line for line in lines if line.startswith("Workbench")]
    assert [line.split()[0] for line in beginnings] == [NAME, NAME + "-2"]
    assert "3.268 → 4.902" in out.getvalue() and "626610453" in out.getvalue()
    assert (lines[0].split()[0] == "episode") == (width == 200), "a table where there is room for one"


def test_of_many_only_those_that_differ_are_listed() -> None:
    alike = Verdict(
        Source(Path("c.json"), None, "c", "same"), seed=1, length=30, returns=(1.0, 1.0), metres=0.0
    )
    differs = replace(VERDICTS[0], first_difference=3, differing=("reward",))
    out = io.StringIO()
    print_verdicts([*[alike] * 40, differs], Console(file=out, width=200))
    assert "same" not in out.getvalue() and NAME in out.getvalue()
    assert "40 that do not differ are not listed; --csv-file lists all" in out.getvalue()
    out = io.StringIO()
    print_verdicts([alike] * 3, Console(file=out, width=200))
    assert out.getvalue().count("same") == 3
