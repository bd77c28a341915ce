"""The live session: handles requests of the page and events of the worker."""

from __future__ import annotations

import asyncio
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

from workbench.actions.policy import NoPolicy, PolicyFile, find_policy
from workbench.app.state import Effect, SessionEvent, State, apply
from workbench.cameras.apply import StudioJobs
from workbench.cameras.state import KeptPlacements, first_studio, kept_placements, placed_cameras
from workbench.cameras.state import view_of as studio_view_of
from workbench.checks.profile import BeginProfile, EndProfile, ProfileJobs
from workbench.checks.state import BeginCheck, CheckJobs, Checks, ChecksView, EndCheck, KeepCheckAfterSave
from workbench.envs.recorded_run import RecordedRun
from workbench.hands.reset_until import BeginSearch, EndSearch, SearchJobs
from workbench.hands.resets import BeginSampling, EndSampling, ResetJobs
from workbench.hands.spawn import EndSpawn, MeasureSpawn, SpawnJobs
from workbench.hands.start_edit import ChangeStartFile, CheckStart, PlanStart
from workbench.hands.start_jobs import StartJobs
from workbench.live.effects import Asked, Later, Then
from workbench.live.events import (
    FileSaved,
    Follow,
    FollowPolicy,
    InterruptWorker,
    LoadDone,
    LoadPreempted,
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
from workbench.live.history.env_table import EnvRows
from workbench.live.loading import executed_texts, files_at_fault, first_requests, watched_files
from workbench.live.messages import Answer, Event, Loaded, Progress, Request, Settings, TaskFailed, WarmUp
from workbench.live.policies import ListPolicies, PolicySearch
from workbench.live.process.ask import Background, QuestionClient
from workbench.live.process.captured_output import PrintedLine, PrintedLog
from workbench.live.process.supervisor import Death, Supervisor, WorkerOptions
from workbench.live.run import Run, first_run
from workbench.live.view import SessionView, view_of
from workbench.machine.loop import BlockingPool, ChangeCounter, do, later, on_loop, result_of, wait_for_disk
from workbench.machine.preferences import keep_check_after_save
from workbench.machine.processes.watched_thread import listen, report_failure, stop_listening
from workbench.page.command import Command
from workbench.record.live_recorder import LiveRecorder
from workbench.record.save_past import PastSaver
from workbench.record.saving_state import BeginSaving, EndSaving, Saving
from workbench.record.state import BeginEpisodes, EndEpisodes, LiveRecording, TakeStep
from workbench.rescore.past_jobs import PastRescorer
from workbench.rescore.past_scores import RescoredCurve
from workbench.rescore.state import BeginRescoring, EndRescoring
from workbench.solve.seeds import BeginSeeds, EndSeeds, SeedsJobs
from workbench.solve.state import BeginPlan, EndPlan, PlanJobs
from workbench.task.description import Stepped, TaskOptions
from workbench.task.modules import read_source
from workbench.task.problem import Problem
from workbench.task.reference import TaskName
from workbench.task.watch import SourceWatcher

Value = TypeVar("Value")
HISTORY_BYTES = 256 * 1024**2
"""Default memory limit of the history."""
_POLL_SECONDS = 0.05
"""Interval at which `saved` looks whether an episode is still being saved."""


@dataclass(frozen=True)
class KeptWork:
    """The user's work in a session, for a later session of the same task."""

    options: TaskOptions
    settings: Settings
    seed: int
    cameras: KeptPlacements


class Session:
    """One task, one worker, any number of pages. All methods may be called on any thread; all but `wait` and
    `close` return at once.

    Its state is one value, which changes on the loop (`machine.loop`): `dispatch` takes an event, `apply` returns the next
    state and the effects, and `_perform` starts each effect. Nothing waits for the env. When the worker dies, `Supervisor`
    starts another, which loads the last good version; pages stay open.
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
            task: a file, ``file.py:ClassName``, or a registered env id; or a cleared task of a recording.
            recordings: folder for recorded episodes; created when the first is written.
            history_bytes: memory limit of the history.
            worker: limits of the worker process, whether a spare process is kept, and debugging.
            kept: work of the previous session of this task; its options replace `options`.
            check: whether the rules are checked after each load, until a `CheckAfterSave` changes this.
            make_worker: makes the supervisor; tests without a worker process replace it.
            on_event: called, on the supervisor's thread, with the events of the worker, and with a
                `TaskFailed` if the worker dies.
            on_line: called, on a thread that reads the output, with each line that the worker prints. If the
                worker prints too many lines, some are dropped.
            on_notice: called, on any thread, with a message for the terminal.
        """
        self.reference = task
        """Reference with which the task was opened; see also `present_reference`."""
        self._on_event = on_event
        self._print = on_line
        self._on_notice = on_notice
        settings = Settings()
        if kept is not None:
            options, settings = replace(kept.options, seed=kept.seed), replace(kept.settings, cameras=())
        self._gives_up = False
        """Whether nothing waits any more for episodes that are being saved."""
        self._state = State(
            first_run(task, options, history_bytes, settings),
            LiveRecording(str(recordings)),
            first_studio(None if kept is None else kept.cameras),
            checks=Checks(ChecksView(after_each_save=check)),
        )
        self._changes = ChangeCounter()
        self._notify = self._changes.notify
        self._enter_numbers = itertools.count(1)
        self._printed = PrintedLog(self._on_lines)
        self._aside = BlockingPool("follow")
        """Runs the calls that start to watch files: such a call reads the files, so it must not block the
        loop."""
        self._watcher = SourceWatcher(self._on_files_changed)
        self._policy_file = PolicyFile(self._on_policy_saved)
        self._worker = make_worker(
            worker or WorkerOptions(),
            WarmUp(options),
            first_requests=self._first_requests,
            on_event=self._take,
            on_death=self._on_death,
            on_busy=lambda busy: self.dispatch(WorkerBusy(busy)),
            own_files=lambda: self.look(lambda run: run.own_files),
            texts=lambda loading: self.look(lambda run: executed_texts(run, loading)),
            output=self._printed.feed,
        )
        self._background = Background()
        """Sends questions to the background process."""
        self._checks = CheckJobs(self._background, self._dispatch)
        self._profiles = ProfileJobs(self._background, self._dispatch)
        self._plans = PlanJobs(self._dispatch)
        self._seeds = SeedsJobs(recordings, self._dispatch)
        self._policies = PolicySearch(self._dispatch)
        self._resets = ResetJobs(self._background, self._dispatch)
        self._searches = SearchJobs(self._background, self._dispatch)
        self._starts = StartJobs(self._background, self._dispatch)
        self._spawns = SpawnJobs(self._background, self._dispatch)
        self._asker = QuestionClient(self._send)
        self._studio = StudioJobs(self._asker, self._background, self._notify, self._dispatch)
        # Created after the parts above, since it reports recovered episodes at once.
        self._recorder = LiveRecorder(recordings, self._dispatch, on_notice)
        self._past_saver = PastSaver(recordings, self._recorder.finisher, self._background, self._dispatch)
        self._past_rescorer = PastRescorer(self._background, self._dispatch)
        listen(self._log)
        self._watcher.follow(watched_files(self._run))
        self._worker.start()

    # --- events ------------------------------------------------------------------------------------

    def do(self, command: Command, page: str = "") -> None:
        """Carry out a command of `state.DOES`.

        Args:
            page: name of the page that sends it.

        Raises:
            Refused: the command makes no sense now; nothing has changed.
        """
        self.dispatch(Asked(command, page))

    def dispatch(self, event: SessionEvent) -> None:
        """Handle an event: a command of a page, a message of the worker, a saved file.

        Raises:
            Refused: a command makes no sense now; nothing has changed.
        """
        for begun in do(lambda: self._dispatch(event)):
            wait_for_disk(begun)  # a file that is saved after `dispatch` has returned must be noticed

    def _dispatch(self, event: SessionEvent) -> list[Future[None]]:
        """Handle an event; returns the work started off the loop. If an effect fails, the others are still
        performed. The failure is raised if the event is a command; otherwise, it is reported."""
        before, begun, failure = self._state, list[Future[None]](), None
        self._state, effects = apply(before, event, Now(time.monotonic(), time.time()))
        for effect in effects:
            try:
                if (future := self._perform(effect)) is not None:
                    begun.append(future)
            except Exception as error:
                failure = failure or error
        if self._state is not before:
            self._notify()
        if failure is not None and isinstance(event, Asked):
            raise failure
        if failure is not None:
            report_failure("An effect of an event failed", failure)
        return begun

    @property
    def _run(self) -> Run:
        return self._state.run

    def _perform(self, effect: Effect) -> Future[None] | None:
        """Start an effect. Returns the work that runs off the loop, if any."""
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
            case Then(event=event):
                self._dispatch(event)
            case Later(seconds=seconds, event=event):
                later(seconds, lambda: self._dispatch(event))
            case BeginCheck() | EndCheck():
                self._checks.perform(effect)
            case KeepCheckAfterSave(wanted=wanted):
                return self._aside.begin(partial(keep_check_after_save, wanted))
            case BeginProfile() | EndProfile():
                self._profiles.perform(effect)
            case BeginSampling() | EndSampling():
                self._resets.perform(effect)
            case BeginSearch() | EndSearch():
                self._searches.perform(effect)
            case PlanStart() | ChangeStartFile() | CheckStart():
                self._starts.perform(effect)
            case MeasureSpawn() | EndSpawn():
                self._spawns.perform(effect)
            case BeginPlan() | EndPlan():
                self._plans.perform(effect)
            case BeginSeeds() | EndSeeds():
                self._seeds.perform(effect)
            case ListPolicies():
                self._policies.perform(effect)
            case BeginEpisodes() | TakeStep() | EndEpisodes():
                self._recorder.perform(effect)
            case BeginSaving():
                self._past_saver.begin(effect, placed_cameras(self._state.studio))
            case EndSaving():
                self._past_saver.end()
            case BeginRescoring() | EndRescoring():
                self._past_rescorer.perform(effect)
            case _:
                self._studio.perform(effect)
        return None

    def _send(self, request: Request) -> None:
        self._worker.send(request)

    # --- reading -----------------------------------------------------------------------------------

    @on_loop
    def look(self, read: Callable[[Run], Value]) -> Value:
        """The result of `read` for the present run. `read` runs on the loop, since the history is written there."""
        return read(self._run)

    @property
    def present_reference(self) -> TaskName:
        """The task's current reference. Differs from `reference` if another class or a copy of the file was
        chosen since."""
        return self._run.reference

    @on_loop
    def view(self) -> SessionView:
        """A snapshot of one moment; cheap enough for every frame."""
        state, run = self._state, self._run
        features = (
            state.recording.status(run),
            state.rescoring.view,
            state.checks.view,
            state.profile,
            state.seeds,
            state.solving.view(run.env),
            studio_view_of(state.studio, run, self._studio.progress),
            state.hands,
            state.resets,
            state.search,
            state.start_edit,
            state.spawn,
        )
        return view_of(
            self._run,
            printed=self._printed.view(),
            vitals=self._worker.vitals,
            known_policies=self._state.policies.found,
            features={type(one): one for one in features},
        )

    def env_rows(self) -> EnvRows | None:
        """See `Run.env_rows`."""
        return self.look(Run.env_rows)

    @on_loop
    def rescored_curve(self, name: str, env: int) -> RescoredCurve | None:
        """See `Rescoring.curve`."""
        return self._state.rescoring.curve(name, env)

    def wait(self, seen: int, timeout: float) -> int:
        """Wait up to `timeout` seconds until the change counter differs from `seen`; returns the counter."""
        return self._changes.wait(seen, timeout)

    @on_loop
    def kept_work(self) -> KeptWork:
        """The user's work in this session, for a later session of the same task."""
        run = self._run
        return KeptWork(run.options, run.settings, run.seed, kept_placements(self._state.studio))

    @property
    def worker_pid(self) -> int | None:
        """Process id of the worker; None while there is none."""
        return self._worker.pid

    @property
    def episodes_written(self) -> int:
        """Number of episodes whose files are written. Can be read while the loop is busy."""
        return self._recorder.finisher.finished.count

    def knows_file(self, path: str) -> bool:
        """Whether this absolute path is a file of the task, the policy's file, or a module in the task's
        folder. The last two are looked up on the disk."""
        run, file = self._run, Path(path)
        if file in [Path(one).absolute() for one in run.own_files]:
            return True
        if run.policy is not None:
            with contextlib.suppress(NoPolicy):
                if file == Path(find_policy(run.policy, run.folder)[0]).absolute():
                    return True
        # A module that has never loaded is in no `source_files`. Resolve the path: ".." in it may leave the
        # folder.
        folder = run.own_folder
        beside = folder is not None and file.resolve().is_relative_to(folder.resolve())
        return beside and file.suffix == ".py" and file.is_file()

    # --- requests ----------------------------------------------------------------------------------

    def change(self, **settings: Any) -> None:
        """Change fields of `Settings`."""
        self.dispatch(SettingsChanged(settings))

    @on_loop
    def clear_printed(self) -> None:
        """Clear the log."""
        self._printed.clear()
        self._notify()

    def enter_recording(
        self,
        run: RecordedRun,
        everywhere: bool = False,
        source_file: str | None = None,
        source: Mapping[str, str] = MappingProxyType({}),
    ) -> int:
        """See `RunToEnter`; returns its number."""
        number = next(self._enter_numbers)
        self.dispatch(RunToEnter(run, number, everywhere, source_file, source))
        return number

    @on_loop
    def saving(self) -> Saving:
        """The episodes that are being saved from the history. Also valid while the session closes."""
        return self._state.recording.saving

    @on_loop
    def give_up_saving(self) -> None:
        """End the waits of `saved` and `close` for episodes that are being saved."""
        self._gives_up = True

    async def saved(self) -> None:
        """Wait until no episode is being saved, or until `give_up_saving`."""
        while self._state.recording.saving.unsaved and not self._gives_up:
            await asyncio.sleep(_POLL_SECONDS)

    def close(self, finish_saving: bool = False) -> None:
        """End all processes and threads; waits for episodes that are being written. Must not be called on the loop.

        Args:
            finish_saving: also wait, until `give_up_saving`, for episodes that are being saved from the history. Only
                the process that saves them is kept meanwhile.
        """
        stop_listening(self._log)
        self._changes.close()
        self._worker.stop()
        self._watcher.stop()
        self._aside.end()
        self._policy_file.close()
        self._past_rescorer.close()
        self._checks.close()
        self._profiles.close()
        self._resets.close()
        self._searches.close()
        self._starts.close()
        self._spawns.close()
        self._plans.close()
        self._seeds.close()
        self._policies.close()
        self._studio.close()
        if finish_saving:
            result_of(self.saved())
        if text := self.saving().text:
            self._on_notice(f"The session ended, and this is lost: {text}.")
        self._past_saver.close()
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
        """Handle an event of the worker. Called on the supervisor's thread; returns when the event is
        handled."""
        # Files are read here: a disk that hangs must not block the loop.
        if isinstance(event, TaskFailed):
            # Watch the files before the user sees the problem and saves a fix.
            files = self.look(lambda run: files_at_fault(run, event))
            wait_for_disk(do(lambda: self._perform(Follow(files))) if files else None)
        on_disk = True
        if isinstance(event, Loaded):
            # Find changes made since the files were read; the watcher finds later ones.
            looked = do(lambda: self._aside.begin(partial(_is_on_disk, event.task.source)))
            wait_for_disk(looked)
            on_disk = not looked.done() or looked.cancelled() or looked.result()
        if do(lambda: self._handle(event, on_disk)):
            self._on_event(event)

    def _on_death(self, death: Death) -> None:
        """Handle the death of a worker. Called on the supervisor's thread."""
        problem, kept = do(lambda: self._died(death))
        if problem is not None:
            self._on_event(TaskFailed(problem, kept))

    def _died(self, death: Death) -> tuple[Problem | None, bool]:
        """Returns the problem to show, if any, and whether there is a version to restore."""
        before = self._run.problem_serial
        self._dispatch(WorkerDied(death, self._printed.tail(20)))
        run = self._run
        return run.problem if run.problem_serial != before else None, run.task is not None

    def _handle(self, event: Event, on_disk: bool) -> bool:
        """Handle an event; returns whether `on_event` needs it.

        Args:
            on_disk: for a loaded version, whether the files still contain the code that was loaded.
        """
        match event:
            case TaskFailed() if self._worker.load_pending and event.problem.interrupted:
                self._dispatch(LoadPreempted(event))
                return False  # interrupted because a newer version waits: no failure to report
            case Loaded():
                self._on_loaded(event, on_disk)
            case Stepped():
                self._dispatch(event)
            case Answer() | Progress():
                self._asker.take(event)
                self._notify()
            case _:
                self._dispatch(event)
        return True

    def _on_loaded(self, event: Loaded, on_disk: bool) -> None:
        self._worker.reset_deaths()
        self._dispatch(VersionLoaded(event, on_disk))
        self._dispatch(LoadDone())

    # --- files and output ----------------------------------------------------------------------------

    @on_loop
    def _on_files_changed(self, paths: set[Path]) -> None:
        """A watched file was saved."""
        self._dispatch(FileSaved())

    def _on_policy_saved(self) -> None:
        """Reload the policy. Called on the watcher's thread."""
        # A policy in the task's folder is also watched as a module of the task, and that watcher reports
        # "nothing changed". So the log names the reload of the policy.
        self._log("the policy's file was saved: it is read again")
        self.dispatch(PolicySaved())

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
