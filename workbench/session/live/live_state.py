"""State of a session, changed by the worker's events and by the page."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from workbench.authoring.loading.reference import (
    RecordedTask,
    TaskName,
    followed_folder,
    named_file,
    reference_to_class,
)
from workbench.authoring.problem import Problem
from workbench.core.camera_data import CameraKey
from workbench.core.capture.inspection import Inspection
from workbench.core.env.step_result import StepResult
from workbench.jobs.task import Stepped, TaskDescription, TaskOptions, changed_options
from workbench.machine.processes.wire import pack
from workbench.session.history.env_table import EnvTable
from workbench.session.live.timeline import Timeline
from workbench.session.live.view import PastLoad, SessionView
from workbench.session.process.heartbeat import death_problem, own_files_of
from workbench.session.process.supervisor import Death, End
from workbench.session.protocol.messages import (
    SCENE_KEPT,
    CameraFailed,
    Event,
    Load,
    Loaded,
    LoadFailed,
    Loading,
    LoadLevel,
    PastPictures,
    Pictures,
    PlaceCamera,
    Placed,
    ReadPolicyAgain,
    RulesBroken,
    Settings,
    Status,
    Told,
)
from workbench.session.record.save_past import PastEpisode, SaveRequest, find_episode

_MOST_LOADS = 20


@dataclass
class LiveState:
    """What each event and each request changes in the page's view.

    No thread, no messages: `Session` calls it on the loop and sends what is needed.
    """

    reference: TaskName
    """The requested task: a file, ``file.py:ClassName`` or a registered env id, or a task that a recording names."""
    options: TaskOptions
    """Build options; the seed is that of `now`."""
    history_bytes: int
    """Memory limit of the history."""
    now: SessionView = SessionView(activity="a worker process")
    """The live view, without the fields that `view` adds."""
    timeline: Timeline | None = None
    """The timeline; None before a task is loaded."""
    first_step_due: bool = False
    """The next step is the first of a new scene: it does not prove that the task runs."""
    clients: int = 0
    """Pages that are open."""
    tried_options: TaskOptions | None = None
    """Options that a person applied and that no load has taken or refused yet."""
    wants_play: bool = False
    policy_failed: bool = False
    """Whether a failure of the policy stopped playing, and playing has not begun since. `problem` may be gone: a save
    that a load follows clears it."""
    versions: list[tuple[int, TaskDescription]] = field(default_factory=list)
    """The versions that made the moments of `timeline`, oldest first, each with the serial of its first one."""

    def __post_init__(self) -> None:
        self.set(seed=self.options.seed, options=self.options)
        self.own_file = named_file(self.reference)
        """The named file, even if it never loaded; None for an env id."""
        self.own_folder = followed_folder(self.reference)
        """Folder whose modules, and those below it, are watched with the file; None if nothing is watched."""
        self.running_reference = self.reference
        """The running task."""

    def set(self, **changes: Any) -> None:
        """Replace fields of `now`."""
        self.now = replace(self.now, **changes)

    # --- events of the worker ----------------------------------------------------------------------

    def loaded(self, event: Loaded, *, restored: bool, stale: bool) -> None:
        """A version runs.

        Args:
            restored: it was brought back after a crash.
            stale: the files have changed since.
        """
        task, report, before = event.task, event.reload, self.now.task
        self._take_options(event.options)
        kept, past = scene_kept(event), past_after(before, event, restored)
        drawn = kept or (
            past != "gone" and before is not None and pack(before.geometry) == pack(task.geometry)
        )
        if drawn and before is not None:
            # The same object, so that the page sees that it need not build the scene again.
            task = replace(task, geometry=before.geometry)
        self.set(
            task=task,
            task_serial=self.now.task_serial + 1,
            step=event.first,
            load_milliseconds=sum(event.milliseconds.values()),
            reload=report,
            timeline_cleared=past == "gone",
            activity="",
            stale=stale,
            failed_cameras=self.now.failed_cameras if restored else {},
        )
        level, reason = (None, "the first version") if report is None else (report.level, report.reason)
        self._remember(PastLoad(time.time(), level, reason, self.now.load_milliseconds))
        self.first_step_due = not kept
        if not kept:
            # Broken rules of the new scene are reported after it.
            self.set(rules=None, rules_serial=self.now.rules_serial + 1)
            self._new_scene(task, event.first, its_past_stays=past != "gone", drawn=drawn)
        elif self.timeline is not None:
            self.set(step=self.timeline.history.replace_last(event.first))
        if past != "gone" and self.timeline is not None:
            if before is None or before.source_hash != task.source_hash:
                self.timeline.history.begin_version(task.outlier_rules)
                self.versions.append((self.timeline.history.last + 1, task))
        if report is None or report.level not in ("same", "patched"):
            self.set(cameras_serial=self.now.cameras_serial + 1)
            self.new_pictures(**{} if kept else {"pictures": {}})
        if not (restored and self.now.choices):  # else another class may have been chosen since
            self.set(choices=(task.chosen, *task.others) if task.others else ())
        if task.others and task.source_files and task.file is not None:
            self.running_reference = reference_to_class(self.reference, Path(task.file), task.chosen)
            if task.in_place_of is not None:
                # Another class runs in place of the one that fails: saves reload that one.
                self.reference = self.running_reference
        else:
            self.running_reference = self.reference
        if not restored:  # else the problem that killed the worker stays
            self.set_problem(None)
        self._set_running()

    def _new_scene(self, task: TaskDescription, first: StepResult, its_past_stays: bool, drawn: bool) -> None:
        settings = self.now.settings
        selected = min(settings.selected_env, task.num_envs - 1)
        self.set(
            scene_serial=self.now.scene_serial + (not drawn),
            settings=replace(settings, selected_env=selected),
            inspection=None,
            told=None,
        )
        if self.timeline is None or not its_past_stays:
            last = -1 if self.timeline is None else self.timeline.history.last
            table = EnvTable(task.geometry, first, task.control_dt, task.reward_mode, task.outlier_rules)
            self.timeline = Timeline(table, self.history_bytes, last + 1, task.joints)
            self.versions = [(last + 1, task)]

    def stepped(self, event: Stepped) -> None:
        if self.timeline is None:
            self.set(step=event.step)
        else:
            moment = self.timeline.add(event)
            self.set(step=moment.step, step_serial=moment.serial)
        first, self.first_step_due = self.first_step_due, False
        if self.now.problem is not None and self.now.problem_at_run and not first:
            # It runs again after a problem at run time: the task was reset, or the policy changed.
            self.set_problem(None)
            self._set_running()

    def take(self, event: Event) -> None:
        """Events other than `Loaded`, `Stepped`, `Answer` and `Progress`, which `Session._handle` passes on elsewhere."""
        now = self.now
        if isinstance(event, Loading):
            self.set(state="loading", activity=event.activity)
        elif isinstance(event, LoadFailed):
            self.set_problem(event.problem, event.at_run, event.spoiled)
            self.policy_failed |= event.problem.stage == "policy"
            of_options = self._refuse_options(event.options)
            if not event.at_run:
                self._remember(PastLoad(time.time(), None, event.problem.message, problem=event.problem))
            self.set(
                activity="",
                playing=now.playing and not event.at_run,
                choices=event.classes or now.choices,
                stale=now.stale or not (event.at_run or of_options),
            )
            if event.kept:
                self._set_running()
            else:
                self.set(state="error")
        elif isinstance(event, RulesBroken):
            self.set(rules=event if event.rows else None, rules_serial=now.rules_serial + 1)
        elif isinstance(event, PastPictures):
            if self.timeline is not None:
                self.timeline.history.add_pictures(event)
                self.new_pictures()
        elif isinstance(event, Pictures):
            if self.timeline is not None:
                self.timeline.history.add_pictures(event)
            if event.pictures and event.pictures[0].env == now.settings.selected_env:
                # Sensors and human cameras come separately, so pictures are merged; unwatched cameras are dropped.
                watched = {(camera.kind, camera.name) for camera in now.settings.cameras}
                made = {picture.key: picture for picture in event.pictures}
                shown = {key: p for key, p in {**now.pictures, **made}.items() if key in watched}
                self.new_pictures(pictures=shown, picture_milliseconds=event.milliseconds)
        elif isinstance(event, CameraFailed):
            self._cameras_failed({event.key: event.why})
        elif isinstance(event, Placed):
            self._placed(event)
        elif isinstance(event, Told):
            self.set(told=event.action)
        elif isinstance(event, Inspection):
            self.set(inspection=event)
        elif isinstance(event, Status):
            self.policy_failed &= not event.playing
            self.set(
                playing=event.playing,
                steps_per_second=event.steps_per_second,
                real_time_factor=event.real_time_factor,
                recorded_share=event.recorded_share,
                watched_share=event.watched_share,
            )
            if event.activity:
                self.set(state="loading", activity=event.activity)
            elif now.state in ("running", "paused", "loading"):
                self.set(activity="")
                self._set_running()

    def _cameras_failed(self, failed: dict[CameraKey, str]) -> None:
        self.set(failed_cameras={**self.now.failed_cameras, **failed})

    def _placed(self, event: Placed) -> None:
        if event.info is None or self.now.task is None:
            return
        infos = tuple(event.info if c.key == event.key else c for c in self.now.task.cameras)
        self.set(task=replace(self.now.task, cameras=infos))
        if event.reshaped:
            self.set(cameras_serial=self.now.cameras_serial + 1)  # its modalities may have changed
        if self.timeline is not None:
            self.timeline.camera_moved(*event.key)

    def died(
        self, death: Death, while_loading: bool, printed: str, texts: Mapping[str, str] | None = None
    ) -> Problem | None:
        """The worker is gone.

        Args:
            while_loading: a version was being loaded, so the running one is not to blame.
            printed: the last lines.
            texts: source by path of what ran; None for that of the running version.

        Returns:
            The problem to show; None if the end was requested.
        """
        if while_loading:
            self._refuse_options(self.tried_options)
        problem = None
        asked = death.end is End.ASKED and not death.stack
        if not asked and death.end is not End.HANDED_OVER:
            if texts is None:
                texts = {} if self.now.task is None else self.now.task.source
            problem = death_problem(death.why, death.doing, death.stack, self.own_files(), printed, texts)
            self.set_problem(problem, at_run=not while_loading)
        if death.doing == "drawing" and death.end is not End.ASKED:
            # The next worker would die of the same picture.
            why = (
                f"The worker process {death.why} while it drew. Untick it and tick it again to try once more."
            )
            self._cameras_failed({(camera.kind, camera.name): why for camera in self.now.settings.cameras})
        if death.end not in (End.FILE_WAITS, End.HANDED_OVER):
            self.wants_play = False
        self.set(
            playing=False,
            steps_per_second=0.0,
            real_time_factor=0.0,
            state="stopped" if death.gives_up else "starting",
            activity="" if death.gives_up else "starting a new worker",
        )
        return problem

    def wait_for_file(self) -> None:
        """A new worker has no version to load: the problem stays."""
        if self.now.state == "starting":
            self.set(state="error", activity="")

    def _remember(self, load: PastLoad) -> None:
        self.set(loads=(load, *self.now.loads[: _MOST_LOADS - 1]))

    def set_problem(self, problem: Problem | None, at_run: bool = False, spoiled: str = "") -> None:
        serial = self.now.problem_serial + 1
        self.set(problem=problem, problem_serial=serial, problem_at_run=at_run, spoiled=spoiled)

    def _set_running(self) -> None:
        self.set(state="running" if self.now.playing else "paused")

    def new_pictures(self, **changes: Any) -> None:
        """The shown pictures change."""
        self.set(pictures_serial=self.now.pictures_serial + 1, **changes)

    # --- options of the envs -----------------------------------------------------------------------

    def apply_options(self, options: TaskOptions) -> None:
        """Build the envs with these options at the next load."""
        self.tried_options = options if changed_options(self.options, options) else None
        self.set(options_refused=None)

    def _take_options(self, loaded: TaskOptions | None) -> None:
        if loaded is None:
            return
        self.options = replace(loaded, seed=self.options.seed)
        self.set(options=self.options)
        if self.tried_options is not None and not changed_options(self.tried_options, loaded):
            self.tried_options = None

    def _refuse_options(self, failed: TaskOptions | None) -> bool:
        """Drop options with which the task failed, so that the next save does not fail for them. False if it was not them."""
        tried = self.tried_options
        if tried is None or failed is None or changed_options(tried, failed):
            return False
        self.tried_options = None
        # Without an env there is nothing to keep: the next load tries them again.
        if self.now.task is None:
            self.options = replace(tried, seed=self.options.seed)
            self.set(options=self.options)
        self.set(options_refused=tried)
        return True

    # --- requests of the page ----------------------------------------------------------------------

    def change(self, **settings: Any) -> bool:
        """Change fields of `Settings`; the selected env is clipped to the batch, once there is one. False if nothing changes."""
        before, task = self.now.settings, self.now.task
        new = replace(before, **settings)
        selected = max(int(new.selected_env), 0)
        new = replace(new, selected_env=selected if task is None else min(selected, task.num_envs - 1))
        if new == before:
            return False
        self.set(settings=new)
        if new.cameras != before.cameras:
            # One that is asked for again is tried again.
            kept = {camera.key for camera in before.cameras} & {camera.key for camera in new.cameras}
            self.set(failed_cameras={key: why for key, why in self.now.failed_cameras.items() if key in kept})
        if new.selected_env != before.selected_env:
            # Without this the other env's picture would stay until a new one comes.
            self.new_pictures(pictures={})
        return True

    def choose_class(self, name: str) -> bool:
        """Choose another task class of the same file. False if the file has no such class."""
        if self.own_file is None or name not in self.now.choices:
            return False
        file = (
            self.own_file if self.now.task is None or self.now.task.file is None else Path(self.now.task.file)
        )
        self.reference = reference_to_class(self.reference, file, name)
        self.set(choices=(name, *(other for other in self.now.choices if other != name)))
        return True

    def open_file(self, file: Path, class_name: str) -> None:
        """Choose a class of another file."""
        self.reference, self.own_file, self.own_folder = f"{file}:{class_name}", file, file.parent
        self.set(choices=())

    def use_saved_file(self) -> None:
        """A watched file was saved. If it was opened with a recording's approved text, use the file on disk from now on."""
        if isinstance(self.reference, RecordedTask) and self.reference.approved is not None:
            self.reference = str(self.reference)

    def load_request(
        self,
        source: dict[str, str] | None,
        snapshot: bytes | None = None,
        number: int = 0,
        level: LoadLevel = "auto",
        because: str = "",
        same_scene: bool = False,
    ) -> Load:
        """See `Load`."""
        tried = self.tried_options if source is None else None
        options = replace(tried or self.options, seed=self.now.seed)
        # The version that ran is brought back even if another class of the file was chosen since.
        reference = self.reference if source is None else self.running_reference
        any_task = self.now.task is None and isinstance(reference, str)
        return Load(reference, options, source, level, snapshot, any_task, number, because, same_scene)

    def settings(self) -> Settings:
        """Settings for the worker: without cameras if no page is open."""
        chosen = self.now.settings
        cameras = tuple(camera for camera in chosen.cameras if camera.key not in self.now.failed_cameras)
        return replace(
            chosen,
            policy_folder=None if self.folder is None else str(self.folder),
            cameras=cameras if self.clients > 0 else (),
        )

    @property
    def folder(self) -> Path | None:
        """Folder of the task's own file, where policies are looked for too."""
        return None if self.own_file is None else self.own_file.parent

    @property
    def policy(self) -> str | None:
        """The acting policy, if one is chosen."""
        chosen = self.now.settings
        return chosen.policy if chosen.action_source == "policy" else None

    def policy_saved(self) -> ReadPolicyAgain:
        """Clear a problem of the policy; playing resumes if one had stopped it."""
        problem = self.now.problem
        if problem is not None and problem.stage == "policy":
            self.set_problem(None)
            self._set_running()
        return ReadPolicyAgain(play=self.policy_failed and self.wants_play)

    # --- reading -------------------------------------------------------------------------------------

    def own_files(self) -> list[str]:
        """The known files of the author."""
        return own_files_of(() if self.now.task is None else self.now.task.source_files, self.own_file)

    def newest_moment(self) -> bytes | None:
        """The newest moment, pickled for `Load.snapshot`; None before a task is loaded."""
        return (
            None if self.timeline is None else self.timeline.history.snapshot_at(self.timeline.history.last)
        )

    def save_request(
        self,
        env_idx: tuple[int, ...] | None,
        load: Load | None,
        placed: tuple[PlaceCamera, ...],
        before: bool = False,
    ) -> SaveRequest | str:
        """See `Session.save_past`; or the reason why there is nothing to keep."""
        if self.now.task is None or self.timeline is None or load is None:
            return "no task is loaded"
        history, shown = self.timeline.history, self.timeline.shown
        envs = range(self.now.task.num_envs) if env_idx is None else env_idx
        serial = None if shown is None else shown.serial
        found = {env: find_episode(history, env, serial, before) for env in envs}
        episodes = tuple(
            replace(episode, played_by=self._version_of(episode.moments[-1][0].serial))
            for episode in found.values()
            if isinstance(episode, PastEpisode)
        )
        if not episodes:
            env, why = next(iter(found.items()))
            return f"nothing was saved of env {env}: {why}"
        return SaveRequest(self.now.task, load, placed, episodes)

    def _version_of(self, serial: int) -> TaskDescription | None:
        """The version that made this moment."""
        return next((task for first, task in reversed(self.versions) if first <= serial), None)

    def view(self, **known: Any) -> SessionView:
        """The view of the shown moment.

        Args:
            known: further fields of the view.
        """
        now, timeline = self.now, self.timeline
        refused = now.problem if now.stale and not now.problem_at_run else None
        if timeline is None:
            return replace(now, refused=refused, **known)
        env, moment = now.settings.selected_env, timeline.shown
        past = timeline.view(env, now.settings.cameras, now.settings.pictures)
        curves = timeline.history.steps.curves(env)
        odd = timeline.history.findings
        view = replace(now, refused=refused, curves=curves, timeline=past, odd=odd, **known)
        if moment is None:
            return view
        return replace(
            view,
            step=moment.step,
            step_serial=moment.serial,
            pictures=timeline.pictures(env),
            told=moment.step.action,
        )


def past_after(
    before: TaskDescription | None, event: Loaded, restored: bool
) -> Literal["same", "patched", "gone"]:
    """What a load means for the history: it continues unchanged, it continues with other code, or another history begins.

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


def scene_kept(event: Loaded) -> bool:
    """Whether the env, its episodes and its history stay."""
    return event.reload is not None and event.reload.level in SCENE_KEPT
