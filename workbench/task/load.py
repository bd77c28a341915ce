"""Loads the task class of a file, a class reference or a registered id; a failed load changes nothing."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import inspect
import platform
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import packages_distributions, version
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from workbench.task import registry
from workbench.task.classes import Robot, choose_task, missing_class, robot_scene_text
from workbench.task.content import source_hash
from workbench.task.library_names import (
    files_named_like_libraries,
    named_like_library_text,
    remove_library_finder,
    search_first,
)
from workbench.task.modules import (
    AuthorFinder,
    ModuleName,
    UnloadedModules,
    hidden_by_libraries,
    read_source,
    restore_modules,
    unload_modules,
)
from workbench.task.problem import Problem, TaskError, is_ctrl_c, problem_from_exception, task_error
from workbench.task.reference import (
    NamedModule,
    RecordedTask,
    TaskName,
    check_task_file,
    file_and_class,
    find_module,
    is_module_name,
    missing_file,
    not_found_text,
    split_reference,
)

if TYPE_CHECKING:
    from mani_skill.envs.sapien_env import BaseEnv


@dataclass(frozen=True)
class RefusedClass:
    """A class of the file that could not be opened."""

    name: str
    why: str


@dataclass(frozen=True)
class LoadedTask:
    cls: type[BaseEnv]
    env_id: str
    """Registered id, or the class name of an unregistered task."""
    class_name: str
    file: Path | None
    """Source file of the class."""
    source_files: tuple[Path, ...]
    """The task's file first, then the imported modules of its folder."""
    source: dict[str, str]
    """The executed text of each of `source_files`, by path."""
    source_hash: str
    """sha256 over `source` with relative paths, 12 hex digits."""
    max_episode_steps: int | None
    default_kwargs: dict[str, Any]
    """Constructor arguments from ``@register_env``."""
    followed: bool
    """Whether the file is watched; False for an id that was registered elsewhere."""
    others: tuple[str, ...] = ()
    """Other task classes of the file (robots if it has no task), which ``file.py:Name`` opens."""
    alternatives: tuple[str, ...] = ()
    """Names in `others` to try if this class fails, in order; empty if a class was named."""
    in_place_of: RefusedClass | None = None
    """The class that was tried first and failed."""
    robot: Robot | None = None
    """The robot, shown in a scene of ManiSkill, for a file without a task."""
    replaced: tuple[registry.Registration, ...] = ()
    """Registrations under a name that another task or robot has (``PickCube-v1``): plain ManiSkill would skip
    them."""
    named_like_libraries: tuple[Path, ...] = ()
    """Files of the task's folder that no import finds, because a library has their name."""

    @property
    def chosen(self) -> str:
        """Name of the open class: the task's, or the robot's."""
        return self.class_name if self.robot is None else self.robot.class_name

    @property
    def asset_ids(self) -> tuple[str, ...]:
        """Assets that the task's registration requires to be downloaded."""
        spec = registry.environment(self.env_id)
        return () if spec is None else tuple(spec.asset_download_ids or ())

    @property
    def notices(self) -> tuple[str, ...]:
        """Notices for the author about a working task, as sentences."""
        found = [named_like_library_text(file) for file in self.named_like_libraries]
        if self.in_place_of is not None:
            name, why = self.in_place_of.name, self.in_place_of.why
            found.append(f"{name} was tried first and failed ({why}): {self.chosen} is open in its place.")
        if self.robot is not None and self.file is not None:
            found.append(robot_scene_text(self.robot, self.file))
        if self.replaced:
            names = ", ".join(one.name for one in self.replaced)
            found.append(
                f"{self.file} registers {names}, which exists already: the workbench uses this file's class from "
                "now on, but plain ManiSkill would skip it. Choose another name to have both, or register with "
                "override=True."
            )
        return tuple(found)


@dataclass
class _Load:
    finder: AuthorFinder
    registrations: registry.Registrations
    before: _Load | None
    """The load of the same file that this one replaced."""
    unloaded: UnloadedModules | None
    """The modules before this load; None once a later load depends on this one."""
    cls: type[BaseEnv] | None = None
    """The class that the load gave."""


