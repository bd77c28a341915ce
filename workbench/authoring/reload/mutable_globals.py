"""Values at the top of a file, or of a class, that code changes while the task runs.

When a file is executed anew its constants are made anew, which is what its author wants of a constant, and not of
a cache: ``MESHES = {}`` that `_load_scene` filled would be empty under an env whose scene is still the old one.
So of each such value the question is whether anybody may write to it: assign to its items or attributes,
call a method on it that changes it, or take it whole to where that cannot be seen.
"""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Literal

from workbench.authoring.reload.memoizing import changes_in_place, root_name
from workbench.authoring.reload.symbols import Symbol

_Nature = Literal["fixed", "filled", "object"]
"""What cannot change; a list, dict or array with something in it, which is meant as a constant unless it is written
to in so many words; and what begins empty or is of an unknown kind, and may change wherever it is taken."""
_WORST: tuple[_Nature, ...] = ("fixed", "filled", "object")
_COPY_OR_LOOK = set(
    "len sorted list tuple dict set frozenset sum min max any all enumerate zip range isinstance float int bool "
    "str abs round print reversed map filter super".split()
)
_DRAWS = ("random", "rng", "generator", "count", "cycle", "iter", "randomstate", "seed")


def changed_while_running(
    symbols: Sequence[Symbol], libraries: Collection[str]
) -> tuple[Symbol, Symbol] | None:
    """A value that may be changed while the task runs, and the code that may; None if there is none."""
    values = {symbol.short: symbol for symbol in symbols if symbol.kind == "value"}
    natures: dict[str, _Nature] = {}
    for symbol in symbols:
        if symbol.kind == "value":
            found = _nature(symbol, values, libraries)
            natures[symbol.short] = _worst([found, natures.get(symbol.short, "fixed")])
    for code in symbols:
        # What else there is runs once, while the file is executed.
        if code.kind in ("function", "statements", "value") and code.mentions & values.keys():
            for node in (n for part in code.nodes for n in _functions(part)):
                for name in _written(node, natures, libraries):
                    return values[name], code
    return None


def _functions(node: ast.AST) -> Iterator[ast.AST]:
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
    if isinstance(node, kinds):
        yield node
    else:
        yield from (inner for inner in ast.walk(node) if isinstance(inner, kinds))


def written_attributes(symbol: Symbol | None) -> set[str]:
    """Names of the attributes that a function assigns to, or to whose items it does."""
    found: set[str] = set()
    for node in (n for part in (symbol.nodes if symbol is not None else ()) for n in ast.walk(part)):
        target: ast.AST = node
        while isinstance(target, ast.Subscript) and isinstance(target.ctx, (ast.Store, ast.Del, ast.Load)):
            target = target.value
        written = isinstance(getattr(node, "ctx", None), ast.Store)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            target, written = node.func.value, changes_in_place(node.func)
        if written and isinstance(target, ast.Attribute):
            found.add(target.attr)
    return found


def _nature(symbol: Symbol, values: dict[str, Symbol], libraries: Collection[str], depth: int = 0) -> _Nature:
    (node,) = symbol.nodes
    assert isinstance(node, (ast.Assign, ast.AnnAssign))
    return "fixed" if node.value is None else _nature_of(node.value, values, libraries, depth)


def _nature_of(value: ast.expr, values: dict[str, Symbol], libraries: Collection[str], depth: int) -> _Nature:
    def of(inner: ast.expr) -> _Nature:
        return _nature_of(inner, values, libraries, depth)

    if isinstance(value, (ast.Constant, ast.JoinedStr, ast.Lambda, ast.Compare)):
        return "fixed"
    if isinstance(value, (ast.BinOp, ast.UnaryOp, ast.Tuple)):
        parts = [child for child in ast.iter_child_nodes(value) if isinstance(child, ast.expr)]
        return _worst([of(part) for part in parts])
    if isinstance(value, (ast.List, ast.Set)):
        return "filled" if value.elts else "object"
    if isinstance(value, ast.Dict):
        return "filled" if value.values else "object"
    if isinstance(value, (ast.ListComp, ast.SetComp, ast.DictComp)):
        return "filled"
    if isinstance(value, (ast.Name, ast.Attribute)):
        root = root_name(value)
        if root in libraries:
            return "fixed"
        if isinstance(value, ast.Name) and value.id in values and depth < 10:
            return _nature(values[value.id], values, libraries, depth + 1)
        return "object"
    if isinstance(value, ast.Call):
        name = ast.unparse(value.func)
        if any(word in name.lower() for word in _DRAWS):
            return "object"
        known = root_name(value.func) in libraries or name in _COPY_OR_LOOK
        return "filled" if known and (value.args or value.keywords) else "object"
    return "object"


