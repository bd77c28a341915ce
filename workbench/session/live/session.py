"""The live session: takes requests of the page and events of the worker."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

from workbench.authoring.loading.modules import read_source
from workbench.authoring.loading.reference import TaskName
from workbench.authoring.loading.watch import SourceWatcher
from workbench.authoring.problem import Problem
from workbench.commands.command import Command
from workbench.commands.run import PauseRun
from workbench.core.capture.recorded_run import RecordedRun
from workbench.jobs.policy import NoPolicy, PolicyFile, find_policy
from workbench.jobs.task import Stepped, TaskOptions
from workbench.machine.processes.watched_thread import listen, stop_listening
from workbench.session.cameras.state import KeptPlacements, first_studio, kept_placements, placed_cameras
from workbench.session.cameras.state import view_of as studio_view_of
from workbench.session.cameras.studio import StudioJobs
from workbench.session.checks.checks import Checks
from workbench.session.checks.profile import StepProfiler
from workbench.session.checks.solve_seeds import SeedsSolver
from workbench.session.events import Asked
from workbench.session.history.env_table import EnvRows
from workbench.session.live.solver import Solver
from workbench.session.live.state import Effect, SessionEvent, State, apply
from workbench.session.live.view import SessionView, view_of
from workbench.session.loop import Aside, ChangeCounter, do, on_loop, wait_for_disk
from workbench.session.process.askers import Asker, Background
from workbench.session.process.captured_output import PrintedLine, PrintedLog
from workbench.session.process.supervisor import Death, End, Supervisor, WorkerOptions
from workbench.session.protocol.messages import (
    Answer,
    Event,
    Loaded,
    LoadFailed,
    PlanDropped,
    PlanWanted,
    Progress,
    Request,
    SetCapture,
    Settings,
    WarmUp,
)
from workbench.session.record.live import LiveRecorder
from workbench.session.record.save_past import PastSaver, request_of
from workbench.session.rescore.background import StoppedBy
from workbench.session.rescore.past import PastRescorer, RescoredPast, rescore_after_load
from workbench.session.run.events import (
    EnvsReset,
    FileSaved,
    Follow,
    FollowPolicy,
    InterruptWorker,
    LoadDone,
    LoadGaveWay,
    Now,
    PolicySaved,
    ReplaceWorker,
    RunToEnter,
    Send,
    SettingsChanged,
    VersionLoaded,
    WorkerBusy,
    WorkerDied,
)
from workbench.session.run.loading import files_at_fault, first_requests, past_after, watched_files
from workbench.session.run.run import Run, first_run

Value = TypeVar("Value")
HISTORY_BYTES = 256 * 1024**2
"""Default memory limit of the history."""


@dataclass(frozen=True)
class KeptWork:
    """What a person did in a session, for a later session of the same task."""

    options: TaskOptions
    settings: Settings
    seed: int
    cameras: KeptPlacements


class Session:
    """One task, one worker, any number of pages. All methods may be called on any thread, and return at once.

    Its state is one value, which changes on the loop (`session.loop`): `happen` takes an event, `apply` says what the state is
    after it and what has to be done, and `_perform` begins that. Nothing waits for the env. When the
    worker dies, `Supervisor` starts another, which loads the last good version; pages stay open.
    """

    def __init__(
        self,
        task: TaskName,
        options: TaskOptions,
        *,
        recordings: Path,
        history_bytes: int = HISTORY_BYTES,
        worker: WorkerOptions | None = None,
        kept: KeptWork | None = None,
        check: bool = False,
        make_worker: Callable[..., Supervisor] = Supervisor,
        on_event: Callable[[Event], None] = lambda event: None,
        on_line: Callable[[PrintedLine], None] = lambda line: None,
        on_notice: Callable[[str], None] = lambda words: None,
    ) -> None:
        """
        Args:
            task: a file, ``file.py:ClassName``, or a registered env id; or what a recording names, cleared.
            recordings: folder for recorded episodes; made when the first is written.
            history_bytes: memory limit of the history.
            worker: limits of the worker process, and whether there is a spare one.
            kept: of an earlier session of this task; its options are used in place of `options`.
            check: whether the rules are checked after each load; `checks` changes it.
            make_worker: makes the supervisor; tests without a worker process give another.
            on_event: called with every event of the worker, and with its death as `LoadFailed`, on the supervisor's thread.
            on_line: called with the lines that the worker printed, from other threads; drops some of a flood.
            on_notice: called, on any thread, with a message for the terminal.
        """
        self.reference = task
        """The task as it was opened."""
        self._on_event = on_event
        self._print = on_line
        settings = Settings()
        if kept is not None:
            options, settings = replace(kept.options, seed=kept.seed), replace(kept.settings, cameras=())
        studio = first_studio(None if kept is None else kept.cameras)
        self._state = State(first_run(task, options, history_bytes, settings), studio)
        self._changes = ChangeCounter()
        self._notify = self._changes.notify
        self._enter_numbers = itertools.count(1)
        self._printed = PrintedLog(self._on_lines)
        self._aside = Aside("follow")
        """Begins to watch files, for which they are read."""
        self._watcher = SourceWatcher(self._on_files_changed)
        self._policy_file = PolicyFile(self._on_policy_saved)
        self._worker = make_worker(
            worker or WorkerOptions(),
            WarmUp(options),
            first_requests=self._first_requests,
            on_event=self._take,
            on_death=self._on_death,
            on_busy=lambda busy: self.happen(WorkerBusy(busy)),
            own_files=lambda: self.look(lambda run: run.own_files),
            output=self._printed.feed,
        )
        self._recorder = LiveRecorder(
            recordings, self._notify, lambda envs: self._send(SetCapture(envs, from_reset=True)), on_notice
        )
        self._background = Background()
        """Asks questions of the background process."""
        self.past_saver = PastSaver(recordings, self._recorder.finisher, self._notify, self._background)
        self.rescorer = PastRescorer(self._notify, self._background)
        self.checks = Checks(self._notify, self._background, check)
        """Checks the rules of the running version."""
        self.profiler = StepProfiler(self._notify, self._background)
        """Measures where the time of a step of the running version goes."""
        self.solver = Solver(self._notify, self._send, lambda: self.do(PauseRun()))
        """Plans the actions of the source *solve*."""
        self.seeds_solver = SeedsSolver(self._notify, recordings)
        """Solves the task from many seeds."""
        self._asker = Asker(self._send)
        self._studio = StudioJobs(self._asker, self._background, self._notify, self._happen)
        listen(self._log)
        self._watcher.follow(watched_files(self._run))
        self._worker.start()

    # --- what happens ------------------------------------------------------------------------------

    def do(self, command: Command, page: str = "") -> None:
        """Carry out a command of `state.DOES`.

        Args:
            page: name of the page that asks.

        Raises:
            Refused: it makes no sense now; nothing has changed.
        """
        self.happen(Asked(command, page))

    def happen(self, event: SessionEvent) -> None:
        """Take an event: what a page asks for, what the worker says, a saved file.

        Raises:
            Refused: a command makes no sense now; nothing has changed.
        """
        for begun in do(lambda: self._happen(event)):
            wait_for_disk(begun)  # then a save is noticed

    def _happen(self, event: SessionEvent) -> list[Future[None]]:
        """Returns what was begun beside the loop."""
        before = self._state
        self._state, effects = apply(before, event, Now(time.monotonic(), time.time()))
        begun = [future for effect in effects if (future := self._perform(effect)) is not None]
        if self._state is not before:
            self._notify()
        return begun

    @property
    def _run(self) -> Run:
        return self._state.run

    def _perform(self, effect: Effect) -> Future[None] | None:
        """Begin it. Returns what is done beside the loop."""
        match effect:
            case Send(request=request):
                self._send(request)
            case ReplaceWorker():
                self._worker.replace()
            case InterruptWorker():
                self._worker.interrupt()
            case Follow(files=files, texts=texts):
                return self._aside.begin(partial(self._watcher.follow, files, texts))
            case FollowPolicy(policy=policy, folder=folder):
                return self._aside.begin(partial(self._policy_file.follow, policy, folder))
            case _:
                self._studio.perform(effect)
        return None

    def _send(self, request: Request) -> None:
        self._worker.send(request)

    # --- reading -----------------------------------------------------------------------------------

    @on_loop
    def look(self, read: Callable[[Run], Value]) -> Value:
        """What `read` gives of the present run. It runs on the loop, since the history is written into there."""
        return read(self._run)

    @property
    def present_reference(self) -> TaskName:
        """The task as it is named now: another class of the file, or a copy of the file, may have been chosen since."""
        return self._run.reference

    @on_loop
    def view(self) -> SessionView:
        """A snapshot of one moment; cheap enough for every frame."""
        env = self._run.env
        view = view_of(
            self._run,
            printed=self._printed.view(),
            vitals=self._worker.vitals,
            rescored=self.rescorer.rescoring.view,
            checks=self.checks.view,
            profile=self.profiler.view,
            seeds=self.seeds_solver.view,
            solve=self.solver.view(env),
        )
        recording = replace(self._recorder.status(), saving=self.past_saver.status(_shown(self._run)))
        studio = studio_view_of(self._state.studio, self._run, self._studio.progress)
        return replace(view, recording=recording, studio=studio)

    def env_rows(self) -> EnvRows | None:
        """See `Run.env_rows`."""
        return self.look(Run.env_rows)

    def wait(self, seen: int, timeout: float) -> int:
        """Block until the counter of changes differs from `seen`; returns the counter."""
        return self._changes.wait(seen, timeout)

    @on_loop
    def kept_work(self) -> KeptWork:
        """What a person did in this session, for a later session of the same task."""
        run = self._run
        return KeptWork(run.options, run.settings, run.seed, kept_placements(self._state.studio))

    @property
    def task_folder(self) -> Path | None:
        """Folder of the task's own file, where policies are looked for too."""
        return self._run.folder

    @property
    def worker_pid(self) -> int | None:
        """Process id of the worker; None while there is none."""
        return self._worker.pid

    def knows_file(self, path: str) -> bool:
        """Whether this absolute path is a file of the task, of its policy, or a module in the task's folder. Looks at the
        disk."""
        run = self._run
        known = run.own_files
        if run.policy is not None:
            with contextlib.suppress(NoPolicy):
                known = [*known, str(find_policy(run.policy, run.folder)[0])]
        file, folder = Path(path), run.own_folder
        # A module that has never loaded is in no `source_files`. Resolved: a path may leave the folder again by "..".
        beside = folder is not None and file.resolve().is_relative_to(folder.resolve())
        return file in [Path(one).absolute() for one in known] or (
            beside and file.suffix == ".py" and file.is_file()
        )

    # --- requests ----------------------------------------------------------------------------------

    def change(self, **settings: Any) -> None:
        """Change fields of `Settings`."""
        self.happen(SettingsChanged(settings))

    @on_loop
    def clear_printed(self) -> None:
        """Clear the log."""
        self._printed.clear()
        self._notify()

    @on_loop
    def start_recording(
        self, env_idx: tuple[int, ...] | None = None, next_episode: bool = False, goes_on: bool = False
    ) -> None:
        """Reset these envs (all if None) and record them until `stop_recording`.

        Args:
            next_episode: do not reset; record only the episode of each env that begins with its next reset.
            goes_on: as `LiveRecorder.start` has it.
        """
        task = self._run.task
        if task is None:
            return
        envs = tuple(range(task.num_envs)) if env_idx is None else env_idx
        self.past_saver.forget()
        self._recorder.start(task, envs, one_each=next_episode, goes_on=goes_on)
        self._send(SetCapture(envs, from_reset=True))
        if not next_episode:
            self.happen(EnvsReset(None if env_idx is None else envs))
        self._notify()

    @on_loop
    def stop_recording(self) -> None:
        """Stop recording; the running episodes are written as far as they are."""
        self._send(SetCapture(()))
        self._recorder.stop()
        self._notify()

    @on_loop
    def save_past(self, env_idx: tuple[int, ...] | None = None, before: bool = False) -> None:
        """Record from the history: for each of these envs (all if None) the episode that contains the shown moment.

        While live, the running episode is saved; if it has no step yet, the one before. `SessionView.recording` has progress
        and result.

        Args:
            before: record the episode before that one.
        """
        what = request_of(self._run, env_idx, placed_cameras(self._state.studio), before)
        if isinstance(what, str):
            self.past_saver.refuse(what, _shown(self._run))
        else:
            self.past_saver.save(what)

    def enter_recording(
        self,
        run: RecordedRun,
        everywhere: bool = False,
        source_file: str | None = None,
        source: Mapping[str, str] = MappingProxyType({}),
    ) -> int:
        """See `RunToEnter`; returns its number."""
        number = next(self._enter_numbers)
        self.happen(RunToEnter(run, number, everywhere, source_file, source))
        return number

    @on_loop
    def check_now(self) -> None:
        """Check the rules of the running version."""
        if (load := self._run.running_load()) is not None:
            self.checks.check(load)

    @on_loop
    def profile_step(self) -> None:
        """Time a control step of the running version."""
        if (load := self._run.running_load()) is not None:
            self.profiler.profile(load)

    @on_loop
    def solve_seeds(self, seeds: int) -> None:
        """Solve the file as it is saved from seeds 0 to `seeds` - 1."""
        if (load := self._run.running_load()) is not None:
            self.seeds_solver.solve(load, seeds, self._run.settings.plan)

    def close(self) -> None:
        """End all processes and threads; waits for episodes that are being written. Called on another thread than the loop."""
        stop_listening(self._log)
        self._changes.close()
        self._worker.stop()
        self._watcher.stop()
        self._aside.end()
        self._policy_file.close()
        self.rescorer.rescoring.close()
        self.checks.close()
        self.profiler.close()
        self.solver.close()
        self.seeds_solver.close()
        self._studio.close()
        self.past_saver.close()
        self._background.close()
        self._recorder.close()

    # --- events of the worker ------------------------------------------------------------------------

    @on_loop
    def _first_requests(self) -> list[Request]:
        """First requests to a new worker."""
        run, requests = first_requests(self._run)
        self._state = replace(self._state, run=run)
        self._notify()
        return requests

    def _take(self, event: Event) -> None:
        """Take an event of the worker. Called on the supervisor's thread, which continues when the event was taken."""
        # Files are read here: a disk that hangs must not keep the loop.
        if isinstance(event, LoadFailed):
            # Before a person sees the problem and mends the file.
            files = self.look(lambda run: files_at_fault(run, event))
            wait_for_disk(do(lambda: self._perform(Follow(files))) if files else None)
        on_disk = not isinstance(event, Loaded) or _is_on_disk(event.task.source)
        if do(lambda: self._handle(event, on_disk)):
            self._on_event(event)

    def _on_death(self, death: Death) -> None:
        """Take the death of a worker. Called on the supervisor's thread."""
        problem, kept = do(lambda: self._died(death))
        if problem is not None:
            self._on_event(LoadFailed(problem, kept))

    def _died(self, death: Death) -> tuple[Problem | None, bool]:
        """Returns the problem to show, if any, and whether there is a version to bring back."""
        if death.end is not End.HANDED_OVER:
            self._recorder.stop()
        self.solver.stop()
        before = self._run.problem_serial
        self._happen(WorkerDied(death, self._printed.tail(20)))
        run = self._run
        return run.problem if run.problem_serial != before else None, run.task is not None

    def _handle(self, event: Event, on_disk: bool) -> bool:
        """Take an event; returns whether anybody needs to hear of it.

        Args:
            on_disk: of a version that was loaded: whether the files still have its texts.
        """
        match event:
            case LoadFailed() if self._worker.load_pending and event.problem.interrupted:
                self._happen(LoadGaveWay(event))
                return False  # interrupted because a newer version waits: no failure to report
            case Loaded():
                self._on_loaded(event, on_disk)
            case Stepped():
                self._happen(event)
                self.solver.stepped(event, self._run.settings.action_source == "solve")
                self._recorder.take(event)
            case Answer() | Progress():
                self._asker.take(event)
                self._notify()
            case PlanWanted():
                if (load := self._run.running_load()) is not None:
                    self.solver.plan(event, load, self._run.settings)
            case PlanDropped():
                self.solver.stop()
            case _:
                self._happen(event)
        return True

    def _on_loaded(self, event: Loaded, on_disk: bool) -> None:
        self._worker.reset_deaths()
        recording, one_each = self._recorder.recording, self._recorder.one_each
        level = None if event.reload is None else event.reload.level
        if level != "same":
            # An episode must not mix steps of two versions, nor of two processes.
            self._recorder.stop()
            self.past_saver.forget()
        before = self._run
        past = past_after(before.task, event, before.recovery.restoring)
        what_to_do = rescore_after_load(past, self.rescorer.rescoring.view)
        rescored = None
        if what_to_do == "rescore" and before.past is not None:
            versions = [task for task in (before.task, event.task) if task is not None]
            has_reward = any(task.reward_mode != "none" for task in versions)
            # Made before the newest moment gets the new version's scores.
            rescored = RescoredPast(before.past.history, before.past.at, has_reward)
        self._happen(VersionLoaded(event, on_disk))
        run = self._run
        load = run.running_load()
        assert run.task is not None and load is not None
        if rescored is not None:
            self.rescorer.rescore(load, rescored)
        elif what_to_do == "forget":
            self.rescorer.forget()
        # After the rescoring was begun: the later of two jobs of one priority comes first.
        self.checks.loaded(load, before.task is not None and before.task.env_id == run.task.env_id)
        self.profiler.loaded()
        self.seeds_solver.loaded()
        if recording:
            put_back = past != "gone" or (event.reload is not None and bool(event.reload.carried))
            self._continue_recording(put_back, recording, one_each)
        self._happen(LoadDone())

    def _continue_recording(self, put_back: bool, env_idx: tuple[int, ...], one_each: bool) -> None:
        """Continue recording these envs after a version came in.

        Args:
            put_back: it goes on with episodes that are under way.
        """
        if not put_back:
            self.start_recording(env_idx, next_episode=one_each, goes_on=True)
        elif not self._recorder.recording:
            # No reset, which would lose the present moment: recording continues with each env's next episode.
            task = self._run.task
            if task is not None:
                self._recorder.start(task, env_idx, one_each, goes_on=True)
                self._send(SetCapture(env_idx, from_reset=True))

    # --- files and output ----------------------------------------------------------------------------

    @on_loop
    def _on_files_changed(self, paths: set[Path]) -> None:
        """A watched file was saved."""
        self.solver.stop()
        self.rescorer.stop(StoppedBy.SAVE)
        self.checks.stop(StoppedBy.SAVE)
        self._happen(FileSaved())

    def _on_policy_saved(self) -> None:
        """Read the policy again. Called on the watcher's thread."""
        # A policy in the task's folder is also watched as a module of the task, for which a save reports "nothing changed".
        self._log("the policy's file was saved: it is read again")
        self.happen(PolicySaved())
        self._notify()

    def _on_lines(self, lines: list[PrintedLine], dropped: int) -> None:
        self._notify()
        for line in lines:
            self._print(line)

    def _log(self, text: str) -> None:
        """Add a text to the log of the page and of the terminal."""
        for line in text.splitlines():
            self._printed.feed("stderr", f"workbench: {line}\n".encode(errors="replace"))


def _is_on_disk(source: Mapping[str, str]) -> bool:
    """Whether the files still have these texts."""
    for path, text in source.items():
        try:
            if read_source(path) != text:
                return False
        except (OSError, SyntaxError):
            return False
    return True


def _shown(run: Run) -> object:
    """The version, env and moment that are shown."""
    past = run.past
    return run.task_serial, run.env, None if past is None else (past.at, past.pinned)
