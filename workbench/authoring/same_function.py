"""Where a line of one version of a file is in another, if the function that it is in is the same."""

from __future__ import annotations

import ast
from collections.abc import Iterator


def line_in(old: str, new: str, line: int) -> int | None:
    """The 1-based line of `new` that is what `line` of `old` was; None where its function says something else now.

    Comments, docstrings and layout do not count. A line outside of all functions is compared as a statement of the
    file. Nothing that the texts may hold raises.
    """
    try:
        before, after = ast.parse(old), ast.parse(new)
    except (SyntaxError, ValueError, RecursionError):  # ValueError: a null byte
        return None
    found = _around(before, line)
    if found is None:
        return None
    names, node = found
    for others, other in _blocks(after, ()):
        if others == names and _says(other) == _says(node):
            return _nearest(old, new, line, node, other)
    return None


def _around(tree: ast.Module, line: int) -> tuple[tuple[str, ...], ast.stmt] | None:
    """The innermost function around a line, or the statement of the file, with the names that lead to it."""
    inner = None
    for names, node in _blocks(tree, ()):
        first = min((d.lineno for d in getattr(node, "decorator_list", [])), default=node.lineno)
        if first <= line <= (node.end_lineno or node.lineno):
            inner = names, node
    return inner


def _blocks(tree: ast.AST, names: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], ast.stmt]]:
    """Functions by their names, outer ones first; and what else stands in a file or a class, by its text."""
    for node in getattr(tree, "body", []):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield (*names, node.name), node
            yield from _blocks(node, (*names, node.name))
        elif isinstance(node, ast.ClassDef):
            yield from _blocks(node, (*names, node.name))
        elif isinstance(tree, (ast.Module, ast.ClassDef)) and isinstance(node, ast.stmt):
            yield (*names, ast.dump(node)), node


def _says(node: ast.stmt) -> str:
    if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
        return ast.dump(node)
    body = node.body[ast.get_docstring(node) is not None :]
    return "\n".join(map(ast.dump, [*node.decorator_list, node.args, *body]))


def _nearest(old: str, new: str, line: int, before: ast.stmt, after: ast.stmt) -> int:
    """Of the lines of `after` that read as this one, the one that is as far into it; that far into it if none does."""
    text = old.splitlines()[line - 1].strip()
    at = after.lineno + line - before.lineno
    end = after.end_lineno or after.lineno
    lines = new.splitlines()
    same = [i for i in range(after.lineno, end + 1) if lines[i - 1].strip() == text]
    return min(same, key=lambda i: abs(i - at), default=min(max(at, after.lineno), end))
