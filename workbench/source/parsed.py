"""Parsed source files, with offsets and edits of their text; places where a traced call's values are
written."""

from __future__ import annotations

import ast
import io
import math
import re
import tokenize
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

from workbench.machine.parse_python import parse_python

Function = ast.FunctionDef | ast.AsyncFunctionDef
Scope = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
Span = tuple[int, int]
"""Offset of the first character, and offset after the last."""
LOOPS = (ast.For, ast.AsyncFor, ast.While, ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)

_LINE_END = re.compile(r"\r\n?|\n")
"""Python's line ends; str.splitlines would split at more characters."""
_BLANK = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


class RefusedEdit(Exception):
    """An edit cannot be made; any code that plans it may raise this."""

    def __init__(self, reason: str, snippet: str = "") -> None:
        super().__init__(reason)
        self.reason, self.snippet = reason, snippet
        """`reason` is the end of a sentence for the author; `snippet` is text that they can copy into the
        file."""


@dataclass(frozen=True)
class Replacement:
    start: int
    end: int
    text: str


class SourceFile:
    """A parsed file. Raises `RefusedEdit` if the text is not Python."""

    def __init__(self, path: str, text: str) -> None:
        self.path = path
        self.text = text
        try:
            self.module = parse_python(text)
        except (SyntaxError, ValueError, RecursionError, MemoryError) as exc:
            reason = f"line {exc.lineno}: {exc.msg}" if isinstance(exc, SyntaxError) else str(exc)
            raise RefusedEdit(f"{self.name} is not valid Python now: {reason}") from exc
        self._starts = [0, *(m.end() for m in _LINE_END.finditer(text))]
        self.nodes = list(walk(self.module))
        """All nodes, nearly in the order of the text."""
        self.parents = {child: node for node in self.nodes for child in ast.iter_child_nodes(node)}

    @property
    def name(self) -> str:
        return re.split(r"[\\/]", self.path)[-1]

    # --- places -------------------------------------------------------------------------------------

    def inner_span(self, node: ast.AST) -> Span:
        """Offsets of an expression, statement or argument, without parentheses around it."""
        place: ast.expr = node  # type: ignore[assignment]
        assert place.end_lineno is not None and place.end_col_offset is not None
        return self._offset(place.lineno, place.col_offset), self._offset(
            place.end_lineno, place.end_col_offset
        )

    def _offset(self, line: int, column: int) -> int:
        """Offset in the text of a line and a column; the column counts UTF-8 bytes, as in Python's nodes."""
        start = self._starts[line - 1]
        if self.text.isascii():
            return start + column
        return start + len(self.line_text(line).encode()[:column].decode())

    def span(self, node: ast.AST) -> Span:
        """Offsets of a node with the parentheses around it."""
        start, end = self.inner_span(node)
        low, high = self._room(node)
        while True:
            before = bisect_left(self._tokens, (start,)) - 1
            after = bisect_left(self._tokens, (end,))
            if before < 0 or after >= len(self._tokens):
                return start, end
            (opens, _, left), (_, closes, right) = self._tokens[before], self._tokens[after]
            if (left, right) != ("(", ")") or opens < low or closes > high:
                return start, end
            start, end = opens, closes

    def _room(self, node: ast.AST) -> Span:
        """The span within which parentheses around a node are its own, not those of an enclosing call."""
        outer = self.parents.get(node)
        if isinstance(outer, ast.keyword):
            node, outer = outer, self.parents[outer]
        if isinstance(outer, ast.Call) and node is not outer.func:
            return self.content_span(outer)
        return self.inner_span(outer) if isinstance(outer, (ast.expr, ast.stmt)) else (0, len(self.text))

    @cached_property
    def _tokens(self) -> list[tuple[int, int, str]]:
        lines = io.StringIO(plain_line_ends(self.text)).readline
        return [
            (self._starts[t.start[0] - 1] + t.start[1], self._starts[t.end[0] - 1] + t.end[1], t.string)
            for t in tokenize.generate_tokens(lines)
            if t.type not in _BLANK
        ]

    def token_after(self, start: int, string: str) -> int:
        """Offset of the first token `string` at or after the offset `start`."""
        following = self._tokens[bisect_left(self._tokens, (start,)) :]
        return next(begin for begin, _, token in following if token == string)

    def after_comma(self, end: int) -> int | None:
        """Offset after the comma that follows `end`; None if no comma follows."""
        following = bisect_left(self._tokens, (end,))
        if following < len(self._tokens) and self._tokens[following][2] == ",":
            return self._tokens[following][1]
        return None

    def content_span(self, node: ast.AST) -> Span:
        """The span between the brackets of a call, list, dict or tuple."""
        start, end = self.inner_span(node)
        if isinstance(node, ast.Call):
            start = self._tokens[bisect_left(self._tokens, (self.span(node.func)[1],))][0]
        return start + 1, end - 1

    def items(self, node: ast.AST) -> list[Span]:
        """Spans of the arguments of a call, or of the elements of a list, tuple or dict."""
        if isinstance(node, ast.Dict):
            pairs = zip(node.keys, node.values, strict=True)
            return [
                (self.span(value if key is None else key)[0], self.span(value)[1]) for key, value in pairs
            ]
        if isinstance(node, ast.Call):
            given = sorted((*node.args, *node.keywords), key=lambda item: self.inner_span(item)[0])
            return [self.item_span(item) for item in given]
        assert isinstance(node, (ast.List, ast.Tuple))
        return [self.span(item) for item in node.elts]

    def item_span(self, item: ast.expr | ast.keyword) -> Span:
        if isinstance(item, ast.keyword):
            return self.inner_span(item)[0], self.span(item.value)[1]
        return self.span(item)

    @cached_property
    def _expressions(self) -> dict[Span, ast.expr]:
        found: dict[Span, ast.expr] = {}
        for node in self.nodes:
            if isinstance(node, ast.expr):
                found.setdefault(self.inner_span(node), node)
        return found

    def expression(self, span: Span) -> ast.expr:
        """The expression with exactly this span. Raises RefusedEdit if there is none."""
        if span not in self._expressions:
            raise RefusedEdit(
                f"{self.name} differs from the text that ran: save it, let it load and try again"
            )
        return self._expressions[span]

    def at(self, line: int, end_line: int, column: int, end_column: int) -> ast.expr | None:
        """The expression at a position from ``co_positions`` of a code object; None if there is none."""
        if not 0 < line <= end_line <= len(self._starts):
            return None
        return self._expressions.get((self._offset(line, column), self._offset(end_line, end_column)))

    def line(self, node: ast.AST) -> int:
        return self.line_at(self.inner_span(node)[0])

    def line_at(self, offset: int) -> int:
        return bisect_right(self._starts, offset)

    def line_text(self, line: int) -> str:
        """One line without its end; empty after the last line."""
        start = self.line_start(line)
        match = _LINE_END.search(self.text, start)
        return self.text[start : match.start() if match else len(self.text)]

    def line_start(self, line: int) -> int:
        return self._starts[line - 1] if line <= len(self._starts) else len(self.text)

    def indent(self, offset: int) -> str:
        """Indentation of the line at an offset."""
        line = self.line_text(self.line_at(offset))
        return line[: len(line) - len(line.lstrip())]

    def code(self, node: ast.AST) -> str:
        start, end = self.span(node)
        return self.text[start:end]

    def one_line(self, node: ast.AST) -> str:
        """The code of a node on one line, for messages."""
        line = " ".join(self.code(node).split())
        return line if len(line) <= 60 else line[:57] + "..."

    # --- parents and scopes -------------------------------------------------------------------------

    def ancestors(self, node: ast.AST) -> Iterator[ast.AST]:
        """Enclosing nodes, from the parent of `node` outwards."""
        while node in self.parents:
            node = self.parents[node]
            yield node

    def scopes(self, node: ast.AST) -> list[Scope]:
        """Scopes that contain `node`, innermost first, the module last.

        Defaults and decorators of a function are not inside its scope.
        """
        found: list[Scope] = []
        inner = node
        for outer in self.ancestors(node):
            body = getattr(outer, "body", None)
            if isinstance(outer, Scope) and (inner is body or (isinstance(body, list) and inner in body)):
                found.append(outer)
            inner = outer
        return found

    def qualname(self, scope: ast.AST) -> str:
        """``__qualname__`` of a class or function; for any other node, that of the class or function around
        it."""
        scopes = (
            [scope, *self.scopes(scope)]
            if isinstance(scope, (ast.ClassDef, *FUNCTIONS))
            else self.scopes(scope)
        )
        parts: list[str] = []
        for outer in scopes:
            if isinstance(outer, ast.ClassDef):
                parts.append(outer.name)
            elif isinstance(outer, FUNCTIONS):
                name = "<lambda>" if isinstance(outer, ast.Lambda) else outer.name
                parts.append(f"{name}.<locals>" if parts else name)
        return ".".join(reversed(parts)) or "<module>"

    # --- edits --------------------------------------------------------------------------------------

    def replaced(self, replacements: Sequence[Replacement]) -> str:
        """The text after these replacements, which must not overlap."""
        newline = next((m[0] for m in _LINE_END.finditer(self.text)), "\n")
        parts: list[str] = []
        at = 0
        for change in sorted(replacements, key=lambda change: (change.start, change.end)):
            if change.start < at:
                raise RefusedEdit("two changes overlap in the file")
            # Use the file's own line ends.
            parts += [self.text[at : change.start], plain_line_ends(change.text).replace("\n", newline)]
            at = change.end
        return "".join([*parts, self.text[at:]])

    def added_arguments(self, call: ast.Call, texts: Sequence[str]) -> list[Replacement]:
        """Add `texts` (``near=0.01``) after the last argument; on separate lines if each argument has its own
        line."""
        start, close = self.content_span(call)
        items = self.items(call)
        if not texts or not items:
            return [Replacement(close, close, ", ".join(texts))] if texts else []
        end = items[-1][1]
        comma = self.after_comma(end)
        lines = [self.line_at(item[0]) for item in items]
        own_lines = len(set(lines)) == len(lines) and lines[-1] != self.line_at(start)
        closing = self.line_start(self.line_at(close))
        if own_lines and (comma or len(items) > 1) and not self.text[closing:close].strip():
            indent = self.indent(items[-1][0])
            found = [Replacement(closing, closing, "".join(f"{indent}{text},\n" for text in texts))]
            return found if comma else [Replacement(end, end, ","), *found]
        if comma:
            return [Replacement(comma, comma, " " + ", ".join(texts))]
        return [Replacement(end, end, "".join(f", {text}" for text in texts))]

    def added_item(self, node: ast.AST, indent: str, text: Callable[[str], str]) -> list[Replacement]:
        """Add an item between the brackets, on its own lines.

        Args:
            indent: indentation of the statement.
            text: returns the item's code, given the indentation of the item.
        """
        start, close = self.content_span(node)
        items = self.items(node)
        own = indent + "    "
        if not items:
            return [Replacement(start, close, f"\n{own}{text(own)},\n{indent}")]
        end = items[-1][1]
        comma = self.after_comma(end)
        closing = self.line_start(self.line_at(close))
        before = self.text[closing:close]
        one_line = self.line_at(close) == self.line_at(start - 1)
        if not before.strip() and not one_line:
            own = before + "    "
            found = [Replacement(closing, closing, f"{own}{text(own)},\n")]
            return found if comma else [Replacement(end, end, ","), *found]
        found = []
        if one_line:
            # Put each item on its own line, or the first would share a line with the bracket.
            gaps = [start, *(self.after_comma(item[1]) or item[1] for item in items[:-1])]
            found = [Replacement(gap, item[0], f"\n{own}") for gap, item in zip(gaps, items, strict=True)]
        return [
            *found,
            Replacement(comma or end, close, f"{'' if comma else ','}\n{own}{text(own)},\n{indent}"),
        ]

    def without_item(self, node: ast.AST, index: int) -> Replacement:
        """Remove one item between the brackets, with its line and comment if it is alone on the line."""
        items = self.items(node)
        start, end = items[index]
        end = self.after_comma(end) or end
        line_start = self.line_start(self.line_at(start))
        rest_end = self.line_start(self.line_at(end) + 1)
        rest = self.text[end:rest_end].strip()
        if not self.text[line_start:start].strip() and (not rest or rest.startswith("#")):
            return Replacement(line_start, rest_end, "")
        if index + 1 < len(items):
            following = items[index + 1][0]
            return Replacement(start, end if self.text[end:following].strip() else following, "")
        return Replacement(items[index - 1][1] if index else start, end, "")

    def import_place(self) -> int:
        """Offset for a new import: after the docstring and ``__future__`` imports."""
        documented = ast.get_docstring(self.module, clean=False) is not None
        for statement in self.module.body[documented:]:
            if not isinstance(statement, ast.ImportFrom) or statement.module != "__future__":
                decorators = getattr(statement, "decorator_list", ())
                return self.line_start(self.line(decorators[0] if decorators else statement))
        return len(self.text)


