"""From what a person names (a file, a class in it or in a module, a registered id) to the task class.

A load is all or nothing. The file is executed afresh, with the modules beside it, and either gives
a class, or the process is as it was: the last good version's modules stand in ``sys.modules``
again (it may import lazily, while it runs on behind the banner), its classes in ManiSkill's
tables, its text in tracebacks. Whatever stands in the way, from a wrong path to ``exit()`` at the
end of a script, is a `TaskError` that says what to do, at the author's line where there is one.
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import inspect
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from workbench.authoring.loading import registry
from workbench.authoring.loading.import_problems import import_problem, named_module_problem
from workbench.authoring.loading.library_names import named_like_library, search_first, stop_guarding
from workbench.authoring.loading.modules import (
    AuthorFinder,
    ModuleName,
    SetAside,
    hidden_by_libraries,
    put_back,
    read_source,
    set_aside,
)
from workbench.authoring.loading.reference import (
    NamedModule,
    RecordedTask,
    TaskName,
    file_and_class,
    find_module,
    is_module_name,
    not_found,
    split_reference,
)
from workbench.authoring.loading.task_classes import Robot, choose_task, no_such_class, shown_in_a_scene
from workbench.authoring.loading.task_content import source_hash
from workbench.authoring.problem import TaskError, is_ctrl_c, refused

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
    """The task's file first, then the modules beside it that it imported."""
    source: dict[str, str]
    """Path to the text that was executed, for each of `source_files`."""
    source_hash: str
    """sha256 over `source`, 12 hex digits; the same wherever the files lie."""
    max_episode_steps: int | None
    default_kwargs: dict[str, Any]
    """What ``@register_env`` was given for the class's constructor."""
    followed: bool
    """True for a file that is to be followed; False for an id that was registered elsewhere."""
    others: tuple[str, ...] = ()
    """Further task classes of the file, and robots if it has no task, to be had as ``file.py:Name``."""
    alternatives: tuple[str, ...] = ()
    """Those that may be opened in its place if it fails, in the order of trying; none where a class was named."""
    in_place_of: RefusedClass | None = None
    """What was tried first, and failed."""
    robot: Robot | None = None
    """Of a file that has no task: the one that is shown in a scene of ManiSkill's."""
    replaced_ids: tuple[str, ...] = ()
    """Ids that belonged to somebody else (``PickCube-v1``): plain ManiSkill would have skipped this
    file's class under them."""
    named_like_libraries: tuple[Path, ...] = ()
    """Files in the folder that it imports from, and that no import finds there."""

    @property
    def chosen(self) -> str:
        """The name in the file of what is open: a task class, or a robot's."""
        return self.class_name if self.robot is None else self.robot.class_name

    @property
    def asset_ids(self) -> tuple[str, ...]:
        """What it was registered to need, and has to be downloaded."""
        spec = registry.environment(self.env_id)
        return () if spec is None else tuple(spec.asset_download_ids or ())

    @property
    def notices(self) -> tuple[str, ...]:
        """What its author should know although it works, in sentences."""
        found = [named_like_library(file) for file in self.named_like_libraries]
        if self.in_place_of is not None:
            name, why = self.in_place_of.name, self.in_place_of.why
            found.append(f"{name} was tried first and failed ({why}): {self.chosen} is open in its place.")
        if self.robot is not None and self.file is not None:
            found.append(shown_in_a_scene(self.robot, self.file))
        if self.replaced_ids:
            ids = ", ".join(self.replaced_ids)
            found.append(
                f"{self.file} registers {ids}, which belonged to another task: here it is this file's class from now "
                "on, and plain ManiSkill would skip that class. Register another id to have both."
            )
        return tuple(found)


@dataclass
class _Load:
    finder: AuthorFinder
    registrations: registry.Registrations
    before: _Load | None
    """The load of the same file that this one replaced."""
    aside: SetAside | None
    """What stood in ``sys.modules`` before it; None once another load has built on this one."""
    cls: type[BaseEnv] | None = None
    """What it gave."""


