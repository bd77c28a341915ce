"""Follows the file of the policy that acts, as the task's is followed: a save has it imported anew."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from workbench.authoring.watch import SourceWatcher


class PolicyFile:
    """Used from any thread."""

    def __init__(self, on_save: Callable[[], None]) -> None:
        """`on_save` is called on a thread of this object's own."""
        self._on_save = on_save
        self._watcher: SourceWatcher | None = None
        self._files: list[Path] = []

    def follow(self, reference: str | None, beside: Path | None) -> None:
        """The file of a ``file.py:function`` from now on, wherever it may lie; of anything else, none.

        Args:
            beside: a folder in which a relative file is looked for when it is not in the current one.
        """
        name = (reference or "").rpartition(":")[0]
        files: list[Path] = []
        if name.endswith(".py"):
            path = Path(name).expanduser()
            files = [path, *([] if beside is None else [beside / path])]
        if files == self._files:
            return
        self._files = files
        if self._watcher is None:
            self._watcher = SourceWatcher(lambda changed: self._on_save())
        self._watcher.follow(files)

    def close(self) -> None:
        if self._watcher is not None:
            self._watcher.stop()
