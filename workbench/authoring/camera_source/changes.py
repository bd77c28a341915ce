"""What is to be changed in the values of one camera, and where in the text that is done.

A value is changed where it stands if nobody else reads it there. If somebody does (one ``pose`` for two
cameras, a constant that the scene is built with), changing it would change more than was asked for: then the
new value is written in place of the name, for this camera alone, and the author is told.
"""

from __future__ import annotations

import math

import libcst as cst

from workbench.authoring.camera_source.arguments import added_arguments
from workbench.authoring.camera_source.number_text import number_text
from workbench.authoring.camera_source.source_file import Replacement, SourceFile, walk
from workbench.authoring.camera_source.values import (
    Angles,
    Number,
    PoseValue,
    Text,
    Value,
    Vector,
    parts_of,
)

DEGREE = math.pi / 180


class Changes:
    def __init__(self) -> None:
        self.texts: dict[Value, str] = {}
        """New text of an expression."""
        self.added: dict[PoseValue, list[str]] = {}
        """Arguments that a pose gets."""
        self.notes: list[str] = []
        self.replacements: list[tuple[SourceFile, Replacement]] = []

    def note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    # --- wanted -------------------------------------------------------------------------------------

    def number(self, value: Number, wanted: float, decimals: int) -> None:
        """`wanted`, unless what stands there is as good."""
        if settled(value, wanted, decimals) == value.value:
            return
        inner, wanted, decimals = _innermost(value, wanted, decimals)
        code = inner.at.file.code(inner.at.node)
        text = number_text(wanted, decimals, code)
        self.texts[inner] = text
        names = sorted(
            {
                node.value
                for node in walk(inner.at.node)
                if isinstance(node, cst.Name) and node.value not in ("np", "math", "pi", "torch", "numpy")
            }
        )
        if names:
            self.note(f"`{code}` became {text}: it no longer follows {' and '.join(names)}")

    # --- where --------------------------------------------------------------------------------------

    def touches(self, value: Value) -> bool:
        if value in self.texts or (isinstance(value, PoseValue) and value in self.added):
            return True
        return any(self.touches(part) for part in parts_of(value))

    def emit(self, value: Value, known: int = 0) -> None:
        """Turn what is changed in `value` into replacements. `known` of its reads are followed already."""
        if not self.touches(value):
            return
        for index, read in enumerate(value.at.reads[known:], known):
            if read.others is not None:
                self.note(
                    f"`{read.file.code(read.node)}` is also read elsewhere ({read.others}), so the new value is "
                    "written in its place, for this camera alone"
                )
                start, end = read.file.span(read.node)
                new = self.rendered(value, index + 1, read.file)
                self.replacements.append((read.file, Replacement(start, end, new)))
                return
        file, node = value.at.file, value.at.node
        if value in self.texts:
            start, end = file.span(node)
            self.replacements.append((file, Replacement(start, end, self.texts[value])))
            return
        for part in parts_of(value):
            self.emit(part, len(value.at.reads))
        if isinstance(value, PoseValue) and value in self.added:
            assert isinstance(node, cst.Call)
            for replacement in added_arguments(file, node, self.added[value]):
                self.replacements.append((file, replacement))

    def rendered(self, value: Value, known: int, into: SourceFile) -> str:
        """`value` as a text of its own, to be written in `into`."""
        if value in self.texts:
            return self.texts[value]
        file, node = value.at.file, value.at.node
        if not self.touches(value):
            reads = value.at.reads[known:]
            named = reads[0].node if reads else node
            home = reads[0].file if reads else file
            if home is into and not _class_level(home, named):
                return home.code(named)
        if isinstance(value, Number):
            if self.touches(value):
                # Only a part of the expression is changed, in the middle of its text.
                return _with_part(self, value, into)
            code = file.code(node)
            return code if value.literal else number_text(value.value, 7)
        if isinstance(value, Vector):
            inside = ", ".join(self.rendered(item, len(value.at.reads), into) for item in value.items)
            return f"({inside})" if isinstance(node, cst.Tuple) else f"[{inside}]"
        if isinstance(value, Text):
            return file.code(node)
        if isinstance(value, PoseValue) or isinstance(value, Angles):
            return self._rendered_call(value, into)
        return "None"

    def _rendered_call(self, value: PoseValue | Angles, into: SourceFile) -> str:
        file, node = value.at.file, value.at.node
        assert isinstance(node, cst.Call)
        by_node: dict[cst.BaseExpression, Value] = {}
        for part in parts_of(value):
            own = part.at.reads[len(value.at.reads) :]
            by_node[own[0].node if own else part.at.node] = part
        arguments: list[str] = []
        for arg in node.args:
            part = by_node.get(arg.value) or next(
                (p for n, p in by_node.items() if n in walk(arg.value)), None
            )
            code = file.code(arg.value) if part is None else self.rendered(part, len(value.at.reads), into)
            arguments.append(code if arg.keyword is None else f"{arg.keyword.value}={code}")
        if isinstance(value, PoseValue):
            arguments += self.added.get(value, [])
        return f"{file.code(node.func)}({', '.join(arguments)})"


def settled(value: Number, wanted: float, decimals: int) -> float:
    """What `value` will be when `wanted` has been written with so many decimals."""
    if abs(value.value - wanted) <= 0.5000001 * 10**-decimals:
        return value.value
    _, new, places = _innermost(value, wanted, decimals)
    return _outward(value, round(new, places))


def _outward(value: Number, innermost: float) -> float:
    """What `value` is when its innermost part is that."""
    for outer in reversed(_chain(value)[:-1]):
        assert outer.part is not None
        innermost = innermost * outer.part[1] + outer.part[2]
    return innermost


def _chain(value: Number) -> list[Number]:
    found = [value]
    while found[-1].part is not None:
        found.append(found[-1].part[0])
    return found


def _innermost(value: Number, wanted: float, decimals: int) -> tuple[Number, float, int]:
    """The number to be changed, what it has to be, and to how many decimals."""
    while value.part is not None:
        inner, slope, offset = value.part
        wanted = (wanted - offset) / slope
        if slope == DEGREE:
            decimals = max(2, decimals - 2)
        value = inner
    return value, wanted, decimals


def _with_part(changes: Changes, value: Number, into: SourceFile) -> str:
    assert value.part is not None
    inner = value.part[0]
    file = value.at.file
    while inner not in changes.texts:
        assert inner.part is not None
        inner = inner.part[0]
    start, end = file.span(value.at.node)
    own = inner.at.reads[len(value.at.reads) :]
    if own or file is not into or inner.at.file is not file:
        return number_text(_outward(value, float(changes.texts[inner])), 7)
    a, b = file.span(inner.at.node)
    return file.text[start:a] + changes.texts[inner] + file.text[b:end]


def _class_level(file: SourceFile, node: cst.CSTNode) -> bool:
    """True for what stands in the body of a class, whose names a method does not see."""
    return isinstance(file.scopes(node)[0], cst.ClassDef)
