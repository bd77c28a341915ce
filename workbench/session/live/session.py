"""The live session: takes requests of the page and events of the worker."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from workbench.authoring.loading.reference import TaskName
from workbench.authoring.problem import Problem
from workbench.core.capture.inspection import Section
from workbench.core.capture.recorded_run import RecordedRun
from workbench.jobs.policy import PolicyFile
from workbench.jobs.task import Stepped, TaskOptions
from workbench.machine.processes.watched_thread import listen, stop_listening
from workbench.session.cameras.selection import KeptPlacements
from workbench.session.cameras.studio import CameraStudio
from workbench.session.checks.checks import Checks
from workbench.session.checks.profile import StepProfiler
from workbench.session.checks.solve_seeds import SeedsSolver
from workbench.session.history.env_table import EnvRows
from workbench.session.live.live_state import LiveState, past_after
from workbench.session.live.solver import Solver
from workbench.session.live.timeline import TimeTravel
from workbench.session.live.versions import Versions, is_on_disk
from workbench.session.live.view import SessionView
from workbench.session.loop import Aside, ChangeCounter, do, on_loop, wait_for_disk
from workbench.session.process.askers import Asker, Background
from workbench.session.process.captured_output import PrintedLine, PrintedLog
from workbench.session.process.heartbeat import Busy
from workbench.session.process.supervisor import Death, End, Supervisor, WorkerOptions
from workbench.session.protocol.messages import (
    Answer,
    EnterRecording,
    Event,
    Inspect,
    Loaded,
    LoadFailed,
    Loading,
    NewProcessNeeded,
    Placed,
    PlanDropped,
    PlanWanted,
    Play,
    Progress,
    Request,
    Reset,
    SetCapture,
    Settings,
    SingleStep,
    Tell,
    WarmUp,
)
from workbench.session.record.live import LiveRecorder
from workbench.session.record.save_past import PastSaver
from workbench.session.rescore.background import StoppedBy
from workbench.session.rescore.past import PastRescorer, RescoredPast, rescore_after_load

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

    All of its state changes on the loop (`session.loop`). Requests only change the state and send a message; none waits
    for the env. The worker's events come one by one and change the `LiveState`, of which `view` makes a snapshot. When the
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
        if kept is not None:
            options = replace(kept.options, seed=kept.seed)
        self._state = LiveState(task, options, history_bytes)
        if kept is not None:
            self._state.set(settings=replace(kept.settings, cameras=()))
        self._changes = ChangeCounter()
        self._notify = self._changes.notify
        self._to_enter: tuple[Callable[[tuple[int, ...]], EnterRecording], bool] | None = None
        """Request to send as soon as a task is loaded, and whether for all envs."""
        self._enter_numbers = itertools.count(1)
        self._printed = PrintedLog(self._on_lines)
        self._aside = Aside("follow")
        """Begins to watch files, for which they are read."""
        self.versions = Versions(
            self._state,
            self._notify,
            self._send,
            lambda: self._worker.replace(),
            self._on_save,
            self._aside,
        )
        """Loads versions of the file."""
        self._worker = make_worker(
            worker or WorkerOptions(),
            WarmUp(options),
            first_requests=self.versions.first_requests,
            on_event=self._take,
            on_death=self._on_death,
            on_busy=self._on_busy,
            own_files=self.versions.own_files,
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
        self.solver = Solver(self._notify, self._send, lambda: self._set_playing(False))
        """Plans the actions of the source *solve*."""
        self.seeds_solver = SeedsSolver(self._notify, recordings)
        """Solves the task from many seeds."""
        self._policy_file = PolicyFile(self._on_policy_saved)
        self.past = TimeTravel(self._state, self._notify, self._send, self.pause)
        """The timeline."""
        self._asker = Asker(self._send)
        self.studio = CameraStudio(
            self._send,
            self._asker,
            self._background,
            self._notify,
            self.past,
            self.versions.running_load,
            self.versions.open_file,
            None if kept is None else kept.cameras,
        )
        """The camera studio."""
        listen(self._log)
        self.versions.start()
        self._worker.start()

    # --- reading -----------------------------------------------------------------------------------

    @property
    def present_reference(self) -> TaskName:
        """The task as it is named now: another class of the file, or a copy of the file, may have been chosen since."""
        return self._state.reference

    @on_loop
    def view(self) -> SessionView:
        """A snapshot of one moment; cheap enough for every frame."""
        env = self._state.now.settings.selected_env
        view = self._state.view(
            printed=self._printed.view(),
            vitals=self._worker.vitals,
            rescored=self.rescorer.rescoring.view,
            checks=self.checks.view,
            profile=self.profiler.view,
            seeds=self.seeds_solver.view,
            solve=self.solver.view(env),
        )
        recording = replace(self._recorder.status(), saving=self.past_saver.status(_shown(view)))
        return replace(view, recording=recording, studio=self.studio.view(view.step, env))

    @on_loop
    def env_rows(self) -> EnvRows | None:
        """The table of envs at the shown moment; None before a task is loaded. Copies some 100 kB for 256 envs: not for
        every frame."""
        return None if self._state.timeline is None else self._state.timeline.env_rows()

    def wait(self, seen: int, timeout: float) -> int:
        """Block until the counter of changes differs from `seen`; returns the counter."""
        return self._changes.wait(seen, timeout)

    @on_loop
    def kept_work(self) -> KeptWork:
        """What a person did in this session, for a later session of the same task."""
        options, now = self._state.options, self._state.now
        return KeptWork(options, now.settings, now.seed, self.studio.kept_placements())

    @property
    def task_folder(self) -> Path | None:
        """Folder of the task's own file, where policies are looked for too."""
        return do(lambda: self._state.folder)

    @property
    def worker_pid(self) -> int | None:
        """Process id of the worker; None while there is none."""
        return self._worker.pid

    # --- requests ----------------------------------------------------------------------------------

    def interrupt(self) -> None:
        """Interrupt the author's code, if it is running; its traceback becomes the problem."""
        self._worker.interrupt()

    @on_loop
    def clear_printed(self) -> None:
        """Clear the log."""
        self._printed.clear()
        self._notify()

    @on_loop
    def play(self) -> None:
        self.past.seek(None)
        self._set_playing(True)

    @on_loop
    def pause(self) -> None:
        self._set_playing(False)

    @on_loop
    def step(self) -> None:
        """One control step; pauses first."""
        self.past.seek(None)
        self._set_playing(False, SingleStep())

    def _set_playing(self, playing: bool, request: Play | SingleStep | None = None) -> None:
        """Note whether the session plays, and send `request`, or a plain `Play`."""
        self._state.set(playing=playing)
        self._state.wants_play = playing
        self._notify()
        self._send(request or Play(playing))

    @on_loop
    def reset(self, env_idx: tuple[int, ...] | None = None) -> None:
        """Reset all envs with the session's seed, or some with fresh seeds."""
        self.past.seek(None)
        self._send(Reset(env_idx, self._state.now.seed if env_idx is None else None))

    @on_loop
    def set_seed(self, seed: int) -> None:
        """Change the seed and reset all envs with it."""
        self._state.set(seed=int(seed))
        self.reset()

    def change(self, **settings: Any) -> None:
        """Change fields of `Settings`."""
        wait_for_disk(do(lambda: self._change(settings)))  # then a save of the policy is noticed

    def _change(self, settings: Mapping[str, Any]) -> Future[None] | None:
        policy = self._state.policy
        if not self._state.change(**settings):
            return None
        self._send_settings()
        self._notify()
        if self._state.policy == policy:
            return None
        # It reads the file.
        return self._aside.begin(partial(self._policy_file.follow, self._state.policy, self._state.folder))

    @on_loop
    def tell(
        self, dimensions: Sequence[int], values: Sequence[float], env_idx: tuple[int, ...] | None = None
    ) -> None:
        """Tell envs (all if None) these numbers of their action, while its source is ``sliders``; without any, to hold still."""
        self.past.seek(None)
        task = self._state.now.task
        if task is not None:
            envs = tuple(range(task.num_envs)) if env_idx is None else env_idx
            self._send(Tell(envs, tuple(dimensions), tuple(values)))

    def _on_policy_saved(self) -> None:
        """Read the policy again. Called on the watcher's thread."""
        # A policy in the task's folder is also watched as a module of the task, for which a save reports "nothing changed".
        self._log("the policy's file was saved: it is read again")
        do(lambda: self._send(self._state.policy_saved()))
        self._notify()

    @on_loop
    def inspect(self, sections: tuple[Section, ...]) -> None:
        """Inspect the selected env once; the answer becomes `SessionView.inspection`."""
        env = self._state.now.settings.selected_env
        self._send(Inspect(env, sections))

    @on_loop
    def set_clients(self, count: int) -> None:
        """Set the number of open pages; with none, no picture is rendered."""
        before, self._state.clients = self._state.clients, count
        if (before == 0) != (count == 0):
            self._send_settings()

    @on_loop
    def start_recording(
        self, env_idx: tuple[int, ...] | None = None, next_episode: bool = False, goes_on: bool = False
    ) -> None:
        """Reset these envs (all if None) and record them until `stop_recording`.

        Args:
            next_episode: do not reset; record only the episode of each env that begins with its next reset.
            goes_on: as `LiveRecorder.start` has it.
        """
        task = self._state.now.task
        if task is None:
            return
        envs = tuple(range(task.num_envs)) if env_idx is None else env_idx
        self.past_saver.forget()
        self._recorder.start(task, envs, one_each=next_episode, goes_on=goes_on)
        self._send(SetCapture(envs, from_reset=True))
        if not next_episode:
            self.reset(None if env_idx is None else envs)
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
        load = self.versions.running_load()
        placed = self.studio.placed_cameras()
        what = self._state.save_request(env_idx, load, placed, before)
        at = _shown(self._state.view())
        if isinstance(what, str):
            self.past_saver.refuse(what, at)
        else:
            self.past_saver.save(what)

    @on_loop
    def enter_recording(
        self,
        run: RecordedRun,
        everywhere: bool = False,
        source_file: str | None = None,
        source: Mapping[str, str] = MappingProxyType({}),
    ) -> int:
        """Put the selected env, or all, into the last state of a recorded run, and pause. Waits for a task to be loaded.

        Args:
            source_file, source: the task's source when it was recorded; changes since are reported with the result.

        Returns:
            The value of `TimelineView.entered` when it is done.
        """
        number = next(self._enter_numbers)
        self._send_enter(
            lambda env_idx: EnterRecording(run, env_idx, source_file, dict(source), number), everywhere
        )
        return number

    def _send_enter(self, request: Callable[[tuple[int, ...]], EnterRecording], everywhere: bool) -> None:
        self.past.seek(None)
        self.pause()
        task, env = self._state.now.task, self._state.now.settings.selected_env
        if task is None:
            self._to_enter = request, everywhere
            return
        self._send(request(tuple(range(task.num_envs)) if everywhere else (env,)))
        self._notify()

    @on_loop
    def check_now(self) -> None:
        """Check the rules of the running version."""
        if (load := self.versions.running_load()) is not None:
            self.checks.check(load)

    @on_loop
    def profile_step(self) -> None:
        """Time a control step of the running version."""
        if (load := self.versions.running_load()) is not None:
            self.profiler.profile(load)

    @on_loop
    def solve_seeds(self, seeds: int) -> None:
        """Solve the file as it is saved from seeds 0 to `seeds` - 1."""
        plan = self._state.now.settings.plan
        if (load := self.versions.running_load()) is not None:
            self.seeds_solver.solve(load, seeds, plan)

    @on_loop
    def show(self, env: int, serial: int) -> None:
        """Select an env and show a moment of the history."""
        self.change(selected_env=env)
        self.past.seek(serial)

    def close(self) -> None:
        """End all processes and threads; waits for episodes that are being written. Called on another thread than the loop."""
        stop_listening(self._log)
        self._changes.close()
        self._worker.stop()
        self.versions.close()
        self._aside.end()
        self._policy_file.close()
        self.rescorer.rescoring.close()
        self.checks.close()
        self.profiler.close()
        self.solver.close()
        self.seeds_solver.close()
        self.studio.close()
        self.past_saver.close()
        self._background.close()
        self._recorder.close()

    # --- events of the worker ------------------------------------------------------------------------

    def _take(self, event: Event) -> None:
        """Take an event of the worker. Called on the supervisor's thread, which continues when the event was taken."""
        # Files are read here: a disk that hangs must not keep the loop.
        if isinstance(event, LoadFailed):
            self.versions.follow_failure(event)
        on_disk = not isinstance(event, Loaded) or is_on_disk(event.task.source)
        if do(lambda: self._handle(event, on_disk)):
            self._on_event(event)

    def _on_death(self, death: Death) -> None:
        """Take the death of a worker. Called on the supervisor's thread."""
        problem, kept = do(lambda: self._died(death))
        if problem is not None:
            self._on_event(LoadFailed(problem, kept))

    def _died(self, death: Death) -> tuple[Problem | None, bool]:
        if death.end is not End.HANDED_OVER:
            self._recorder.stop()
        self.solver.stop()
        self.studio.interrupted()
        self._notify()
        return self.versions.died(death, self._printed.tail(20))

    @on_loop
    def _on_busy(self, busy: Busy | None) -> None:
        if busy is None and self._state.now.busy is None:
            return
        self._state.set(busy=busy)
        self._notify()

    def _handle(self, event: Event, on_disk: bool) -> bool:
        """Take an event; returns whether anybody needs to hear of it.

        Args:
            on_disk: of a version that was loaded: whether the files still have its texts.
        """
        if isinstance(event, LoadFailed) and self._worker.load_pending and event.problem.interrupted:
            self.versions.failed(event)
            return False  # interrupted because a newer version waits: no failure to report
        if isinstance(event, Loaded):
            self._on_loaded(event, on_disk)
        elif isinstance(event, Stepped):
            self._on_stepped(event)
        elif isinstance(event, Answer | Progress):
            self._asker.take(event)
        elif isinstance(event, PlanWanted):
            self._on_plan_wanted(event)
        elif isinstance(event, PlanDropped):
            self.solver.stop()
        else:
            self._state.take(event)
            if isinstance(event, Loading):
                self.versions.began(event)
            if isinstance(event, NewProcessNeeded):
                self.versions.new_process_needed(event)
            if isinstance(event, Placed):
                self.studio.placed(event, self._state.now.task)
            if isinstance(event, LoadFailed):
                self.versions.failed(event)
                if not event.at_run:
                    self.studio.failed_to_load()
        self._notify()
        return True

    def _on_loaded(self, event: Loaded, on_disk: bool) -> None:
        self._worker.reset_deaths()
        recording, one_each = self._recorder.recording, self._recorder.one_each
        if event.reload is None or event.reload.level != "same":
            # An episode must not mix steps of two versions, nor of two processes.
            self._recorder.stop()
            self.past_saver.forget()
        s = self._state
        restored = self.versions.version_loaded(event.task)
        stale = restored and not on_disk
        before = s.now.task
        past = past_after(before, event, restored)
        what_to_do = rescore_after_load(past, self.rescorer.rescoring.view)
        rescored = None
        if what_to_do == "rescore" and s.timeline is not None:
            versions = [task for task in (before, event.task) if task is not None]
            has_reward = any(task.reward_mode != "none" for task in versions)
            rescored = RescoredPast(s.timeline.history, s.timeline.at, has_reward)
        s.loaded(event, restored=restored, stale=stale)
        level = None if event.reload is None else event.reload.level
        placed = self.studio.loaded(event.task, level)
        load = self.versions.running_load()
        assert load is not None
        if rescored is not None:
            self.rescorer.rescore(load, rescored)
        elif what_to_do == "forget":
            self.rescorer.forget()
        # After the rescoring was begun: the later of two jobs of one priority comes first.
        self.checks.loaded(load, before is not None and before.env_id == event.task.env_id)
        self.profiler.loaded()
        self.seeds_solver.loaded()
        self.versions.follow(event.task, stale)
        self._send_settings()
        self.studio.send_placements(placed)
        if recording:
            put_back = past != "gone" or (event.reload is not None and bool(event.reload.carried))
            self._continue_recording(put_back, recording, one_each)
        to_enter, self._to_enter = self._to_enter, None
        if to_enter is not None:
            self._send_enter(*to_enter)

    def _continue_recording(self, put_back: bool, env_idx: tuple[int, ...], one_each: bool) -> None:
        """Continue recording these envs after a version came in.

        Args:
            put_back: it goes on with episodes that are under way.
        """
        if not put_back:
            self.start_recording(env_idx, next_episode=one_each, goes_on=True)
        elif not self._recorder.recording:
            # No reset, which would lose the present moment: recording continues with each env's next episode.
            task = self._state.now.task
            if task is not None:
                self._recorder.start(task, env_idx, one_each, goes_on=True)
                self._send(SetCapture(env_idx, from_reset=True))

    def _on_stepped(self, event: Stepped) -> None:
        self._state.stepped(event)
        self.versions.stepped(event)
        planned = self._state.now.settings.action_source == "solve"
        self.solver.stepped(event, planned)
        self._recorder.take(event)

    def _on_plan_wanted(self, event: PlanWanted) -> None:
        load = self.versions.running_load()
        settings = self._state.now.settings
        if load is not None:
            self.solver.plan(event, load, settings)

    def _on_save(self) -> None:
        self.solver.stop()
        self.rescorer.stop(StoppedBy.SAVE)
        self.checks.stop(StoppedBy.SAVE)
        self.studio.interrupted()

    def _on_lines(self, lines: list[PrintedLine], dropped: int) -> None:
        self._notify()
        for line in lines:
            self._print(line)

    def _log(self, text: str) -> None:
        """Add a text to the log of the page and of the terminal."""
        for line in text.splitlines():
            self._printed.feed("stderr", f"workbench: {line}\n".encode(errors="replace"))

    # --- sending -------------------------------------------------------------------------------------

    def _send_settings(self) -> None:
        self._send(self._state.settings())

    def _send(self, request: Request) -> None:
        self._worker.send(request)


def _shown(view: SessionView) -> object:
    """The version, env and moment that are shown."""
    return view.task_serial, view.selected_env, view.step_serial, view.timeline.shown
