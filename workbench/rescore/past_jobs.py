"""Rescores the history: replays its moments with the new code and compares them with the record."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from workbench.live.messages import Load
from workbench.live.process.ask import Background
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.machine.loop import do
from workbench.rescore.past_scores import RescoredPast
from workbench.rescore.state import BeginRescoring, EndRescoring, RescoreEffect, RescoreView, RescoringUpdate
from workbench.rescore.verdict import RescoredMoments, RescoreMoments

_CHUNK_SECONDS = 0.1
"""Target duration of one request to the process; progress is shown, and a stop takes effect, between
requests."""
_MAX_MOMENTS = 64
_SUMMARY_SECONDS = 0.5
"""Interval between summaries."""


class PastRescorer:
    """Rescores the history in the background process, a few moments at a time.

    A stopped job sends no more requests. If the process does not answer, for example because the new code
    hangs, the process is killed.
    """

    def __init__(self, process: Background, dispatch: Callable[[RescoringUpdate], object]) -> None:
        """
        Args:
            process: the background process; other jobs there have priority.
            dispatch: called on the loop with the events of a job.
        """
        self._process, self._dispatch = process, dispatch
        self._jobs = Jobs(lambda: None, self._failed)
        self._update = RescoringUpdate(0, RescoreView())
        """State and results of the running job, or of the last one."""
        self._past: RescoredPast | None = None

    def perform(self, effect: RescoreEffect) -> None:
        """Cancel the current job and carry out the effect; called on the loop."""
        self._jobs.stop()
        if self._past is not None:
            self._past.release()
        match effect:
            case BeginRescoring(job=number, view=view, load=load, past=past):
                self._update, self._past = RescoringUpdate(number, view), past
                self._jobs.start("rescoring", lambda job: self._rescore(job, load, past))
            case EndRescoring():
                self._past = None

    def close(self) -> None:
        """Cancel the job, and accept no further jobs."""
        do(self._jobs.close)

    def _failed(self, failure: JobFailed) -> None:
        self._send_view(state="failed", why=str(failure), problem=failure.problem)

    def _send_view(self, **values: Any) -> None:
        """Update these fields of the view, and send it."""
        self._update = replace(self._update, view=replace(self._update.view, **values))
        self._dispatch(self._update)

    # --- the job -------------------------------------------------------------------------------------

    async def _rescore(self, job: Job, load: Load, past: RescoredPast) -> None:
        summed_up, missed = 0.0, dict[str, str]()

        def on_answer(answer: RescoredMoments, seconds: float) -> None:
            nonlocal summed_up
            missed.update(answer.not_carried)
            now, done, summary = time.monotonic(), past.rescored_steps, {}
            if answer.problem is not None or done == past.steps or now - summed_up > _SUMMARY_SECONDS:
                summed_up = now
                names, differing = past.names()
                summary = {"verdicts": tuple(past.verdicts()), "names": names, "differing_names": differing}
            self._send_view(
                state="rescoring",
                done=done,
                steps=done,
                seconds=self._update.view.seconds + seconds,
                warnings=tuple(f"not restored: {what}: {why}" for what, why in missed.items()),
                **summary,
            )
            if answer.problem is not None:
                raise JobFailed("the new code raised", answer.problem)

        async def rescore_rows(rows: range) -> None:
            await self._load(job, load, past)
            await self._replay_steps(past, rows, on_answer)

        try:
            for rows in past.runs():
                await self._process.in_turns(job, partial(rescore_rows, rows), priority="low")
        finally:
            past.release()
        self._send_view(state="done")

    async def _load(self, job: Job, load: Load, past: RescoredPast) -> None:
        if self._process.has_loaded(load):
            return
        self._send_view(state="loading")
        if self._process.num_envs == past.num_envs:
            # Loading tries the new code at the env's current moment, where the last job ended. The code may
            # raise or hang there, although it works from the recorded start states. So restore a recorded
            # start state first.
            await self._ask(past, past.runs()[0][:1])
        try:
            await self._process.ensure(job, load, or_else=replace(load, level="rebuilt"))
        except JobFailed as failure:
            if failure.problem is None:
                raise
            raise JobFailed("the new code could not be loaded for rescoring", failure.problem) from failure

    async def _replay_steps(
        self, past: RescoredPast, rows: range, on_answer: Callable[[RescoredMoments, float], None]
    ) -> None:
        at, count = rows.start, 2
        while at < rows.stop:
            chunk = range(at, min(at + count, rows.stop))
            began = time.monotonic()
            answer = await self._ask(past, chunk)
            took = time.monotonic() - began
            for row, step in zip(chunk, answer.steps, strict=False):
                try:
                    past.add(row, step)
                except ValueError as error:
                    raise JobFailed(f"the episodes cannot be compared: {error}") from error
            on_answer(answer, took)
            in_time = count * _CHUNK_SECONDS / max(took, 1e-3)
            count = max(1, min(int(in_time), 2 * count, _MAX_MOMENTS))
            at = chunk.stop

    async def _ask(self, past: RescoredPast, rows: range) -> RescoredMoments:
        moments = tuple(past.moment_to_rescore(row) for row in rows)
        return await self._process.ask(RescoreMoments(moments))
