"""A recorded episode lived through again by envs that run: to a chosen state of it, or to its end; and said how.

Two ways lead to a recorded state. One can put it there (`core.capture.recorded_state`): then every body is where it was, and
what is in no recording is not as it was (contacts, drive targets, what the task counted on itself). Or one can
live up to it: the reset with the recorded seed, and the recorded actions. With the same code that gives everything,
to the last bit; with another it gives another state. So both are done at once: the episode is lived through, after each
step the bodies are compared with the record, and where they have parted by more than can be overlooked they
are put back on it. How far they were and how often that was needed is told, never assumed.

What a task draws at a reset hangs on more than the env's own seed where several envs were reset together: torch's
numbers come in one piece for all of them. So the first state is compared as well, and put back where it is another.

In a batch the envs that do not take part stand still (`step_only`), and what the task keeps for them is put
back afterwards, so that nobody is disturbed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.core.capture.recorded_run import RecordedRun
from workbench.core.capture.recorded_state import (
    new_physics,
    read_states,
    same_state,
    settle_robot,
    state_distance,
    state_mismatches,
    write_states,
)
from workbench.core.env import actions
from workbench.core.env.step_result import StepResult
from workbench.core.snapshots.snapshot import Snapshot, step_only
from workbench.jobs.open_task import OpenedTask, blamed
from workbench.machine.text import length

PARTED_METRES, PARTED_RADIANS = 1e-4, 1e-3
"""From here on a state is another one than the recorded, and is put back to it."""

Way = Literal["re-simulated", "corrected", "put there"]


@dataclass(frozen=True)
class ReplayResult:
    """How an env came to a recorded state."""

    way: Way
    steps: int
    metres: float | None
    """How far the body that is furthest is from the record; None where it holds no states to compare with."""
    radians: float | None
    """The same of turning: bodies and joints."""
    corrected: int = 0
    """Steps after which it was put back on the record."""
    start_differs: bool = False
    """The reset with its seed gave another state than the recorded one, which was put in its place."""
    missed: dict[str, str] = field(default_factory=dict)
    """What could not be put back, and why."""


@dataclass(frozen=True)
class Beginning:
    """How an env came to the first state of a run."""

    differs: bool
    """The reset gave another state, which the recorded one then took the place of."""
    missed: dict[str, str]
    """What could not be put back, and why."""


def begin_again(opened: OpenedTask, runs: Mapping[int, RecordedRun]) -> dict[int, Beginning]:
    """Let these envs stand at the first state of their runs.

    Raises:
        TaskError: a reset raised.
    """
    task, env = opened.env, opened.env.env
    missed: dict[int, dict[str, str]] = {i: {} for i in runs}
    with blamed("restore", opened.loaded, task):
        new_physics(env, list(runs))
    for i, run in runs.items():
        options = {name: value for name, value in run.reset_options.items() if name != "env_idx"}
        if options.pop("reconfigure", False):
            missed[i]["reset option reconfigure"] = "the scene is not built anew for one env of a batch"
        if run.seed < 0:
            missed[i]["the seed"] = "the recording does not know it: what the task drew at the reset is new"
        seed = [run.seed] if run.seed >= 0 else None
        # One by one: numbers that are drawn for several envs together are others than each would get alone.
        with blamed("reset", opened.loaded, task):
            task.reset(seed, [i], options)
    now = read_states(env)
    other = {i: not same_state(_of(now, i), run.state(0)) for i, run in runs.items()}
    wrong = {i: run.state(0) for i, run in runs.items() if other[i]}
    with blamed("restore", opened.loaded, task):
        for i, run in runs.items():
            if run.env_states:
                missed[i] |= state_mismatches(env, i, run.state(0))
        if wrong:
            write_states(env, wrong)
            settle_robot(env, list(wrong))
    return {i: Beginning(other[i], missed[i]) for i in runs}


def put_there(
    opened: OpenedTask, states: Mapping[int, Mapping[str, NDArray]], action: NDArray[np.float32] | None = None
) -> StepResult:
    """Put a recorded state into each of these envs, and let the task say what it is; as `TaskEnv.rescore`.

    Raises:
        TaskError: the task's code raised.
    """
    with blamed("restore", opened.loaded, opened.env):
        write_states(opened.env.env, states)
        return opened.env.rescore(action)


def arrive(
    opened: OpenedTask,
    run: RecordedRun,
    state: int,
    env_idx: Sequence[int],
    on_step: Callable[[int], None] = lambda done: None,
) -> tuple[StepResult, ReplayResult]:
    """Let envs stand at one state of a recorded run, all of them at the same; the others are not disturbed.

    Args:
        on_step: called with the number of steps that are lived through.

    Raises:
        TaskError: the task's code raised on the way; then the envs stand somewhere on it.
        IndexError: the run has no such state, or the task no such env.
    """
    task, env = opened.env, opened.env.env
    chosen = [int(i) for i in env_idx]
    if not 0 <= state <= run.length:
        raise IndexError(f"{run.name} has states 0 to {run.length}, not {state}")
    if not chosen or any(not 0 <= i < task.num_envs for i in chosen):
        raise IndexError(f"env_idx {chosen} is out of range for {task.num_envs} envs")
    others = [i for i in range(task.num_envs) if i not in chosen]
    why_not = why_not_replayed(opened, run)
    kept, reason = _kept(opened, others)
    why_not = why_not or reason
    corrected = 0
    with step_only(env, chosen, kept):
        beginnings = begin_again(opened, dict.fromkeys(chosen, run))
        missed = {what: why for each in beginnings.values() for what, why in each.missed.items()}
        if not why_not:
            for t in range(state):
                action: NDArray[np.float32] = run.action[t]
                rows = dict.fromkeys(chosen, action)
                with blamed("step", opened.loaded, task):
                    task.step(actions.action_of(task.parts, task.num_envs, rows))
                wanted = run.state(t + 1)
                if wanted and _far(env, chosen, wanted):
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
    way: Way = "put there" if why_not and state > 0 else "corrected" if corrected else "re-simulated"
    return step, ReplayResult(
        way,
        state,
        metres,
        radians,
        corrected,
        any(each.differs for each in beginnings.values()),
        missed,
    )


def why_not_replayed(opened: OpenedTask, run: RecordedRun) -> str:
    """Why the recorded actions cannot be made; empty where they can."""
    width = actions.width(opened.env.parts)
    recorded = run.action.shape[1] if run.action.ndim == 2 else 0
    if not np.isfinite(run.action).all():
        return "the recorded actions hold NaN or infinity: they were not made again"
    if width == recorded:
        return ""
    return f"the recorded actions have {recorded} numbers each, and this robot takes {width}: they were not made again"


def _kept(opened: OpenedTask, others: list[int]) -> tuple[Snapshot | None, str]:
    """What the envs that do not take part are put back to; where that cannot be had, why no step may be made."""
    if not others:
        return None, ""
    try:
        return opened.env.snapshot(others), ""
    except Exception as error:  # what a task keeps on itself is open
        return (
            None,
            f"the other envs cannot be put back after steps, since this task's state cannot be kept ({error})",
        )


def _of(states: Mapping[str, NDArray], env: int) -> dict[str, NDArray]:
    return {name: rows[env] for name, rows in states.items()}


def _far(env: object, chosen: list[int], wanted: Mapping[str, NDArray]) -> bool:
    metres, radians = _distance(env, chosen, wanted)
    return (metres or 0.0) > PARTED_METRES or (radians or 0.0) > PARTED_RADIANS


def _distance(
    env: object, chosen: list[int], wanted: Mapping[str, NDArray]
) -> tuple[float | None, float | None]:
    """Of the env that is furthest; None where nothing was recorded."""
    if not wanted:
        return None, None
    now = read_states(env)
    found = [state_distance(_of(now, i), wanted) for i in chosen]
    return max(metres for metres, _ in found), max(radians for _, radians in found)


def how(replay_result: ReplayResult) -> str:
    """One sentence: the way, and how near it came."""
    if replay_result.way == "put there":
        words = (
            "the recorded state was put in place; contacts, and what the task counts on itself, begin anew"
        )
    elif replay_result.way == "corrected":
        words = (
            f"its actions were made again, and its state put back at {replay_result.corrected} of {replay_result.steps} steps, "
            "where they had parted"
        )
    elif replay_result.steps == 0:
        words = "reset with its seed" + (", then its first state put in place" * replay_result.start_differs)
    else:
        words = "its actions were made again"
        words += " from its first state" if replay_result.start_differs else " from its seed"
    if replay_result.metres is None:
        words += "; it holds no states to compare with"
    elif replay_result.metres == 0 and not replay_result.radians:
        words += "; every body is where it was, to the last bit"
    else:
        words += f"; bodies are within {length(replay_result.metres)} of where they were"
    return words + "."
