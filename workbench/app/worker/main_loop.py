"""The worker's loop: handles requests, steps the env, draws pictures."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.actions.choose import ActionChooser
from workbench.app.worker.questions import QUESTIONS
from workbench.cameras.questions import CameraQuestion, RunCameras
from workbench.cameras.worker import WorkerCameras
from workbench.checks.questions import CheckGroup, ProfileStep
from workbench.checks.worker import WorkerChecks
from workbench.envs.action_vector import width
from workbench.envs.inspect_env import inspect_env
from workbench.envs.maniskill_private import mark_camera_configs
from workbench.envs.step_result import StepResult
from workbench.envs.task_drawings import drawings
from workbench.envs.task_env import TaskEnv
from workbench.hands.questions import EpisodeStart, ReadStart, SampleReset
from workbench.hands.reach_worker import LedArms, set_arm
from workbench.hands.reset_worker import first_states
from workbench.hands.start_worker import read_start
from workbench.hands.worker import Hand, move_body, move_joints
from workbench.live.messages import (
    SCENE_KEPT,
    Answer,
    Cancel,
    CannotAnswer,
    DrawPast,
    EnterRecording,
    FollowPlan,
    Inspect,
    ListenForDebugger,
    Load,
    Loaded,
    Loading,
    MoveBody,
    MoveJoints,
    PlaceCamera,
    Play,
    Progress,
    PullBody,
    Quit,
    ReachPose,
    ReadPolicyAgain,
    ReloadReport,
    Reset,
    Restore,
    RulesBroken,
    SetCapture,
    SetSliderAction,
    Settings,
    SingleStep,
    SliderAction,
    Status,
    TaskFailed,
    WarmUp,
)
from workbench.live.process.heartbeat import Doing, HeartbeatWriter, Interrupts
from workbench.live.questions_without_task import DrawTask, ListTasks, MakeScene
from workbench.live.worker.connection import ServerConnection
from workbench.live.worker.go_back import enter_recording, entering_text, go_back, going_back_text
from workbench.live.worker.guarded_task import REFUSED, GuardedTask
from workbench.live.worker.make_scene import SceneEnv, draw_task, registered_ids
from workbench.live.worker.pacing import Pacer, Rate, Shares, throttled
from workbench.live.worker.process_state import ProcessState, read_process_state
from workbench.live.worker.reload import Running, load_version, why_new_process
from workbench.live.worker.step_events import StepEvents
from workbench.machine.folders import CurrentFolder
from workbench.machine.processes.debugger import (
    CannotDebug,
    listen_for_debugger,
    listening_text,
    wait_for_debugger,
)
from workbench.machine.processes.time_limit import end_after
from workbench.machine.processes.wire import Call, Question, pack
from workbench.record.questions import CaptureMoment
from workbench.rescore.replay_past import rescore_moments
from workbench.rescore.verdict import Rescore, RescoreMoments
from workbench.solve.questions import PlanActions
from workbench.solve.worker import FollowedPlan, WorkerPlans, envs_to_plan, succeeded
from workbench.source.parsed import RefusedEdit
from workbench.task.blame import blamed
from workbench.task.description import Pulled, Restored, TaskOptions
from workbench.task.modules import executed_modules
from workbench.task.open import OpenedTask, Opening, warm_up
from workbench.task.problem import TaskError, treat_ctrl_c_as_error
from workbench.task.reference import named_file

_STATUS_PERIOD_SECONDS = 0.25
_IDLE_SECONDS = 0.5
"""Longest sleep when nothing is due; a request ends the sleep at once."""


class Worker:
    """The loop and its state. Only this process steps the env.

    It runs in a separate process because SAPIEN holds the GIL while it steps and renders, and because the author's code may
    loop for ever or crash. A single loop does everything, so that nothing else touches the env during a step.
    In turn it handles the waiting requests, steps the env if a step is due, draws the watched cameras, and
    sleeps. It writes its activity into shared memory (`heartbeat`), and the author's code can be interrupted
    (`Interrupts`).
    """

    def __init__(self, connection: int, heartbeat: HeartbeatWriter) -> None:
        self._heartbeat = heartbeat
        self._interrupts = Interrupts()
        self._line = ServerConnection(connection, self._interrupts, QUESTIONS)
        self._steps = StepEvents()
        self._task = GuardedTask(self._line, self._interrupts, heartbeat, self._steps, self._pause)
        self._cameras = WorkerCameras(self._task, self._on_first_picture)
        self._checks = WorkerChecks(self._line.waits)
        self._plans = WorkerPlans(self._line.waits)
        self._followed = FollowedPlan(self._line.send)
        self._hand = Hand()
        self._arms = LedArms(self._line.send)
        self._one_planned_step = False
        self._loaded_by: Load | None = None
        self._last: StepResult | None = None
        self._playing = False
        self._plays_handled = 0
        self._start_folder = CurrentFolder()
        self._scene = SceneEnv()
        self._chooser = ActionChooser(self._start_folder)
        self._settings = Settings()
        self._pacer = Pacer(0.05)
        self._rate = Rate()
        self._shares = Shares()
        self._status_sent = 0.0
        self._rules_sent = 0.0
        self._rules_reported = RulesBroken(())
        self._rules_serial: tuple[object, int] = None, 0
        self._quit = False
        self._state_at_start: ProcessState = {}
        """Settings of the process before any version was loaded."""
        self._handlers: dict[type, Callable[[Any], None]] = {
            Load: self._load,
            Play: self._play,
            SingleStep: self._single_step,
            Reset: self._reset,
            Settings: self._apply_settings,
            SetSliderAction: self._set_sliders,
            ReadPolicyAgain: self._read_policy_again,
            FollowPlan: self._follow_plan,
            PlaceCamera: self._cameras.place,
            SetCapture: lambda request: self._steps.capture(request.env_idx, request.from_reset),
            Restore: lambda request: self._task.guarded(partial(self._go, request)),
            EnterRecording: lambda request: self._task.guarded(partial(self._go, request)),
            MoveBody: lambda request: self._task.guarded(partial(self._move, request)),
            MoveJoints: lambda request: self._task.guarded(partial(self._move, request)),
            PullBody: self._hand.take,
            ReachPose: self._reach,
            DrawPast: self._cameras.draw_past,
            ListenForDebugger: self._listen_for_debugger,
            Inspect: self._inspect,
            Cancel: lambda request: None,
            Quit: self._stop,
        }

    def run(self) -> None:
        """Run until the server sends Quit or closes the connection."""
        self._interrupts.install()
        drawings.on = True
        self._state_at_start = read_process_state()
        while not self._ends:
            self._heartbeat.begin("idle")
            self._line.listen(self._sleep())
            while not self._ends and (request := self._line.next()) is not None:
                if isinstance(request, Call):
                    self._call(request)
                    continue
                work = partial(self._handlers[type(request)], request)
                self._task.run(_DOING.get(type(request)), work, loads=isinstance(request, Load))
            if self._ends:
                return
            if self._playing and self._step_due(time.monotonic()):
                self._pacer.spend()
                self._task.run("stepping", partial(self._task.guarded, self._step_once))
            if self._arms.is_asked:
                self._task.run("stepping", partial(self._task.guarded, self._answer_reach))
            if self._cameras.placing_due:
                self._task.run("stepping", self._cameras.place_waiting)
            began = time.monotonic()
            self._cameras.make(may_block=not self._playing)
            self._shares.add("watched", time.monotonic() - began, time.monotonic())
            self._send_status(time.monotonic())
            if time.monotonic() - self._rules_sent > _STATUS_PERIOD_SECONDS:
                self._send_rules()

    @property
    def _ends(self) -> bool:
        return self._quit or self._task.spoiled or self._line.closed

    # --- questions ---------------------------------------------------------------------------------

    def _call(self, call: Call) -> None:
        """Answer a call. An answer is always sent: without one, the server's thread would wait for ever."""
        answers: list[Answer] = []
        doing = _DOING.get(type(call.request))
        problem = self._task.run(doing, lambda: answers.append(self._answer(call)))
        if problem is not None:
            answers = [Answer(call.number, why=problem.message, problem=problem)]
        self._line.send(answers[0])

    def _answer(self, call: Call) -> Answer:
        def report(done: int, total: int, part: object = None) -> None:
            self._line.send(Progress(call.number, done, total, b"" if part is None else pack(part)))

        try:
            return Answer(call.number, pack(self._value(call.request, report)))
        except CannotAnswer as error:
            return Answer(call.number, why=str(error))
        except TaskError as error:
            if self._task.drop_steps_if_interrupted(error):
                failed = self._task.restore_last_step()
                if failed is not None:
                    self._task.fail(failed)
            return Answer(call.number, why=str(error), problem=error.problem)

    def _value(self, question: Question[Any], report: Callable[..., None]) -> object:
        if isinstance(question, WarmUp):
            return warm_up(question.options, lambda: not self._line.waits())
        if isinstance(question, Load):
            loaded: list[Loaded] = []
            self._load_version(question, loaded.append)
            return loaded[0]
        if isinstance(question, MakeScene):
            return self._scene.scene(question, report)
        if isinstance(question, ListTasks):
            return registered_ids()
        if isinstance(question, DrawTask):
            return draw_task(question.env_id)
        if isinstance(question, Rescore):
            # Imported late: rerun and the readers take a third of a second.
            from workbench.rescore import replay_recordings as rescore_run

            return rescore_run.answer(question, report)
        opened = self._task.opened
        if opened is None:
            raise CannotAnswer("no task is loaded")
        if isinstance(question, CameraQuestion):
            return self._cameras.answer(opened, question, report)
        if isinstance(question, PlaceCamera):
            return self._cameras.place_now(opened, question)
        if isinstance(question, Reset):
            return self._reset_envs(opened, question.env_idx, self._seeds(question))
        if isinstance(question, SampleReset):
            poses = self._reset_envs(opened, None, question.seed).poses
            with blamed("step", opened.loaded, opened.env):
                return first_states(opened.env, poses)
        if isinstance(question, ReadStart):
            return self._read_start(opened, question)
        if isinstance(question, RescoreMoments):
            return rescore_moments(opened, question)
        if isinstance(question, CaptureMoment):
            return self._cameras.capture(opened, question)
        if isinstance(question, CheckGroup | ProfileStep):
            options = TaskOptions() if self._loaded_by is None else self._loaded_by.options
            return self._checks.answer(opened, options, question, report)
        assert isinstance(question, PlanActions)
        env_kwargs = {} if self._loaded_by is None else self._loaded_by.options.env_kwargs
        return self._plans.answer(opened, env_kwargs, question, report)

    # --- requests ----------------------------------------------------------------------------------

    def _sleep(self) -> float:
        waits = [_IDLE_SECONDS]
        if self._playing and not self._followed.awaited:
            waits.append(self._pacer.wait())
        picture = self._cameras.wait(time.monotonic())
        if picture is not None:
            waits.append(picture)
        return min(waits)

    def _load(self, request: Load) -> None:
        running, when_loaded = self._running, self._task.when_loaded
        if running is not None and when_loaded is not None:
            needed = why_new_process(request, running, self._task.failed, self._state_at_start, when_loaded)
            if needed is not None:
                self._line.send(needed)
                self._quit = True
                return
        self._line.send(Loading("loading", request.number))
        executed = executed_modules()
        try:
            self._load_version(request, self._line.send)
        except TaskError as error:
            self._task.drop_steps_if_interrupted(error)
            kept = self._task.opened is not None
            spoiled = REFUSED if executed_modules() > executed else ""
            refused = TaskFailed(error.problem, kept, error.classes, request.options, spoiled=spoiled)
            self._task.refuse(refused)

    @property
    def _running(self) -> Running | None:
        opened = self._task.opened
        if opened is None or self._loaded_by is None or self._last is None:
            return None
        return Running(self._loaded_by, opened, self._last)

    def _load_version(self, request: Load, send: Callable[[Loaded], None]) -> None:
        self._cameras.settle()
        with self._start_folder.again():
            self._task.requested_file = named_file(request.task)
        running = self._running
        drawings.begin_version()
        # A load starts in the initial working directory; if it fails, the working directory of the previous
        # version is restored.
        with self._start_folder.again(stay=True):
            opened, report = load_version(
                request,
                running,
                Opening(
                    on_activity=lambda activity: self._line.send(Loading(activity, request.number)),
                    on_finding=lambda finding: None,  # see `_send_rules`
                    begins_anew=True,
                ),
            )
        self._task.when_loaded = read_process_state()
        # After an interrupt here, the page would show a task that the worker does not run.
        with self._interrupts.shielded():
            self._replace_task(opened, report, request, send)
            self._send_rules()

    def _replace_task(
        self, opened: OpenedTask, report: ReloadReport | None, request: Load, send: Callable[[Loaded], None]
    ) -> None:
        self._checks.close()
        self._plans.loaded(opened, None if report is None else report.level)
        self._followed.forget()
        self._arms.forget()
        before, self._task.opened = self._task.opened, opened
        opened.env.watched_forces = self._settings.watched_forces
        self._task.failed = False
        self._loaded_by, self._last = request, opened.first
        if report is None or report.level not in ("same", "patched"):
            self._cameras.forget_placed()
        if report is not None and report.level in SCENE_KEPT:
            self._cameras.update_watched()
            self._cameras.scene_changed()
            # The server already has the meshes: 9 MB for a Panda would add 0.2 s to a reload.
            unchanged = replace(opened.description.geometry, visuals=(), collisions=())
            description = replace(opened.description, geometry=unchanged)
            send(Loaded(description, opened.first, opened.milliseconds, report, request.options))
            return
        drawings.scene_replaced()
        self._pacer = Pacer(opened.env.control_dt, self._pacer.speed)
        if report is None or not report.carried:
            self._chooser.seed(request.options.seed)
        self._rate.clear()
        self._chooser.new_scene()
        self._cameras.update_watched()
        self._steps.new_scene()
        send(Loaded(opened.description, opened.first, opened.milliseconds, report, request.options))
        # The history begins with this reset.
        resumed = report is not None and report.level == "restarted" and bool(report.carried)
        mask = np.ones(opened.env.num_envs, bool)
        self._send_step(opened.first, mask, opened.env.episode_seeds, resumed=resumed)
        if before is not None:
            before.env.close()

    def _listen_for_debugger(self, request: ListenForDebugger) -> None:
        try:
            listen_for_debugger(request.port, self._heartbeat.hold)
            self._state_at_start = read_process_state()  # with the variables that the debugger sets
        except CannotDebug as error:
            print(f"workbench: no debugger can attach: {error}", file=sys.stderr)
            return
        print(f"workbench: {listening_text(request.port, request.wait)}", file=sys.stderr)
        if request.wait:
            self._heartbeat.begin("waiting for a debugger")
            wait_for_debugger(self._heartbeat.hold)

    def _play(self, request: Play) -> None:
        self._playing = request.playing and self._task.opened is not None
        self._plays_handled = max(self._plays_handled, request.number)
        self._one_planned_step = False
        self._followed.forget()
        self._pacer.start(time.monotonic())
        self._rate.clear()
        self._shares.clear(time.monotonic())
        self._send_status(None)

    def _reset(self, request: Reset) -> None:
        if self._task.opened is not None:
            seeds = self._seeds(request)
            self._task.guarded(lambda opened: self._reset_envs(opened, request.env_idx, seeds))

    def _seeds(self, request: Reset) -> int | list[int] | None:
        # Random actions restart with the seed: otherwise, a reset with this seed would not repeat the
        # episode.
        if request.seed is not None:
            self._chooser.seed(request.seed)
        count = 0 if request.env_idx is None else len(request.env_idx)
        return self._chooser.fresh_seeds(count) if request.seed is None and count else request.seed

    def _apply_settings(self, new: Settings) -> None:
        old, self._settings = self._settings, new
        if new.speed != old.speed:
            self._pacer.speed = new.speed
            self._pacer.start(time.monotonic())
        self._cameras.watch(new.selected_env, new.cameras, new.pictures)
        if self._task.opened is not None:
            self._task.opened.env.watched_forces = new.watched_forces
        if (new.action_source, new.solve_all, new.selected_env) != (
            old.action_source,
            old.solve_all,
            old.selected_env,
        ):
            self._followed.forget()
            # A requested step that waits for its plan now waits for a plan with the new settings.
            self._one_planned_step = self._one_planned_step and self._is_planned
            self._take_planned_step()
        if (new.action_source, new.policy, new.policy_folder) != (
            old.action_source,
            old.policy,
            old.policy_folder,
        ):
            self._task.run("importing the policy", self._use_action_source)
            self._task.guarded(self._send_slider_action)

    def _set_sliders(self, request: SetSliderAction) -> None:
        def set_sliders(opened: OpenedTask) -> None:
            task = opened.env
            # The page may have sent this before it knew of a new version, which may have fewer envs or
            # another robot.
            if max(request.env_idx, default=0) < task.num_envs and max(request.dimensions, default=0) < width(
                task.parts
            ):
                self._chooser.set_sliders(task, request.env_idx, request.dimensions, request.values)
                self._send_slider_action(opened)

        self._task.guarded(set_sliders)

    def _send_slider_action(self, opened: OpenedTask) -> None:
        if self._chooser.by_sliders:
            self._line.send(SliderAction(self._chooser.slider_action(opened.env)))

    def _use_action_source(self) -> bool:
        """Set the source of actions as in the settings. Returns whether it can be used."""
        s = self._settings
        try:
            folder = None if s.policy_folder is None else Path(s.policy_folder)
            self._chooser.use(s.action_source, s.policy, folder)
        except TaskError as error:
            self._task.drop_steps_if_interrupted(error)
            # Before a task is loaded, the page would take this failure for a failed load. In that case the
            # first step reports the failure.
            if self._task.opened is not None:
                self._task.fail(error.problem)
            return False
        return True

    def _read_policy_again(self, request: ReadPolicyAgain) -> None:
        if self._use_action_source() and request.play and not self._playing:
            self._play(Play(True))

    def _inspect(self, request: Inspect) -> None:
        # The page may have sent this before it knew of a version with fewer envs.
        if self._task.opened is not None and request.env < self._task.opened.env.num_envs:
            self._line.send(inspect_env(self._task.opened.env, request.env, request.sections, request.body))

    def _stop(self, request: Quit) -> None:
        self._quit = True

    # --- stepping ----------------------------------------------------------------------------------

    def _single_step(self, request: SingleStep) -> None:
        if self._playing:
            self._pause()
        self._one_planned_step = self._is_planned and not self._plan_ready()
        if not self._one_planned_step:
            self._task.guarded(self._step_once)

    def _follow_plan(self, request: FollowPlan) -> None:
        self._followed.take(request)
        self._take_planned_step()

    def _take_planned_step(self) -> None:
        """Make the requested step if its plan has arrived."""
        if self._one_planned_step and self._plan_ready():
            self._one_planned_step = False
            self._task.run("stepping", partial(self._task.guarded, self._step_once))

    @property
    def _is_planned(self) -> bool:
        return self._settings.action_source == "solve" and self._task.opened is not None

    def _plan_ready(self) -> bool:
        """Whether there is an action to take now; if there is none, request a plan."""
        opened, last = self._task.opened, self._last
        if opened is None or last is None:
            return False
        envs = envs_to_plan(self._settings, opened.env, last)
        return self._followed.ready(opened, self._steps.number, envs)

    def _step_due(self, now: float) -> bool:
        # Ask for the next plan even if no step is due yet: it is then computed while the present one is
        # played.
        ready = not self._is_planned or self._plan_ready()
        return self._pacer.due(now) and ready

    def _step_once(self, opened: OpenedTask) -> None:
        if opened.env.observes_pictures:
            self._cameras.settle()  # the observation is about to draw the same scene
        if self._is_planned:
            action = self._followed.next_action(opened.env, self._steps.number)
        else:
            action = self._chooser.next_action(opened.env)
        before = self._last
        with blamed("step", opened.loaded, opened.env), self._hand.pulling(opened.env.env):
            if self._chooser.by_sliders:
                action = self._arms.lead(opened.env, action)
            step = opened.env.step(action)
        self._chooser.acted(action)
        self._rate.tick(time.monotonic())
        self._send_step(step, np.zeros(opened.env.num_envs, bool), pulled=self._hand.pulled)
        ended = np.flatnonzero(step.terminated | step.truncated)
        if self._is_planned:
            done = succeeded(step)
            # Solved envs are not reset, so that they can be watched and saved.
            ended = ended[~done[ended]]
            if before is not None and self._all_solved(done, succeeded(before)):
                self._pause()
        if len(ended) == 0:
            return
        if self._settings.episode_end == "reset":
            self._reset_envs(opened, tuple(int(i) for i in ended), self._chooser.fresh_seeds(len(ended)))
        elif self._settings.episode_end == "pause":
            self._pause()

    def _all_solved(self, done: np.ndarray, before: np.ndarray) -> bool:
        """Whether all planned envs have succeeded, the last of them in this step.

        Args:
            done, before: (N,) whether each env has succeeded after this step, and after the step before.
        """
        planned = slice(None) if self._settings.solve_all else self._settings.selected_env
        return bool(done[planned].all() and not before[planned].all())

    def _reset_envs(
        self, opened: OpenedTask, env_idx: tuple[int, ...] | None, seed: int | list[int] | None
    ) -> StepResult:
        self._cameras.finish_picture()  # a reset may rebuild the scene
        with blamed("reset", opened.loaded, opened.env):
            step = self._reset_with_seeds(opened.env, env_idx, seed)
        self._cameras.put_back()
        self._chooser.begin(env_idx)
        self._arms.forget(env_idx)
        self._send_step(step, _mask(opened, env_idx), seeds=opened.env.episode_seeds)
        return step

    def _read_start(self, opened: OpenedTask, question: ReadStart) -> EpisodeStart:
        try:
            return read_start(
                question,
                opened.env.num_envs,
                lambda: self._reset_envs(opened, None, question.seed),
            )
        except RefusedEdit as refused:
            raise CannotAnswer(refused.reason) from refused

    def _reset_with_seeds(
        self, task: TaskEnv, env_idx: tuple[int, ...] | None, seed: int | list[int] | None
    ) -> StepResult:
        """Reset these envs. Envs that are recorded are reset one by one, so that their initial states depend
        only on their own seeds.

        Envs that are reset together share torch's generator: the random numbers of each env depend on which
        envs are reset with it, and on the seed of the first.
        """
        every = range(task.num_envs) if env_idx is None else env_idx
        alone = [env for env in every if env in self._steps.recorded] if len(every) > 1 else []
        if seed is None or not alone:
            return task.reset(seed, env_idx)
        seeds = dict(
            zip(every, range(seed, seed + len(every)) if isinstance(seed, int) else seed, strict=True)
        )
        step = None
        if env_idx is None:
            step = task.reset(seed)  # only a reset of all envs can rebuild the scene
        elif rest := [env for env in every if env not in alone]:
            step = task.reset([seeds[env] for env in rest], rest)
        for env in alone:
            step = task.reset([seeds[env]], [env])
        assert step is not None
        return step

    def _go(self, request: Restore | EnterRecording, opened: OpenedTask) -> None:
        self._cameras.settle()  # the envs get new physics scenes with the same entities, and may step
        try:
            if isinstance(request, Restore):
                step, restored = go_back(opened, request, self._throttled_status(going_back_text))
            else:
                on_step = self._throttled_status(partial(entering_text, request))
                step, restored = enter_recording(opened, request, on_step)
        finally:
            self._cameras.put_back()
        self._chooser.begin(restored.env_idx, _led_there(request))
        self._arms.forget(restored.env_idx)
        self._send_step(step, _mask(opened, restored.env_idx), opened.env.episode_seeds, restored)
        self._send_status(None)

    def _move(self, request: MoveBody | MoveJoints, opened: OpenedTask) -> None:
        self._cameras.settle()  # the envs get new physics scenes
        with blamed("restore", opened.loaded, opened.env):
            if isinstance(request, MoveBody):
                moved = move_body(opened.env, request)
            else:
                moved = move_joints(opened.env, request)
        if moved is not None:
            step, restored = moved
            if isinstance(request, MoveJoints):
                self._chooser.begin(restored.env_idx)  # the last targets would drive the joints back
            self._arms.forget(restored.env_idx)
            self._send_step(step, _mask(opened, restored.env_idx), opened.env.episode_seeds, restored)

    def _reach(self, request: ReachPose) -> None:
        if request.arm and request.how == "set":
            self._task.guarded(partial(self._set_arm, request))
        else:
            self._arms.take(request)

    def _answer_reach(self, opened: OpenedTask) -> None:
        with blamed("step", opened.loaded, opened.env):
            self._arms.answer(opened.env)

    def _set_arm(self, request: ReachPose, opened: OpenedTask) -> None:
        self._cameras.settle()  # the env gets a new physics scene
        with blamed("restore", opened.loaded, opened.env):
            found = set_arm(opened.env, request)
        if found is not None:
            step, restored, reached = found
            self._chooser.begin(restored.env_idx)
            self._arms.forget(restored.env_idx)
            self._line.send(reached)
            self._send_step(step, _mask(opened, restored.env_idx), opened.env.episode_seeds, restored)

    def _throttled_status(self, text: Callable[..., str]) -> Callable[..., None]:
        """A progress callback that sends ``text(*arguments)`` as the status, at most once in
        `_STATUS_PERIOD_SECONDS`."""
        return throttled(lambda *done: self._send_status(None, text(*done)), _STATUS_PERIOD_SECONDS)

    def _send_step(
        self,
        step: StepResult,
        reset_mask: np.ndarray,
        seeds: np.ndarray | None = None,
        restored: Restored | None = None,
        resumed: bool = False,
        pulled: Pulled | None = None,
    ) -> None:
        assert self._task.opened is not None
        self._last = step
        if self._steps.pictures_due(step, reset_mask):
            self._cameras.settle()  # the same scene is about to be drawn
        acted_by = "" if restored else self._chooser.name + (", pulled by hand" if pulled else "")
        event = self._steps.event(
            self._task.opened,
            step,
            reset_mask,
            seeds,
            restored,
            acted_by,
            resumed,
            self._cameras.placed,
            self._cameras.failed,
            pulled,
        )
        self._shares.add("recorded", self._steps.recording_took, time.monotonic())
        self._cameras.scene_changed()
        self._line.send(event)
        self._send_slider_action(self._task.opened)

    # --- status and findings -----------------------------------------------------------------------

    def _pause(self) -> None:
        self._playing = False
        self._followed.forget()
        self._send_status(None)

    def _on_first_picture(self, there: bool) -> None:
        if not there:
            self._send_status(None, "compiling the renderer's shaders, once")
            return
        self._pacer.start(time.monotonic())
        self._send_status(None)

    def _send_status(self, now: float | None, activity: str = "") -> None:
        """Send the status every `_STATUS_PERIOD_SECONDS` while playing, or at once if `now` is None."""
        moment = time.monotonic()
        if now is not None and (not self._playing or now - self._status_sent < _STATUS_PERIOD_SECONDS):
            return
        self._status_sent = moment
        steps = self._rate.per_second(moment) if self._playing else 0.0
        recorded, watched = (
            self._shares.of(what, moment) if self._playing else 0.0 for what in ("recorded", "watched")
        )
        speed = steps * self._pacer.control_dt
        self._line.send(Status(self._playing, steps, speed, activity, recorded, watched, self._plays_handled))

    def _send_rules(self) -> None:
        """Send the rules that the task breaks, if they changed."""
        self._rules_sent = time.monotonic()
        opened = self._task.opened
        rules = None if opened is None else opened.env.broken_rules
        serial = rules, 0 if rules is None else rules.serial
        if serial == self._rules_serial:
            return
        self._rules_serial = serial
        rows, more = ((), 0) if rules is None else (rules.rows, rules.more)
        known = {row.key for row in self._rules_reported.rows}
        event = RulesBroken(rows, more, tuple(row for row in rows if row.key not in known))
        if event.rows or self._rules_reported.rows:
            self._line.send(event)
        self._rules_reported = event


