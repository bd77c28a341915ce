"""Parses Python text, one thread at a time."""

from __future__ import annotations

import ast
import threading

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
