"""Finds where a name is defined, and where else it is read, in the text of the author's files."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass

from workbench.source.parsed import FUNCTIONS, LOOPS, RefusedEdit, Scope, SourceFile, parse_file, walk


@dataclass(frozen=True, eq=False)
class Binding:
    """A place in the text that binds a name or an attribute."""

    file: SourceFile
    name: str
    node: ast.AST
    """The statement or argument that binds it."""
    value: ast.expr | None
    """The expression of its value; None if the text does not determine it."""
    why: str = ""
    """Reason why `value` is None."""
    imported: tuple[str, str] | None = None
    """For an import: the module with its leading dots, and the name in it (empty for the module itself). Else
    None."""
    attribute: bool = False
    """Whether the binding is an attribute of an object, not a variable."""

    @property
    def dotted(self) -> str:
        """The imported module or name; empty if the binding is not an import."""
        return "" if self.imported is None else ".".join(filter(None, self.imported))


class Project:
    """The author's files, parsed on demand.

    Which branches run depends on the task, so a definition in a branch may or may not apply. Searches for
    other readers of a value find too many rather than too few: they cover every file that contains the name.
    A wrongly found reader only means that a new value is written where it is used, not where it is defined.
    """

    def __init__(self, texts: Mapping[str, str]) -> None:
        self.texts = texts
        self._files: dict[str, SourceFile] = {}
        self._words: dict[str, frozenset[str]] = {}
        self._bindings: dict[ast.AST, dict[str, list[Binding]]] = {}

    def file(self, path: str) -> SourceFile:
        # Cached here too: nodes are compared by identity, and `parse_file` caches only a few files.
        if path not in self._files:
            self._files[path] = parse_file(path, self.texts[path])
        return self._files[path]

    def own_file(self, path: str) -> SourceFile:
        """The file at `path`. Raises RefusedEdit if it is not one of the author's files."""
        if path not in self.texts:
            raise RefusedEdit(f"{path} is not one of your files")
        return self.file(path)

    def files_with_word(self, word: str) -> Iterator[SourceFile]:
        """The files that contain `word` as a whole word."""
        for path, text in self.texts.items():
            if path not in self._words:
                self._words[path] = frozenset(re.findall(r"\w+", text))
            if word in self._words[path]:
                yield self.file(path)

    def bindings(self, file: SourceFile, scope: Scope) -> dict[str, list[Binding]]:
        """Names bound by `scope` itself, in the order of the text."""
        if scope not in self._bindings:
            found: dict[str, list[Binding]] = {}
            for binding in _bound_in(file, scope):
                found.setdefault(binding.name, []).append(binding)
            self._bindings[scope] = found
        return self._bindings[scope]

    def bindings_of(self, file: SourceFile, node: ast.Name) -> list[Binding]:
        """The bindings that may be in effect where `node` is read; empty for a builtin or a name from ``import *``."""
        for outer in file.ancestors(node):
            for inside in getattr(outer, "generators", ()):
                if any(isinstance(n, ast.Name) and n.id == node.id for n in walk(inside.target)):
                    return [Binding(file, node.id, inside.target, None, "it changes in a comprehension")]
        for depth, scope in enumerate(file.scopes(node)):
            if isinstance(scope, ast.ClassDef) and depth > 0:
                continue
            here = self.bindings(file, scope).get(node.id)
            if here:
                return reaching(file, here, node if depth == 0 else None, scope)
        return []

    # --- readers ------------------------------------------------------------------------------------

    def readers(
        self,
        binding: Binding,
        reader: SourceFile,
        read: ast.AST,
        concerns: Callable[[str, str], bool] = lambda path, owner: True,
        together: Collection[ast.AST] = (),
    ) -> str | None:
        """The place, as text, of another reader of the binding; None if there is none.

        Args:
            reader, read: file and node of the known reader.
            concerns: returns whether objects of a class (file and name) may have the binding as an attribute.
                It is asked about attributes of ``self``; on any other object, every attribute with the name
                counts.
            together: further nodes that do not count.
        """
        home, name = binding.file, binding.name
        scope = home.scopes(binding.node)[0]
        attribute = binding.attribute or isinstance(scope, ast.ClassDef)
        everywhere = binding.imported is None and (attribute or isinstance(scope, ast.Module))
        for file in dict.fromkeys((home, *(self.files_with_word(name) if everywhere else ()))):
            for node in file.nodes:
                if isinstance(node, ast.Name) and node.id == name:
                    loads = isinstance(node.ctx, ast.Load) and binding in self.bindings_of(file, node)
                    found = loads or (file is not home and not attribute)
                elif isinstance(node, ast.Attribute) and node.attr == name:
                    found = not isinstance(node.ctx, ast.Store) if attribute else file is not home
                elif isinstance(node, ast.alias) and node.name == name:
                    found = not attribute and file not in (home, reader)
                else:
                    found = attribute and isinstance(node, ast.Constant) and node.value == name
                owner = class_of_self(file, node)
                found = found and (owner is None or not attribute or concerns(file.path, owner))
                if (
                    found
                    and node is not read
                    and node not in together
                    and not _other_element(file, node, read)
                ):
                    return _location(file, node, reader)
        return None

    def attribute_stores(self, name: str, classes: Collection[tuple[str, str]]) -> list[Binding]:
        """The assignments to the attribute `name` of any object that may be of these classes.

        Args:
            classes: file and name of the object's class and of its base classes.
        """
        found: list[Binding] = []
        for file in self.files_with_word(name):
            for node in file.nodes:
                if isinstance(node, ast.Attribute) and node.attr == name and _is_set(file, node):
                    owner = class_of_self(file, node)
                    if owner is None or (file.path, owner) in classes:
                        found.append(_stored(file, node))
        return found


