"""Parses Python text, one thread at a time."""

from __future__ import annotations

import ast
import linecache
import threading
from collections.abc import Iterable, Iterator
from functools import lru_cache

_lock = threading.Lock()


def parse_python(text: str | bytes, file: str = "<unknown>") -> ast.Module:
    """Parse Python text as ``ast.parse`` does, safely in several threads.

    Before Python 3.12, and in some releases of 3.11 (seen in 3.11.7), all threads share one counter for the depth of the
    tree that they build. If a finalizer lets another thread run meanwhile, ``ast.parse`` raises SystemError for valid text
    (github.com/python/cpython, issue 106905).

    Raises:
        SyntaxError, ValueError: as ``ast.parse``.
    """
    with _lock:
        return ast.parse(text, file)


def line_of_return(file: str, line: int) -> int:
    """1-based line of the only ``return`` of the function whose ``def`` or first decorator is at `line`; `line` if the
    function has several, or none."""
    return _line_of_return("".join(linecache.getlines(file)), line)


@lru_cache(maxsize=64)
def _line_of_return(text: str, line: int) -> int:
    try:
        tree = parse_python(text)
    except (SyntaxError, ValueError):  # the file was edited since it was loaded
        return line
    for node in ast.walk(tree):
        if isinstance(node, _FUNCTIONS):
            first = min(each.lineno for each in (node, *node.decorator_list))
            if first <= line <= node.lineno:
                lines = [*_returns(node.body)]
                return lines[0] if len(lines) == 1 else line
    return line


_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def _returns(body: Iterable[ast.AST]) -> Iterator[int]:
    """Lines of the ``return`` statements, without those of inner functions and classes."""
    for node in body:
        if isinstance(node, ast.Return):
            yield node.lineno
        elif not isinstance(node, (*_FUNCTIONS, ast.ClassDef, ast.Lambda)):
            yield from _returns(ast.iter_child_nodes(node))
