"""The list of tasks."""

from __future__ import annotations

from typing import Annotated

import msgspec

from workbench.page.command import Command
from workbench.task.new_task import TemplateName


class OpenTaskList(Command, frozen=True):
    """Open another task."""

    key = "ctrl+o"


class OpenListedTask(Command, frozen=True):
    """Open this task of the list."""

    number: int


class OpenFoundTask(Command, frozen=True):
    """Open the best match of the search."""

    context = "dialog"


class ClearTaskSearch(Command, frozen=True):
    """Show all tasks again."""


class LookForTasks(Command, frozen=True):
    """List the tasks that have these words, or the file with this path."""

    words: str


LONGEST_NAME = 200
"""Characters."""


class NameTask(Command, frozen=True):
    """Name the task that is to be created."""

    name: Annotated[str, msgspec.Meta(max_length=LONGEST_NAME)]


class ChooseTemplate(Command, frozen=True):
    """Choose what the task that is to be created begins as."""

    template: TemplateName


class CreateTask(Command, frozen=True):
    """Create the named task from the chosen template, and open it."""
