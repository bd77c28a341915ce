"""Checks that a task runs in any order of resets, and does the same again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.checks.evidence.builds import shapes_of_env
from workbench.checks.evidence.checkup import Check, Checkup, Found, NotApplicable, Note, NotKnown, read_obs
from workbench.checks.evidence.random_calls import first_draw, global_draw, torch_draw
from workbench.checks.evidence.time_step import EVERY_STEP
from workbench.envs.action_vector import random_action
from workbench.envs.maniskill_private import apply_and_fetch
from workbench.envs.state_columns import env_states, flat_names, split_flat
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv
from workbench.machine.text import listed
from workbench.task.blame import blamed

ROUNDS = 6
"""Partial resets, with a step between them."""
REPLAYED_STEPS = 10
SAME = 1e-4
"""Largest difference of two numbers that are equal: poses come back rounded."""
RESTORED = 1e-3
"""The same after a state dict, whose link poses are computed from joints again; of larger numbers, relative."""
_RESET_HOOKS = ("_initialize_episode", "reset")
_RESULT_HOOKS = ("evaluate", "_get_obs_extra", "_get_obs_agent", "get_info", "get_obs")
"""They give what a reset returns."""
Numbers = dict[str, NDArray[np.float64]]
"""(N, ...) by name."""


def runs(checkup: Checkup) -> Iterator[Found | Note]:
    """Resets at random subsets, with and without seeds, and steps with random actions, the largest among them."""
    task, rng = checkup.task, np.random.default_rng(1)
    every = range(checkup.num_envs)
    checkup.reset(task, None)
    for turn in range(ROUNDS):
        count = int(rng.integers(1, checkup.num_envs + 1))
        chosen = sorted(int(i) for i in rng.choice(every, count, replace=False))
        checkup.reset(task, None if turn % 2 else [1000 * turn + i for i in chosen], chosen)
        action = random_action(task.parts, task.num_envs, rng)
        checkup.step(task, np.sign(action) if turn == 0 else action)
    # With one env no reset leaves another in the middle of its episode.
    checkup.require_several()
    return iter(())


def same_seed(checkup: Checkup) -> Iterator[Found | Note]:
    """After a reset, and again after resets and steps of other seeds."""
    checkup.require_task()
    task, seeds = checkup.task, next(checkup.batches())
    first = _seen(task, checkup.reset(task, seeds))
    # Others that have their own generators may be at an equal place after a reset.
    checkup.reset(task, [seed + 5000 for seed in seeds])
    rng = np.random.default_rng(2)
    for _ in range(3):
        checkup.step(task, random_action(task.parts, task.num_envs, rng))
    if checkup.num_envs > 1:
        checkup.reset(task, None, [checkup.num_envs - 1])
    again = _seen(task, checkup.reset(task, seeds))
    differing = _differing(first, again, SAME)
    if differing:
        drawn = first_draw(checkup.places, global_draw, *_RESET_HOOKS, *_RESULT_HOOKS)
        # Within the reset torch is seeded, and what comes of its result is asked for after it.
        drawn = drawn or first_draw(checkup.places, torch_draw, *_RESULT_HOOKS)
        place, called = drawn or (checkup.places.hook("_initialize_episode"), "")
        yield Found(
            f"{_named(differing)} after two resets with the same seeds. "
            + (
                f"{called} is not seeded by the reset: draw"
                if called
                else "Set everything in a reset, and draw"
            )
            + " with torch.rand in _initialize_episode, or from self._batched_episode_rng.",
            place,
            len(differing),
        )


def same_for_any_batch(checkup: Checkup) -> Iterator[Found | Note]:
    """What one env builds for a seed, beside what the batch built for it."""
    checkup.require_several()
    assert checkup.task
    wrong = [
        seed
        for env, (seed, alone) in zip(range(checkup.num_envs), checkup.alone.shapes.items(), strict=False)
        if alone != shapes_of_env(checkup.builds, env)
    ]
    if wrong:
        yield Found(
            f"one env alone is built with other shapes or colours for seed {listed(wrong)} than the env of that seed among "
            f"{checkup.num_envs}. Draw from self._batched_episode_rng[i] for env i, not from torch or numpy.",
            checkup.places.hook("_load_scene"),
            len(wrong),
        )


def state_restores(checkup: Checkup) -> Iterator[Found | Note]:
    """The state right after a reset, put back after a reset with other seeds. No step is made: contacts are in no state."""
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
            # Only the simulation was elsewhere, not the task: velocities of links, say, come back otherwise.
            for each in (elsewhere, state):
                task.env.set_state_dict(each)
                apply_and_fetch(task.env)
            noisy |= _differing(before, _rescored(task), RESTORED)
        checkup.reset(task, others)
        with blamed("reset", checkup.loaded, task):
            task.env.set_state_dict(state)
            apply_and_fetch(task.env)
            after = _rescored(task)
    differing = _differing(before, after, RESTORED)
    lost = {name: by for name, by in differing.items() if name not in noisy}
    if lost:
        yield Found(
            f"{_named(lost)} after get_state_dict() and set_state_dict(). Keep what decides it in a body (a kinematic goal "
            "that has a pose), or add it to the state in get_state_dict and set_state_dict.",
            checkup.places.hook("get_state_dict", "_initialize_episode"),
        )


def actions_replay(checkup: Checkup) -> Iterator[Found | Note]:
    """Twice from the same seeds. Each reset begins with physics that has no past, so only the task's code can differ."""
    checkup.require_task()
    seeds = next(checkup.batches())
    task = checkup.task
    if not task.parts:
        raise NotApplicable("it takes no actions")
    first, second = (_episode(checkup, task, seeds) for _ in range(2))
    for step, (one, other) in enumerate(zip(first, second, strict=True)):
        if not (differing := _differing(one, other, SAME)):
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
            f"{_named(differing)} after {step} {'step' if step == 1 else 'steps'} of the same actions from the same seeds. "
            f"No reset seeds {drawn[1]}: draw from self._batched_episode_rng, or in the reset.",
            drawn[0],
        )
        return


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
    # Of a task without a reward, it would raise.
    result = task.rescore(None if task.env.reward_mode == "none" else action)
    return {**_of_result(result), **_observed(task)}


