"""Parses references to tasks (file, class, id) without importing or running them."""

from __future__ import annotations

import difflib
import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.machinery import SOURCE_SUFFIXES, ModuleSpec
from pathlib import Path

from workbench.machine.files import real_path
from workbench.task.library_names import is_library, is_own_file
from workbench.task.problem import TaskError, task_error

_FILE = re.compile(r"(?P<file>.+\.py)(:(?P<cls>[^/\\]*))?", re.DOTALL)
_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
_REFERENCE = re.compile(rf"(?P<module>{_NAME.pattern}):(?P<cls>[^\W\d]\w*)")


@dataclass(frozen=True)
class RecordedTask:
    """A task that a recording names. A task that a person names is a ``str``.

    A separate type, so that a path or module name from a recording is never opened as if a person had given
    it. Only a registered id is opened, or the exact texts that a person approved.
    """

    env_id: str
    """Id that is opened if it is registered; never read as a path."""
    file: str | None = None
    """The task's own file, absolute, if the recording has one."""
    class_name: str | None = None
    approved: Mapping[str, str] | None = None
    """Texts of `file` and of its modules, by path, as a person approved them: only these texts are executed.
    None: `file` is not opened."""

    def __str__(self) -> str:
        if self.file is None:
            return self.env_id
        return self.file if self.class_name is None else f"{self.file}:{self.class_name}"


TaskName = str | RecordedTask
"""A task to open."""


def file_and_class(reference: str) -> tuple[str, str | None]:
    """File and class of ``file.py`` or ``file.py:ClassName``; ``("", None)`` for any other form."""
    match = _FILE.fullmatch(reference)
    return ("", None) if match is None else (match["file"], match["cls"])


def named_file(reference: TaskName) -> Path | None:
    """The file of ``file.py`` or ``file.py:ClassName`` (which need not exist), or of ``package.module:ClassName``.

    None for an env id and for a module that is not found. Called by the server, which must neither import
    ManiSkill (which takes seconds and needs a graphics driver) nor run the author's code. So not even the
    packages above a module are imported.
    """
    if isinstance(reference, RecordedTask):
        return None if reference.file is None else Path(reference.file)
    if (named := split_reference(reference)) is not None:
        module = find_module(named[0])
        return None if module is None else module.file
    file, _ = file_and_class(reference)
    # Not Path.expanduser, which raises if there is no such user.
    return real_path(Path(os.path.expanduser(file))) if file else None


def looks_like_file(env_id: str) -> bool:
    """Whether `env_id` has the form of a path to a task; the file need not exist."""
    return bool(file_and_class(env_id)[0]) or env_id.startswith(("/", "./", "../", "~")) or "\\" in env_id


def is_path(reference: str) -> bool:
    """Whether `reference` is a path: it has the form of one, or it contains a slash and exists, or it names a file
    in the current folder.

    A folder in the current folder does not count: it may have the name of an env id.
    """
    if looks_like_file(reference) or reference in (".", ".."):
        return True
    return os.path.exists(reference) if "/" in reference else os.path.isfile(reference)


def followed_folder(reference: TaskName) -> Path | None:
    """The folder whose modules are watched with the task's file; None if no file is watched."""
    if isinstance(reference, str) and (named := split_reference(reference)) is not None:
        module = find_module(named[0])
        return None if module is None else module.own_folder
    file = named_file(reference)
    return None if file is None else file.parent


def why_missing(reference: str) -> str | None:
    """Why the named file or module cannot be opened, judged by its form and the disk alone; None if it may exist."""
    if (named := split_reference(reference)) is not None:
        return not_found_text(named[0]) if find_module(named[0]) is None else None
    file = named_file(reference)
    if file is None and not is_path(reference):
        return None
    try:
        check_task_file(file or Path(os.path.expanduser(reference)).resolve())
    except TaskError as error:
        return error.problem.message
    return None


def check_task_file(file: Path) -> None:
    """Raise `TaskError`, with advice, for a path that is not a readable .py file."""
    try:
        if file.is_dir():
            names = sorted(path.name for path in file.glob("*.py"))[:5]
            inside = f", for example {' or '.join(names)}" if names else " (there is none in it)"
            raise task_error(f"{file} is a folder; name a .py file in it{inside}")
        if not file.exists():
            if file.is_symlink():
                raise task_error(f"{file} is a link to {file.readlink()}, which does not exist")
            raise missing_file(file)
        if not file.is_file():
            # Reading a pipe or a device may block forever.
            raise task_error(f"{file} is not an ordinary file")
        if file.suffix != ".py":
            raise task_error(
                f"{file} is not a .py file; a task is one Python file with a class that inherits BaseEnv"
            )
    except OSError as exc:
        raise task_error(f"cannot access the file ({exc.strerror}): {file}") from exc


