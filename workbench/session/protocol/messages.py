"""The words that the server and its worker say to each other: plain dataclasses over one pipe, read by their types
(`wire`).

The worker owns the env; the server owns the page. Requests go one way and are handled in order,
between control steps; events come back. Nothing here may hold a torch tensor or a SAPIEN object:
whatever crosses is numpy and plain data, so that a dying worker can take nothing with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from workbench.authoring.loading.reference import TaskName
from workbench.authoring.problem import Problem
from workbench.core.camera_data import CameraInfo, CameraKey, CameraKind, CameraSettings, Picture
from workbench.core.capture.inspection import Inspection, Section
from workbench.core.capture.recorded_run import RecordedRun
from workbench.core.env.step_result import StepResult
from workbench.core.rules import Finding
from workbench.jobs.pool import Answer, Progress
from workbench.jobs.task import ActionSource, Stepped, TaskDescription, TaskOptions
from workbench.machine.processes.wire import Call, Question

LoadLevel = Literal["auto", "patched", "cameras", "rebuilt"]
"""How a new version is to come in; ``auto`` for the least that is safe. See `workbench.authoring.reload.level`."""
ReloadLevel = Literal["same", "patched", "cameras", "rebuilt", "restarted"]
SCENE_KEPT: frozenset[ReloadLevel] = frozenset({"same", "patched", "cameras"})
"""Levels that leave the env, its episodes and its past where they are."""
EpisodeEnd = Literal["reset", "continue", "pause"]
"""What the player does with an env whose episode ends: reset that env, let it run on, or pause."""


# --- requests: server to worker ------------------------------------------------------------------


@dataclass(frozen=True)
class Load(Question["Loaded"]):
    """Import and build the task, replacing the one that runs if (and only if) all goes well."""

    task: TaskName
    """A path, ``path:ClassName``, or a registered env id, as a person named it; or what a recording names."""
    options: TaskOptions
    source: dict[str, str] | None = None
    """Text to use in place of what is on disk: how the last good version comes back."""
    level: LoadLevel = "auto"
    """What is done if a version of the same task runs; a level that is named is taken as asked."""
    snapshot: bytes | None = None
    """Pickled `core.snapshots.snapshot.Snapshot` of the moment to be shown after a build, by name, where shapes match."""
    any_task: bool = False
    """If no class is named and the one that is taken fails, another task of the file may be opened."""


@dataclass(frozen=True)
class Play:
    playing: bool


@dataclass(frozen=True)
class SingleStep:
    """Pause, and make one control step."""


@dataclass(frozen=True)
class Reset(Question[StepResult]):
    env_idx: tuple[int, ...] | None = None
    """None resets all."""
    seed: int | None = None
    """None goes on with the task's own random numbers."""


class CameraRequest(NamedTuple):
    """As `take_pictures.Request`."""

    name: str
    kind: CameraKind
    modalities: tuple[str, ...] = ("rgb",)

    @property
    def key(self) -> CameraKey:
        return self.kind, self.name


@dataclass(frozen=True)
class Settings:
    """What pages choose of how the batch runs and what of it is looked at: sent whole, and the worker applies what
    differs from what it knew."""

    speed: float = 1.0
    """Simulated seconds per second; ``inf`` runs as fast as the machine can."""
    episode_end: EpisodeEnd = "reset"
    action_source: ActionSource = "random"
    policy: str | None = None
    """``module:function`` or ``file.py:function`` when `action_source` is ``policy``; None while none is named."""
    policy_folder: str | None = None
    """In which a policy's file is looked for when it is not in the current folder."""
    sliders: tuple[float, ...] = ()
    """(A,) the action of every env while `action_source` is ``sliders``."""
    selected_env: int = 0
    cameras: tuple[CameraRequest, ...] = ()
    """Whose pictures of the selected env are made; none while no page is open."""


@dataclass(frozen=True)
class ReadPolicyAgain:
    """The file of the policy was saved."""

    play: bool
    """Play on, once it can be taken."""


@dataclass(frozen=True)
class PlaceCamera(Question["Placed"]):
    """Put a camera elsewhere in all envs, or give it another lens, size or shader; answered with `Placed`.

    Of several for one camera that wait, only the last is made.
    """

    key: CameraKey
    settings: CameraSettings | None
    """None puts it back where the task had it."""


@dataclass(frozen=True)
class SetCapture:
    """While on, every step comes back with the state columns of the batch, and with the pictures of all cameras of
    these envs, to be recorded."""

    env_idx: tuple[int, ...]
    """Empty turns it off."""
    from_reset: bool = False
    """Of each of these envs from its next reset on: until then a picture would be made for nobody."""


@dataclass(frozen=True)
class WayBack:
    """How an env came to a moment: from the state at an exact point, by actions."""

    start: int
    """The server's number of the exact point's moment; its snapshot is among `Restore.starts`."""
    source: int
    """Which env it was then."""
    actions: NDArray[np.float32]
    """(T, A)"""


@dataclass(frozen=True)
class Restore:
    """Put envs back to a moment of the past; the answer is a `Stepped` with `Stepped.restored`."""

    snapshot: bytes
    """A pickled `core.snapshots.snapshot.Snapshot` of the whole batch."""
    env_idx: tuple[int, ...]
    """The envs to be set."""
    source: tuple[int, ...]
    """Whose state each of them gets."""
    origin: int
    """The server's number of that moment; comes back as it is."""
    undoes: int | None = None
    """The server's number of the jump that this takes back, if it takes one back; comes back as it is."""
    ways: Mapping[int, WayBack] = field(default_factory=dict)
    """Of those of `env_idx` that can live up to the moment again."""
    starts: Mapping[int, bytes] = field(default_factory=dict)
    """Pickled snapshots of the whole batch at the beginnings of `ways`, by number of the moment."""