_loads: dict[Path, _Load] = {}
"""The last good load of each file. Global, as ``sys.modules`` and the registries are."""


def load_task(reference: TaskName, source: Mapping[str, str] | None = None) -> LoadedTask:
    """Import the task that `reference` names: ``file.py``, ``file.py:ClassName``, ``package.module:ClassName`` or an id.

    All or nothing: the file is executed again with the modules of its folder. If that fails, the modules,
    registrations and texts for tracebacks of the last good version are restored: that version may be running,
    and may import more modules later.

    Args:
        reference: a `RecordedTask` opens only a registered id or approved texts, never a path.
        source: texts by path that replace the files on disk; those files need not exist.

    Raises:
        TaskError: with the author's line if there is one. A person's KeyboardInterrupt is not converted.
    """
    if isinstance(reference, RecordedTask):
        return _load_recorded(reference, source or {})
    given = {str(_resolve(path)): text for path, text in (source or {}).items()}
    if registry.environment(reference) is not None:
        return _registered(reference)
    if (named := split_reference(reference)) is not None:
        return _load_named(*named, given)
    file, class_name = _parse(reference)
    if str(file) not in given:
        check_task_file(file)
    return _load_file(file, class_name, given)


def with_late_imports(task: LoadedTask) -> LoadedTask:
    """`task`, plus the modules that its hooks have imported since."""
    load = _load_of(task)
    return task if load is None else dataclasses.replace(task, **_source_fields(load.finder))


def undo_load(task: LoadedTask) -> bool:
    """Undo the load that gave `task`: restore the modules and registrations of the version before it.

    Used when the class could be imported, but its env cannot be built. Only the newest load of a file can be
    undone: returns False for any other load, and for a task that is not watched.
    """
    load = _load_of(task)
    if load is None or load.unloaded is None or sys.modules.get(load.finder.main) is None:
        return False
    if load.cls is not task.cls:
        return False
    _revert(load)
    return True


def _load_of(task: LoadedTask) -> _Load | None:
    return _loads.get(task.file) if task.followed and task.file is not None else None


def _load_recorded(task: RecordedTask, source: Mapping[str, str]) -> LoadedTask:
    if task.approved is None:
        # A file without approval is not opened; `env_id` may look like a path but is never used as one.
        if registry.environment(task.env_id) is None:
            lost = (
                ""
                if task.file is not None
                else (
                    ", and its file was found neither in or above the recording's folder, nor below the "
                    "current folder"
                )
            )
            raise task_error(
                f"a recording names the task {task.env_id!r}, which no installed package registers{lost}. {IMPORT_HINT}"
            )
        return _registered(task.env_id)
    if task.file is None or task.file not in task.approved:
        raise task_error(f"the approved texts do not include the file of {task.env_id}")
    return _load_file(Path(task.file), task.class_name, {**task.approved, **source}, only_given=True)


def import_module(name: str) -> ModuleType:
    """Import a module that a person named, as Python does, but also from the current folder (see
    `find_module`). Raises TaskError."""
    if name in sys.modules:
        return sys.modules[name]
    found = find_module(name)
    if found is None:
        raise task_error(not_found_text(name))
    if found.search_folder is not None and str(found.search_folder) not in sys.path:
        search_first(found.search_folder, permanent=True)
    try:
        return importlib.import_module(name)
    except BaseException as exc:
        if is_ctrl_c(exc):
            raise
        raise TaskError(_named_module_problem(exc, found)) from exc


def import_modules(names: Sequence[str]) -> None:
    """Import the modules of ``--import``, for the ids that they register. Raises TaskError."""
    for name in names:
        import_module(name)


def class_of_module(name: str, class_name: str) -> type[BaseEnv]:
    """A task class of a module, which `import_module` imports. Raises TaskError."""
    module = import_module(name)
    cls = getattr(module, class_name, None)
    if not isinstance(cls, type) or not registry.is_task(cls):
        names = [value.__name__ for value in vars(module).values() if registry.is_task(value)]
        raise missing_class(class_name, cls, name, Path(module.__file__ or name), names)
    return cls


