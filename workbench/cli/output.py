"""Prints results, errors and questions of all commands to a terminal, with escape sequences removed."""

from __future__ import annotations

import os
import select
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, redirect_stdout
from enum import IntEnum
from typing import IO, TYPE_CHECKING

from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn
from rich.segment import Segment
from rich.text import Text

from workbench.machine.maniskill_installed import lines_if_lacking, lines_if_mixed
from workbench.machine.text import SafeStream, listed, plain_text
from workbench.task.problem import place_text
from workbench.trust.clearance import CodeFile, Consent, NotTrusted, Since, TrustQuestion, question_text

if TYPE_CHECKING:
    from workbench.envs.gpu_rules import Finding
    from workbench.jobs.scheduler import Failure
    from workbench.live.messages import Event, TaskFailed
    from workbench.live.process.captured_output import PrintedLine
    from workbench.task.problem import Problem


class Exit(IntEnum):
    """Exit codes of the commands."""

    DONE = 0
    FAILED = 1
    """The author's code raised, a check has findings, or there are fewer results than requested."""
    REFUSED = 2
    """Nothing was done: a wrong argument, a missing file."""
    NOT_TRUSTED = 4
    """Nothing was run: recordings name code that is not trusted (see ``--trust``)."""
    INTERRUPTED = 130
    """Ended by Ctrl-C (128 + SIGINT); finished results are kept."""


class SafeConsole(Console):
    """A rich console that removes escape sequences from printed text, and keeps its own colours, bars and cursor moves.

    Escape sequences may come from file names, recordings, the author's code and requests. The output of
    libraries, loggers and tracebacks bypasses this console; `machine.text` filters it.
    """

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            if segment.control is not None:
                yield segment
                continue
            style = segment.style
            # Drop the link: rich would print its address unescaped.
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
_MAX_FAILED_ITEMS = 100
"""Maximum number of items that are listed for each kind of failure."""
_printed_notices: set[str] = set()
"""Notices of the task that were printed already; each reload sends them again."""


def print_text(text: object) -> None:
    """Print one line to stdout without wrapping, so that it can be copied."""
    print(plain_text(str(text)), flush=True)


@contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """Redirect output of the author's code, native libraries and child processes to stderr: stdout is for results."""
    sys.stdout.flush()
    before = os.dup(1)
    try:
        os.dup2(2, 1)
        with redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(before, 1)
        os.close(before)


def progress_bar(*columns: ProgressColumn) -> Progress:
    """A progress bar with `columns` on stderr, which keeps stdout for results."""
    return Progress(TextColumn("{task.description}", markup=False), BarColumn(), *columns, console=err)


def print_addresses(addresses: Sequence[str]) -> None:
    """Print the addresses of a page: first the one to open, then those for other machines."""
    for i, address in enumerate(addresses):
        print_text(f"  {'or' if i else 'page':8}{address}")


def refuse(message: str) -> int:
    """Print why a command does nothing; returns the exit code."""
    err.print(f"[red]{escape(plain_text(message))}[/]", soft_wrap=True)
    return Exit.REFUSED


def interrupted(kept: str = "") -> int:
    """Print that Ctrl-C ended a command; returns the exit code.

    Args:
        kept: text about the results that were kept.
    """
    refuse(f"interrupted; {kept}" if kept else "interrupted")
    return Exit.INTERRUPTED


def end_quietly() -> int:
    """Return the exit code of SIGPIPE if the reader of stdout has closed the pipe.

    Must be called in an ``except BrokenPipeError`` block; reraises the error if it comes from another pipe.
    """
    poller = select.poll()
    poller.register(sys.stdout.fileno(), 0)
    if not any(event & select.POLLERR for _, event in poller.poll(0)):
        raise
    # Prevents a second error when Python flushes stdout at exit.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 128 + signal.SIGPIPE


def warn(message: str) -> None:
    """Print a warning."""
    err.print(f"[yellow]{escape(plain_text(message))}[/]", soft_wrap=True)


