"""States that random actions seldom reach: joints and bodies are put there, and the task's hooks are asked again."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sapien.physx
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import common
from numpy.typing import NDArray

from workbench.checks.evidence.checkup import Checkup, leaf_rows
from workbench.envs import action_vector as actions
from workbench.envs import maniskill_private
from workbench.envs.evaluate_entries import split_entries
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.simulation.state_layout import BODY
from workbench.envs.snapshots.snapshot import remembering
from workbench.envs.task_env import TaskEnv
from workbench.episodes.recorded_state import read_states, write_states
from workbench.task.blame import blamed, returns_check

BATCHES = 2
"""Batches of seeds whose states are changed."""
MARGIN_METRES = 0.15
"""Metres beyond where bodies begin."""
HEIGHT_METRES = 0.3
"""Metres above where a body begins."""
KINDS = ("right after the reset", "with joints and bodies at random places", "with joints at their limits")
MAX_GOALS = 4
"""A drawing has hundreds of marks."""
AT_GOAL = "with bodies at the place of {}"
SHORT = "on the way back from a success to the reset"
HALVINGS = 6
"""Of the way back: the last states are within a 64th of it from where success ends."""
DENSE_HOOKS = {"dense": "compute_dense_reward", "normalized_dense": "compute_normalized_dense_reward"}

States = dict[str, NDArray[np.float32]]
"""(N, D) by name, as `read_states` gives them."""


@dataclass
class OddStates:
    """What the hooks gave in R rounds of N envs. Rounds of one seed are of one episode: its goal stays."""

    seeds: list[list[int]] = field(default_factory=list)
    """(R, N)"""
    kinds: list[str] = field(default_factory=list)
    """(R,) where joints and bodies were, for a sentence."""
    evaluate: list[dict[str, NDArray]] = field(default_factory=list)
    """(R,) of (N, ...) each."""
    reward: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    """(R, N) by reward mode: the present one, and the dense ones that the class has."""
    obs: list[dict[str, NDArray[np.float64]]] = field(default_factory=list)
    """(R,) of (N, D) by leaf, pictures left out."""
    told: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    """As `reward`, where evaluate() is said to have reported success in all envs; NaN where the reward raised then. Empty where
    evaluate() has no success."""


def odd_states(checkup: Checkup) -> OddStates:
    """Evidence for `Checkup.look`: the first seeds, in each of the `KINDS` and with the bodies at each goal."""
    task, rng, seen = checkup.task, np.random.default_rng(0), OddStates()
    for seeds in [*checkup.batches()][:BATCHES]:
        checkup.reset(task, seeds)
        begun = read_states(task.env)
        rounds = [(kind, _changed(task.env, begun, kind, rng)) for kind in KINDS]
        for goal in _goals(task.env)[:MAX_GOALS]:
            rounds.append((AT_GOAL.format(goal.partition("/")[2]), _at(task.env, begun, goal)))
        for kind, states in rounds:
            succeeded = _put(checkup, kind, states, seeds, rng, seen)
            if not succeeded.any():
                continue
            with_success, without = np.zeros(len(seeds)), np.ones(len(seeds))
            for _ in range(HALVINGS):
                share = (with_success + without) / 2
                there = _put(checkup, SHORT, _between(states, begun, share), seeds, rng, seen)
                with_success, without = np.where(there, share, with_success), np.where(there, without, share)
    return seen


def _put(
    checkup: Checkup, kind: str, states: States, seeds: list[int], rng: np.random.Generator, seen: OddStates
) -> NDArray[np.bool_]:
    """Put all envs into these states and ask the hooks; (N,) where that is a success."""
    task = checkup.task
    write_all(task.env, states)
    action = actions.random_action(task.parts, task.num_envs, rng)
    seen.seeds.append(seeds)
    seen.kinds.append(kind)
    with blamed("step", checkup.loaded, task):
        _ask(checkup, task, action, seen)
    success = seen.evaluate[-1].get("success", np.zeros(task.num_envs, bool))
    return np.logical_or.reduce(success.reshape(task.num_envs, -1).astype(bool), axis=1)


def write_all(env: BaseEnv, states: States) -> None:
    """Put all envs into these states."""
    write_states(env, {i: {name: rows[i] for name, rows in states.items()} for i in range(env.num_envs)})


def _ask(checkup: Checkup, task: TaskEnv, action: NDArray[np.float32], seen: OddStates) -> None:
    for mode in reward_modes(checkup):
        with remembering(task.env):
            info = task.env.get_info()
            obs: Any = task.env.get_obs(info, unflattened=True)
            given: Any = None
            if task.parts:
                flat = actions.to_env_action(task.env, task.parts, action)
                given = common.to_tensor(flat, device=task.env.device)
            if mode == reward_modes(checkup)[0]:
                seen.evaluate.append(split_entries(info, task.num_envs)[0])
                seen.obs.append(leaf_rows(obs, task.num_envs))
            hook = getattr(task.env, DENSE_HOOKS[mode]) if mode in DENSE_HOOKS else task.env.get_reward
            reward = hook(obs=obs, action=given, info=info)
        returns_check(checkup.loaded, task.num_envs)(info, reward)
        seen.reward.setdefault(mode, []).append(_rows(reward, task.num_envs))
        if "success" in info:
            with remembering(task.env):
                _tell_success(seen, mode, hook, obs, given, info, task.num_envs)


def _tell_success(
    seen: OddStates, mode: str, hook: Any, obs: Any, action: Any, info: dict[str, Any], num_envs: int
) -> None:
    success = info["success"]
    told = {**info, "success": torch.ones_like(success) if isinstance(success, torch.Tensor) else True}
    try:
        rows = _rows(hook(obs=obs, action=action, info=told), num_envs)
    except Exception:
        # No fault of the task: this state has no success. What else a success means may be missing in it.
        rows = np.full(num_envs, np.nan)
    seen.told.setdefault(mode, []).append(rows)


def _rows(reward: Any, num_envs: int) -> NDArray[np.float64]:
    """(N,)"""
    return np.broadcast_to(torch.as_tensor(reward).double().numpy(force=True), (num_envs,)).copy()


def reward_modes(checkup: Checkup) -> list[str]:
    """The present reward mode, then the dense ones that the class has."""
    cls, present = checkup.loaded.cls, checkup.task.env.reward_mode
    own = [mode for mode, hook in DENSE_HOOKS.items() if getattr(cls, hook) is not getattr(BaseEnv, hook)]
    return [present, *(mode for mode in own if mode != present and mode in cls.SUPPORTED_REWARD_MODES)]


# --- the states ----------------------------------------------------------------------------------------------


def _changed(env: BaseEnv, begun: States, kind: str, rng: np.random.Generator) -> States:
    if kind == KINDS[0]:
        return begun
    low, high = _box(env, begun)
    states: States = {}
    for name, rows in begun.items():
        struct = scene_index(env).states.get(name)
        states[name] = rows = rows.copy()
        if struct is not None and name.startswith("articulations/"):
            rows[:, BODY:] = _joints(struct, len(rows), rng, at_limits=kind == KINDS[2])
        elif struct is not None and struct.px_body_type == "dynamic" and kind == KINDS[1]:
            here = np.isfinite(rows).all(axis=1)
            highest = rows[:, 2:3] + HEIGHT_METRES
            places = np.concatenate([np.tile(low[:2], (len(rows), 1)), rows[:, 2:3]], axis=1)
            spans = np.concatenate([np.tile(high[:2], (len(rows), 1)), highest], axis=1) - places
            turned = rng.normal(size=(len(rows), 4))
            turned /= np.linalg.norm(turned, axis=1, keepdims=True)
            pose = np.concatenate([places + rng.random((len(rows), 3)) * spans, turned], axis=1)
            rows[here, :7], rows[here, 7:] = pose[here], 0
    return states


def _box(env: BaseEnv, begun: States) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(3,) lowest and highest place of what moves, and `MARGIN_METRES` it."""
    places = [
        rows[np.isfinite(rows).all(axis=1), :3]
        for name, rows in begun.items()
        if name.startswith("actors/") and scene_index(env).states[name].px_body_type == "dynamic"
    ]
    if not places:
        return np.full(3, -MARGIN_METRES, np.float32), np.full(3, MARGIN_METRES, np.float32)
    together = np.concatenate(places)
    return together.min(axis=0) - MARGIN_METRES, together.max(axis=0) + MARGIN_METRES


