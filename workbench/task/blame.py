"""Turns an exception of the author's code into a `TaskError` at their line."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from mani_skill.envs.sapien_env import BaseEnv

from workbench.envs.broken_rule import WrongReturn
from workbench.envs.error_notes import AuthorCall
from workbench.envs.task_env import TaskEnv
from workbench.task.load import LoadedTask
from workbench.task.problem import (
    Interrupted,
    Problem,
    TaskError,
    check_step_returns,
    is_ctrl_c,
    problem_from_exception,
    problem_from_return,
)

_DTYPE_AT_START = torch.get_default_dtype()


class blamed:
    """Context manager that turns an exception of the author's code into a TaskError with their line."""

    def __init__(self, stage: str, loaded: LoadedTask, task: TaskEnv | None = None) -> None:
        self._stage, self._loaded, self._task = stage, loaded, task
        self._call = AuthorCall()

    def __enter__(self) -> None:
        self._call.__enter__()

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self._call.__exit__(kind, error, trace)
        if isinstance(error, Interrupted):
            # Call no more of the author's code to explain the error: it may hang again.
            files, cls = self._loaded.source_files, self._loaded.cls
            raise TaskError(problem_from_exception(error, self._stage, files, cls)) from error
        # Convert SystemExit and an author's BaseException too: they must not end the worker. Make the problem
        # here: later, a caller may have restored the previous version and its texts.
        if error is None or isinstance(error, TaskError) or is_ctrl_c(error) or self._is_closed(error):
            return
        raise TaskError(self._problem(error)) from error

    def _is_closed(self, error: BaseException) -> bool:
        """Whether `error` is a GeneratorExit that closes a generator of the workbench; False if the author's
        code raised it."""
        if not isinstance(error, GeneratorExit):
            return False
        files = {str(file) for file in self._loaded.source_files}
        return not any(frame.filename in files for frame in traceback.extract_tb(error.__traceback__))

    def _problem(self, error: BaseException) -> Problem:
        loaded = self._loaded
        if isinstance(error, WrongReturn):
            return problem_from_return(loaded.cls, error.hook, error.problem, loaded.source_files)
        problem = self._wrong_return(error) or problem_from_exception(
            error, self._stage, loaded.source_files, loaded.cls
        )
        dtype = torch.get_default_dtype()
        if problem.line is not None or dtype == _DTYPE_AT_START:
            return problem
        # After the default dtype has changed, ManiSkill's code fails, far from the line that changed it.
        was = f"torch's default dtype is {dtype}, and was {_DTYPE_AT_START} before the task was imported"
        return replace(problem, message=f"{problem.message} ({was})")

    def _wrong_return(self, error: BaseException) -> Problem | None:
        """The problem of ``evaluate``'s return value, if ManiSkill raised `error` on that value; else
        None."""
        loaded, env = self._loaded, _env_that_reads(error)
        if env is None:
            return None
        try:
            returned = env.evaluate()
        except Exception:
            return None  # report the original error
        return check_step_returns(loaded.cls, env.num_envs, returned, None, loaded.source_files)


def returns_check(loaded: LoadedTask, num_envs: int) -> Callable[[Mapping[str, Any], Any], None]:
    """The function that `TaskEnv` calls with the result of ``evaluate`` and with the reward. It raises
    TaskError for a wrong type or shape."""

    def check(evaluate: Mapping[str, Any], reward: Any) -> None:
        problem = check_step_returns(loaded.cls, num_envs, evaluate, reward, loaded.source_files)
        if problem is not None:
            raise TaskError(problem)

    return check


_READERS = tuple(getattr(BaseEnv, name).__code__ for name in ("step", "get_info", "compute_sparse_reward"))
"""ManiSkill's functions that use the result of ``evaluate`` without checking it."""


def _env_that_reads(error: BaseException) -> BaseEnv | None:
    """The env whose ManiSkill code failed on the result of ``evaluate``; None for any other error."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return frames[-1].f_locals.get("self") if frames and frames[-1].f_code in _READERS else None
