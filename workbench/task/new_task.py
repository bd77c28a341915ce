"""Writes a new task into the user's folder, from a template (an example task) or an installed task."""

from __future__ import annotations

import ast
import difflib
import importlib.util
import keyword
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import chain, count
from pathlib import Path
from typing import Literal

from workbench.machine.files import create_file, read_regular_file, replace_file
from workbench.machine.folders import example_tasks
from workbench.machine.parse_python import parse_python
from workbench.task.copy import CannotCopy, NewNames, copied_text, registrations_in
from workbench.task.find import find_task_files, read_task_file
from workbench.task.library_names import is_library
from workbench.task.modules import read_exactly

TemplateName = Literal["minimal", "tabletop", "articulated", "multi-robot", "locomotion"]
MAX_NAME_CHARACTERS = 60
_MAX_BLANK_BYTES = 64 * 1024
"""Maximum size of a file that counts as blank."""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_WORD = re.compile(r"[A-Za-z0-9]+")


@dataclass(frozen=True)
class Template:
    """An example that a new task can start from."""

    name: TemplateName
    """Name for ``workbench new --from``."""
    example: str
    """File name of the template among the examples."""
    about: str


TEMPLATES = (
    Template("minimal", "minimal.py", "the smallest task: a robot, a cube, and a condition for success"),
    Template("tabletop", "push_cube.py", "a whole task on a table: reward, cameras, observations, fail"),
    Template("articulated", "articulated.py", "a drawer that is built in code, and pulled open"),
    Template("multi-robot", "two_robots.py", "two arms that lift one bar together"),
    Template("locomotion", "locomotion.py", "a four-legged robot that walks, rewarded at each step"),
)


@dataclass(frozen=True)
class NewTask:
    """A task that was written."""

    file: Path
    env_id: str
    class_name: str
    is_default: bool
    """Whether the file alone opens this class; else the reference must name the class."""

    @property
    def reference(self) -> str:
        """Argument of ``workbench open`` in the folder of the file."""
        return self.file.name if self.is_default else f"{self.file.name}:{self.class_name}"


class CannotBegin(ValueError):
    """No task was written; the message is a sentence with advice."""


def write_new_task(name: str, origin: str, folder: Path) -> NewTask:
    """Write ``NAME.py`` into a folder.

    Args:
        name: name of the file, which gives the class and the id: ``stack_two`` gives ``StackTwoEnv`` and ``StackTwo-v1``.
        origin: a template's name, or the id of a ManiSkill task.

    Raises:
        CannotBegin: nothing was written.
    """
    _check_name(name, folder)
    file = folder / f"{name}.py"
    text, encoding, made = _new_text(file, camel_case(name), origin)
    try:
        created = create_file(file, text.encode(encoding))
    except OSError as error:
        raise CannotBegin(f"{file} cannot be written: {error.strerror}.") from error
    if not created:
        raise CannotBegin(_taken(file))
    return made


def is_blank(file: Path) -> bool:
    """Whether a file contains only comments and blank lines; False if it cannot be read."""
    return _blank_content(file) is not None


def fill_blank_file(file: Path) -> None:
    """Write the first template into a file that contains only comments and blank lines, which stay above it.

    The file's name gives the class and the id; if another task has that id, the prefix ``My`` is added.

    Raises:
        CannotBegin: the file is unchanged.
    """
    content = _blank_content(file)
    if content is None:
        raise CannotBegin(f"{file.name} is no longer empty, and was not overwritten.")
    name, owners = camel_case(file.stem), _owners_of_ids(file)
    names = chain([name, f"My{name}"], (f"My{name}{number}" for number in count(2)))
    text, _, _ = _new_text(
        file, next(name for name in names if f"{name}-v1" not in owners), TEMPLATES[0].name
    )
    above = content.rstrip()
    try:
        done = replace_file(file, (above + b"\n\n" if above else b"") + text.encode(), expected=content)
    except OSError as error:
        raise CannotBegin(f"{file} cannot be written: {error.strerror}.") from error
    if not done:
        raise CannotBegin(f"{file.name} was saved meanwhile, and was not overwritten.")


def _blank_content(file: Path) -> bytes | None:
    try:
        content = read_regular_file(file, _MAX_BLANK_BYTES)
        lines = content.decode().splitlines()
    except (OSError, ValueError):
        return None
    return content if all(not line.strip() or line.lstrip().startswith("#") for line in lines) else None


def why_not_name(name: str, folder: Path) -> str:
    """Why a new task cannot have this name, as a sentence; empty if it can."""
    try:
        _check_name(name, folder)
        _check_id(f"{camel_case(name)}-v1", folder / f"{name}.py")
    except CannotBegin as error:
        return str(error)
    return ""