@dataclass(frozen=True)
class EnterRecording:
    """Put envs into a state of a recorded episode; the answer is a `Stepped` with `Stepped.restored`."""

    run: RecordedRun
    """Up to the state."""
    env_idx: tuple[int, ...]
    """The envs to be set, all to the same state."""
    source_file: str | None = None
    source: Mapping[str, str] = field(default_factory=dict)
    """What the task was when it was recorded, where what has changed since is to be told."""
    number: int = 0
    """Which request of the session this is; its answer has the same."""


@dataclass(frozen=True)
class DrawPast:
    """Draw one env as it was, without touching its simulation; the answer is `PastPictures`."""

    poses: NDArray[np.float32]
    """(B, 7) of that env's bodies, as in `StepResult.poses`."""
    env: int
    cameras: tuple[CameraRequest, ...]
    origin: int
    """The server's number of that moment; comes back as it is."""


@dataclass(frozen=True)
class WarmUp(Question[None]):
    """Do what the first load and the first picture of a process take long over; see `warm_up`."""

    options: TaskOptions


@dataclass(frozen=True)
class ListenForDebugger:
    """Have debugpy listen on this machine; what comes of it is a line of the log."""

    port: int
    wait: bool = False
    """Do nothing else until one has attached."""


@dataclass(frozen=True)
class Inspect:
    """Read one env out, once; answered with an `Inspection`, between two control steps."""

    env: int
    sections: tuple[Section, ...]


@dataclass(frozen=True)
class Cancel:
    """Nobody waits for what was asked before. What takes long ends early at any request."""


@dataclass(frozen=True)
class Quit:
    pass


Request = (
    Load
    | Play
    | SingleStep
    | Reset
    | Settings
    | ReadPolicyAgain
    | PlaceCamera
    | SetCapture
    | Restore
    | EnterRecording
    | DrawPast
    | ListenForDebugger
    | Inspect
    | Call
    | Cancel
    | Quit
)


def without_steps(requests: Iterable[Request]) -> Iterator[Request]:
    """What an interrupt leaves of the requests that wait: no control steps, but the pause that a `SingleStep` begins with."""
    for request in requests:
        if isinstance(request, SingleStep):
            yield Play(False)
        elif not (isinstance(request, Play) and request.playing):
            yield request


# --- events: worker to server --------------------------------------------------------------------


@dataclass(frozen=True)
class Loading:
    """What a load is doing now, for the status line."""

    activity: str


@dataclass(frozen=True)
class ReloadReport:
    """How a version took the place of another."""

    level: ReloadLevel
    reason: str
    """For example ``only compute_dense_reward changed``."""
    carried: tuple[str, ...] = ()
    """After a build: actors, articulations and attributes that are as they were, by name."""
    not_carried: dict[str, str] = field(default_factory=dict)
    """What is not, and why."""


@dataclass(frozen=True)
class Loaded:
    task: TaskDescription
    first: StepResult
    milliseconds: dict[str, float]
    """Time of each part of the load: import, build, reset, probe, geometry."""
    reload: ReloadReport | None = None
    """None for the first version of a task. With ``same``, ``patched`` and ``cameras`` the scene, its episodes and
    `first`'s poses are those that were there before; of the geometry, which is large, the visuals are left out."""


@dataclass(frozen=True)
class LoadFailed:
    """Something of the author's raised. `kept` says that the version before still runs."""

    problem: Problem
    kept: bool
    classes: tuple[str, ...] = ()
    """What can be chosen in the file, the one that was tried first; empty where the file has one or none was tried."""


@dataclass(frozen=True)
class Pictures:
    """The newest pictures of the cameras that are watched, of one kind."""

    pictures: tuple[Picture, ...]
    milliseconds: float
    number: int
    """`Stepped.number` of the moment that they show."""


@dataclass(frozen=True)
class Placed:
    """The answer to `PlaceCamera`. Pictures of that camera that come later show it as it was placed."""

    key: CameraKey
    settings: CameraSettings | None
    """As asked."""
    info: CameraInfo | None
    """Of the camera as it is now, but for what the task's config says of it (`CameraInfo.settings`)."""
    reshaped: bool = False
    """Its pictures are of another size, or have other modalities."""
    why_not: str = ""
    """Why it was not placed; then nothing was changed."""


@dataclass(frozen=True)
class PastPictures:
    """The answer to `DrawPast`."""

    origin: int
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class Status:
    playing: bool
    steps_per_second: float
    """Control steps of the whole batch per second of wall time."""
    real_time_factor: float
    """Simulated seconds per wall second; below the asked speed the machine is the limit."""
    activity: str = ""
    """What keeps the worker from its requests for a while, if anything does."""


@dataclass(frozen=True)
class RulesBroken:
    """What the version that runs has broken of the rules and is not stopped by; sent when it changes."""

    rows: tuple[Finding, ...]
    more: int = 0
    """Times at places for which there was no row left."""
    new: tuple[Finding, ...] = ()
    """Those of the rows that the event before did not have."""


Event = (
    Loading
    | Loaded
    | LoadFailed
    | Stepped
    | Pictures
    | Placed
    | PastPictures
    | Inspection
    | Answer
    | Progress
    | Status
    | RulesBroken
)
