"""The question whether code that a recording names may run, in a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import AbstractContextManager

from rich.console import Console
from rich.markup import escape
from rich.text import Text

from workbench.machine.terminal_text import plain_text
from workbench.session.clearance import AskedFile, Consent, NotTrusted, Since, TrustQuestion, in_words

MOST_NAMED = 20
"""Questions that are listed where nobody can answer them."""
TAB = "\t"
_SHOW = ("s", "show")
_ANSWERS = {
    "y": Consent.ONCE,
    "yes": Consent.ONCE,
    "a": Consent.ALWAYS,
    "always": Consent.ALWAYS,
    "q": Consent.NONE,
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

    def ask(self, question: TrustQuestion, stopped: Callable[[], bool]) -> Consent:
        with self._quiet():
            print_question(question, self._out)
            choices = (
                "show: print the text first; y: run it, and ask again next time; a: run it, and trust this text from now on; "
                "n: do not run it"
            )
            choices += f"; q: nor the {question.more} more" if question.more else ""
            while True:
                self._out.print(f"[bold]Run it?[/] ({choices}) \\[n] ", end="", soft_wrap=True)
                try:
                    typed = input().strip().lower()
                except EOFError:
                    return Consent.NO
                if typed not in _SHOW:
                    return _ANSWERS.get(typed, Consent.NO)
                print_texts(question, self._out)


def print_question(question: TrustQuestion, out: Console) -> None:
    """What would run."""

    def tell(text: str, style: str = "") -> None:
        out.print(escape(plain_text(text)), style=style, soft_wrap=True)

    holds = "hold this text" if question.recorded_text else "name this file"
    tell(f"Recordings of {question.task} that were not made by this installation {holds}:")
    for place, file in enumerate(question.files):
        if place == 1:
            tell(_about_modules(question))
        name = escape(plain_text(file.name))
        out.print(f"    {name if place else f'[bold]{name}[/]'}  {_marks(file)}", soft_wrap=True)
    if question.nothing_known:
        tell(
            "You trusted another version of this file and the modules beside it before. Which of them has changed since is "
            "not known.",
            "yellow",
        )
    elif question.trusted_before:
        gone = f"; gone since: {', '.join(question.gone)}" if question.gone else ""
        tell(f"You trusted another version of this before. What has changed since is marked{gone}.", "yellow")
    for what in question.unseen:
        tell(what, "yellow")
    tell(
        "It can read and change all that you can. The digits are the first that sha256sum says of each file."
    )


def print_texts(question: TrustQuestion, out: Console) -> None:
    """The texts that would run, with nothing in them that a terminal takes for more than text."""
    for file in question.files:
        out.print(f"[bold]{escape(plain_text(file.name))}[/]  {file.hash}", soft_wrap=True)
        for number, line in enumerate(file.text.split("\n"), 1):
            # Not as markup, in which `:x:` would be a picture.
            out.print(Text.assemble((f"{number:5} ", "dim"), plain_text(line, TAB)), soft_wrap=True)


def not_trusted(error: NotTrusted) -> list[str]:
    """Why nothing was run, and what to do; a line each."""
    said = [
        f"Nothing was run: {reason}. Add it, which agrees to all in this run, if you know where the recording comes from."
        for reason in error.reasons
    ]
    questions = error.questions
    if not questions:
        return said
    if can_ask():
        return [*said, "Nothing was run: you agreed to none of it."]
    named: list[str] = []
    for question in questions[:MOST_NAMED]:
        named.append(f"    {in_words(question)}")
        named += [f"        with {module.name} ({module.hash})" for module in question.modules]
    if len(questions) > MOST_NAMED:
        named.append(f"    and {len(questions) - MOST_NAMED} more")
    return [
        *said,
        "Nothing was run: the recordings were not made by this installation, and nobody has agreed to the code that they name:",
        *named,
        "Read it. Then run the command in a terminal, where you are asked, and where show prints the text; or add --trust, which "
        "agrees for this run; or name your own task file with --task.",
    ]


def _about_modules(question: TrustQuestion) -> str:
    if question.recorded_text:
        return "Beside it they hold what it may import:"
    if question.computed:
        return "What it imports cannot be told by reading it, so it may import all that lies beside it:"
    return "It imports from beside it:"


def _marks(file: AskedFile) -> str:
    return file.hash if file.since is Since.SAME else f"{file.hash}  [yellow]{file.since.value} since[/]"
