"""The run of the open task as one value: the loaded version, its state, and the user's choices."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraKey, Picture
from workbench.envs.inspection import Inspection, Section
from workbench.envs.step_result import StepResult
from workbench.live.events import RunEffect, RunToEnter
from workbench.live.history.curves import REWARD, Column
from workbench.live.history.env_table import EnvRows
from workbench.live.history.moments import EnvMoment, EpisodeNumbers, ShownMoment
from workbench.live.load_attempts import LoadInputs, Recovery
from workbench.live.messages import (
    Load,
    LoadLevel,
    NewProcessNeeded,
    ReloadLevel,
    ReloadReport,
    RulesBroken,
    Settings,
)
from workbench.live.past import Past, Strip
from workbench.live.pause_when import PauseWhen
from workbench.live.process.heartbeat import Busy, own_files_of
from workbench.task.description import Pulled, TaskDescription, TaskOptions
from workbench.task.problem import Problem
from workbench.task.reference import TaskName, followed_folder, named_file

RunState = Literal["starting", "loading", "running", "paused", "error", "stopped"]
"""``starting``: the worker process starts; ``loading``: a task is being imported or built; ``error``: no
version is loaded, see `Run.problem`; ``stopped``: there is no worker."""


PastAfterLoad = Literal["same", "patched", "gone"]
"""Effect of a load on the history: it continues unchanged, it continues with other code, or a new history begins."""


@dataclass(frozen=True)
class PastLoad:
    """One attempt to load the file."""

    at: float
    """Seconds since the epoch."""
    level: ReloadLevel | None
    """Level of the reload; None for the first version and for a refused one."""
    reason: str
    milliseconds: float = 0.0
    problem: Problem | None = None
    """Why the version was refused."""


@dataclass(frozen=True)
class Run:
    """State of the run. Its serials tell a page cheaply which parts are new."""

    reference: TaskName
    """The requested task: a file, ``file.py:ClassName``, a registered env id, or a task named by a recording."""
    options: TaskOptions
    """Build options in effect, apart from their seed: the seed in use is `Run.seed`."""
    history_bytes: int
    """Memory limit of the history."""
    own_file: Path | None
    """The named file, even if it never loaded; None for an env id."""
    own_folder: Path | None
    """Folder whose modules, also in subfolders, are watched with the file; None if nothing is watched."""
    running_reference: TaskName
    """The task of the running version; `reference` may already name another class of the file."""
    recovery: Recovery = Recovery()
    past: Past | None = None
    """The history; None before a task is loaded."""
    versions: tuple[tuple[int, TaskDescription], ...] = ()
    """The versions that made the moments of `past`, oldest first, with the serials of their first moments."""
    needed: NewProcessNeeded = NewProcessNeeded("", False)
    """The last worker's reason for the new process, see `NewProcessNeeded`; empty if it gave none."""
    to_enter: RunToEnter | None = None
    """Recorded run to enter as soon as a task is loaded."""
    first_step_due: bool = False
    """Whether the next step is the first of a new scene. That step does not prove that the task runs."""
    pages: int = 0
    """Number of open pages."""
    tried_options: TaskOptions | None = None
    """Options that the user applied and that no load has accepted or refused yet."""
    plays_asked: int = 0
    """Number of `Play` requests to this worker. A `Status` from before the last `Play` says nothing about
    `playing`."""
    wants_play: bool = False
    policy_failed: bool = False
    """Whether a failure of the policy stopped playing, and playing has not resumed since. `problem` may be
    None nevertheless, because a successful load clears it."""
    named_policy: str | None = None
    """The policy that was named last, to use when the source of actions is a policy again."""

    state: RunState = "starting"
    activity: str = "a worker process"
    """Current phase of starting or loading, else empty."""
    stale: bool = False
    """Whether the file on disk is newer than the running version, or does not load."""
    task: TaskDescription | None = None
    task_serial: int = 0
    """Increases with every successful load."""
    scene_serial: int = 0
    """Increases with every new scene, not with a version that is patched into the present one."""
    cameras_serial: int = 0
    """Increases with every new set of cameras."""
    load_milliseconds: float = 0.0
    reload: ReloadReport | None = None
    """How the running version was loaded; None for the first version."""
    after_load: PastAfterLoad = "same"
    """Effect of the last load on the history."""
    loads: tuple[PastLoad, ...] = ()
    """The last loads, newest first."""
    choices: tuple[str, ...] = ()
    """Task classes of the file, the chosen class first; empty if the file has only one."""
    step: StepResult | None = None
    """The newest step."""
    step_serial: int = 0
    pictures: Mapping[CameraKey, Picture] = field(default_factory=dict)
    """The newest pictures of the watched cameras."""
    pictures_serial: int = 0
    picture_milliseconds: float | None = None
    failed_cameras: Mapping[CameraKey, str] = field(default_factory=dict)
    """Cameras that cannot be drawn and are left out, with the reason as a sentence."""
    problem: Problem | None = None
    problem_serial: int = 0
    problem_at_run: bool = False
    """Whether `problem` occurred while the task ran, not during a load."""
    spoiled: str = ""
    """Why another process restored the version that ran when `problem` occurred; see `TaskFailed.spoiled`."""
    settings: Settings = Settings()
    """Settings chosen on the page."""
    pause_when: PauseWhen = PauseWhen()
    """Condition at which the run pauses."""
    paused_at: int | None = None
    """Serial of the moment at which the condition held; None once the run has continued."""
    pulled: Pulled | None = None
    """The pull by hand during the newest step."""
    slider_action: NDArray[np.float32] | None = None
    """(N, A) next action of the sliders; None if unknown."""
    options_refused: TaskOptions | None = None
    """The options that were applied last, if the task failed with them; else None."""
    seed: int = 0
    playing: bool = False
    steps_per_second: float = 0.0
    real_time_factor: float = 0.0
    recorded_share: float = 0.0
    watched_share: float = 0.0
    """Speeds and shares of time, as in `Status`."""
    busy: Busy | None = None
    """A long-running call in the worker."""
    rules: RulesBroken | None = None
    """Rules of GPU simulation that the running version has broken; None for none."""
    rules_serial: int = 0
    inspection: Inspection | None = None
    """The newest reading, of the env that was selected then."""
    read_sections: tuple[Section, ...] = ()
    """Sections of the selected env to read again after each step; see `inspect_polling`."""
    read_body: str = ""
    """Name of the body that is read with them; empty for none."""
    reading: Literal["none", "soon", "asked"] = "none"
    """``soon``: a reading is scheduled; ``asked``: the worker has not answered the last request yet."""
    read_at: object = None
    """Version, step, env and sections of the last requested reading."""
    read_when: float = -math.inf
    """When the last reading was requested, in seconds of `Now.monotonic`."""

    # --- reading -----------------------------------------------------------------------------------

    @property
    def env(self) -> int:
        """The selected env."""
        return self.settings.selected_env

    @property
    def num_envs(self) -> int:
        """Number of envs; 1 before a task is loaded."""
        return 1 if self.task is None else self.task.num_envs

    @property
    def folder(self) -> Path | None:
        """Folder of the task's own file, where policies are searched too."""
        return None if self.own_file is None else self.own_file.parent

    @property
    def policy(self) -> str | None:
        """The acting policy, if one is chosen."""
        return self.settings.policy if self.settings.action_source == "policy" else None

    @property
    def own_files(self) -> list[str]:
        """The known files of the author."""
        return own_files_of(() if self.task is None else self.task.source_files, self.own_file)

    def newest_moment(self) -> bytes | None:
        """The newest moment, pickled for `Load.snapshot`; None before a task is loaded. Takes longer than a step."""
        return None if self.past is None else self.past.history.snapshot_at(self.past.history.last)

    def running_load(self) -> Load | None:
        """A load of the running version for another worker; None if no task runs."""
        return None if self.task is None else load_of(self, LoadInputs(dict(self.task.source), None, 0))

    def for_worker(self) -> Settings:
        """Settings for the worker: without failed cameras, and without any camera if no page is open."""
        cameras = tuple(one for one in self.settings.cameras if one.key not in self.failed_cameras)
        return replace(
            self.settings,
            policy_folder=None if self.folder is None else str(self.folder),
            cameras=cameras if self.pages > 0 else (),
        )

    def env_rows(self) -> EnvRows | None:
        """The table of envs at the shown moment; None before a task is loaded. Copies some 100 kB for 256 envs: do not call
        it every frame."""
        return None if self.past is None else self.past.env_rows()

    def newest_env_table(self) -> EnvRows | None:
        """The table of envs at the newest moment, without the rewards; None before a task is loaded."""
        newest = None if self.past is None else self.past.history.at(self.past.history.last)
        return None if newest is None else newest.rows

    def strip(self, low: int, high: int, column: Column = REWARD) -> Strip | None:
        """The selected env's history between two ticks; None before a task is loaded."""
        return None if self.kept is None else self.kept.strip(self.env, low, high, column)

    def episodes(
        self, env: int, last: int, columns: Sequence[Column], before: int
    ) -> tuple[EpisodeNumbers, ...]:
        """See `Past.episodes`; none before a task is loaded."""
        return () if self.kept is None else self.kept.episodes(env, last, columns, before)

    def episode_ticks(self) -> tuple[int, int] | None:
        """First and last tick of the selected env's episode that contains the shown moment; jumps back do not end an episode."""
        if self.kept is None:
            return None
        begin, end = self.kept.episode(self.env)
        return self.kept.tick_of(begin), self.kept.tick_of(end)

    def segment(self) -> tuple[int, int] | None:
        """First and last serial of the selected env's segment that contains the shown moment."""
        return None if self.kept is None else self.kept.history.segment_at(self.env, self.kept.at)

    @property
    def stands_at(self) -> object:
        """Key of the shown past moment and of the pictures that the page needs of it; None while live."""
        if self.past is None or self.past.pinned is None:
            return None
        return self.past.pinned, self.env, self.settings.cameras, self.settings.pictures

    @property
    def kept(self) -> Past | None:
        """The past, if it has a moment."""
        return None if self.past is None or not len(self.past.history) else self.past

    def shown_moment(self) -> ShownMoment:
        """The moment that the page shows."""
        shown = None if self.past is None else self.past.shown
        count = 0 if self.task is None else self.task.num_envs
        return ShownMoment(self.env, count, None if shown is None else shown.step.poses)

    def episode_moments(self, most: int) -> tuple[EnvMoment, ...]:
        """At most `most` moments of the selected env's episode that contains the shown moment."""
        if self.past is None or not len(self.past.history):
            return ()
        return self.past.history.episode(self.env, self.past.at, most)

    def version_of(self, serial: int) -> TaskDescription | None:
        """The version that made the moment of this serial; None if unknown."""
        return next((task for first, task in reversed(self.versions) if first <= serial), None)


