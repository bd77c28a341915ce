"""What a task reference names, told from its form alone, and on whose word it is opened.

A ``str`` is what a person named: a file, a class in it, or an id. What a recording names is a `RecordedTask`, which opens
nothing but a registered id unless a person agreed to the very texts. The two are different types so that one cannot be
taken for the other.

The server must know which file to follow before, and whether or not, the worker can load it, and it
must not import ManiSkill to find out: that takes seconds and a graphics driver.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

_FILE = re.compile(r"(?P<file>.+\.py)(:[^/\\]*)?", re.DOTALL)


@dataclass(frozen=True)
class RecordedTask:
    """A task that a recording names."""

    env_id: str
    """Opened if it is registered, never taken for a path."""
    file: str | None = None
    """The task's own file, absolute, where the recording leads to one."""
    class_name: str | None = None
    approved: Mapping[str, str] | None = None
    """Path to text of `file` and of the modules beside it, to which a person agreed: these are executed, and no others
    beside the file. Without them `file` is not opened."""

    def __str__(self) -> str:
        if self.file is None:
            return self.env_id
        return self.file if self.class_name is None else f"{self.file}:{self.class_name}"


TaskName = str | RecordedTask
"""What may be opened."""


def named_file(reference: TaskName) -> Path | None:
    """The file of ``file.py`` or ``file.py:ClassName``, whether or not it exists; None for an env id."""
    if isinstance(reference, RecordedTask):
        return None if reference.file is None else Path(reference.file)
    match = _FILE.fullmatch(reference)
    return None if match is None else Path(match["file"]).expanduser().resolve()