def _observed(task: TaskEnv) -> Numbers:
    """The leaves of the observation, of a flat one too."""
    found: Numbers = {}
    for name, value in read_obs(task).items():
        names = flat_names(task, task.obs) if name == "obs" else None
        parts = [(name, value, "")] if names is None else split_flat(names, value)
        found |= {f"obs/{part}": numbers for part, numbers, _ in parts}
    # A robot's touch sensors read the contacts of the last substep, of the last episode.
    found = {name: numbers for name, numbers in found.items() if not name.startswith("obs/agent/")}
    return found


def _episode(checkup: Checkup, task: TaskEnv, seeds: list[int]) -> list[Numbers]:
    rng = np.random.default_rng(3)
    results = [checkup.reset(task, seeds)]
    for _ in range(REPLAYED_STEPS):
        results.append(checkup.step(task, random_action(task.parts, task.num_envs, rng)))
    return [{"a pose": result.poses.astype(np.float64), **_of_result(result)} for result in results]


def _differing(one: Numbers, other: Numbers, tolerance: float) -> dict[str, float]:
    """By how much at most, of what differs. Infinite where shapes differ."""
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


def _named(differing: Mapping[str, float]) -> str:
    """``actors/cube (by 0.05), the reward (by 1) differ``."""
    names = [f"{name} (by {by:.2g})" for name, by in differing.items()]
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"{', '.join(names[:3])}{more} {'differs' if len(names) == 1 else 'differ'}"


def _is_batch(task: TaskEnv, rows: Any) -> bool:
    return hasattr(rows, "shape") and len(rows.shape) > 0 and rows.shape[0] == task.num_envs


def _copied(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _copied(item) for key, item in value.items()}
    return value.clone() if isinstance(value, torch.Tensor) else value


CHECKS: Mapping[str, Check] = {
    "runs": runs,
    "same-seed": same_seed,
    "state-restores": state_restores,
    "actions-replay": actions_replay,
    "same-for-any-batch": same_for_any_batch,
}