Change = tuple[Run, list[RunEffect]]
"""The run after an event, and the effects to perform."""


def first_run(task: TaskName, options: TaskOptions, history_bytes: int, settings: Settings) -> Run:
    """The run before the first event of a worker. Reads the disk."""
    return Run(
        task,
        options,
        history_bytes,
        named_file(task),
        followed_folder(task),
        task,
        seed=options.seed,
        settings=settings,
        named_policy=settings.policy,
    )


def load_of(
    run: Run, inputs: LoadInputs, level: LoadLevel = "auto", because: str = "", same_scene: bool = False
) -> Load:
    tried = run.tried_options if inputs.source is None else None
    options = replace(tried or run.options, seed=run.seed)
    # The version that ran is restored even if another class of the file was chosen since.
    reference = run.reference if inputs.source is None else run.running_reference
    any_task = run.task is None and isinstance(reference, str)
    return Load(
        reference,
        options,
        inputs.source,
        level,
        inputs.snapshot,
        any_task,
        inputs.number,
        because,
        same_scene,
    )


def movable_bodies(task: TaskDescription | None) -> list[str]:
    """Names of the bodies whose path can be drawn."""
    if task is None:
        return []
    kinds = zip(task.geometry.body_names, task.geometry.body_kinds, strict=True)
    return [name for name, kind in kinds if kind in ("link", "dynamic")]


# --- parts of a change ------------------------------------------------------------------------------


def with_problem(run: Run, problem: Problem | None, at_run: bool = False, spoiled: str = "") -> Run:
    serial = run.problem_serial + 1
    return replace(run, problem=problem, problem_serial=serial, problem_at_run=at_run, spoiled=spoiled)


def at_rest(run: Run) -> Run:
    return replace(run, state="running" if run.playing else "paused")


def new_pictures(run: Run) -> Run:
    """The run with a new `pictures_serial`."""
    return replace(run, pictures_serial=run.pictures_serial + 1)
