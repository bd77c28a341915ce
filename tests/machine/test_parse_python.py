"""Parsing in several threads, and which line of a function is shown for a value that it returned."""

from __future__ import annotations

import gc
import sys
import threading
import time
from pathlib import Path

import pytest

from workbench.machine.parse_python import line_of_return, parse_python

PACKAGE = Path(__file__).parents[2] / "workbench"


@pytest.mark.thorough
def test_threads_can_parse_during_garbage_collection() -> None:
    text, failures = (PACKAGE / "envs" / "maniskill_private.py").read_text(), []

    def parse(depth: int) -> None:
        if depth:
            return parse(depth - 1)
        for _ in range(25):
            try:
                parse_python(text)
            except SystemError as error:
                failures.append(error)

    def switch_thread(phase: str, info: dict[str, int]) -> None:
        """Switch threads during a collection, as a finalizer may, while the parser builds a tree."""
        time.sleep(0)

    threads = [threading.Thread(target=parse, args=(depth,)) for depth in (0, 30, 60, 90)]
    before = sys.getswitchinterval()
    gc.callbacks.append(switch_thread)
    sys.setswitchinterval(1e-5)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(before)
        gc.callbacks.remove(switch_thread)
    assert failures == []


def test_a_syntax_error_has_its_line_and_file() -> None:
    with pytest.raises(SyntaxError) as raised:
        parse_python("x = 1\nif\n", "task.py")
    assert (raised.value.lineno, raised.value.filename) == (2, "task.py")


# --- the line of a returned value ------------------------------------------------------------------------

TEXT = """\
import functools


@functools.cache
@staticmethod
def decorated():
    def inner():
        return 1

    class Inner:
        def method(self):
            return 2

    key = lambda: 3
    if key:
        return 4


async def plain():
    return 5


def several(x):
    if x:
        return 1
    return 2


def none():
    pass
"""


def at(words: str) -> int:
    return TEXT[: TEXT.index(words)].count("\n") + 1


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        *[(at(words), at("return 4")) for words in ("@functools.cache", "@staticmethod", "def decorated")],
        (at("def inner"), at("return 1\n\n    class")),
        (at("def method"), at("return 2\n\n    key")),
        (at("async def plain"), at("return 5")),
        (at("def several"), at("def several")),
        (at("def none"), at("def none")),
        (at("import functools"), at("import functools")),
        (999, 999),
    ],
)
def test_the_only_return_of_a_function_is_found(tmp_path: Path, line: int, wanted: int) -> None:
    file = tmp_path / "task.py"
    file.write_text(TEXT)
    assert line_of_return(str(file), line) == wanted


def test_a_file_that_is_no_longer_python_gives_the_line_itself(tmp_path: Path) -> None:
    (tmp_path / "task.py").write_text("def broken(:\n    return 1\n")
    assert line_of_return(str(tmp_path / "task.py"), 1) == 1
    assert line_of_return(str(tmp_path / "gone.py"), 3) == 3
