"""The session on the server's side: what the page asks for, and what it sees.

The page's controls call methods here; each only notes the wish and sends a message, so none waits for
the env. The worker's events come one by one on one thread and are turned into the state from which
`Session.view` makes a snapshot. When the worker dies, `KeptWorker` starts another, which is greeted with
the last version that ran, and the page never goes away.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from workbench.authoring.problem import Problem
from workbench.authoring.reference import named_file
from workbench.authoring.watch import SourceWatcher
from workbench.core.inspection import Inspection, Section
from workbench.core.pictures import CameraKind, Picture
from workbench.core.step import StepResult
from workbench.session.env_table import EnvRows, EnvTable
from workbench.session.judge import FILE_SAVED, Judge, what_a_load_means
from workbench.session.judgement import JudgedCurve, Judgement
from workbench.session.kept_worker import Death, KeptWorker, WorkerOptions
from workbench.session.last_words import Busy, death_problem, own_files_of
from workbench.session.messages import (
    SCENE_KEPT,
    ActionSource,
    CameraRequest,
    EpisodeEnd,
    Event,
    Failed,
    Inspect,
    Load,
    Loaded,
    Loading,
    LoadLevel,
    PastPictures,
    Pictures,
    Play,
    ReloadReport,
    Request,
    Reset,
    Restore,
    SetActionSource,
    SetCapture,
    SetEpisodeEnd,
    SetSliders,
    SetSpeed,
    SingleStep,
    Status,
    Stepped,
    TaskDescription,
    TaskOptions,
    WarmUp,
    WatchCameras,
)
from workbench.session.past import Past
from workbench.session.printed import PrintedLine, PrintedLog
from workbench.session.record_live import LiveRecorder
from workbench.session.recovery import Recovery, Wanted, is_on_disk
from workbench.session.reward_terms import TermCurves, TermHistory
from workbench.session.timeline import Scope, Strip, Timeline, TimelineView
from workbench.session.view import Curves, SessionView, State

HISTORY_BYTES = 256 * 1024**2
"""What the past may take unless somebody says otherwise."""


@dataclass
class _State:
    """What the snapshots are made of; only touched under the session's lock."""

    state: State = "starting"
    activity: str = "starting the worker"
    stale: bool = False
    task: TaskDescription | None = None
    task_serial: int = 0
    scene_serial: int = 0
    cameras_serial: int = 0
    reload: ReloadReport | None = None
    load_milliseconds: dict[str, float] = field(default_factory=dict)
    step: StepResult | None = None
    step_serial: int = 0
    pictures: dict[tuple[CameraKind, str], Picture] = field(default_factory=dict)
    pictures_serial: int = 0
    picture_milliseconds: float = 0.0
    problem: Problem | None = None
    problem_serial: int = 0
    problem_at_run: bool = False
    past: Past | None = None
    timeline: Timeline | None = None
    table: EnvTable | None = None
    terms: TermHistory | None = None
    inspection: Inspection | None = None
    selected_env: int = 0
    playing: bool = False
    wants_play: bool = False
    speed: float = 1.0
    episode_end: EpisodeEnd = "reset"
    action_source: ActionSource = "random"
    policy: str | None = None
    sliders: tuple[float, ...] = ()
    steps_per_second: float = 0.0
    real_time_factor: float = 0.0
    cameras: tuple[CameraRequest, ...] = ()
    clients: int = 0
    busy: Busy | None = None


