"""Builds 3-D scenes for recordings without one, and renders registered tasks, in a worker without a task."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from workbench.live.messages import CannotAnswer
from workbench.live.questions_without_task import MakeScene, SceneMade, TaskPicture
from workbench.live.worker.pacing import throttled

if TYPE_CHECKING:
    from workbench.envs.task_env import TaskEnv

_PROGRESS_PERIOD_SECONDS = 0.2
"""Interval of progress messages."""


class SceneEnv:
    """Builds scenes of recordings. Keeps the env: the next episode may have the same task and options."""

    def __init__(self) -> None:
        self._made: tuple[object, TaskEnv] | None = None

    def scene(self, request: MakeScene, on_progress: Callable[[int, int, str], None]) -> SceneMade:
        """The scene of a recording.

        Args:
            on_progress: called with done, total and the activity.

        Raises:
            CannotAnswer: the scene cannot be made.
        """
        key = (request.task, request.files, repr(sorted(request.env_kwargs.items())))
        try:
            if self._made is None or self._made[0] != key:
                if self._made is not None:
                    self._made[1].close()
                    self._made = None
                on_progress(0, 0, f"making {request.task}")
                self._made = (key, make(request))
            return scene_of(self._made[1], request, on_progress)
        except CannotAnswer:
            raise
        except Exception as error:
            traceback.print_exc()
            raise CannotAnswer(
                f"The scene of {request.task} could not be made ({type(error).__name__}: {_line(error)}), so there "
                "are numbers and curves only."
            ) from error


def make(request: MakeScene) -> TaskEnv:
    """One env of the recorded task, built with the recording's options."""
    from workbench.envs.task_env import EnvOptions, TaskEnv, make_env
    from workbench.task.load import import_modules, load_task
    from workbench.task.problem import TaskError
    from workbench.task.reference import RecordedTask

    try:
        import_modules(request.imports)
    except TaskError as error:
        raise CannotAnswer(error.problem.message) from error
    loaded = None
    for file in request.files:
        try:
            found = load_task(file)
            loaded = found if found.env_id == request.task or loaded is None else loaded
            if found.env_id != request.task and request.task in found.others:
                loaded = load_task(f"{file}:{request.task}")
        except TaskError as error:
            raise CannotAnswer(f"{Path(file).name} cannot be loaded: {error.problem.message}") from error
    if loaded is None or loaded.env_id != request.task:
        try:
            loaded = load_task(RecordedTask(request.task))  # a registered id, never a path
        except TaskError as error:
            raise CannotAnswer(
                f"There is no env {request.task} here, so there is no scene, only numbers and curves. If the "
                "env is yours, name its file (workbench review --task FILE) or the package that registers it "
                "(workbench review --import PACKAGE)."
            ) from error
    try:
        env = make_env(
            loaded.cls,
            EnvOptions(
                num_envs=1, backend="cpu", rules="off", kwargs={**request.env_kwargs, "obs_mode": "none"}
            ),
            default_kwargs=loaded.default_kwargs,
        )
    except BaseException as error:  # a constructor may end the program (SystemExit)
        traceback.print_exc()
        raise CannotAnswer(
            f"{request.task} cannot be made here ({type(error).__name__}: {_line(error)}), so there are numbers and "
            "curves only."
        ) from error
    return TaskEnv(env)


def scene_of(env: TaskEnv, request: MakeScene, on_progress: Callable[[int, int, str], None]) -> SceneMade:
    """The geometry, and the poses of every body at each recorded state."""
    from workbench.envs.scene.read_scene import read_geometry
    from workbench.envs.scene.scene_index import read_poses
    from workbench.episodes.recorded_state import state_mismatches, write_states

    seed = request.seed if request.seed >= 0 else None
    env.reset(seed=seed, options=request.reset_options)
    geometry = read_geometry(env.env)
    states = request.env_states
    count = min(len(values) for values in states.values())
    poses: list[Any] = []
    report = throttled(on_progress, _PROGRESS_PERIOD_SECONDS)
    missed = (
        state_mismatches(env.env, 0, {name: values[0] for name, values in states.items()}) if count else {}
    )
    for row in range(count):
        report(row, count, f"setting state {row} of {count - 1}")
        write_states(env.env, {0: {name: values[row] for name, values in states.items()}})
        poses.append(read_poses(env.env)[0])
    return SceneMade(geometry, np.stack(poses), tuple(f"{name}: {why}" for name, why in missed.items()))


def registered_ids() -> tuple[str, ...]:
    """The ids that ManiSkill registers when it is imported."""
    from workbench.task.registry import environment_ids

    return tuple(environment_ids())


def draw_task(env_id: str) -> TaskPicture:
    """Render a registered task after a reset."""
    from workbench.envs.assets import MissingAssets
    from workbench.envs.task_env import EnvOptions, TaskEnv, make_env
    from workbench.pictures.render import list_cameras, take_pictures
    from workbench.task.load import load_task
    from workbench.task.problem import is_ctrl_c
    from workbench.task.reference import RecordedTask

    env: TaskEnv | None = None
    try:
        loaded = load_task(RecordedTask(env_id))  # never a path
        options = EnvOptions(num_envs=1, backend="cpu", rules="off", kwargs={"obs_mode": "none"})
        assets, kwargs = loaded.asset_ids, loaded.default_kwargs
        env = TaskEnv(make_env(loaded.cls, options, asset_ids=assets, default_kwargs=kwargs))
        env.reset(seed=0)
        cameras = sorted(list_cameras(env.env), key=lambda camera: camera.kind != "human")
        seen = [camera for camera in cameras if "rgb" in camera.modalities]
        if not seen:
            return TaskPicture(why_not="The task has no camera, or there is no renderer.")
        (picture,) = take_pictures(env.env, 0, [(seen[0].name, seen[0].kind, ("rgb",))])
        return TaskPicture(picture.rgb, "" if picture.rgb is not None else "The camera renders no colours.")
    except MissingAssets as error:
        return TaskPicture(why_not=" ".join(str(error).split()), needs_download=True)
    except BaseException as error:  # a constructor may end the program (SystemExit)
        if is_ctrl_c(error):
            raise
        return TaskPicture(why_not=f"{type(error).__name__}: {_line(error)}")
    finally:
        if env is not None:
            env.close()


def _line(error: BaseException) -> str:
    return (str(error).strip() or "no reason given").splitlines()[0][:300]
