"""Turns an exception of the author's code, wherever it was raised, into a `TaskError` at their line."""

from __future__ import annotations

import linecache
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from workbench.authoring.loading.load import LoadedTask
from workbench.authoring.problem import (
    Interrupted,
    Problem,
    TaskError,
    check_step_returns,
    is_ctrl_c,
    problem_from_exception,
    problem_from_return,
)
from workbench.core.broken_rule import BrokenRule, NeedsOneEnv, WrongReturn
from workbench.core.env.cpu_scene import ForgottenInit
from workbench.core.env.task_env import TaskEnv


class blamed:
    """A context that turns an exception of the author's code into a TaskError with their line."""

    def __init__(self, stage: str, loaded: LoadedTask, task: TaskEnv | None = None) -> None:
        self._stage, self._loaded, self._task = stage, loaded, task

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, Interrupted):
            # Call no more of the author's code to explain the error: it may be what does not end.
            files, cls = self._loaded.source_files, self._loaded.cls
            raise TaskError(problem_from_exception(error, self._stage, files, cls)) from error
        # Also SystemExit and an author's BaseException, which must not end the worker. Here and not in a caller: the
        # previous version and its texts may be restored by then.
        if error is None or isinstance(error, TaskError) or is_ctrl_c(error) or self._is_closed(error):
            return
        raise TaskError(self._problem(error)) from error

    def _is_closed(self, error: BaseException) -> bool:
        """Whether one of our generators is being closed, and not the author's code raised GeneratorExit."""
        if not isinstance(error, GeneratorExit):
            return False
        files = {str(file) for file in self._loaded.source_files}
        return not any(frame.filename in files for frame in traceback.extract_tb(error.__traceback__))

    def _problem(self, error: BaseException) -> Problem:
        loaded = self._loaded
        if isinstance(error, WrongReturn):
            return problem_from_return(loaded.cls, error.hook, error.problem, loaded.source_files)
        env = self._task.env if self._task is not None else _env_on_traceback(error, loaded.cls)
        if isinstance(error, (BrokenRule, ForgottenInit, NeedsOneEnv)):
            return _problem_at_its_place(error, self._stage, loaded)
        known = _raised_in(error, loaded.source_files)
        if env is not None and not known:
            # Raised in ManiSkill's own code, most often because of what evaluate() returned; the author's last line on
            # the traceback is then only their call of super().__init__().
            try:
                returned = env.evaluate()
            except Exception:
                # evaluate() fails too, as without a scene after an unknown keyword: that would hide the first error.
                return problem_from_exception(error, self._stage, loaded.source_files, loaded.cls)
            blamed = check_step_returns(loaded.cls, env.num_envs, returned, None, loaded.source_files)
            if blamed is not None:
                return blamed
        return problem_from_exception(error, self._stage, loaded.source_files, loaded.cls)


def returns_check(loaded: LoadedTask, num_envs: int) -> Callable[[Mapping[str, Any], Any], None]:
    """The check that `TaskEnv` calls with the returns of ``evaluate`` and the reward; raises TaskError for wrong shapes."""

    def check(evaluate: Mapping[str, Any], reward: Any) -> None:
        problem = check_step_returns(loaded.cls, num_envs, evaluate, reward, loaded.source_files)
        if problem is not None:
            raise TaskError(problem)

    return check


def _problem_at_its_place(
    error: BrokenRule | ForgottenInit | NeedsOneEnv, stage: str, loaded: LoadedTask
) -> Problem:
    """The problem at the line at fault, which may have ended earlier and be on no traceback."""
    problem = problem_from_exception(error, stage, loaded.source_files, loaded.cls)
    if error.place is None or Path(error.place[0]) not in loaded.source_files:
        return problem
    file, line, _ = error.place
    return replace(problem, file=file, line=line, code=linecache.getline(file, line).strip() or None)


def _raised_in(error: BaseException, files: Sequence[Path]) -> bool:
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and Path(frames[-1].filename) in files


def _env_on_traceback(error: BaseException, cls: type) -> Any:
    """The env whose constructor raised: ``BaseEnv.__init__`` resets, so hooks run before it returns."""
    trace = error.__traceback__
    while trace is not None:
        owner = trace.tb_frame.f_locals.get("self")
        if isinstance(owner, cls):
            return owner
        trace = trace.tb_next
    return None
