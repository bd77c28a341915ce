"""The symbols of two versions of a task, and which of them changed and may reach each other."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import PurePath

from workbench.authoring.reload.symbols import Key, Symbol, read_symbols


class TwoVersions:
    """One graph of both versions: nodes are symbols by file and name, edges the names that either version mentions.

    A name that either version mentions may be used by whichever runs. Pure: nothing is imported or executed.
    """

    def __init__(self, old: Mapping[str, str], new: Mapping[str, str]) -> None:
        """
        Args:
            old, new: texts by path.

        Raises:
            SyntaxError, ValueError, RecursionError: a text cannot be read as Python.
        """
        keep_docstrings = any("__doc__" in text for text in (*old.values(), *new.values()))
        self.old = _read_all(old, keep_docstrings)
        self.new = _read_all(new, keep_docstrings)
        self.by_key: dict[Key, list[Symbol]] = {}
        """The symbol in the versions that have it, the old one first."""
        self._named: dict[str, set[Key]] = {}
        for symbol in (*self.old.values(), *self.new.values()):
            self.by_key.setdefault(symbol.key, []).append(symbol)
            for name in symbol.short_names:
                self._named.setdefault(name, set()).add(symbol.key)
        self.symbols = [symbol for versions in self.by_key.values() for symbol in versions]
        self._reached: dict[Key, set[Key]] = {}
        self.changed = [
            key
            for key in self.by_key
            if key not in self.old or key not in self.new or self.old[key].text != self.new[key].text
        ]
        self.libraries = self._imported_libraries({*old, *new})
        """Names that are imported from libraries."""

    def mentioned(self, symbol: Symbol) -> set[Key]:
        """All symbols that a name in `symbol` may mean."""
        return {key for name in symbol.mentions & self._named.keys() for key in self._named[name]}

    def reach(self, roots: Iterable[Key]) -> dict[Key, Key | None]:
        """All symbols that can be reached from `roots`, each with the one it was reached from (None for a root)."""
        found: dict[Key, Key | None] = dict.fromkeys(roots)
        waiting = list(found)
        while waiting:
            key = waiting.pop()
            for reached in self._edges(key):
                if reached not in found:
                    found[reached] = key
                    waiting.append(reached)
        return found

    def affected(self) -> set[Key]:
        """The changed symbols, and all that may reach one of them."""
        users: dict[Key, set[Key]] = {}
        for key in self.by_key:
            for used in self._edges(key):
                users.setdefault(used, set()).add(key)
        found, waiting = set(self.changed), list(self.changed)
        while waiting:
            for user in users.get(waiting.pop(), ()):
                if user not in found:
                    found.add(user)
                    waiting.append(user)
        return found

    def members(self, classes: Collection[Key], names: Collection[str]) -> set[Key]:
        """Members of `classes` that have one of these names."""
        return {
            key
            for key, (symbol, *_) in self.by_key.items()
            if symbol.owner is not None and (symbol.path, symbol.owner) in classes and symbol.short in names
        }

    def siblings(self, family: set[Key]) -> set[Key]:
        """Other tasks in the files, which have no live env."""
        found: set[Key] = set()
        tasks, before = {"BaseEnv", *(name for _, name in family)}, -1
        while before != len(found):
            before = len(found)
            for key, versions in self.by_key.items():
                if versions[0].kind == "class" and key not in family and versions[0].mentions & tasks:
                    found.add(key)
                    tasks.add(key[1])
        return found

    def _edges(self, key: Key) -> set[Key]:
        if key not in self._reached:
            self._reached[key] = {k for symbol in self.by_key[key] for k in self.mentioned(symbol)} - {key}
        return self._reached[key]

    def _imported_libraries(self, files: Collection[str]) -> frozenset[str]:
        stems = {PurePath(path).stem for path in files} | {PurePath(p).parent.name for p in files}
        found: set[str] = set()
        for symbol in self.symbols:
            for node in symbol.nodes if symbol.kind == "import" else ():
                if isinstance(node, ast.ImportFrom):
                    parts = {*(node.module or "").split("."), *(alias.name for alias in node.names)}
                    own = node.level > 0 or bool(parts & stems)
                else:
                    assert isinstance(node, ast.Import)
                    own = any(set(alias.name.split(".")) & stems for alias in node.names)
                found |= set() if own else symbol.short_names
        return frozenset(found)


def _read_all(texts: Mapping[str, str], keep_docstrings: bool) -> dict[Key, Symbol]:
    found: dict[Key, Symbol] = {}
    for path, text in texts.items():
        found.update(read_symbols(path, text, keep_docstrings))
    return found


# --- lines in another version --------------------------------------------------------------------


def line_in(old: str, new: str, line: int) -> int | None:
    """The 1-based line of `new` that corresponds to `line` of `old`; None if its function changed.

    Comments, docstrings and layout do not count. A line outside of functions is compared as a statement of the file. No
    content of the texts raises.
    """
    try:
        before, after = ast.parse(old), ast.parse(new)
    except (SyntaxError, ValueError, RecursionError):  # ValueError: a null byte
        return None
    found = _block_at(before, line)
    if found is None:
        return None
    names, node = found
    for others, other in _blocks(after, ()):
        if others == names and _code_text(other) == _code_text(node):
            return _matching_line(old, new, line, node, other)
    return None


def _block_at(tree: ast.Module, line: int) -> tuple[tuple[str, ...], ast.stmt] | None:
    """The innermost function (or top-level statement) that contains a line, with its qualified name."""
    inner = None
    for names, node in _blocks(tree, ()):
        first = min((d.lineno for d in getattr(node, "decorator_list", [])), default=node.lineno)
        if first <= line <= (node.end_lineno or node.lineno):
            inner = names, node
    return inner


def _blocks(tree: ast.AST, names: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], ast.stmt]]:
    """Functions by qualified name, outer ones first; other statements of a file or class by their text."""
    for node in getattr(tree, "body", []):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield (*names, node.name), node
            yield from _blocks(node, (*names, node.name))
        elif isinstance(node, ast.ClassDef):
            yield from _blocks(node, (*names, node.name))
        elif isinstance(tree, (ast.Module, ast.ClassDef)) and isinstance(node, ast.stmt):
            yield (*names, ast.dump(node)), node


def _code_text(node: ast.stmt) -> str:
    if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
        return ast.dump(node)
    body = node.body[ast.get_docstring(node) is not None :]
    return "\n".join(map(ast.dump, [*node.decorator_list, node.args, *body]))


def _matching_line(old: str, new: str, line: int, before: ast.stmt, after: ast.stmt) -> int:
    """The line of `after` with the same text that is nearest to the same offset; the offset itself if none has it."""
    text = old.splitlines()[line - 1].strip()
    at = after.lineno + line - before.lineno
    end = after.end_lineno or after.lineno
    lines = new.splitlines()
    same = [i for i in range(after.lineno, end + 1) if lines[i - 1].strip() == text]
    return min(same, key=lambda i: abs(i - at), default=min(max(at, after.lineno), end))
