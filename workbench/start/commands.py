"""Commands of the list of tasks."""

from __future__ import annotations

from typing import Annotated

import msgspec

from workbench.page.command import Command
from workbench.task.new_task import TemplateName


class OpenTaskList(Command, frozen=True):
    """Open another task."""

    key = "ctrl+o"


class OpenListedTask(Command, frozen=True):
    """Open this listed task."""

    number: int


class OpenFoundTask(Command, frozen=True):
    """Open the best match of the search."""

    context = "dialog"


class ClearTaskSearch(Command, frozen=True):
    """Show all tasks again."""


class LookForTasks(Command, frozen=True):
    """List the tasks that contain these words, or the file with this path."""

    words: str


MAX_NAME_CHARACTERS = 200


class NameTask(Command, frozen=True):
    """Type the name of the new task."""

    name: Annotated[str, msgspec.Meta(max_length=MAX_NAME_CHARACTERS)]


class ChooseTemplate(Command, frozen=True):
    """Choose the template of the new task."""

    template: TemplateName


class CreateTask(Command, frozen=True):
    """Create the task with the typed name from the chosen template, and open it."""
