"""Who is asked about cameras: the worker that plays, between its steps, or another in the background.

The worker that plays has the envs that are on the screen, at their present moment. The other is a process of its own
with a low priority, started when it is first wanted (some seconds, and the memory of a worker) and ended when nobody
wants it; its envs are reset as often as one likes, which is how a camera is judged over many seeds.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import TypeVar

from workbench.session.camera_messages import CameraAnswer, CameraQuestion, CameraQuestionFailed, Searching
from workbench.session.lane import Job, JobFailed
from workbench.session.messages import (
    Event,
    Failed,
    Load,
    Loaded,
    Play,
    Request,
    Reset,
    Status,
    Stepped,
)
from workbench.session.process import WorkerProcess, describe_exit, start_in_background

_LOOK = 0.05
_PATIENCE = 3.0
"""Seconds in which a process that was told to stop must answer again, or is ended."""
MOST_ENVS = 16
"""In the background: more are made of these by resetting them again."""
Kind = TypeVar("Kind", bound=Event)


class LiveAsker:
    """Asks the worker that plays."""

    def __init__(self, send: Callable[[Request], None], first: int = 1) -> None:
        """
        Args:
            first: number of its first question.
        """
        self._send = send
        self._numbers = count(first)
        self._condition = threading.Condition()
        self._answer: CameraAnswer | None = None
        self._awaited = 0

    def ask(self, question: CameraQuestion, job: Job, kind: type[Kind]) -> Kind:
        """
        Raises:
            Stopped: the job is to stop.
            JobFailed: it cannot be answered.
        """
        with self._condition:
            self._awaited, self._answer = next(self._numbers), None
            question = replace(question, number=self._awaited)
        self._send(question)
        while True:
            job.check()
            with self._condition:
                self._condition.wait_for(lambda: self._answer is not None, _LOOK)
                answer = self._answer
            if isinstance(answer, CameraQuestionFailed):
                raise JobFailed(answer.why)
            if isinstance(answer, kind):
                return answer

    def take(self, answer: CameraAnswer) -> None:
        """What the worker said."""
        with self._condition:
            if answer.number == self._awaited:
                self._answer = answer
                self._condition.notify_all()


class BackgroundAsker:
    """Asks a process of its own; all methods on one thread."""

    def __init__(self) -> None:
        self._numbers = count(1)
        self._process: WorkerProcess | None = None
        self._loaded: Load | None = None
        self.num_envs = 0

    @property
    def pid(self) -> int | None:
        """None while there is no process."""
        process = self._process
        return None if process is None else process.pid

    def load(self, load: Load, job: Job) -> None:
        """Have that version there, with no more than `MOST_ENVS` envs."""
        load = _for_judging(load)
        if self._process is not None and self._loaded == load:
            return
        if self._process is None:
            job.tell(0, 0, "starting a process to look with")
            try:
                self._process = start_in_background()
            except OSError as error:
                raise JobFailed(f"no process could be started to look with: {error}") from error
        job.tell(0, 0, "building envs to look at")
        self._loaded = None
        event = self._request(load, job, Loaded)
        self._loaded, self.num_envs = load, event.task.num_envs

    def reset(self, seed: int, job: Job) -> None:
        """All envs, with this seed and the next ones."""
        self._request(Reset(None, seed), job, Stepped)

    def ask(
        self,
        question: CameraQuestion,
        job: Job,
        kind: type[Kind],
        on_search: Callable[[Searching], None] = lambda at: None,
    ) -> Kind:
        """Raises as `LiveAsker.ask`."""
        return self._request(replace(question, number=next(self._numbers)), job, kind, on_search)

    def end(self) -> None:
        """End the process, if there is one."""
        process, self._process, self._loaded = self._process, None, None
        if process is not None:
            process.stop(grace=0.0)

    def _request(
        self,
        request: Request,
        job: Job,
        kind: type[Kind],
        on_search: Callable[[Searching], None] = lambda at: None,
    ) -> Kind:
        assert self._process is not None
        self._process.send(request)
        try:
            while not job.stopped:
                event = self._process.receive(timeout=_LOOK)
                if isinstance(event, Searching):
                    on_search(event)
                elif isinstance(event, kind):
                    return event
                elif isinstance(event, CameraQuestionFailed):
                    raise JobFailed(event.why)
                elif isinstance(event, Failed):
                    raise JobFailed(f"the task failed in the background: {event.problem.message}")
            self._settle()
        except EOFError:
            code = None if self._process is None else self._process.exit_code()
            self.end()
            if not job.stopped:
                raise JobFailed(f"the process that looks at the cameras {describe_exit(code)}") from None
        job.check()
        raise AssertionError("a job that is stopped raises")

    def _settle(self) -> None:
        """Have it give up what it does (a search ends at any request), or end it."""
        assert self._process is not None
        self._process.send(Play(False))
        deadline = time.monotonic() + _PATIENCE
        while time.monotonic() < deadline:
            # It answers in order: what comes after this belongs to nobody before.
            if isinstance(self._process.receive(timeout=_LOOK), Status):
                return
        self.end()


def _for_judging(load: Load) -> Load:
    options = load.options
    kwargs = dict(options.env_kwargs)
    if kwargs.get("obs_mode", "state") not in ("state", "state_dict", "none"):
        kwargs["obs_mode"] = "state"  # else every reset draws all cameras of all envs
    envs = min(options.num_envs, MOST_ENVS)
    return replace(
        load, options=replace(options, num_envs=envs, env_kwargs=kwargs), level="auto", snapshot=None
    )
