"""In the process that runs the author's code: what the camera hooks give, and where in the files it stands."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import Any

from mani_skill.envs.sapien_env import BaseEnv

from workbench.authoring.camera_source.cameras import FIELDS, HOOKS, PARAMETERS, CameraRun, Ran
from workbench.authoring.source.names import Project
from workbench.authoring.source.read_values import trace_call
from workbench.authoring.source.trace import Trace
from workbench.core import maniskill_private
from workbench.core.camera_data import CameraSettings
from workbench.core.cameras.place import settings_of

Noted = dict[int, tuple[Any, CameraSettings | None, Trace | None]]
"""By identity of a config: it, what it was made with, and its call."""


@contextmanager
def noting_calls(sources: Mapping[str, str]) -> Iterator[Noted]:
    """Within this every camera config that these texts make is noted."""
    project, noted = Project(sources), Noted()

    def note(config: Any, frame: FrameType) -> None:
        values = {name: getattr(config, name) for name in FIELDS}
        noted[id(config)] = config, settings_of(config), trace_call(project, frame, PARAMETERS, values)

    with maniskill_private.noting_cameras(note):
        yield noted


def run_hooks(env: Any, sources: Mapping[str, str]) -> Ran:
    """Calls the hooks of an env whose classes were made of these texts."""
    with noting_calls(sources) as noted:
        configs = maniskill_private.camera_configs(env)
    return Ran(
        {key: camera_run(config, noted) for key, config in configs.items()},
        owners(maniskill_private.task_class(env)),
    )


def camera_run(config: Any, noted: Noted) -> CameraRun:
    _, made, trace = noted.get(id(config), (None, None, None))
    name = getattr(config.mount, "name", None)
    mount = f"{config.entity_uid} {name if isinstance(name, str) else type(config.mount).__name__}"
    return CameraRun(made, settings_of(config), mount, maniskill_private.camera_site(config), trace)


def owners(task: type) -> dict[str, tuple[str, str]]:
    """See `Ran.owners`."""
    found: dict[str, tuple[str, str]] = {}
    for hook in HOOKS:
        cls = next((cls for cls in task.__mro__ if hook in vars(cls)), None)
        if cls is not None and cls is not BaseEnv:
            found[hook] = cls.__name__, str(getattr(sys.modules.get(cls.__module__), "__file__", ""))
    return found
