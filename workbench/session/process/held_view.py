"""What a page reads of a job in the background: one immutable view, changed by several threads."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from workbench.session.process.job_lane import Job


class Numbered(Protocol):
    """A frozen dataclass whose `serial` grows with every change."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def serial(self) -> int: ...


View = TypeVar("View", bound=Numbered)


class HeldView(Generic[View]):
    """Holds the view of a job, so that nothing of a job that was stopped is ever shown."""

    def __init__(self, first: View, on_change: Callable[[], None]) -> None:
        """
        Args:
            on_change: called when `now` has changed.
        """
        self.now = first
        self._on_change = on_change
        self.lock = threading.Lock()
        """Taken to stop a job or to start one, with what is then shown: else an update of the one would come after that,
        or one of the other before it."""

    def set(self, **values: Any) -> None:
        """Change fields, under the lock; the caller tells of it afterwards (`changed`)."""
        self.now = replace(self.now, serial=self.now.serial + 1, **values)

    def put(self, view: View) -> None:
        """Show another view, under the lock, as `set`."""
        self.now = replace(view, serial=self.now.serial + 1)

    def changed(self) -> None:
        """Tell that it has changed."""
        self._on_change()

    def change(self, **values: Any) -> None:
        """Change fields."""
        with self.lock:
            self.set(**values)
        self.changed()

    def update(self, job: Job, **values: Any) -> None:
        """Change fields for a job, unless it was stopped."""
        with self.lock:
            if job.stopped:
                return
            self.set(**values)
        self.changed()
