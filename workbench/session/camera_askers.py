"""Who is asked about cameras: the worker that plays, between its steps, or another in the background.

The worker that plays has the envs that are on the screen, at their present moment. The other is a process of its own
with a low priority, started when it is first wanted (some seconds, and the memory of a worker) and ended when nobody
wants it; its envs are reset as often as one likes, which is how a camera is judged over many seeds.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import TypeVar

from workbench.session.background import BackgroundProcess
from workbench.session.camera_messages import CameraAnswer, CameraQuestion, CameraQuestionFailed, Searching
from workbench.session.lane import Job, JobFailed, Stopped
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

_LOOK = 0.05
_PATIENCE = 3.0
"""Seconds in which a process that was told to stop must answer again, or is ended."""
MOST_ENVS = 16
"""In the background: more are made of these by resetting them again."""
Kind = TypeVar("Kind", bound=Event)


class LiveAsker:
    """Asks the worker that plays: any number of questions at a time, from any threads, each with its own answer."""

    def __init__(self, send: Callable[[Request], None]) -> None:
        self._send = send
        self._numbers = count(1)
        self._condition = threading.Condition()
        self._answers: dict[int, CameraAnswer | None] = {}
        """Of the questions under way, by number; None for those without one yet."""

    def ask(self, question: CameraQuestion, check: Callable[[], None], kind: type[Kind]) -> Kind:
        """
        Args:
            check: called often meanwhile; what it raises ends the question, whose answer is then dropped.

        Raises:
            JobFailed: it cannot be answered.
        """
        with self._condition:
            number = next(self._numbers)
            self._answers[number] = None
        try:
            self._send(replace(question, number=number))
            while True:
                check()
                with self._condition:
                    self._condition.wait_for(lambda: self._answers[number] is not None, _LOOK)
                    answer = self._answers[number]
                if isinstance(answer, CameraQuestionFailed):
                    raise JobFailed(answer.why)
                if isinstance(answer, kind):
                    return answer
        finally:
            with self._condition:
                del self._answers[number]

    def take(self, answer: CameraAnswer) -> None:
        """What the worker said."""
        with self._condition:
            if answer.number in self._answers:
                self._answers[answer.number] = answer
                self._condition.notify_all()


class BackgroundAsker:
    """Asks a process of its own; all methods on one thread."""

    def __init__(self) -> None:
        self._numbers = count(1)
        self._process = BackgroundProcess("that looks at the cameras", "to look with")
        self._loaded: Load | None = None
        """By the process that is there."""
        self.num_envs = 0

    def load(self, load: Load, job: Job) -> None:
        """Have that version there, with no more than `MOST_ENVS` envs."""
        load = _for_judging(load)
        if not self._process.there:
            self._loaded = None
            job.tell(0, 0, "starting a process to look with")
            self._process.start()
        if self._loaded == load:
            return
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
        """
        Raises:
            Stopped: the job is to stop.
            JobFailed: it cannot be answered.
        """
        return self._request(replace(question, number=next(self._numbers)), job, kind, on_search)

    def end(self) -> None:
        """End the process, if there is one."""
        self._process.end()

    def _request(
        self,
        request: Request,
        job: Job,
        kind: type[Kind],
        on_search: Callable[[Searching], None] = lambda at: None,
    ) -> Kind:
        self._process.send(request)
        while True:
            try:
                event = self._process.answer(job, kind, Searching, CameraQuestionFailed, Failed)
            except Stopped:
                # Have it give up what it does: a search ends at any request. It answers in order, so what comes
                # after the status belongs to nobody before.
                self._process.send(Play(False))
                self._process.settle(_PATIENCE, for_this=Status)
                raise
            if isinstance(event, Searching):
                on_search(event)
            elif isinstance(event, CameraQuestionFailed):
                raise JobFailed(event.why)
            elif isinstance(event, Failed):
                raise JobFailed(f"the task failed in the background: {event.problem.message}")
            else:
                return event


def _for_judging(load: Load) -> Load:
    options = load.options
    kwargs = dict(options.env_kwargs)
    if kwargs.get("obs_mode", "state") not in ("state", "state_dict", "none"):
        kwargs["obs_mode"] = "state"  # else every reset draws all cameras of all envs
    envs = min(options.num_envs, MOST_ENVS)
    return replace(
        load, options=replace(options, num_envs=envs, env_kwargs=kwargs), level="auto", snapshot=None
    )
