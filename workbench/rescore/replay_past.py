"""Rescores moments of the history with the code of the open task."""

from __future__ import annotations

import pickle

from workbench.envs.step_result import StepResult
from workbench.rescore.verdict import RescoredMoments, RescoreMoments
from workbench.task.blame import blamed
from workbench.task.open import OpenedTask
from workbench.task.problem import TaskError


def rescore_moments(opened: OpenedTask, request: RescoreMoments) -> RescoredMoments:
    """Replay the moments of `request` in order; stops at the first one that raises, and returns its problem."""
    steps: list[StepResult] = []
    missed: dict[str, str] = {}
    for moment in request.moments:
        try:
            if moment.snapshot is None:
                with blamed("step", opened.loaded, opened.env):
                    steps.append(opened.env.step(moment.action))
                continue
            snapshot = pickle.loads(moment.snapshot)
            with blamed("restore", opened.loaded, opened.env):
                step, report = opened.env.restore(snapshot, moment.env_idx, moment.env_idx)
        except TaskError as error:
            return RescoredMoments(tuple(steps), missed, error.problem)
        steps.append(step)
        if len(moment.env_idx) == opened.env.num_envs:
            # Not for a jump of some envs: such a jump never restores state of the whole batch, and did not
            # when the history was recorded either.
            missed |= report.not_carried
    return RescoredMoments(tuple(steps), missed)
