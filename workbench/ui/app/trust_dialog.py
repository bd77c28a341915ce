"""The window that asks whether code that a recording names may run.

One window at a time, on every open page; whoever answers first has answered. Only a press of one of its buttons is a yes:
Escape, a page that is closed, and the end of what wanted to run it are a no.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import viser

from workbench.session.clearance import FOLLOWED, Consent, TrustQuestion
from workbench.ui.library.dialogs import Question as Window
from workbench.ui.widgets.templates import render

TITLE = "Run this code?"
DO_NOT, ONCE, ALWAYS = (
    "Don't run it",
    "Run it, without asking until the workbench ends",
    "Run it, and trust this text from now on",
)
MOST_OF_ONE, MOST_OF_ALL = 200_000, 1_000_000
"""Characters of one text, and of all of them together, that go to the page; of the rest it is said that it is missing."""
_LOOK = 0.1
"""Seconds between two looks at whether the answer is still wanted."""


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
    """See the module's text."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._lock = threading.RLock()
        self._waiting: list[_Pending] = []
        """The first is shown."""
        self._window: Window | None = None
        self._escape: viser.CommandHandle | None = None
        self._closed = False
        self._asking: Callable[[bool], None] = lambda asking: None

    def tell(self, asking: Callable[[bool], None]) -> None:
        """Tell this from now on whether something is asked: a page's table of recordings takes no keys then."""
        with self._lock:
            self._asking = asking
            self._asking(bool(self._waiting))

    def ask(self, question: TrustQuestion, stopped: Callable[[], bool]) -> Consent:
        """Show the question, and wait for the answer. Not to be called on viser's own threads.

        Args:
            stopped: asked often; True withdraws the question.
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
        """Take every question back."""
        self._closed = True

    def _keep_shown(self) -> None:
        """The window of the first question; a page that went has taken it along."""
        with self._lock:
            if self._window is not None and not self._window.modal.closed:
                return
            pending = self._waiting[0]
            question = pending.question
            gui = self._server.gui
            with self._server.atomic():
                self._window = Window(self._server, TITLE, lambda: None)
                with self._window.modal:
                    # The first has the focus: Enter must not run anything.
                    self._add_button(DO_NOT, None, viser.Icon.X, pending, Consent.NO)
                    if question.more:
                        label = f"Nor the {question.more} more that are asked about"
                        self._add_button(label, "gray", viser.Icon.X, pending, Consent.NONE)
                    self._add_button(ONCE, "gray", viser.Icon.PLAYER_PLAY, pending, Consent.ONCE)
                    self._add_button(ALWAYS, "gray", viser.Icon.SHIELD_CHECK, pending, Consent.ALWAYS)
                    # After them, so that no name in it has the focus; page.css puts it above them.
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
        # False where the page went, and with it the window and the key.
        if window is not None and window.close() and escape is not None:
            escape.remove()


def question_html(question: TrustQuestion) -> str:
    """What would run; every value escaped."""
    files: list[dict[str, object]] = []
    left = MOST_OF_ALL
    for file in question.files:
        shown = file.text[: min(MOST_OF_ONE, left)]
        left -= len(shown)
        left_out = len(file.text) - len(shown)
        said = {"name": file.name, "hash": file.hash, "since": file.since.value, "text": shown}
        files.append({**said, "left_out": left_out})
    return render("trust_question", asked=question, files=files, followed=FOLLOWED)