class Session:
    """One task, one worker, any number of pages. All methods are thread-safe and return at once."""

    def __init__(
        self,
        task: str,
        options: TaskOptions,
        *,
        recordings: Path,
        history_bytes: int = HISTORY_BYTES,
        worker: WorkerOptions | None = None,
        on_event: Callable[[Event], None] = lambda event: None,
        on_line: Callable[[str], None] = lambda line: None,
    ) -> None:
        """
        Args:
            task: a file, ``file.py:ClassName``, or a registered env id.
            recordings: folder that recorded episodes go to; made when the first is written.
            history_bytes: memory that the past may take.
            worker: limits of the worker process, and whether there is a spare one.
            on_event: called with every event of the worker, and its death as a failure, on the session's thread
                (the terminal).
            on_line: called with the lines that the worker printed, from its own threads; not with all of a flood.
        """
        self._task = task
        self._options = options
        self._seed = options.seed
        self._history_bytes = history_bytes
        self._on_event = on_event
        self._print = on_line
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._change = 0
        self._state = _State()
        self._curves: Curves | None = None
        self._closing = False
        self._first_due = False
        self._recovery = Recovery(self._newest_moment)
        self._printed = PrintedLog(self._on_lines)
        self._worker = KeptWorker(
            worker or WorkerOptions(),
            WarmUp(options),
            greet=self._greeting,
            on_event=self._handle,
            on_death=self._on_death,
            on_busy=self._on_busy,
            own_files=self._own_files,
            output=self._printed.feed,
        )
        self._recorder = LiveRecorder(recordings, self._note)
        self._judge = Judge(self._note)
        self._watcher = SourceWatcher(self._on_files_changed)
        self._own_file = named_file(task)
        self._follow((), {})
        self._worker.start()

    # --- what the page reads -----------------------------------------------------------------------

    def view(self) -> SessionView:
        """A snapshot; cheap enough for every frame."""
        recording = self._recorder.status()
        printed, vitals = self._printed.view(), self._worker.vitals
        with self._lock:
            s = self._state
            if s.past is not None and (self._curves is None or self._curves.serial != s.step_serial):
                self._curves = s.past.curves()
            shown = None if s.timeline is None else s.timeline.shown
            live = s.timeline is None or shown is None
            return SessionView(
                state=s.state,
                activity=s.activity,
                stale=s.stale,
                task=s.task,
                task_serial=s.task_serial,
                scene_serial=s.scene_serial,
                cameras_serial=s.cameras_serial,
                reload=s.reload,
                load_milliseconds=s.load_milliseconds,
                step=s.step if shown is None else shown.step,
                step_serial=s.step_serial if shown is None else shown.serial,
                pictures=s.pictures if live or s.timeline is None else s.timeline.pictures(s.selected_env),
                pictures_serial=s.pictures_serial,
                picture_milliseconds=s.picture_milliseconds,
                problem=s.problem,
                problem_serial=s.problem_serial,
                curves=self._curves if s.past is not None else None,
                selected_env=s.selected_env,
                playing=s.playing,
                speed=s.speed,
                seed=self._seed,
                episode_end=s.episode_end,
                action_source=s.action_source,
                policy=s.policy,
                sliders=s.sliders,
                steps_per_second=s.steps_per_second,
                real_time_factor=s.real_time_factor,
                recording=recording,
                timeline=TimelineView() if s.timeline is None else s.timeline.view(s.selected_env, s.cameras),
                printed=printed,
                busy=s.busy,
                vitals=vitals,
                inspection=s.inspection,
                judgement=self._judge.view,
            )

    def env_rows(self) -> EnvRows | None:
        """The row of every env; None before a task is loaded. Copies some 100 kB for 256 envs: not for every frame."""
        with self._lock:
            return None if self._state.table is None else self._state.table.rows()

    def term_curves(self) -> TermCurves | None:
        """The reward's terms over time; None before a task is loaded. Copies: not for every frame."""
        with self._lock:
            return None if self._state.terms is None else self._state.terms.curves()

    def wait(self, seen: int, timeout: float) -> int:
        """Block until something changed since the counter `seen`; returns the counter as it is now."""
        with self._changed:
            self._changed.wait_for(lambda: self._change != seen or self._closing, timeout)
            return self._change

    @property
    def worker_pid(self) -> int | None:
        """Process id of the worker; None while there is none."""
        return self._worker.pid

    # --- what the page asks for --------------------------------------------------------------------

    def reload(self, level: LoadLevel = "auto") -> None:
        """Load the file again, by a level that is named whatever it may leave of the old version.

        A worker that does not take it up (an endless loop) is interrupted or replaced.
        """
        with self._lock:
            request = replace(self._load_request(self._recovery.file_asked()), level=level)
            stopped = self._state.state == "stopped"
        if stopped:
            self._worker.replace()  # it will be greeted with the file
        else:
            self._send(request)

    def choose_class(self, name: str) -> None:
        """Another task class of the same file, one that `TaskDescription.others` names."""
        with self._lock:
            task = self._state.task
            if task is None or self._own_file is None or name not in task.others:
                return
            self._task = f"{self._own_file}:{name}"
        self.reload()

    def interrupt(self) -> None:
        """Have the author's code left where it is, if it is at work; its traceback becomes the problem."""
        self._worker.interrupt()

    def restart_worker(self) -> None:
        """End the worker, whatever it is doing, and start another with the last good version where it was."""
        with self._lock:
            self._recovery.restart_asked()
        self._worker.replace()

    def clear_printed(self) -> None:
        """Forget what the author's code printed."""
        self._printed.clear()
        self._note()

    def play(self) -> None:
        self.seek(None)
        self._set(playing=True, wants_play=True)
        self._send(Play(True))

    def pause(self) -> None:
        self._set(playing=False, wants_play=False)
        self._send(Play(False))

    def step(self) -> None:
        """One control step; pauses first."""
        self.seek(None)
        self.pause()
        self._send(SingleStep())

    def reset(self, env_idx: tuple[int, ...] | None = None) -> None:
        """All envs with the session's seed, or some with fresh seeds."""
        self.seek(None)
        self._send(Reset(env_idx, self._seed if env_idx is None else None))

    def set_seed(self, seed: int) -> None:
        """Take another seed and reset all envs with it."""
        with self._lock:
            self._seed = int(seed)
        self.reset()

    def set_speed(self, speed: float) -> None:
        """Simulated seconds per wall second; ``math.inf`` for as fast as the machine can."""
        self._set(speed=speed)
        self._send(SetSpeed(speed))

    def set_episode_end(self, rule: EpisodeEnd) -> None:
        self._set(episode_end=rule)
        self._send(SetEpisodeEnd(rule))

    def set_action_source(self, source: ActionSource, policy: str | None = None) -> None:
        self._set(action_source=source, policy=policy)
        self._send(SetActionSource(source, policy))

    def set_sliders(self, action: tuple[float, ...]) -> None:
        """The action (A,) that every env gets while the action source is ``sliders``."""
        self._set(sliders=action)
        self._send(SetSliders(action))

    def select_env(self, env: int) -> None:
        """The env whose pictures and numbers are shown."""
        with self._lock:
            last = 0 if self._state.task is None else self._state.task.num_envs - 1
            chosen = min(max(int(env), 0), last)
            if chosen == self._state.selected_env:
                return
            self._state.selected_env = chosen
            # The other env's picture must not stand beside this env's numbers until a new one comes.
            self._state.pictures = {}
            self._state.pictures_serial += 1
        self._watch()
        self._note()

    def watch_cameras(self, cameras: tuple[CameraRequest, ...]) -> None:
        """Which pictures of the selected env are on screen; no others are rendered."""
        with self._lock:
            if cameras == self._state.cameras:
                return
            self._state.cameras = cameras
        self._watch()

    def inspect(self, sections: tuple[Section, ...]) -> None:
        """Read the selected env out, once; the answer becomes `SessionView.inspection`."""
        with self._lock:
            env = self._state.selected_env
        self._send(Inspect(env, sections))

    def set_clients(self, count: int) -> None:
        """How many pages are open; with none, no picture is rendered."""
        with self._lock:
            before, self._state.clients = self._state.clients, count
        if (before == 0) != (count == 0):
            self._watch()

    def start_recording(self, env_idx: tuple[int, ...] | None = None) -> None:
        """Record from a fresh episode on: the envs (all if None) are reset, and capturing begins."""
        with self._lock:
            task = self._state.task
        if task is None:
            return
        envs = tuple(range(task.num_envs)) if env_idx is None else env_idx
        self._recorder.start(task, envs)
        self._send(SetCapture(envs))
        self.reset(None if env_idx is None else envs)
        self._note()

    def stop_recording(self) -> None:
        """Write what was gathered of the episodes under way, and stop."""
        self._send(SetCapture(()))
        self._recorder.stop()
        self._note()

    # --- the past ------------------------------------------------------------------------------------

    def seek(self, serial: int | None) -> None:
        """Show a moment of the past, by its number (see `TimelineView`); None shows what is live."""
        self._seek(lambda timeline: timeline.seek(serial))

    def seek_by(self, steps: int) -> None:
        """Show a moment before (negative) or after the one that is shown."""
        self._seek(lambda timeline: timeline.seek_by(steps))

    def seek_step(self, env: int, step: int) -> None:
        """Show the moment at which this env was at that step of its present episode."""
        self._seek(lambda timeline: timeline.seek_step(env, step))

    def seek_event(self, direction: int) -> None:
        """Show the next (1) or last (-1) event of the selected env: reset, success, fail, truncation, branch."""
        env = self._state.selected_env
        self._seek(lambda timeline: timeline.seek_event(env, direction))

    def go_on(self, scope: Scope) -> None:
        """Put envs back to the shown moment; the simulation goes on from there (see `timeline.Scope`)."""
        self._travel(lambda timeline, env: timeline.go_on(env, scope))

    def undo(self) -> None:
        """Take back the selected env's last reset or going back, and pause there."""
        self.pause()
        self._travel(lambda timeline, env: timeline.undo(env))

    def draw_past(self) -> None:
        """Ask for pictures of the moment that is shown, if it has none of the cameras looked through."""
        with self._lock:
            s = self._state
            request = None if s.timeline is None else s.timeline.draw(s.selected_env, s.cameras)
        if request is not None:
            self._send(request)

    def strip(self, low: int, high: int) -> Strip | None:
        """The selected env's past between two moments; None before a task is loaded."""
        with self._lock:
            s = self._state
            return None if s.timeline is None else s.timeline.strip(s.selected_env, low, high)

    def stretch(self) -> tuple[int, int] | None:
        """First and last moment of what the selected env lived through round the shown moment, without a jump."""
        with self._lock:
            s = self._state
            if s.timeline is None or not len(s.timeline.history):
                return None
            shown = s.timeline.shown
            at = s.timeline.history.last if shown is None else shown.serial
            return s.timeline.history.stretch_at(s.selected_env, at)

    def snapshot(self) -> bytes | None:
        """The newest moment, pickled for `Load.snapshot`; None before a task is loaded."""
        with self._lock:
            return self._newest_moment()

    def _newest_moment(self) -> bytes | None:
        timeline = self._state.timeline
        return None if timeline is None else timeline.history.snapshot_at(timeline.history.last)

    # --- the past judged again -----------------------------------------------------------------------

    def stop_judging(self) -> None:
        """Judge the past no further; what is known by then stays."""
        self._judge.stop("stopped by hand")

    def judged_curve(self, name: str, env: int) -> JudgedCurve | None:
        """One number of one env, as recorded and as the new code has it. Copies: not for every frame."""
        return self._judge.curve(name, env)

    def show(self, env: int, serial: int) -> None:
        """Select an env and show a moment of its past."""
        self.select_env(env)
        self.seek(serial)

    def _seek(self, seek: Callable[[Timeline], None]) -> None:
        with self._lock:
            s = self._state
            if s.timeline is None:
                return
            before = s.timeline.shown
            seek(s.timeline)
            if s.timeline.shown is before:
                return
            s.pictures_serial += 1
        self._note()

    def _travel(self, ask: Callable[[Timeline, int], Restore | None]) -> None:
        with self._lock:
            s = self._state
            request = None if s.timeline is None else ask(s.timeline, s.selected_env)
            s.pictures_serial += 1
        if request is not None:
            self._send(request)
        self._note()

    def close(self) -> None:
        """End the worker and the watcher, and wait for episodes that are being written."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._watcher.stop()
        self._worker.stop()
        self._judge.close()
        self._recorder.close()

    # --- what the worker says, on the session's thread -------------------------------------------

    def _greeting(self) -> list[Request]:
        """Everything that a worker before this one knew."""
        with self._lock:
            s = self._state
            requests: list[Request] = [
                SetSpeed(s.speed),
                SetEpisodeEnd(s.episode_end),
                SetActionSource(s.action_source, s.policy),
            ]
            wanted = self._recovery.wanted()
            if wanted is not None:
                requests.append(self._load_request(wanted))
            elif s.state == "starting":
                # Nothing that could be loaded: the problem stands, and the file is waited for.
                s.state, s.activity = "error", ""
            if s.wants_play:
                requests.append(Play(True))
            return [*requests, self._watch_request()]

    def _on_death(self, death: Death) -> None:
        self._recorder.stop()
        with self._lock:
            s = self._state
            while_loading = self._recovery.loading
            self._recovery.died(death.file_waits)
            s.playing, s.steps_per_second, s.real_time_factor = False, 0.0, 0.0
            told = None
            if not death.asked or death.stack:
                known = () if s.task is None else s.task.source_files
                self._set_problem(
                    death_problem(
                        death.why,
                        death.doing,
                        death.stack,
                        own_files_of(known, self._own_file),
                        self._printed.tail(20),
                        {} if s.task is None or while_loading else s.task.source,
                    )
                )
                s.problem_at_run = not while_loading
                told = s.problem
            if not death.file_waits:
                s.wants_play = False
            s.state = "stopped" if death.gives_up else "starting"
            s.activity = "" if death.gives_up else "starting another worker"
            kept = s.task is not None
        self._note()
        if told is not None:
            self._on_event(Failed(told, kept))

    def _on_busy(self, busy: Busy | None) -> None:
        with self._lock:
            if busy is None and self._state.busy is None:
                return
            self._state.busy = busy
        self._note()

    def _own_files(self) -> list[str]:
        with self._lock:
            task = self._state.task
        return own_files_of(() if task is None else task.source_files, self._own_file)

    def _handle(self, event: Event) -> None:
        if isinstance(event, Failed) and self._worker.load_waits and "Interrupted:" in event.problem.message:
            return  # left for the sake of a newer version, which waits: nobody need hear of it
        if isinstance(event, Loaded):
            self._on_loaded(event)
        elif isinstance(event, Stepped):
            self._on_stepped(event)
        else:
            with self._lock:
                self._apply(event)
            if isinstance(event, Failed):
                self._bring_back(event)
            if isinstance(event, Failed) and event.problem.file is not None:
                # A module beside the task that broke before the task had ever imported it whole.
                known = self._state.task.source_files if self._state.task is not None else ()
                self._follow((*known, event.problem.file), {})
        self._note()
        self._on_event(event)

    def _apply(self, event: Event) -> None:
        s = self._state
        if isinstance(event, Loading):
            s.state, s.activity = "loading", event.activity
        elif isinstance(event, Failed):
            s.activity = ""
            self._set_problem(event.problem)
            s.problem_at_run = s.state != "loading"
            s.state = "error"
            s.stale = s.stale or not s.problem_at_run
        elif isinstance(event, PastPictures):
            if s.timeline is not None:
                s.timeline.add_pictures(event)
                s.pictures_serial += 1
        elif isinstance(event, Pictures):
            if s.timeline is not None:
                s.timeline.add_pictures(event)
            if event.pictures and event.pictures[0].env == s.selected_env:
                # They come a kind at a time; what nobody looks through any more is not to stay.
                watched = {(camera.kind, camera.name) for camera in s.cameras}
                made = {(picture.kind, picture.camera): picture for picture in event.pictures}
                s.pictures = {k: p for k, p in {**s.pictures, **made}.items() if k in watched}
                s.pictures_serial += 1
                s.picture_milliseconds = event.milliseconds
        elif isinstance(event, Inspection):
            s.inspection = event
        elif isinstance(event, Status):
            s.playing = event.playing
            s.steps_per_second, s.real_time_factor = event.steps_per_second, event.real_time_factor
            if event.activity:
                s.state, s.activity = "loading", event.activity
            elif s.state in ("running", "paused", "loading"):
                s.state, s.activity = "running" if event.playing else "paused", ""

    def _on_loaded(self, event: Loaded) -> None:
        self._worker.ran()
        report, task = event.reload, event.task
        kept = report is not None and report.level in SCENE_KEPT
        recording = self._recorder.status()
        if not kept or (report is not None and report.level != "same"):
            # Episodes of the version before end here: their steps and the new ones do not belong together.
            self._recorder.stop()
        with self._lock:
            s = self._state
            restored = self._recovery.restoring
            self._recovery.loaded(task)
            self._first_due = not kept
            same = restored and s.task is not None and s.task.source_hash == task.source_hash
            meaning = what_a_load_means(s.task, event, self._judge.view)
            judgement = None
            if meaning == "judge" and s.timeline is not None:
                judgement = Judgement(s.timeline.history)
            if kept and s.task is not None:
                # The same scene: who has drawn it can see that by its being the same object.
                task = replace(task, geometry=s.task.geometry)
            s.task, s.step, s.load_milliseconds, s.reload = task, event.first, event.milliseconds, report
            s.task_serial += 1
            if not kept:
                s.scene_serial += 1
                s.sliders = ()
                s.selected_env = min(s.selected_env, task.num_envs - 1)
                s.inspection = None
                if s.past is None or s.timeline is None or not same:
                    s.past, self._curves = Past(task.num_envs), None
                    next_serial = 0 if s.timeline is None else s.timeline.history.next_serial
                    s.timeline = Timeline(task.num_envs, self._history_bytes, next_serial)
                    s.table, s.terms = EnvTable(task, event.first), TermHistory(task.num_envs)
            elif s.timeline is not None:
                s.timeline.history.renew_last(event.first)
            if report is None or report.level not in ("same", "patched"):
                s.cameras_serial += 1
                s.pictures_serial += 1
                if not kept:
                    s.pictures = {}
            s.activity = ""
            # The last good version came back after a worker's death: what killed it still stands.
            s.stale = restored and not is_on_disk(task.source)
            if not restored:
                self._set_problem(None)
            s.state = "running" if s.playing else "paused"
        if judgement is not None:
            self._judge.judge(self._load_request(Wanted(dict(task.source), None)), judgement)
        elif meaning == "forget":
            self._judge.forget()
        self._follow(task.source_files, {} if s.stale else task.source)
        self._watch()
        if not recording.active:
            return
        if kept:
            # The moment is not to be lost: recording goes on with each env's next episode.
            if not self._recorder.status().active:
                self._recorder.start(task, recording.env_idx)
        else:
            self.start_recording(recording.env_idx)

    def _on_stepped(self, event: Stepped) -> None:
        with self._lock:
            s = self._state
            s.step = event.step
            if s.past is not None and s.timeline is not None:
                s.past.add(event)
                s.timeline.add(event, max(0, s.past.count - 1))
                s.step_serial = s.timeline.history.last
            if s.table is not None and s.terms is not None:
                s.table.add(event, None if s.timeline is None else s.timeline.history)
                s.terms.add(event)
            first, self._first_due = self._first_due, False
            if s.problem is not None and s.problem_at_run and not first:
                # What failed while running runs again: the task was reset, or the policy changed.
                self._set_problem(None)
                s.state = "running" if s.playing else "paused"
        self._recorder.take(event)

    def _on_files_changed(self, paths: set[Path]) -> None:
        self._judge.stop(FILE_SAVED)
        with self._lock:
            self._state.stale = True
        self._note()
        self.reload()

    def _on_lines(self, lines: list[PrintedLine], dropped: int) -> None:
        self._note()
        for line in lines:
            self._print(line.text)

    def _follow(self, paths: Iterable[str], texts: Mapping[str, str]) -> None:
        """Watch the task's own file, whether or not it ever loaded, and `paths` beside it."""
        if self._own_file is None:
            return
        beside = [Path(p) for p in paths if Path(p).is_relative_to(self._own_file.parent)]
        self._watcher.follow({self._own_file, *beside}, texts)

    # --- small things --------------------------------------------------------------------------------

    def _set_problem(self, problem: Problem | None) -> None:
        self._state.problem = problem
        self._state.problem_serial += 1

    def _load_request(self, wanted: Wanted) -> Load:
        options = TaskOptions(
            self._options.num_envs, self._options.backend, self._seed, self._options.env_kwargs
        )
        return Load(self._task, options, wanted.source, snapshot=wanted.snapshot)

    def _bring_back(self, failed: Failed) -> None:
        """A fresh worker could not load the file: it is to have the last good version."""
        with self._lock:
            wanted = self._recovery.wanted() if self._recovery.failed(failed.kept) else None
        if wanted is not None:
            self._send(self._load_request(wanted))

    def _watch_request(self) -> WatchCameras:
        s = self._state
        return WatchCameras(s.selected_env, s.cameras if s.clients > 0 else ())

    def _watch(self) -> None:
        with self._lock:
            request = self._watch_request()
        self._send(request)

    def _send(self, request: Request) -> None:
        self._worker.send(request)

    def _set(self, **values: object) -> None:
        with self._lock:
            for name, value in values.items():
                setattr(self._state, name, value)
        self._note()

    def _note(self) -> None:
        with self._changed:
            self._change += 1
            self._changed.notify_all()
