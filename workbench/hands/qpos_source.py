"""Finds where the first joint positions of a robot are written in the author's files, and plans the edit that changes them.

Only the text is read. Whether the edit does what was asked is decided by running it (`start_jobs`).
"""

from __future__ import annotations

import ast
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.source.definitions import Project
from workbench.source.parsed import RefusedEdit, Replacement, SourceFile
from workbench.source.traced_edits import list_text, number_text
from workbench.task.write_edits import SourceEdit, check_own

Floats = NDArray[np.floating[Any]]
DECIMALS = 4
_ROUNDED = 1e-3
"""Error of a position that a reset sets: the controllers of some agents hold it only so well."""
_OPERATIONS: dict[type, Any] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b if b else math.nan,
}


@dataclass(frozen=True, eq=False)
class WrittenQpos:
    """A list of joint positions in the author's files, at which episodes begin, perhaps with noise around it."""

    file: SourceFile
    items: tuple[ast.expr, ...]
    values: Floats
    """(J,) in rad or m."""


def find_qpos(texts: Mapping[str, str], rows: Floats) -> WrittenQpos:
    """Find the list of numbers at which a robot begins.

    Args:
        texts: the author's files by path.
        rows: (K, J) first joint positions in K episodes.

    Raises:
        RefusedEdit: there is no such list, or several.
    """
    spread = np.ptp(rows, axis=0) + _ROUNDED
    low, high = rows.min(axis=0) - spread, rows.max(axis=0) + spread
    project = Project(texts)
    found = [
        one
        for path in texts
        for one in _lists(project.file(path), rows.shape[1])
        if ((low <= one.values) & (one.values <= high)).all()
    ]
    if len(found) > 1:
        found = [one for one in found if _is_named_qpos(one)] or found
    if not found:
        raise RefusedEdit(
            f"no list of {rows.shape[1]} numbers in your files is where the robot begins, so that it is set elsewhere, for "
            "example by a scene builder of ManiSkill"
        )
    if len(found) > 1:
        places = " and ".join(f"{one.file.name}, line {one.file.line(one.items[0])}" for one in found)
        raise RefusedEdit(f"several lists are where the robot begins ({places})")
    check_own(found[0].file.path)
    return found[0]


def without_noise(written: WrittenQpos, rows: Floats, wanted: Sequence[float]) -> Floats:
    """(J,) numbers to write: the old number where the wanted position is one that resets give anyway.

    So the noise of the present episode is not written for joints that nobody moved.

    Args:
        rows: (K, J) as in `find_qpos`.
    """
    is_noise = (rows.min(axis=0) <= wanted) & (wanted <= rows.max(axis=0))
    return np.where(is_noise, written.values, wanted)


def plan_qpos(written: WrittenQpos, wanted: Sequence[float] | Floats) -> SourceEdit:
    """Plan the edit that writes (J,) other joint positions. Raises RefusedEdit if nothing changes."""
    changes = [
        Replacement(*written.file.span(item), number_text(to, DECIMALS, written.file.code(item)))
        for item, now, to in zip(written.items, written.values, wanted, strict=True)
        if abs(now - to) > 0.5 * 10**-DECIMALS
    ]
    if not changes:
        raise RefusedEdit("the joints were moved by less than the precision of the written numbers (0.0001)")
    file = written.file
    return SourceEdit(file.path, file.text, file.replaced(changes), notes=(), settings=None)


def lines_to_copy(qpos: Sequence[float]) -> str:
    """Lines that reset a robot to these joint positions, for the author to copy."""
    return (
        "# at the end of _initialize_episode\n"
        f"qpos = torch.tensor({list_text(qpos, DECIMALS)}, device=self.device)\n"
        "self.agent.reset(qpos.repeat(len(env_idx), 1))"
    )


def _lists(file: SourceFile, length: int) -> Iterator[WrittenQpos]:
    """The lists of this many numbers in a file."""
    for node in file.nodes:
        if isinstance(node, ast.List | ast.Tuple) and len(node.elts) == length:
            values = np.array([_number(item) for item in node.elts])
            if np.isfinite(values).all():
                yield WrittenQpos(file, tuple(node.elts), values)


def _number(node: ast.expr) -> float:
    """The value of a number, also of one like ``-np.pi * 5 / 8``; nan for any other expression."""
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return float(node.value)  # type: ignore[arg-type]
    if isinstance(node, ast.Attribute) and node.attr == "pi":
        return math.pi
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        return _number(node.operand) * (-1 if isinstance(node.op, ast.USub) else 1)
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATIONS:
        return _OPERATIONS[type(node.op)](_number(node.left), _number(node.right))
    return math.nan


def _is_named_qpos(one: WrittenQpos) -> bool:
    """Whether the list is the value of a variable or argument whose name contains qpos."""
    for outer in one.file.ancestors(one.items[0]):
        if isinstance(outer, ast.keyword):
            return "qpos" in (outer.arg or "")
        if isinstance(outer, ast.Call) and one.file.code(outer.func).endswith(("set_qpos", "agent.reset")):
            return True
        if isinstance(outer, ast.Assign):
            return any("qpos" in one.file.code(target) for target in outer.targets)
        if isinstance(outer, ast.stmt):
            return False
    return False
