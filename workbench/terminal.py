"""What every command says in a terminal, and how: results to stdout, refusals and problems in colour to stderr."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape

if TYPE_CHECKING:
    from workbench.authoring.problem import Problem
    from workbench.core.rules import Finding
    from workbench.session.messages import Event

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)


def refuse(message: str) -> int:
    """Say in a sentence why nothing is done; returns the exit code."""
    err.print(f"[red]{escape(message)}[/]", soft_wrap=True)
    return 2


def warn(message: str) -> None:
    err.print(f"[yellow]{escape(message)}[/]")


def print_problem(problem: Problem) -> None:
    """What went wrong in the author's code, with its place."""
    place = "" if problem.file is None else f"{problem.file}:{problem.line or 1}: "
    err.print(
        f"[red]{escape(problem.stage)} failed[/] {escape(place)}{escape(problem.message)}", soft_wrap=True
    )
    if problem.code:
        err.print(f"    {escape(problem.code)}", soft_wrap=True)
    if problem.traceback:
        err.print(f"[dim]{escape(problem.traceback.rstrip())}[/]", soft_wrap=True)


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
        parts = ", ".join(f"{name} {ms:.0f}" for name, ms in event.milliseconds.items())
        total = sum(event.milliseconds.values())
        how = "loaded" if event.reload is None else event.reload.level
        why = "" if event.reload is None or not event.reload.reason else f": {escape(event.reload.reason)}"
        out.print(
            f"[green]{how}[/] {escape(event.task.env_id)}{why} in {total:.0f} ms [dim]({parts})[/]",
            soft_wrap=True,
        )
    elif isinstance(event, Failed):
        print_problem(event.problem)
        if event.kept:
            back = "comes back where it was" if event.problem.stage == "worker" else "keeps running"
            err.print(f"[dim]the last good version {back}[/]")
    elif isinstance(event, RulesBroken):
        for finding in event.new:
            print_finding(finding)


def print_line(line: str) -> None:
    """What the author's code printed, told apart from the workbench's own lines."""
    print(f"  | {line}", flush=True)