def _check_name(name: str, folder: Path) -> None:
    if not _NAME.fullmatch(name) or len(name) > MAX_NAME_CHARACTERS or keyword.iskeyword(name):
        words = _WORD.findall(name.removesuffix(".py"))
        better = "_".join(words)[:MAX_NAME_CHARACTERS]
        if not _NAME.fullmatch(better) or keyword.iskeyword(better):
            better = "stack_two"
        raise CannotBegin(
            f"{name[:MAX_NAME_CHARACTERS]!r} cannot be the name of a task: use letters, digits and underscores, at most "
            f"{MAX_NAME_CHARACTERS}, with a letter first, such as {better}."
        )
    if (folder / f"{name}.py").exists():
        raise CannotBegin(_taken(folder / f"{name}.py"))
    if is_library(name):
        raise CannotBegin(
            f"{name} is the name of a library, and no import would find {name}.py: use another name, such as {name}_task."
        )


def _taken(file: Path) -> str:
    return f"{file.name} exists already and is not overwritten: use another name, or move the file."


def camel_case(name: str) -> str:
    """A name in camel case: ``stack_two`` becomes ``StackTwo``. The prefix ``Task`` is added if the result
    would not begin with a letter."""
    joined = "".join(word[0].upper() + word[1:] for word in _WORD.findall(name))
    return joined if joined[:1].isalpha() else f"Task{joined}"


def _new_text(file: Path, bare: str, origin: str) -> tuple[str, str, NewTask]:
    """Text and encoding of a new task whose names begin with `bare`, and its description."""
    env_id = f"{bare}-v1"
    class_name = bare if bare.endswith("Env") else f"{bare}Env"
    template = next((one for one in TEMPLATES if one.name == origin), None)
    installed = maniskill_ids()
    _check_id(env_id, file)
    if template is None and origin not in installed:
        names = [one.name for one in TEMPLATES]
        close = difflib.get_close_matches(origin, [*names, *installed], 1, 0.5)
        more = f" Did you mean {close[0]}?" if close else ""
        raise CannotBegin(
            f"There is neither a template nor a ManiSkill task named {origin!r}: use {', '.join(names)}, or an id such "
            f"as PickCube-v1.{more}"
        )
    source = installed[origin] if template is None else _example(template)
    try:
        _, text, encoding = read_exactly(source)
    except (OSError, SyntaxError) as error:
        raise CannotBegin(f"{source} cannot be read: {error}.") from error
    known = [
        (cls.name, uid.value)
        for cls, _, uid in registrations_in(parse_python(text))
        if isinstance(uid, ast.Constant) and isinstance(uid.value, str)
    ]
    ids = {uid: f"{bare}{uid}" for _, uid in known}
    if template is not None:
        origin = known[-1][1]
    ids[origin] = env_id
    old_class = next(cls for cls, uid in known if uid == origin)
    try:
        text, _ = copied_text(source, text, names=NewNames(ids, {old_class: class_name}))
    except CannotCopy as error:
        raise CannotBegin(f"{origin} cannot be copied: {error}.") from error
    return text, encoding, NewTask(file, env_id, class_name, known[-1][0] == old_class)


def _owners_of_ids(file: Path) -> dict[str, str]:
    """What already has each id: ManiSkill, or the name of an example or of another file in the folder."""
    here = [path for path in sorted(file.parent.glob("*.py")) if path != file]
    owners = dict.fromkeys(maniskill_ids(), "ManiSkill")
    for path in (*example_tasks(), *here):
        task = read_task_file(path)
        owners.update(dict.fromkeys(() if task is None else task.ids, path.name))
    return owners


def _check_id(env_id: str, file: Path) -> None:
    owners = _owners_of_ids(file)
    if env_id in owners:
        raise CannotBegin(
            f"The task would register {env_id}, which is already an id of {owners[env_id]}: use another name, such as "
            f"my_{file.stem}."
        )


def _example(template: Template) -> Path:
    for file in example_tasks():
        if file.name == template.example:
            return file
    raise CannotBegin(f"The example {template.example} is missing: install the workbench again.")


@cache
def maniskill_ids() -> Mapping[str, Path]:
    """File of each id of the installed ManiSkill, found by parsing; nothing is imported. Empty without ManiSkill."""
    spec = importlib.util.find_spec("mani_skill")
    folders = [] if spec is None else spec.submodule_search_locations or ()
    return {
        uid: task.path
        for folder in folders
        for task in find_task_files(Path(folder) / "envs").files
        for uid in task.ids
    }
