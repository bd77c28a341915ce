"""Rescoring recordings as a value: what a page asks for, and what a job tells."""

from __future__ import annotations

from dataclasses import replace

import pytest

from workbench.live.effects import Asked
from workbench.live.process.background_jobs import StoppedBy
from workbench.live.timeline_commands import StopRescoring
from workbench.page.command import Refused
from workbench.rescore.state import EndRescoring, RescoreView, Rescoring, RescoringTold, apply_to_job

BEGUN = Rescoring().begun(RescoreView("loading", total=2, unit="episodes"))
HALF = RescoringTold(BEGUN.job, replace(BEGUN.view, state="rescoring", done=1))


def test_results_so_far_stay_when_it_is_stopped_and_the_job_changes_nothing_any_more() -> None:
    half, effects = apply_to_job(BEGUN, HALF)
    assert effects == [] and (half.view.state, half.view.done, half.view.total) == ("rescoring", 1, 2)
    stopped, effects = apply_to_job(half, Asked(StopRescoring()))
    assert effects == [EndRescoring()] and stopped.view.serial > half.view.serial
    assert (stopped.view.state, stopped.view.stopped_by, stopped.view.done) == ("stopped", StoppedBy.HAND, 1)
    late = RescoringTold(BEGUN.job, replace(HALF.view, state="done", done=2))
    assert apply_to_job(stopped, late) == (stopped, [])
    with pytest.raises(Refused):
        apply_to_job(stopped, Asked(StopRescoring()))


def test_the_next_job_begins_with_nothing_of_the_one_before() -> None:
    half, _ = apply_to_job(BEGUN, HALF)
    again = half.begun(BEGUN.view)
    assert again.view.done == 0 and again.view.serial > half.view.serial
    assert apply_to_job(again, HALF) == (again, [])
