"""From what a person names (a file, a class in it, a registered id) to the task class.

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
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from workbench.authoring import registry
from workbench.authoring.library_names import (
    files_named_like_libraries,
    named_like_library,
    search_first,
    stop_guarding,
)
from workbench.authoring.modules import (
    AuthorFinder,
    SetAside,
    hidden_by_libraries,
    put_back,
    read_source,
    set_aside,
)
from workbench.authoring.problem import Problem, TaskError, problem_from_exception, shorten
from workbench.authoring.reference import RecordedTask, TaskName

if TYPE_CHECKING:
    from mani_skill.envs.sapien_env import BaseEnv

_FILE_AND_CLASS = re.compile(r"(?P<file>.+\.py):(?P<cls>[^/\\]*)", re.DOTALL)


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
    """Further task classes of the file, to be had as ``file.py:Name``."""
    replaced_ids: tuple[str, ...] = ()
    """Ids that belonged to somebody else (``PickCube-v1``): plain ManiSkill would have skipped this
    file's class under them."""
    named_like_libraries: tuple[Path, ...] = ()
    """Files in the folder that it imports from, and that no import finds there."""

    @property
    def notices(self) -> tuple[str, ...]:
        """What its author should know although it works, in sentences."""
        found = [named_like_library(file) for file in self.named_like_libraries]
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


_loads: dict[Path, _Load] = {}
"""The last good load of each file. ``sys.modules`` and the registries are of the process, so this is."""


def load_task(reference: TaskName, source: Mapping[str, str] | None = None) -> LoadedTask:
    """Import the task that `reference` names: ``file.py``, ``file.py:ClassName`` or a registered id.

    What a recording names (`RecordedTask`) is a registered id, or texts that a person agreed to; no path out of a
    recording is followed.

    `source` gives, by path, texts to use in place of what is on disk, for the task's file and for
    modules beside it; files in it need not exist. Raises `TaskError`, and lets KeyboardInterrupt
    through; in either case all is as it was before.
    """
    if isinstance(reference, RecordedTask):
        return _load_recorded(reference, source or {})
    file, class_name = _parse(reference)
    if file is None:
        return _registered(reference)
    given = {str(_resolve(path)): text for path, text in (source or {}).items()}
    if str(file) not in given:
        _check_file(file)
    return _load_file(file, class_name, given)


def with_late_imports(task: LoadedTask) -> LoadedTask:
    """`task` with those modules added that it has imported since, inside its hooks."""
    load = None if task.file is None or not task.followed else _loads.get(task.file)
    return task if load is None else dataclasses.replace(task, **_source_fields(load.finder))


def take_back(task: LoadedTask) -> bool:
    """Undo the load that gave `task`, as if it had failed: for a class that imports but cannot be built.

    Only the newest load can be taken back; False for any other, and for a task that is not followed.
    """
    load = None if task.file is None or not task.followed else _loads.get(task.file)
    if load is None or load.aside is None or sys.modules.get(load.finder.main) is None:
        return False
    if vars(sys.modules[load.finder.main]).get(task.class_name) is not task.cls:
        return False
    _revert(load)
    return True


def source_hash(source: Mapping[str, str], folder: Path) -> str:
    """sha256 over names relative to `folder` and texts, 12 hex digits."""
    digest = sha256()
    for path in sorted(source):
        name = Path(path).relative_to(folder).as_posix() if Path(path).is_relative_to(folder) else path
        for part in (name.encode(), source[path].encode("utf-8", "surrogatepass")):
            digest.update(len(part).to_bytes(8, "big") + part)
    return digest.hexdigest()[:12]


def _load_recorded(task: RecordedTask, source: Mapping[str, str]) -> LoadedTask:
    if task.approved is None:
        # A file that was asked about and not approved is not here; `env_id` may look like a path, and is none.
        if registry.environment(task.env_id) is None:
            raise _refused(
                f"a recording names the task {task.env_id!r}, and no installed package registers one of that id"
            )
        return _registered(task.env_id)
    if task.file is None or task.file not in task.approved:
        raise _refused(f"the texts that were agreed to do not hold the file of {task.env_id}")
    return _load_file(Path(task.file), task.class_name, {**task.approved, **source}, only_given=True)


def _load_file(
    file: Path, class_name: str | None, given: dict[str, str], only_given: bool = False
) -> LoadedTask:
    finder = AuthorFinder(file, given, only_given)
    others = {load.finder.main for path, load in _loads.items() if path != file}
    load = _begin(finder, set_aside(finder, others.__contains__))
    with registry.registering(finder.texts.__contains__, load.registrations):
        try:
            module = importlib.import_module(finder.main)
            task = _choose(module, class_name, finder, load.registrations)
        except BaseException as exc:
            # Before anything is put back: the problem's lines are those of the text that failed.
            problem = None if isinstance(exc, KeyboardInterrupt) else _import_problem(exc, finder)
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


