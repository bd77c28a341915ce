"""What the library asks before it does something: tags, a note, and whether it shall delete.

A window over the page, since the table scrolls and a form in it would be out of sight. It is there for all open pages,
as the selection is; whoever answers first has answered. What it was asked for (these recordings, not whatever is
selected by then) is kept with the question.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import viser

from workbench.ui.fragments import render

MOST_NAMES = 6


class Question:
    """One window with a question, open until it is answered or `close`."""

    def __init__(self, server: viser.ViserServer, title: str, closed: Callable[[], None]) -> None:
        self.modal = server.gui.add_modal(title)
        self._closed = closed
        self._lock = threading.Lock()

    def close(self) -> bool:
        """Close it; False if it was closed already: of two answers only one counts."""
        with self._lock:
            if self.modal.closed:
                return False
            self.modal.close()
        self._closed()
        return True

    def give_up(self, _event: object) -> None:
        """For *Cancel*."""
        self.close()


def ask_text(
    server: viser.ViserServer,
    title: str,
    explained: str,
    names: Sequence[str],
    value: str,
    answered: Callable[[str], None],
    closed: Callable[[], None],
) -> Question:
    """Ask for one line of text; Enter or *Save* is the answer.

    Args:
        names: of the recordings that it is for.
        value: what stands in the field.
        answered: gets what was typed, as the page sent it, on a thread of viser's.
        closed: is called once, when the window is gone, before `answered`.
    """
    question = Question(server, title, closed)
    with question.modal:
        server.gui.add_html(_question("", names, explained))
        form = server.gui.add_form(None)
        with form:
            field = server.gui.add_text("", value)
        save = server.gui.add_button("Save", icon=viser.Icon.CHECK)
        cancel = server.gui.add_button("Cancel", color="gray")

    def answer(_event: object) -> None:
        typed = field.value
        if question.close():
            answered(typed if isinstance(typed, str) else "")

    form.on_submit(answer)
    save.on_click(answer)
    cancel.on_click(question.give_up)
    return question


def ask_whether(
    server: viser.ViserServer,
    title: str,
    asked: str,
    names: Sequence[str],
    explained: str,
    do: str,
    answered: Callable[[], None],
    closed: Callable[[], None],
) -> Question:
    """Ask whether to do something that takes something away; only the button `do` is a yes."""
    question = Question(server, title, closed)
    with question.modal:
        server.gui.add_html(_question(asked, names, explained))
        yes = server.gui.add_button(do, color="red", icon=viser.Icon.TRASH)
        cancel = server.gui.add_button("Cancel", color="gray")

    def answer(_event: object) -> None:
        if question.close():
            answered()

    yes.on_click(answer)
    cancel.on_click(question.give_up)
    return question


def _question(asked: str, names: Sequence[str], answer: str) -> str:
    shown = names if len(names) <= MOST_NAMES else names[: MOST_NAMES - 1]
    return render(
        "library_question", question=asked, names=shown, more=len(names) - len(shown), answer=answer
    )