def _worst(natures: list[_Nature]) -> _Nature:
    return _WORST[max((_WORST.index(nature) for nature in natures), default=0)]


def _written(node: ast.AST, natures: dict[str, _Nature], libraries: Collection[str]) -> Iterator[str]:
    parents = {id(child): parent for parent in ast.walk(node) for child in ast.iter_child_nodes(parent)}
    for inner in ast.walk(node):
        if isinstance(inner, (ast.Global, ast.Nonlocal)):
            yield from (name for name in inner.names if name in natures)
        elif isinstance(inner, ast.Name) and inner.id in natures and isinstance(inner.ctx, ast.Load):
            if _may_change(inner, natures[inner.id], parents, libraries):
                yield inner.id
        elif isinstance(inner, ast.Attribute) and inner.attr in natures:
            stores = not isinstance(inner.ctx, ast.Load)
            own = isinstance(inner.value, ast.Name) and inner.value.id == "self"
            # `self.count = 0` makes an attribute of the env, whatever the class has of that name.
            if (stores and not own) or (
                not stores and _may_change(inner, natures[inner.attr], parents, libraries)
            ):
                yield inner.attr


def _may_change(
    use: ast.AST, nature: _Nature, parents: dict[int, ast.AST], libraries: Collection[str]
) -> bool:
    """Whether this use of a value may change it, or take it to where that is not to be seen."""
    here, parent = use, parents.get(id(use))
    while isinstance(parent, (ast.Attribute, ast.Subscript)) and parent.value is here:
        if not isinstance(parent.ctx, ast.Load):
            return True
        above = parents.get(id(parent))
        if isinstance(parent, ast.Attribute) and isinstance(above, ast.Call) and above.func is parent:
            return nature == "object" or (nature == "filled" and changes_in_place(parent))
        here, parent = parent, above
    if nature == "fixed":
        return False
    if isinstance(parent, (ast.Assign, ast.NamedExpr)) and nature == "filled":
        targets = parent.targets if isinstance(parent, ast.Assign) else [parent.target]
        return any(isinstance(t, ast.Name) and _is_written(t.id, parents.values()) for t in targets)
    if nature == "filled":
        return False
    if isinstance(parent, ast.keyword):
        here, parent = parent, parents.get(id(parent))
    if isinstance(parent, ast.Call):
        if parent.func is here:
            return True
        function = parent.func
        looks = isinstance(function, ast.Name) and function.id in _COPY_OR_LOOK
        return not looks and root_name(function) not in libraries
    taken = (ast.Assign, ast.AnnAssign, ast.NamedExpr, ast.Return, ast.Dict, ast.List, ast.Tuple, ast.Set)
    return isinstance(parent, (*taken, ast.Starred, ast.Yield, ast.Lambda, ast.IfExp, ast.BoolOp))


def _is_written(local: str, nodes: Iterable[ast.AST]) -> bool:
    """Whether a local name's value is changed in place."""
    for node in nodes:
        if isinstance(node, ast.Subscript) and not isinstance(node.ctx, ast.Load):
            written: ast.AST = node
        elif isinstance(node, ast.AugAssign):
            written = node.target
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            written = node.func if changes_in_place(node.func) else node
        else:
            continue
        if root_name(written) == local:
            return True
    return False
