"""What the next worker is asked to load when one has gone: the last good version at the last moment.

Bringing back a version can itself fail, in ways that end the worker again: the moment cannot be restored, the
file kills whoever imports it, the memory does not suffice. So there is a way down: the file as it is on disk
(if that is what somebody waits for), the last good version at its last moment, the same from its start, and at
last nothing: a worker that is up and waits for the file to change. None is tried twice, so that no
file can make workers die one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from workbench.authoring.modules import read_source
from workbench.session.messages import TaskDescription

Rung = Literal["file", "moment", "version", "nothing"]


@dataclass(frozen=True)
class Wanted:
    """What a load is to name besides the task."""

    source: dict[str, str] | None
    """Text to be used in place of the files; None for what is on disk."""
    snapshot: bytes | None
    """The moment to be restored."""


def is_on_disk(source: Mapping[str, str]) -> bool:
    """Whether the files still have these texts."""
    for path, text in source.items():
        try:
            if read_source(path) != text:
                return False
        except (OSError, SyntaxError):
            return False
    return True


class Recovery:
    """One session's last good version and moment. Used under the session's lock."""

    def __init__(self, newest: Callable[[], bytes | None]) -> None:
        """
        Args:
            newest: the newest state of the batch, a pickled `core.snapshot.Snapshot`, or None. Asked for only
                when it is wanted, since putting one together takes longer than a step.
        """
        self._good: TaskDescription | None = None
        self._newest = newest
        self._rung: Rung = "file"
        self._loading = True
        self._has_env = False

    @property
    def restoring(self) -> bool:
        """Whether the load under way brings back what there was."""
        return self._loading and self._rung in ("moment", "version")

    @property
    def loading(self) -> bool:
        """Whether a load is under way."""
        return self._loading

    def wanted(self) -> Wanted | None:
        """What a fresh worker is to load; None to load nothing."""
        if self._rung == "nothing":
            return None
        self._loading = True
        good = self._good.source if self._good is not None and self._rung != "file" else None
        return Wanted(good or None, self._newest() if self._rung in ("file", "moment") else None)

    def file_asked(self) -> Wanted:
        """The file is to be loaded as it is on disk, by the worker that there is."""
        self._rung, self._loading = "file", True
        return Wanted(None, None if self._has_env else self._newest())

    def loaded(self, task: TaskDescription) -> None:
        """`task` runs, and is the last good version from now on."""
        self._good, self._has_env = task, True
        self._rung, self._loading = "file", False

    def failed(self, kept: bool) -> bool:
        """A load failed in a worker that goes on. True if it has nothing now, and `wanted` says what to try."""
        was_loading, self._loading = self._loading, False
        if kept or not was_loading:
            return False
        self._step_down()
        return self._rung != "nothing"

    def died(self, file_waits: bool) -> None:
        """The worker is gone; `file_waits`: it was ended because a newer file waited behind it."""
        if file_waits:
            self._rung = "file"
        elif self._loading:
            self._step_down()
        elif self._rung != "nothing":
            self._rung = "moment" if self._good is not None else "nothing"
        self._loading = self._has_env = False

    def restart_asked(self) -> None:
        """Somebody had the worker replaced: what there was comes back, or the file if nothing ever ran."""
        self._rung = "file" if self._good is None else "moment"
        self._loading = self._has_env = False

    def _step_down(self) -> None:
        if self._good is None:
            self._rung = "nothing"
        elif self._rung == "file":
            self._rung = "moment" if self._newest() is not None else "version"
        elif self._rung == "moment" and self._newest() is not None:
            self._rung = "version"
        else:
            self._rung = "nothing"
