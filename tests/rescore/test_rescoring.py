"""Rescoring of recordings as a state machine: commands of a page, and reports of a job."""

from __future__ import annotations

from dataclasses import replace

import pytest

from workbench.live.effects import Asked
from workbench.live.process.background_jobs import StoppedBy
from workbench.live.timeline_commands import StopRescoring
from workbench.page.command import Refused
from workbench.rescore.state import EndRescoring, RescoreView, Rescoring, RescoringUpdate, apply_to_job

BEGUN = Rescoring().begun(RescoreView("loading", total=2, unit="episodes"))
HALF = RescoringUpdate(BEGUN.job, replace(BEGUN.view, state="rescoring", done=1))


def test_a_stopped_rescoring_keeps_its_results_and_ignores_late_reports() -> None:
    half, effects = apply_to_job(BEGUN, HALF)
    assert effects == [] and (half.view.state, half.view.done, half.view.total) == ("rescoring", 1, 2)
    stopped, effects = apply_to_job(half, Asked(StopRescoring()))
    assert effects == [EndRescoring()] and stopped.view.serial > half.view.serial
    assert (stopped.view.state, stopped.view.stopped_by, stopped.view.done) == ("stopped", StoppedBy.USER, 1)
    late = RescoringUpdate(BEGUN.job, replace(HALF.view, state="done", done=2))
    assert apply_to_job(stopped, late) == (stopped, [])
    with pytest.raises(Refused):
        apply_to_job(stopped, Asked(StopRescoring()))


def test_the_next_job_begins_without_results() -> None:
    half, _ = apply_to_job(BEGUN, HALF)
    again = half.begun(BEGUN.view)
    assert again.view.done == 0 and again.view.serial > half.view.serial
    assert apply_to_job(again, HALF) == (again, [])
