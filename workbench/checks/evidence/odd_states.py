"""Puts joints and bodies into states that random actions seldom reach, and calls the task's hooks there."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sapien.physx
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import common
from numpy.typing import NDArray

from workbench.checks.evidence.collect import Checkup, leaf_rows
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
"""Number of batches of seeds whose states are changed."""
MARGIN_METRES = 0.15
"""Bodies are placed, in x and y, within the box of all their start positions, widened by this margin in
metres on each side."""
HEIGHT_METRES = 0.3
"""A body is placed between its start height and this many metres above."""
KINDS = ("right after the reset", "with joints and bodies at random places", "with joints at their limits")
"""Descriptions of the states of each batch, for a sentence."""
MAX_GOALS = 4
"""Maximum number of goal marks at which bodies are placed: a drawing task has hundreds of marks."""
AT_GOAL = "with bodies at the place of {}"
SHORT = "between the reset and a success"
HALVINGS = 6
"""Number of bisection steps that search, between a success and the reset, for the point where success ends.
The last states are at most 1/64 of the way from this point."""
DENSE_HOOKS = {"dense": "compute_dense_reward", "normalized_dense": "compute_normalized_dense_reward"}
"""Hook of each dense reward mode."""

States = dict[str, NDArray[np.float32]]
"""(N, D) by name, as `read_states` gives them."""


@dataclass
class OddStates:
    """Results of the hooks in R rounds of N envs. Rounds with the same seeds belong to the same episodes, with the same goals."""

    seeds: list[list[int]] = field(default_factory=list)
    """(R, N)"""
    kinds: list[str] = field(default_factory=list)
    """(R,) description of the states, for a sentence."""
    evaluate: list[dict[str, NDArray]] = field(default_factory=list)
    """(R,) entries of ``evaluate()``, each (N, ...)."""
    reward: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    """(R, N) by reward mode: the mode of the env, and the dense modes that the class has."""
    obs: list[dict[str, NDArray[np.float64]]] = field(default_factory=list)
    """(R,) observations, (N, D) by leaf, without pictures."""
    reward_if_success: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    """As `reward`, with ``info["success"]`` set to true in all envs; NaN where the reward raised. Empty if evaluate() has no
    entry success."""


def odd_states(checkup: Checkup) -> OddStates:
    """Evidence for `Checkup.look`: results for the first seeds, in each of the `KINDS` of states and with the
    bodies at each goal."""
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
    """Put all envs into these states and call the hooks. Returns (N,) whether each env has success."""
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
                _add_reward_if_success(seen, mode, hook, obs, given, info, task.num_envs)


def _add_reward_if_success(
    seen: OddStates, mode: str, hook: Any, obs: Any, action: Any, info: dict[str, Any], num_envs: int
) -> None:
    success = info["success"]
    successful = {**info, "success": torch.ones_like(success) if isinstance(success, torch.Tensor) else True}
    try:
        rows = _rows(hook(obs=obs, action=action, info=successful), num_envs)
    except Exception:
        # Not the task's fault: the state is not a success, and the hook may rely on other conditions of a
        # success.
        rows = np.full(num_envs, np.nan)
    seen.reward_if_success.setdefault(mode, []).append(rows)


def _rows(reward: Any, num_envs: int) -> NDArray[np.float64]:
    """(N,) the reward of each env."""
    return np.broadcast_to(torch.as_tensor(reward).double().numpy(force=True), (num_envs,)).copy()


def reward_modes(checkup: Checkup) -> list[str]:
    """The reward mode of the env, then the dense modes that the class has."""
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
    """(3,) corners of the box around the bodies that move, with a margin of `MARGIN_METRES`."""
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
    """(N, 2 J) random joint positions within the limits (each at its lower or upper limit if `at_limits`), and zero
    velocities. Missing limits, and limits beyond ±pi (rad or m), count as ±pi."""
    limits = np.array(articulation.get_qlimits().numpy(force=True), np.float32)
    low, high = np.clip(np.broadcast_to(limits, (count, *limits.shape[1:])), -np.pi, np.pi).transpose(2, 0, 1)
    share = rng.random(low.shape)
    qpos = low + (high - low) * (np.round(share) if at_limits else share)
    return np.concatenate([qpos, np.zeros_like(qpos)], axis=1).astype(np.float32)


def _goals(env: BaseEnv) -> list[str]:
    """Names of kinematic bodies without collision shapes, which mark a goal."""
    return [
        name
        for name, struct in scene_index(env).states.items()
        if name.startswith("actors/")
        and struct.px_body_type == "kinematic"
        and len(maniskill_private.envs_of(struct)) == env.num_envs
        and not any(map(_collides, maniskill_private.objects_of(struct)))
    ]


def _collides(entity: Any) -> bool:
    # ManiSkill's `has_collision_shapes` raises for a merged actor.
    body = entity.find_component_by_type(sapien.physx.PhysxRigidBaseComponent)
    return body is not None and len(body.collision_shapes) > 0


def _at(env: BaseEnv, begun: States, goal: str) -> States:
    """States with all dynamic bodies at the goal: at its height in odd envs, at the height of their start in even envs."""
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
    """States at rest on the straight way from `states` to the states in which the episode began.

    Args:
        shares: (N,) share of the way; 0 is `states`, 1 is `begun`.
    """
    found: States = {}
    share = shares[:, None]
    for name, rows in states.items():
        first = begun[name]
        between = rows + share * (first - rows)
        # The turn takes the shorter way round; the quaternion gets length 1.
        sign = np.where((rows[:, 3:7] * first[:, 3:7]).sum(axis=1, keepdims=True) < 0, -1, 1)
        turned = rows[:, 3:7] + share * (sign * first[:, 3:7] - rows[:, 3:7])
        between[:, 3:7] = turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
        joints = (rows.shape[1] - BODY) // 2
        between[:, 7:BODY], between[:, BODY + joints :] = 0, 0
        # A body that an env lacks is NaN; a body that does not move keeps its state.
        found[name] = np.where(np.isfinite(rows) & (rows != first), between, rows).astype(np.float32)
    return found
