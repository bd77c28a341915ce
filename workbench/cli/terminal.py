"""What every command says in a terminal, and how: results to stdout, refusals and problems in colour to stderr.

Much of it comes from elsewhere: names of files, notes of recordings, what the author's code raises and prints, the
paths of requests. What is said here is made harmless where it is known (`terminal_text`); and for what libraries, loggers
and tracebacks say past this module, `machine.text` stands before both streams of every command.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import IO, TYPE_CHECKING

from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn
from rich.segment import Segment

from workbench.machine.text import SafeStream, plain_text

if TYPE_CHECKING:
    from workbench.authoring.problem import Problem
    from workbench.core.rules import Finding
    from workbench.session.process.captured_output import PrintedLine
    from workbench.session.protocol.messages import Event
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager

from rich.text import Text

from workbench.session.clearance import CodeFile, Consent, NotTrusted, Since, TrustQuestion, question_text


class Exit(IntEnum):
    """What the commands end with."""

    DONE = 0
    FAILED = 1
    """The author's code raised, or there is less than was asked for."""
    REFUSED = 2
    """Nothing was done, and it was said why: a wrong argument, a missing file."""
    NOT_TRUSTED = 4
    """Nothing was run, because recordings name code that nobody agreed to; ``--trust`` agrees."""


class SafeConsole(Console):
    """Its own colours, bars and cursor moves reach the terminal; those in the text that it is given do not."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            if segment.control is not None:
                yield segment
                continue
            style = segment.style
            # The address of a link goes to the terminal as it is.
            if style is not None and style.link is not None:
                style = style.update_link(None)
            yield Segment(plain_text(segment.text, "\n"), style)

    @property
    def file(self) -> IO[str]:
        file = super().file
        return file.raw if isinstance(file, SafeStream) else file

    @file.setter
    def file(self, new_file: IO[str]) -> None:
        self._file = new_file


out = SafeConsole(highlight=False)
err = SafeConsole(stderr=True, highlight=False)

_LINES = "\n\t"
_told: set[str] = set()
"""Notices of the task; each reload brings them again."""


def say(text: object) -> None:
    """One line to stdout, not broken where the terminal ends: it can be taken from there."""
    print(plain_text(str(text)), flush=True)


def progress_bar(*columns: ProgressColumn) -> Progress:
    """What is being done, how far it is, and `columns`; on stderr, so that what comes of it can be taken from stdout."""
    return Progress(TextColumn("{task.description}", markup=False), BarColumn(), *columns, console=err)


def say_addresses(addresses: Sequence[str]) -> None:
    """Where a page is: the address to open, and others that lead to it from elsewhere."""
    for i, address in enumerate(addresses):
        say(f"  {'or' if i else 'page':8}{address}")


def refuse(message: str) -> int:
    """Say in a sentence why nothing is done; returns the exit code."""
    err.print(f"[red]{escape(plain_text(message))}[/]", soft_wrap=True)
    return Exit.REFUSED


def warn(message: str) -> None:
    err.print(f"[yellow]{escape(plain_text(message))}[/]", soft_wrap=True)


def print_problem(problem: Problem) -> None:
    """What went wrong in the author's code, with its place."""
    place = "" if problem.file is None else f"{problem.file}:{problem.line or 1}: "
    said = escape(plain_text(f"{place}{problem.message}"))
    err.print(f"[red]{escape(problem.stage)} failed[/] {said}", soft_wrap=True)
    if problem.code:
        err.print(f"    {escape(plain_text(problem.code))}", soft_wrap=True)
    if problem.traceback:
        err.print(f"[dim]{escape(plain_text(problem.traceback.rstrip(), _LINES))}[/]", soft_wrap=True)


def print_finding(finding: Finding) -> None:
    """A rule of GPU simulation that the author's code broke, with its place; the task goes on."""
    place = "" if finding.file is None else f"{finding.file}:{finding.line or 1}: "
    err.print(
        f"[yellow]warning[/] {escape(place)}{escape(finding.message)} [dim](rule {finding.rule})[/]",
        soft_wrap=True,
    )
    if finding.code:
        err.print(f"    {escape(finding.code)}", soft_wrap=True)


def print_event(event: Event) -> None:
    """What the page shows of loads and failures, in the terminal as well."""
    from workbench.session.protocol.messages import Loaded, LoadFailed, RulesBroken

    if isinstance(event, Loaded):
        parts = ", ".join(f"{plain_text(name)} {ms:.0f}" for name, ms in event.milliseconds.items())
        total = sum(event.milliseconds.values())
        how = "loaded" if event.reload is None else event.reload.level
        why = "" if event.reload is None or not event.reload.reason else f": {event.reload.reason}"
        what = escape(plain_text(f"{event.task.env_id}{why}"))
        out.print(
            f"[green]{escape(how)}[/] {what} in {total:.0f} ms [dim]({escape(parts)})[/]",
            soft_wrap=True,
        )
        for notice in event.task.notices:
            if notice not in _told:
                _told.add(notice)
                warn(notice)
    elif isinstance(event, LoadFailed):
        print_problem(event.problem)
        if event.kept:
            back = "comes back where it was" if event.problem.stage == "worker" else "keeps running"
            err.print(f"[dim]the last good version {back}[/]")
    elif isinstance(event, RulesBroken):
        for finding in event.new:
            print_finding(finding)


def print_line(line: PrintedLine) -> None:
    """What the author's code printed, told apart from the workbench's own lines."""
    from workbench.session.process.captured_output import for_terminal

    coloured = line.runs and out.color_system is not None and not out.no_color
    print(f"  | {for_terminal(line.runs) if coloured else line.text}", flush=True)


# --- The question whether code that a recording names may run, in a terminal ------------------


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
        named.append(f"    {question_text(question)}")
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


def _marks(file: CodeFile) -> str:
    return file.hash if file.since is Since.SAME else f"{file.hash}  [yellow]{file.since.value} since[/]"
