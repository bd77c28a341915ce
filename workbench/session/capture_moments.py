"""The worker's part in recording after the fact: what a recording would have kept of moments that are past.

The worker that does this is not the one that plays (see `session.keep_past`). Poses, actions, rewards and what
``evaluate`` returned are in the server's history; what is asked for here is the rest: env states, observations and
pictures, for which the envs are put back to where they were. They make no step, so their physics needs no fresh scene.
"""

from __future__ import annotations

import pickle

from workbench.core.state_columns import read_state_columns
from workbench.core.step_pictures import step_pictures
from workbench.session.moment_messages import Captured, CaptureMoment
from workbench.session.open_task import OpenedTask, blamed
from workbench.session.recorded_pictures import recorded_pictures


def capture_moment(opened: OpenedTask, request: CaptureMoment) -> Captured:
    """See the module's text.

    Raises:
        TaskError: a hook of the author's raised.
    """
    with blamed("restore", opened.loaded, opened.env):
        # All of them: what the task keeps for the batch, and the process's generators, go back with all only.
        opened.env.restore(pickle.loads(request.snapshot), fresh_physics=False)
        columns = read_state_columns(opened.env)
    wanted = recorded_pictures(opened.description.cameras) if request.pictures else ()
    drawn = [picture for env in request.env_idx for picture in step_pictures(opened.env, env, wanted)]
    return Captured(columns, tuple(drawn))
