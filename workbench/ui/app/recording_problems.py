"""Tells every open browser, whichever page and tab it shows, and the terminal why something was not recorded."""

from __future__ import annotations

import threading
from collections.abc import Callable

import viser

from workbench.machine.processes.watched_thread import watched_thread
from workbench.session.live.session import Session
from workbench.session.record.recording import RecordingStatus
from workbench.ui.widgets.notices import tell_all

_LOOK_SECONDS = 0.5
REFUSED_SECONDS = 8.0


class RecordingProblems:
    """Follows the live session, also while another page is shown: it goes on recording.

    Args:
        session: The live session now, if there is one.
        on_notice: Called with a message for the terminal.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Callable[[], Session | None],
        on_notice: Callable[[str], None],
    ) -> None:
        self._server, self._session, self._on_notice = server, session, on_notice
        self._before = RecordingStatus()
        self._closing = threading.Event()
        self._thread = watched_thread("recording-problems", self._watch)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()

    def _watch(self) -> None:
        seen = -1
        while not self._closing.is_set():
            session = self._session()
            if session is None:
                self._closing.wait(_LOOK_SECONDS)
                continue
            seen = session.wait(seen, _LOOK_SECONDS)
            self._tell(session.view().recording)

    def _tell(self, now: RecordingStatus) -> None:
        before, self._before = self._before, now
        # By identity: the same may happen again between two looks.
        if now.problem is not None and now.problem is not before.problem:
            self._on_notice(now.problem)
            tell_all(self._server, "Not recorded", now.problem, "red")
        saving = now.saving
        if not saving.failed or saving.message is before.saving.message:
            return
        if saving.refused_at is not None:
            tell_all(self._server, "Nothing was saved", saving.message, seconds=REFUSED_SECONDS)
        elif saving.message != now.problem:
            self._on_notice(saving.message)
            tell_all(self._server, "Nothing was saved", saving.message, "red")
