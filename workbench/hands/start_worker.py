"""Records in the worker which uniform numbers a reset draws, and where the author's files draw them."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, Literal

import numpy as np
import torch
from mani_skill.envs.utils.randomization import uniform
from numpy.typing import NDArray
from torch.overrides import TorchFunctionMode

from workbench.envs.step_result import StepResult
from workbench.hands.questions import Draw, EpisodeStart, Operand, Operation, ReadStart
from workbench.source.definitions import Project
from workbench.source.parsed import FUNCTIONS, Place, Plain, SourceFile, arguments
from workbench.source.read_values import Unknown, ValueReader, running_call

MAX_DRAWS, MAX_COLUMNS = 256, 64
"""Maximum number of recorded draws of a reset, and of numbers for each env in one of them: a task may draw a height map."""
Sign = Literal["+", "-", "from", "*", "/", "negated"]
_SIGNS: dict[type, Literal["+", "-", "*", "/"]] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_UNCHANGED = ("to", "float", "clone")
"""Methods that leave the drawn numbers as they are."""
_TORCH = str(Path(torch.__file__).parent)


def read_start(question: ReadStart, num_envs: int, reset: Callable[[], StepResult]) -> EpisodeStart:
    """Reset, and record what is drawn.

    Args:
        reset: resets all envs.

    Raises:
        RefusedEdit: one of the texts is not Python.
    """
    with _Recorder(question.texts, num_envs) as recorder:
        step = reset()
    return EpisodeStart(step.poses, step.qpos, tuple(recorder.draws))


class _Recorder(TorchFunctionMode):
    """Context that records the calls of ``torch.rand`` and ``torch.rand_like`` below code of these texts."""

    def __init__(self, texts: Mapping[str, str], num_envs: int) -> None:
        super().__init__()
        self._project, self._num_envs = Project(texts), num_envs
        self.draws: list[Draw] = []

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        if func in (torch.rand, torch.rand_like) and len(self.draws) < MAX_DRAWS:
            self._record(result, sys._getframe(1))
        return result

    def _record(self, drawn: torch.Tensor, frame: FrameType | None) -> None:
        batched = drawn.ndim > 0 and drawn.shape[0] == self._num_envs
        rows = drawn.reshape(self._num_envs if batched else 1, -1) if drawn.numel() else drawn.reshape(1, 0)
        if not 0 < rows.shape[1] <= MAX_COLUMNS:
            return
        numbers = np.repeat(rows.numpy(force=True), self._num_envs // len(rows), axis=0).astype(np.float32)
        helpers: list[Any] = []
        while frame is not None and frame.f_code.co_filename not in self._project.texts:
            if not frame.f_code.co_filename.startswith(
                _TORCH
            ):  # `torch.device` has a function of its own around
                helpers.append(frame.f_code)
            frame = frame.f_back
        found = None if frame is None else running_call(self._project, frame)
        if frame is None or found is None:
            return
        of_uniform = helpers == [uniform.__code__]
        if helpers and not of_uniform:
            place = _place(found[0], found[1])
            self.draws.append(Draw(place, place, numbers, simple=False))
        else:
            self.draws.append(_draw(self._project, *found, frame, numbers, of_uniform))


def _draw(
    project: Project,
    file: SourceFile,
    call: ast.Call,
    frame: FrameType,
    numbers: NDArray[np.float32],
    of_uniform: bool,
) -> Draw:
    """The draw of a call that `frame` is making."""
    whole, steps = _expression_around(project, file, call)
    bounds: tuple[ast.expr, ...] = ()
    if of_uniform:
        given = arguments(call, ("low", "high", "size", "device"))
        bounds = (given["low"], given["high"]) if {"low", "high"} <= set(given) else ()
    elif found := _bounds_in(file, steps):
        bounds, steps = found, steps[2:]
    operands = [*bounds, *(node for _, node in steps if node is not None)]
    reader = ValueReader(project, file, call, frame, together=operands)

    def operand(node: ast.expr) -> Operand:
        place = _place(file, node)
        try:
            value = reader.part(file, node)
            return Operand(place, _flat(value.value), value)
        except Unknown as exc:
            why = str(exc)
        try:
            return Operand(place, _flat(reader.present_value(file, node)), None, why)
        except Unknown:
            return Operand(place, (), None, why)

    return Draw(
        _place(file, call),
        _place(file, whole),
        numbers,
        tuple(map(operand, bounds)),
        tuple(Operation(sign, None if node is None else operand(node)) for sign, node in steps),
        simple=not of_uniform or bool(bounds),
    )


def _flat(value: Plain) -> tuple[float, ...]:
    """The numbers of a number or of a list of numbers; empty for any other value."""
    numbers = value if isinstance(value, tuple) else (value,)
    found = tuple(number for number in numbers if isinstance(number, float))
    return found if len(found) == len(numbers) else ()


def _expression_around(
    project: Project, file: SourceFile, call: ast.expr
) -> tuple[ast.expr, list[tuple[Sign, ast.expr | None]]]:
    """The arithmetic expression around a call, and its operations on the call's result, innermost first.

    It continues where a name that the call is assigned to is read, if the name is assigned and read once.
    """
    steps: list[tuple[Sign, ast.expr | None]] = []
    while True:
        outer = file.parents[call]
        if isinstance(outer, ast.Assign) and (read := _only_reader(project, file, outer)) is not None:
            call = read
            continue
        if isinstance(outer, ast.BinOp) and type(outer.op) in _SIGNS:
            first, sign = outer.left is call, _SIGNS[type(outer.op)]
            if sign == "/" and not first:
                return call, steps
            steps.append(
                ("from" if sign == "-" and not first else sign, outer.right if first else outer.left)
            )
        elif isinstance(outer, ast.UnaryOp) and isinstance(outer.op, ast.USub):
            steps.append(("negated", None))
        elif isinstance(outer, ast.Attribute) and outer.attr in _UNCHANGED:
            outer = file.parents[outer]
            if not isinstance(outer, ast.Call):
                return call, steps
        else:
            return call, steps
        call = outer


def _only_reader(project: Project, file: SourceFile, assignment: ast.Assign) -> ast.expr | None:
    """The name that reads what is assigned; None if there are several, or other assignments to it."""
    scope, target = file.scopes(assignment)[0], assignment.targets[0]
    if len(assignment.targets) > 1 or not isinstance(target, ast.Name) or not isinstance(scope, FUNCTIONS):
        return None
    if len(project.bindings(file, scope).get(target.id, ())) != 1:
        return None
    found = [node for node in ast.walk(scope) if isinstance(node, ast.Name) and node.id == target.id]
    reads = [node for node in found if node is not target]
    return reads[0] if len(reads) == 1 else None


def _bounds_in(file: SourceFile, steps: list[tuple[Sign, ast.expr | None]]) -> tuple[ast.expr, ...]:
    """The nodes of ``low, high, low`` in ``draw * (high - low) + low``; empty for another expression."""
    if [sign for sign, _ in steps[:2]] != ["*", "+"]:
        return ()
    (_, width), (_, low) = steps[:2]
    if not isinstance(width, ast.BinOp) or not isinstance(width.op, ast.Sub) or low is None:
        return ()
    return (width.right, width.left, low) if file.code(width.right) == file.code(low) else ()


def _place(file: SourceFile, node: ast.AST) -> Place:
    return Place(file.path, *file.inner_span(node))