def _parse(reference: str) -> tuple[Path | None, str | None]:
    """File and class of `reference`; (None, None) for a registered id."""
    if not reference.strip():
        raise _refused(
            "no task named; give a .py file, file.py:ClassName, or a registered id like PickCube-v1"
        )
    if registry.environment(reference) is not None:
        return None, None
    match = _FILE_AND_CLASS.fullmatch(reference)
    if match is not None and not _exists(reference):
        name = match["cls"]
        if not name.isidentifier():
            raise _refused(f"{reference!r}: after the colon comes the name of a class, as in push.py:PushEnv")
        return _resolve(match["file"]), name
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
        raise _refused(f"{str(path)!r} is not a path that can be opened: {exc}") from exc


def _check_file(file: Path) -> None:
    try:
        if file.is_dir():
            names = sorted(path.name for path in file.glob("*.py"))[:5]
            inside = f", for example {' or '.join(names)}" if names else " (there is none in it)"
            raise _refused(f"{file} is a folder; name a .py file in it{inside}")
        if not file.exists():
            raise _missing(file)
        if not file.is_file():
            # A pipe, say: reading it would wait for ever. A device, which a link may lead to, may have no end.
            raise _refused(f"{file} is not an ordinary file")
        if file.suffix != ".py":
            raise _refused(
                f"{file} is not a .py file; a task is one Python file with a class that inherits BaseEnv"
            )
    except OSError as exc:
        raise _refused(f"cannot look at the file ({exc.strerror}): {file}") from exc


def _missing(file: Path) -> TaskError:
    if not file.parent.is_dir():
        return _refused(f"{file} does not exist, nor does its folder {file.parent}")
    names = difflib.get_close_matches(file.name, [path.name for path in file.parent.glob("*.py")], n=3)
    hint = f"; did you mean {' or '.join(names)}?" if names else ""
    return _refused(f"{file} does not exist{hint}")


def _unknown_id(env_id: str) -> TaskError:
    if registry.is_other_gymnasium_id(env_id):
        return _refused(f"{env_id} is a gymnasium environment, but not one of ManiSkill's (no BaseEnv)")
    ids = {known.lower(): known for known in registry.environment_ids()}
    close = [ids[name] for name in difflib.get_close_matches(env_id.lower(), list(ids), n=3)]
    hint = f"did you mean {' or '.join(close)}?" if close else "give a .py file, or an id such as PickCube-v1"
    return _refused(f"no task is registered as {env_id!r}, and there is no such file; {hint}")


def _refused(message: str, file: Path | None = None) -> TaskError:
    return TaskError(Problem("import", shorten(message), None if file is None else str(file), None, None, ""))


# --- the class -----------------------------------------------------------------------------------


def task_of_class(cls: type[BaseEnv], env_id: str) -> LoadedTask:
    """What is known of a class that is there already, under whatever id it goes.

    If it came from a file that `load_task` read, with the texts that were executed; else with those on disk.
    """
    spec = registry.environment(env_id)
    limit, kwargs = (None, {}) if spec is None else (spec.max_episode_steps, dict(spec.default_kwargs))
    for load in _loads.values():
        if vars(sys.modules.get(load.finder.main, object)).get(cls.__name__) is cls:
            fields = _source_fields(load.finder)
            return LoadedTask(
                cls, env_id, cls.__name__, load.finder.file, **fields, max_episode_steps=limit,
                default_kwargs=kwargs, followed=True,
            )  # fmt: skip
    source: dict[str, str] = {}
    try:
        name = inspect.getsourcefile(cls)
    except (TypeError, OSError):  # a class made without a file: in a notebook, or by type()
        name = None
    if name is not None:
        file = Path(name).resolve()
        try:
            source[str(file)] = read_source(file)
        except (OSError, SyntaxError):  # shipped as bytecode only: it runs, but there is no text to keep
            name = None
    files = tuple(Path(path) for path in source)
    return LoadedTask(
        cls=cls,
        env_id=env_id,
        class_name=cls.__name__,
        file=files[0] if files else None,
        source_files=files,
        source=source,
        source_hash=source_hash(source, files[0].parent if files else Path()),
        max_episode_steps=limit,
        default_kwargs=kwargs,
        followed=False,
    )


def _registered(env_id: str) -> LoadedTask:
    spec = registry.environment(env_id)
    assert spec is not None
    return dataclasses.replace(task_of_class(spec.cls, env_id), followed=False)


