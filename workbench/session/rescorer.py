"""Recorded episodes judged again for a page: in a process of its own, with progress, and to be stopped.

A lane's thread does all of it. It groups the episodes by the env that they are judged in, has the process load one after
the other and judge its episodes, and gathers what it says. To stop is to end the process: what is known by then stays.
It ends with the job: the code of recordings is not to stay.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from workbench.authoring.reference import TaskName, named_file
from workbench.session.askers import Background
from workbench.session.calls import Progress
from workbench.session.clearance import Clearances, NotCleared
from workbench.session.judging import RUNNING, JudgedView, StoppedBy
from workbench.session.lane import Job, JobFailed, Lane
from workbench.session.messages import Load, TaskOptions
from workbench.session.rescore import Group, group_episodes, hidden_in_words, not_judged, with_renderer
from workbench.session.rescore_messages import EpisodeFile, Rescore, Rescored
from workbench.session.step_back import CannotStepIn, write_source

MOST_AT_ONCE = 16
"""Envs."""
MOST_NAMED = 3
"""Of the versions that are judged with, where there are many."""


@dataclass(frozen=True)
class _Asked:
    files: tuple[EpisodeFile, ...]
    file: Path | None
    recorded_source: bool
    use_env_states: bool


class Rescorer:
    """One judgement at a time; a new one takes the place of the one before. All methods return at once."""

    def __init__(self, clearances: Clearances | None = None, base: TaskOptions | None = None) -> None:
        """
        Args:
            clearances: says what of the code that recordings name may run; None asks nobody.
            base: what is the same for all that is opened.
        """
        self._clearances = clearances or Clearances()
        self._base = base or TaskOptions()
        self._lock = threading.Lock()
        """Of `view`: what a job that was stopped still has to say is not heard."""
        self._view = JudgedView()
        self._process = Background()
        # `_run` tells of failures itself, with what the code raised.
        self._lane = Lane("rescore", lambda: None, lambda why: None)

    @property
    def view(self) -> JudgedView:
        return self._view

    def start(
        self,
        files: Sequence[EpisodeFile],
        *,
        file: Path | None = None,
        recorded_source: bool = False,
        use_env_states: bool = False,
    ) -> None:
        """Judge these; see `group_episodes` for the arguments."""
        if not files:
            return
        asked = _Asked(tuple(files), file, recorded_source, use_env_states)
        with self._lock:
            # Under the lock, or the job might tell how far it is before it is said that it begins.
            self._lane.start("judging", lambda job: self._run(job, asked))
            self._view = JudgedView(
                "loading",
                self._view.serial + 1,
                total=len(files),
                unit="episodes",
            )

    def stop(self) -> None:
        """Go no further; what is known by now stays to be seen."""
        with self._lock:
            self._lane.stop()
            if self._view.state in RUNNING:
                why = StoppedBy.HAND
                self._view = replace(
                    self._view, state="stopped", stopped_by=why, why=why.value, serial=self._view.serial + 1
                )

    def close(self) -> None:
        """End it all; returns when the thread has ended."""
        self._lane.close()

    # --- on the lane ---------------------------------------------------------------------------------

    def _run(self, job: Job, asked: _Asked) -> None:
        try:
            groups, unread = group_episodes(
                asked.files,
                MOST_AT_ONCE,
                self._base,
                file=asked.file,
                recorded_source=asked.recorded_source,
            )
            notes = [f"with {_judged_with(group, asked)}" for group in groups[:MOST_NAMED]]
            notes += [f"and {len(groups) - MOST_NAMED} more"] if len(groups) > MOST_NAMED else []
            notes += dict.fromkeys(g.note for g in groups if g.note)
            self._tell(job, state="asking", verdicts=tuple(unread), notes=tuple(notes))
            cleared = self._clearances.clear_all([group.wanted for group in groups], lambda: job.stopped)
            job.check()
            failed = 0
            for group, reference in zip(groups, cleared):
                try:
                    if isinstance(reference, NotCleared):
                        raise JobFailed(str(reference)) from reference
                    self._judge(job, asked, group, reference)
                except JobFailed as failure:
                    failed += 1
                    if failed == len(groups):
                        raise
                    why = str(failure)
                    if failure.problem is not None:
                        why += f": {failure.problem.message}"
                    verdicts = self._view.verdicts
                    self._tell(job, verdicts=(*verdicts, *not_judged(group, verdicts, why)))
            self._tell(job, state="done")
        except JobFailed as failure:
            self._tell(job, state="failed", why=str(failure), problem=failure.problem)
        except Exception as error:
            self._tell(
                job, state="failed", why=f"it failed within the workbench ({type(error).__name__}: {error})"
            )
            raise
        finally:
            self._process.end()  # with the code that the recordings named

    def _judge(self, job: Job, asked: _Asked, group: Group, reference: TaskName) -> None:
        process = self._process
        folder: Path | None = None
        try:
            if asked.recorded_source:
                folder, reference = write_source(group.info)
            warnings = tuple(dict.fromkeys((*self._view.warnings, *hidden_in_words(reference))))
            self._tell(job, state="loading", task=_judged_with(group, asked), warnings=warnings)
            # Never patched into what the last episodes were judged in.
            load = Load(reference, group.options, level="rebuilt")
            try:
                process.ensure(job, load, or_else=replace(load, options=with_renderer(group.options)))
            except JobFailed as failure:
                if failure.problem is None:
                    raise
                why = f"{group.info.task} could not be opened to judge with"
                raise JobFailed(why, failure.problem) from failure
            self._tell(job, state="judging")
            began, before, steps = time.monotonic(), self._view.seconds, self._view.steps

            def on_progress(at: Progress) -> None:
                told(at.part)

            def told(now: Rescored) -> None:
                self._tell(
                    job,
                    verdicts=(*self._view.verdicts, *now.verdicts),
                    steps=steps + now.steps,
                    seconds=before + time.monotonic() - began,
                )

            last = process.ask(job.check, Rescore(group.files, asked.use_env_states), on_progress)
            told(last)
            if last.problem is not None:
                raise JobFailed(f"the code of {group.info.task} raised", last.problem)
        except CannotStepIn as error:
            raise JobFailed(str(error)) from error
        finally:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)

    def _tell(self, job: Job, **values: object) -> None:
        with self._lock:
            if job.stopped:
                return
            view = replace(self._view, serial=self._view.serial + 1, **values)  # type: ignore[arg-type]
            self._view = replace(view, done=len(view.verdicts))


def _judged_with(group: Group, asked: _Asked) -> str:
    """What is opened, in words."""
    if asked.recorded_source:
        return f"{group.info.task} as it was recorded"
    file = named_file(group.reference)
    return f"{group.info.task} as it is installed" if file is None else f"{group.info.task} of {file}"
