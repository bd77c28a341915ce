"""The worker's part in recording after the fact: what a recording would have kept of moments that are past.

The worker that does this is not the one that plays (see `session.keep_past`). Poses, actions, rewards and what
``evaluate`` returned are in the server's history; what is asked for here is the rest: env states, observations and
pictures, for which the envs are put back to where they were. They make no step, so their physics needs no fresh scene.
"""

from __future__ import annotations

import pickle

from numpy.typing import NDArray

from workbench.core.pictures import Picture
from workbench.core.state_columns import read_state_columns
from workbench.core.step_pictures import step_pictures
from workbench.session.moment_messages import Captured, CaptureMoments
from workbench.session.open_task import OpenedTask, blamed
from workbench.session.recorded_pictures import recorded_pictures


def capture_moments(opened: OpenedTask, request: CaptureMoments) -> Captured:
    """See the module's text.

    Raises:
        TaskError: a hook of the author's raised.
    """
    columns: list[dict[str, NDArray]] = []
    pictures: list[tuple[Picture, ...]] = []
    missed: dict[str, str] = {}
    wanted = recorded_pictures(opened.description.cameras) if request.pictures else ()
    for moment in request.moments:
        with blamed("restore", opened.loaded, opened.env):
            snapshot = pickle.loads(moment.snapshot)
            # All of them: what the task keeps for the batch, and the process's generators, go back with all only.
            _, report = opened.env.restore(snapshot, fresh_physics=False)
            columns.append(read_state_columns(opened.env))
        missed |= report.not_carried
        drawn: tuple[Picture, ...] = ()
        for env in moment.env_idx:
            drawn += step_pictures(opened.env, env, wanted)
        pictures.append(drawn)
    return Captured(tuple(columns), tuple(pictures), missed)
