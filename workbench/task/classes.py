"""Chooses which class of a file to open: a task, or a robot in a scene if the file has no task."""

from __future__ import annotations

import difflib
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from workbench.task import registry
from workbench.task.modules import module_name
from workbench.task.problem import TaskError, task_error

if TYPE_CHECKING:
    from mani_skill.envs.sapien_env import BaseEnv

_SCENE = "Empty-v1"
"""ManiSkill's scene for viewing a robot. A file with a robot and no task opens with the robot alone in this scene."""


@dataclass(frozen=True)
class Robot:
    """An agent class that a file registers."""

    class_name: str
    uid: str


@dataclass(frozen=True)
class ChosenTask:
    cls: type[BaseEnv]
    env_id: str | None
    """Registered id; None for a class that is not registered."""
    others: tuple[str, ...]
    """Other classes of the file that can be opened by name."""
    alternatives: tuple[str, ...] = ()
    """Names in `others` to try, in order, if no class was named and `cls` cannot be opened."""
    kwargs: dict[str, Any] = field(default_factory=dict)
    """Constructor arguments in addition to the registered ones."""
    robot: Robot | None = None


def choose_task(
    module: ModuleType,
    requested: str | None,
    file: Path,
    text: str,
    registrations: registry.Registrations,
) -> ChosenTask:
    """The class `requested` of a module that was just executed. If `requested` is None: the last registered
    task, else the last task, else the last robot.

    Args:
        text: text of the file.
        registrations: registrations that the module made.

    Raises:
        TaskError: there is no such class, or no task class at all.
    """
    mine = [made for made in registrations.made if made.file == str(file)]
    registered = {made.cls: made.name for made in mine if registry.is_task(made.cls)}
    robots = {made.cls.__name__: made for made in mine if registry.is_robot(made.cls)}
    defined = [
        value
        for value in vars(module).values()
        if registry.is_task(value) and value.__module__ == module.__name__
    ]
    # Registered classes last, in the order of registration: the last candidate is the default.
    candidates = [cls for cls in dict.fromkeys(defined) if cls not in registered] + list(registered)
    names = [cls.__name__ for cls in candidates]
    if requested is None:
        if candidates:
            cls = candidates[-1]
        elif robots:
            return _robot_in_scene(module, list(robots)[-1], robots)
        else:
            raise _no_class(module, file, text)
    else:
        cls = next(
            (cls for cls in reversed(candidates) if cls.__name__ == requested),
            getattr(module, requested, None),
        )
        if requested in robots and not registry.is_task(cls):
            return _robot_in_scene(module, requested, robots)
        if not registry.is_task(cls):
            raise missing_class(requested, cls, file.name, file, names or list(robots))
    assert isinstance(cls, type)
    others = tuple(other.__name__ for other in candidates if other is not cls)
    return ChosenTask(
        cls, registered.get(cls), others, () if requested else _alternatives(cls, candidates, registered)
    )


def _alternatives(cls: type, candidates: list[type], registered: Collection[type]) -> tuple[str, ...]:
    """Classes to try if `cls` fails: the registered classes if `cls` is registered, else the
    unregistered ones. Base classes of `cls` are left out: a base may open and show nothing."""
    return tuple(
        other.__name__
        for other in reversed(candidates)
        if other is not cls and not issubclass(cls, other) and (other in registered) == (cls in registered)
    )


def _robot_in_scene(
    module: ModuleType, class_name: str, robots: dict[str, registry.Registration]
) -> ChosenTask:
    spec = registry.environment(_SCENE)
    assert spec is not None
    # A new class for each version, since the class identifies the load.
    cls = type(spec.cls.__name__, (spec.cls,), {"__module__": module.__name__})
    uid = robots[class_name].name
    others = tuple(name for name in robots if name != class_name)
    return ChosenTask(cls, _SCENE, others, kwargs={"robot_uids": uid}, robot=Robot(class_name, uid))


def robot_scene_text(robot: Robot, file: Path) -> str:
    """Notice for the author of a robot: which scene is shown, and how to open the robot in a task."""
    place = module_name(file)
    name = place.name if (file.parent / "__init__.py").is_file() else file.stem
    return (
        f"{file.name} has an agent but no task: {robot.class_name}, with the uid {robot.uid!r}, is shown in "
        f"{_SCENE}. To see it in a task, type in {place.search_folder}: "
        f"workbench open PickCube-v1 --import {name} --env robot_uids={robot.uid}"
    )


def missing_class(requested: str, found: object, name: str, file: Path, names: list[str]) -> TaskError:
    """Error for a `requested` class that is not a task class of the file or module `name`, which has the task
    classes `names`."""
    if found is not None:
        return task_error(f"{requested} in {name} is not a class that inherits BaseEnv", file)
    close = difflib.get_close_matches(requested, names, n=1)
    hint = f"did you mean {close[0]}?" if close else f"it has {', '.join(names) or 'no task class at all'}"
    return task_error(f"there is no class {requested} in {name}; {hint}", file)


def _no_class(module: ModuleType, file: Path, text: str) -> TaskError:
    name = file.name
    if all(not line.strip() or line.lstrip().startswith("#") for line in text.splitlines()):
        return task_error(
            f"{name} is empty: add a class that inherits BaseEnv; `workbench new` writes a minimal one",
            file,
        )
    imported = [value for value in vars(module).values() if registry.is_task(value)]
    robots = [
        value
        for value in vars(module).values()
        if registry.is_robot(value) and value.__module__ == module.__name__
    ]
    if robots:
        hint = (
            f"{robots[-1].__name__} is an agent that is not registered: put @register_agent() above it (from "
            "mani_skill.agents.registration) to see it in a scene"
        )
    elif imported:
        cls = imported[-1]
        hint = f"{cls.__name__} is imported from {cls.__module__}: name that file, or inherit from it here"
    else:
        hint = (
            "write `class MyTask(BaseEnv):` with BaseEnv from mani_skill.envs.sapien_env, or begin with "
            "`workbench new`"
        )
    return task_error(f"no class in {name} inherits BaseEnv; {hint}", file)