def _led_there(request: Restore | EnterRecording) -> Mapping[int, NDArray[np.float32]]:
    """The last action (A,) before the restored state, by env, without envs whose last action is unknown."""
    if isinstance(request, Restore):
        return {env: way.actions[-1] for env, way in request.ways.items() if len(way.actions)}
    run = request.run
    return {env: run.action[-1].copy() for env in request.env_idx} if run.length else {}


def _mask(opened: OpenedTask, env_idx: tuple[int, ...] | None) -> np.ndarray:
    """(N,) mask of these envs; all if `env_idx` is None."""
    mask = np.zeros(opened.env.num_envs, bool)
    mask[slice(None) if env_idx is None else list(env_idx)] = True
    return mask


_DOING: dict[type, Doing] = {
    Load: "loading",
    RunCameras: "loading",
    Rescore: "loading",
    SingleStep: "stepping",
    Reset: "resetting",
    Restore: "resetting",
    EnterRecording: "resetting",
    MoveBody: "resetting",
    ReachPose: "resetting",
    MoveJoints: "resetting",
    ReadPolicyAgain: "importing the policy",
    WarmUp: "warming up",
    ListTasks: "starting",
    DrawTask: "drawing",
    ListenForDebugger: "starting",
}
"""Requests and questions that may run the author's code or take long, each with its activity."""


def work(connection: int, heartbeat: HeartbeatWriter) -> None:
    """Entry point of the worker process; `connection` is the file descriptor of its end of the socket pair."""
    # Tensors have only a few thousand numbers: several threads mostly wait for each other (measured: 16
    # PickCube envs ran 2.8 times faster with one thread than with two).
    torch.set_num_threads(1)
    mark_camera_configs()
    treat_ctrl_c_as_error()
    end_after()
    Worker(connection, heartbeat).run()
