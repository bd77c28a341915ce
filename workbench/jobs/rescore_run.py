"""Recorded episodes lived through again by a batch of envs, as many at once as there are envs.

Each env takes an episode, begins it as it began (`relive.begin_again`), makes its actions, and takes the next when it
is through, whatever the others are at. What the task says of every state is noted, and how far its bodies are from the
record. Envs that have none left stand still.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from workbench.authoring.problem import TaskError
from workbench.core.capture.recorded_run import RecordedRun
from workbench.core.capture.recorded_state import read_states, state_distance
from workbench.core.env import actions
from workbench.core.env.step_result import StepResult
from workbench.core.snapshots.snapshot import step_only
from workbench.jobs.from_recording import run_of
from workbench.jobs.open_task import OpenedTask, blamed
from workbench.jobs.replay import begin_again, put_there, why_not_replayed
from workbench.jobs.verdict import Rescore, Rescored, Scores, Verdict, compare, single_numbers
from workbench.recording.episode.episode import Episode
from workbench.recording.episode.row import Source, UnreadableRecording
from workbench.recording.reader.reading import read_source

_TELL_EVERY = 0.2
"""Seconds."""


@dataclass
class _Seat:
    """An episode that can be judged, and what is said of it in the env that lives through it."""

    file: Source
    task: str
    run: RecordedRun
    missed: dict[str, str]
    """What of it cannot be read or be put into the env, and why."""
    start_differs: bool = False
    reward: list[float] = field(default_factory=list)
    """(T,) What the task says of it now, as the following."""
    evaluate: dict[str, list[float]] = field(default_factory=dict)
    """(T + 1,) each."""
    drift: list[tuple[float, float]] = field(default_factory=list)
    """(T + 1,) metres and radians from the record, where it has states."""

    @property
    def at(self) -> int:
        """The state that it is in."""
        return len(self.reward)

    def verdict(self) -> Verdict[Source]:
        run = self.run
        # A recording of somebody else's that holds no rewards: there is nothing to compare with.
        old = np.zeros(0) if np.isnan(run.reward).all() else run.reward
        now = {name: np.array(rows) for name, rows in self.evaluate.items()}
        return compare(
            self.file,
            Scores(old, single_numbers(run.evaluate)),
            Scores(np.array(self.reward), now),
            np.array(self.drift) if run.env_states else None,
            task=self.task,
            seed=run.seed,
            start_differs=self.start_differs,
            missed=self.missed,
        )


def rescore(
    opened: OpenedTask,
    files: Iterable[Source],
    *,
    use_env_states: bool = False,
    on_steps: Callable[[int], None] = lambda steps: None,
    read: Callable[[Source], Episode] = read_source,
) -> Iterator[Verdict[Source]]:
    """Judge these episodes with the code that is open; a verdict for each, in the order in which they end.

    Args:
        use_env_states: put every recorded state in after its step, so that nothing drifts.
        on_steps: called with the number of control steps of all episodes that were made so far.
        read: gives the episode of a file; raises as `read_source`.

    Raises:
        TaskError: the task's code raised.
    """
    task = opened.env
    waiting = iter(files)
    seats: dict[int, _Seat] = {}
    steps = 0
    more = True
    while more or seats:
        begun: dict[int, _Seat] = {}
        while more and len(seats) + len(begun) < task.num_envs:
            file = next(waiting, None)
            if file is None:
                more = False
                break
            told = _ready(opened, file, use_env_states, read)
            if isinstance(told, Verdict):
                yield told
            else:
                env = next(i for i in range(task.num_envs) if i not in seats and i not in begun)
                begun[env] = told
        if begun:
            _begin(opened, begun)
            seats |= begun
        if not seats:
            continue
        _one_step(opened, seats, use_env_states)
        steps += len(seats)
        on_steps(steps)
        for env in [env for env, seat in seats.items() if seat.at == seat.run.length]:
            yield seats.pop(env).verdict()


def answer(opened: OpenedTask, request: Rescore, tell: Callable[[int, int, Rescored], None]) -> Rescored:
    """Carry out `request` in a worker.

    Args:
        tell: called a few times a second with the control steps so far and what is new.

    Returns:
        what is new since then.
    """
    told, steps = time.monotonic(), 0
    ready: list[Verdict[Source]] = []

    def on_steps(now: int) -> None:
        nonlocal told, steps
        steps = now
        if time.monotonic() - told > _TELL_EVERY:
            told = time.monotonic()
            tell(steps, 0, Rescored(tuple(ready), steps))
            ready.clear()

    try:
        for verdict in rescore(
            opened, request.files, use_env_states=request.use_env_states, on_steps=on_steps
        ):
            ready.append(verdict)
    except TaskError as error:
        return Rescored(tuple(ready), steps, error.problem)
    return Rescored(tuple(ready), steps)


def _ready(
    opened: OpenedTask, file: Source, use_env_states: bool, read: Callable[[Source], Episode]
) -> _Seat | Verdict[Source]:
    try:
        episode = read(file)
    except (UnreadableRecording, OSError) as error:
        return Verdict(file, why_not=str(error))
    run, info = run_of(episode), episode.info
    why_not = why_not_replayed(opened, run)
    if run.length == 0:
        why_not = "it has no step"
    elif use_env_states and not run.env_states:
        why_not = "it holds no env states"
    if why_not:
        why_not = ". ".join((why_not, *(broken.sentence for broken in episode.broken_files)))
        return Verdict(file, task=info.task, seed=info.seed, length=run.length, why_not=why_not)
    return _Seat(file, info.task, run, {broken.file: broken.what for broken in episode.broken_files})


def _begin(opened: OpenedTask, seats: dict[int, _Seat]) -> None:
    task = opened.env
    beginnings = begin_again(opened, {env: seat.run for env, seat in seats.items()})
    with blamed("restore", opened.loaded, task):
        first = task.rescore()
    now = read_states(task.env)
    for env, seat in seats.items():
        seat.start_differs = beginnings[env].differs
        seat.missed = beginnings[env].missed | seat.missed
        _hear(seat, first, env, now)


def _one_step(opened: OpenedTask, seats: dict[int, _Seat], use_env_states: bool) -> None:
    task = opened.env
    rows = {env: seat.run.action[seat.at] for env, seat in seats.items()}
    action = actions.action_of(task.parts, task.num_envs, rows)
    others = step_only(task.env, [*seats], None) if len(seats) < task.num_envs else nullcontext()
    with others, blamed("step", opened.loaded, task):
        step = task.step(action)
    now = read_states(task.env)
    if use_env_states:
        step = put_there(opened, {env: seat.run.state(seat.at + 1) for env, seat in seats.items()}, action)
        now = read_states(task.env)
    for env, seat in seats.items():
        seat.reward.append(float(step.reward[env]))
        _hear(seat, step, env, now)


def _hear(seat: _Seat, step: StepResult, env: int, now: dict[str, NDArray[np.float32]]) -> None:
    for name, values in single_numbers(step.evaluate).items():
        rows = seat.evaluate.setdefault(name, [])
        # The terms of a reward are there from the first step on.
        rows += [np.nan] * (seat.at - len(rows))
        rows.append(float(values[env]))
    recorded = seat.run.state(seat.at)
    far = (
        state_distance({name: rows[env] for name, rows in now.items()}, recorded) if recorded else (0.0, 0.0)
    )
    seat.drift.append(far)