def lacks_maniskill(command: str) -> bool:
    """Return whether ManiSkill is missing; prints how to install it, and warns if two of its distributions are installed."""
    lines = lines_if_lacking(f"workbench {command}", sys.argv[1:])
    for line in lines or ():
        refuse(line)
    for line in lines_if_mixed() or ():
        warn(line)
    return lines is not None


def print_problem(problem: Problem) -> None:
    """Print an error in the author's code, with its line."""
    place = place_text(problem.file, problem.line)
    message = escape(plain_text(f"{place}{problem.message}"))
    err.print(f"[red]{escape(problem.what_failed)}[/] {message}", soft_wrap=True)
    if problem.code:
        err.print(f"    {escape(plain_text(problem.code))}", soft_wrap=True)
    if problem.traceback:
        err.print(f"[dim]{escape(plain_text(problem.traceback.rstrip(), _LINES))}[/]", soft_wrap=True)


def print_failures(failures: Sequence[Failure], names: Callable[[int], str]) -> None:
    """Print the failures that did not end a job: each kind of failure once, with the items that it affects.

    Args:
        names: returns the name of an item.
    """
    from workbench.jobs.scheduler import by_kind

    for problem, numbers in by_kind(failures):
        print_problem(problem)
        items = listed([names(number) for number in numbers], _MAX_FAILED_ITEMS)
        count = "1 item" if len(numbers) == 1 else f"{len(numbers)} items"
        err.print(escape(f"    {count} without a result: {items}"), soft_wrap=True)


def print_finding(finding: Finding) -> None:
    """Print a rule of GPU simulation that the author's code broke, with its line."""
    place = place_text(finding.file, finding.line)
    err.print(
        f"[yellow]warning[/] {escape(place)}{escape(finding.message)} [dim](rule {finding.rule})[/]",
        soft_wrap=True,
    )
    if finding.code:
        err.print(f"    {escape(finding.code)}", soft_wrap=True)


def print_event(event: Event) -> None:
    """Print loads, failures and broken rules; the page shows them too."""
    from workbench.live.messages import Loaded, RulesBroken, TaskFailed

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
            if notice not in _printed_notices:
                _printed_notices.add(notice)
                warn(notice)
    elif isinstance(event, TaskFailed):
        print_problem(event.problem)
        if event.kept:
            err.print(f"[dim]{escape(_what_runs(event))}[/]", soft_wrap=True)
    elif isinstance(event, RulesBroken):
        for finding in event.new:
            print_finding(finding)


def _what_runs(failed: TaskFailed) -> str:
    """Describe which version runs after a failure, and how to continue."""
    if failed.at_run:
        what = "the policy" if failed.problem.stage == "policy" else "the version"
        process = f"; another process loads the version again: {failed.spoiled}" if failed.spoiled else ""
        return f"{what} failed while the task ran, and the task is paused{process}. Save a fixed file, or reset, to continue"
    if failed.spoiled or failed.problem.stage == "worker":
        return "the last good version is loaded again and restored to its last state"
    return "the last good version stays loaded, running or paused as before"


def print_line(line: PrintedLine) -> None:
    """Print a line that the author's code has printed, with a mark that distinguishes it from the workbench's
    own lines."""
    from workbench.live.process.captured_output import for_terminal

    coloured = line.runs and out.color_system is not None and not out.no_color
    print(f"  | {for_terminal(line.runs) if coloured else line.text}", flush=True)


# --- Asking whether code of a recording may run ------------------------------------------------


MAX_QUESTIONS = 20
"""Maximum number of questions that are listed if there is no terminal to ask them in."""
_TAB = "\t"
_SHOW = ("s", "show")
_ANSWERS = {
    "y": Consent.ONCE,
    "yes": Consent.ONCE,
    "a": Consent.ALWAYS,
    "always": Consent.ALWAYS,
    "q": Consent.NONE,
}


