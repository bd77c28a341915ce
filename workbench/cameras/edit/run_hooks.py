"""Runs a task's camera hooks in the worker and records the place in the author's files where each camera is made."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import Any

from mani_skill.envs.sapien_env import BaseEnv

from workbench.cameras.edit.hook_cameras import FIELDS, HOOKS, PARAMETERS, HookCamera, HookCameras
from workbench.envs import maniskill_private
from workbench.envs.camera_data import CameraSettings
from workbench.pictures.placed_cameras import settings_of
from workbench.source.definitions import Project
from workbench.source.parsed import RefusedEdit, Trace
from workbench.source.read_values import trace_call

RecordedCalls = dict[int, tuple[Any, CameraSettings | None, Trace | None]]
"""Each config, the settings that it was made with, and the trace of its call, by the config's ``id``."""


@contextmanager
def recording_calls(sources: Mapping[str, str]) -> Iterator[RecordedCalls]:
    """Record every camera config that is made in the context, with a trace if the call is in these texts."""
    project, recorded = Project(sources), RecordedCalls()

    def note(config: Any, frame: FrameType) -> None:
        values = {name: getattr(config, name) for name in FIELDS}
        recorded[id(config)] = config, settings_of(config), trace_call(project, frame, PARAMETERS, values)

    with maniskill_private.noting_cameras(note):
        yield recorded


def run_hooks(env: Any, sources: Mapping[str, str]) -> HookCameras:
    """Run the camera hooks of an env whose classes were made from these texts. Raises RefusedEdit."""
    if moved := maniskill_private.why_not(maniskill_private.WRITING):
        raise RefusedEdit(moved)
    with recording_calls(sources) as recorded:
        configs = maniskill_private.camera_configs(env)
    return HookCameras(
        {key: hook_camera(config, recorded) for key, config in configs.items()},
        owners(maniskill_private.task_class(env)),
    )


def hook_camera(config: Any, recorded: RecordedCalls) -> HookCamera:
    _, made, trace = recorded.get(id(config), (None, None, None))
    name = getattr(config.mount, "name", None)
    mount = f"{config.entity_uid} {name if isinstance(name, str) else type(config.mount).__name__}"
    return HookCamera(made, settings_of(config), mount, maniskill_private.camera_site(config), trace)


def owners(task: type) -> dict[str, tuple[str, str]]:
    """Name and file of the class that defines each hook, see `HookCameras`."""
    found: dict[str, tuple[str, str]] = {}
    for hook in HOOKS:
        cls = next((cls for cls in task.__mro__ if hook in vars(cls)), None)
        if cls is not None and cls is not BaseEnv:
            found[hook] = cls.__name__, str(getattr(sys.modules.get(cls.__module__), "__file__", ""))
    return found
