"""Runs ``workbench new``: writes a task, and in a terminal asks for missing arguments."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rich.markup import escape

from workbench.cli.output import Exit, can_ask, out, print_text, refuse
from workbench.machine.text import plain_text
from workbench.task.new_task import TEMPLATES, CannotBegin, why_not_name, write_new_task


def new_in_terminal(name: str, origin: str) -> int:
    """Write the task; returns the exit code.

    Args:
        name: name of the task; empty to ask for it.
        origin: a template or an id. If it is empty and a name is given, the first template is used. If both
            are empty, the user is asked for both.
    """
    folder = Path.cwd()
    if not name:
        if not can_ask():
            names = ", ".join(template.name for template in TEMPLATES)
            return refuse(
                f"Type a name, as in: workbench new stack_two --from {TEMPLATES[0].name} (templates: {names}; or an id such "
                "as PickCube-v1)"
            )
        try:
            origin = origin or _ask_template()
            name = _ask("Name of the task, such as stack_two", lambda typed: why_not_name(typed, folder))
        except EOFError:
            out.print()  # ends the line of the question
            return refuse("Nothing was written.")
    try:
        made = write_new_task(name, origin or TEMPLATES[0].name, folder)
    except CannotBegin as error:
        return refuse(str(error))
    print_text(f"{made.file.name} has the task {made.env_id}, class {made.class_name}.")
    print_text(f"Open it:  workbench open {made.reference}")
    return Exit.DONE


def _ask_template() -> str:
    longest = max(len(template.name) for template in TEMPLATES)
    for number, template in enumerate(TEMPLATES, 1):
        out.print(
            f"  {number}  [cyan]{template.name:<{longest}}[/]  {escape(template.about)}", soft_wrap=True
        )
    numbers = [str(number) for number in range(1, len(TEMPLATES) + 1)]
    names = [template.name for template in TEMPLATES]

    def why_not(typed: str) -> str:
        known = typed in (*numbers, *names, "")
        return "" if known else f"Type a number from 1 to {numbers[-1]}, or Enter for {names[0]}."

    typed = _ask(f"Template, from 1 to {numbers[-1]} (Enter: {names[0]})", why_not) or names[0]
    return names[numbers.index(typed)] if typed in numbers else typed


def _ask(question: str, why_not: Callable[[str], str]) -> str:
    """Ask until `why_not` accepts the answer. Raises EOFError."""
    while True:
        out.print(f"[bold]{escape(question)}:[/] ", end="", soft_wrap=True)
        typed = input().strip()
        why = why_not(typed)
        if not why:
            return typed
        out.print(f"[red]{escape(plain_text(why))}[/]", soft_wrap=True)