def class_of_self(file: SourceFile, node: ast.AST) -> str | None:
    """Qualified name of the class whose method contains `node`, if `node` is an attribute of ``self``; else
    None."""
    if not isinstance(node, ast.Attribute) or not isinstance(node.value, ast.Name):
        return None
    scopes = file.scopes(node)
    for scope, outer in zip(scopes, scopes[1:], strict=False):
        given = [*scope.args.posonlyargs, *scope.args.args] if isinstance(scope, FUNCTIONS) else []
        if node.value.id in [argument.arg for argument in given]:
            static = any(
                getattr(one, "id", "") == "staticmethod" for one in getattr(scope, "decorator_list", ())
            )
            is_first = isinstance(outer, ast.ClassDef) and given[0].arg == node.value.id
            return file.qualname(outer) if is_first and not static else None
    return None


def _bound_in(file: SourceFile, scope: Scope) -> Iterator[Binding]:
    if isinstance(scope, FUNCTIONS):
        what = "a lambda" if isinstance(scope, ast.Lambda) else scope.name
        for node in ast.walk(scope.args):
            if isinstance(node, ast.arg):
                yield Binding(file, node.arg, node, None, f"it is a parameter of {what}")
    body = scope.body if isinstance(scope.body, list) else [scope.body]
    waiting: list[ast.AST] = [*reversed(body)]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load):
            yield from _bound_name(file, node)
        elif isinstance(node, ast.Subscript) and not isinstance(node.ctx, ast.Load):
            # NAME[0] = ... changes the value that was assigned.
            base = _base(node)
            if isinstance(base, ast.Name):
                yield Binding(file, base.id, _statement(file, node), None, "a part of it is set")
        elif isinstance(node, (*FUNCTIONS, ast.ClassDef)) and not isinstance(node, ast.Lambda):
            yield Binding(file, node.name, node, None, f"{node.name} is a function or class")
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            yield from _imported(file, node)
        elif isinstance(node, (ast.ExceptHandler, ast.MatchAs, ast.MatchStar)) and node.name is not None:
            yield Binding(file, node.name, node, None, "it is computed")
        if not isinstance(node, (*FUNCTIONS, ast.ClassDef)):
            waiting += reversed(list(ast.iter_child_nodes(node)))


def _bound_name(file: SourceFile, node: ast.Name) -> Iterator[Binding]:
    if any(isinstance(outer, ast.comprehension) for outer in file.ancestors(node)):
        return  # it belongs to the comprehension's own scope
    statement, value = _statement(file, node), _assigned(file, node)
    if isinstance(statement, ast.AnnAssign) and statement.value is None:
        return
    why = "it changes in a loop" if isinstance(statement, (ast.For, ast.AsyncFor)) else "it is computed"
    yield Binding(file, node.id, statement, value, why)


def _assigned(file: SourceFile, target: ast.AST) -> ast.expr | None:
    """The expression assigned to `target`; None if the text does not determine it."""
    outer = file.parents[target]
    if isinstance(outer, (ast.Assign, ast.AnnAssign, ast.NamedExpr)):
        return outer.value
    if isinstance(outer, (ast.Tuple, ast.List)):
        value = _assigned(file, outer)
        given = value.elts if isinstance(value, (ast.Tuple, ast.List)) else []
        if len(given) == len(outer.elts) and not any(
            isinstance(e, ast.Starred) for e in (*given, *outer.elts)
        ):
            return next(v for t, v in zip(outer.elts, given, strict=True) if t is target)
    return None


