"""What a task reference names, told from its form alone, and on whose word it is opened.

A ``str`` is what a person named: a file, a class in it or in an importable module, or an id. What a recording names is a
`RecordedTask`, which opens nothing but a registered id unless a person agreed to the very texts, and never a module by its
name. The two are different types so that one cannot be taken for the other.

The server must know which file to follow before, and whether or not, the worker can load it, and it
must not import ManiSkill to find out: that takes seconds and a graphics driver. It must not run the file either, so not
even the packages above a module are imported. A module is looked for where Python would find it, and then in the current
folder, which is on nobody's ``sys.path``: who names a module in words means the one that they see where they are. What is
a library stays the library (`library_names`).
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.machinery import SOURCE_SUFFIXES, ModuleSpec
from pathlib import Path

from workbench.authoring.loading.library_names import is_library, is_own_file

_FILE = re.compile(r"(?P<file>.+\.py)(:(?P<cls>[^/\\]*))?", re.DOTALL)
_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
_REFERENCE = re.compile(rf"(?P<module>{_NAME.pattern}):(?P<cls>[^\W\d]\w*)")


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


def file_and_class(reference: str) -> tuple[str, str | None]:
    """Of ``file.py`` or ``file.py:ClassName``; an empty file for another form."""
    match = _FILE.fullmatch(reference)
    return ("", None) if match is None else (match["file"], match["cls"])


def named_file(reference: TaskName) -> Path | None:
    """The file of ``file.py`` or ``file.py:ClassName``, whether or not it exists, or of ``package.module:ClassName``.

    None for an env id, and for a module that is not there.
    """
    if isinstance(reference, RecordedTask):
        return None if reference.file is None else Path(reference.file)
    if (named := split_reference(reference)) is not None:
        module = find_module(named[0])
        return None if module is None else module.file
    file, _ = file_and_class(reference)
    return Path(file).expanduser().resolve() if file else None


def is_like_a_file(env_id: str) -> bool:
    """Whether what stands in place of an id is the form of a path to a task, whether or not it is there."""
    return bool(file_and_class(env_id)[0]) or env_id.startswith(("/", "./", "../", "~")) or "\\" in env_id


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


# --- package.module:ClassName ----------------------------------------------------------------------


@dataclass(frozen=True)
class NamedModule:
    """A module that was named, and was found."""

    name: str
    file: Path
    search_folder: Path | None
    """What must be on ``sys.path`` for it; None where the file does not lie as its name says (an import hook maps it)."""
    own_folder: Path | None
    """Its first package, or where a module without a package lies: what is in there is its author's. None for a
    library's module, which is imported as it is and not followed."""


def split_reference(reference: str) -> tuple[str, str] | None:
    """Module and class of ``package.module:ClassName``; None for another form, ``file.py:ClassName`` too."""
    match = _REFERENCE.fullmatch(reference)
    if match is None or match["module"].endswith(".py"):
        return None
    return match["module"], match["cls"]


def is_module_name(text: str) -> bool:
    """Whether it has the form of one."""
    return _NAME.fullmatch(text) is not None


def find_module(name: str) -> NamedModule | None:
    """Where the module `name` lies; None where there is no source of it."""
    first, *rest = name.split(".")
    file, folders = _first(first)
    for part in rest:
        file, folders = find_in(folders, part)
    if file is None or file.suffix not in SOURCE_SUFFIXES:
        return None
    file = file.resolve()
    parts = [*name.split("."), "__init__"] if file.stem == "__init__" else name.split(".")
    if [*file.parts[-len(parts) : -1], file.stem] != parts:
        return NamedModule(name, file, None, None)
    search_folder = file.parents[len(parts) - 1]
    own_folder = search_folder if len(parts) == 1 else search_folder / first
    is_own = is_own_file(str(file), own_folder) and not is_library(first)
    return NamedModule(name, file, search_folder, own_folder if is_own else None)


def not_found(name: str) -> str:
    """That there is no such module, in a sentence with the places where it was looked for."""
    return (
        f"there is no module {name} with a source file: it is neither installed for {sys.executable}, nor in a folder of "
        f"PYTHONPATH, nor below {Path.cwd()}"
    )


def _first(name: str) -> tuple[Path | None, list[Path]]:
    """File of a top-level module, and the folders in which its submodules lie."""
    spec: ModuleSpec | None = None
    for finder in sys.meta_path:
        spec = finder.find_spec(name, None) if hasattr(finder, "find_spec") else None
        if spec is not None:
            break
    folders = [] if spec is None else [Path(place) for place in spec.submodule_search_locations or ()]
    if spec is not None and spec.origin is not None:
        return (Path(spec.origin) if spec.has_location else None), folders
    # A folder without an __init__.py gives way to a package further on, as it does on sys.path.
    file, here = find_in([Path.cwd()], name)
    return (file, here) if file is not None else (None, [*folders, *here])


def find_in(folders: list[Path], name: str) -> tuple[Path | None, list[Path]]:
    """File of a module in one of these folders, as Python looks for it, and the folders in which its submodules lie."""
    plain: list[Path] = []
    for folder in folders:
        package, module = folder / name, folder / f"{name}.py"
        # Not Path.is_file, which raises for a name that is too long.
        if os.path.isfile(package / "__init__.py"):
            return package / "__init__.py", [package]
        if os.path.isfile(module):
            return module, []
        if os.path.isdir(package):
            plain.append(package)
    return None, plain
