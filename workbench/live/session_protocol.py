"""Interface through which panels use the session of the open task."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from workbench.live.history.env_table import EnvRows
from workbench.live.run import Run
from workbench.live.view import SessionView
from workbench.page.command import Command
from workbench.task.reference import TaskName

Value = TypeVar("Value")


class LiveSession(Protocol):
    """The session of the open task, which the app assembles from all features. Thread-safe."""

    @property
    def present_reference(self) -> TaskName:
        """The present name of the task."""
        ...

    def do(self, command: Command, page: str = "") -> None:
        """Carry out a command. Raises `Refused` if the command makes no sense now."""
        ...

    def dispatch(self, event: Any) -> None:
        """Handle an event of `live.events` or of a feature. Raises `Refused` for a command that makes no sense now."""
        ...

    def change(self, **settings: Any) -> None:
        """Change fields of `Settings`."""
        ...

    def view(self) -> SessionView:
        """A snapshot of the present state."""
        ...

    def look(self, read: Callable[[Run], Value]) -> Value:
        """The result of ``read(run)`` for the present run. `read` runs on the loop, because the loop
        writes the history."""
        ...

    def env_rows(self) -> EnvRows | None:
        """See `Run.env_rows`."""
        ...
