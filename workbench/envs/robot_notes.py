"""Adds notes to robot-loading errors: line and link in the robot's file, and the line of the class that names
the file."""

from __future__ import annotations

import ast
import difflib
import inspect
import textwrap
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from traceback import walk_tb
from types import FrameType
from typing import Any
from xml.parsers.expat import ExpatError, ParserCreate

import mani_skill
import sapien
from mani_skill.agents import base_agent
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers.base_controller import BaseController
from mani_skill.agents.multi_agent import MultiAgent

from workbench.envs.broken_rule import in_brackets, place_of_class
from workbench.envs.error_notes import CoreRefusal, ErrorNote, Place, chain_of
from workbench.machine.parse_python import parse_python

_LOADERS = tuple(
    f"{Path(module.__path__[0]) / folder}/"
    for module, folder in ((sapien, "wrapper"), (mani_skill, "utils/building"))
)
_FILE_ARGUMENTS = ("urdf_file", "mjcf_file", "asset_path")
"""Names of the variables that hold the robot's file, in the loaders and in
``BaseAgent._load_articulation``."""
_ELEMENTS = ("origin_node", "node", "geom", "mesh", "texture", "material", "body")
"""Names of the variables that hold an element of the file, in the loaders' functions."""
_LOOP_NAMES = ("mimic", "joint", "x", "link")
"""Names of loop variables, which are read only in the innermost frame: further out, they may be stale."""


@contextmanager
def note_robot_errors() -> Iterator[None]:
    """Context in which an exception of a robot's loader or controller gets a note with the line at fault."""
    try:
        yield
    except CoreRefusal:
        raise
    except Exception as error:
        for link in chain_of(error):
            note = _note(link)
            if note is not None:
                error.add_note(note)
                break
        raise


def place_of_robot_file(cls: type) -> Place | None:
    """The line that gives a robot's class its ``urdf_path`` or ``mjcf_path``."""
    name = "urdf_path" if getattr(cls, "urdf_path", None) is not None else "mjcf_path"
    return _find_line(cls, lambda node: _gives(node, name))


def _note(error: BaseException) -> ErrorNote | None:
    frames = [frame for frame, _ in walk_tb(error.__traceback__)][::-1]
    robot = next((agent for frame in frames if (agent := _self(frame, BaseAgent)) is not None), None)
    if isinstance(robot, MultiAgent) and not robot.agents:
        # ManiSkill's own error is an IndexError from an empty list of robots.
        return ErrorNote(
            'The task names no robot: give `robot_uids` a default in its __init__, such as "panda".'
        )
    controller = next(
        (found for frame in frames if (found := _self(frame, BaseController)) is not None), None
    )
    if controller is not None and robot is not None:
        return _controller_note(controller, robot)
    path = next((Path(str(found)) for frame in frames if (found := _file_argument(frame)) is not None), None)
    named = None if robot is None else place_of_class(type(robot))
    if path is None:
        return (
            None
            if robot is None
            else ErrorNote(f"The robot is {type(robot).__name__}{in_brackets(named)}.", named)
        )
    part = _part_at_fault([frame for frame in frames if frame.f_code.co_filename.startswith(_LOADERS)])
    line = _line_of(error, part, path)
    text = f"Robot file {path}" + ("" if line is None else f":{line}")
    if part is not None:
        text += f", {part.tag} {part.name!r}" if part.name else f", <{part.tag}>"
    text += "".join(_missing_mesh(frames, path))
    if robot is not None:
        named = place_of_robot_file(type(robot)) or named
        text += f". {type(robot).__name__} names this file{in_brackets(named)}"
    return ErrorNote(f"{text}.", named)


def _file_argument(frame: FrameType) -> Any:
    file = frame.f_code.co_filename
    if not (file.startswith(_LOADERS) or file == base_agent.__file__):
        return None
    return next((frame.f_locals[name] for name in _FILE_ARGUMENTS if name in frame.f_locals), None)


def _self(frame: FrameType, kind: type) -> Any:
    found = frame.f_locals.get("self")
    return found if isinstance(found, kind) else None


@dataclass(frozen=True)
class _Part:
    """An element of a robot's file."""

    tag: str
    name: str
    """The element's own name, or that of an element around it; empty if none has a name."""
    line: int | None = None
    attributes: Mapping[str, str] | None = None
    """All attributes of the element, if its line must be found by them."""


