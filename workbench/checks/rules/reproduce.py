"""Checks that a task runs in any order of resets, and that its episodes can be reproduced."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.checks.evidence.builds import shapes_of_env
from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note, NotKnown, read_obs
from workbench.checks.evidence.random_draws import first_draw, global_draw, torch_draw
from workbench.checks.evidence.time_step import EVERY_STEP
from workbench.checks.register_rule import rule
from workbench.envs.action_vector import random_action
from workbench.envs.maniskill_private import apply_and_fetch
from workbench.envs.state_columns import env_states, flat_names, split_flat
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv
from workbench.machine.text import listed
from workbench.task.blame import blamed

PARTIAL_RESETS = 6
"""Number of partial resets, with a step between them."""
REPLAYED_STEPS = 10
"""Number of steps that are made twice."""
SAME_TOLERANCE = 1e-4
"""Maximum difference of two numbers that count as equal: a pose that is set and read again is rounded."""
RESTORED_TOLERANCE = 1e-3
"""Maximum difference of two numbers that count as equal after a state dict is restored: restoring computes
link poses from joints."""
_RESET_HOOKS = ("_initialize_episode", "reset")
_RESULT_HOOKS = ("evaluate", "_get_obs_extra", "_get_obs_agent", "get_info", "get_obs")
"""Hooks that make the result of a reset."""
Numbers = dict[str, NDArray[np.float64]]
"""Arrays (N, ...) by name."""


@rule("runs", "stop", "_initialize_episode")
def runs(checkup: Checkup) -> Iterator[Found | Note]:
    """Resets of any subset of envs with any seed, and steps with any action, work.

    Training ends with an error.

    ## Why
    A trainer resets any of its envs at any step, with and without seeds, and tries actions that no person
    would. An error then ends the training, after minutes or hours.

    ## Fix
    Work on the rows of `env_idx`; it may be a single row.

    ```python fragment
    def _initialize_episode(self, env_idx, options):
        b = len(env_idx)
        self.target[env_idx] = torch.rand((b, 3), device=self.device)
    ```

    ## How it is checked
    The rule resets random subsets of the envs six times, three times with seeds, and takes a step of random
    actions after each reset; in the first step all actions are at their bounds. An error that the task raises
    in any other check is reported under this rule too. If several envs raise and one env does not, the
    finding says so. With one env no partial reset can be tried, and the result is *not known* unless
    something raises. The rule does not see what fails in a state that random actions do not reach.
    """
    task, rng = checkup.task, np.random.default_rng(1)
    every = range(checkup.num_envs)
    checkup.reset(task, None)
    for turn in range(PARTIAL_RESETS):
        count = int(rng.integers(1, checkup.num_envs + 1))
        chosen = sorted(int(i) for i in rng.choice(every, count, replace=False))
        checkup.reset(task, None if turn % 2 else [1000 * turn + i for i in chosen], chosen)
        action = random_action(task.parts, task.num_envs, rng)
        checkup.step(task, np.sign(action) if turn == 0 else action)
    # With one env no reset leaves another env in the middle of its episode.
    checkup.require_several()
    return iter(())


@rule("same-seed", "stop", "_initialize_episode")
def same_seed(checkup: Checkup) -> Iterator[Found | Note]:
    """The same seed gives the same state after a reset, whatever came before.

    Runs, demonstrations and bugs cannot be reproduced.

    ## Why
    `reset(seed=s)` promises a certain episode. If numbers come from a generator that the reset does not seed,
    or if something keeps its value from the last episode, then runs, bugs and demonstrations cannot be
    reproduced, and evaluations on fixed seeds measure luck.

    ## Fix
    Draw random numbers with torch in `_initialize_episode`, where torch is seeded, and set everything that an
    episode changes.

    ```python fragment
    def _initialize_episode(self, env_idx, options):
        b = len(env_idx)
        xy = torch.rand((b, 2), device=self.device)  # not np.random.rand
        self.steps_near[env_idx] = 0
    ```

    ## How it is checked
    The rule resets the first seeds, then resets other seeds, makes three random steps and a partial reset,
    and resets the first seeds again. State, `evaluate()` and observation must agree to 0.0001. Readings of
    the robot's own sensors are left out: a touch sensor shows the contacts of the last substep. If a hook of
    a reset, or a function that it calls, draws random numbers that no reset seeds, the rule reports the line
    of that call: a call of `np.random` or `random`, or a call of torch in `evaluate` or the observation.
    """
    checkup.require_task()
    task, seeds = checkup.task, next(checkup.batches())
    first = _seen(task, checkup.reset(task, seeds))
    # Reset other seeds in between: otherwise a generator of the task's own might be in the same state again.
    checkup.reset(task, [seed + 5000 for seed in seeds])
    rng = np.random.default_rng(2)
    for _ in range(3):
        checkup.step(task, random_action(task.parts, task.num_envs, rng))
    if checkup.num_envs > 1:
        checkup.reset(task, None, [checkup.num_envs - 1])
    again = _seen(task, checkup.reset(task, seeds))
    differing = _differing(first, again, SAME_TOLERANCE)
    if differing:
        drawn = first_draw(checkup.places, global_draw, *_RESET_HOOKS, *_RESULT_HOOKS)
        # ManiSkill seeds torch for the duration of a reset; the hooks that make its result run afterwards.
        drawn = drawn or first_draw(checkup.places, torch_draw, *_RESULT_HOOKS)
        place, called = drawn or (checkup.places.hook("_initialize_episode"), "")
        yield Found(
            f"{_differences_text(differing)} after two resets with the same seeds. "
            + (
                f"{called} is not seeded by the reset: draw"
                if called
                else "Set everything in a reset, and draw"
            )
            + " with torch.rand in _initialize_episode, or from self._batched_episode_rng.",
            place,
            len(differing),
        )


@rule("state-restores", "warn", "get_state_dict")
def state_restores(checkup: Checkup) -> Iterator[Found | Note]:
    """The state dict restores evaluate(), reward and observation.

    Replayed demonstrations, state-based resets and planners see another goal than the recorded one.

    ## Why
    Replayed demonstrations, planners and resets to recorded states call `set_state_dict`. It restores bodies
    and joints. It does not restore a goal that the task keeps as a tensor: reward and success are then those
    of another goal, and labels of a dataset are wrong.

    ## Fix
    Give the goal a body, or add it to the state.

    ```python fragment
    def get_state_dict(self):
        return {**super().get_state_dict(), "goal": self.goal_pos.clone()}


    def set_state_dict(self, state, env_idx=None):
        rest = {key: value for key, value in state.items() if key != "goal"}
        super().set_state_dict(rest, env_idx)
        self.goal_pos[:] = state["goal"]
    ```

    ## How it is checked
    The rule resets at most four seeds, keeps the state, resets other seeds, and sets the state. `evaluate()`,
    the reward for an action of zeros and the observation must be as before, to 0.001. The rule ignores the
    robot's own sensors. It also ignores every number that already changes when only the simulation's state is
    set to another state and back, without a reset (velocities of links, noise). It makes no step, because no
    state contains the contacts. So it does not notice counters that change only in a step.
    """
    seeds = next(checkup.batches())[: min(4, checkup.num_envs)]
    others = [seed + 5000 for seed in seeds]
    with checkup.env(len(seeds)) as task:
        checkup.reset(task, others)
        with blamed("reset", checkup.loaded, task):
            elsewhere = _copied(task.env.get_state_dict())
        checkup.reset(task, seeds)
        with blamed("reset", checkup.loaded, task):
            state = _copied(task.env.get_state_dict())
            before = _rescored(task)
            noisy = _differing(before, _rescored(task), 0)
            # Only the simulation moves away and back here: numbers that differ now, such as velocities of links, are noise.
            for each in (elsewhere, state):
                task.env.set_state_dict(each)
                apply_and_fetch(task.env)
            noisy |= _differing(before, _rescored(task), RESTORED_TOLERANCE)
        checkup.reset(task, others)
        with blamed("reset", checkup.loaded, task):
            task.env.set_state_dict(state)
            apply_and_fetch(task.env)
            after = _rescored(task)
    differing = _differing(before, after, RESTORED_TOLERANCE)
    lost = {name: by for name, by in differing.items() if name not in noisy}
    if lost:
        yield Found(
            f"{_differences_text(lost)} after get_state_dict() and set_state_dict(). Keep what decides these values in a body (a "
            "kinematic goal that has a pose), or add it to the state in get_state_dict and set_state_dict.",
            checkup.places.hook("get_state_dict", "_initialize_episode"),
        )


@rule("actions-replay", "warn", "step")
def actions_replay(checkup: Checkup) -> Iterator[Found | Note]:
    """The same actions from the same seed give the same episode.

    Demonstrations cannot be replayed.

    ## Why
    Demonstrations are stored as a seed and actions. If a step draws random numbers that no seed decides, or
    depends on something that a reset does not set, the same actions lead elsewhere.

    ## Fix
    Draw in the reset, or in the step from the generators of the episodes.

    ```python fragment
    def _before_control_step(self):
        push = np.stack([rng.normal(size=3) for rng in self._batched_episode_rng.rngs])
        self.cube.apply_force(torch.from_numpy(push).float().to(self.device))
    ```

    ## How it is checked
    The rule makes ten random steps twice from the same seeds. Each reset begins with physics that has no
    contacts from before, so that only the task's code can make a difference. Poses, rewards and `evaluate()`
    must agree to 0.0001. If a call draws in a step, the rule reports its line. The result is *not known* if
    the reset itself differs ([same-seed](same-seed.md)), and *not applicable* if the task takes no actions.
    The rule does not look at observations, since noise may be wanted there.
    """
    checkup.require_task()
    seeds = next(checkup.batches())
    task = checkup.task
    if not task.parts:
        raise NotApplicable("the task takes no actions")
    first, second = (_episode(checkup, task, seeds) for _ in range(2))
    for step, (one, other) in enumerate(zip(first, second, strict=True)):
        if not (differing := _differing(one, other, SAME_TOLERANCE)):
            continue
        if step == 0:
            raise NotKnown("the same seed gives another start")
        drawn = next(
            (
                found
                for draws in (global_draw, torch_draw)
                if (found := first_draw(checkup.places, draws, *EVERY_STEP)) is not None
            ),
            (
                checkup.places.hook("_before_control_step", "_after_control_step", "evaluate"),
                "what is drawn in a step",
            ),
        )
        yield Found(
            f"{_differences_text(differing)} after {step} {'step' if step == 1 else 'steps'} of the same actions from the same seeds. "
            f"{drawn[1]} does not depend on the seed: draw from self._batched_episode_rng, or in the reset.",
            drawn[0],
        )
        return


@rule("same-for-any-batch", "warn", "_load_scene")
def same_for_any_batch(checkup: Checkup) -> Iterator[Found | Note]:
    """The scene that is built for a seed does not depend on the number of envs.

    A demonstration that was recorded with one env shows other objects when it is replayed among many.

    ## Why
    A demonstration is recorded with one env and replayed, or rendered again, with many envs. If the objects
    of a seed depend on the number of envs, the replay shows a hand that grasps where nothing is.

    ## Fix
    Draw what is built from the generator of each env.

    ```python fragment
    def _load_scene(self, options):
        for i in range(self.num_envs):
            size = 0.02 + 0.01 * self._batched_episode_rng[i].rand()
            builder = self.scene.create_actor_builder()
            builder.add_box_collision(half_size=[size] * 3)
    ```

    ## How it is checked
    The rule builds one env alone for the two seeds of the first two envs of the batch, and compares the
    bodies of both builds: kinds, sizes, poses in the body, colours, frictions and mesh files. It does not
    compare where a reset places bodies, since ManiSkill seeds the reset of the whole batch with the seed of
    its first env. The result is *not known* with one env.
    """
    checkup.require_several()
    assert checkup.task
    wrong = [
        seed
        for env, (seed, alone) in zip(range(checkup.num_envs), checkup.alone.shapes.items(), strict=False)
        if alone != shapes_of_env(checkup.builds, env)
    ]
    if wrong:
        yield Found(
            f"A single env is built with other shapes or colours for seed {listed(wrong)} than the env of that seed in a "
            f"batch of {checkup.num_envs}. Draw from self._batched_episode_rng[i] for env i, not from torch or numpy.",
            checkup.places.hook("_load_scene"),
            len(wrong),
        )


# --- what is compared ------------------------------------------------------------------------------------


def _seen(task: TaskEnv, result: StepResult) -> Numbers:
    """State, evaluate() and observation after a reset."""
    states = {
        name: np.asarray(rows, np.float64)
        for name, rows in env_states(task.env).items()
        if _is_batch(task, rows)
    }
    return {**states, **_of_result(result), **_observed(task)}


def _of_result(result: StepResult) -> Numbers:
    return {
        "the reward": result.reward.astype(np.float64),
        **{f"evaluate()[{name!r}]": np.asarray(v, np.float64) for name, v in result.evaluate.items()},
    }


def _rescored(task: TaskEnv) -> Numbers:
    """Reward, evaluate() and observation of the present state, for an action of zeros."""
    action = np.zeros((task.num_envs, sum(len(part.names) for part in task.parts)), np.float32)
    # In a task without a reward, an action would make rescore() raise.
    result = task.rescore(None if task.env.reward_mode == "none" else action)
    return {**_of_result(result), **_observed(task)}


def _observed(task: TaskEnv) -> Numbers:
    """The leaves of the observation; a flat observation is split by its names."""
    found: Numbers = {}
    for name, value in read_obs(task).items():
        names = flat_names(task, task.obs) if name == "obs" else None
        parts = [(name, value, "")] if names is None else split_flat(names, value)
        found |= {f"obs/{part}": numbers for part, numbers, _ in parts}
    # A robot's touch sensors read the contacts of the last substep, which is of the previous episode.
    found = {name: numbers for name, numbers in found.items() if not name.startswith("obs/agent/")}
    return found


def _episode(checkup: Checkup, task: TaskEnv, seeds: list[int]) -> list[Numbers]:
    rng = np.random.default_rng(3)
    results = [checkup.reset(task, seeds)]
    for _ in range(REPLAYED_STEPS):
        results.append(checkup.step(task, random_action(task.parts, task.num_envs, rng)))
    return [{"a pose": result.poses.astype(np.float64), **_of_result(result)} for result in results]


def _differing(one: Numbers, other: Numbers, tolerance: float) -> dict[str, float]:
    """Largest difference of each array that differs, by name; infinite if the shapes differ.

    Args:
        tolerance: maximum difference of equal numbers; relative for numbers above 1.
    """
    found: dict[str, float] = {}
    for name in one.keys() & other.keys():
        a, b = one[name], other[name]
        if a.shape != b.shape:
            found[name] = np.inf
            continue
        away = np.abs(np.nan_to_num(a) - np.nan_to_num(b))
        if (away > tolerance * np.maximum(1, np.abs(np.nan_to_num(a)))).any():
            found[name] = float(away.max())
    return dict(sorted(found.items()))


def _differences_text(differing: Mapping[str, float]) -> str:
    """Text such as ``actors/cube (by 0.05), the reward (by 1) differ``."""
    names = [f"{name} (by {by:.2g})" for name, by in differing.items()]
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"{', '.join(names[:3])}{more} {'differs' if len(names) == 1 else 'differ'}"


def _is_batch(task: TaskEnv, rows: Any) -> bool:
    return hasattr(rows, "shape") and len(rows.shape) > 0 and rows.shape[0] == task.num_envs


def _copied(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _copied(item) for key, item in value.items()}
    return value.clone() if isinstance(value, torch.Tensor) else value