def _statement(file: SourceFile, node: ast.AST) -> ast.AST:
    return next(outer for outer in file.ancestors(node) if isinstance(outer, (ast.stmt, ast.NamedExpr)))


def _imported(file: SourceFile, node: ast.Import | ast.ImportFrom) -> Iterator[Binding]:
    for alias in node.names:
        if isinstance(node, ast.ImportFrom):
            imported = ("." * node.level + (node.module or ""), alias.name)
        else:
            imported = (alias.name if alias.asname else alias.name.partition(".")[0], "")
        bound = alias.asname or (imported[1] or imported[0])
        yield Binding(
            file, bound, node, None, f"it is imported: {'.'.join(filter(None, imported))}", imported
        )


def _base(node: ast.expr) -> ast.expr:
    while isinstance(node, ast.Subscript):
        node = node.value
    return node


def _is_set(file: SourceFile, node: ast.Attribute) -> bool:
    outer: ast.AST = node
    while isinstance(file.parents[outer], ast.Subscript) and file.parents[outer].value is outer:  # type: ignore[attr-defined]
        outer = file.parents[outer]
    return not isinstance(outer.ctx, ast.Load)  # type: ignore[attr-defined]


def _stored(file: SourceFile, node: ast.Attribute) -> Binding:
    outer, value = file.parents[node], None
    looped = any(isinstance(o, (ast.For, ast.While, ast.If)) for o in file.ancestors(node))
    if isinstance(outer, (ast.Assign, ast.AnnAssign)) and file.code(node.value) == "self" and not looped:
        value = outer.value
    return Binding(file, node.attr, _statement(file, node), value, "it is set", attribute=True)


def reaching(file: SourceFile, bindings: list[Binding], use: ast.AST | None, scope: Scope) -> list[Binding]:
    """The `bindings` of one name that may hold at the node `use`, or at the end of `scope` if `use` is
    None."""
    found: list[Binding] = []
    around = [scope] if use is None else list(file.ancestors(use))
    for binding in bindings:
        if use is not None and file.inner_span(binding.node)[0] >= file.inner_span(use)[0]:
            if any(isinstance(o, LOOPS) and o in around for o in file.ancestors(binding.node)):
                found.append(Binding(file, binding.name, binding.node, None, "it changes in a loop"))
            continue
        if isinstance(binding.node, (ast.Assign, ast.AnnAssign, ast.AugAssign, ast.NamedExpr)):
            if binding.node in around:
                continue  # `use` is on the right-hand side of this assignment
        if use is not None and _exclusive(file, binding.node, use):
            continue
        # A binding that certainly ran replaces the bindings before it.
        certain = isinstance(binding.node, ast.arg) or _block(file, binding.node) in _blocks(file, use, scope)
        found = [binding] if certain else [*found, binding]
    return found


def _block(file: SourceFile, node: ast.AST) -> tuple[ast.AST, str]:
    """The statement and the part of it ("body", "orelse" ...) that contain `node`."""
    inner = node
    for outer in file.ancestors(node):
        for part in ("body", "orelse", "finalbody"):
            held = getattr(outer, part, None)
            if isinstance(held, list) and inner in held:
                return outer, part
        inner = outer
    return file.module, "body"


def _blocks(file: SourceFile, use: ast.AST | None, scope: Scope) -> list[tuple[ast.AST, str]]:
    if use is None:
        return [(scope, "body")]
    return [_block(file, node) for node in (use, *file.ancestors(use))]


def _exclusive(file: SourceFile, a: ast.AST, b: ast.AST) -> bool:
    """Whether two nodes are in different branches of one ``if``."""
    above = dict(_blocks(file, a, file.module))
    return any(
        isinstance(outer, ast.If) and above.get(outer, part) != part
        for outer, part in _blocks(file, b, file.module)
    )


def _other_element(file: SourceFile, node: ast.AST, mine: ast.AST) -> bool:
    """Whether the names `node` and `mine` have different constant subscripts: ``CAMERA["fov"]`` and
    ``CAMERA["eye"]``."""
    keys = []
    for name in (node, mine):
        outer = file.parents.get(name)
        if (
            not isinstance(outer, ast.Subscript)
            or outer.value is not name
            or not isinstance(outer.slice, ast.Constant)
        ):
            return False
        keys.append(outer.slice.value)
    return keys[0] != keys[1]


def _location(file: SourceFile, node: ast.AST, reader: SourceFile) -> str:
    line = f"line {file.line(node)}"
    return line if file is reader else f"{file.name}, {line}"
