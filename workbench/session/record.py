"""Record episodes from the command line, without a page: as many envs at once as asked for.

Each episode is started by a reset of its env alone with a seed of its own (the first seed, counting
up), so that episode k of a recording is the one that ``gym.make(...).reset(seed=seed + k)`` starts,
whatever the number of envs. Envs whose episode ends take the next; when all are begun, those that are
done wait for the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from workbench.authoring.reference import named_file
from workbench.core.pictures import Picture
from workbench.core.step import StepResult
from workbench.core.take_pictures import take_pictures
from workbench.recording.episode import Episode
from workbench.recording.rrd import episode_filename, write_rrd
from workbench.session.acting import Acting
from workbench.session.episodes import EpisodeGatherer, recorded_pictures
from workbench.session.messages import Stepped, TaskOptions
from workbench.session.open_task import OpenedTask, open_task, reset_checked, step_checked

_STEPS_WITHOUT_LIMIT = 200


@dataclass(frozen=True)
class RecordOptions:
    task: str
    out: Path
    episodes: int = 4
    actions: str = "random"
    """``random``, ``zero``, ``hold``, or a policy ``module:function`` or ``file.py:function``."""
    pictures: bool = True
    max_steps: int | None = None
    """Longest episode; None takes the task's own limit, or 200 steps where it has none."""
    options: TaskOptions = field(default_factory=lambda: TaskOptions(num_envs=4))


@dataclass(frozen=True)
class Written:
    path: Path
    steps: int
    total_reward: float
    success: bool | None


@dataclass(frozen=True)
class Progress:
    episodes: int
    """Episodes written so far."""
    steps: int
    """Control steps of the batch so far."""


def record(
    what: RecordOptions,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> list[Written]:
    """Record `what.episodes` episodes into `what.out`, one file each.

    Raises:
        TaskError: the task cannot be opened, or fails while it runs.
        RecordingError: a file cannot be written.
    """
    if what.episodes < 1:
        raise ValueError(f"episodes must be at least 1, not {what.episodes}")
    torch.set_num_threads(1)  # see workbench.session.worker.work
    opened = open_task(what.task, what.options, on_activity=on_activity)
    written: list[Written] = []

    def keep(episode: Episode) -> None:
        success = episode.evaluate.get("success")
        path = write_rrd(episode, what.out / episode_filename(episode.info))
        ended_well = None if success is None else bool(np.any(success[-1]))
        written.append(Written(path, len(episode.reward), float(episode.reward.sum()), ended_well))

    try:
        _run(opened, what, keep, lambda steps: on_progress(Progress(len(written), steps)))
    finally:
        opened.env.close()
    return written


def _run(
    opened: OpenedTask,
    what: RecordOptions,
    keep: Callable[[Episode], None],
    on_steps: Callable[[int], None],
) -> None:
    env, seed = opened.env, what.options.seed
    envs = list(range(min(what.episodes, env.num_envs)))
    gatherer = EpisodeGatherer(opened.description, envs, keep)
    limit = what.max_steps or opened.description.max_episode_steps or _STEPS_WITHOUT_LIMIT
    acting = _acting(what)
    begun = steps = 0
    running: set[int] = set()
    while True:
        for index in envs:
            if index not in running and begun < what.episodes:
                _begin(opened, gatherer, index, seed + begun, what.pictures)
                running.add(index)
                begun += 1
        if not running:
            return
        step = step_checked(env, opened.loaded, acting.next_action(env))
        gatherer.take(_stepped(opened, step, None, sorted(running) if what.pictures else [], None))
        for index in sorted(running):
            over = bool(step.terminated[index] or step.truncated[index])
            if over or step.elapsed_steps[index] >= limit:
                gatherer.end(index)
                running.discard(index)
        steps += 1
        on_steps(steps)


def _begin(opened: OpenedTask, gatherer: EpisodeGatherer, index: int, seed: int, pictures: bool) -> None:
    step = reset_checked(opened.env, opened.loaded, seed, [index])
    gatherer.take(_stepped(opened, step, index, [index] if pictures else [], opened.env.episode_seeds))


def _stepped(
    opened: OpenedTask, step: StepResult, reset: int | None, pictured: list[int], seeds: np.ndarray | None
) -> Stepped:
    mask = np.zeros(opened.env.num_envs, bool)
    if reset is not None:
        mask[reset] = True
    wanted = recorded_pictures(opened.description.cameras)
    captured: tuple[Picture, ...] = ()
    for index in pictured:
        captured += take_pictures(opened.env.env, index, wanted)
    return Stepped(step, mask, captured, seeds)


def _acting(what: RecordOptions) -> Acting:
    acting = Acting()
    acting.seed(what.options.seed)
    if what.actions in ("hold", "zero", "random"):
        acting.use(what.actions, None)
    else:
        file = named_file(what.task)
        acting.use("policy", what.actions, None if file is None else file.parent)
    return acting
