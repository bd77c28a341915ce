"""One file as a syntax tree whose nodes know their place in the text, and edits that replace spans of that text.

Whatever is not replaced is the same to the last character, without anything having to be printed again.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

Function = ast.FunctionDef | ast.AsyncFunctionDef
Scope = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
Span = tuple[int, int]
"""First character and the one behind the last."""
LOOPS = (ast.For, ast.AsyncFor, ast.While, ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)

_LINE_END = re.compile(r"\r\n?|\n")
"""Python's own idea of a line; str.splitlines has more."""
_BLANK = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


class RefusedEdit(Exception):
    """Ends a plan from anywhere inside, with the reason; its callers make a sentence for the author of it."""

    def __init__(self, reason: str, snippet: str = "") -> None:
        super().__init__(reason)
        self.reason, self.snippet = reason, snippet
        """Why the file is left alone, and what the author can copy into it themselves."""


@dataclass(frozen=True)
class Replacement:
    start: int
    end: int
    text: str


class SourceFile:
    """A parsed file. Raises `RefusedEdit` for a text that is not Python."""

    def __init__(self, path: str, text: str) -> None:
        self.path = path
        self.text = text
        try:
            self.module = ast.parse(text)
        except (SyntaxError, ValueError, RecursionError, MemoryError) as exc:
            said = f"line {exc.lineno}: {exc.msg}" if isinstance(exc, SyntaxError) else str(exc)
            raise RefusedEdit(f"{self.name} is not valid Python as it stands: {said}") from exc
        self._starts = [0, *(m.end() for m in _LINE_END.finditer(text))]
        self.nodes = list(walk(self.module))
        """All, nearly in the order of the text."""
        self.parents = {child: node for node in self.nodes for child in ast.iter_child_nodes(node)}

    @property
    def name(self) -> str:
        return re.split(r"[\\/]", self.path)[-1]

    # --- places -------------------------------------------------------------------------------------

    def inner_span(self, node: ast.AST) -> Span:
        """Offsets of a node that has a place of its own, without parentheses around it."""
        place: ast.expr = node  # type: ignore[assignment]
        assert place.end_lineno is not None and place.end_col_offset is not None
        return self._offset(place.lineno, place.col_offset), self._offset(
            place.end_lineno, place.end_col_offset
        )

    def _offset(self, line: int, column: int) -> int:
        """Of a column in bytes of UTF-8, as Python counts them."""
        start = self._starts[line - 1]
        if self.text.isascii():
            return start + column
        return start + len(self.line_text(line).encode()[:column].decode())

    def span(self, node: ast.AST) -> Span:
        """Offsets with the parentheses around it."""
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
        """Where the parentheses of a node must lie: those of a call around it are not its own."""
        outer = self.parents.get(node)
        if isinstance(outer, ast.keyword):
            node, outer = outer, self.parents[outer]
        if isinstance(outer, ast.Call) and node is not outer.func:
            return self.inside(outer)
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
        """Where the first of these words or signs begins, from `start` on."""
        following = self._tokens[bisect_left(self._tokens, (start,)) :]
        return next(begin for begin, _, token in following if token == string)

    def after_comma(self, end: int) -> int | None:
        """Behind the comma that follows; None where none does."""
        following = bisect_left(self._tokens, (end,))
        if following < len(self._tokens) and self._tokens[following][2] == ",":
            return self._tokens[following][1]
        return None

    def inside(self, node: ast.AST) -> Span:
        """What is between the brackets of a call, list, dict or tuple."""
        start, end = self.inner_span(node)
        if isinstance(node, ast.Call):
            start = self._tokens[bisect_left(self._tokens, (self.span(node.func)[1],))][0]
        return start + 1, end - 1

    def items(self, node: ast.AST) -> list[Span]:
        """The arguments of a call, or the elements of a list, tuple or dict."""
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
        """The one that is exactly there. Raises RefusedEdit where none is."""
        if span not in self._expressions:
            raise RefusedEdit(
                f"{self.name} is another text than the one that ran; save it, let it load and ask again"
            )
        return self._expressions[span]

    def at(self, line: int, end_line: int, column: int, end_column: int) -> ast.expr | None:
        """The expression at a place as code objects have it (``co_positions``)."""
        if not 0 < line <= end_line <= len(self._starts):
            return None
        return self._expressions.get((self._offset(line, column), self._offset(end_line, end_column)))

    def line(self, node: ast.AST) -> int:
        return self.line_at(self.inner_span(node)[0])

    def line_at(self, offset: int) -> int:
        return bisect_right(self._starts, offset)

    def line_text(self, line: int) -> str:
        """One line without its end; of the line behind the last, nothing."""
        start = self.line_start(line)
        match = _LINE_END.search(self.text, start)
        return self.text[start : match.start() if match else len(self.text)]

    def line_start(self, line: int) -> int:
        return self._starts[line - 1] if line <= len(self._starts) else len(self.text)

    def indent(self, offset: int) -> str:
        """Of the line at an offset."""
        line = self.line_text(self.line_at(offset))
        return line[: len(line) - len(line.lstrip())]

    def code(self, node: ast.AST) -> str:
        start, end = self.span(node)
        return self.text[start:end]

    def short(self, node: ast.AST) -> str:
        """On one line, for a sentence."""
        line = " ".join(self.code(node).split())
        return line if len(line) <= 60 else line[:57] + "..."

    # --- what is around -----------------------------------------------------------------------------

    def ancestors(self, node: ast.AST) -> Iterator[ast.AST]:
        """From its parent outwards."""
        while node in self.parents:
            node = self.parents[node]
            yield node

    def scopes(self, node: ast.AST) -> list[Scope]:
        """What `node` is inside of, innermost first, the module last.

        What stands in the head of a function (defaults, decorators) is not inside of it.
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
        """Of a class or function, as Python has it; of the code that any other node is in."""
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
        """The text with `replacements`, which must not overlap."""
        newline = next((m[0] for m in _LINE_END.finditer(self.text)), "\n")
        parts: list[str] = []
        at = 0
        for change in sorted(replacements, key=lambda change: (change.start, change.end)):
            if change.start < at:
                raise RefusedEdit("two changes fall on the same place of the file")
            # The file's own line ends, whatever was composed here.
            parts += [self.text[at : change.start], plain_line_ends(change.text).replace("\n", newline)]
            at = change.end
        return "".join([*parts, self.text[at:]])

    def added_arguments(self, call: ast.Call, texts: Sequence[str]) -> list[Replacement]:
        """`texts` (``near=0.01``) after the last argument: on lines of their own where the others have that."""
        start, close = self.inside(call)
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
        """`text(indent)` as one more item between the brackets, on lines of its own; `indent` is the statement's."""
        start, close = self.inside(node)
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
            # What stood on one line gets a line each, or the first would share one with the bracket.
            gaps = [start, *(self.after_comma(item[1]) or item[1] for item in items[:-1])]
            found = [Replacement(gap, item[0], f"\n{own}") for gap, item in zip(gaps, items, strict=True)]
        return [
            *found,
            Replacement(comma or end, close, f"{'' if comma else ','}\n{own}{text(own)},\n{indent}"),
        ]

    def without_item(self, node: ast.AST, index: int) -> Replacement:
        """One item fewer between the brackets; a line that it has for itself goes with it, and a remark at its end."""
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
        """Where an import can be added: before all that may use it, behind what has to come before any."""
        documented = ast.get_docstring(self.module, clean=False) is not None
        for statement in self.module.body[documented:]:
            if not isinstance(statement, ast.ImportFrom) or statement.module != "__future__":
                decorators = getattr(statement, "decorator_list", ())
                return self.line_start(self.line(decorators[0] if decorators else statement))
        return len(self.text)


