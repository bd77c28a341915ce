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
from mani_skill.agents.controllers.pd_ee_pose import PDEEPosController, PDEEPoseController
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosController
from mani_skill.agents.controllers.pd_joint_pos_vel import PDJointPosVelController
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.geometry.rotation_conversions import matrix_to_euler_angles, quaternion_to_matrix
from numpy.typing import NDArray

from workbench.envs import maniskill_private
from workbench.envs.broken_rule import place_of_class
from workbench.envs.error_notes import RefusedCall, WrongAction
from workbench.envs.evaluate_entries import describe, type_text
from workbench.envs.scene.scene_index import once_a_scene
from workbench.machine.text import listed

_EE_AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class ActionPart:
    """The slice of the flat action that one controller of one robot reads."""

    robot: str | None
    """The robot's key in the action dict; None unless there are several robots."""
    controller: Any
    """A ManiSkill BaseController."""
    names: tuple[str, ...]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    shape: tuple[int, ...]
    """Shape of the controller's action for one env; the flat action contains that action flattened."""


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
                    f"The action space of {type(part).__name__} is {space}: the workbench supports Box "
                    "spaces only.",
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
    """(N, A) action from `rows`, which has (A,) numbers by env index; zeros for envs without a row."""
    action = np.zeros((num_envs, width(parts)), np.float32)
    for env, row in rows.items():
        action[env] = row
    return action


