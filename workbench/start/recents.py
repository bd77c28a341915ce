"""Stores the last opened tasks and their options in the user's state folder."""

from __future__ import annotations

import datetime
import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from workbench.live.commands import MAX_NUM_ENVS
from workbench.machine.folders import locked, read_private, state_folder, write_private
from workbench.task.description import TaskOptions
from workbench.task.reference import lasting, named_file, split_reference

log = logging.getLogger(__name__)

RECENT_FILE = "recent_tasks.json"
MAX_TASKS = 20
MAX_REFERENCE_CHARACTERS = 4096
MAX_KWARGS_BYTES = 20_000
"""Maximum size of the keyword arguments of one task."""


class RecentTask(msgspec.Struct, frozen=True):
    """A task that was opened, with the options to use again."""

    reference: str
    """An absolute path with or without a class, or a registered id."""
    num_envs: int = 16
    env_kwargs: dict[str, Any] = {}
    when: str = ""
    """ISO time of the last opening."""

    @property
    def file(self) -> Path | None:
        """The task's file; None for a registered id."""
        return named_file(self.reference)


class _Document(msgspec.Struct):
    tasks: list[msgspec.Raw]
    format: int = 1


class RecentTasks:
    """The tasks that this user opened last, newest first. Thread-safe; other processes may write too.

    A file that is broken or writable by other users is ignored, and invalid entries are dropped. If the file
    cannot be written, entries last until the program ends.

    Args:
        folder: returns the folder; raises OSError if there is none.
    """

    def __init__(self, folder: Callable[[], Path] = state_folder) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._this_run: list[RecentTask] = []
        self._warned: set[str] = set()

    def list(self) -> list[RecentTask]:
        """The tasks, newest first, each reference once."""
        with self._lock:
            return _newest([*self._this_run, *self._read()])

    def add(self, reference: str, options: TaskOptions) -> None:
        """Store that a task was opened with these options."""
        now = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
        task = _checked(RecentTask(lasting(reference), options.num_envs, dict(options.env_kwargs), now))
        if task is None:
            return
        with self._lock:
            self._this_run = _newest([task, *self._this_run])
            try:
                folder = self._folder()
                with locked(RECENT_FILE, folder):
                    kept = _newest([task, *self._read()])
                    encoded = [msgspec.Raw(msgspec.json.encode(one)) for one in kept]
                    text = msgspec.json.format(msgspec.json.encode(_Document(encoded)), indent=1)
                    write_private(RECENT_FILE, text, folder)
            except OSError as error:
                self._warn_once(f"The list of recent tasks cannot be saved for the next run: {error}")

    def _read(self) -> list[RecentTask]:
        try:
            content = read_private(RECENT_FILE, self._folder())
        except OSError as error:
            self._warn_once(f"The list of recent tasks cannot be read: {error}")
            return []
        if content is None:
            return []
        try:
            rows = msgspec.json.decode(content, type=_Document).tasks
        except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
            self._warn_once(f"The list of recent tasks is broken and will be recreated: {error}")
            return []
        return [task for row in rows[: 10 * MAX_TASKS] if (task := _decoded(row)) is not None]

    def _warn_once(self, what: str) -> None:
        if what not in self._warned:
            self._warned.add(what)
            log.warning("%s", what)


def _newest(tasks: list[RecentTask]) -> list[RecentTask]:
    first: dict[str, RecentTask] = {}
    for task in tasks:
        first.setdefault(task.reference, task)
    return list(first.values())[:MAX_TASKS]


def _decoded(row: msgspec.Raw) -> RecentTask | None:
    try:
        return _checked(msgspec.json.decode(row, type=RecentTask))
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError):
        return None


def _checked(task: RecentTask) -> RecentTask | None:
    """The task if its values are valid, else None: the file is untrusted."""
    text = task.reference
    if (
        not 0 < len(text) <= MAX_REFERENCE_CHARACTERS
        or not text.isprintable()
        or not 1 <= task.num_envs <= MAX_NUM_ENVS
    ):
        return None
    try:
        # A module name is looked up in the current folder too, so it may name another file in the next run.
        if split_reference(text) is not None or (task.file is not None and not text.startswith("/")):
            return None
        if len(msgspec.json.encode(task.env_kwargs)) > MAX_KWARGS_BYTES:
            return None
    except (OSError, ValueError, TypeError, RuntimeError, RecursionError, msgspec.MsgspecError):
        return None
    return task if all(name.isidentifier() for name in task.env_kwargs) else None
