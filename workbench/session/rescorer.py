"""Recorded episodes judged again for a page.

It groups the episodes by the env that they are judged in, has the process load one after the other and judge its episodes,
and gathers what it says. To stop is to end the process: what is known by then stays. It ends with the job: the code of
recordings is not to stay.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from workbench.authoring.problem import TaskError
from workbench.authoring.reference import TaskName, named_file
from workbench.recording.sources import Source
from workbench.session.askers import Background
from workbench.session.clearance import Clearances
from workbench.session.judging import JudgedView, Judging
from workbench.session.lane import Job, JobFailed
from workbench.session.messages import Load, TaskOptions
from workbench.session.rescore import (
    Group,
    group_episodes,
    hidden_in_words,
    judge_each,
    not_judged,
    with_renderer,
)
from workbench.session.rescore_messages import Rescore, Rescored
from workbench.session.step_back import CannotStepIn
from workbench.session.verdict import Verdict

MOST_AT_ONCE = 16
"""Envs."""
MOST_NAMED = 3
"""Of the versions that are judged with, where there are many."""


class Rescorer:
    """Judges recordings."""

    def __init__(self, clearances: Clearances | None = None, base: TaskOptions | None = None) -> None:
        """
        Args:
            clearances: says what of the code that recordings name may run; None asks nobody.
            base: what is the same for all that is opened.
        """
        self.judging = Judging("rescore")
        self._process = Background()
        self._clearances = clearances or Clearances()
        self._base = base or TaskOptions()

    def start(
        self,
        files: Sequence[Source],
        *,
        file: Path | None = None,
        recorded_source: bool = False,
        use_env_states: bool = False,
    ) -> None:
        """Judge these; see `group_episodes` for the arguments."""
        if not files:
            return

        def work(job: Job) -> None:
            groups, unread = group_episodes(
                files, MOST_AT_ONCE, self._base, file=file, recorded_source=recorded_source
            )
            notes = [f"with {_judged_with(group)}" for group in groups[:MOST_NAMED]]
            notes += [f"and {len(groups) - MOST_NAMED} more"] if len(groups) > MOST_NAMED else []
            notes += dict.fromkeys(g.note for g in groups if g.note)
            self._tell(job, unread, state="asking", notes=tuple(notes))
            try:
                self._judge_all(job, groups, use_env_states)
            except CannotStepIn as error:
                raise JobFailed(str(error)) from error
            finally:
                self._process.end()  # with the code that the recordings named

        self.judging.begin(JudgedView("loading", total=len(files), unit="episodes"), work)

    # --- on the lane ---------------------------------------------------------------------------------

    def _judge_all(self, job: Job, groups: list[Group], use_env_states: bool) -> None:
        cleared = self._clearances.clear_all([group.wanted for group in groups], lambda: job.stopped)
        job.check()

        def failed(group: Group, error: JobFailed | TaskError | CannotStepIn) -> None:
            why = str(error)
            if isinstance(error, JobFailed) and error.problem is not None:
                why += f": {error.problem.message}"
            self._tell(job, not_judged(group, self.judging.view.verdicts, why))

        judge_each(groups, cleared, lambda group, task: self._judge(job, group, task, use_env_states), failed)

    def _judge(self, job: Job, group: Group, reference: TaskName, use_env_states: bool) -> None:
        process = self._process
        warnings = tuple(dict.fromkeys((*self.judging.view.warnings, *hidden_in_words(reference))))
        self._tell(job, state="loading", task=_judged_with(group), warnings=warnings)
        # Never patched into what the last episodes were judged in.
        load = Load(reference, group.options, level="rebuilt")
        try:
            process.ensure(job, load, or_else=replace(load, options=with_renderer(group.options)))
        except JobFailed as failure:
            if failure.problem is None:
                raise
            raise JobFailed(
                f"{group.info.task} could not be opened to judge with", failure.problem
            ) from failure
        self._tell(job, state="judging")
        began, before, steps = time.monotonic(), self.judging.view.seconds, self.judging.view.steps

        def told(now: Rescored) -> None:
            seconds = before + time.monotonic() - began
            self._tell(job, now.verdicts, steps=steps + now.steps, seconds=seconds)

        question = Rescore(group.files, use_env_states)
        last = process.ask(job.check, question, lambda done, total, now: told(now))
        told(last)
        if last.problem is not None:
            raise JobFailed(f"the code of {group.info.task} raised", last.problem)

    def _tell(self, job: Job, verdicts: Iterable[Verdict[Source]] = (), **values: Any) -> None:
        """What is new, and these verdicts besides those that are known."""
        known = (*self.judging.view.verdicts, *verdicts)
        self.judging.tell(job, verdicts=known, done=len(known), **values)


def _judged_with(group: Group) -> str:
    """What is opened, in words."""
    if group.recorded_source:
        return f"{group.info.task} as it was recorded"
    file = named_file(group.reference)
    return f"{group.info.task} as it is installed" if file is None else f"{group.info.task} of {file}"
