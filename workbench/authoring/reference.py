"""What a task reference names, told from its form alone, and on whose word it is opened.

A ``str`` is what a person named: a file, a class in it or in an importable module, or an id. What a recording names is a
`RecordedTask`, which opens nothing but a registered id unless a person agreed to the very texts, and never a module by its
name. The two are different types so that one cannot be taken for the other.

The server must know which file to follow before, and whether or not, the worker can load it, and it
must not import ManiSkill to find out: that takes seconds and a graphics driver.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from workbench.authoring.named_modules import find_module, not_found, split_reference

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
    """The file of ``file.py`` or ``file.py:ClassName``, whether or not it exists, or of ``package.module:ClassName``.

    None for an env id, and for a module that is not there.
    """
    if isinstance(reference, RecordedTask):
        return None if reference.file is None else Path(reference.file)
    if (named := split_reference(reference)) is not None:
        module = find_module(named[0])
        return None if module is None else module.file
    match = _FILE.fullmatch(reference)
    return None if match is None else Path(match["file"]).expanduser().resolve()


def is_like_a_file(env_id: str) -> bool:
    """Whether what stands in place of an id is the form of a path to a task, whether or not it is there."""
    return _FILE.fullmatch(env_id) is not None or env_id.startswith(("/", "./", "../", "~")) or "\\" in env_id


def followed_folder(reference: TaskName) -> Path | None:
    """The folder whose modules are followed with the task's file; None where no file is followed."""
    if isinstance(reference, str) and (named := split_reference(reference)) is not None:
        module = find_module(named[0])
        return None if module is None else module.own_folder
    file = named_file(reference)
    return None if file is None else file.parent


def why_not_there(reference: str) -> str | None:
    """Why what a person named cannot be opened, as far as its form and the disk say; None for what may be."""
    if (named := split_reference(reference)) is not None:
        return not_found(named[0]) if find_module(named[0]) is None else None
    file = named_file(reference)
    return None if file is None or file.is_file() else f"there is no file {file}"


def class_beside(reference: TaskName, file: Path, class_name: str) -> TaskName:
    """What names another class where `reference` led to; `file` is that of the class that it gave."""
    if isinstance(reference, RecordedTask):
        return replace(reference, class_name=class_name)
    named = split_reference(reference)
    module = None if named is None else find_module(named[0])
    if module is None or module.search_folder is None or not file.is_relative_to(module.search_folder):
        return f"{named_file(reference)}:{class_name}"
    # The class may be of another module, which the one that was named only imports it from.
    parts = file.relative_to(module.search_folder).with_suffix("").parts
    return f"{'.'.join(parts[:-1] if parts[-1] == '__init__' else parts)}:{class_name}"
