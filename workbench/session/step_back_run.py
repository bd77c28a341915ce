"""The worker's part in stepping into a recording: go there, and say in a sentence how that was done."""

from __future__ import annotations

from collections.abc import Callable

from workbench.core.step import StepResult
from workbench.session.changed_since import changed_since
from workbench.session.messages import NO_MOMENT, Restored, StepBack
from workbench.session.number_text import length
from workbench.session.open_task import OpenedTask
from workbench.session.relive import Arrival, arrive


def step_back(
    opened: OpenedTask, request: StepBack, on_step: Callable[[int], None]
) -> tuple[StepResult, Restored]:
    """Let the envs of `request` stand at the last state of its run.

    Raises:
        TaskError: the task's code raised on the way; the envs stand somewhere on it.
    """
    run = request.run
    step, arrival = arrive(opened, run, run.length, request.env_idx, on_step)
    source = request.env_idx
    where = f"{run.name}, step {run.length}"
    loaded = opened.loaded
    file = None if loaded.file is None else str(loaded.file)
    changed = changed_since(request.source_file, request.source, file, loaded.source)
    said = f"{where} (changed since: {changed}): {how(arrival)}" if changed else f"{where}: {how(arrival)}"
    return step, Restored(
        request.env_idx, source, NO_MOMENT, None, arrival.missed, where, said, number=request.number
    )


def going_there(request: StepBack, done: int) -> str:
    """For the status line, while it takes long."""
    return f"going to {request.run.name}: step {done} of {request.run.length}"


def how(arrival: Arrival) -> str:
    """One sentence: the way, and how near it came."""
    if arrival.way == "put there":
        words = (
            "the recorded state was put in place; contacts, and what the task counts on itself, begin anew"
        )
    elif arrival.way == "corrected":
        words = (
            f"its actions were made again, and its state put back at {arrival.corrected} of {arrival.steps} steps, "
            "where they had parted"
        )
    elif arrival.steps == 0:
        words = "reset with its seed" + (", then its first state put in place" * arrival.begins_otherwise)
    else:
        words = "its actions were made again"
        words += " from its first state" if arrival.begins_otherwise else " from its seed"
    if arrival.metres is None:
        words += "; it holds no states to compare with"
    elif arrival.metres == 0 and not arrival.radians:
        words += "; every body is where it was, to the last bit"
    else:
        words += f"; bodies are within {length(arrival.metres)} of where they were"
    return words + "."