def missing_file(file: Path) -> TaskError:
    """Error for a file that does not exist, with similar names in its folder."""
    if not file.parent.is_dir():
        return task_error(f"{file} does not exist, nor does its folder {file.parent}")
    # Compare stems: the common suffix makes unrelated short names similar.
    stems = [path.stem for path in file.parent.glob("*.py")]
    near = difflib.get_close_matches(file.stem, stems, n=3, cutoff=0.7)
    hint = f"; did you mean {' or '.join(f'{stem}.py' for stem in near)}?" if near else ""
    return task_error(f"{file} does not exist{hint}")


def reference_to_class(reference: TaskName, file: Path, class_name: str) -> TaskName:
    """The reference to another class of the file that `reference` opened; `file` is that file."""
    if isinstance(reference, RecordedTask):
        return replace(reference, class_name=class_name)
    named = split_reference(reference)
    module = None if named is None else find_module(named[0])
    if module is None or module.search_folder is None or not file.is_relative_to(module.search_folder):
        return f"{named_file(reference)}:{class_name}"
    # Name the module of `file`: the module in `reference` may merely import the class.
    parts = file.relative_to(module.search_folder).with_suffix("").parts
    return f"{'.'.join(parts[:-1] if parts[-1] == '__init__' else parts)}:{class_name}"


# --- package.module:ClassName ----------------------------------------------------------------------


@dataclass(frozen=True)
class NamedModule:
    """A module that a person named, found on disk."""

    name: str
    file: Path
    search_folder: Path | None
    """The folder that must be on ``sys.path``; None if the file's path does not match the module's name (an import hook maps
    it)."""
    own_folder: Path | None
    """Top package of the module, or the folder of a module without a package: everything in it is the author's. None for a
    library's module (imported normally and not watched), and if `search_folder` is None."""


def split_reference(reference: str) -> tuple[str, str] | None:
    """Module and class of ``package.module:ClassName``; None for any other form, including ``file.py:ClassName``."""
    match = _REFERENCE.fullmatch(reference)
    if match is None or match["module"].endswith(".py"):
        return None
    return match["module"], match["cls"]


def is_module_name(text: str) -> bool:
    """Whether `text` has the form of a dotted module name."""
    return _NAME.fullmatch(text) is not None


def find_module(name: str) -> NamedModule | None:
    """The module `name`, found as Python finds it, or else in the current folder. None if it is not found, or
    has no source file.

    The current folder is not on ``sys.path`` of the command, but a person expects names to be found there.
    """
    first, *rest = name.split(".")
    file, folders = _first(first)
    for part in rest:
        file, folders = find_in(folders, part)
    if file is None or file.suffix not in SOURCE_SUFFIXES:
        return None
    file = real_path(file)
    parts = [*name.split("."), "__init__"] if file.stem == "__init__" else name.split(".")
    if [*file.parts[-len(parts) : -1], file.stem] != parts:
        return NamedModule(name, file, None, None)
    search_folder = file.parents[len(parts) - 1]
    own_folder = search_folder if len(parts) == 1 else search_folder / first
    is_own = is_own_file(str(file), own_folder) and not is_library(first)
    return NamedModule(name, file, search_folder, own_folder if is_own else None)


def not_found_text(name: str) -> str:
    """Error text for a missing module, with the places that were searched."""
    return (
        f"there is no module {name} with a source file: it is neither installed for {sys.executable}, nor in a folder of "
        f"PYTHONPATH, nor below {Path.cwd()}"
    )


def _first(name: str) -> tuple[Path | None, list[Path]]:
    """File of a top-level module, and the folders of its submodules."""
    spec: ModuleSpec | None = None
    for finder in sys.meta_path:
        spec = finder.find_spec(name, None) if hasattr(finder, "find_spec") else None
        if spec is not None:
            break
    folders = [] if spec is None else [Path(place) for place in spec.submodule_search_locations or ()]
    if spec is not None and spec.origin is not None:
        return (Path(spec.origin) if spec.has_location else None), folders
    # A package found later takes precedence over a folder without __init__.py, as on sys.path.
    file, here = find_in([Path.cwd()], name)
    return (file, here) if file is not None else (None, [*folders, *here])


def find_in(folders: list[Path], name: str) -> tuple[Path | None, list[Path]]:
    """File of a module in one of these folders, as Python searches them, and the folders of its submodules."""
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


def lasting(reference: str) -> str:
    """A reference that names the same task from any folder."""
    file = named_file(reference)
    if file is None:
        return reference
    named = split_reference(reference)
    class_name = named[1] if named is not None else file_and_class(reference)[1]
    return f"{file}:{class_name}" if class_name else str(file)
