"""The dialog that asks whether code named by a recording may run."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import viser

from workbench.session.clearance import FOLLOWED, Consent, TrustQuestion
from workbench.ui.library.dialogs import Dialog
from workbench.ui.widgets.templates import render

TITLE = "Run this code?"
DO_NOT, ONCE, ALWAYS = (
    "Don't run it",
    "Run it, and ask again next time",
    "Run it, and don't ask again unless it changes",
)
MOST_OF_ONE, MOST_OF_ALL = 200_000, 1_000_000
"""Characters of one text, and of all texts, that go to the page; it says how much is left out."""
_LOOK = 0.1
"""Seconds between two checks whether the answer is still wanted."""


@dataclass
class _Pending:
    question: TrustQuestion
    answered: threading.Event = field(default_factory=threading.Event)
    answer: Consent = Consent.NO

    def take(self, answer: Consent) -> None:
        """The first answer counts."""
        if not self.answered.is_set():
            self.answer = answer
            self.answered.set()


class TrustDialog:
    """Asks one question at a time, on every open page; the first answer counts.

    Only a press of one of its buttons is a yes: Escape, a page that closes, and a request that is withdrawn are a no.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._lock = threading.RLock()
        self._waiting: list[_Pending] = []
        """The first is shown."""
        self._window: Dialog | None = None
        self._escape: viser.CommandHandle | None = None
        self._closed = False
        self._asking: Callable[[bool], None] = lambda asking: None

    def tell(self, asking: Callable[[bool], None]) -> None:
        """Call `asking` whenever a question opens or the last one closes: the library's keys are off meanwhile."""
        with self._lock:
            self._asking = asking
            self._asking(bool(self._waiting))

    def ask(self, question: TrustQuestion, stopped: Callable[[], bool]) -> Consent:
        """Show the question and wait for the answer. Never call it on viser's own threads.

        Args:
            stopped: called often; True withdraws the question.
        """
        pending = _Pending(question)
        with self._lock:
            self._waiting.append(pending)
        try:
            while not self._closed and not stopped():
                self._keep_shown()
                if pending.answered.wait(_LOOK):
                    return pending.answer
            return Consent.NO
        finally:
            with self._lock:
                if self._waiting[0] is pending:
                    self._take_down()
                self._waiting.remove(pending)
                self._asking(bool(self._waiting))

    def close(self) -> None:
        """Withdraw every question."""
        self._closed = True

    def _keep_shown(self) -> None:
        """Open the dialog of the first question, again if a page switch has removed it."""
        with self._lock:
            if self._window is not None and not self._window.modal.closed:
                return
            pending = self._waiting[0]
            question = pending.question
            gui = self._server.gui
            with self._server.atomic():
                self._window = Dialog(self._server, TITLE, lambda: None)
                with self._window.modal:
                    # The first button has the focus: Enter must not run anything.
                    self._add_button(DO_NOT, None, viser.Icon.X, pending, Consent.NO)
                    if question.more:
                        label = f"Don't run the other {question.more} either"
                        self._add_button(label, "gray", viser.Icon.X, pending, Consent.NONE)
                    self._add_button(ONCE, "gray", viser.Icon.PLAYER_PLAY, pending, Consent.ONCE)
                    self._add_button(ALWAYS, "gray", viser.Icon.SHIELD_CHECK, pending, Consent.ALWAYS)
                    # After the buttons, so that nothing in it has the focus; page.css puts it above them.
                    gui.add_html(question_html(question))
                self._escape = gui.add_command(DO_NOT, hotkey="escape")
                self._escape.on_trigger(lambda _: pending.take(Consent.NO))
            self._asking(True)

    def _add_button(
        self,
        label: str,
        color: Literal["gray"] | None,
        icon: viser.IconName,
        pending: _Pending,
        answer: Consent,
    ) -> None:
        button = self._server.gui.add_button(label, color=color, icon=icon)
        button.on_click(lambda _: pending.take(answer))

    def _take_down(self) -> None:
        window, escape = self._window, self._escape
        self._window = self._escape = None
        # False if a page switch has removed dialog and key.
        if window is not None and window.close() and escape is not None:
            escape.remove()


def question_html(question: TrustQuestion) -> str:
    """The code that would run, as HTML."""
    files: list[dict[str, object]] = []
    left = MOST_OF_ALL
    for file in question.files:
        shown = file.text[: min(MOST_OF_ONE, left)]
        left -= len(shown)
        left_out = len(file.text) - len(shown)
        said = {"name": file.name, "hash": file.hash, "since": file.since.value, "text": shown}
        files.append({**said, "left_out": left_out})
    return render("trust_question", asked=question, files=files, followed=FOLLOWED)
