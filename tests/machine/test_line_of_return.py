"""Which line of a function is shown for a value that it returned."""

from __future__ import annotations

from pathlib import Path

import pytest

from workbench.machine.parse_python import line_of_return

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
