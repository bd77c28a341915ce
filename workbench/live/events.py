"""Events of the run, and the effects that follow from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from workbench.envs.inspection import Section
from workbench.envs.recorded_run import RecordedRun
from workbench.live.effects import Asked, Later
from workbench.live.history.env_table import EnvEvent
from workbench.live.messages import Event, Loaded, Request, TaskFailed
from workbench.live.process.heartbeat import Busy
from workbench.live.process.supervisor import Death
from workbench.task.description import TaskOptions


class Now(NamedTuple):
    """Time of an event."""

    monotonic: float
    """`time.monotonic()` in seconds."""
    wall: float
    """Seconds since the epoch."""


@dataclass(frozen=True)
class RunToEnter:
    """Put the selected env, or all envs, into the last state of a recorded run, and pause. Without a task
    this is done as soon as one is loaded."""

    run: RecordedRun
    number: int
    """Value of `TimelineView.entered` when this is done."""
    everywhere: bool = False
    source_file: str | None = None
    source: Mapping[str, str] = field(default_factory=dict)
    """The task's source when the run was recorded; later changes of the source are reported with the
    result."""


# --- events of the session; all other events are `Asked` and those of `live.messages` -------------


@dataclass(frozen=True)
class VersionLoaded:
    """The worker has loaded a version."""

    loaded: Loaded
    on_disk: bool
    """Whether the files on disk still equal the loaded texts."""


@dataclass(frozen=True)
class LoadDone:
    """All requests that follow from a load were sent to the worker."""


@dataclass(frozen=True)
class LoadPreempted:
    """A load was interrupted because a newer version waits."""

    failed: TaskFailed


@dataclass(frozen=True)
class WorkerDied:
    """The worker has ended."""

    death: Death
    printed: str
    """The last lines of the worker's output."""


@dataclass(frozen=True)
class WorkerBusy:
    """The worker has been busy with one piece of work for long; `busy` is None when that work is done."""

    busy: Busy | None


@dataclass(frozen=True)
class FileSaved:
    """A watched file of the task was saved."""


@dataclass(frozen=True)
class PolicySaved:
    """The file of the acting policy was saved."""


@dataclass(frozen=True)
class PagesCounted:
    """The number of open pages changed. Without open pages, no picture is rendered."""

    count: int


@dataclass(frozen=True)
class SettingsChanged:
    """Change these fields of `Settings`."""

    values: Mapping[str, Any]


@dataclass(frozen=True)
class OptionsApplied:
    """Rebuild the envs with other options. If the task fails with them, the present envs and options stay."""

    options: TaskOptions


@dataclass(frozen=True)
class FileOpened:
    """Open a task class of another file in place of the present task."""

    file: Path
    class_name: str


@dataclass(frozen=True)
class MomentShown:
    """Show the moment of this serial (None: live), in this env (None: the selected one)."""

    serial: int | None
    env: int | None = None


@dataclass(frozen=True)
class EpisodeStepShown:
    """Select an env and show a step of its shown episode."""

    env: int
    step: int


@dataclass(frozen=True)
class EnvEventShown:
    """Select an env and show its newest event of this kind, in the present or an earlier episode."""

    env: int
    event: EnvEvent


@dataclass(frozen=True)
class PastPicturesWanted:
    """Draw the missing pictures of the shown moment, unless another moment is shown by now."""

    at: object
    """`Run.stands_at` when this was requested."""


@dataclass(frozen=True)
class SlidersMoved:
    """Set these dimensions of the action of some envs (None: all), while the source of actions is
    ``sliders``. Without dimensions, the envs hold still."""

    dimensions: tuple[int, ...]
    values: tuple[float, ...]
    env_idx: tuple[int, ...] | None = None


@dataclass(frozen=True)
class ReadingChosen:
    """Read these sections and this body of the selected env from now on, while pages are open; empty: stop reading."""

    sections: tuple[Section, ...]
    body: str = ""


@dataclass(frozen=True)
class ReadingDue:
    """A scheduled reading is due."""


@dataclass(frozen=True)
class EnvsReset:
    """Reset these envs. None: reset all with the session's seed."""

    env_idx: tuple[int, ...] | None = None
    seed: int | None = None
    """Seed of these envs; None continues the task's random numbers."""


RunEvent = (
    Event
    | Asked
    | VersionLoaded
    | LoadDone
    | LoadPreempted
    | WorkerDied
    | WorkerBusy
    | FileSaved
    | PolicySaved
    | PagesCounted
    | SettingsChanged
    | OptionsApplied
    | FileOpened
    | MomentShown
    | EpisodeStepShown
    | EnvEventShown
    | PastPicturesWanted
    | SlidersMoved
    | ReadingChosen
    | ReadingDue
    | EnvsReset
    | RunToEnter
)


# --- effects --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Send:
    """Send this request to the worker."""

    request: Request


@dataclass(frozen=True)
class ReplaceWorker:
    """End the worker and start another."""


@dataclass(frozen=True)
class InterruptWorker:
    """Interrupt the author's code, if it is running."""


@dataclass(frozen=True)
class Follow:
    """Watch these files from now on."""

    files: frozenset[Path]
    texts: Mapping[str, str] = field(default_factory=dict)
    """The loaded texts by path; a file with another text was saved since the load."""


@dataclass(frozen=True)
class FollowPolicy:
    """From now on, watch the file of this policy; None: watch no file."""

    policy: str | None
    folder: Path | None


RunEffect = Send | ReplaceWorker | InterruptWorker | Follow | FollowPolicy | Later
