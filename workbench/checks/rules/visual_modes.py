"""Checks of the observation in visual modes: the numbers that a policy gets besides the pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note, NotKnown, leaf_rows
from workbench.checks.evidence.odd_states import DENSE_HOOKS, write_all
from workbench.checks.register_rule import rule
from workbench.checks.rules.observation import place_of_leaf
from workbench.envs import maniskill_private
from workbench.envs.evaluate_entries import split_entries
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.simulation.state_layout import BODY
from workbench.envs.snapshots.snapshot import remembering
from workbench.envs.task_env import TaskEnv
from workbench.episodes.recorded_state import read_states
from workbench.machine.text import listed
from workbench.task.blame import blamed

SHIFT_METRES = np.array([0.031, -0.043, 0.057], np.float32)
"""Offset in metres by which a body is moved, to see which numbers follow."""
MIN_CHANGE = 1e-5
"""Minimum change of a number that follows the body."""
MAX_BODIES = 40
"""Maximum number of bodies that are moved, one after the other."""


@rule("ground-truth", "warn", "_get_obs_extra")
def ground_truth(checkup: Checkup) -> Iterator[Found | Note]:
    """In visual modes _get_obs_extra adds the state of objects only if self.obs_mode_struct.use_state.

    The policy reads the poses of objects instead of finding them in the pictures, and cannot run on a real
    robot.

    ## Why
    A policy that reads the poses of objects never learns to find the objects in the pictures. The policy
    seems to work, but cannot run on a real robot, which has no such numbers.

    ## Fix
    Add the state of objects only if the mode has state.

    ```python fragment
    def _get_obs_extra(self, info):
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose, "goal_pos": self.goal.pose.p}
        if self.obs_mode_struct.use_state:
            obs["cube_pose"] = self.cube.pose.raw_pose
        return obs
    ```

    ## How it is checked
    The rule runs two envs that observe pictures. The rule moves each dynamic body and each articulation that
    is not a robot (40 at most) by a few centimetres without a step, and calls `_get_obs_extra` again: a
    number that changes follows the body. Goals (kinematic and hidden bodies) may be in the observation.
    Contacts and forces do not change without a step, so `is_grasping` is not reported. The result is *not
    known* if there is no renderer, and *not applicable* for a task that has no observation mode with
    pictures, or in which nothing but the robot moves freely.
    """
    bodies_of: dict[str, list[str]] = {}
    seen = {body: moved for body, moved in checkup.look(followers).items() if not moved.hidden}
    if not seen:
        raise NotApplicable("nothing but the robot moves freely")
    for body, moved in seen.items():
        for leaf in moved.observation:
            bodies_of.setdefault(leaf, []).append(body)
    for leaf, bodies in bodies_of.items():
        yield Found(
            f"In obs_mode {checkup.pictured.env.obs_mode!r}, which has pictures, {leaf!r} of _get_obs_extra() depends "
            f"on the state of {listed(bodies)}. Add the entry only `if self.obs_mode_struct.use_state:`.",
            place_of_leaf(checkup, f"extra/{leaf}"),
        )
    if not bodies_of:
        _require_all_moved(checkup)


def _require_all_moved(checkup: Checkup) -> None:
    if (count := len(scene_index(checkup.pictured.env).states)) > MAX_BODIES:
        raise NotKnown(f"only {MAX_BODIES} of {count} bodies were looked at")


@rule("hidden-goal", "warn", "_get_obs_extra")
def hidden_goal(checkup: Checkup) -> Iterator[Found | Note]:
    """A goal that is hidden from pictures is in _get_obs_extra.

    Without the goal's position in the observation, the policy cannot know what to do.

    ## Why
    `_hidden_objects` are not in the pictures. If the goal is one of them and its place is not in the
    observation either, the policy can only learn the mean of all goals.

    ## Fix
    Put the goal into the observation in all modes.

    ```python fragment
    def _get_obs_extra(self, info):
        return {"tcp_pose": self.agent.tcp.pose.raw_pose, "goal_pos": self.goal_site.pose.p}
    ```

    ## How it is checked
    The rule runs two envs that observe pictures. The rule moves each body of `_hidden_objects` by a few
    centimetres. It reports a body if nothing in `_get_obs_extra` changes, although an entry of `evaluate()`
    or the dense reward does. The result is *not applicable* without hidden bodies. The rule does not see a
    goal that the task keeps in a tensor.
    """
    bodies = {body: moved for body, moved in checkup.look(followers).items() if moved.hidden}
    if not bodies:
        raise NotApplicable("the task hides nothing from pictures")
    found = False
    for body, moved in bodies.items():
        if moved.meaning and not moved.observation:
            found = True
            yield Found(
                f"{body} is hidden from pictures. Its position decides {listed(sorted(moved.meaning))}, but nothing "
                "in _get_obs_extra() depends on it. Add the position there, in all modes.",
                checkup.places.hook("_get_obs_extra"),
            )
    if not found:
        _require_all_moved(checkup)


# --- what follows a body that is moved -----------------------------------------------------------------------


@dataclass
class Followers:
    """The numbers that change with the place of one body."""

    hidden: bool
    """Whether the task hides the body from pictures."""
    observation: set[str] = field(default_factory=set)
    """Leaves of ``_get_obs_extra``."""
    meaning: set[str] = field(default_factory=set)
    """Entries of ``evaluate``, and ``the reward``."""


def followers(checkup: Checkup) -> dict[str, Followers]:
    """Evidence for `Checkup.look`: what follows each body that moves freely or is hidden, in a mode with pictures."""
    task = checkup.pictured
    checkup.reset(task, checkup.seeds[0])
    env: Any = task.env
    begun = read_states(env)
    robots = {agent.robot.name for agent in maniskill_private.agents(env)}
    index = scene_index(env)
    hidden = {name for name, is_hidden in zip(index.names, index.hidden, strict=True) if is_hidden}
    found: dict[str, Followers] = {}
    with blamed("observation", checkup.loaded, task):
        before = _ask(checkup, task)
        again = _ask(checkup, task)
        restless = _changed(before, again)
        for name, struct in [*index.states.items()][:MAX_BODIES]:
            kind, _, body = name.partition("/")
            free = body not in robots if kind == "articulations" else struct.px_body_type == "dynamic"
            if not (free or body in hidden) or np.isnan(begun[name]).any():
                continue
            states = {other: rows.copy() for other, rows in begun.items()}
            states[name][:, :3] += SHIFT_METRES
            if kind == "articulations":
                joints = (states[name].shape[1] - BODY) // 2
                states[name][:, BODY : BODY + joints] += 0.02
            write_all(env, states)
            moved = _changed(before, _ask(checkup, task)) - restless
            found[body] = Followers(
                body in hidden,
                {leaf.removeprefix("obs/") for leaf in moved if leaf.startswith("obs/")},
                {leaf for leaf in moved if not leaf.startswith("obs/")},
            )
            write_all(env, begun)
    return found


def _ask(checkup: Checkup, task: TaskEnv) -> dict[str, NDArray[np.float64]]:
    """(N, D) of each leaf of ``_get_obs_extra`` (``obs/...``), each entry of ``evaluate``, and the reward."""
    env = task.env
    with remembering(env):
        info = env.get_info()
        extra = maniskill_private.extra_observation(env, info)
        rows = {f"obs/{name}": value for name, value in leaf_rows(extra, task.num_envs).items()}
        entries = split_entries(info, task.num_envs)[0]
        rows |= {name: np.asarray(value, np.float64) for name, value in entries.items()}
        if checkup.loaded.cls.compute_dense_reward is not BaseEnv.compute_dense_reward:
            action = torch.zeros(env.action_space.shape or (), device=env.device)
            observed: Any = {"extra": extra}
            reward = getattr(env, DENSE_HOOKS["dense"])(obs=observed, action=action, info=info)
            rows["the reward"] = torch.as_tensor(reward).double().numpy(force=True)
    return rows


def _changed(before: dict[str, NDArray[np.float64]], now: dict[str, NDArray[np.float64]]) -> set[str]:
    return {
        name
        for name, rows in now.items()
        if name in before
        and rows.shape == before[name].shape
        and np.abs(np.nan_to_num(rows) - np.nan_to_num(before[name])).max(initial=0) > MIN_CHANGE
    }
