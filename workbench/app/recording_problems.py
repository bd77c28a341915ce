"""Reports what a recording saved, and why something was not recorded, to every open browser, on any page and tab."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from weakref import WeakKeyDictionary

import viser

from workbench.app.session import Session
from workbench.machine.loop import begin, do
from workbench.page.widgets.notices import notify_all
from workbench.page.widgets.templates import counted
from workbench.record.state import RecordingStatus

_POLL_SECONDS = 0.2
REFUSED_SECONDS = 8.0
SAVED_SECONDS = 10.0


class RecordingProblems:
    """Watches the live session for ends of recordings and for problems. The session records also while another page is
    shown.

    Args:
        session: Returns the live session, if there is one.
        on_notice: Called with a message about a problem, for the terminal.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Callable[[], Session | None],
        on_notice: Callable[[str], None],
    ) -> None:
        self._server, self._session, self._on_notice = server, session, on_notice
        self._before = WeakKeyDictionary[Session, RecordingStatus]()
        self._watching = do(lambda: begin(self._watch()))

    def close(self) -> None:
        """Stop watching. Must not be called on the loop."""
        do(self._watching.cancel)

    async def _watch(self) -> None:
        while True:
            session = self._session()
            if session is not None:
                now = session.view().of(RecordingStatus)
                self._notify(self._before.get(session, RecordingStatus()), now)
                self._before[session] = now
            await asyncio.sleep(_POLL_SECONDS)

    def _notify(self, before: RecordingStatus, now: RecordingStatus) -> None:
        if now.saved is not None and (now.since, now.saved) != (before.since, before.saved):
            text = (
                f"{counted(now.saved, 'episode')} in {now.folder}"
                if now.saved
                else "No episode: none had a step."
            )
            notify_all(self._server, "Saved by the recording", text, None, SAVED_SECONDS)
        # Compare identities, not texts: the same problem may have occurred again since the last poll.
        if now.problem is not None and now.problem is not before.problem:
            self._on_notice(now.problem)
            notify_all(self._server, "Not recorded", now.problem, "red")
        saving = now.saving
        if not saving.failed or saving.message is before.saving.message:
            return
        if saving.refused_at is not None:
            notify_all(self._server, "Nothing was saved", saving.message, seconds=REFUSED_SECONDS)
        elif saving.message != now.problem:
            self._on_notice(saving.message)
            notify_all(self._server, "Nothing was saved", saving.message, "red")
