"""A fake worker without a process: it answers a session at once with a synthetic scene."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from tests.drive.scenes import camera, description, step_of, table_scene
from workbench.envs.camera_data import CameraInfo, Picture
from workbench.envs.step_result import StepResult
from workbench.live.messages import (
    EnterRecording,
    Event,
    Load,
    Loaded,
    Pictures,
    Play,
    Request,
    Reset,
    Restore,
    Settings,
    SingleStep,
    Status,
    WarmUp,
)
from workbench.live.process.heartbeat import Busy
from workbench.live.process.supervisor import Death, ProcessMemory, Supervisor, WorkerOptions
from workbench.live.process.worker_process import Output
from workbench.task.description import Restored, Stepped, TaskDescription

STEP_SECONDS = 0.02
"""Time between two steps while playing."""
Evaluate = Callable[[np.ndarray], dict[str, np.ndarray]]
"""Computes the entries of `evaluate()` from the elapsed steps of each env."""


def no_success(elapsed: np.ndarray) -> dict[str, np.ndarray]:
    return {"success": np.zeros(len(elapsed), bool)}


class ScriptedWorker:
    """Takes `Supervisor`'s arguments, after those that define its scene."""

    pid = None
    load_pending = False
    vitals = ProcessMemory()
    goes_back = True
    """Whether a restore succeeds; the restored state looks like the current one."""

    def __init__(
        self,
        task: TaskDescription,
        poses: np.ndarray,
        evaluate: Evaluate,
        options: WorkerOptions,
        warm_up: WarmUp,
        *,
        first_requests: Callable[[], list[Request]],
        on_event: Callable[[Event], None],
        on_death: Callable[[Death], None],
        on_busy: Callable[[Busy | None], None],
        own_files: Callable[[], list[str]],
        texts: Callable[[bool], Mapping[str, str]],
        output: Output,
    ) -> None:
        self._task, self._start, self._evaluate = task, poses, evaluate
        self._first_requests, self.tell = first_requests, on_event
        self._lived: list[StepResult] = []
        self._playing = False
        self._requests: queue.Queue[Request | None] = queue.Queue()
        self._thread = threading.Thread(target=self._run, name="scripted-worker", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def send(self, request: Request) -> None:
        self._requests.put(request)

    def interrupt(self) -> None:
        """Does nothing: it is never busy."""

    def reset_deaths(self) -> None:
        """Does nothing: it never dies."""

    def replace(self) -> None:
        for request in self._first_requests():
            self.send(request)

    def stop(self) -> None:
        self._requests.put(None)
        self._thread.join()

    def _run(self) -> None:
        self.replace()
        while True:
            try:
                request = self._requests.get(timeout=STEP_SECONDS if self._playing else None)
            except queue.Empty:
                self._step()
                continue
            if request is None:
                return
            self._answer(request)

    def _answer(self, request: Request) -> None:
        count = self._task.num_envs
        if isinstance(request, Load):
            first = self._at(self._start, np.zeros(count, np.int32))
            self.tell(Loaded(self._task, first, {"import": 1.0}))
            self._send(first, range(count), seeds=np.arange(count))
        elif isinstance(request, Play):
            self._playing = request.playing
            self.tell(Status(self._playing, 1 / STEP_SECONDS, 1.0, handled=request.number))
        elif isinstance(request, SingleStep):
            self._playing = False
            self._step()
        elif isinstance(request, Reset):
            envs = range(count) if request.env_idx is None else request.env_idx
            poses, elapsed = self._lived[-1].poses.copy(), self._lived[-1].elapsed_steps.copy()
            poses[list(envs)], elapsed[list(envs)] = self._start[list(envs)], 0
            self._send(self._at(poses, elapsed), envs, seeds=np.arange(count))
        elif isinstance(request, Restore):
            self._restore(request)
        elif isinstance(request, EnterRecording) and self.goes_back:
            last, restored = (
                self._lived[-1],
                Restored(request.env_idx, (), -1, None, {}, number=request.number),
            )
            self._send(last, request.env_idx, restored=restored)
        elif isinstance(request, Settings) and request.cameras:
            self._draw(request)

    def _step(self) -> None:
        # Every body moves by a centimetre.
        moved = self._lived[-1].poses + np.array([0.01, 0, 0, 0, 0, 0, 0], np.float32)
        action = np.zeros((self._task.num_envs, len(self._task.actions)), np.float32)
        self._send(replace(self._at(moved, self._lived[-1].elapsed_steps + 1), action=action), ())

    def _restore(self, request: Restore) -> None:
        poses, elapsed = self._lived[-1].poses.copy(), self._lived[-1].elapsed_steps.copy()
        before, envs = self._lived[request.origin], list(request.env_idx)
        poses[envs] = before.poses[list(request.source)]
        elapsed[envs] = before.elapsed_steps[list(request.source)]
        restored = Restored(request.env_idx, request.source, request.origin, request.undoes, {})
        self._send(self._at(poses, elapsed), request.env_idx, restored=restored)

    def _at(self, poses: np.ndarray, elapsed: np.ndarray) -> StepResult:
        return replace(step_of(poses, **self._evaluate(elapsed)), elapsed_steps=elapsed)

    def _send(self, step: StepResult, envs: Any, **more: Any) -> None:
        self._lived.append(step)
        begins = np.isin(np.arange(self._task.num_envs), list(envs))
        number = len(self._lived)
        self.tell(Stepped(step, begins, snapshot=b"a moment", part_keys=(), number=number, **more))

    def _draw(self, request: Settings) -> None:
        grey = np.full((6, 8, 3), 128, np.uint8)
        pose = np.array([1, 0, 0.5, 1, 0, 0, 0], np.float32)
        wanted = [Picture(one.name, one.kind, request.selected_env, pose, grey) for one in request.cameras]
        self.tell(Pictures(tuple(wanted), 1.0, len(self._lived)))


def scripted(
    num_envs: int, evaluate: Evaluate = no_success, info: CameraInfo | None = None
) -> Callable[..., Supervisor]:
    """A ``make_worker`` for `Session`: the table scene with `num_envs` envs and one camera."""
    geometry, poses = table_scene(num_envs)
    # There is no file to watch.
    task = replace(description(geometry, (info or camera(),)), file=None, source_files=(), source={})
    return partial(ScriptedWorker, task, poses, evaluate)  # type: ignore[return-value]