def plain_line_ends(text: str) -> str:
    """As Python reads it: every line ends with ``\\n``."""
    return text.replace("\r\n", "\n").replace("\r", "\n")


def arguments(call: ast.Call, parameters: Sequence[str]) -> dict[str, ast.expr]:
    """What a call gives, by parameter, but for what comes by ``*`` and ``**``."""
    first = next((i for i, arg in enumerate(call.args) if isinstance(arg, ast.Starred)), len(call.args))
    given = dict(zip(parameters, call.args[:first], strict=False))
    return given | {keyword.arg: keyword.value for keyword in call.keywords if keyword.arg is not None}


def is_starred(call: ast.Call) -> bool:
    """Whether arguments come by ``*`` or ``**``."""
    return any(isinstance(a, ast.Starred) for a in call.args) or any(k.arg is None for k in call.keywords)


FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)


def walk(node: ast.AST) -> Iterator[ast.AST]:
    """`node` and all below it, statements in the order of the text."""
    waiting = [node]
    while waiting:
        found = waiting.pop()
        yield found
        waiting += reversed(list(ast.iter_child_nodes(found)))


@lru_cache(maxsize=8)
def parsed(path: str, text: str) -> SourceFile:
    """A `SourceFile`, which is never changed: edit after edit is one of the same few files."""
    return SourceFile(path, text)