def _load_named(name: str, class_name: str, given: dict[str, str]) -> LoadedTask:
    """Load the file of ``package.module:ClassName``, with the package's modules.

    A library's module is imported normally: it is not edited, and other code uses its classes.
    """
    found = find_module(name)
    if found is None:
        raise task_error(not_found_text(name))
    place = _place_of(found)
    if place is None:
        cls = class_of_module(name, class_name)
        return dataclasses.replace(task_of_class(cls, registry.id_of(cls) or class_name), followed=False)
    task = _load_file(found.file, class_name, given, named=place)
    home = sys.modules[task.cls.__module__]
    file = Path(home.__file__ or found.file)
    if file == found.file or str(file) not in task.source:
        return task
    # The named module only imports the class from another module of the package. Edit and watch that module.
    _revert(_loads[found.file])
    return _load_file(
        file, task.class_name, given, named=dataclasses.replace(place, name=task.cls.__module__)
    )


def _place_of(found: NamedModule) -> ModuleName | None:
    if found.search_folder is None or found.own_folder is None:
        return None
    return ModuleName(found.name, found.search_folder, found.own_folder)


def _load_file(
    file: Path,
    class_name: str | None,
    given: dict[str, str],
    only_given: bool = False,
    named: ModuleName | None = None,
) -> LoadedTask:
    finder = AuthorFinder(file, given, only_given, named)
    # In a named package every module is read again, even the main modules of its other tasks.
    package = None if named is None else named.own_folder
    others = {
        load.finder.main
        for path, load in _loads.items()
        if path != file and not (package is not None and path.is_relative_to(package))
    }
    load = _begin(finder, unload_modules(finder, others.__contains__))
    with registry.registering(finder.texts.__contains__, load.registrations):
        try:
            module = importlib.import_module(finder.main)
            task = _task_in(module, class_name, load)
        except BaseException as exc:
            # Computed before the modules are restored: the problem's lines are those of the text that failed.
            problem = None if is_ctrl_c(exc) else _import_problem(exc, finder)
            _revert(load)
            if problem is None:
                raise
            raise TaskError(problem) from exc
    for earlier in _loads.values():
        if earlier is not load:
            earlier.unloaded = None
    # Without this every earlier version would stay in memory.
    if load.before is not None:
        load.before.unloaded = load.before.before = None
    return task


def _begin(finder: AuthorFinder, unloaded: UnloadedModules) -> _Load:
    before = _loads.get(finder.file)
    if before is not None:
        before.registrations.undo()
        sys.meta_path.remove(before.finder)
    if not finder.only_given:
        search_first(finder.search_folder)
    sys.meta_path.insert(0, finder)
    # Python's cached folder listing lacks a helper that was just created.
    importlib.invalidate_caches()
    _loads[finder.file] = load = _Load(finder, registry.Registrations(), before, unloaded)
    return load


def _revert(load: _Load) -> None:
    assert load.unloaded is not None
    load.registrations.undo()
    sys.meta_path.remove(load.finder)
    restore_modules(load.unloaded, load.finder)
    if load.before is None:
        del _loads[load.finder.file]
        if not _loads:
            remove_library_finder()
    else:
        load.before.registrations.redo()
        sys.meta_path.insert(0, load.before.finder)
        _loads[load.finder.file] = load.before


# --- the reference -------------------------------------------------------------------------------


def _parse(reference: str) -> tuple[Path, str | None]:
    """File and class of a reference that is not a registered id."""
    if not reference.strip():
        raise task_error(
            "no task named; give a .py file, file.py:ClassName, or a registered id like PickCube-v1"
        )
    path, name = file_and_class(reference)
    if name is not None and not _exists(reference):
        if not name.isidentifier():
            raise task_error(
                f"{reference!r}: after the colon comes the name of a class, as in push.py:PushEnv"
            )
        return _resolve(path), name
    if is_module_name(reference) and not _exists(reference) and find_module(reference) is not None:
        raise task_error(f"{reference} is a module: name the class in it too, as in {reference}:MyTask")
    if _looks_like_path(reference):
        return _resolve(reference), None
    raise _unknown_id(reference)


def _looks_like_path(reference: str) -> bool:
    return (
        "/" in reference
        or "\\" in reference
        or reference.startswith(("~", "."))
        or "." in reference
        or _exists(reference)
    )