def _part_at_fault(frames: list[FrameType]) -> _Part | None:
    """The element that a loader was reading when it failed.

    Args:
        frames: frames of the loaders, innermost first.
    """
    found: _Part | None = None
    for frame in frames:
        values = frame.f_locals
        names = (*_ELEMENTS, *_LOOP_NAMES) if frame is frames[0] else _ELEMENTS
        if frame.f_code.co_name == "_build_link":
            names = (*names, "link")
        parts = [_part_of(values[name]) for name in names if values.get(name) is not None]
        builder = values.get("self")
        if hasattr(builder, "joint_record"):
            parts.append(_Part("link", str(getattr(builder, "name", ""))))
        for part in filter(None, parts):
            # An MJCF element may lack a name: use that of the body around it, which is in a frame further out.
            found = part if found is None else replace(found, name=part.name)
            if found.name:
                return found
    return found


def _part_of(value: Any) -> _Part | None:
    tag = getattr(value, "tag", None)
    if isinstance(tag, str):
        if tag in ("robot", "mujoco"):
            return None
        around = (
            value.iterancestors() if hasattr(value, "iterancestors") else ()
        )  # lxml's elements know their parents, Python's own do not
        named = next((one for one in (value, *around) if one.get("name")), value)
        line = getattr(value, "sourceline", None)
        return _Part(named.tag, named.get("name") or "", line, None if line else dict(value.attrib))
    if hasattr(value, "mimic") and hasattr(value, "multiplier"):
        return _Part("joint", str(value.joint))
    name = getattr(value, "name", None)
    return _Part(type(value).__name__.lower(), name) if isinstance(name, str) else None


def _line_of(error: BaseException, part: _Part | None, path: Path) -> int | None:
    """1-based line in the robot's file."""
    if isinstance(error, SyntaxError | ExpatError):  # raised by an XML parser
        position = getattr(error, "position", None)
        return position[0] if position else error.lineno
    if part is None or part.line is not None:
        return None if part is None else part.line
    lines: list[int] = []
    parser = ParserCreate()

    def begin(tag: str, attributes: dict[str, str]) -> None:
        wanted = (
            attributes == part.attributes
            if part.attributes is not None
            else attributes.get("name") == part.name
        )
        if tag == part.tag and wanted:
            lines.append(parser.CurrentLineNumber)

    parser.StartElementHandler = begin
    try:
        parser.Parse(path.read_bytes(), True)
    except (OSError, ExpatError):
        return None
    # If two elements have the same name, the last is the duplicate.
    return lines[-1] if lines else None


def _missing_mesh(frames: list[FrameType], path: Path) -> Iterator[str]:
    for frame in frames:
        record = frame.f_locals.get("r")
        if isinstance(name := getattr(record, "filename", None), str) and name:
            exists = Path(path.parent, name).exists()
            yield f", mesh {name}" + ("" if exists else f" (there is no {Path(path.parent, name)})")
            return


def _controller_note(controller: Any, robot: Any) -> ErrorNote | None:
    names = getattr(getattr(controller, "config", None), "joint_names", None)
    articulation = getattr(controller, "articulation", None)
    if articulation is None:
        return None
    known = [joint.name for joint in articulation.active_joints]
    unknown = [str(name) for name in names or () if name not in known]
    place = _find_line(type(robot), lambda node: isinstance(node, ast.Constant) and node.value in unknown)
    place = place or _find_line(
        type(robot), lambda node: isinstance(node, ast.FunctionDef) and node.name == "_controller_configs"
    )
    text = f"{type(controller).__name__} of {type(robot).__name__}{in_brackets(place)}"
    for name in unknown:
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"there are {', '.join(known)}"
        text += f": the robot has no active joint {name!r}; {hint}"
    return ErrorNote(text, place)


def _gives(node: ast.AST, name: str) -> bool:
    if isinstance(node, ast.FunctionDef):
        return node.name == name  # a property
    targets = node.targets if isinstance(node, ast.Assign) else ()
    targets = [node.target] if isinstance(node, ast.AnnAssign) and node.value is not None else targets
    return any(name in (getattr(target, "id", None), getattr(target, "attr", None)) for target in targets)


def _find_line(cls: type, fits: Callable[[ast.AST], bool]) -> Place | None:
    """Place of the first node that `fits`, in the source of a class, else of its base classes."""
    for owner in cls.__mro__:
        if owner is BaseAgent or not issubclass(owner, BaseAgent):
            continue
        try:
            file, (lines, first) = inspect.getfile(owner), inspect.getsourcelines(owner)
            tree = parse_python(textwrap.dedent("".join(lines)))
        except (OSError, TypeError, SyntaxError):  # made without source
            continue
        found = [node for node in ast.walk(tree) if fits(node)]
        if found:
            return file, first + found[0].lineno - 1, owner.__name__  # type: ignore[attr-defined]
    return None
