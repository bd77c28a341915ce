"""Edits traced values: finds where each value is written in the source, and makes its new text."""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence

import numpy as np

from workbench.pictures.camera_conventions import normalised
from workbench.source.definitions import Project
from workbench.source.parsed import (
    DEGREE,
    Place,
    RefusedEdit,
    Replacement,
    SourceFile,
    TracedValue,
    arguments,
)


class Changes:
    """Collects edits of traced values and turns them into replacements of text.

    A value is edited where it is defined if nothing else reads it. If something else reads it too (one
    ``pose`` for two cameras, a constant that the scene uses), the new value replaces the name at this use
    only, with a note.

    Places come from the worker, whose texts may differ: a place that is not an expression in these files
    raises RefusedEdit.
    """

    def __init__(self, project: Project) -> None:
        self.project = project
        self.texts: dict[TracedValue, str] = {}
        """New texts of expressions."""
        self.added: dict[TracedValue, list[str]] = {}
        """New arguments of calls."""
        self.notes: list[str] = []
        self.replacements: list[tuple[SourceFile, Replacement]] = []

    def note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def find(self, place: Place) -> tuple[SourceFile, ast.expr]:
        file = self.project.own_file(place.file)
        return file, file.expression((place.start, place.end))

    def code(self, place: Place) -> str:
        file, node = self.find(place)
        return file.code(node)

    def one_line(self, place: Place) -> str:
        """The code of an expression on one line, for messages."""
        file, node = self.find(place)
        return file.one_line(node)

    def change(self, file: SourceFile, *replacements: Replacement) -> None:
        self.replacements += [(file, replacement) for replacement in replacements]

    def replace(self, file: SourceFile, node: ast.AST, text: str) -> None:
        self.change(file, Replacement(*file.span(node), text))

    def add_imports(self, file: SourceFile, lines: Mapping[str, str]) -> None:
        """Add missing imports at the top of a file.

        Args:
            lines: import statements by the name that each binds.

        Raises:
            RefusedEdit: the file uses a name for something else.
        """
        bindings = self.project.bindings(file, file.module)
        for name in lines:
            if name in bindings and not bindings[name][-1].dotted:
                line = file.line(bindings[name][-1].node)
                raise RefusedEdit(f"`{name}` means something else in this file (line {line})")
        missing = [line for name, line in lines.items() if name not in bindings]
        for line in missing:
            self.note(f"{line}: added at the top of the file")
        if missing:
            place = file.import_place()
            text = "".join(f"{line}\n" for line in sorted(missing, key=lambda line: line.startswith("from")))
            self.change(file, Replacement(place, place, text))

    # --- new values ---------------------------------------------------------------------------------

    def number(self, value: TracedValue, requested: float, decimals: int) -> None:
        """Edit `value` to `requested`; no edit if rounding to `decimals` decimals gives the old value."""
        if written_value(value, requested, decimals) == value.value:
            return
        inner, requested, decimals = _inner_target(value, requested, decimals)
        code = self.code(inner.at)
        text = number_text(requested, decimals, code)
        self.texts[inner] = text
        named = {node.id for node in ast.walk(self.find(inner.at)[1]) if isinstance(node, ast.Name)}
        names = sorted(named - {"np", "math", "pi", "torch", "numpy"})
        if names:
            self.note(f"`{code}` became {text}: it no longer follows {' and '.join(names)}")

    # --- replacements -------------------------------------------------------------------------------

    def is_edited(self, value: TracedValue) -> bool:
        return any(part in self.texts or part in self.added for part in value.walk())

    def emit(self, value: TracedValue, known: int = 0) -> None:
        """Turn the edits within `value` into replacements. The first `known` of `value.reads` are already
        handled."""
        if not self.is_edited(value):
            return
        for index, read in enumerate(value.reads[known:], known):
            if read.others is not None:
                file, node = self.find(read.at)
                self.note(
                    f"`{file.code(node)}` is also read elsewhere ({read.others}), so the new value replaces "
                    "the name here, for this camera alone"
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

    def rendered(self, value: TracedValue, known: int, into: SourceFile) -> str:
        """The code of `value` as a standalone expression in the file `into`."""
        if value in self.texts:
            return self.texts[value]
        file, node = self.find(value.at)
        if not self.is_edited(value):
            home, named = self.find(value.reads[known].at) if value.reads[known:] else (file, node)
            if home is into and not isinstance(home.scopes(named)[0], ast.ClassDef):
                # Do not use a name of a class body: the class's methods do not see it.
                return home.code(named)
        if isinstance(value.value, float):
            if self.is_edited(value):
                return self._with_part(value, into)
            return file.code(node) if value.literal else number_text(value.value, 7)
        if value.function:
            return self._rendered_call(value, into)
        if not isinstance(value.value, tuple):
            return file.code(node)
        items = [self.rendered(part, len(value.reads), into) for part in value.parts.values()]
        inside = ", ".join(items or [number_text(number, 7) for number in value.numbers])
        return f"({inside})" if isinstance(node, ast.Tuple) else f"[{inside}]"

    def _rendered_call(self, value: TracedValue, into: SourceFile) -> str:
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

    def _with_part(self, value: TracedValue, into: SourceFile) -> str:
        """The code of an expression whose inner number is edited."""
        chain = _chain(value)
        inner = chain[-1]
        file, node = self.find(value.at)
        where, within = self.find(inner.at)
        if len(inner.reads) > len(value.reads) or file is not into or where is not file:
            return number_text(_outer_value(chain, float(self.texts[inner])), 7)
        (start, end), (a, b) = file.span(node), file.span(within)
        return file.text[start:a] + self.texts[inner] + file.text[b:end]


def written_value(value: TracedValue, requested: float, decimals: int) -> float:
    """The number that results from writing `requested` with `decimals` decimals."""
    assert isinstance(value.value, float)
    if abs(value.value - requested) <= 0.5000001 * 10**-decimals:
        return value.value
    _, new, places = _inner_target(value, requested, decimals)
    return _outer_value(_chain(value), round(new, places))


def _chain(value: TracedValue) -> list[TracedValue]:
    found = [value]
    while "of" in found[-1].parts:
        found.append(found[-1].parts["of"])
    return found


def _outer_value(chain: list[TracedValue], innermost: float) -> float:
    """The value of the first part of `chain` if the last part has the value `innermost`."""
    for outer in reversed(chain[:-1]):
        innermost = innermost * outer.slope + outer.offset
    return innermost


def _inner_target(value: TracedValue, requested: float, decimals: int) -> tuple[TracedValue, float, int]:
    """The number to edit within `value`, its new value, and its decimals."""
    *outer, last = _chain(value)
    for part in outer:
        requested = (requested - part.offset) / part.slope
        if math.isclose(part.slope, DEGREE):
            decimals = max(2, decimals - 2)
    return last, requested, decimals


# --- numbers as text ------------------------------------------------------------------------------


def number_text(value: float, decimals: int, like: str = "0.0") -> str:
    """`value` rounded to `decimals`, without trailing zeros. A whole number is written as an integer if the
    old text `like` is an integer or `decimals` is 0."""
    rounded = round(value, decimals)
    if rounded == int(rounded):
        whole = str(int(rounded))
        return whole if decimals == 0 or like.lstrip("+-").isdigit() else f"{whole}.0"
    return f"{rounded:.{decimals}f}".rstrip("0")


def list_text(values: Sequence[float], decimals: int) -> str:
    return "[" + ", ".join(number_text(value, decimals) for value in values) + "]"


def matrix_text(rows: Sequence[Sequence[float]]) -> str:
    """Matrix of pixels as text, rounded to a thousandth."""
    return "[" + ", ".join(list_text(row, 3) for row in rows) + "]"


def quaternion_texts(quaternion: Sequence[float]) -> list[str]:
    """The numbers of the normalised `quaternion` (wxyz) as text, with as few decimals as are exact to 1e-7.

    SAPIEN does not normalise: with 0.7071 in place of 0.7071068, the camera's frame is not a rotation.
    """
    exact = same_side(quaternion, quaternion)
    for decimals in (1, 2, 3, 4, 5, 6):
        rounded = [round(part, decimals) for part in exact]
        if max(abs(a - b) for a, b in zip(rounded, exact, strict=True)) < 1e-7:
            return [number_text(part, decimals) for part in rounded]
    return [number_text(part, 7) for part in exact]


def same_side(quaternion: Sequence[float], old: Sequence[float]) -> list[float]:
    """The unit quaternion of this orientation whose sign matches `old`."""
    found = normalised(quaternion)
    return (found if found @ np.asarray(old) >= 0 else -found).tolist()