def random_action(
    parts: tuple[ActionPart, ...], num_envs: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """(N, A) uniform random numbers: within the bounds, or from -1 to 1 where a bound is infinite."""
    low, high = bounds(parts)
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    return rng.uniform(low, high, (num_envs, len(low))).astype(np.float32)


def hold_action(parts: tuple[ActionPart, ...], num_envs: int) -> NDArray[np.float32]:
    """(N, A) the action that leaves every joint where it is, as far as the controllers allow.

    A zero action does not hold: it opens a gripper by half, and absolute joint control moves to the middle of
    the limits.

    * Delta and velocity controllers: zero.
    * Absolute joint position: the present qpos, through the inverse of ManiSkill's ``clip_and_scale_action``.
    * Absolute end-effector pose: the present pose.
    """
    columns = [_hold(part, num_envs) for part in parts]
    return np.concatenate(columns, axis=1) if columns else np.zeros((num_envs, 0), np.float32)


def to_env_action(env: BaseEnv, parts: tuple[ActionPart, ...], flat: NDArray[np.float32]) -> Any:
    """The argument of ``env.step``: a tensor (N, A), or a dict of tensors by robot if there are several; None
    without a robot."""
    if not parts:
        return None
    action = torch.from_numpy(np.ascontiguousarray(flat, dtype=np.float32)).to(env.device)
    return by_robot(parts, action)


def by_robot(parts: tuple[ActionPart, ...], action: torch.Tensor) -> Any:
    """The argument of ``env.step`` for a flat action (N, A): a tensor, or a dict of tensors by robot if there
    are several; None without a robot."""
    if not parts:
        return None
    split = torch.split(action, [len(p.names) for p in parts], dim=1)
    of_robots: dict[str | None, list[torch.Tensor]] = {}
    for part, columns in zip(parts, split, strict=True):
        # The controllers of one robot share that robot's flat action.
        of_robots.setdefault(part.robot, []).append(columns.reshape(len(columns), *part.shape))
    made = {robot: each[0] if len(each) == 1 else torch.cat(each, 1) for robot, each in of_robots.items()}
    return made[None] if None in made else made


def to_flat_action(env: BaseEnv, parts: tuple[ActionPart, ...], action: Any) -> NDArray[np.float32]:
    """(N, A) from a policy's action: an array or tensor (A,) or (N, A), or a dict of these by robot.

    Raises:
        WrongAction: the action is something else, its shape does not fit, or a value is not finite.
    """
    count, of_robots = env.num_envs, _columns_of_robots(parts)
    if isinstance(action, Mapping):
        _refuse_other_robots(action, of_robots)
        each = [_rows(action[robot], count, at, f" for {robot}") for robot, at in of_robots.items()]
        flat = np.concatenate(each, axis=1)
    else:
        flat = _rows(action, count, sum(of_robots.values()), "", of_robots, env.control_mode)
    # Fast test: a finite sum means that all numbers are finite. Otherwise test each number, since the sum of
    # finite numbers may overflow.
    with np.errstate(over="ignore"):
        total = np.add.reduce(flat, axis=None)
    if not math.isfinite(total) and not (finite := np.isfinite(flat)).all():
        row, column = np.argwhere(~finite)[0].tolist()
        name = [name for part in parts for name in part.names][column]
        raise WrongAction(
            f"holds NaN or infinity in {np.count_nonzero(~finite.all(axis=1))} of {count} envs: {flat[row, column]} for {name} "
            f"of env {row}"
        )
    return np.array(flat)


def _columns_of_robots(parts: tuple[ActionPart, ...]) -> dict[str | None, int]:
    """Width of each robot's action, by robot; the key is None for a single robot."""
    found: dict[str | None, int] = {}
    for part in parts:
        found[part.robot] = found.get(part.robot, 0) + len(part.names)
    return found


def _refuse_other_robots(action: Mapping[Any, Any], of_robots: Mapping[str | None, int]) -> None:
    if None in of_robots or not of_robots:
        what = f"an array ({of_robots[None]} wide)" if of_robots else "no action"
        raise WrongAction(
            f"is a dict of {listed([*action])}; this task does not have several robots and takes {what}"
        )
    missing = [robot for robot in of_robots if robot not in action]
    unknown = [name for name in action if name not in of_robots]
    if not missing and not unknown:
        return
    robots = ", ".join(f"{robot} ({wide} wide)" for robot, wide in of_robots.items())
    lacks = [f"has no action for {listed(missing)}"] if missing else []
    lacks += [f"names {listed(unknown)}, which the task does not have"] if unknown else []
    raise WrongAction(f"{' and '.join(lacks)}; its robots are {robots}")


def _rows(
    given: Any,
    count: int,
    wide: int,
    of: str,
    of_robots: Mapping[str | None, int] | None = None,
    mode: Any = None,
) -> NDArray[np.float32]:
    """(N, wide) numbers of an action that is given as (wide,) or (N, wide).

    Args:
        of: text for messages that names the robot.

    Raises:
        WrongAction: the action is not an array of numbers, or has another shape.
    """
    values = _numpy(given, of)
    if values.shape == (wide,):
        return np.broadcast_to(values, (count, wide))
    if values.shape == (count, wide):
        return values
    text = f"has shape {values.shape}{of}, expected {(count, wide)} (envs, dimensions)"
    if values.ndim and values.shape[-1] != wide and of_robots is not None:
        text += f": it is {values.shape[-1]} wide"
        if None in of_robots:
            text += (
                f", and the control mode {mode} takes {wide}. Choose the policy's own mode with "
                "--env control_mode=..., or as Control on the page (Run tab, How the envs are made), or return "
                f"{wide} numbers"
            )
        else:
            robots = ", ".join(f"{robot} {each}" for robot, each in of_robots.items())
            text += (
                f", and the robots take {robots}. Return a dict of their actions, or one array with all "
                "actions side by side"
            )
    raise WrongAction(text)


def _numpy(values: Any, of: str = "") -> NDArray[np.float32]:
    try:
        if values is None:
            raise TypeError
        values = values.float().numpy(force=True) if isinstance(values, torch.Tensor) else values
        return np.asarray(values, dtype=np.float32)
    except (TypeError, ValueError, RuntimeError) as error:  # text, an object, rows of different lengths
        # The policies of some libraries return a tuple of action and state.
        what = (
            f"tuple of {', '.join(map(type_text, values))}" if isinstance(values, tuple) else describe(values)
        )
        raise WrongAction(f"is {what}{of}: an action is an array of numbers (envs, dimensions)") from error


def _dimension_names(controller: Any) -> list[str]:
    count = math.prod(controller.single_action_space.shape)
    if isinstance(controller, PDEEPosController):
        names: list[str] = list(_EE_AXES)
    else:
        names = [joint.name for joint in _controlled_joints(controller)]
    return names[:count] if len(names) >= count else [f"{i}" for i in range(count)]


def _controlled_joints(controller: Any) -> list[Any]:
    """The controller's joints, without those that mimic another joint."""
    joints = [*getattr(controller, "joints", ())]
    controlled = getattr(controller, "control_joint_indices", None)
    return joints if controlled is None else [joints[i] for i in controlled.tolist()]


def target_joints(part: ActionPart) -> list[Any]:
    """The joints whose absolute positions are the numbers of this part; empty for other controllers."""
    controller = part.controller
    # End-effector controllers inherit from joint controllers.
    of_joints = _is_absolute(controller) and not isinstance(controller, PDEEPosController)
    return _controlled_joints(controller) if of_joints else []


def is_target(parts: tuple[ActionPart, ...]) -> NDArray[np.bool_]:
    """(A,) True for absolute joint positions and end-effector poses: each stays the target until the next action."""
    columns = [np.full(len(part.names), _is_absolute(part.controller)) for part in parts]
    return np.concatenate(columns) if columns else np.zeros(0, bool)


def zero_holds(part: ActionPart) -> bool:
    """Whether an action of zero leaves the joints of this controller where they are: True for deltas and
    velocities."""
    return bool(getattr(part.controller.config, "use_delta", True))


def _hold(part: ActionPart, num_envs: int) -> NDArray[np.float32]:
    controller: Any = part.controller
    if not _is_absolute(controller):
        return np.zeros((num_envs, len(part.names)), np.float32)
    if isinstance(controller, PDEEPosController):
        pose = controller.ee_pose_at_base
        wanted = pose.p
        if isinstance(controller, PDEEPoseController):
            wanted = torch.hstack([pose.p, matrix_to_euler_angles(quaternion_to_matrix(pose.q), "XYZ")])
        held = unscaled(part, wanted.cpu().numpy())
    else:
        qpos: Any = controller.qpos
        controlled = getattr(controller, "control_joint_indices", None)
        if controlled is not None:
            qpos = qpos[:, controlled.long()]
        if isinstance(controller, PDJointPosVelController):
            qpos = torch.cat([qpos, torch.zeros_like(qpos)], dim=1)
        if controller.config.normalize_action:
            low: Any = controller.action_space_low
            high: Any = controller.action_space_high
            qpos = (2 * qpos - (high + low)) / (high - low)
        held = qpos.cpu().numpy()
    return np.clip(held, part.low, part.high).astype(np.float32)


def unscaled(part: ActionPart, wanted: NDArray[Any]) -> NDArray[Any]:
    """(N, D) numbers of the action that the part's controller scales to `wanted` (N, D), without bounds: the inverse of its
    affine map."""
    at_zero, at_half = (
        maniskill_private.scaled_action(
            part.controller, torch.full(wanted.shape, number, device=part.controller.device)
        )
        .cpu()
        .numpy()
        for number in (0.0, 0.5)
    )
    return (wanted - at_zero) / (2 * (at_half - at_zero))


def _is_absolute(controller: Any) -> bool:
    return isinstance(controller, PDJointPosController) and not controller.config.use_delta