def _choose(
    module: ModuleType, wanted: str | None, finder: AuthorFinder, registrations: registry.Registrations
) -> LoadedTask:
    """The wanted class, or the one defined last, registered classes before others."""
    file = str(finder.file)
    defined = [
        value
        for value in vars(module).values()
        if registry.is_task(value) and value.__module__ == module.__name__
    ]
    registered = {
        made.cls: made.name for made in registrations.made if made.file == file and registry.is_task(made.cls)
    }
    # Registered ones last, in the order of their registration: the last of all is the default.
    candidates = [cls for cls in dict.fromkeys(defined) if cls not in registered] + list(registered)
    if wanted is not None:
        cls = next(
            (cls for cls in reversed(candidates) if cls.__name__ == wanted), getattr(module, wanted, None)
        )
        if not registry.is_task(cls):
            raise _no_such_class(wanted, cls, finder, [cls.__name__ for cls in candidates])
    elif candidates:
        cls = candidates[-1]
    else:
        raise _no_class(module, finder)
    assert isinstance(cls, type)
    env_id = registered.get(cls)
    spec = None if env_id is None else registry.environment(env_id)
    return LoadedTask(
        cls=cls,
        env_id=env_id or cls.__name__,
        class_name=cls.__name__,
        file=finder.file,
        max_episode_steps=None if spec is None else spec.max_episode_steps,
        default_kwargs={} if spec is None else dict(spec.default_kwargs),
        followed=True,
        others=tuple(other.__name__ for other in candidates if other is not cls),
        replaced_ids=registrations.replaced_names(),
        named_like_libraries=hidden_by_libraries(finder.file),
        **_source_fields(finder),
    )


def _source_fields(finder: AuthorFinder) -> dict[str, Any]:
    source = dict(finder.texts)
    # A helper may have been read first, where the file is part of a package.
    files = sorted((Path(path) for path in source), key=lambda path: path != finder.file)
    return {
        "source_files": tuple(files),
        "source": {str(path): source[str(path)] for path in files},
        "source_hash": source_hash(source, finder.file.parent),
    }


def _no_such_class(wanted: str, found: object, finder: AuthorFinder, names: list[str]) -> TaskError:
    name = finder.file.name
    if found is not None:
        return _refused(f"{wanted} in {name} is not a class that inherits BaseEnv", finder.file)
    close = difflib.get_close_matches(wanted, names, n=1)
    hint = f"did you mean {close[0]}?" if close else f"it has {', '.join(names) or 'no task class at all'}"
    return _refused(f"there is no class {wanted} in {name}; {hint}", finder.file)


def _no_class(module: ModuleType, finder: AuthorFinder) -> TaskError:
    name = finder.file.name
    if not finder.texts[str(finder.file)].strip():
        return _refused(f"{name} is empty; a task is a class that inherits BaseEnv", finder.file)
    imported = [value for value in vars(module).values() if registry.is_task(value)]
    if imported:
        cls = imported[-1]
        hint = f"{cls.__name__} is imported from {cls.__module__}: name that file, or inherit from it here"
    else:
        hint = (
            "write `class MyTask(BaseEnv):` with BaseEnv from mani_skill.envs.sapien_env, or begin from "
            "tasks/minimal.py"
        )
    return _refused(f"no class in {name} inherits BaseEnv; {hint}", finder.file)


# --- what went wrong -----------------------------------------------------------------------------


def _import_problem(exc: BaseException, finder: AuthorFinder) -> Problem:
    if isinstance(exc, TaskError):
        return exc.problem
    problem = problem_from_exception(exc, "import", [Path(path) for path in finder.texts])
    message = problem.message
    if isinstance(exc, registry.DuplicateName):
        message = str(exc)
    elif isinstance(exc, SystemExit):
        message = (
            f"the file ended the program (SystemExit: {exc.code}) while being imported; what is only for "
            'running it as a script belongs under `if __name__ == "__main__":`'
        )
    elif isinstance(exc, ModuleNotFoundError) and exc.name:
        message = f"{message}; {_module_hint(exc.name, finder)}"
    elif isinstance(exc, ImportError) and (file := _named_like(exc.name, finder)) is not None:
        message = f"{message}; {named_like_library(file)}"
    elif isinstance(exc, OSError) and exc.filename == str(finder.file) and problem.file is None:
        message = f"{finder.file} cannot be read: {exc.strerror}; is it being written just now?"
    if problem.file is None:
        # Nothing of the author's ran yet, but it is this file that cannot be had.
        problem = dataclasses.replace(problem, file=str(finder.file))
    return dataclasses.replace(problem, message=message)


def _named_like(name: str | None, finder: AuthorFinder) -> Path | None:
    """The author's file that was meant, where a library has its name."""
    top = (name or "").partition(".")[0]
    return next((file for file in files_named_like_libraries(finder.search_folder) if file.stem == top), None)


def _module_hint(name: str, finder: AuthorFinder) -> str:
    if (file := _named_like(name, finder)) is not None:
        return named_like_library(file)
    top = name.partition(".")[0]
    if Path(f"{top}.py").is_file() or Path(top, "__init__.py").is_file():
        return (
            f"there is one in the folder where the command was started, which is not searched: move {top} beside the "
            "file, or name its folder in PYTHONPATH"
        )
    beside = [path.stem for path in finder.file.parent.glob("*.py") if path != finder.file]
    if finder.only_given and name.rpartition(".")[2] in beside:
        return (
            f"{name} lies beside the file, but was not among what you were asked about; open {finder.file} by its name "
            "to run it with all that lies beside it"
        )
    close = difflib.get_close_matches(name, beside, n=1)
    if close:
        return f"there is {close[0]}.py beside the file"
    return f"neither beside the file nor installed for {sys.executable}"
