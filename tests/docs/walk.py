"""The tutorial as steps: the edits of the reader's files, and the mistakes that it shows."""

from __future__ import annotations

import ast
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.docs.pages import DOCS, Fence, fences
from workbench.task.new_task import write_new_task

PAGE = DOCS / "tutorial.md"
FILE = "push_it.py"
"""The task that the reader writes."""
_NAMED = re.compile(r"# (\w+\.py)\n")
_HEADING = re.compile(r"^## (.+)$", re.MULTILINE)


@dataclass(frozen=True)
class Step:
    """The content under one heading."""

    title: str
    fences: tuple[Fence, ...]


def _steps() -> tuple[Step, ...]:
    text = PAGE.read_text()
    heads = [(text.count("\n", 0, match.start()) + 1, match[1]) for match in _HEADING.finditer(text)]
    ends = [line for line, _ in heads[1:]] + [text.count("\n") + 1]
    found = [
        Step(title, tuple(fence for fence in fences(PAGE) if begin < fence.line < end))
        for (begin, title), end in zip(heads, ends, strict=True)
    ]
    return tuple(step for step in found if step.fences)


STEPS = _steps()
"""The steps that have fences."""


def after(count: int, folder: Path) -> None:
    """Write the files that a reader has after the first `count` steps."""
    if count:
        write_new_task(FILE.removesuffix(".py"), "minimal", folder)
    for fence in (fence for step in STEPS[:count] for fence in step.fences if fence.language == "python"):
        write(fence, folder)


def write(fence: Fence, folder: Path) -> None:
    """Apply a Python fence to the files in the folder, as the reader would.

    If the first line is a comment with a file name, the fence is that whole file. Otherwise its imports and constants go
    below the task's imports, and its docstring, attributes and methods replace those of the same name in the class.
    """
    named = _NAMED.match(fence.text)
    if named is not None:
        (folder / named[1]).write_text(fence.text)
        return
    file = folder / FILE
    of_class = fence.text.startswith(" ")
    edit = _into_class if of_class else _below_imports
    file.write_text(edit(file.read_text(), textwrap.dedent(fence.text)))


def mistake(fence: Fence, text: str) -> str:
    """Apply a ``diff`` fence to the task's text, which must contain its old lines exactly once."""
    lines = fence.text.splitlines()
    assert all(line[:1] in ("-", "+", " ") for line in lines), fence.place
    old, new = (
        "".join(f"{line[1:]}\n" for line in lines if line[0] in kept) for kept in ((" ", "-"), (" ", "+"))
    )
    assert old != new and text.count(old) == 1, (
        f"{fence.place}: the task has these lines {text.count(old)} times"
    )
    return text.replace(old, new)


# --- edits of the task -----------------------------------------------------------------------------------


def _below_imports(text: str, added: str) -> str:
    imports = [node for node in ast.parse(text).body if isinstance(node, (ast.Import, ast.ImportFrom))]
    gap = "" if isinstance(ast.parse(added).body[0], (ast.Import, ast.ImportFrom)) else "\n"
    return _with_lines(text, [(imports[-1].end_lineno or 0, 0, gap + added)])


def _into_class(text: str, added: str) -> str:
    (task,) = (node for node in ast.parse(text).body if isinstance(node, ast.ClassDef))
    there = {_name(node): node for node in task.body}
    first_method = next(node for node in task.body if isinstance(node, ast.FunctionDef))
    changes: list[tuple[int, int, str]] = []
    for node in ast.parse(added).body:
        lines = added.splitlines(keepends=True)[_first(node) - 1 : node.end_lineno]
        new = textwrap.indent("".join(lines), "    ")
        name = _name(node)
        assert name, f"neither a method nor an attribute: {new}"
        if (old := there.get(name)) is not None:
            changes.append((_first(old) - 1, (old.end_lineno or 0) - _first(old) + 1, new))
        elif isinstance(node, ast.FunctionDef):
            changes.append((task.end_lineno or 0, 0, f"\n{new}"))
        else:
            changes.append((_first(first_method) - 2, 0, new))
    return _with_lines(text, changes)


def _with_lines(text: str, changes: Sequence[tuple[int, int, str]]) -> str:
    """Apply changes (line number, number of lines removed, new text); changes at one place keep their order."""
    lines = text.splitlines(keepends=True)
    for at, removed, new in sorted(changes, key=lambda change: change[0])[::-1]:
        lines[at : at + removed] = [new]
    return "".join(lines)


def _first(node: ast.stmt) -> int:
    """The line of the node's first decorator, or its own line."""
    return min([node.lineno, *(each.lineno for each in getattr(node, "decorator_list", ()))])


def _name(node: ast.stmt) -> str:
    if isinstance(node, ast.FunctionDef):
        return node.name
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return "__doc__"
    target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
    return target.id if isinstance(target, ast.Name) else ""
