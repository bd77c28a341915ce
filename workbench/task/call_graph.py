"""The symbols of two versions of a task: which of them changed, and which may reach which."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import PurePath
from typing import Literal

from workbench.machine.parse_python import parse_python

Kind = Literal["function", "value", "import", "class", "statements"]
Key = tuple[str, str]
"""File and name within it: ``("/x/push.py", "PushEnv.evaluate")``."""

STATEMENTS = "(statements)"
"""Name of the symbol of all statements that are not definitions; they run in order when the file is imported."""

_INTROSPECTION = frozenset(
    (
        "globals locals vars eval exec compile __import__ dir breakpoint __dict__ __getattribute__ __code__ "
        "__globals__ __subclasses__ __mro__ __bases__ __defaults__ __kwdefaults__ __closure__ __wrapped__ "
        "f_globals f_locals f_lineno _getframe attrgetter methodcaller import_module getmembers getsource "
        "__annotations__ __func__ __reduce__ __getstate__ __setstate__ __builtins__ modules"
    ).split()
)
_INTROSPECTION_MODULES = frozenset(
    (
        "inspect importlib gc ctypes pickle dill cloudpickle marshal builtins runpy pkgutil threading "
        "multiprocessing asyncio concurrent atexit signal traceback linecache"
    ).split()
)


@dataclass(frozen=True)
class Symbol:
    """A function, method, constant, class attribute, import or class; or the other statements of a scope.

    Names are not resolved: ``x.reset`` may be any ``reset``, so it counts as a mention of every ``reset`` in
    all files. A string that is an identifier counts as a name (``getattr(self, "reset")``). For computed
    names, and code that inspects itself, see `dynamic`.
    """

    path: str
    name: str
    kind: Kind
    parts: Sequence[ast.AST]
    """The nodes that form `text`; for a class, without its members."""
    nodes: Sequence[ast.AST]
    """Nodes of the symbol; several, for example, for a property with its setter."""
    short_names: frozenset[str]
    """Names by which other code may mention the symbol."""
    owner: str | None = None
    """Class that a member belongs to."""

    @cached_property
    def text(self) -> str:
        """The code without comments, docstrings and layout; equal in two versions if and only if the code is
        equal."""
        return "\n".join([self.kind, *map(ast.dump, self.parts)])

    @cached_property
    def _mentions(self) -> tuple[frozenset[str], str | None]:
        return _mentions(self.parts)

    @property
    def mentions(self) -> frozenset[str]:
        """Names of variables and attributes in the symbol, and strings that are identifiers."""
        return self._mentions[0]

    @property
    def dynamic(self) -> str | None:
        """A name in the symbol by which it may reach code that it does not mention; None if there is none."""
        return self._mentions[1]

    @property
    def key(self) -> Key:
        return self.path, self.name

    @property
    def short(self) -> str:
        """The name within its class."""
        return self.name.rpartition(".")[2]


def read_symbols(path: str, text: str, keep_docstrings: bool = False) -> dict[Key, Symbol]:
    """The symbols of one file, in order. Raises SyntaxError, as ``compile`` does."""
    tree = parse_python(text, path)
    if not keep_docstrings:
        _remove_docstrings(tree)
    return {symbol.key: symbol for symbol in _scope(path, tree.body, None)}


def _scope(path: str, body: list[ast.stmt], owner: str | None) -> Iterator[Symbol]:
    groups: dict[str, list[ast.stmt]] = {}
    loose: list[ast.stmt] = []
    for statement in body if owner is not None else _one_import_each(body):
        name = _defines(statement, at_top=owner is None)
        if name is not None:
            groups.setdefault(name, []).append(statement)
        elif not isinstance(statement, ast.Pass) and not _runs_as_script_only(statement):
            loose.append(statement)
    taken = _bound(loose)
    for name, statements in list(groups.items()):
        several = len(statements) > 1 and not all(isinstance(s, ast.FunctionDef) for s in statements)
        if name in taken or several:
            # Which definition is in effect depends on what ran, so all of them form one symbol.
            loose += groups.pop(name)
    prefix = "" if owner is None else f"{owner}."
    for name, statements in groups.items():
        first = statements[0]
        if isinstance(first, ast.ClassDef) and owner is None:
            head = [*first.decorator_list, *first.bases, *first.keywords, *getattr(first, "type_params", [])]
            yield Symbol(path, name, "class", head, [first], frozenset({name}))
            yield from _scope(path, first.body, name)
        else:
            functions = isinstance(first, (ast.FunctionDef, ast.AsyncFunctionDef))
            kind: Kind = (
                "function"
                if functions
                else "import"
                if isinstance(first, (ast.Import, ast.ImportFrom))
                else "value"
            )
            yield Symbol(path, prefix + name, kind, statements, statements, _bound(statements), owner)
    if loose:
        loose.sort(key=lambda statement: statement.lineno)
        yield Symbol(path, prefix + STATEMENTS, "statements", loose, loose, _bound(loose), owner)


def _bound(statements: Iterable[ast.AST]) -> frozenset[str]:
    return frozenset(name for statement in statements for name in bound_names(statement))


def _defines(statement: ast.stmt, at_top: bool) -> str | None:
    """The name of a plain definition; None for other statements."""
    if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef)):
        return statement.name
    if isinstance(statement, ast.ClassDef):
        return statement.name if at_top else None
    if isinstance(statement, (ast.Import, ast.ImportFrom)) and at_top:
        alias = statement.names[0]
        if alias.name == "*":
            return ast.unparse(statement)
        return alias.asname or alias.name.partition(".")[0]
    if isinstance(statement, ast.Assign) and len(statement.targets) == 1:
        target = statement.targets[0]
        return target.id if isinstance(target, ast.Name) else None
    if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
        return statement.target.id
    return None


def _one_import_each(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """The statements of `body`, with one import statement for each imported name: ``from x import a, b``
    becomes two statements. So a name can be added to the import without changing the symbols of a and b."""
    for statement in body:
        if isinstance(statement, ast.ImportFrom) and statement.module == "__future__":
            # Skip it: annotations are ignored, and the other features are the default now.
            continue
        if isinstance(statement, ast.Import):
            yield from (ast.copy_location(ast.Import([alias]), statement) for alias in statement.names)
        elif isinstance(statement, ast.ImportFrom):
            module, level = statement.module, statement.level
            for alias in statement.names:
                yield ast.copy_location(ast.ImportFrom(module, [alias], level), statement)
        else:
            yield statement


def bound_names(statement: ast.AST) -> set[str]:
    """Names that `statement` binds in its own scope."""
    found: set[str] = set()
    waiting = [statement]
    while waiting:
        node = waiting.pop()
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            found.add(node.name)
            continue
        if isinstance(node, ast.Lambda):
            continue
        if isinstance(node, ast.Name) and isinstance(node.ctx, (ast.Store, ast.Del)):
            found.add(node.id)
        elif isinstance(node, ast.alias):
            found.add(node.asname or node.name.partition(".")[0])
        elif isinstance(node, (ast.ExceptHandler, ast.MatchAs, ast.MatchStar)) and node.name:
            found.add(node.name)
        waiting += ast.iter_child_nodes(node)
    return found


def _runs_as_script_only(statement: ast.stmt) -> bool:
    """Whether a statement is an ``if __name__ == "__main__":`` without ``else``. It does nothing in an
    import."""
    if not isinstance(statement, ast.If) or statement.orelse:
        return False
    return ast.unparse(statement.test) in ("__name__ == '__main__'", "'__main__' == __name__")


def _mentions(parts: Iterable[ast.AST]) -> tuple[frozenset[str], str | None]:
    """The names in `parts`, and the first name by which the code may reach more than it names; see
    `Symbol.dynamic`."""
    names: set[str] = set()
    dynamic: list[str] = []
    modules: set[str] = set()
    called = set()
    for node in (node for part in parts for node in _walk_code(part)):
        if isinstance(node, ast.Name):
            names.add(node.id)
            if node.id in ("getattr", "setattr", "delattr", "hasattr") and id(node) not in called:
                dynamic.append(node.id)
        elif isinstance(node, ast.Attribute):
            names.add(node.attr)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            names.update(word for word in node.value.split(".") if word.isidentifier())
        elif isinstance(node, ast.MatchClass):
            names.update(node.kwd_attrs)
        elif isinstance(node, ast.Global):
            names.update(node.names)
        elif isinstance(node, ast.Import):
            modules.update(alias.name for alias in node.names)
            names.update(word for alias in node.names for word in alias.name.split("."))
        elif isinstance(node, ast.ImportFrom):
            modules.add(node.module or "")
            names.update(alias.name for alias in node.names)
            if any(alias.name == "*" for alias in node.names):
                dynamic.append(ast.unparse(node))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            if node.func.id in ("getattr", "setattr", "delattr", "hasattr"):
                name = node.args[1] if len(node.args) > 1 else None
                if isinstance(name, ast.Constant) and isinstance(name.value, str):
                    called.add(id(node.func))
            elif node.func.id == "type" and len(node.args) != 1:
                dynamic.append("type")
    dynamic += sorted(names & _INTROSPECTION)
    dynamic += sorted(module for module in modules if module.partition(".")[0] in _INTROSPECTION_MODULES)
    return frozenset(names), dynamic[0] if dynamic else None


def _walk_code(node: ast.AST) -> Iterator[ast.AST]:
    """Like ``ast.walk``, but parents first, and without annotations, which have no effect."""
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _walk_code(child)


def _remove_docstrings(tree: ast.Module) -> None:
    """Remove statements that are only a constant."""
    for node in ast.walk(tree):
        for name in ("body", "orelse", "finalbody"):
            block = getattr(node, name, None)
            if not isinstance(block, list):
                continue
            kept = [s for s in block if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
            if not kept and block and name == "body" and not isinstance(node, ast.Module):
                kept = [ast.copy_location(ast.Pass(), block[0])]
            block[:] = kept


# --- two versions --------------------------------------------------------------------------------


class TwoVersions:
    """One graph of both versions. A node is a `Key` (file and name): it stands for the symbols of both
    versions that have this file and name. Its edges lead to every symbol that a name in these symbols may
    mean.

    Pure: nothing is imported or executed.
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
        """The symbol in each version that has it, the old version first."""
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
        """All symbols that can be reached from `roots`, each with the symbol before it on the way (None for a
        root)."""
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
        """The changed symbols, and all symbols that may reach one of them."""
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
        """The task classes of all files, without those in `family`. They have no live env."""
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
    """The 1-based line of `new` that corresponds to `line` of `old`; None if the function around it changed.

    Comments, docstrings and layout do not count as changes. For a line outside of functions, the statement
    around it is compared. Does not raise, whatever the texts contain.
    """
    try:
        before, after = parse_python(old), parse_python(new)
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
    """The line of `after` with the text of `line`. If several lines have this text, the one nearest to the place
    of `line` within `before`; if none has this text, the line at that place."""
    text = old.splitlines()[line - 1].strip()
    at = after.lineno + line - before.lineno
    end = after.end_lineno or after.lineno
    lines = new.splitlines()
    same = [i for i in range(after.lineno, end + 1) if lines[i - 1].strip() == text]
    return min(same, key=lambda i: abs(i - at), default=min(max(at, after.lineno), end))
