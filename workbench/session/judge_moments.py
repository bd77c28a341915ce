"""The worker's part in judging the past again: live through recorded moments with the code that it has.

The worker that does this is not the one that plays (see `session.judge`). It is handed a few moments at a time: a
jump, where chosen envs are put back to a snapshot, or a control step with the action that was made then. What the
task says of each goes back as it is; comparing is the server's work, which has the record.
"""

from __future__ import annotations

import pickle

from workbench.authoring.problem import TaskError
from workbench.core.step import StepResult
from workbench.session.open_task import OpenedTask, restore_checked, step_checked
from workbench.session.questions import Judged, JudgeMoments


def judge_moments(opened: OpenedTask, request: JudgeMoments) -> Judged:
    """Live through the moments of `request`, in order; stops at the first that raises, which is then told."""
    steps: list[StepResult] = []
    missed: dict[str, str] = {}
    for moment in request.moments:
        try:
            if moment.snapshot is None:
                steps.append(step_checked(opened.env, opened.loaded, moment.action))
                continue
            snapshot = pickle.loads(moment.snapshot)
            step, report = restore_checked(
                opened.env, opened.loaded, snapshot, moment.env_idx, moment.env_idx
            )
        except TaskError as error:
            return Judged(tuple(steps), missed, error.problem)
        steps.append(step)
        if len(moment.env_idx) == opened.env.num_envs:
            # With some of the envs what holds for the whole batch is never put back: neither was it in the record.
            missed |= report.not_carried
    return Judged(tuple(steps), missed)
