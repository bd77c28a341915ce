"""What every command says in a terminal, and how: results to stdout, refusals and problems in colour to stderr.

Much of it comes from elsewhere: names of files, notes of recordings, what the author's code raises and prints, the
paths of requests. What is said here is made harmless where it is known (`terminal_text`); and for what libraries, loggers
and tracebacks say past this module, `machine.terminal_text` stands before both streams of every command.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import IO, TYPE_CHECKING

from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn
from rich.segment import Segment

from workbench.machine.terminal_text import SafeStream, plain_text

if TYPE_CHECKING:
    from workbench.authoring.problem import Problem
    from workbench.core.rules import Finding
    from workbench.session.messages import Event
    from workbench.session.printed import PrintedLine


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
    from workbench.session.messages import Failed, Loaded, RulesBroken

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
    elif isinstance(event, Failed):
        print_problem(event.problem)
        if event.kept:
            back = "comes back where it was" if event.problem.stage == "worker" else "keeps running"
            err.print(f"[dim]the last good version {back}[/]")
    elif isinstance(event, RulesBroken):
        for finding in event.new:
            print_finding(finding)


def print_line(line: PrintedLine) -> None:
    """What the author's code printed, told apart from the workbench's own lines."""
    from workbench.session.printed import for_terminal

    coloured = line.runs and out.color_system is not None and not out.no_color
    print(f"  | {for_terminal(line.runs) if coloured else line.text}", flush=True)
