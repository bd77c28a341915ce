"""``package.module:ClassName`` as a person types it: which file that is, found without importing anything.

The server follows the file and must not run it, so not even the packages above the module are imported. A module is
looked for where Python would find it, and then in the current folder, which is on nobody's ``sys.path``: who names a
module in words means the one that they see where they are. What is a library stays the library (`library_names`).
"""

from __future__ import annotations

import os
import re
import sys
from dataclasses import dataclass
from importlib.machinery import SOURCE_SUFFIXES, ModuleSpec
from pathlib import Path

from workbench.authoring.library_names import is_library, is_own_file

_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
_REFERENCE = re.compile(rf"(?P<module>{_NAME.pattern}):(?P<cls>[^\W\d]\w*)")


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
        file, folders = _in(folders, part)
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
    file, here = _in([Path.cwd()], name)
    return (file, here) if file is not None else (None, [*folders, *here])


def _in(folders: list[Path], name: str) -> tuple[Path | None, list[Path]]:
    """The same of a module in one of these folders, as Python looks for it."""
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