def plain_line_ends(text: str) -> str:
    """`text` with ``\\n`` as line ends, as Python reads it."""
    return text.replace("\r\n", "\n").replace("\r", "\n")


def arguments(call: ast.Call, parameters: Sequence[str]) -> dict[str, ast.expr]:
    """The arguments of a call by parameter. ``**``, and positional arguments from the first ``*`` on, are
    left out."""
    first = next((i for i, arg in enumerate(call.args) if isinstance(arg, ast.Starred)), len(call.args))
    given = dict(zip(parameters, call.args[:first], strict=False))
    return given | {keyword.arg: keyword.value for keyword in call.keywords if keyword.arg is not None}


def is_starred(call: ast.Call) -> bool:
    """Whether a call has arguments by ``*`` or ``**``."""
    return any(isinstance(a, ast.Starred) for a in call.args) or any(k.arg is None for k in call.keywords)


FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)


def walk(node: ast.AST) -> Iterator[ast.AST]:
    """`node` and all nodes below it; statements come in the order of the text."""
    waiting = [node]
    while waiting:
        found = waiting.pop()
        yield found
        waiting += reversed(list(ast.iter_child_nodes(found)))


@lru_cache(maxsize=8)
def parse_file(path: str, text: str) -> SourceFile:
    """A `SourceFile`, which is never modified. It is cached, because successive edits concern the same few
    files."""
    return SourceFile(path, text)


