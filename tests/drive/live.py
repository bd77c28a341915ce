"""The live page without a browser or a worker: open it, show it a view, press, and see what it asks of the session.

Only this file knows how a page gets its view: when the session's models change, this file changes and its tests do not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import viser

from tests.drive.panels import Clock, Panels, forget_what_was_drawn
from tests.drive.scenes import EMPTY
from workbench.app.live_page import Page
from workbench.live.history.env_table import EnvRows
from workbench.live.view import SessionView
from workbench.page.command import Command

FILE = "push.py"


class _Asked:
    """A part of the session: records each call under its dotted path, unless `answers` has an entry for it."""

    def __init__(self, path: str, session: StubSession) -> None:
        self._path, self._session = path, session

    def __getattr__(self, name: str) -> Any:
        path = f"{self._path}.{name}"
        answer = self._session.answers.get(path)
        return _Asked(path, self._session) if answer is None else answer

    def __call__(self, *args: Any, **named: Any) -> None:
        self._session.asked.append((self._path, *args, *([named] if named else [])))


class StubSession:
    """Stub session: shows the view that it was given and records what is asked: ``Step()``, ``("stop_recording",)``."""

    def __init__(self) -> None:
        self.shown = EMPTY
        self.rows: EnvRows | None = None
        self.asked: list[Any] = []
        self.reference = self.present_reference = FILE
        self.answers: dict[str, Any] = {
            "knows_file": lambda file: True,
            "strip": lambda low, high, column: None,
            "episodes": lambda env, last, columns, before: (),
            "episode_ticks": lambda: None,
            "segment": lambda: None,
            "rescored_curve": lambda name, env: None,
        }

    def view(self) -> SessionView:
        return self.shown

    def env_rows(self) -> EnvRows | None:
        return self.rows

    def newest_env_table(self) -> EnvRows | None:
        return self.rows

    def look(self, read: Callable[[Any], Any]) -> Any:
        return read(self)

    def do(self, command: Command, page: str = "") -> None:
        self.asked.append(command)

    def dispatch(self, event: object) -> None:
        self.asked.append(event)

    def __getattr__(self, name: str) -> Any:
        return self.answers.get(name) or _Asked(name, self)


class Live(Panels):
    """The live page on a server, operated by a test."""

    def __init__(
        self,
        server: viser.ViserServer,
        clock: Clock | None = None,
        on_look: Callable[[Any], None] = lambda path: None,
        **more: Any,
    ) -> None:
        """`more` goes to `Page`."""
        super().__init__(server)
        self.clock, self.session = clock or Clock(), StubSession()
        self._envs = self._scenes = 0
        self.asked_by_drawing: list[Any] = []
        """What the last redraw asked of the session."""
        self.page = Page(server, self.visitors, self.session, on_look=on_look, clock=self.clock, **more)  # type: ignore[arg-type]
        self.visitors.do = self.page.do

    @property
    def asked(self) -> list[Any]:
        """What presses asked of the session."""
        return self.session.asked

    def show(self, view: SessionView, rows: EnvRows | None = None, seconds: float = 60.0) -> None:
        """Draw this view, `seconds` after the last one."""
        if view.task is not None and view.task.num_envs != self._envs:
            self._envs, self._scenes = view.task.num_envs, self._scenes + 1
        view = replace(view, scene_serial=view.scene_serial + self._scenes, env_table=rows or view.env_table)
        self.session.shown, self.session.rows = view, rows
        self.clock.passes(seconds)
        pressed, self.session.asked = self.session.asked, []
        self.page.redraw()
        self.asked_by_drawing, self.session.asked = self.session.asked, pressed

    def all_drawn(self) -> dict[str, object]:
        """Everything visible after a forced redraw of every part."""
        forget_what_was_drawn(self.page._parts)
        self.again()
        return self.everything()

    def again(self, seconds: float = 60.0) -> None:
        """Redraw the last view, with the effect of presses since."""
        shown = self.session.shown
        self.show(replace(shown, scene_serial=shown.scene_serial - self._scenes), self.session.rows, seconds)
