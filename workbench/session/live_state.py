"""What a session knows: how the task stands, what its batch lived through, and what the page has chosen.

Every event of the worker changes a little of this, and every snapshot that the page draws is made of it. What an
event means for what is seen is one idea and worth reading alone, so there is no lock, no thread and no message
in here: `Session` calls these methods under its lock, and sends whatever is to be sent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from workbench.authoring.problem import Problem
from workbench.authoring.reference import RecordedTask, TaskName, class_beside, followed_folder, named_file
from workbench.core.inspection import Inspection
from workbench.core.pictures import CameraKind, Picture
from workbench.core.snapshot_bytes import WholeSnapshot
from workbench.core.step import StepResult
from workbench.session.chronicle import Chronicle
from workbench.session.judge import JudgementView
from workbench.session.kept_worker import Death, Vitals
from workbench.session.last_words import Busy, death_problem, own_files_of
from workbench.session.messages import (
    SCENE_KEPT,
    ActionSource,
    CameraRequest,
    EpisodeEnd,
    Event,
    Failed,
    Load,
    Loaded,
    Loading,
    LoadLevel,
    PastPictures,
    Pictures,
    PlaceCamera,
    Placed,
    ReloadReport,
    Request,
    Restore,
    RulesBroken,
    SetActionSource,
    SetEpisodeEnd,
    SetSpeed,
    Status,
    Stepped,
    TaskDescription,
    TaskOptions,
    WatchCameras,
)
from workbench.session.past_episodes import PastEpisode, WhatToKeep, episode_round, moments_of
from workbench.session.printed import Printed
from workbench.session.recovery import Wanted
from workbench.session.timeline import Timeline, TimelineView
from workbench.session.view import RecordingStatus, SessionView, State


@dataclass
class LiveState:
    """See the module's text. Not thread-safe: the session locks."""

    reference: TaskName
    """The task that was asked for: a file, ``file.py:ClassName``, or a registered env id; or what a recording names."""
    options: TaskOptions
    """How it is made, but for the seed."""
    history_bytes: int
    """What the past may take."""
    # --- the worker and its task ---
    state: State = "starting"
    activity: str = "starting the worker"
    stale: bool = False
    task: TaskDescription | None = None
    task_serial: int = 0
    scene_serial: int = 0
    cameras_serial: int = 0
    reload: ReloadReport | None = None
    load_milliseconds: dict[str, float] = field(default_factory=dict)
    problem: Problem | None = None
    problem_serial: int = 0
    problem_at_run: bool = False
    """It came while the task ran, not while a version was loaded."""
    busy: Busy | None = None
    rules: RulesBroken | None = None
    """What the version that runs has broken of the rules; None while nothing."""
    rules_serial: int = 0
    choices: tuple[str, ...] = ()
    """What can be chosen in the file, the one that was asked for first."""
    # --- the batch ---
    chronicle: Chronicle | None = None
    """None before a task is loaded."""
    step: StepResult | None = None
    step_serial: int = 0
    first_due: bool = False
    """The next step is the one that a new scene begins with: it does not show that anything runs."""
    pictures: dict[tuple[CameraKind, str], Picture] = field(default_factory=dict)
    pictures_serial: int = 0
    picture_milliseconds: float = 0.0
    inspection: Inspection | None = None
    playing: bool = False
    steps_per_second: float = 0.0
    real_time_factor: float = 0.0
    # --- what the page has chosen ---
    seed: int = field(init=False)
    selected_env: int = 0
    cameras: tuple[CameraRequest, ...] = ()
    clients: int = 0
    wants_play: bool = False
    speed: float = 1.0
    episode_end: EpisodeEnd = "reset"
    action_source: ActionSource = "random"
    policy: str | None = None
    sliders: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        self.seed = self.options.seed
        self.own_file = named_file(self.reference)
        """The file that was named, whether or not it ever loaded; None for an env id."""
        self.own_folder = followed_folder(self.reference)
        """Modules in or below it are followed with the file; None where nothing is."""
        self.running_reference = self.reference
        """The task that runs."""

    @property
    def timeline(self) -> Timeline | None:
        """None before a task is loaded."""
        return None if self.chronicle is None else self.chronicle.timeline

    # --- what the worker says ----------------------------------------------------------------------

    def loaded(self, event: Loaded, *, restored: bool, stale: bool) -> None:
        """A version runs.

        Args:
            restored: it is the last good one, brought back after a worker's death.
            stale: the files hold another by now.
        """
        task, report = event.task, event.reload
        if scene_kept(event) and self.task is not None:
            # The same scene: who has drawn it can see that by its being the same object.
            task = replace(task, geometry=self.task.geometry)
        before, self.task = self.task, task
        self.task_serial += 1
        self.step, self.load_milliseconds, self.reload = event.first, event.milliseconds, report
        self.first_due = not scene_kept(event)
        if not scene_kept(event):
            self.rules, self.rules_serial = None, self.rules_serial + 1  # those of this scene come after it
            same = restored and before is not None and before.source_hash == task.source_hash
            self._new_scene(task, event.first, its_past_stays=same)
        elif self.timeline is not None:
            self.step = self.timeline.history.renew_last(event.first)
        if report is None or report.level not in ("same", "patched"):
            self.cameras_serial += 1
            self.pictures_serial += 1
            if not scene_kept(event):
                self.pictures = {}
        if not (restored and self.choices):  # else another may have been asked for since
            self.choices = (task.chosen, *task.others) if task.others else ()
        if task.others and task.source_files and task.file is not None:
            self.running_reference = class_beside(self.reference, Path(task.file), task.chosen)
            if task.in_place_of is not None:
                # Saves bring in what is open; the other is to be chosen when it is mended.
                self.reference = self.running_reference
        else:
            self.running_reference = self.reference
        self.activity = ""
        self.stale = stale
        if not restored:  # else what killed the worker still stands
            self.set_problem(None)
        self._runs()

    def _new_scene(self, task: TaskDescription, first: StepResult, its_past_stays: bool) -> None:
        self.scene_serial += 1
        self.sliders = ()
        self.selected_env = min(self.selected_env, task.num_envs - 1)
        self.inspection = None
        if self.timeline is None or not its_past_stays:
            next_serial = 0 if self.timeline is None else self.timeline.history.next_serial
            self.chronicle = Chronicle(task, first, self.history_bytes, next_serial)

    def stepped(self, event: Stepped) -> None:
        self.step = event.step
        if self.chronicle is not None:
            self.step = self.chronicle.add(event)
            self.step_serial = self.chronicle.timeline.history.last
        first, self.first_due = self.first_due, False
        if self.problem is not None and self.problem_at_run and not first:
            # What failed while running runs again: the task was reset, or the policy changed.
            self.set_problem(None)
            self._runs()

    def take(self, event: Event) -> None:
        """Any other event."""
        if isinstance(event, Loading):
            self.state, self.activity = "loading", event.activity
        elif isinstance(event, Failed):
            self.activity = ""
            self.set_problem(event.problem)
            self.problem_at_run = self.state != "loading"
            self.choices = event.classes or self.choices
            self.state = "error"
            self.stale = self.stale or not self.problem_at_run
        elif isinstance(event, RulesBroken):
            self.rules = event if event.rows else None
            self.rules_serial += 1
        elif isinstance(event, PastPictures):
            if self.timeline is not None:
                self.timeline.add_pictures(event)
                self.pictures_serial += 1
        elif isinstance(event, Pictures):
            if self.timeline is not None:
                self.timeline.add_pictures(event)
            if event.pictures and event.pictures[0].env == self.selected_env:
                # They come a kind at a time; what nobody looks through any more is not to stay.
                watched = {(camera.kind, camera.name) for camera in self.cameras}
                made = {(picture.kind, picture.camera): picture for picture in event.pictures}
                self.pictures = {k: p for k, p in {**self.pictures, **made}.items() if k in watched}
                self.pictures_serial += 1
                self.picture_milliseconds = event.milliseconds
        elif isinstance(event, Placed):
            self._placed(event)
        elif isinstance(event, Inspection):
            self.inspection = event
        elif isinstance(event, Status):
            self.playing = event.playing
            self.steps_per_second, self.real_time_factor = event.steps_per_second, event.real_time_factor
            if event.activity:
                self.state, self.activity = "loading", event.activity
            elif self.state in ("running", "paused", "loading"):
                self.activity = ""
                self._runs()

    def _placed(self, event: Placed) -> None:
        if event.info is None or self.task is None:
            return
        infos = tuple(event.info if c.key == event.key else c for c in self.task.cameras)
        self.task = replace(self.task, cameras=infos)
        if event.reshaped:
            self.cameras_serial += 1  # what it can show may be something else
        if self.timeline is not None:
            self.timeline.camera_moved(*event.key)

    def died(self, death: Death, while_loading: bool, printed: str) -> Problem | None:
        """The worker is gone.

        Args:
            while_loading: a version was being loaded, so it is not the running one that killed it.
            printed: the last lines.

        Returns:
            what is to be told of it; None where somebody asked for it.
        """
        self.playing, self.steps_per_second, self.real_time_factor = False, 0.0, 0.0
        problem = None
        if not death.asked or death.stack:
            source = {} if self.task is None or while_loading else self.task.source
            problem = death_problem(death.why, death.doing, death.stack, self.own_files(), printed, source)
            self.set_problem(problem)
            self.problem_at_run = not while_loading
        if not death.file_waits:
            self.wants_play = False
        self.state = "stopped" if death.gives_up else "starting"
        self.activity = "" if death.gives_up else "starting another worker"
        return problem

    def waits_for_the_file(self) -> None:
        """A worker is up and has nothing that it could load: the problem stands."""
        if self.state == "starting":
            self.state, self.activity = "error", ""

    def set_problem(self, problem: Problem | None) -> None:
        self.problem = problem
        self.problem_serial += 1

    def _runs(self) -> None:
        self.state = "running" if self.playing else "paused"

    def _drop_pictures(self) -> None:
        self.pictures = {}
        self.pictures_serial += 1

    # --- what the page asks for --------------------------------------------------------------------

    def select(self, env: int) -> bool:
        """Choose the env (the nearest that there is) whose pictures and numbers are shown. False if it was."""
        last = 0 if self.task is None else self.task.num_envs - 1
        chosen = min(max(env, 0), last)
        if chosen == self.selected_env:
            return False
        self.selected_env = chosen
        # The other env's picture must not stand beside this env's numbers until a new one comes.
        self._drop_pictures()
        return True

    def choose_class(self, name: str) -> bool:
        """Ask for another task class of the same file. False if the file has no such class."""
        if self.own_file is None or name not in self.choices:
            return False
        file = self.own_file if self.task is None or self.task.file is None else Path(self.task.file)
        self.reference = class_beside(self.reference, file, name)
        self.choices = (name, *(other for other in self.choices if other != name))
        return True

    def open_file(self, file: Path, class_name: str) -> None:
        """Ask for a class of another file."""
        self.reference, self.own_file, self.own_folder = f"{file}:{class_name}", file, file.parent
        self.choices = ()

    def file_is_edited(self) -> None:
        """A file that a recording named is open live and is saved: from now on it is what is on disk that is open."""
        if isinstance(self.reference, RecordedTask) and self.reference.approved is not None:
            self.reference = str(self.reference)

    def seek(self, seek: Callable[[Timeline], None]) -> bool:
        """Show another moment. False if it was shown."""
        if self.timeline is None:
            return False
        before = self.timeline.shown
        seek(self.timeline)
        if self.timeline.shown is before:
            return False
        self.pictures_serial += 1
        return True

    def travel(self, ask: Callable[[Timeline, int], Restore | None]) -> Restore | None:
        """What is to be asked of the worker to put envs back, if anything."""
        self.pictures_serial += 1
        return None if self.timeline is None else ask(self.timeline, self.selected_env)

    def load_request(self, wanted: Wanted, level: LoadLevel = "auto") -> Load:
        options = replace(self.options, seed=self.seed)
        # The version that ran is brought back although another class of the file was asked for since.
        reference = self.reference if wanted.source is None else self.running_reference
        any_task = self.task is None and isinstance(reference, str)
        return Load(reference, options, wanted.source, level, wanted.snapshot, any_task)

    def settings(self) -> list[Request]:
        """What has been chosen, for a worker that knows nothing of it; the cameras are told last (`watch_request`)."""
        return [
            SetSpeed(self.speed),
            SetEpisodeEnd(self.episode_end),
            self.action_request(),
        ]

    @property
    def folder(self) -> Path | None:
        """Of the task's own file, where a policy's may lie too."""
        return None if self.own_file is None else self.own_file.parent

    def action_request(self) -> SetActionSource:
        """Where the actions come from."""
        beside = None if self.folder is None else str(self.folder)
        return SetActionSource(self.action_source, self.policy, beside)

    def policy_saved(self) -> SetActionSource:
        """What was wrong with it before is past; what it stopped goes on, if it is well now."""
        mended = self.problem is not None and self.problem.stage == "policy"
        if mended:
            self.set_problem(None)
            self._runs()
        return replace(self.action_request(), play=mended and self.wants_play)

    def watch_request(self) -> WatchCameras:
        """The pictures that somebody looks at; none while no page is open."""
        return WatchCameras(self.selected_env, self.cameras if self.clients > 0 else ())

    # --- what is read --------------------------------------------------------------------------------

    def own_files(self) -> list[str]:
        """The author's files, as far as they are known."""
        return own_files_of(() if self.task is None else self.task.source_files, self.own_file)

    def newest_moment(self) -> bytes | None:
        """Pickled for `Load.snapshot`; None before a task is loaded."""
        return (
            None if self.timeline is None else self.timeline.history.snapshot_at(self.timeline.history.last)
        )

    def stretch(self) -> tuple[int, int] | None:
        """See `TimeTravel.stretch`."""
        if self.timeline is None or not len(self.timeline.history):
            return None
        return self.timeline.history.stretch_at(self.selected_env, self.timeline.at)

    def what_to_keep(
        self,
        env_idx: tuple[int, ...] | None,
        load: Load | None,
        placed: tuple[PlaceCamera, ...],
        before: bool = False,
    ) -> WhatToKeep | str:
        """See `Session.keep_past`; in a sentence why there is nothing to keep."""
        if self.task is None or self.timeline is None or load is None:
            return "no task is loaded"
        history, shown = self.timeline.history, self.timeline.shown
        envs = range(self.task.num_envs) if env_idx is None else env_idx
        serial = None if shown is None else shown.serial
        found = {env: episode_round(history, env, serial, before) for env in envs}
        episodes = tuple(episode for episode in found.values() if isinstance(episode, PastEpisode))
        if not episodes:
            env, why = next(iter(found.items()))
            return f"nothing was kept of env {env}: {why}"
        snapshots: dict[int, WholeSnapshot] = {}
        for moment, _ in moments_of(episodes):
            whole = history.whole_at(moment.serial)
            assert whole is not None, "an episode of the past has a snapshot of every moment"
            snapshots[moment.serial] = whole
        return WhatToKeep(self.task, load, placed, episodes, snapshots)

    def view(
        self, *, recording: RecordingStatus, printed: Printed, vitals: Vitals, judgement: JudgementView
    ) -> SessionView:
        """A snapshot, with what others know."""
        timeline = self.timeline
        shown = None if timeline is None else timeline.shown
        past = TimelineView() if timeline is None else timeline.view(self.selected_env, self.cameras)
        return SessionView(
            state=self.state,
            activity=self.activity,
            stale=self.stale,
            task=self.task,
            task_serial=self.task_serial,
            scene_serial=self.scene_serial,
            cameras_serial=self.cameras_serial,
            reload=self.reload,
            load_milliseconds=self.load_milliseconds,
            step=self.step if shown is None else shown.step,
            step_serial=self.step_serial if shown is None else shown.serial,
            pictures=self.pictures
            if timeline is None or shown is None
            else timeline.pictures(self.selected_env),
            pictures_serial=self.pictures_serial,
            picture_milliseconds=self.picture_milliseconds,
            problem=self.problem,
            problem_serial=self.problem_serial,
            choices=self.choices,
            refused=self.problem if self.stale and not self.problem_at_run else None,
            curves=None if self.chronicle is None else self.chronicle.curves(),
            selected_env=self.selected_env,
            playing=self.playing,
            speed=self.speed,
            seed=self.seed,
            episode_end=self.episode_end,
            action_source=self.action_source,
            policy=self.policy,
            sliders=self.sliders,
            steps_per_second=self.steps_per_second,
            real_time_factor=self.real_time_factor,
            recording=recording,
            timeline=past,
            printed=printed,
            busy=self.busy,
            rules=self.rules,
            rules_serial=self.rules_serial,
            vitals=vitals,
            inspection=self.inspection,
            judgement=judgement,
        )


def scene_kept(event: Loaded) -> bool:
    """Whether the env, its episodes and its past are those that were there before."""
    return event.reload is not None and event.reload.level in SCENE_KEPT
