"""What a process does once and takes long over, done before somebody waits for it.

Measured with N = 4 on two cores: to make the first env of a process and read its shapes takes 1.2 s, the second 0.12,
and the first picture of each kind of camera has its shaders compiled. Both go away by opening one of ManiSkill's own small
tasks and drawing it, whatever the author's task is: the robot's files, the render system and the shaders are
the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from workbench.authoring.problem import TaskError
from workbench.core.take_pictures import take_pictures
from workbench.session.messages import TaskOptions
from workbench.session.recorded_pictures import recorded_pictures
from workbench.session.reload import open_task

_TASK = "PickCube-v1"
"""Needs no download, has a sensor and a human camera, and the robot that most tasks have."""


def warm_up(options: TaskOptions, goes_on: Callable[[], bool]) -> None:
    """Make a small env, draw it, and throw it away; ends early when `goes_on` says no.

    It can only fail where the author's own load would (no renderer, no GPU), which then says so better.
    """
    # Of the author's own arguments the one that says whether there is anything to draw with.
    renderer = {name: value for name, value in options.env_kwargs.items() if name == "render_backend"}
    try:
        opened = open_task(_TASK, replace(options, num_envs=1, env_kwargs=renderer, imports=()))
    except TaskError:
        return
    try:
        for camera in recorded_pictures(opened.description.cameras):
            if not goes_on():
                return
            take_pictures(opened.env.env, 0, [camera])
    finally:
        opened.env.close()