_loads: dict[Path, _Load] = {}
"""The last good load of each file. ``sys.modules`` and the registries are of the process, so this is."""


def load_task(reference: TaskName, source: Mapping[str, str] | None = None) -> LoadedTask:
    """Import the task that `reference` names: ``file.py``, ``file.py:ClassName``, ``package.module:ClassName`` or an id.

    What a recording names (`RecordedTask`) is a registered id, or texts that a person agreed to; no path out of a
    recording is followed.

    `source` gives, by path, texts to use in place of what is on disk, for the task's file and for
    modules beside it; files in it need not exist. Raises `TaskError`, and lets a person's Ctrl-C
    through; in either case all is as it was before.
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
        _check_file(file)
    return _load_file(file, class_name, given)


def with_late_imports(task: LoadedTask) -> LoadedTask:
    """`task` with those modules added that it has imported since, inside its hooks."""
    load = _load_of(task)
    return task if load is None else dataclasses.replace(task, **_source_fields(load.finder))


def take_back(task: LoadedTask) -> bool:
    """Undo the load that gave `task`, as if it had failed: for a class that imports but cannot be built.

    Only the newest load can be taken back; False for any other, and for a task that is not followed.
    """
    load = _load_of(task)
    if load is None or load.aside is None or sys.modules.get(load.finder.main) is None:
        return False
    if load.cls is not task.cls:
        return False
    _revert(load)
    return True


def _load_of(task: LoadedTask) -> _Load | None:
    return _loads.get(task.file) if task.followed and task.file is not None else None


def _load_recorded(task: RecordedTask, source: Mapping[str, str]) -> LoadedTask:
    if task.approved is None:
        # A file that was asked about and not approved is not here; `env_id` may look like a path, and is none.
        if registry.environment(task.env_id) is None:
            raise refused(
                f"a recording names the task {task.env_id!r}, and no installed package registers one of that id. {IMPORT_HINT}"
            )
        return _registered(task.env_id)
    if task.file is None or task.file not in task.approved:
        raise refused(f"the texts that were agreed to do not hold the file of {task.env_id}")
    return _load_file(Path(task.file), task.class_name, {**task.approved, **source}, only_given=True)


def import_module(name: str) -> ModuleType:
    """Import a module that a person named, as Python does it; see `reference` for where it is looked for.

    Raises TaskError.
    """
    if name in sys.modules:
        return sys.modules[name]
    found = find_module(name)
    if found is None:
        raise refused(not_found(name))
    if found.search_folder is not None and str(found.search_folder) not in sys.path:
        search_first(found.search_folder, for_good=True)
    try:
        return importlib.import_module(name)
    except BaseException as exc:
        if is_ctrl_c(exc):
            raise
        raise TaskError(named_module_problem(exc, found)) from exc


def import_modules(names: Sequence[str]) -> None:
    """Import what a person named with ``--import``, for the ids that it registers. Raises TaskError."""
    for name in names:
        import_module(name)


def class_of_module(name: str, class_name: str) -> type[BaseEnv]:
    """A task class of a module that is imported as Python does it. Raises TaskError."""
    module = import_module(name)
    cls = getattr(module, class_name, None)
    if not isinstance(cls, type) or not registry.is_task(cls):
        names = [value.__name__ for value in vars(module).values() if registry.is_task(value)]
        raise no_such_class(class_name, cls, name, Path(module.__file__ or name), names)
    return cls


def _load_named(name: str, class_name: str, given: dict[str, str]) -> LoadedTask:
    """``package.module:ClassName``: as its file is loaded, with the package's modules beside it.

    A library's module is imported as it is: nobody edits it, and others have its classes.
    """
    found = find_module(name)
    if found is None:
        raise refused(not_found(name))
    place = _place_of(found)
    if place is None:
        cls = class_of_module(name, class_name)
        return dataclasses.replace(task_of_class(cls, registry.id_of(cls) or class_name), followed=False)
    task = _load_file(found.file, class_name, given, named=place)
    home = sys.modules[task.cls.__module__]
    file = Path(home.__file__ or found.file)
    if file == found.file or str(file) not in task.source:
        return task
    # A package imports its tasks from the modules in which they are written: there is what is edited and followed.
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
    # Of a package that was named everything is read again, the module in which its task is written too.
    package = None if named is None else named.own_folder
    others = {
        load.finder.main
        for path, load in _loads.items()
        if path != file and not (package is not None and path.is_relative_to(package))
    }
    load = _begin(finder, set_aside(finder, others.__contains__))
    with registry.registering(finder.texts.__contains__, load.registrations):
        try:
            module = importlib.import_module(finder.main)
            task = _task_in(module, class_name, load)
        except BaseException as exc:
            # Before anything is put back: the problem's lines are those of the text that failed.
            problem = None if is_ctrl_c(exc) else import_problem(exc, finder)
            _revert(load)
            if problem is None:
                raise
            raise TaskError(problem) from exc
    for earlier in _loads.values():
        if earlier is not load:
            earlier.aside = None
    # With them would live every version there ever was.
    if load.before is not None:
        load.before.aside = load.before.before = None
    return task


def _begin(finder: AuthorFinder, aside: SetAside) -> _Load:
    before = _loads.get(finder.file)
    if before is not None:
        before.registrations.undo()
        sys.meta_path.remove(before.finder)
    if not finder.only_given:
        search_first(finder.search_folder)
    sys.meta_path.insert(0, finder)
    # A helper that was created a moment ago is not in the listing of its folder that Python keeps.
    importlib.invalidate_caches()
    _loads[finder.file] = load = _Load(finder, registry.Registrations(), before, aside)
    return load


def _revert(load: _Load) -> None:
    assert load.aside is not None
    load.registrations.undo()
    sys.meta_path.remove(load.finder)
    put_back(load.aside, load.finder)
    if load.before is None:
        del _loads[load.finder.file]
        if not _loads:
            stop_guarding()
    else:
        load.before.registrations.redo()
        sys.meta_path.insert(0, load.before.finder)
        _loads[load.finder.file] = load.before


# --- the reference -------------------------------------------------------------------------------


def _parse(reference: str) -> tuple[Path, str | None]:
    """File and class of what is no registered id."""
    if not reference.strip():
        raise refused(
            "no task named; give a .py file, file.py:ClassName, or a registered id like PickCube-v1"
        )
    path, name = file_and_class(reference)
    if name is not None and not _exists(reference):
        if not name.isidentifier():
            raise refused(f"{reference!r}: after the colon comes the name of a class, as in push.py:PushEnv")
        return _resolve(path), name
    if is_module_name(reference) and not _exists(reference) and find_module(reference) is not None:
        raise refused(f"{reference} is a module: name the class in it too, as in {reference}:MyTask")
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
    except (OSError, ValueError):  # a name too long, or with a null byte in it
        return False


def _resolve(path: str | Path) -> Path:
    try:
        return Path(path).expanduser().resolve()
    except (OSError, RuntimeError, ValueError) as exc:  # no such user's home; a loop of links; a null byte
        raise refused(f"{str(path)!r} is not a path that can be opened: {exc}") from exc


def _check_file(file: Path) -> None:
    try:
        if file.is_dir():
            names = sorted(path.name for path in file.glob("*.py"))[:5]
            inside = f", for example {' or '.join(names)}" if names else " (there is none in it)"
            raise refused(f"{file} is a folder; name a .py file in it{inside}")
        if not file.exists():
            raise _missing(file)
        if not file.is_file():
            # A pipe, say: reading it would wait for ever. A device, which a link may lead to, may have no end.
            raise refused(f"{file} is not an ordinary file")
        if file.suffix != ".py":
            raise refused(
                f"{file} is not a .py file; a task is one Python file with a class that inherits BaseEnv"
            )
    except OSError as exc:
        raise refused(f"cannot look at the file ({exc.strerror}): {file}") from exc


def _missing(file: Path) -> TaskError:
    if not file.parent.is_dir():
        return refused(f"{file} does not exist, nor does its folder {file.parent}")
    names = difflib.get_close_matches(file.name, [path.name for path in file.parent.glob("*.py")], n=3)
    hint = f"; did you mean {' or '.join(names)}?" if names else ""
    return refused(f"{file} does not exist{hint}")


def _unknown_id(env_id: str) -> TaskError:
    if registry.is_other_gymnasium_id(env_id):
        return refused(f"{env_id} is a gymnasium environment, but not one of ManiSkill's (no BaseEnv)")
    ids = {known.lower(): known for known in registry.environment_ids()}
    close = [ids[name] for name in difflib.get_close_matches(env_id.lower(), list(ids), n=3)]
    hint = (
        f"did you mean {' or '.join(close)}?" if close else "give a .py file, or an id such as PickCube-v1."
    )
    return refused(f"no task is registered as {env_id!r}, and there is no such file; {hint} {IMPORT_HINT}")


IMPORT_HINT = (
    "An id that a package of yours registers is known once that is imported: --import PACKAGE on the command line, "
    "`import package` before workbench.make."
)


# --- the class -----------------------------------------------------------------------------------


def task_of_class(cls: type[BaseEnv], env_id: str) -> LoadedTask:
    """What is known of a class that is there already, under whatever id it goes.

    If it came from a file that `load_task` read, with the texts that were executed; else with those on disk.
    """
    for load in _loads.values():
        # A class of others that the file only imports has its own file.
        registered = any(made.cls is cls and made.name == env_id for made in load.registrations.made)
        if registered or cls.__module__ in load.finder.names:
            return _task(cls, env_id, load.finder.file, followed=True, **_source_fields(load.finder))
    # Of a class made without a file (in a notebook, or by type()), and of one that is shipped as bytecode only,
    # there is no text to keep.
    with suppress(TypeError, OSError, SyntaxError):
        file = Path(inspect.getsourcefile(cls) or "").resolve()
        return _task(cls, env_id, file, **_fields({str(file): read_source(file)}, file, file.parent))
    return _task(cls, env_id, None, **_fields({}, None, Path()))


def _task(
    cls: type[BaseEnv], env_id: str | None, file: Path | None, followed: bool = False, **known: Any
) -> LoadedTask:
    spec = None if env_id is None else registry.environment(env_id)
    limit, kwargs = (None, {}) if spec is None else (spec.max_episode_steps, dict(spec.default_kwargs))
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


def _task_in(module: ModuleType, wanted: str | None, load: _Load) -> LoadedTask:
    finder = load.finder
    text = finder.texts[str(finder.file)]
    chosen = choose_task(module, wanted, finder.file, text, load.registrations)
    load.cls = chosen.cls
    task = _task(
        chosen.cls,
        chosen.env_id,
        finder.file,
        followed=True,
        others=chosen.others,
        alternatives=chosen.alternatives,
        robot=chosen.robot,
        replaced_ids=load.registrations.replaced_names(),
        named_like_libraries=hidden_by_libraries(finder.file, finder.search_folder),
        **_source_fields(finder),
    )
    return dataclasses.replace(task, default_kwargs={**task.default_kwargs, **chosen.kwargs})


def _source_fields(finder: AuthorFinder) -> dict[str, Any]:
    return _fields(finder.texts, finder.file, finder.own_folder)


def _fields(source: Mapping[str, str], file: Path | None, folder: Path) -> dict[str, Any]:
    # A helper may have been read first, where the file is part of a package.
    files = sorted((Path(path) for path in source), key=lambda path: path != file)
    return {
        "source_files": tuple(files),
        "source": {str(path): source[str(path)] for path in files},
        "source_hash": source_hash(source, folder),
    }