def can_ask() -> bool:
    """Whether stdin and stdout are terminals, so that a person can answer."""
    return sys.stdin.isatty() and sys.stdout.isatty()


class TerminalPrompt:
    """Asks for consent in a terminal.

    Args:
        out: the console to ask on.
        quiet: context in which nothing else writes to the console.
    """

    def __init__(self, out: Console, quiet: Callable[[], AbstractContextManager[None]]) -> None:
        self._out, self._quiet = out, quiet

    def ask(self, question: TrustQuestion, stopped: Callable[[], bool]) -> Consent:
        with self._quiet():
            print_question(question, self._out)
            choices = (
                "show: print the text first; y: run it and ask again next time; a: run it and trust this text from now on; "
                "n: do not run it"
            )
            choices += f"; q: run neither it nor the {question.more} others" if question.more else ""
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
    """Print which files would run and what is known of them."""

    def print_escaped(text: str, style: str = "") -> None:
        out.print(escape(plain_text(text)), style=style, soft_wrap=True)

    how = "contain this code" if question.recorded_text else "name this file"
    print_escaped(f"Recordings of {question.task} {how}, and you have not yet chosen to always trust it:")
    for place, file in enumerate(question.files):
        if place == 1:
            print_escaped(_modules_text(question))
        name = escape(plain_text(file.name))
        out.print(f"    {name if place else f'[bold]{name}[/]'}  {_file_mark(file)}", soft_wrap=True)
    if question.nothing_known:
        print_escaped(
            "You trusted another version of this file and the modules next to it. It is not known which of them has "
            "changed.",
            "yellow",
        )
    elif question.trusted_before:
        gone = f"; removed since: {', '.join(question.gone)}" if question.gone else ""
        print_escaped(f"You trusted another version of this. Changes since then are marked{gone}.", "yellow")
    for what in question.unseen:
        print_escaped(what, "yellow")
    print_escaped(
        "This code can read and change everything that you can. The digits are the start of each file's "
        "sha256sum."
    )


def print_texts(question: TrustQuestion, out: Console) -> None:
    """Print the texts that would run, escaped."""
    for file in question.files:
        out.print(f"[bold]{escape(plain_text(file.name))}[/]  {file.hash}", soft_wrap=True)
        for number, line in enumerate(file.text.split("\n"), 1):
            # Not as markup, in which `:x:` is an emoji.
            out.print(Text.assemble((f"{number:5} ", "dim"), plain_text(line, _TAB)), soft_wrap=True)


def not_trusted_lines(error: NotTrusted) -> list[str]:
    """Explain why nothing was run, and what to do."""
    lines = [
        f"Nothing was run: {reason}. --trust allows all code in this run: add it only if you know where the "
        "recording comes from."
        for reason in error.reasons
    ]
    questions = error.questions
    if not questions:
        return lines
    if can_ask():
        return [*lines, "Nothing was run: you did not allow any of the code."]
    named: list[str] = []
    for question in questions[:MAX_QUESTIONS]:
        named.append(f"    {question_text(question)}")
        named += [f"        with {module.name} ({module.hash})" for module in question.modules]
    if len(questions) > MAX_QUESTIONS:
        named.append(f"    and {len(questions) - MAX_QUESTIONS} more")
    return [
        *lines,
        "Nothing was run: you have not agreed to run the code that the recordings name or contain:",
        *named,
        "Read the code. Then run the command in a terminal, where it asks you (the answer show prints the "
        "code); or add --trust, which allows the code in this run; or name your own task file with --task.",
    ]


def _modules_text(question: TrustQuestion) -> str:
    if question.recorded_text:
        return "The recordings also contain the modules that this code may import:"
    if question.computed:
        return "Its imports cannot be determined by reading it, so it may import every module next to it:"
    return "It imports these modules next to it:"


def _file_mark(file: CodeFile) -> str:
    return file.hash if file.since is Since.SAME else f"{file.hash}  [yellow]{file.since.value} since[/]"
