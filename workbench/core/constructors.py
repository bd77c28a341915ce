"""A constructor that leaves out its parent's: found by what is missing after it, and told at its ``def``."""

from __future__ import annotations

import inspect
from typing import Any

from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.multi_agent import MultiAgent
from mani_skill.envs.sapien_env import BaseEnv

from workbench.core.broken_rule import Place, in_brackets


class ForgottenInit(RuntimeError):
    """Without it nothing is there, and the first use of anything fails far away ("weak reference to 'NoneType'")."""

    def __init__(self, message: str, place: Place | None) -> None:
        super().__init__(message)
        self.place = place


def refuse_unbuilt_env(env: BaseEnv, task: type[BaseEnv], num_envs: int) -> None:
    """After the constructor of `task`.

    Raises:
        ForgottenInit: ``BaseEnv.__init__`` was not called, or not with the number of envs.
    """
    if env.scene is None:
        cls, place = _culprit(task, BaseEnv)
        raise ForgottenInit(
            f"{cls.__name__}.__init__ ends without super().__init__(*args, **kwargs), so nothing was built"
            f"{in_brackets(place)}. Call it there, behind what the hooks need of it: ManiSkill builds the scene and resets in it.",
            place,
        )
    if env.num_envs != num_envs:
        cls, place = _first(task, BaseEnv)
        raise ForgottenInit(
            f"{num_envs} envs were asked for and {env.num_envs} built: {cls.__name__}.__init__ does not hand num_envs on"
            f"{in_brackets(place)}. Give its keyword arguments to super().__init__(*args, **kwargs).",
            place,
        )


def refuse_unbuilt_agent(agent: Any) -> None:
    """After ``_load_agent``.

    Raises:
        ForgottenInit: ``BaseAgent.__init__`` was not called.
    """
    for robot in agent.agents if isinstance(agent, MultiAgent) else [agent]:
        if isinstance(robot, BaseAgent) and not hasattr(robot, "robot"):
            cls, place = _culprit(type(robot), BaseAgent)
            raise ForgottenInit(
                f"{cls.__name__}.__init__ ends without super().__init__(*args, **kwargs), so the robot was not loaded"
                f"{in_brackets(place)}. Call it there.",
                place,
            )


def _culprit(cls: type, base: type) -> tuple[type, Place | None]:
    """The first class whose constructor names no other, or else the first that has one."""
    own = _own(cls, base)
    for owner in own:
        if "__init__" not in vars(owner)["__init__"].__code__.co_names:
            return owner, _place(owner)
    return _first(cls, base)


def _first(cls: type, base: type) -> tuple[type, Place | None]:
    own = _own(cls, base)
    return (own[0], _place(own[0])) if own else (cls, None)


def _own(cls: type, base: type) -> list[type]:
    return [
        owner
        for owner in cls.__mro__[: cls.__mro__.index(base)]
        if hasattr(vars(owner).get("__init__"), "__code__")
    ]


def _place(owner: type) -> Place:
    code = inspect.unwrap(vars(owner)["__init__"]).__code__
    return code.co_filename, code.co_firstlineno, "__init__"
