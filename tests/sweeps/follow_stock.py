"""Compare one env of a batch with ManiSkill's own single CPU env, step by step from the same state under the same actions.

Both are built with the same seed, so that a task whose objects depend on the seed builds the same ones in both. Then both
unpack the same state, since ``set_state_dict`` rounds an articulation's root pose (PhysX stores it at the centre of mass).
The task's own tensors (a goal, a direction) are copied from the batch's row.

After each control step the packed PhysX states (poses, velocities, joints, drive targets) are compared byte for byte. The
reward and ``evaluate``'s entries have a tolerance, since torch sums four rows in a different order than one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.structs import Pose
from torch.utils import _pytree as pytree

from workbench.envs import action_vector as actions
from workbench.envs.partial_reset import active_controllers
from workbench.envs.task_env import EnvOptions, default_reward_mode, make_env

NUM_ENVS, PLACE = 4, 3
"""Batch size, and index of the compared env: RotateValveLevel1 repeats three kinds of valves, so env 3 equals env 0."""
STEPS = 50
TOLERANCE = 1e-5

WITH_A_RENDERER = frozenset({"PushT-v1", "DrawTriangle-v1", "DrawSVG-v1", "TableTopFreeDraw-v1"})
"""PushT recolours its table, which needs a renderer. The others create hundreds of render materials, each of which
takes 40 ms if no render device stays alive."""

MOVED_BY_THE_TASK = {
    "SO100GraspCube-v1": ("camera_mount", "moved at random by torch's one generator, all rows from one draw"),
    "MS-AntWalk-v1": ("camera_mount", "_after_control_step reads the torso before the fetch, as on the GPU"),
    "MS-AntRun-v1": ("camera_mount", "_after_control_step reads the torso before the fetch, as on the GPU"),
}
"""Bodies without collision shapes that the task places differently in a batch, and why; they are not compared."""


@dataclass(frozen=True)
class Comparison:
    """Result of `STEPS` steps side by side."""

    first_difference: int | None
    """First control step after which a byte of the packed state differed, or None."""
    first_contact: int | None
    """First control step after which two bodies of the env touched, or None."""
    state_difference: float
    """Largest absolute difference of any number of the state."""
    value_difference: float
    """Largest absolute difference of the reward or an entry of evaluate()."""
    unbatched: tuple[str, ...]
    """Entries of evaluate() without a row per env; not compared."""
    ignored: str | None
    """The body from `MOVED_BY_THE_TASK`, if any; not compared."""

    @property
    def follows(self) -> bool:
        """Whether the states agree within `TOLERANCE` in all steps, or until two bodies touched."""
        same = self.first_difference is None or self.state_difference <= TOLERANCE
        touched = self.first_contact is not None and self.first_contact <= (self.first_difference or 0)
        return same and self.value_difference <= TOLERANCE or touched

    def in_words(self) -> str:
        if self.first_difference is not None and self.state_difference > TOLERANCE:
            contact = "no contact" if self.first_contact is None else f"first contact: {self.first_contact}"
            return f"to step {self.first_difference - 1} ({contact})"
        state = "bit for bit" if self.first_difference is None else f"to {self.state_difference:.0e}"
        return state if self.value_difference == 0 else f"{state}, reward to {self.value_difference:.0e}"


def batch_of(env_id: str, num_envs: int, **kwargs: Any) -> BaseEnv:
    spec = REGISTERED_ENVS[env_id]
    options = EnvOptions(num_envs, "cpu", render=env_id in WITH_A_RENDERER, kwargs=state_only(env_id, kwargs))
    return make_env(spec.cls, options, default_kwargs=spec.default_kwargs)


def stock_env(env_id: str, **kwargs: Any) -> BaseEnv:
    reward_mode = default_reward_mode(REGISTERED_ENVS[env_id].cls)
    backend = "cpu" if env_id in WITH_A_RENDERER else "none"
    wanted = {"render_backend": backend, "reward_mode": reward_mode, **state_only(env_id, kwargs)}
    env: Any = gym.make(env_id, num_envs=1, **wanted).unwrapped
    return env


def state_only(env_id: str, kwargs: dict[str, Any]) -> dict[str, Any]:
    supported = REGISTERED_ENVS[env_id].cls.SUPPORTED_OBS_MODES
    return {"obs_mode": "state_dict" if "state_dict" in supported else "none", **kwargs}


def take_over(target: Any, target_row: int, source: Any, source_row: int, state: bytes | None = None) -> None:
    """Copy physics state, the task's tensors and controller state of one env of `source` to one env of `target`.

    PhysX does not unpack exactly what it packed, and unpacking may change the last bits again. So both envs unpack
    the same bytes: `state`, which must be the same for all envs that shall be equal.
    """
    state = _system(source, source_row).pack() if state is None else state
    _system(source, source_row).unpack(state)
    _system(target, target_row).unpack(state)
    for name, value in vars(source).items():
        _copy_row(value, getattr(target, name, None), source, source_row, target, target_row)
    for env in (source, target):
        if env.scene.gpu_sim_enabled:
            env.scene.px.note_change()
            env.scene._gpu_fetch_all()
        for controller in active_controllers(env):
            controller.reset()


def _copy_row(value: Any, there: Any, source: Any, source_row: int, target: Any, target_row: int) -> None:
    if isinstance(value, Pose) and isinstance(there, Pose):
        value, there = value.raw_pose, there.raw_pose
    if not (isinstance(value, torch.Tensor) and isinstance(there, torch.Tensor)) or value.ndim == 0:
        return
    if value.shape[0] == source.num_envs and there.shape == (target.num_envs, *value.shape[1:]):
        there[target_row] = value[source_row]


def _system(env: Any, row: int) -> Any:
    """Return the CPU physics system of one env; a stock env has only one."""
    return env.scene.px.systems[row] if env.scene.gpu_sim_enabled else env.scene.px


def packed(env: Any, row: int, without: str | None = None) -> bytes:
    """Return the packed state of one env, with zeros for the body named `without`."""
    system = _system(env, row)
    state = np.frombuffer(system.pack(), np.float32).copy()
    for i, body in enumerate(system.rigid_dynamic_components):
        if without is not None and without in body.entity.name:
            state[13 * i : 13 * i + 13] = 0
    return state.tobytes()


def touching(env: Any, row: int) -> bool:
    return any(
        np.linalg.norm(np.sum([point.impulse for point in contact.points], axis=0)) > 0
        for contact in _system(env, row).get_contacts()
    )


def flat_action(env: Any, flat: np.ndarray) -> Any:
    return actions.to_env_action(env, actions.action_parts(env), flat)


def compare(env_id: str, num_envs: int = NUM_ENVS, place: int = PLACE, seed: int = 0) -> Comparison:
    """Step env `place` of a batch and a stock env side by side; the other envs get different actions."""
    batch, stock = batch_of(env_id, num_envs), stock_env(env_id)
    try:
        batch.reset(seed=[seed + i for i in range(num_envs)], options={"reconfigure": True})
        stock.reset(seed=seed + place, options={"reconfigure": True})
        take_over(stock, 0, batch, place)
        return _side_by_side(env_id, batch, stock, place, seed)
    finally:
        batch.close()
        stock.close()


def _side_by_side(env_id: str, batch: BaseEnv, stock: BaseEnv, place: int, seed: int) -> Comparison:
    parts = actions.action_parts(batch)
    rng = np.random.default_rng(seed)
    ignored, _ = MOVED_BY_THE_TASK.get(env_id, (None, None))
    unbatched: set[str] = set()
    first_difference = first_contact = None
    state_difference = value_difference = 0.0
    for step in range(1, STEPS + 1):
        flat = actions.random_action(parts, batch.num_envs, rng)
        _, reward, terminated, _, info = batch.step(actions.to_env_action(batch, parts, flat))
        single = flat_action(stock, flat[place : place + 1])
        _, stock_reward, stock_terminated, _, stock_info = stock.step(single)
        ours, theirs = packed(batch, place, ignored), packed(stock, 0, ignored)
        if ours != theirs:
            first_difference = first_difference or step
            both = np.frombuffer(ours, np.float32), np.frombuffer(theirs, np.float32)
            state_difference = max(state_difference, float(np.abs(both[0] - both[1]).max()))
        if first_contact is None and touching(stock, 0):
            first_contact = step
        mine = {"reward": reward, "terminated": terminated, **info}
        its = {"reward": stock_reward, "terminated": stock_terminated, **stock_info}
        value_difference = max(value_difference, _difference(mine, its, place, batch.num_envs, unbatched))
    return Comparison(
        first_difference,
        first_contact,
        state_difference,
        value_difference,
        tuple(sorted(unbatched)),
        ignored,
    )


def _difference(mine: Any, its: Any, place: int, num_envs: int, unbatched: set[str]) -> float:
    """Return the largest difference between row `place` of each value and the single env's value."""
    ours, spec = pytree.tree_flatten_with_path(mine)
    theirs, their_spec = pytree.tree_flatten(its)
    if spec != their_spec:
        raise AssertionError(f"evaluate() returned different entries: {spec} and {their_spec}")
    largest = 0.0
    for (path, value), single in zip(ours, theirs, strict=True):
        value, single = torch.as_tensor(value), torch.as_tensor(single)
        if value.ndim == 0 or value.shape[0] != num_envs:
            unbatched.add(pytree.keystr(path).strip("[]'"))
            continue
        difference = (value[place].double() - single.double().reshape(value[place].shape)).abs()
        both_nan = value[place].isnan() & single.reshape(value[place].shape).isnan()
        difference = torch.where(both_nan, 0.0, difference).nan_to_num(nan=float("inf"))
        largest = max(largest, float(difference.max()) if difference.numel() else 0.0)
    return largest
