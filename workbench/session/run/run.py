"""The run of the open task: what is loaded, how it goes, what a person asks of it, and how each event changes that."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from workbench.authoring.loading.reference import (
    RecordedTask,
    TaskName,
    followed_folder,
    named_file,
    reference_to_class,
)
from workbench.authoring.problem import Problem
from workbench.commands.cameras import ChoosePictures
from workbench.commands.command import Command, Refused
from workbench.commands.envs import NextEnv, PreviousEnv, SelectEnv
from workbench.commands.run import (
    ChooseActions,
    ChooseClass,
    ChooseEpisodeEnd,
    Interrupt,
    PauseRun,
    PlayRun,
    RebuildScene,
    ReloadCameras,
    ReloadCode,
    ReloadFile,
    ResetAll,
    ResetSelected,
    RestartWorker,
    SetPolicy,
    SetSeed,
    SetSpeed,
    Step,
    TogglePlay,
    UseControlMode,
)
from workbench.commands.solve import (
    ChooseMethod,
    ChoosePlannedEnvs,
    FollowBody,
    SetHorizon,
    SetNoise,
    SetPlanEvery,
    SetRollouts,
    SetTemperature,
)
from workbench.commands.timeline import (
    ContinueFromHere,
    GoToLast,
    NextEvent,
    PreviousEvent,
    Seek,
    StepBack,
    StepForward,
    UndoReset,
)
from workbench.core.camera_data import CameraKey, Picture
from workbench.core.capture.inspection import Inspection, Section
from workbench.core.capture.recorded_run import RecordedRun
from workbench.core.env.step_result import StepResult
from workbench.jobs.task import Stepped, TaskDescription, TaskOptions, changed_options
from workbench.machine.processes.wire import pack
from workbench.session.events import Asked
from workbench.session.history.env_table import EnvRows, EnvTable
from workbench.session.history.history import EnvMoment, History, ShownMoment
from workbench.session.process.heartbeat import Busy, death_problem, own_files_of
from workbench.session.process.supervisor import Death, End
from workbench.session.protocol.messages import (
    SCENE_KEPT,
    CameraFailed,
    EnterRecording,
    Event,
    Inspect,
    Load,
    Loaded,
    LoadFailed,
    Loading,
    LoadLevel,
    NewProcessNeeded,
    PastPictures,
    Pictures,
    Placed,
    Play,
    ReadPolicyAgain,
    ReloadLevel,
    ReloadReport,
    Request,
    Reset,
    RulesBroken,
    Settings,
    SingleStep,
    Status,
    Tell,
    Told,
)
from workbench.session.run.past import Past, Strip
from workbench.session.run.recovery import LoadInputs, Recovery

State = Literal["starting", "loading", "running", "paused", "error", "stopped"]
"""``starting`` the worker process; ``loading``: a task is being imported or built; ``error``: no version is loaded,
see `Run.problem`; ``stopped``: there is no worker."""
PastAfterLoad = Literal["same", "patched", "gone"]
"""What a load means for the history: it continues unchanged, it continues with other code, or another history begins."""
_MOST_LOADS = 20


class Now(NamedTuple):
    """When an event happens."""

    monotonic: float
    """Seconds of `time.monotonic`."""
    wall: float
    """Seconds since the epoch."""


@dataclass(frozen=True)
class PastLoad:
    """One attempt to load the file."""

    at: float
    """Seconds since the epoch."""
    level: ReloadLevel | None
    """Level of the reload; None for the first version, and for one that was refused."""
    reason: str
    milliseconds: float = 0.0
    problem: Problem | None = None
    """Why the version was refused."""


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
class LoadGaveWay:
    """A load was interrupted because a newer version waits."""

    failed: LoadFailed


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
    """Draw the pictures that the shown moment lacks."""


@dataclass(frozen=True)
class ActionTold:
    """Tell envs (all if None) these numbers of their action, while its source is ``sliders``; without any, to hold still."""

    dimensions: tuple[int, ...]
    values: tuple[float, ...]
    env_idx: tuple[int, ...] | None = None


@dataclass(frozen=True)
class InspectionWanted:
    """Inspect the selected env once."""

    sections: tuple[Section, ...]


@dataclass(frozen=True)
class EnvsReset:
    """Reset these envs with fresh seeds; all, with the session's seed, if None."""

    env_idx: tuple[int, ...] | None = None


