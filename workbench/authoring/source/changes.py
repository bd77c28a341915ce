"""What is to be changed in traced values, and where in the text that is done.

A value is changed where it stands if nobody else reads it there. If somebody does (one ``pose`` for two cameras, a
constant that the scene is built with), changing it would change more than was asked for: then the new value is written
in place of the name, for this use alone, and the author is told.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping

from workbench.authoring.source.names import Project
from workbench.authoring.source.numbers import number_text
from workbench.authoring.source.text import RefusedEdit, Replacement, SourceFile, arguments
from workbench.authoring.source.trace import DEGREE, Part, Place


class Changes:
    """Places come from the process that runs the author's code: one that is no expression of a text that is here raises
    RefusedEdit."""

    def __init__(self, project: Project) -> None:
        self.project = project
        self.texts: dict[Part, str] = {}
        """New text of an expression."""
        self.added: dict[Part, list[str]] = {}
        """Arguments that a call gets."""
        self.notes: list[str] = []
        self.replacements: list[tuple[SourceFile, Replacement]] = []

    def note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def find(self, place: Place) -> tuple[SourceFile, ast.expr]:
        file = self.project.given(place.file)
        return file, file.expression((place.start, place.end))

    def code(self, place: Place) -> str:
        file, node = self.find(place)
        return file.code(node)

    def short(self, place: Place) -> str:
        """On one line, for a sentence."""
        file, node = self.find(place)
        return file.short(node)

    def change(self, file: SourceFile, *replacements: Replacement) -> None:
        self.replacements += [(file, replacement) for replacement in replacements]

    def replace(self, file: SourceFile, node: ast.AST, text: str) -> None:
        self.change(file, Replacement(*file.span(node), text))

    def importing(self, file: SourceFile, lines: Mapping[str, str]) -> None:
        """Add what is missing at the top of a file.

        Args:
            lines: by the name that each brings.

        Raises:
            RefusedEdit: a name means something else there.
        """
        bindings = self.project.bindings(file, file.module)
        for name in lines:
            if name in bindings and not bindings[name][-1].dotted:
                line = file.line(bindings[name][-1].node)
                raise RefusedEdit(f"`{name}` means something else in this file (line {line})")
        missing = [line for name, line in lines.items() if name not in bindings]
        for line in missing:
            self.note(f"`{line}` is added at the top of the file")
        if missing:
            place = file.import_place()
            text = "".join(f"{line}\n" for line in sorted(missing, key=lambda line: line.startswith("from")))
            self.change(file, Replacement(place, place, text))

    # --- wanted -------------------------------------------------------------------------------------

    def number(self, value: Part, wanted: float, decimals: int) -> None:
        """`wanted`, unless what stands there is as good."""
        if settled(value, wanted, decimals) == value.value:
            return
        inner, wanted, decimals = _innermost(value, wanted, decimals)
        code = self.code(inner.at)
        text = number_text(wanted, decimals, code)
        self.texts[inner] = text
        named = {node.id for node in ast.walk(self.find(inner.at)[1]) if isinstance(node, ast.Name)}
        names = sorted(named - {"np", "math", "pi", "torch", "numpy"})
        if names:
            self.note(f"`{code}` became {text}: it no longer follows {' and '.join(names)}")

    # --- where --------------------------------------------------------------------------------------

    def touches(self, value: Part) -> bool:
        return any(part in self.texts or part in self.added for part in value.walk())

    def emit(self, value: Part, known: int = 0) -> None:
        """Turn what is changed in `value` into replacements. `known` of its reads are followed already."""
        if not self.touches(value):
            return
        for index, read in enumerate(value.reads[known:], known):
            if read.others is not None:
                file, node = self.find(read.at)
                self.note(
                    f"`{file.code(node)}` is also read elsewhere ({read.others}), so the new value is written in its "
                    "place, for this camera alone"
                )
                self.replace(file, node, self.rendered(value, index + 1, file))
                return
        file, node = self.find(value.at)
        if value in self.texts:
            self.replace(file, node, self.texts[value])
            return
        for part in value.parts.values():
            self.emit(part, len(value.reads))
        if value in self.added:
            assert isinstance(node, ast.Call)
            self.change(file, *file.added_arguments(node, self.added[value]))

    def rendered(self, value: Part, known: int, into: SourceFile) -> str:
        """`value` as a text of its own, to be written in `into`."""
        if value in self.texts:
            return self.texts[value]
        file, node = self.find(value.at)
        if not self.touches(value):
            home, named = self.find(value.reads[known].at) if value.reads[known:] else (file, node)
            if home is into and not isinstance(home.scopes(named)[0], ast.ClassDef):
                # Not what stands in the body of a class, whose names a method does not see.
                return home.code(named)
        if isinstance(value.value, float):
            if self.touches(value):
                return self._with_part(value, into)
            return file.code(node) if value.literal else number_text(value.value, 7)
        if value.function:
            return self._rendered_call(value, into)
        if not isinstance(value.value, tuple):
            return file.code(node)
        items = [self.rendered(part, len(value.reads), into) for part in value.parts.values()]
        inside = ", ".join(items or [number_text(number, 7) for number in value.numbers])
        return f"({inside})" if isinstance(node, ast.Tuple) else f"[{inside}]"

    def _rendered_call(self, value: Part, into: SourceFile) -> str:
        file, node = self.find(value.at)
        assert isinstance(node, ast.Call)
        by_node = {given: name for name, given in arguments(node, list(value.parts)).items()}
        texts: list[str] = []
        for given in (*node.args, *node.keywords):
            expression = given.value if isinstance(given, ast.keyword) else given
            part = value.parts.get(by_node.get(expression, ""))
            code = file.code(expression) if part is None else self.rendered(part, len(value.reads), into)
            texts.append(f"{given.arg}={code}" if isinstance(given, ast.keyword) else code)
        return f"{file.code(node.func)}({', '.join([*texts, *self.added.get(value, [])])})"

    def _with_part(self, value: Part, into: SourceFile) -> str:
        """An expression of which only a part is changed, in the middle of its text."""
        chain = _chain(value)
        inner = chain[-1]
        file, node = self.find(value.at)
        where, within = self.find(inner.at)
        if len(inner.reads) > len(value.reads) or file is not into or where is not file:
            return number_text(_outward(chain, float(self.texts[inner])), 7)
        (start, end), (a, b) = file.span(node), file.span(within)
        return file.text[start:a] + self.texts[inner] + file.text[b:end]


def settled(value: Part, wanted: float, decimals: int) -> float:
    """What a number will be when `wanted` has been written with so many decimals."""
    assert isinstance(value.value, float)
    if abs(value.value - wanted) <= 0.5000001 * 10**-decimals:
        return value.value
    _, new, places = _innermost(value, wanted, decimals)
    return _outward(_chain(value), round(new, places))


def _chain(value: Part) -> list[Part]:
    found = [value]
    while "of" in found[-1].parts:
        found.append(found[-1].parts["of"])
    return found


def _outward(chain: list[Part], innermost: float) -> float:
    """What the first is when the last is that."""
    for outer in reversed(chain[:-1]):
        innermost = innermost * outer.slope + outer.offset
    return innermost


def _innermost(value: Part, wanted: float, decimals: int) -> tuple[Part, float, int]:
    """The number to be changed, what it has to be, and to how many decimals."""
    *outer, last = _chain(value)
    for part in outer:
        wanted = (wanted - part.offset) / part.slope
        if math.isclose(part.slope, DEGREE):
            decimals = max(2, decimals - 2)
    return last, wanted, decimals
