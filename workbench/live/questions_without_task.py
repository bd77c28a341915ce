"""Questions for a worker without a task: scenes of recordings, and the list of tasks with their pictures."""

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
    """States that could not be set in the env, each with its reason."""


@dataclass(frozen=True)
class MakeScene(Question[SceneMade]):
    """Build a recording's env in a worker without a task, and read the poses at each recorded state."""

    part: ClassVar[Any] = str
    task: str
    """Registered id of the task."""
    files: tuple[str, ...]
    """Task files in which to look for the task before ManiSkill's registry."""
    env_kwargs: dict[str, Any]
    seed: int
    reset_options: dict[str, Any]
    env_states: dict[str, NDArray]
    """(T + 1, D) states by name."""
    imports: tuple[str, ...] = ()
    """Modules to import, as in `TaskOptions.imports`."""


@dataclass(frozen=True)
class ListTasks(Question[tuple[str, ...]]):
    """List the ids that ManiSkill registers."""


@dataclass(frozen=True)
class TaskPicture:
    """A picture of a task, or the reason why there is none."""

    pixels: NDArray[np.uint8] | None = None
    """(H, W, 3) pixels."""
    why_not: str = ""
    needs_download: bool = False
    """Whether the task or its robot lacks files that ManiSkill can download."""


@dataclass(frozen=True)
class DrawTask(Question[TaskPicture]):
    """Reset a registered task, and render it with its human camera, or with its first sensor if it has no
    such camera."""

    env_id: str
