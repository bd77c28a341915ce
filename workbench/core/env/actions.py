"""The action of a task as a flat vector with names, bounds and a hold value."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from mani_skill.agents.controllers.base_controller import CombinedController
from mani_skill.agents.controllers.pd_ee_pose import PDEEPosController
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosController
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.core.broken_rule import place_of_class
from workbench.core.error_notes import RefusedCall
from workbench.core.scene.scene_index import once_a_scene

_EE_AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class ActionPart:
    """The slice of the flat action that one controller of one robot reads."""

    robot: str | None
    """Key of the action dict for several robots, else None."""
    controller: Any
    """A ManiSkill BaseController."""
    names: tuple[str, ...]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    shape: tuple[int, ...]
    """Of the controller's action of one env, which has a row of the flat one."""


@once_a_scene
def action_parts(env: BaseEnv) -> tuple[ActionPart, ...]:
    """Parts in the order of the flat action; empty without a robot.

    Raises:
        RefusedCall: a controller's action is not an array of numbers.
    """
    if env.agent is None:
        return ()
    controllers: Any = env.agent.controller
    robots = controllers.items() if isinstance(controllers, dict) else [(None, controllers)]
    parts = []
    for robot, controller in robots:
        combined = isinstance(controller, CombinedController)
        named = controller.controllers.items() if combined else [(None, controller)]
        for name, part in named:
            space: Any = part.single_action_space
            if not isinstance(space, spaces.Box):
                raise RefusedCall(
                    f"The action space of {type(part).__name__} is {space}: the workbench acts in a Box only.",
                    place=place_of_class(type(part)),
                )
            prefix = "/".join(str(p) for p in (robot, name) if p is not None)
            dimensions = [f"{prefix}/{d}" if prefix else d for d in _dimension_names(part)]
            low, high = (np.asarray(bound, np.float32).ravel() for bound in (space.low, space.high))
            parts.append(ActionPart(robot, part, tuple(dimensions), low, high, space.shape))
    return tuple(parts)


