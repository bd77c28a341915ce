"""Questions to a worker without a task: scenes of recordings, and the list of tasks with their pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from workbench.envs.scene.shapes import SceneGeometry
from workbench.machine.processes.wire import Question


@dataclass(frozen=True)
class SceneMade:
    geometry: SceneGeometry
    poses: NDArray[np.float32]
    """(T + 1, B, 7) poses."""
    missed: tuple[str, ...]
    """States that could not be written into the env, each with its reason."""


@dataclass(frozen=True)
class MakeScene(Question[SceneMade]):
    """Make a recording's env in a worker without a task, and put it into each recorded state."""

    part: ClassVar[Any] = str
    task: str
    """Registered id of the task."""
    files: tuple[str, ...]
    """Task files to search before ManiSkill's registry."""
    env_kwargs: dict[str, Any]
    seed: int
    reset_options: dict[str, Any]
    env_states: dict[str, NDArray]
    """(T + 1, D) states by name."""
    imports: tuple[str, ...] = ()
    """Modules to import, as in `TaskOptions.imports`."""


@dataclass(frozen=True)
class ListTasks(Question[tuple[str, ...]]):
    """The ids that ManiSkill registers."""


@dataclass(frozen=True)
class TaskPicture:
    """A picture of a task, or why there is none."""

    pixels: NDArray[np.uint8] | None = None
    """(H, W, 3) pixels."""
    why_not: str = ""
    needs_download: bool = False
    """Whether the task or its robot lacks files that ManiSkill can download."""


@dataclass(frozen=True)
class DrawTask(Question[TaskPicture]):
    """Draw a picture of a registered task after a reset, by its human camera, or else by its first sensor."""

    env_id: str
