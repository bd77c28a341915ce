"""Goes back to a past moment, or into a recording."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Mapping
from itertools import count

from workbench.envs import action_vector as actions
from workbench.envs.simulation.cpu_system import batched_system
from workbench.envs.snapshots.snapshot import (
    RestoreReport,
    Snapshot,
    in_this_state,
    restore_memory,
    restore_snapshot,
    step_only,
)
from workbench.envs.step_result import StepResult
from workbench.episodes.recorded_source import changed_since
from workbench.episodes.replay import replay_text, replay_to
from workbench.live.messages import EnterRecording, Restore
from workbench.task.blame import blamed
from workbench.task.description import NO_MOMENT, Restored
from workbench.task.open import OpenedTask
from workbench.task.problem import Interrupted, TaskError

MAX_REPLAY_SECONDS = 8.0
"""Timeout of a replay; then the state of the moment is restored instead."""


def go_back(
    opened: OpenedTask, request: Restore, on_step: Callable[[int, int], None]
) -> tuple[StepResult, Restored]:
    """Put the envs of `request` back to its moment: by a replay if possible, else by restoring its state.

    A restored state lacks the internal state of PhysX, above all contacts, so a run continues differently if bodies press
    on each other (`envs.snapshots.snapshot`; ``tests/benchmarks/restore_distance.py`` measures the
    difference). But an episode begins without internal state (`envs.snapshots.snapshot.begin_anew`), and so
    does a run from a restored moment. These are exact points: the same actions lead from them to the same
    moment, contacts included. The replayed state is compared with the moment byte by byte. If the two
    differ (the code was edited, or the task draws random numbers for all envs at once), the moment's state is
    restored. State outside PhysX comes from the moment's snapshot in both cases.

    Args:
        on_step: called with the number of steps replayed so far, and with the number of all steps to replay.

    Raises:
        TaskError: the task's code raised at the moment itself, not during a replay.
    """
    task, env = opened.env, opened.env.env
    snapshot: Snapshot = pickle.loads(request.snapshot)
    source = dict(zip(request.env_idx, request.source, strict=True))
    replayed = _replay_steps(opened, request, snapshot, source, on_step)
    put = [i for i in request.env_idx if i not in replayed]
    report = RestoreReport((), {})
    with blamed("restore", opened.loaded, task):
        if put:
            report = restore_snapshot(env, snapshot, put, [source[i] for i in put])
        if replayed:
            # All requested envs in one call: only a call for the whole batch restores the random generators.
            every, own = list(source), all(i == of for i, of in source.items())
            positions = [snapshot.env_idx.index(of) for of in source.values()]
            whole = own and snapshot.num_envs == env.num_envs == len(every)
            _, missed = restore_memory(env, snapshot.memory, every, positions, whole)
            report = RestoreReport((), {**missed, **_of_simulation(report)})
        step = task.rescore()
    steps = max((len(request.ways[i].actions) for i in replayed), default=0)
    return step, Restored(
        request.env_idx,
        request.source,
        request.origin,
        request.undoes,
        report.not_carried,
        how=_how(request, len(replayed), len(put), steps),
        replayed=tuple(replayed),
    )


def _replay_steps(
    opened: OpenedTask,
    request: Restore,
    snapshot: Snapshot,
    source: Mapping[int, int],
    on_step: Callable[[int, int], None],
) -> list[int]:
    """Replay all paths; returns the envs whose state then equals that of the moment byte by byte."""
    task, env = opened.env, opened.env.env
    width = actions.width(task.parts)
    ways = {i: way for i, way in request.ways.items() if way.actions.shape[1:] == (width,)}
    px = batched_system(env.scene)
    if px is None or not ways:
        return []
    others = [i for i in range(task.num_envs) if i not in ways]
    starts = {number: pickle.loads(start) for number, start in request.starts.items()}
    total = max(len(way.actions) for way in ways.values())
    began = time.monotonic()
    try:
        with step_only(env, [*ways], task.snapshot(others) if others else None):
            for done in count():
                # Shorter paths begin later, so that all end at the same step.
                for number, start in starts.items():
                    begin = [
                        i for i, w in ways.items() if w.start == number and total - len(w.actions) == done
                    ]
                    if begin:
                        restore_snapshot(env, start, begin, [ways[i].source for i in begin])
                if done == total:
                    break
                waiting = [i for i, way in ways.items() if total - len(way.actions) > done]
                px.freeze_envs({*others, *waiting})
                at = {i: max(0, done - total + len(way.actions)) for i, way in ways.items()}
                rows = {i: way.actions[at[i]] for i, way in ways.items()}
                with blamed("step", opened.loaded, task):
                    task.step(actions.action_of(task.parts, task.num_envs, rows))
                on_step(done + 1, total)
                if time.monotonic() - began > MAX_REPLAY_SECONDS:
                    return []
            return [i for i in ways if in_this_state(env, i, snapshot, source[i])]
    except TaskError as error:
        if isinstance(error.__cause__, Interrupted):
            raise
        return []  # an edited hook failed during the replay; only an error at the moment itself is reported


def _of_simulation(report: RestoreReport) -> dict[str, str]:
    """The entries of `not_carried` about physics; `restore_memory` reports the task's own state."""
    return {what: why for what, why in report.not_carried.items() if what.startswith("fresh physics")}


def _how(request: Restore, replayed: int, put: int, steps: int) -> str:
    if not replayed or steps == 0:
        return ""
    again = f"{steps} steps were replayed, and " if steps > 1 else "one step was replayed, and "
    if not put:
        return f"{again}every body is where it was, to the last bit."
    return (
        f"{again}in {replayed} of {replayed + put} envs every body is where it was, to the last bit; "
        "the other envs were restored from the snapshot."
    )


def going_back_text(done: int, total: int) -> str:
    """Text of the status line while going back."""
    return f"going back: step {done} of {total}"


# --- into a recording ----------------------------------------------------------------------------------


def enter_recording(
    opened: OpenedTask, request: EnterRecording, on_step: Callable[[int], None]
) -> tuple[StepResult, Restored]:
    """Put the envs of `request` into the last state of its run.

    Raises:
        TaskError: the task's code raised during the replay; the envs stay in the state at the error.
    """
    run = request.run
    step, replay_result = replay_to(opened, run, run.length, request.env_idx, on_step)
    source = request.env_idx
    where = f"{run.name}, step {run.length}"
    loaded = opened.loaded
    file = None if loaded.file is None else str(loaded.file)
    changed = changed_since(request.source_file, request.source, file, loaded.source)
    text = (
        f"{where} (changed since: {changed}): {replay_text(replay_result)}"
        if changed
        else f"{where}: {replay_text(replay_result)}"
    )
    return step, Restored(
        request.env_idx, source, NO_MOMENT, None, replay_result.missed, where, text, number=request.number
    )


def entering_text(request: EnterRecording, done: int) -> str:
    """Text of the status line while entering a recording."""
    return f"going to {request.run.name}: step {done} of {request.run.length}"