# --- values of a call that ran: plain data from a worker ------------------------------------------

DEGREE = math.pi / 180


@dataclass(frozen=True)
class Place:
    """An expression in a file: offsets of its first character and of its end, without parentheses around it."""

    file: str
    start: int
    end: int


@dataclass(frozen=True)
class Read:
    """A name (``EYE``, ``self.eye``, ``EYES[0]``) that was resolved to the assignment of its value."""

    at: Place
    others: str | None
    """Place of another reader of that value, as text; None if there is no other."""


if TYPE_CHECKING:
    Plain = float | str | None | tuple["Plain", ...]
else:  # the message decoder supports no recursive types; four levels of nesting are enough
    _One = float | str | None
    Plain = _One | tuple[_One | tuple[_One | tuple[_One | tuple[_One, ...], ...], ...], ...]


@dataclass(frozen=True, eq=False)
class TracedValue:
    """An expression that is not a name, its value in the run, and its parts that may be edited."""

    at: Place
    reads: tuple[Read, ...]
    """Names that lead to the expression, the name in the call first."""
    value: Plain
    """Value in the run; a pose is seven numbers: p, then q as wxyz."""
    function: str = ""
    """Name (`KnownFunction.name`) of the called function; empty for other expressions."""
    parts: Mapping[str, TracedValue] = field(default_factory=dict)
    """Elements of a list by index, or arguments of a call by parameter. For any other expression: ``of``, the
    number within it that may be edited instead of the whole expression."""
    slope: float = 1.0
    offset: float = 0.0
    """value = slope * `parts["of"].value` + offset"""
    literal: bool = False
    """Whether the value is written as a plain number, perhaps with a sign, or as a list of its items."""

    @property
    def numbers(self) -> tuple[float, ...]:
        """All numbers of the value, in order."""
        return tuple(_numbers(self.value))

    def walk(self) -> Iterator[TracedValue]:
        """This part and all parts within it."""
        yield self
        for part in self.parts.values():
            yield from part.walk()


@dataclass(frozen=True, eq=False)
class Trace:
    """A traced call, with its arguments by parameter."""

    at: Place
    function: str
    """Qualified name of the function that contains the call."""
    parts: Mapping[str, TracedValue]
    """Arguments that could be followed."""
    unknown: Mapping[str, str]
    """Reasons why the other arguments could not be followed."""


def _numbers(value: Plain) -> Iterator[float]:
    if isinstance(value, tuple):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, float):
        yield value