def _exists(reference: str) -> bool:
    try:
        return Path(reference).exists()
    except (OSError, ValueError):  # too long, or with a null byte
        return False


def _resolve(path: str | Path) -> Path:
    try:
        return Path(path).expanduser().resolve()
    except (
        OSError,
        RuntimeError,
        ValueError,
    ) as exc:  # home of an unknown user; a loop of links; a null byte
        raise task_error(f"{str(path)!r} is not a path that can be opened: {exc}") from exc


def _unknown_id(env_id: str) -> TaskError:
    if registry.is_other_gymnasium_id(env_id):
        return task_error(f"{env_id} is a gymnasium environment, but not one of ManiSkill's (no BaseEnv)")
    ids = {known.lower(): known for known in registry.environment_ids()}
    close = [ids[name] for name in difflib.get_close_matches(env_id.lower(), list(ids), n=3)]
    hint = (
        f"did you mean {' or '.join(close)}?" if close else "give a .py file, or an id such as PickCube-v1."
    )
    return task_error(f"no task is registered as {env_id!r}, and there is no such file; {hint} {IMPORT_HINT}")


IMPORT_HINT = (
    "If a package of yours registers it, import that package first: --import PACKAGE on the command line, "
    "`import package` before workbench.make."
)


# --- the class -----------------------------------------------------------------------------------


def task_of_class(cls: type[BaseEnv], env_id: str) -> LoadedTask:
    """The `LoadedTask` of a class that exists already.

    Its source is the executed texts if `load_task` loaded its file, else the text on disk; empty for a class
    without a file.
    """
    for load in _loads.values():
        # Excludes a class that the file only imports.
        registered = any(made.cls is cls and made.name == env_id for made in load.registrations.made)
        if registered or cls.__module__ in load.finder.names:
            return _task(cls, env_id, load.finder.file, followed=True, **_source_fields(load.finder))
    # A class made without a file (in a notebook, by type()) or shipped as bytecode has no text.
    with suppress(TypeError, OSError, SyntaxError):
        file = Path(inspect.getsourcefile(cls) or "").resolve()
        return _task(cls, env_id, file, **_fields({str(file): read_source(file)}, file, file.parent))
    return _task(cls, env_id, None, **_fields({}, None, Path()))


def _task(
    cls: type[BaseEnv], env_id: str | None, file: Path | None, followed: bool = False, **known: Any
) -> LoadedTask:
    spec = None if env_id is None else registry.environment(env_id)
    limit, kwargs = (None, {}) if spec is None else (spec.max_episode_steps, dict(spec.default_kwargs))
    if spec is None and (of_gymnasium := registry.gymnasium_spec_of(cls)) is not None:
        env_id, limit, kwargs = of_gymnasium.id, of_gymnasium.max_episode_steps, dict(of_gymnasium.kwargs)
    return LoadedTask(
        cls,
        env_id or cls.__name__,
        cls.__name__,
        file,
        max_episode_steps=limit,
        default_kwargs=kwargs,
        followed=followed,
        **known,
    )


def _registered(env_id: str) -> LoadedTask:
    spec = registry.environment(env_id)
    assert spec is not None
    return dataclasses.replace(task_of_class(spec.cls, env_id), followed=False)


def _task_in(module: ModuleType, requested: str | None, load: _Load) -> LoadedTask:
    finder = load.finder
    text = finder.texts[str(finder.file)]
    chosen = choose_task(module, requested, finder.file, text, load.registrations)
    load.cls = chosen.cls
    task = _task(
        chosen.cls,
        chosen.env_id,
        finder.file,
        followed=True,
        others=chosen.others,
        alternatives=chosen.alternatives,
        robot=chosen.robot,
        replaced=load.registrations.replaced(),
        named_like_libraries=hidden_by_libraries(finder.file, finder.search_folder),
        **_source_fields(finder),
    )
    task = dataclasses.replace(task, default_kwargs={**task.default_kwargs, **chosen.kwargs})
    # A robot without a task is shown in ManiSkill's empty scene, whose limit of 200,000 steps is not an episode length.
    return task if task.robot is None else dataclasses.replace(task, max_episode_steps=None)


