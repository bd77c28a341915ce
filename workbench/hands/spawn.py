"""The range in which resets put a body: measured in the background process, and dragged by a person."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from workbench.checks.state import load_version
from workbench.hands.commands import HideSpawn, SetSpawnSide, Side, WriteSpawn
from workbench.hands.questions import EpisodeStart, ReadStart
from workbench.hands.spawn_source import AXES, MIN_WIDTH_METRES, Range, measure_spawn, why_no_range
from workbench.hands.start_edit import SpawnRange, StartWanted, seeds_to_try
from workbench.live.effects import Asked, Then
from workbench.live.events import VersionLoaded
from workbench.live.messages import Load
from workbench.live.process.ask import Background
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.live.run import Run
from workbench.machine.loop import do
from workbench.page.command import Command, Refused
from workbench.task.description import TaskDescription
from workbench.task.problem import Problem

DOES: frozenset[type[Command]] = frozenset({HideSpawn, SetSpawnSide, WriteSpawn})
"""Commands that `apply` handles."""
Ranges = tuple[Range | None, Range | None]
"""Range of x and of y; None if no single uniform number gives the coordinate."""
_DECIMALS = 4
_MAX_METRES = 1e3


@dataclass(frozen=True)
class SpawnBox:
    """The range in which resets put one body. Also the view of this feature."""

    stage: Literal["none", "measuring", "measured", "failed"] = "none"
    number: int = 0
    """Number of the measurement; results of older ones are dropped."""
    body: str = ""
    seen: tuple[Range, Range] = ((0.0, 0.0), (0.0, 0.0))
    """Smallest and largest x, and y, of the measured resets, in metres in the env's frame."""
    measured: Ranges = (None, None)
    """Ranges in the file."""
    wanted: Ranges = (None, None)
    """Ranges that a person chose."""
    why: str = ""
    """Why the measurement failed."""
    problem: Problem | None = None
    """The error that the author's code raised."""

    @property
    def sides(self) -> tuple[Range, Range]:
        """x and y of the sides of the box."""
        x, y = (seen if to is None else to for seen, to in zip(self.seen, self.wanted, strict=True))
        return x, y


@dataclass(frozen=True)
class SpawnAsked:
    """A person asks for the range of a body."""

    body: str


@dataclass(frozen=True)
class SpawnDragged:
    """A person drags a side of the box."""

    side: Side
    to: float
    """In metres, in the env's frame."""


@dataclass(frozen=True)
class SpawnMeasured:
    """The range in the file."""

    number: int
    seen: tuple[Range, Range]
    ranges: Ranges


@dataclass(frozen=True)
class SpawnFailed:
    """The range could not be measured."""

    number: int
    why: str
    problem: Problem | None


@dataclass(frozen=True)
class MeasureSpawn:
    """Reset this version with these seeds; a running measurement is stopped."""

    number: int
    task: TaskDescription
    load: Load
    seeds: tuple[int, ...]
    body: str


@dataclass(frozen=True)
class EndSpawn:
    """Stop the measurement."""


SpawnEvent = SpawnAsked | SpawnDragged | SpawnMeasured | SpawnFailed
SpawnEffect = MeasureSpawn | EndSpawn
Change = tuple[SpawnBox, list[Any]]


def apply(box: SpawnBox, event: object, run: Run) -> Change:
    """The box after an event, and the effects to perform. A new version is measured again.

    Raises:
        Refused: the command makes no sense now.
    """
    match event:
        case SpawnAsked(body=body):
            return _measure(box, run, body)
        case Asked(command=HideSpawn()):
            return SpawnBox(number=box.number + 1), [EndSpawn()]
        case VersionLoaded() if box.stage != "none":
            if run.task is None or box.body not in run.task.geometry.body_names:
                return SpawnBox(number=box.number + 1), [EndSpawn()]
            return _measure(box, run, box.body)
        case SpawnMeasured(number=box.number, seen=seen, ranges=ranges):
            return replace(box, stage="measured", seen=seen, measured=ranges, wanted=ranges), []
        case SpawnFailed(number=box.number, why=why, problem=problem):
            return replace(box, stage="failed", why=why, problem=problem), []
        case Asked(command=SetSpawnSide(side=side, to=to)) | SpawnDragged(side=side, to=to):
            return replace(box, wanted=_moved(box, side, to)), []
        case Asked(command=WriteSpawn()):
            if box.stage != "measured":
                raise Refused("Measure the range first: press Spawn range.")
            return box, [Then(StartWanted(SpawnRange(box.body, *box.wanted)))]
    return box, []


def _measure(box: SpawnBox, run: Run, body: str) -> Change:
    load = run.running_load()
    if run.task is None or load is None:
        raise Refused("No task is loaded yet.")
    if body not in run.task.geometry.body_names:
        raise Refused("The task has no such body.")
    # The box of an older version stays in view until the new one is measured.
    kept = box if box.body == body else SpawnBox(body=body)
    asked = replace(kept, stage="measuring", number=box.number + 1)
    return asked, [MeasureSpawn(asked.number, run.task, load, seeds_to_try(run), body)]


def _moved(box: SpawnBox, side: Side, to: float) -> Ranges:
    """The ranges with one side at another coordinate; a side never passes the opposite one."""
    axis, is_max = AXES.index(side[0]), side.endswith("max")
    found = box.wanted[axis]
    if box.stage != "measured":
        raise Refused("The range is not measured yet.")
    if found is None:
        raise Refused(f"{why_no_range(AXES[axis], box.body)}, so its range cannot be set.")
    if not math.isfinite(to) or abs(to) > _MAX_METRES:
        raise Refused(f"A side of the range is a number of metres up to {_MAX_METRES:g}.")
    to = round(to, _DECIMALS)
    low, high = found
    moved = (low, max(to, low + MIN_WIDTH_METRES)) if is_max else (min(to, high - MIN_WIDTH_METRES), high)
    x, y = (moved if of == axis else kept for of, kept in enumerate(box.wanted))
    return x, y


class SpawnJobs:
    """Performs the effects: one measurement at a time. Used on the loop, except `close`."""

    def __init__(self, process: Background, dispatch: Callable[[SpawnEvent], object]) -> None:
        """
        Args:
            process: the background process, which resets the task.
            dispatch: handles the resulting events.
        """
        self._process, self._dispatch = process, dispatch
        self._jobs = Jobs(lambda: None, self._failed)
        self._number = 0

    def perform(self, effect: SpawnEffect) -> None:
        match effect:
            case MeasureSpawn():
                self._number = effect.number
                self._jobs.start("the spawn range", lambda job: self._measure(job, effect))
            case EndSpawn():
                self._jobs.stop()

    def close(self) -> None:
        """Stop, and begin no more jobs. May be called on any thread."""
        do(self._jobs.close)

    async def _measure(self, job: Job, effect: MeasureSpawn) -> None:
        async def ask() -> Sequence[EpisodeStart]:
            await load_version(self._process, job, effect.load)
            texts = effect.task.source
            return [await self._process.ask(ReadStart(seed, texts)) for seed in effect.seeds]

        starts = await self._process.in_turns(job, ask)
        spawn = measure_spawn(starts, effect.task.geometry.body_names.index(effect.body))
        if spawn is None:
            self._dispatch(SpawnFailed(effect.number, f"no env has {effect.body}", None))
        else:
            self._dispatch(SpawnMeasured(effect.number, spawn.seen, spawn.ranges))

    def _failed(self, failure: JobFailed) -> None:
        self._dispatch(SpawnFailed(self._number, str(failure), failure.problem))
