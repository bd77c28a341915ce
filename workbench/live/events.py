"""What can happen to the run, and what is done about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from workbench.envs.inspection import Section
from workbench.envs.recorded_run import RecordedRun
from workbench.live.effects import Asked, Later
from workbench.live.messages import Event, Loaded, Request, TaskFailed
from workbench.live.process.heartbeat import Busy
from workbench.live.process.supervisor import Death
from workbench.task.description import TaskOptions


class Now(NamedTuple):
    """When an event happens."""

    monotonic: float
    """Seconds of `time.monotonic`."""
    wall: float
    """Seconds since the epoch."""


@dataclass(frozen=True)
class RunToEnter:
    """Put the selected env, or all, into the last state of a recorded run, and pause. Waits for a task to be loaded."""

    run: RecordedRun
    number: int
    """The value of `TimelineView.entered` when it is done."""
    everywhere: bool = False
    source_file: str | None = None
    source: Mapping[str, str] = field(default_factory=dict)
    """The task's source when it was recorded; changes since are reported with the result."""


# --- events that only the session knows, beside those of `protocol.messages` and `Asked` ----------


@dataclass(frozen=True)
class VersionLoaded:
    """The worker has loaded a version."""

    loaded: Loaded
    on_disk: bool
    """Whether the files still have its texts."""


@dataclass(frozen=True)
class LoadDone:
    """All that follows from a load has been asked of the worker."""


@dataclass(frozen=True)
class LoadPreempted:
    """A load was interrupted because a newer version waits."""

    failed: TaskFailed


@dataclass(frozen=True)
class WorkerDied:
    """The worker is gone."""

    death: Death
    printed: str
    """Its last lines."""


@dataclass(frozen=True)
class WorkerBusy:
    """The worker has been at one piece of work for long; None when it is done."""

    busy: Busy | None


@dataclass(frozen=True)
class FileSaved:
    """A watched file of the task was saved."""


@dataclass(frozen=True)
class PolicySaved:
    """The file of the acting policy was saved."""


@dataclass(frozen=True)
class PagesCounted:
    """So many pages are open. With none, no picture is rendered."""

    count: int


@dataclass(frozen=True)
class SettingsChanged:
    """Change these fields of `Settings`."""

    values: Mapping[str, Any]


@dataclass(frozen=True)
class OptionsApplied:
    """Make the envs with other options. If the task fails with them, the present envs and options stay."""

    options: TaskOptions


@dataclass(frozen=True)
class FileOpened:
    """Open a task class of another file instead."""

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
class PastPicturesWanted:
    """Draw the pictures that the shown moment lacks, if it is still the same."""

    at: object
    """`Run.stands_at` when this was asked for."""


@dataclass(frozen=True)
class ActionTold:
    """Tell envs (all if None) these numbers of their action, while its source is ``sliders``; without any, to hold still."""

    dimensions: tuple[int, ...]
    values: tuple[float, ...]
    env_idx: tuple[int, ...] | None = None


@dataclass(frozen=True)
class ReadingChosen:
    """Read these sections of the selected env from now on, while pages are open; without any, nothing."""

    sections: tuple[Section, ...]


@dataclass(frozen=True)
class ReadingDue:
    """The time of a reading that was scheduled has come."""


@dataclass(frozen=True)
class EnvsReset:
    """Reset these envs with fresh seeds; all, with the session's seed, if None."""

    env_idx: tuple[int, ...] | None = None


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
    | PastPicturesWanted
    | ActionTold
    | ReadingChosen
    | ReadingDue
    | EnvsReset
    | RunToEnter
)


# --- effects --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Send:
    """Send this to the worker."""

    request: Request


@dataclass(frozen=True)
class ReplaceWorker:
    """End the worker, and start another."""


@dataclass(frozen=True)
class InterruptWorker:
    """Interrupt the author's code, if it is running."""


@dataclass(frozen=True)
class Follow:
    """Watch these files from now on."""

    files: frozenset[Path]
    texts: Mapping[str, str] = field(default_factory=dict)
    """Texts by path as they were loaded; a file that differs was saved since."""


@dataclass(frozen=True)
class FollowPolicy:
    """Watch the file of this policy, or none, from now on."""

    policy: str | None
    folder: Path | None


RunEffect = Send | ReplaceWorker | InterruptWorker | Follow | FollowPolicy | Later
