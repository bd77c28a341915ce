"""Where the parts of a source text begin and end."""

from __future__ import annotations

import ast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from workbench.source.parsed import parse_file

AROUND = [
    "f({})",
    "f(a, {})",
    "f({}, b)",
    "f(near={})",
    "f(near={}, far=b)",
    "f(*{})",
    "{}(a)",
    "({}, a)",
    "[{}]",
    "{} + a",
    "a - {}",
    "-{}",
    "value = {}",
    "{}.shape",
    "a[{}]",
    "(yield {})",
]


@pytest.mark.parametrize("around", AROUND)
@given(count=st.integers(0, 4), space=st.sampled_from(["", " ", "\n", "  # why (\n    "]))
def test_the_span_of_an_expression_has_its_own_parentheses_and_no_others(
    around: str, count: int, space: str
) -> None:
    own = "x" if count == 0 else f"{f'({space}' * count}x{f'{space})' * count}"
    text = f"def g():\n    {around.format(own)}\n"
    file = parse_file("a.py", text)
    (node,) = (one for one in file.nodes if isinstance(one, ast.Name) and one.id == "x")
    start, end = file.span(node)
    assert text[start:end] == own
