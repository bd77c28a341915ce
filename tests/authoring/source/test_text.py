"""Edits of a file's text at a place that is known by its node."""

from __future__ import annotations

import ast

import pytest

from workbench.authoring.source.text import SourceFile


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("f()\n", "f(far=100)\n"),
        ("f(1)\n", "f(1, far=100)\n"),
        ("f(1, )\n", "f(1, far=100 )\n"),
        ("f(\n    1,\n    near=2,\n)\n", "f(\n    1,\n    near=2,\n    far=100,\n)\n"),
        ("f(\n    1,\n    near=2\n)\n", "f(\n    1,\n    near=2,\n    far=100,\n)\n"),
        # Whoever hangs the first argument elsewhere goes on at the indent of the last.
        ("f(\n  1,\n      near=2,\n)\n", "f(\n  1,\n      near=2,\n      far=100,\n)\n"),
        ("f(1,\n  near=2)\n", "f(1,\n  near=2, far=100)\n"),
    ],
)
def test_an_argument_is_added_as_the_last_one_stands(before: str, after: str) -> None:
    file = SourceFile("task.py", before)
    (call,) = (node for node in file.nodes if isinstance(node, ast.Call))
    assert file.replaced(file.added_arguments(call, ["far=100"])) == after
