"""What docstrings name exists: parameters under Args, exceptions under Raises, files in the documents."""

from __future__ import annotations

import ast
import builtins
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "workbench"
SECTION = re.compile(r"^([ ]*)(Args|Raises):\n((?:\1[ ]+.*\n|[ ]*\n)+)", re.MULTILINE)
ENTRY = re.compile(r"^([ ]+)([\w., ]+):", re.MULTILINE)
PATH_IN_A_DOCUMENT = re.compile(r"`((?:workbench/|tests/|tasks/)?[\w/]+\.(?:py|toml|html))`")


def entries(doc: str, section: str) -> Iterator[str]:
    """Names that begin an entry of this section: the least indented ones, of ``a, b: ...`` both."""
    for match in SECTION.finditer(doc + "\n"):
        if match[2] == section:
            found = [(len(one[1]), one[2]) for one in ENTRY.finditer(match[3])]
            least = min((indent for indent, _ in found), default=0)
            for indent, names in found:
                if indent == least:
                    yield from (name.strip() for name in names.split(","))


def parameters(node: ast.AST) -> set[str] | None:
    """Of a function, or of what makes an object of a class; None where that is inherited."""
    if isinstance(node, ast.ClassDef):
        fields = {
            one.target.id
            for one in node.body
            if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)
        }
        for one in node.body:
            if isinstance(one, ast.FunctionDef) and one.name == "__init__":
                return fields | (parameters(one) or set())
        return fields or None
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        a = node.args
        every = (*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg)))
        return {one.arg for one in every}
    return None


FILES = sorted(PACKAGE.rglob("*.py"))


@cache
def trees() -> dict[Path, ast.Module]:
    return {file: ast.parse(file.read_text()) for file in FILES}


@cache
def defined() -> set[str]:
    """Names of the package's classes."""
    nodes = (node for tree in trees().values() for node in ast.walk(tree))
    return {node.name for node in nodes if isinstance(node, ast.ClassDef)}


def documented() -> Iterator[tuple[str, ast.AST, str]]:
    for file, tree in trees().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                doc = ast.get_docstring(node)
                if doc:
                    yield f"{file.relative_to(ROOT)}:{node.lineno} {node.name}", node, doc


def test_what_stands_under_args_is_a_parameter() -> None:
    wrong = [
        (place, name)
        for place, node, doc in documented()
        if (known := parameters(node)) is not None
        for name in entries(doc, "Args")
        if name.isidentifier() and name not in known
    ]
    assert wrong == []


def test_what_stands_under_raises_is_an_exception_that_there_is() -> None:
    imported = {
        alias.asname or alias.name
        for tree in trees().values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    known = defined() | imported | set(vars(builtins))
    wrong = [
        (place, name)
        for place, _, doc in documented()
        for name in entries(doc, "Raises")
        if name.rpartition(".")[2] not in known and name.isidentifier()
    ]
    assert wrong == []


@pytest.mark.parametrize("page", sorted((ROOT / "web_assets/docs").rglob("*.md")), ids=lambda page: page.stem)
def test_every_file_that_a_document_names_is_there(page: Path) -> None:
    named = set(PATH_IN_A_DOCUMENT.findall(page.read_text()))
    gone = [
        name
        for name in named
        if not any((folder / name).exists() for folder in (ROOT, PACKAGE, page.parent)) and "/" in name
    ]
    assert sorted(gone) == []
