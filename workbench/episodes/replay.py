"""Replays a recorded episode in running envs, up to a chosen state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.envs import action_vector as actions
from workbench.envs.recorded_run import RecordedRun
from workbench.envs.snapshots.snapshot import Snapshot, step_only
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv
from workbench.episodes.recorded_state import (
    new_physics,
    read_states,
    same_state,
    settle_robot,
    state_distance,
    state_mismatches,
    write_states,
)
from workbench.machine.text import length
from workbench.task.blame import blamed
from workbench.task.load import LoadedTask
from workbench.task.open import OpenedTask

PARTED_METRES, PARTED_RADIANS = 1e-4, 1e-3
"""Tolerances of a replay: if the position of a body, or the rotation of a body or joint, deviates by more
from the recorded state, the replay restores that state."""

Way = Literal["re-simulated", "corrected", "restored"]


@dataclass(frozen=True)
class ReplayResult:
    """Result of putting an env into a recorded state."""

    way: Way
    steps: int
    metres: float | None
    """Largest distance in metres of a body from the recorded state; None if the recording has no states."""
    radians: float | None
    """Largest rotation in radians of a body or joint from the recorded state."""
    corrected: int = 0
    """Number of steps after which the recorded state was restored."""
    start_differs: bool = False
    """Whether the reset with the recorded seed led to another state than the recorded first state, which was
    then restored."""
    missed: dict[str, str] = field(default_factory=dict)
    """Name and reason of each part of the state that could not be restored."""


@dataclass(frozen=True)
class Beginning:
    """Result of putting an env into the first state of a run."""

    differs: bool
    """Whether the reset led to another state than the recorded one, which was then restored."""
    missed: dict[str, str]
    """Name and reason of each part of the state that could not be restored."""


def begin_run(loaded: LoadedTask, task: TaskEnv, runs: Mapping[int, RecordedRun]) -> dict[int, Beginning]:
    """Put these envs into the first state of their runs: reset with the seed, then restore the state if it differs.

    The state may differ if the recorded env was reset together with other envs: all of them drew from torch's
    generator, so the env's random numbers depended on more than its seed.

    Raises:
        TaskError: a reset raised.
    """
    env = task.env
    missed: dict[int, dict[str, str]] = {i: {} for i in runs}
    with blamed("restore", loaded, task):
        new_physics(env, list(runs))
    for i, run in runs.items():
        options = {name: value for name, value in run.reset_options.items() if name != "env_idx"}
        if options.pop("reconfigure", False):
            missed[i]["reset option reconfigure"] = "the scene is not built again for one env of a batch"
        if run.seed < 0:
            missed[i]["randomness outside the states"] = (
                "the recording has no seed, so new random numbers are drawn"
            )
        seed = [run.seed] if run.seed >= 0 else None
        # Reset one env at a time: envs that are reset together draw different random numbers than an env that
        # is reset alone.
        with blamed("reset", loaded, task):
            task.reset(seed, [i], options)
    now = read_states(env)
    other = {i: not same_state(_of(now, i), run.state(0)) for i, run in runs.items()}
    wrong = {i: run.state(0) for i, run in runs.items() if other[i]}
    with blamed("restore", loaded, task):
        for i, run in runs.items():
            if run.env_states:
                missed[i] |= state_mismatches(env, i, run.state(0))
        if wrong:
            write_states(env, wrong)
            settle_robot(env, list(wrong))
    return {i: Beginning(other[i], missed[i]) for i in runs}


def restore_recorded(
    opened: OpenedTask, states: Mapping[int, Mapping[str, NDArray]], action: NDArray[np.float32] | None = None
) -> StepResult:
    """Write a recorded state into each of these envs; returns the task's result for these states, computed by
    `TaskEnv.rescore`.

    Raises:
        TaskError: the task's code raised.
    """
    with blamed("restore", opened.loaded, opened.env):
        write_states(opened.env.env, states)
        return opened.env.rescore(action)


def replay_to(
    opened: OpenedTask,
    run: RecordedRun,
    state: int,
    env_idx: Sequence[int],
    on_step: Callable[[int], None] = lambda done: None,
) -> tuple[StepResult, ReplayResult]:
    """Put these envs into state `state` of a recorded run.

    A state that is only restored (`episodes.recorded_state`) has all bodies in place, but lacks what no
    recording holds: contacts, drive targets, the task's own counters. A replay from the recorded seed with
    the recorded actions reproduces all of this exactly if the code is the same; different code leads to a
    different state. So the run is replayed, and the bodies are compared with the recording after each step.
    If a body is too far from its recorded pose, the recorded state is restored; the result counts the steps
    after which this happened.

    The other envs do not move (`step_only`), and the task's attributes for them are restored afterwards.

    Args:
        state: from 0 (the state after the reset) to ``run.length``.
        on_step: called with the number of replayed steps.

    Raises:
        TaskError: the task's code raised during the replay; the envs stay in the state that they had reached.
        IndexError: the run has no such state, or the task has no such env.
    """
    task, env = opened.env, opened.env.env
    chosen = [int(i) for i in env_idx]
    if not 0 <= state <= run.length:
        raise IndexError(f"{run.name} has states 0 to {run.length}, not {state}")
    if not chosen or any(not 0 <= i < task.num_envs for i in chosen):
        raise IndexError(f"env_idx {chosen} is out of range for {task.num_envs} envs")
    others = [i for i in range(task.num_envs) if i not in chosen]
    why_not = why_not_replayable(opened, run)
    snapshot, reason = _snapshot_of(opened, others)
    why_not = why_not or reason
    corrected = 0
    with step_only(env, chosen, snapshot):
        beginnings = begin_run(opened.loaded, task, dict.fromkeys(chosen, run))
        missed = {what: why for each in beginnings.values() for what, why in each.missed.items()}
        if not why_not:
            for t in range(state):
                action: NDArray[np.float32] = run.action[t]
                rows = dict.fromkeys(chosen, action)
                with blamed("step", opened.loaded, task):
                    task.step(actions.action_of(task.parts, task.num_envs, rows))
                wanted = run.state(t + 1)
                if wanted and _is_off(env, chosen, wanted):
                    with blamed("restore", opened.loaded, task):
                        write_states(env, dict.fromkeys(chosen, wanted))
                    corrected += 1
                on_step(t + 1)
        elif state > 0:
            missed["the way there"] = why_not
            with blamed("restore", opened.loaded, task):
                write_states(env, dict.fromkeys(chosen, run.state(state)))
                settle_robot(env, chosen)
                env.elapsed_steps[chosen] = state
    with blamed("restore", opened.loaded, task):
        step = task.rescore()
    metres, radians = _distance(env, chosen, run.state(state))
    way: Way = "restored" if why_not and state > 0 else "corrected" if corrected else "re-simulated"
    return step, ReplayResult(
        way,
        state,
        metres,
        radians,
        corrected,
        any(each.differs for each in beginnings.values()),
        missed,
    )


def why_not_replayable(opened: OpenedTask, run: RecordedRun) -> str:
    """Why the recorded actions cannot be replayed; empty if they can."""
    width = actions.width(opened.env.parts)
    recorded = run.action.shape[1] if run.action.ndim == 2 else 0
    if not np.isfinite(run.action).all():
        return "actions not replayed: they hold NaN or infinity"
    if width == recorded:
        return ""
    return f"actions not replayed: recorded with {recorded} dimensions, this env takes {width}"


def _snapshot_of(opened: OpenedTask, others: list[int]) -> tuple[Snapshot | None, str]:
    """(snapshot of the envs that must not move, ""), or (None, reason why no step may be taken)."""
    if not others:
        return None, ""
    try:
        return opened.env.snapshot(others), ""
    except Exception as error:  # a task may have attributes that cannot be copied
        return (
            None,
            f"the other envs cannot be put back after a step: this task's state cannot be copied ({error})",
        )


def _of(states: Mapping[str, NDArray], env: int) -> dict[str, NDArray]:
    return {name: rows[env] for name, rows in states.items()}


def _is_off(env: object, chosen: list[int], wanted: Mapping[str, NDArray]) -> bool:
    metres, radians = _distance(env, chosen, wanted)
    return (metres or 0.0) > PARTED_METRES or (radians or 0.0) > PARTED_RADIANS


def _distance(
    env: object, chosen: list[int], wanted: Mapping[str, NDArray]
) -> tuple[float | None, float | None]:
    """Largest distances of these envs from the state `wanted`, in metres and in radians; (None, None) if
    `wanted` is empty."""
    if not wanted:
        return None, None
    now = read_states(env)
    found = [state_distance(_of(now, i), wanted) for i in chosen]
    return max(metres for metres, _ in found), max(radians for _, radians in found)


def replay_text(replay_result: ReplayResult) -> str:
    """Text on how the state was reached, and how close it is to the recording; follows the episode's name."""
    if replay_result.way == "restored":
        text = "the recorded state was restored; contacts and the task's own counters start over"
    elif replay_result.way == "corrected":
        text = (
            f"its actions were replayed; after {replay_result.corrected} of {replay_result.steps} steps the "
            "state differed and the recorded one was restored"
        )
    elif replay_result.steps == 0:
        text = "reset with its seed" + (", then its first state restored" * replay_result.start_differs)
    else:
        text = "its actions were replayed"
        text += " from its first state" if replay_result.start_differs else " from its seed"
    if replay_result.metres is None:
        text += "; the recording has no states to compare with"
    elif replay_result.metres == 0 and not replay_result.radians:
        text += "; every body has its recorded pose, to the last bit"
    else:
        text += f"; bodies are within {length(replay_result.metres)} of their recorded positions"
    return text + "."