def _source_fields(finder: AuthorFinder) -> dict[str, Any]:
    return _fields(finder.texts, finder.file, finder.own_folder)


def _fields(source: Mapping[str, str], file: Path | None, folder: Path) -> dict[str, Any]:
    # The task's file first: in a package a helper may be read before it.
    files = sorted((Path(path) for path in source), key=lambda path: path != file)
    return {
        "source_files": tuple(files),
        "source": {str(path): source[str(path)] for path in files},
        "source_hash": source_hash(source, folder),
    }


# --- failed imports ------------------------------------------------------------------------------


def _import_problem(exc: BaseException, finder: AuthorFinder) -> Problem:
    """The problem for the author of the file whose import raised `exc`, with advice."""
    if isinstance(exc, TaskError):
        return exc.problem
    problem = problem_from_exception(exc, "import", [Path(path) for path in finder.texts])
    message = problem.message
    if isinstance(exc, FileNotFoundError) and exc.filename == str(finder.file) and problem.file is None:
        return missing_file(finder.file).problem  # deleted since it was found
    if isinstance(exc, registry.DuplicateName):
        message = str(exc)
    elif isinstance(exc, SystemExit):
        message = (
            f"the file ended the program (SystemExit: {exc.code}) while being imported; code that is only for "
            'running it as a script belongs under `if __name__ == "__main__":`'
        )
    elif isinstance(exc, ModuleNotFoundError) and exc.name:
        message = f"{message}; {_module_hint(exc.name, finder)}"
    elif isinstance(exc, ImportError) and (file := _named_like(exc.name, finder)) is not None:
        message = f"{message}; {named_like_library_text(file)}"
    elif isinstance(exc, ImportError) and (installed := _installed(exc.name)) is not None:
        message = (
            f"{message}; installed here is {installed}: use what it has, or install the version that the file was "
            "written for"
        )
    elif isinstance(exc, OSError) and exc.filename == str(finder.file) and problem.file is None:
        message = f"{finder.file} cannot be read: {exc.strerror}; is it being written just now?"
    if problem.file is None:
        # None of the author's code has run, but this is the file that cannot be loaded.
        problem = dataclasses.replace(problem, file=str(finder.file))
    return dataclasses.replace(problem, message=message)


def _named_module_problem(exc: BaseException, module: NamedModule) -> Problem:
    """The problem of `exc`, which the import of `module` by `import_module` raised."""
    problem = problem_from_exception(exc, "import", [module.file])
    message = f"{module.name} cannot be imported: {problem.message}"
    return dataclasses.replace(problem, message=message, file=problem.file or str(module.file))


def _named_like(name: str | None, finder: AuthorFinder) -> Path | None:
    """The author's file that has the same name as the library `name`."""
    top = (name or "").partition(".")[0]
    return next((file for file in files_named_like_libraries(finder.search_folder) if file.stem == top), None)


def _installed(name: str | None) -> str | None:
    """Name and version of the package (or Python) that the module `name` belongs to; None for an author's module."""
    top = (name or "").partition(".")[0]
    if top in sys.stdlib_module_names:
        return f"Python {platform.python_version()}"
    of = packages_distributions().get(top)
    return f"{of[0]} {version(of[0])}" if of else None


def _module_hint(name: str, finder: AuthorFinder) -> str:
    if (file := _named_like(name, finder)) is not None:
        return named_like_library_text(file)
    top = name.partition(".")[0]
    if Path(f"{top}.py").is_file() or Path(top, "__init__.py").is_file():
        return (
            f"{top} is in the folder where the command was started, which is not searched: move {top} into the task "
            "file's folder, or add the folder to PYTHONPATH"
        )
    siblings = [path.stem for path in finder.file.parent.glob("*.py") if path != finder.file]
    if finder.only_given and name.rpartition(".")[2] in siblings:
        return (
            f"{name} is in the file's folder, but not among the files that you approved; open {finder.file} by its name "
            "to run it with all files of its folder"
        )
    close = difflib.get_close_matches(name, siblings, n=1)
    if close:
        return f"there is {close[0]}.py in the file's folder"
    return f"it is neither in the file's folder nor installed for {sys.executable}"
