"""Parses text typed or pasted into the task search as the path of a task."""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import unquote

from workbench.task.problem import TaskError
from workbench.task.reference import check_task_file, file_and_class, find_module, is_path, split_reference

_QUOTES = ('""', "''", "``", "“”", "‘’")
_LINE = re.compile(r"(?<=\.py)(:\d+)+$")
"""The line number, and sometimes column, that messages and editors append to a path: ``push.py:88``."""


class NotAPath(ValueError):
    """The path cannot be opened; the message is the reason."""


def typed_path(text: str, folder: Path) -> tuple[Path, str | None] | None:
    """File and class that a path or a ``module:Class`` names; the class is None if the path has none. Returns
    None for other texts, such as search words, and for a module that is not found.

    Accepts paths as terminals, editors and file managers write them: with surrounding quotes and spaces,
    ``file://``, ``~``, or a line number at the end.

    Args:
        folder: base of a relative path.

    Raises:
        NotAPath: there is no such file, or it is not a Python file.
    """
    text = text.strip()
    while len(text) > 1 and text[0] + text[-1] in _QUOTES:
        text = text[1:-1].strip()
    if text.startswith("file://"):
        text = unquote("/" + text.removeprefix("file://").partition("/")[2])
    text = _LINE.sub("", text)
    if (named := split_reference(text)) is not None:
        module = find_module(named[0])
        return None if module is None else (module.file, named[1])
    if not is_path(text) and "/" not in text:
        return None
    file, class_name = file_and_class(text)
    try:
        path = (folder / os.path.expanduser(file or text)).resolve()
        check_task_file(path)
    except TaskError as error:
        raise NotAPath(error.problem.message) from error
    except (OSError, RuntimeError, ValueError) as error:  # ValueError: characters that a path cannot contain
        raise NotAPath(f"{text} is not a path that can be opened: {error}") from error
    return path, class_name or None