def _joints(articulation: Any, count: int, rng: np.random.Generator, at_limits: bool) -> NDArray[np.float32]:
    """(N, 2 J) positions within the limits, and no velocity. A joint without limits turns or slides by up to pi."""
    limits = np.array(articulation.get_qlimits().numpy(force=True), np.float32)
    low, high = np.clip(np.broadcast_to(limits, (count, *limits.shape[1:])), -np.pi, np.pi).transpose(2, 0, 1)
    share = rng.random(low.shape)
    qpos = low + (high - low) * (np.round(share) if at_limits else share)
    return np.concatenate([qpos, np.zeros_like(qpos)], axis=1).astype(np.float32)


def _goals(env: BaseEnv) -> list[str]:
    """Kinematic bodies without collision shapes: marks of where something is to go."""
    return [
        name
        for name, struct in scene_index(env).states.items()
        if name.startswith("actors/")
        and struct.px_body_type == "kinematic"
        and len(maniskill_private.envs_of(struct)) == env.num_envs
        and not any(map(_collides, maniskill_private.objects_of(struct)))
    ]


def _collides(entity: Any) -> bool:
    # Of a merged actor ManiSkill's `has_collision_shapes` raises.
    body = entity.find_component_by_type(sapien.physx.PhysxRigidBaseComponent)
    return body is not None and len(body.collision_shapes) > 0


def _at(env: BaseEnv, begun: States, goal: str) -> States:
    """Dynamic bodies above or below the goal, as high as they began in every other env, and at its height in the others."""
    states: States = {}
    for name, rows in begun.items():
        states[name] = rows = rows.copy()
        struct = scene_index(env).states.get(name)
        if name.startswith("actors/") and struct is not None and struct.px_body_type == "dynamic":
            here = np.isfinite(rows).all(axis=1)
            place = begun[goal][:, :3].copy()
            place[::2, 2] = rows[::2, 2]
            rows[here, :3], rows[here, 7:] = place[here], 0
    return states


def _between(states: States, begun: States, shares: NDArray[np.float64]) -> States:
    """Part of the way back to where the episode began, at rest.

    Args:
        shares: (N,) from 0 on, where 1 is where it began.
    """
    found: States = {}
    share = shares[:, None]
    for name, rows in states.items():
        first = begun[name]
        between = rows + share * (first - rows)
        # The shorter way round, to a quaternion of length 1.
        sign = np.where((rows[:, 3:7] * first[:, 3:7]).sum(axis=1, keepdims=True) < 0, -1, 1)
        turned = rows[:, 3:7] + share * (sign * first[:, 3:7] - rows[:, 3:7])
        between[:, 3:7] = turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
        joints = (rows.shape[1] - BODY) // 2
        between[:, 7:BODY], between[:, BODY + joints :] = 0, 0
        # A body that an env lacks is NaN, and one that does not move stays as it is.
        found[name] = np.where(np.isfinite(rows) & (rows != first), between, rows).astype(np.float32)
    return found
