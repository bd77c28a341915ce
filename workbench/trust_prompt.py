"""The question whether code that a recording names may run, in a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import AbstractContextManager

from rich.console import Console
from rich.markup import escape

from workbench.machine.terminal_text import plain_text
from workbench.session.clearance import Answer, Question, in_words

MOST_NAMED = 20
_ANSWERS = {
    "y": Answer.ONCE,
    "yes": Answer.ONCE,
    "a": Answer.ALWAYS,
    "always": Answer.ALWAYS,
    "q": Answer.NONE,
}


def can_ask() -> bool:
    """Whether somebody sits at both ends: a question into a file, or an answer out of one, is none."""
    return sys.stdin.isatty() and sys.stdout.isatty()


class TerminalPrompt:
    """
    Args:
        out: Where it asks.
        quiet: Keeps everything else from writing there meanwhile.
    """

    def __init__(self, out: Console, quiet: Callable[[], AbstractContextManager[None]]) -> None:
        self._out, self._quiet = out, quiet

    def ask(self, question: Question, stopped: Callable[[], bool]) -> Answer:
        with self._quiet():
            print_question(question, self._out)
            choices = "y: run it, and ask again next time; a: run it, and trust this text from now on; n: do not run it"
            choices += f"; q: nor the {question.more} more" if question.more else ""
            self._out.print(f"[bold]Run it?[/] ({choices}) \\[n] ", end="", soft_wrap=True)
            try:
                typed = input()
            except EOFError:
                return Answer.NO
        return _ANSWERS.get(typed.strip().lower(), Answer.NO)


def print_question(question: Question, out: Console) -> None:
    """What would run."""
    if question.recorded_text:
        out.print(
            f"Recordings of {escape(plain_text(question.task))} that were not made by this installation hold this text:",
            soft_wrap=True,
        )
    else:
        out.print(
            f"Recordings of {escape(plain_text(question.task))} that were not made by this installation name this file:",
            soft_wrap=True,
        )
    out.print(f"    [bold]{escape(plain_text(question.file))}[/]  {question.hash}", soft_wrap=True)
    for name in question.modules[:MOST_NAMED]:
        out.print(f"    and beside it {escape(plain_text(name))}", soft_wrap=True)
    if len(question.modules) > MOST_NAMED:
        out.print(f"    and {len(question.modules) - MOST_NAMED} more beside it")
    if question.changed:
        out.print("[yellow]You trusted another text of this file before; it has changed since.[/]")
    for what in question.unseen[:MOST_NAMED]:
        out.print(f"[yellow]{escape(plain_text(what))}[/]", soft_wrap=True)
    out.print("It can read and change all that you can.")


def not_trusted(questions: tuple[Question, ...]) -> list[str]:
    """Why nothing was run, and what to do; a line each."""
    if can_ask():
        return ["Nothing was run: you agreed to none of it."]
    named = [f"    {in_words(question)}" for question in questions[:MOST_NAMED]]
    if len(questions) > MOST_NAMED:
        named.append(f"    and {len(questions) - MOST_NAMED} more")
    return [
        "Nothing was run: the recordings were not made by this installation, and nobody has agreed to the code that they name:",
        *named,
        "Read it. Then run the command in a terminal, where you are asked; or add --trust, which agrees for this run; or "
        "name your own task file with --task.",
    ]