def bounds(parts: tuple[ActionPart, ...]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(A,) lowest and (A,) highest value of the flat action."""
    if not parts:
        return np.zeros(0, np.float32), np.zeros(0, np.float32)
    return np.concatenate([p.low for p in parts]), np.concatenate([p.high for p in parts])


def width(parts: tuple[ActionPart, ...]) -> int:
    """Width A of the flat action."""
    return sum([len(part.names) for part in parts])


def action_of(
    parts: tuple[ActionPart, ...], num_envs: int, rows: Mapping[int, NDArray]
) -> NDArray[np.float32]:
    """(N, A) with these rows (A,) by env, zeros elsewhere."""
    action = np.zeros((num_envs, width(parts)), np.float32)
    for env, row in rows.items():
        action[env] = row
    return action


def random_action(
    parts: tuple[ActionPart, ...], num_envs: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """(N, A) uniform within the bounds; dimensions without bounds are drawn from -1 to 1."""
    low, high = bounds(parts)
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    return rng.uniform(low, high, (num_envs, len(low))).astype(np.float32)


def hold_action(parts: tuple[ActionPart, ...], num_envs: int) -> NDArray[np.float32]:
    """(N, A) the action that leaves every joint where it is, as far as the controllers can say.

    Zero is not that: it is a half-open gripper, and in absolute joint control the middle of the limits. Delta and velocity controllers: zero. Absolute joint position: the present qpos, through the
    inverse of ManiSkill's ``clip_and_scale_action``. Absolute end-effector pose: zero, since its
    inverse would need the controller's frame; hold such a robot with ``step(None)``.
    """
    columns = [_hold(part, num_envs) for part in parts]
    return np.concatenate(columns, axis=1) if columns else np.zeros((num_envs, 0), np.float32)


def to_env_action(env: BaseEnv, parts: tuple[ActionPart, ...], flat: NDArray[np.float32]) -> Any:
    """The argument of ``env.step``: a tensor (N, A), a dict of them for several robots, None without a robot."""
    if not parts:
        return None
    action = torch.from_numpy(np.ascontiguousarray(flat, dtype=np.float32)).to(env.device)
    return by_robot(parts, action)


def by_robot(parts: tuple[ActionPart, ...], action: torch.Tensor) -> Any:
    """The argument of ``env.step`` of a flat action (N, A): itself, a dict of parts for several robots, None without a robot."""
    if not parts:
        return None
    split = torch.split(action, [len(p.names) for p in parts], dim=1)
    of_robots: dict[str | None, list[torch.Tensor]] = {}
    for part, columns in zip(parts, split, strict=True):
        # Several controllers of one robot share a flat action.
        of_robots.setdefault(part.robot, []).append(columns.reshape(len(columns), *part.shape))
    made = {robot: each[0] if len(each) == 1 else torch.cat(each, 1) for robot, each in of_robots.items()}
    return made[None] if None in made else made


def to_flat_action(
    env: BaseEnv, parts: tuple[ActionPart, ...], action: Any, whose: str = "the action"
) -> NDArray[np.float32]:
    """(N, A) from a policy's action: array or tensor, (A,) or (N, A), or a dict of robots.

    Args:
        whose: subject of error messages.

    Raises:
        ValueError: the shape does not fit, or a value is not finite.
    """
    if isinstance(action, dict):
        robots = dict.fromkeys(p.robot for p in parts)
        action = np.concatenate([_numpy(action[robot]) for robot in robots], axis=-1)
    flat = _numpy(action)
    expected = (env.num_envs, width(parts))
    if flat.shape == expected[1:]:
        flat = np.broadcast_to(flat, expected)
    if flat.shape != expected:
        raise ValueError(_wrong_shape(whose, flat.shape, expected, env.control_mode))
    # The sum is quick, but may overflow.
    if not math.isfinite(np.add.reduce(flat, axis=None)) and not np.isfinite(flat).all():
        raise ValueError(f"{whose} holds NaN or infinity")
    return np.array(flat)


def _wrong_shape(whose: str, shape: tuple[int, ...], expected: tuple[int, int], mode: Any) -> str:
    problem = f"{whose} has shape {shape}, expected {expected} (envs, dimensions)"
    if not shape or shape[-1] == expected[1]:
        return problem
    # Several robots have one mode each.
    modes = ", ".join(f"{one}" for one in mode.values()) if isinstance(mode, dict) else str(mode)
    return (
        f"{problem}: it is {shape[-1]} wide, and the control mode {modes} takes {expected[1]}. Name the one that it is written "
        "for with --env control_mode=..., or return as many"
    )


def _numpy(values: Any) -> NDArray[np.float32]:
    values = values.numpy(force=True) if isinstance(values, torch.Tensor) else values
    return np.asarray(values, dtype=np.float32)


def _dimension_names(controller: Any) -> list[str]:
    count = math.prod(controller.single_action_space.shape)
    if isinstance(controller, PDEEPosController):
        names: list[str] = list(_EE_AXES)
    else:
        names = [joint.name for joint in getattr(controller, "joints", ())]
        controlled = getattr(controller, "control_joint_indices", None)
        if controlled is not None:
            names = [names[i] for i in controlled.tolist()]
    return names[:count] if len(names) >= count else [f"{i}" for i in range(count)]


def _hold(part: ActionPart, num_envs: int) -> NDArray[np.float32]:
    controller: Any = part.controller
    count = len(part.names)
    if not _is_joint_position(controller) or controller.config.use_delta:
        return np.zeros((num_envs, count), np.float32)
    qpos = controller.qpos
    controlled = getattr(controller, "control_joint_indices", None)
    if controlled is not None:
        qpos = qpos[:, controlled.long()]
    if controller.config.normalize_action:
        low, high = controller.action_space_low, controller.action_space_high
        qpos = (2 * qpos - (high + low)) / (high - low)
    return np.clip(qpos.cpu().numpy(), part.low, part.high).astype(np.float32)


def _is_joint_position(controller: object) -> bool:
    return isinstance(controller, PDJointPosController) and not isinstance(controller, PDEEPosController)