RunEvent = (
    Event
    | Asked
    | VersionLoaded
    | LoadGaveWay
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
    | InspectionWanted
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


RunEffect = Send | ReplaceWorker | InterruptWorker | Follow | FollowPolicy


# --- state ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """One value for all that is known of the run. Its serials tell a page cheaply which parts are new."""

    reference: TaskName
    """The requested task: a file, ``file.py:ClassName`` or a registered env id, or a task that a recording names."""
    options: TaskOptions
    """Build options in effect; the seed is `seed`."""
    history_bytes: int
    """Memory limit of the history."""
    own_file: Path | None
    """The named file, even if it never loaded; None for an env id."""
    own_folder: Path | None
    """Folder whose modules, and those below it, are watched with the file; None if nothing is watched."""
    running_reference: TaskName
    """The running task."""
    recovery: Recovery = Recovery()
    past: Past | None = None
    """None before a task is loaded."""
    versions: tuple[tuple[int, TaskDescription], ...] = ()
    """The versions that made the moments of `past`, oldest first, each with the serial of its first one."""
    needed: NewProcessNeeded = NewProcessNeeded("", False)
    """Why the next worker is a new process, where the last one said so."""
    to_enter: RunToEnter | None = None
    """To be entered as soon as a task is loaded."""
    first_step_due: bool = False
    """The next step is the first of a new scene: it does not prove that the task runs."""
    pages: int = 0
    """Pages that are open."""
    tried_options: TaskOptions | None = None
    """Options that a person applied and that no load has taken or refused yet."""
    wants_play: bool = False
    policy_failed: bool = False
    """Whether a failure of the policy stopped playing, and playing has not begun since. `problem` may be gone: a save
    that a load follows clears it."""
    named_policy: str | None = None
    """The policy that was named last, for when policies act again."""

    state: State = "starting"
    activity: str = "a worker process"
    """Current step of starting or loading, else empty."""
    stale: bool = False
    """The file on disk is newer than the running version, or does not load."""
    task: TaskDescription | None = None
    task_serial: int = 0
    """Grows with every successful load."""
    scene_serial: int = 0
    """Grows with every new scene: not with a version that is patched into the present one."""
    cameras_serial: int = 0
    """Grows with every new set of cameras."""
    load_milliseconds: float = 0.0
    reload: ReloadReport | None = None
    """How the running version came in; None for the first."""
    timeline_cleared: bool = False
    """Whether the running version began another history."""
    loads: tuple[PastLoad, ...] = ()
    """The last loads, newest first."""
    choices: tuple[str, ...] = ()
    """Task classes of the file, the chosen one first; empty if it has only one."""
    step: StepResult | None = None
    """The newest step."""
    step_serial: int = 0
    pictures: Mapping[CameraKey, Picture] = field(default_factory=dict)
    """The newest pictures of the watched cameras."""
    pictures_serial: int = 0
    picture_milliseconds: float | None = None
    failed_cameras: Mapping[CameraKey, str] = field(default_factory=dict)
    """Why cameras cannot be drawn, as sentences; they are left out."""
    problem: Problem | None = None
    problem_serial: int = 0
    problem_at_run: bool = False
    """Whether `problem` came while the task ran, not while a version was loaded."""
    spoiled: str = ""
    """Why another process brought the version back that ran when `problem` came, as `LoadFailed` has it."""
    settings: Settings = Settings()
    """Settings chosen on the page."""
    told: NDArray[np.float32] | None = None
    """(N, A) action that sliders send next; None if unknown."""
    options_refused: TaskOptions | None = None
    """Options that were applied last and with which the task failed."""
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
    """The newest answer to `InspectionWanted`, of the env that was selected then."""

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
        """Folder of the task's own file, where policies are looked for too."""
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
        """The load of the running version, for another worker; None if no task runs."""
        return None if self.task is None else _load(self, LoadInputs(dict(self.task.source), None, 0))

    def for_worker(self) -> Settings:
        """Settings for the worker: without cameras if no page is open."""
        cameras = tuple(one for one in self.settings.cameras if one.key not in self.failed_cameras)
        return replace(
            self.settings,
            policy_folder=None if self.folder is None else str(self.folder),
            cameras=cameras if self.pages > 0 else (),
        )

    def env_rows(self) -> EnvRows | None:
        """The table of envs at the shown moment; None before a task is loaded. Copies some 100 kB for 256 envs: not for
        every frame."""
        return None if self.past is None else self.past.env_rows()

    def strip(self, low: int, high: int) -> Strip | None:
        """The selected env's history between two ticks; None before a task is loaded."""
        return None if self._kept is None else self._kept.strip(self.env, low, high)

    def episode_ticks(self) -> tuple[int, int] | None:
        """First and last tick of the selected env's episode that contains the shown moment, also where it went back."""
        if self._kept is None:
            return None
        begin, end = self._kept.episode(self.env)
        return self._kept.tick_of(begin), self._kept.tick_of(end)

    def segment(self) -> tuple[int, int] | None:
        """First and last serial of the selected env's segment that contains the shown moment."""
        return None if self._kept is None else self._kept.history.segment_at(self.env, self._kept.at)

    @property
    def _kept(self) -> Past | None:
        """The past, if it has a moment."""
        return None if self.past is None or not len(self.past.history) else self.past

    def shown_moment(self) -> ShownMoment:
        """The moment that the page shows."""
        shown = None if self.past is None else self.past.shown
        count = 0 if self.task is None else self.task.num_envs
        return ShownMoment(self.env, count, None if shown is None else shown.step.poses)

    def episode_moments(self, most: int) -> tuple[EnvMoment, ...]:
        """At most so many moments of the selected env's episode that contains the shown moment."""
        if self.past is None or not len(self.past.history):
            return ()
        return self.past.history.episode(self.env, self.past.at, most)

    def version_of(self, serial: int) -> TaskDescription | None:
        """The version that made this moment."""
        return next((task for first, task in reversed(self.versions) if first <= serial), None)


Change = tuple[Run, list[RunEffect]]
"""The run after an event, and what has to be done."""


def first_run(task: TaskName, options: TaskOptions, history_bytes: int, settings: Settings) -> Run:
    """The run before a worker has said anything. Looks at the disk."""
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


_NEW_PLAN = ChooseMethod, SetRollouts, SetHorizon, SetNoise, SetTemperature, SetPlanEvery
DOES: frozenset[type[Command]] = frozenset(
    {
        TogglePlay,
        PlayRun,
        PauseRun,
        Step,
        ResetAll,
        ResetSelected,
        SelectEnv,
        NextEnv,
        PreviousEnv,
        SetSeed,
        SetSpeed,
        ChooseEpisodeEnd,
        ChooseActions,
        SetPolicy,
        ChoosePlannedEnvs,
        FollowBody,
        *_NEW_PLAN,
        ChoosePictures,
        ReloadFile,
        RebuildScene,
        ReloadCode,
        ReloadCameras,
        ChooseClass,
        UseControlMode,
        RestartWorker,
        Interrupt,
        StepBack,
        StepForward,
        PreviousEvent,
        NextEvent,
        Seek,
        GoToLast,
        UndoReset,
        ContinueFromHere,
    }
)
"""Commands that `apply` takes."""


def apply(run: Run, event: RunEvent, now: Now) -> Change:
    """The run after an event, and what has to be done.

    Only the history is written into in place (see `Past.history`): all else is in the value.

    Raises:
        Refused: the command makes no sense now; nothing has changed.
    """
    match event:
        case Asked(command=command):
            return _do(run, command)
        case VersionLoaded():
            return _loaded(run, event.loaded, event.on_disk, now)
        case Stepped():
            return _stepped(run, event), []
        case Status():
            return _take_status(run, event), []
        case Pictures() | PastPictures():
            return _take_pictures(run, event), []
        case Loading():
            run = replace(run, recovery=run.recovery.began(event.number))
            return replace(run, state="loading", activity=event.activity), []
        case LoadFailed():
            return _load_failed(run, event, now)
        case LoadGaveWay():
            return _try_next(run, event.failed)
        case NewProcessNeeded():
            return replace(run, needed=event), []
        case RulesBroken():
            rules = event if event.rows else None
            return replace(run, rules=rules, rules_serial=run.rules_serial + 1), []
        case CameraFailed():
            return replace(run, failed_cameras={**run.failed_cameras, event.key: event.why}), []
        case Placed():
            return _placed(run, event), []
        case Told():
            return replace(run, told=event.action), []
        case Inspection():
            return replace(run, inspection=event), []
        case WorkerDied():
            return _died(run, event, now), []
        case WorkerBusy(busy=busy):
            return replace(run, busy=busy), []
        case FileSaved():
            return _file_saved(run)
        case PolicySaved():
            return _policy_saved(run)
        case PagesCounted(count=count):
            counted = replace(run, pages=count)
            changes = (count == 0) != (run.pages == 0)
            return counted, [Send(counted.for_worker())] if changes else []
        case SettingsChanged(values=values):
            return _change(run, **values)
        case OptionsApplied(options=options):
            return _apply_options(run, options)
        case FileOpened():
            file = event.file
            opened = replace(
                run, reference=f"{file}:{event.class_name}", own_file=file, own_folder=file.parent, choices=()
            )
            return _reload(opened, "auto", _follow(opened, ()))
        case MomentShown(serial=serial, env=env):
            run, effects = (run, []) if env is None else _change(run, selected_env=env)
            return _show(run, None if run.past is None else run.past.seek(serial)), effects
        case EpisodeStepShown(env=env, step=step):
            run, effects = _change(run, selected_env=env)
            return _show(run, None if run.past is None else run.past.seek_step(env, step)), effects
        case PastPicturesWanted():
            return _draw_past(run)
        case ActionTold():
            if run.task is None:
                return run, []
            envs = tuple(range(run.num_envs)) if event.env_idx is None else event.env_idx
            return _live(run), [Send(Tell(envs, event.dimensions, event.values))]
        case InspectionWanted(sections=sections):
            return run, [Send(Inspect(run.env, sections))]
        case EnvsReset(env_idx=env_idx):
            return _reset(run, env_idx)
        case RunToEnter():
            return _enter(run, event)
    return run, []


# --- what a person asks -----------------------------------------------------------------------------


def _do(run: Run, command: Command) -> Change:
    match command:
        case TogglePlay():
            return _play(run, not run.playing)
        case PlayRun():
            return _play(run, True)
        case PauseRun():
            return _play(run, False)
        case Step():
            return _set_playing(_live(run), False), [Send(SingleStep())]
        case ResetAll():
            return _reset(run, None)
        case ResetSelected():
            return _reset(run, (run.env,))
        case SetSeed(seed=seed):
            return _reset(replace(run, seed=seed), None)
        case SelectEnv(env=env):
            if not 0 <= env < run.num_envs:
                raise Refused(f"There is no env {env}: they are 0 to {run.num_envs - 1}.")
            return _change(run, selected_env=env)
        case NextEnv():
            return _change(run, selected_env=(run.env + 1) % run.num_envs)
        case PreviousEnv():
            return _change(run, selected_env=(run.env - 1) % run.num_envs)
        case SetSpeed(speed=speed):
            return _change(run, speed=math.inf if speed is None else speed)
        case ChooseEpisodeEnd(rule=rule):
            return _change(run, episode_end=rule)
        case ChooseActions(source=source):
            # Without a name a policy is a source too: the next step reports what is missing.
            policy = run.named_policy if source == "policy" else None
            return _change(run, action_source=source, policy=policy)
        case SetPolicy(policy=policy):
            policy = policy.strip()
            if policy and ":" not in policy:
                raise Refused("A policy is written module:function or file.py:function.")
            return _change(run, action_source="policy", policy=policy or None)
        case ChoosePlannedEnvs(envs=envs):
            return _change(run, solve_all=envs == "all")
        case FollowBody(body=body):
            if body and body not in movable_bodies(run.task):
                raise Refused("There is no such body that moves.")
            return _change(run, traced=body)
        case ChoosePictures(pictures=pictures):
            return _change(run, pictures=pictures)
        case _ if isinstance(command, _NEW_PLAN):
            plan = replace(run.settings.plan, **msgspec.structs.asdict(command))
            return _change(run, plan=plan)
        case ReloadFile():
            return _reload(run)
        case RebuildScene():
            return _reload(run, "rebuilt")
        case ReloadCode():
            return _reload(run, "patched")
        case ReloadCameras():
            return _reload(run, "cameras")
        case ChooseClass(name=name):
            return _choose_class(run, name)
        case UseControlMode(mode=mode):
            if run.task is None or run.task.control_mode == mode:
                return run, []
            env_kwargs = {**run.options.env_kwargs, "control_mode": mode}
            return _apply_options(run, replace(run.options, env_kwargs=env_kwargs))
        case RestartWorker():
            return replace(run, recovery=run.recovery.restart_requested()), [ReplaceWorker()]
        case Interrupt():
            return run, [InterruptWorker()]
        case _:
            return _travel(run, command)


def movable_bodies(task: TaskDescription | None) -> list[str]:
    """Names of the bodies whose path can be drawn."""
    if task is None:
        return []
    kinds = zip(task.geometry.body_names, task.geometry.body_kinds, strict=True)
    return [name for name, kind in kinds if kind in ("link", "dynamic")]


def _travel(run: Run, command: Command) -> Change:
    """Commands of the timeline."""
    past, env = run.past, run.env
    if past is None:
        raise Refused("No task is loaded yet.")
    match command:
        case StepBack():
            return _show(run, past.seek_by(env, -1)), []
        case StepForward():
            return _show(run, past.seek_by(env, 1)), []
        case PreviousEvent():
            return _show(run, past.seek_event(env, -1)), []
        case NextEvent():
            return _show(run, past.seek_event(env, 1)), []
        case Seek(step=step, episode_only=episode_only):
            return _show(run, past.seek_tick(step, env if episode_only else None)), []
        case GoToLast():
            return _live(run), []
        case UndoReset():
            run, effects = _play(run, False, live=False)
            restore = past.undo(env)
        case ContinueFromHere(scope=scope):
            effects = []
            restore = past.continue_from_shown(env, scope)
        case _:
            raise AssertionError(f"{command} is not in DOES")
    if restore is None:
        return _new_pictures(run), effects
    return _new_pictures(replace(run, past=past.seek(None))), [*effects, Send(restore)]


def _set_playing(run: Run, playing: bool) -> Run:
    return replace(run, playing=playing, wants_play=playing)


def _play(run: Run, playing: bool, live: bool = True) -> Change:
    run = _live(run) if playing and live else run
    return _set_playing(run, playing), [Send(Play(playing))]


def _reset(run: Run, env_idx: tuple[int, ...] | None) -> Change:
    return _live(run), [Send(Reset(env_idx, run.seed if env_idx is None else None))]


def _live(run: Run) -> Run:
    """The newest moment is shown."""
    return _show(run, None if run.past is None else run.past.seek(None))


def _show(run: Run, past: Past | None) -> Run:
    """`past` shows another moment, or the same."""
    if past is None or run.past is None or past.shown is run.past.shown:
        return run
    return _new_pictures(replace(run, past=past))


def _draw_past(run: Run) -> Change:
    if run.past is None:
        return run, []
    past, request = run.past.draw(run.env, run.settings.cameras, run.settings.pictures)
    return replace(run, past=past), [] if request is None else [Send(request)]


def _change(run: Run, **values: Any) -> Change:
    """Change fields of `Settings`; the selected env is clipped to the batch, once there is one."""
    before = run.settings
    new = replace(before, **values)
    selected = max(int(new.selected_env), 0)
    new = replace(new, selected_env=selected if run.task is None else min(selected, run.task.num_envs - 1))
    if new.action_source == "policy" and ("policy" in values or new.policy):
        run = replace(run, named_policy=new.policy)
    if new == before:
        return run, []
    policy = run.policy
    run = replace(run, settings=new)
    if new.cameras != before.cameras:
        # One that is asked for again is tried again.
        kept = {camera.key for camera in before.cameras} & {camera.key for camera in new.cameras}
        run = replace(
            run, failed_cameras={key: why for key, why in run.failed_cameras.items() if key in kept}
        )
    if new.selected_env != before.selected_env:
        # Without this the other env's picture would stay until a new one comes.
        run = _new_pictures(replace(run, pictures={}))
    effects: list[RunEffect] = [Send(run.for_worker())]
    if run.policy != policy:
        effects.append(FollowPolicy(run.policy, run.folder))
    return run, effects


def _choose_class(run: Run, name: str) -> Change:
    if run.own_file is None or name not in run.choices:
        raise Refused("The file has no such task.")
    file = run.own_file if run.task is None or run.task.file is None else Path(run.task.file)
    choices = (name, *(other for other in run.choices if other != name))
    return _reload(replace(run, reference=reference_to_class(run.reference, file, name), choices=choices))


def _enter(run: Run, wanted: RunToEnter) -> Change:
    run, effects = _play(_live(run), False)
    if run.task is None:
        return replace(run, to_enter=wanted), effects
    env_idx = tuple(range(run.num_envs)) if wanted.everywhere else (run.env,)
    request = EnterRecording(wanted.run, env_idx, wanted.source_file, dict(wanted.source), wanted.number)
    return run, [*effects, Send(request)]


# --- loading ----------------------------------------------------------------------------------------


def first_requests(run: Run) -> tuple[Run, list[Request]]:
    """First requests to a new worker: settings, what to load, and whether to play."""
    requests: list[Request] = [run.for_worker()]
    recovery, inputs = run.recovery.next_load(run.newest_moment)
    run = replace(run, recovery=recovery)
    if inputs is not None:
        needed, run = run.needed, replace(run, needed=NewProcessNeeded("", False))
        requests.append(_load(run, inputs, because=needed.reason, same_scene=needed.same_scene))
    elif run.state == "starting":
        # There is no version to load: the problem stays.
        run = replace(run, state="error", activity="")
    # A version that failed while it ran would fail again: it comes back paused.
    if run.wants_play and not (recovery.restoring and run.problem_at_run):
        requests.append(Play(True))
    return run, requests


def watched_files(run: Run, paths: Iterable[str] = (), at_fault: str | None = None) -> frozenset[Path]:
    """The task's own file, those of `paths` in its folder, and the one that `at_fault` names, wherever it is; none if
    nothing is watched."""
    if run.own_file is None or run.own_folder is None:
        return frozenset()
    modules = (Path(p) for p in paths if Path(p).is_relative_to(run.own_folder))
    return frozenset({run.own_file, *modules, *([] if at_fault is None else [Path(at_fault)])})


def files_at_fault(run: Run, failed: LoadFailed) -> frozenset[Path]:
    """Files to watch where a problem is: a module that the task has never imported without an error is in no
    `source_files`, and it may be in another folder, where a person mends it."""
    if failed.problem.file is None:
        return frozenset()
    return watched_files(run, () if run.task is None else run.task.source_files, failed.problem.file)


def _follow(
    run: Run, paths: Iterable[str], texts: Mapping[str, str] = MappingProxyType({})
) -> list[RunEffect]:
    files = watched_files(run, paths)
    return [Follow(files, texts)] if files else []


def _load(
    run: Run, inputs: LoadInputs, level: LoadLevel = "auto", because: str = "", same_scene: bool = False
) -> Load:
    tried = run.tried_options if inputs.source is None else None
    options = replace(tried or run.options, seed=run.seed)
    # The version that ran is brought back even if another class of the file was chosen since.
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


def _reload(run: Run, level: LoadLevel = "auto", effects: Iterable[RunEffect] = ()) -> Change:
    """Load the file again. A level other than ``auto`` is forced, even if it keeps parts of the old version.

    A worker that does not take the request (an endless loop) is interrupted or replaced.
    """
    recovery, inputs = run.recovery.file_requested(run.newest_moment)
    run = replace(run, recovery=recovery)
    # A stopped one is replaced, and the new one loads the file, see `first_requests`.
    load = ReplaceWorker() if run.state == "stopped" else Send(_load(run, inputs, level))
    return run, [*effects, load]


def _file_saved(run: Run) -> Change:
    run = replace(run, stale=True)
    if isinstance(run.reference, RecordedTask) and run.reference.approved is not None:
        # It was opened with a recording's approved text: from now on the file on disk is used.
        run = replace(run, reference=str(run.reference))
    return _reload(run)


def _apply_options(run: Run, options: TaskOptions) -> Change:
    tried = options if changed_options(run.options, options) else None
    return _reload(replace(run, tried_options=tried, options_refused=None))


def past_after(before: TaskDescription | None, event: Loaded, restored: bool) -> PastAfterLoad:
    """What a load means for the history.

    Args:
        before: the version that ran before.
        restored: it was brought back.
    """
    if before is None:
        return "gone"
    report, same_source = event.reload, before.source_hash == event.task.source_hash
    if report is None:
        return "same" if restored and same_source else "gone"
    if report.level in SCENE_KEPT:
        return "patched" if report.level == "patched" else "same"
    same_task = before.chosen == event.task.chosen and before.num_envs == event.task.num_envs
    if report.level != "restarted" or not same_task or not (same_source or report.same_scene):
        return "gone"
    return "same" if same_source else "patched"


def _loaded(run: Run, event: Loaded, on_disk: bool, now: Now) -> Change:
    """A version runs."""
    restored = run.recovery.restoring
    stale = restored and not on_disk
    task, report, before = event.task, event.reload, run.task
    run = replace(run, recovery=run.recovery.loaded(task, now.monotonic))
    run = _take_options(run, event.options)
    kept = report is not None and report.level in SCENE_KEPT
    past = past_after(before, event, restored)
    drawn = kept or (past != "gone" and before is not None and pack(before.geometry) == pack(task.geometry))
    if drawn and before is not None:
        # The same object, so that the page sees that it need not build the scene again.
        task = replace(task, geometry=before.geometry)
    level, reason = (None, "the first version") if report is None else (report.level, report.reason)
    milliseconds = sum(event.milliseconds.values())
    run = replace(
        run,
        task=task,
        task_serial=run.task_serial + 1,
        step=event.first,
        load_milliseconds=milliseconds,
        reload=report,
        timeline_cleared=past == "gone",
        activity="",
        stale=stale,
        failed_cameras=run.failed_cameras if restored else {},
        loads=_remembered(run, PastLoad(now.wall, level, reason, milliseconds)),
        first_step_due=not kept,
    )
    if not kept:
        run = _new_scene(run, task, event.first, its_past_stays=past != "gone", drawn=drawn)
    elif run.past is not None:
        run = replace(run, step=run.past.history.replace_last(event.first))
    if past != "gone" and run.past is not None and (before is None or before.source_hash != task.source_hash):
        run.past.history.begin_version(task.outlier_rules)
        run = replace(run, versions=(*run.versions, (run.past.history.last + 1, task)))
    if report is None or report.level not in ("same", "patched"):
        run = replace(run, cameras_serial=run.cameras_serial + 1, pictures=run.pictures if kept else {})
        run = _new_pictures(run)
    if not (restored and run.choices):  # else another class may have been chosen since
        run = replace(run, choices=(task.chosen, *task.others) if task.others else ())
    if task.others and task.source_files and task.file is not None:
        running = reference_to_class(run.reference, Path(task.file), task.chosen)
        # Another class may run in place of the one that fails: saves reload that one.
        reference = run.reference if task.in_place_of is None else running
        run = replace(run, running_reference=running, reference=reference)
    else:
        run = replace(run, running_reference=run.reference)
    if not restored:  # else the problem that killed the worker stays
        run = _with_problem(run, None)
    run = _at_rest(run)
    effects = [*_follow(run, task.source_files, {} if stale else task.source), Send(run.for_worker())]
    return run, effects


def enter_when_loaded(run: Run) -> Change:
    """Enter the run that waited for a task, if one did."""
    wanted = run.to_enter
    return (run, []) if wanted is None else _enter(replace(run, to_enter=None), wanted)


def _new_scene(run: Run, task: TaskDescription, first: StepResult, its_past_stays: bool, drawn: bool) -> Run:
    selected = min(run.env, task.num_envs - 1)
    run = replace(
        run,
        scene_serial=run.scene_serial + (not drawn),
        settings=replace(run.settings, selected_env=selected),
        inspection=None,
        told=None,
        # Broken rules of the new scene are reported after it.
        rules=None,
        rules_serial=run.rules_serial + 1,
    )
    if run.past is not None and its_past_stays:
        return run
    begins = 0 if run.past is None else run.past.history.last + 1
    table = EnvTable(task.geometry, first, task.control_dt, task.reward_mode, task.outlier_rules)
    past = Past(History(table, run.history_bytes, begins, task.joints))
    return replace(run, past=past, versions=((begins, task),))


def _load_failed(run: Run, event: LoadFailed, now: Now) -> Change:
    run = _with_problem(run, event.problem, event.at_run, event.spoiled)
    run = replace(run, policy_failed=run.policy_failed or event.problem.stage == "policy")
    run, of_options = _refuse_options(run, event.options)
    if not event.at_run:
        run = replace(
            run,
            loads=_remembered(run, PastLoad(now.wall, None, event.problem.message, problem=event.problem)),
        )
    run = replace(
        run,
        activity="",
        playing=run.playing and not event.at_run,
        choices=event.classes or run.choices,
        stale=run.stale or not (event.at_run or of_options),
    )
    run = _at_rest(run) if event.kept else replace(run, state="error")
    return _try_next(run, event)


def _try_next(run: Run, failed: LoadFailed) -> Change:
    """A worker without a version gets the next attempt of `Recovery`, unless it is spoiled and ends."""
    if failed.spoiled:
        return replace(run, needed=NewProcessNeeded(failed.spoiled, failed.at_run)), []
    recovery, goes_on = run.recovery.failed(failed.kept, run.newest_moment)
    inputs = None
    if goes_on:
        recovery, inputs = recovery.next_load(run.newest_moment)
    run = replace(run, recovery=recovery)
    return run, [] if inputs is None else [Send(_load(run, inputs))]


def _take_options(run: Run, loaded: TaskOptions | None) -> Run:
    if loaded is None:
        return run
    taken = run.tried_options is not None and not changed_options(run.tried_options, loaded)
    return replace(
        run,
        options=replace(loaded, seed=run.options.seed),
        tried_options=None if taken else run.tried_options,
    )


def _refuse_options(run: Run, failed: TaskOptions | None) -> tuple[Run, bool]:
    """Drop options with which the task failed, so that the next save does not fail for them. False if it was not them."""
    tried = run.tried_options
    if tried is None or failed is None or changed_options(tried, failed):
        return run, False
    # Without an env there is nothing to keep: the next load tries them again.
    options = replace(tried, seed=run.options.seed) if run.task is None else run.options
    return replace(run, tried_options=None, options=options, options_refused=tried), True


# --- what the worker says ---------------------------------------------------------------------------


def _stepped(run: Run, event: Stepped) -> Run:
    if event.step.action is not None:
        run = replace(run, recovery=run.recovery.stepped())
    if run.past is None:
        run = replace(run, step=event.step)
    else:
        past, moment = run.past.added(event)
        run = replace(run, past=past, step=moment.step, step_serial=moment.serial)
    first, run = run.first_step_due, replace(run, first_step_due=False)
    if run.problem is not None and run.problem_at_run and not first:
        # It runs again after a problem at run time: the task was reset, or the policy changed.
        run = _at_rest(_with_problem(run, None))
    return run


def _take_status(run: Run, event: Status) -> Run:
    was = run.state
    run = replace(
        run,
        policy_failed=run.policy_failed and not event.playing,
        playing=event.playing,
        steps_per_second=event.steps_per_second,
        real_time_factor=event.real_time_factor,
        recorded_share=event.recorded_share,
        watched_share=event.watched_share,
    )
    if event.activity:
        return replace(run, state="loading", activity=event.activity)
    return _at_rest(replace(run, activity="")) if was in ("running", "paused", "loading") else run


def _take_pictures(run: Run, event: Pictures | PastPictures) -> Run:
    if run.past is not None:
        run.past.history.add_pictures(event)
    if isinstance(event, PastPictures):
        return run if run.past is None else _new_pictures(run)
    if not event.pictures or event.pictures[0].env != run.env:
        return run
    # Sensors and human cameras come separately, so pictures are merged; unwatched cameras are dropped.
    watched = {camera.key for camera in run.settings.cameras}
    made = {picture.key: picture for picture in event.pictures}
    shown = {key: picture for key, picture in {**run.pictures, **made}.items() if key in watched}
    return _new_pictures(replace(run, pictures=shown, picture_milliseconds=event.milliseconds))


def _placed(run: Run, event: Placed) -> Run:
    if event.info is None or run.task is None:
        return run
    infos = tuple(event.info if c.key == event.key else c for c in run.task.cameras)
    reshaped = run.cameras_serial + event.reshaped  # its modalities may have changed
    past = None if run.past is None else run.past.camera_moved(*event.key)
    return replace(run, task=replace(run.task, cameras=infos), cameras_serial=reshaped, past=past)


def _died(run: Run, event: WorkerDied, now: Now) -> Run:
    death, recovery = event.death, run.recovery
    while_loading = recovery.loading
    texts = _texts(run)
    run = replace(
        run,
        recovery=recovery.died(death.end is End.DIED, death.doing is None, now.monotonic, run.newest_moment),
    )
    if while_loading:
        run, _ = _refuse_options(run, run.tried_options)
    problem = death_to_show(run, death, event.printed, texts)
    if problem is not None:
        run = _with_problem(run, problem, at_run=not while_loading)
    if death.doing == "drawing" and death.end is not End.ASKED:
        # The next worker would die of the same picture.
        why = f"The worker process {death.why} while it drew. Untick it and tick it again to try once more."
        failed = {camera.key: why for camera in run.settings.cameras}
        run = replace(run, failed_cameras={**run.failed_cameras, **failed})
    if death.end not in (End.FILE_WAITS, End.HANDED_OVER):
        run = replace(run, wants_play=False)
    return replace(
        run,
        playing=False,
        steps_per_second=0.0,
        real_time_factor=0.0,
        state="stopped" if death.gives_up else "starting",
        activity="" if death.gives_up else "starting a new worker",
    )


def death_to_show(run: Run, death: Death, printed: str, texts: Mapping[str, str]) -> Problem | None:
    """The problem of a death; None if the end was requested."""
    if death.end is End.HANDED_OVER or (death.end is End.ASKED and not death.stack):
        return None
    return death_problem(death.why, death.doing, death.stack, run.own_files, printed, texts)


def _texts(run: Run) -> Mapping[str, str]:
    """Source by path of the version that is being loaded, as far as it is known, or of the running one."""
    recovery = run.recovery
    if not recovery.loading:
        return {} if run.task is None else run.task.source
    if recovery.restoring:
        return recovery.good_source or {}
    if recovery.file_waits:
        # It was saved again since: its lines on disk are not those that ran.
        return dict.fromkeys(run.own_files, "")
    return {}


def _policy_saved(run: Run) -> Change:
    """Clear a problem of the policy; playing resumes if one had stopped it."""
    if run.problem is not None and run.problem.stage == "policy":
        run = _at_rest(_with_problem(run, None))
    return run, [Send(ReadPolicyAgain(play=run.policy_failed and run.wants_play))]


# --- parts of a change ------------------------------------------------------------------------------


def _remembered(run: Run, load: PastLoad) -> tuple[PastLoad, ...]:
    return load, *run.loads[: _MOST_LOADS - 1]


def _with_problem(run: Run, problem: Problem | None, at_run: bool = False, spoiled: str = "") -> Run:
    serial = run.problem_serial + 1
    return replace(run, problem=problem, problem_serial=serial, problem_at_run=at_run, spoiled=spoiled)


def _at_rest(run: Run) -> Run:
    return replace(run, state="running" if run.playing else "paused")


def _new_pictures(run: Run) -> Run:
    """Other pictures are shown."""
    return replace(run, pictures_serial=run.pictures_serial + 1)
