"""The dialog that asks whether code of a recording, or a listed file, may run."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field

import viser

from workbench.machine.loop import result_of
from workbench.page.command import Refused
from workbench.page.commands import AnswerTrust
from workbench.page.widgets.dialog import Dialog
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tools_html
from workbench.trust.clearance import FOLLOWED, Consent, TrustQuestion

TITLE = "Run this code?"
DO_NOT, ONCE, ALWAYS = (
    "Don't run it",
    "Run it, and ask again next time",
    "Run it, and don't ask again unless it changes",
)
MAX_TEXT_CHARACTERS, MAX_TOTAL_CHARACTERS = 200_000, 1_000_000
"""Maximum length of one text, and of all texts together, on the page; the page shows how much is left out."""
_POLL_SECONDS = 0.1
"""Interval at which the dialog checks whether the answer is still needed."""


@dataclass
class _Pending:
    question: TrustQuestion
    name: str = field(default_factory=lambda: secrets.token_urlsafe(12))
    """Random, so that a page of an earlier run of the program cannot answer a question."""
    answer: asyncio.Future[Consent] = field(default_factory=asyncio.Future)


class TrustDialog:
    """Asks one question at a time, on every open page; the first answer counts.

    Only its buttons can give a yes: Escape, a closed page, and a withdrawn request count as no.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._waiting: list[_Pending] = []
        """Pending questions; the first is shown."""
        self._window: Dialog | None = None
        self._closed = False

    def say_no(self) -> bool:
        """Answer no to the shown question; returns False if there is none."""
        if not self._waiting:
            return False
        self._take(Consent.NO)
        return True

    def answer(self, command: AnswerTrust) -> None:
        """Answer the shown question. Raises `Refused` if another question is shown, or if the shown question
        is already answered."""
        is_shown = self._waiting and self._waiting[0].name == command.question
        if not is_shown or not self._take(Consent(command.answer)):
            raise Refused("This question was already answered or withdrawn.")

    def _take(self, answer: Consent) -> bool:
        """Answer the first question; returns False if it is already answered."""
        shown = self._waiting[0]
        if shown.answer.done():
            return False
        shown.answer.set_result(answer)
        return True

    def ask(self, question: TrustQuestion, stopped: Callable[[], bool]) -> Consent:
        """Show the question and wait for the answer. Must not be called on the loop.

        Args:
            stopped: polled; True withdraws the question.
        """
        return result_of(self._asked(question, stopped))

    async def _asked(self, question: TrustQuestion, stopped: Callable[[], bool]) -> Consent:
        pending = _Pending(question)
        self._waiting.append(pending)
        try:
            while not self._closed and not stopped():
                self._keep_shown()
                await asyncio.wait([pending.answer], timeout=_POLL_SECONDS)
                if pending.answer.done():
                    return pending.answer.result()
            return Consent.NO
        finally:
            if self._waiting[0] is pending:
                self._take_down()
            self._waiting.remove(pending)

    def close(self) -> None:
        """Withdraw every question."""
        self._closed = True

    def _keep_shown(self) -> None:
        """Open the dialog of the first question if it is not open; for example, a page switch may have
        removed it."""
        if self._window is not None and not self._window.modal.closed:
            return
        pending = self._waiting[0]
        gui = self._server.gui
        with self._server.atomic():
            self._window = Dialog(self._server, TITLE)
            with self._window.modal:
                gui.add_html(buttons_html(pending.name, pending.question.more))
                # After the buttons, so that a button gets the focus; page.css shows the question above them.
                gui.add_html(question_html(pending.question))

    def _take_down(self) -> None:
        window, self._window = self._window, None
        if window is not None:
            window.close()


def buttons_html(name: str, more: int) -> str:
    """The answer buttons of the question with this name; `more` other questions follow."""
    # The first button has the focus: Enter must not run anything.
    rows = [[Tool(DO_NOT, AnswerTrust(question=name, answer="no"), tone="main")]]
    if more:
        rows.append([Tool(f"Don't run the other {more} either", AnswerTrust(question=name, answer="none"))])
    rows.append([Tool(ONCE, AnswerTrust(question=name, answer="once"))])
    rows.append([Tool(ALWAYS, AnswerTrust(question=name, answer="always"))])
    return tools_html(*rows)


def question_html(question: TrustQuestion) -> str:
    """The code that would run, as HTML."""
    files: list[dict[str, object]] = []
    left = MAX_TOTAL_CHARACTERS
    for file in question.files:
        shown = file.text[: min(MAX_TEXT_CHARACTERS, left)]
        left -= len(shown)
        left_out = len(file.text) - len(shown)
        values = {"name": file.name, "hash": file.hash, "since": file.since.value, "text": shown}
        files.append({**values, "left_out": left_out})
    return render("trust_question", asked=question, files=files, followed=FOLLOWED)
