"""One file as a syntax tree whose every node knows its place in the text and what it is in.

Edits are made as replacements of spans of the text, and libcst says where the spans are: whatever is not
replaced is the same to the last character, without anything having to be printed again.
"""

from __future__ import annotations

import dataclasses
import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import libcst as cst
from libcst.metadata import CodeRange, MetadataWrapper, PositionProvider

from workbench.authoring.camera_source.result import Refused

_LINE_END = re.compile(r"\r\n?|\n")
"""libcst's own idea of a line; str.splitlines has more."""

Scope = cst.Module | cst.ClassDef | cst.FunctionDef | cst.Lambda
BOM = "\ufeff"


@dataclass(frozen=True)
class Replacement:
    start: int
    end: int
    text: str


class SourceFile:
    """A parsed file. Raises `Refused` for a text that is not Python."""

    def __init__(self, path: str, text: str) -> None:
        self.path = path
        self.text = text
        # A mark at the start is part of the encoding; Python does not take it as source.
        self._skipped = len(BOM) if text.startswith(BOM) else 0
        try:
            parsed = cst.parse_module(text[self._skipped :])
        except (cst.ParserSyntaxError, UnicodeError) as exc:
            raise Refused(f"{self.name} is not valid Python as it stands: {_first_line(exc)}") from exc
        wrapper = MetadataWrapper(parsed, unsafe_skip_copy=True)
        self.module = wrapper.module
        self._ranges = wrapper.resolve(PositionProvider)
        self._line_starts = [self._skipped]
        self._line_starts += [m.end() for m in _LINE_END.finditer(text, self._skipped)]
        self.parents: dict[cst.CSTNode, cst.CSTNode] = {}
        waiting: list[cst.CSTNode] = [self.module]
        while waiting:
            node = waiting.pop()
            for child in children(node):
                self.parents[child] = node
                waiting.append(child)

    @property
    def name(self) -> str:
        return re.split(r"[\\/]", self.path)[-1]

    def span(self, node: cst.CSTNode) -> tuple[int, int]:
        """Offsets of `node` in the text, with the parentheses around it."""
        start, end = self.inner_span(node)
        # libcst counts parentheses as around an expression, and those of a tuple are in truth its own.
        for paren in reversed(getattr(node, "lpar", ())):
            before = start - len(self.module.code_for_node(paren))
            if before < 0 or self.text[before] != "(":
                return self.inner_span(node)
            start = before
        for paren in getattr(node, "rpar", ()):
            after = end + len(self.module.code_for_node(paren))
            if self.text[after - 1 : after] != ")":
                return self.inner_span(node)
            end = after
        return start, end

    def inner_span(self, node: cst.CSTNode) -> tuple[int, int]:
        found = self._ranges[node]
        assert isinstance(found, CodeRange)
        return self._offset(found.start.line, found.start.column), self._offset(
            found.end.line, found.end.column
        )

    def _offset(self, line: int, column: int) -> int:
        return self._line_starts[line - 1] + column

    def line(self, node: cst.CSTNode) -> int:
        return self.line_at(self.inner_span(node)[0])

    def line_at(self, offset: int) -> int:
        return bisect_right(self._line_starts, offset)

    @property
    def lines(self) -> int:
        return len(self._line_starts)

    def line_text(self, line: int) -> str:
        """One line without its end."""
        start = self._line_starts[line - 1]
        match = _LINE_END.search(self.text, start)
        return self.text[start : match.start() if match else len(self.text)]

    def line_start(self, line: int) -> int:
        return self._line_starts[line - 1]

    @property
    def newline(self) -> str:
        return self.module.default_newline

    def code(self, node: cst.CSTNode) -> str:
        start, end = self.span(node)
        return self.text[start:end]

    def ancestors(self, node: cst.CSTNode) -> Iterator[cst.CSTNode]:
        """From its parent outwards."""
        while node in self.parents:
            node = self.parents[node]
            yield node

    def scopes(self, node: cst.CSTNode) -> list[Scope]:
        """What `node` is inside of, innermost first, the module last.

        What stands in the head of a function (defaults, decorators) is not inside of it.
        """
        found: list[Scope] = []
        inner = node
        for outer in self.ancestors(node):
            if (
                isinstance(outer, cst.Module)
                or (isinstance(outer, (cst.ClassDef, cst.FunctionDef)) and inner is outer.body)
                or (isinstance(outer, cst.Lambda) and inner is outer.body)
            ):
                found.append(outer)
            inner = outer
        return found

    def function(self, node: cst.CSTNode) -> str:
        """Qualified name of the code that `node` is in, as Python's ``__qualname__`` has it."""
        parts: list[str] = []
        for scope in self.scopes(node):
            if isinstance(scope, cst.ClassDef):
                parts.append(scope.name.value)
            elif isinstance(scope, cst.FunctionDef):
                parts.append(f"{scope.name.value}.<locals>" if parts else scope.name.value)
            elif isinstance(scope, cst.Lambda):
                parts.append("<lambda>.<locals>" if parts else "<lambda>")
        return ".".join(reversed(parts)) or "<module>"

    @cached_property
    def nodes(self) -> list[cst.CSTNode]:
        """All nodes in the order of the text."""
        return list(walk(self.module))

    def replaced(self, replacements: list[Replacement]) -> str:
        """The text with `replacements`, which must not overlap."""
        parts: list[str] = []
        at = 0
        for change in sorted(replacements, key=lambda change: (change.start, change.end)):
            if change.start < at:
                raise Refused("two changes fall on the same place of the file")
            # The file's own line ends, whatever was composed here.
            new = change.text.replace("\n", self.newline) if self.newline != "\n" else change.text
            parts += [self.text[at : change.start], new]
            at = change.end
        return "".join([*parts, self.text[at:]])


def walk(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
    """`node` and all below it that is code, in the order of the text."""
    waiting = [node]
    while waiting:
        found = waiting.pop()
        yield found
        waiting += reversed(children(found))


def children(node: cst.CSTNode) -> list[cst.CSTNode]:
    """As ``node.children``, without blanks, remarks and punctuation, which are most of it and take most of the time."""
    found: list[cst.CSTNode] = []
    for name in _code_fields(type(node)):
        value = getattr(node, name)
        if isinstance(value, cst.CSTNode):
            found.append(value)
        elif isinstance(value, (list, tuple)):
            found += value
    return found


@cache
def _code_fields(kind: type[cst.CSTNode]) -> tuple[str, ...]:
    names = (field.name for field in dataclasses.fields(kind))
    return tuple(name for name in names if not _PUNCTUATION.match(name))


_PUNCTUATION = re.compile(
    r"whitespace|leading_lines|lines_after|lpar|rpar|lbrac|rbrac|header|footer|trailing|equal|comma|semicolon|"
    "colon|indent|dot$|first_colon|second_colon|arrow"
)


@lru_cache(maxsize=8)
def parsed(path: str, text: str) -> SourceFile:
    """A `SourceFile`, which is never changed: edit after edit is one of the same few files."""
    return SourceFile(path, text)


def _first_line(exc: Exception) -> str:
    if isinstance(exc, cst.ParserSyntaxError):
        return f"line {exc.raw_line}: {exc.message.splitlines()[0]}"
    return str(exc).splitlines()[0]
