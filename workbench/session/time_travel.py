"""The past of the batch as a page asks for it: looked at, gone back to, undone, read.

Every step that was made is kept in a `History`, and one `Timeline` says which moment of it is shown. A page asks for
another moment, or to go on from the one that is shown, as it asks for anything else: nothing here waits. To look is to
change a number behind the session's lock; to go on is a message to the worker, whose answer comes as a step like any
other.
"""

from __future__ import annotations

from collections.abc import Callable

from workbench.session.camera_judging import ShownMoment
from workbench.session.history import Lived
from workbench.session.live_state import SharedState
from workbench.session.messages import Request, Restore
from workbench.session.timeline import Scope, Strip, Timeline


class TimeTravel:
    """What the batch lived through. All methods are thread-safe and return at once."""

    def __init__(
        self, shared: SharedState, send: Callable[[Request], None], pause: Callable[[], None]
    ) -> None:
        """
        Args:
            shared: what the session knows.
            send: tells the worker.
            pause: stops playing.
        """
        self._state, self._lock, self._note = shared.state, shared.lock, shared.note
        self._send, self._pause = send, pause

    # --- looked at -------------------------------------------------------------------------------

    def seek(self, serial: int | None) -> None:
        """Show a moment of the past, by its number (see `TimelineView`); None shows what is live."""
        self._seek(lambda timeline: timeline.seek(serial))

    def seek_by(self, steps: int) -> None:
        """Show a moment before (negative) or after the one that is shown."""
        self._seek(lambda timeline: timeline.seek_by(steps))

    def seek_step(self, env: int, step: int) -> None:
        """Show the moment at which this env was at that step of its present episode."""
        self._seek(lambda timeline: timeline.seek_step(env, step))

    def seek_event(self, direction: int) -> None:
        """Show the next (1) or last (-1) event of the selected env: reset, success, fail, truncation, branch."""
        env = self._env
        self._seek(lambda timeline: timeline.seek_event(env, direction))

    def draw(self) -> None:
        """Ask for pictures of the moment that is shown, if it has none of the cameras looked through."""
        with self._lock:
            s = self._state
            request = None if s.timeline is None else s.timeline.draw(self._env, s.now.settings.cameras)
        if request is not None:
            self._send(request)

    # --- gone back to ----------------------------------------------------------------------------

    def go_on(self, scope: Scope) -> None:
        """Put envs back to the shown moment; the simulation goes on from there (see `timeline.Scope`)."""
        self._travel(lambda timeline, env: timeline.go_on(env, scope))

    def undo(self) -> None:
        """Take back the selected env's last reset or going back, and pause there."""
        self._pause()
        self._travel(lambda timeline, env: timeline.undo(env))

    # --- read ------------------------------------------------------------------------------------

    def strip(self, low: int, high: int) -> Strip | None:
        """The selected env's past between two moments; None before a task is loaded."""
        with self._lock:
            s = self._state
            return None if s.timeline is None else s.timeline.strip(self._env, low, high)

    def stretch(self) -> tuple[int, int] | None:
        """First and last moment of what the selected env lived through round the shown moment, without a jump."""
        with self._lock:
            timeline = self._state.timeline
            if timeline is None or not len(timeline.history):
                return None
            return timeline.history.stretch_at(self._env, timeline.at)

    def shown_moment(self) -> ShownMoment:
        """Which env is looked at, and where its bodies are if that is not live."""
        with self._lock:
            s = self._state
            shown = None if s.timeline is None else s.timeline.shown
            count = 0 if s.now.task is None else s.now.task.num_envs
            return ShownMoment(self._env, count, None if shown is None else shown.step.poses)

    def episode_moments(self, most: int) -> tuple[Lived, ...]:
        """Moments, at the most so many, of the selected env's episode round the one that is shown."""
        with self._lock:
            s = self._state
            if s.timeline is None or not len(s.timeline.history):
                return ()
            return s.timeline.history.episode(self._env, s.timeline.at, most)

    @property
    def _env(self) -> int:
        return self._state.now.settings.selected_env

    def _seek(self, seek: Callable[[Timeline], None]) -> None:
        with self._lock:
            timeline = self._state.timeline
            if timeline is None:
                return
            before = timeline.shown
            seek(timeline)
            if timeline.shown is before:
                return
            self._state.new_pictures()
        self._note()

    def _travel(self, ask: Callable[[Timeline, int], Restore | None]) -> None:
        with self._lock:
            timeline = self._state.timeline
            request = None if timeline is None else ask(timeline, self._env)
            self._state.new_pictures()
        if request is not None:
            self._send(request)
        self._note()
