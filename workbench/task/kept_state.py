"""Finds code by which values of an old version outlive that version: memoized values and mutable globals."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Literal

from workbench.task.call_graph import Symbol, bound_names

MUTATES = frozenset(
    (
        "append appendleft extend insert add update put push pop popitem clear remove discard set sort reverse "
        "register_buffer setdefault __setitem__ __delitem__ __setattr__ __delattr__ __iadd__ __ior__ __imul__"
    ).split()
)
_ATTRIBUTE_FUNCTIONS = {"hasattr", "setattr", "delattr", "vars"}
_NEW_VALUES = set("dict list set tuple zip range sorted float int bool len sum min max enumerate".split())
_MAKES_NEW = {"clone", "copy", "deepcopy", "tolist", "sum", "mean", "norm"}
_PLAIN_DECORATORS = {"property", "staticmethod", "classmethod", "override"}
_HOOK_ARGUMENTS = {"info", "obs", "action"}
"""Hook arguments by name. ManiSkill creates new values for them in every step, so what the task writes into
these values does not outlive the step."""


def memoizing_statement(function: ast.AST, imported: Collection[str]) -> str | None:
    """Line and text of a statement of `function` by which a value may outlive the call, and which later calls
    may skip; None if there is no such statement.

    A value that every call writes is renewed by the first call of the new code. A value that is written only
    once is not::

        if not hasattr(self, "weights"):
            self.weights = make_weights()  # after an edit: new in a fresh env, old in this env

    Whether a statement runs only once is undecidable. So a conditional write counts if its target outlives
    the call: an attribute, or an item of anything but a fresh local value. A write is conditional in an
    ``if``, ``while``, ``try`` or nested function, after a ``return``, and if ``or`` chooses its value.
    ``global``, ``nonlocal``, ``hasattr``, ``setdefault``, decorators that may cache, and mutable defaults
    always count. An accumulator (``self.best = torch.maximum(self.best, d)``), written at every call, does
    not count: it is episode state.

    Args:
        imported: names of libraries in the module (``torch``, ``np``): their functions return new values.
    """
    assert isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef))
    for decorator in function.decorator_list:
        root = root_name(decorator.func if isinstance(decorator, ast.Call) else decorator)
        accessor = isinstance(decorator, ast.Attribute) and decorator.attr in ("setter", "getter", "deleter")
        if root not in _PLAIN_DECORATORS and root != "torch" and not accessor:
            return f"line {decorator.lineno}: @{ast.unparse(decorator)}"
    for default in [*function.args.defaults, *function.args.kw_defaults]:
        made = isinstance(default, ast.Call) and root_name(default.func) not in imported
        if made or isinstance(default, (ast.Dict, ast.List, ast.Set)):
            return f"line {default.lineno}: a default of {ast.unparse(default)}"
    fresh = _fresh_names(function, imported)
    found = next(_in_block(function.body, False, fresh, imported), None)
    return None if found is None else f"line {found.lineno}: {ast.unparse(found).splitlines()[0]}"


def root_name(value: ast.AST) -> str | None:
    """The first name of an expression with dots or indices, as ``torch`` in ``torch.linalg.norm``; None if
    the expression does not begin with a name."""
    while isinstance(value, (ast.Attribute, ast.Subscript)):
        value = value.value
    return value.id if isinstance(value, ast.Name) else None


def _in_block(
    block: list[ast.stmt], conditional: bool, fresh: set[str], imported: Collection[str]
) -> Iterator[ast.stmt]:
    for statement in block:
        nested = isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef))
        if isinstance(statement, (ast.Global, ast.Nonlocal)):
            yield statement
        elif not nested and _writes(statement, conditional, fresh, imported):
            yield statement
        certain = isinstance(statement, (ast.With, ast.For))
        for inner in _blocks(statement):
            yield from _in_block(inner, conditional or not certain, fresh, imported)
        leaves = (ast.Return, ast.Break, ast.Continue, ast.Raise)
        if not isinstance(statement, ast.Return) and any(isinstance(n, leaves) for n in ast.walk(statement)):
            conditional = True  # what follows may not run


def _writes(statement: ast.stmt, conditional: bool, fresh: set[str], imported: Collection[str]) -> bool:
    """Whether `statement` itself, without its inner statements, is a write that a later call may skip."""
    targets: list[ast.expr] = []
    if isinstance(statement, ast.Assign):
        targets = statement.targets
    elif isinstance(statement, (ast.AugAssign, ast.AnnAssign, ast.For)):
        targets = [statement.target]
    elif isinstance(statement, ast.Delete):
        targets = statement.targets
        conditional = True
    elif isinstance(statement, ast.With):
        targets = [item.optional_vars for item in statement.items if item.optional_vars is not None]
    lasting = any(_outlives(target, fresh, imported) for target in targets)
    if lasting and conditional:
        return True
    if isinstance(statement, ast.If) and any(_mentions_options(node) for node in ast.walk(statement.test)):
        return True
    for node in (node for part in _expressions(statement) for node in ast.walk(part)):
        if isinstance(node, (ast.IfExp, ast.BoolOp)) and lasting:
            return True
        if isinstance(node, (ast.Yield, ast.YieldFrom, ast.Await)):
            return True
        if isinstance(node, ast.Call) and _call_keeps(node, conditional, fresh, imported):
            return True
        if isinstance(node, (ast.IfExp, ast.BoolOp, ast.Lambda, ast.comprehension)):
            inside = [n for n in ast.walk(node) if isinstance(n, ast.Call)]
            if any(_call_keeps(call, True, fresh, imported) for call in inside):
                return True
    return False


def _call_keeps(call: ast.Call, conditional: bool, fresh: set[str], imported: Collection[str]) -> bool:
    function = call.func
    if isinstance(function, ast.Name):
        return function.id in _ATTRIBUTE_FUNCTIONS or (function.id == "getattr" and len(call.args) > 2)
    if not isinstance(function, ast.Attribute):
        return False
    if function.attr in ("setdefault", "__missing__"):
        return True
    writes = changes_in_place(function) or any(word.arg == "out" for word in call.keywords)
    return conditional and writes and _is_old(function.value, fresh, imported)


def changes_in_place(method: ast.Attribute) -> bool:
    """Whether a method changes its object in place: ``append``, ``update``, torch's ``add_``."""
    return method.attr in MUTATES or (method.attr.endswith("_") and not method.attr.endswith("__"))


def _outlives(target: ast.expr, fresh: set[str], imported: Collection[str]) -> bool:
    """Whether `target` is part of something that existed before the call."""
    if isinstance(target, (ast.Tuple, ast.List)):
        return any(_outlives(element, fresh, imported) for element in target.elts)
    if isinstance(target, ast.Starred):
        return _outlives(target.value, fresh, imported)
    if isinstance(target, ast.Subscript):
        return _is_old(target.value, fresh, imported)
    return isinstance(target, ast.Attribute)


def _is_old(value: ast.expr, fresh: set[str], imported: Collection[str]) -> bool:
    if isinstance(value, ast.Name):
        return value.id not in fresh
    # A new dict may hold an old one: `both = {"seen": self.seen}; both["seen"][k] = v`.
    return isinstance(value, ast.Subscript) or not _is_new(value, imported)


def _fresh_names(function: ast.FunctionDef | ast.AsyncFunctionDef, imported: Collection[str]) -> set[str]:
    """Local names that are bound only to values created in this call."""
    values: dict[str, list[ast.expr]] = {}
    stale = {argument.arg for argument in ast.walk(function.args) if isinstance(argument, ast.arg)}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                if isinstance(target, ast.Name):
                    values.setdefault(target.id, []).append(node.value)
                else:
                    stale |= bound_names(target)
        elif isinstance(node, (ast.AnnAssign, ast.NamedExpr)) and isinstance(node.target, ast.Name):
            if node.value is not None:
                values.setdefault(node.target.id, []).append(node.value)
        elif isinstance(node, (ast.For, ast.AsyncFor, ast.comprehension)):
            stale |= bound_names(node.target)
        elif isinstance(node, ast.withitem) and node.optional_vars is not None:
            stale |= bound_names(node.optional_vars)
        elif isinstance(node, (ast.ExceptHandler, ast.MatchAs, ast.MatchStar)) and node.name:
            stale.add(node.name)
    new = {name for name, bound in values.items() if all(_is_new(value, imported) for value in bound)}
    return (new - stale) | (_HOOK_ARGUMENTS - values.keys())


def _is_new(value: ast.expr, imported: Collection[str]) -> bool:
    """Whether an expression creates a new value, to which nothing else refers."""
    if not isinstance(value, ast.Call):
        displays = (ast.Dict, ast.List, ast.Set, ast.Tuple, ast.ListComp, ast.DictComp, ast.SetComp)
        return isinstance(
            value, (*displays, ast.BinOp, ast.UnaryOp, ast.Compare, ast.Constant, ast.JoinedStr)
        )
    function = value.func
    if isinstance(function, ast.Name):
        return function.id in _NEW_VALUES
    if not isinstance(function, ast.Attribute):
        return False
    if function.attr in _MAKES_NEW:
        return True
    if isinstance(function.value, ast.Call) and isinstance(function.value.func, ast.Name):
        if function.value.func.id == "super":
            return function.attr.startswith("_get_obs") or function.attr == "evaluate"
    # Not `torch.from_numpy`, `np.asarray`: they may return their argument.
    aliases = function.attr.startswith(("as", "from")) or function.attr.endswith("_")
    return root_name(function) in imported and not aliases


def _blocks(statement: ast.stmt) -> list[list[ast.stmt]]:
    """The statements within `statement`."""
    found = [block for name in ("body", "orelse", "finalbody") if (block := getattr(statement, name, None))]
    found += [handler.body for handler in getattr(statement, "handlers", ())]
    return found + [case.body for case in getattr(statement, "cases", ())]


def _expressions(statement: ast.stmt) -> Iterator[ast.AST]:
    """Expressions of `statement`, without those of its inner statements."""
    for child in ast.iter_child_nodes(statement):
        if not isinstance(child, (ast.stmt, ast.ExceptHandler, ast.match_case)):
            yield child


def _mentions_options(node: ast.AST) -> bool:
    # ``if options.get("reconfigure"):`` is true only at the first reset.
    return (isinstance(node, ast.Name) and node.id == "options") or (
        isinstance(node, ast.Attribute) and "reconfig" in node.attr
    )


# --- mutable globals ------------------------------------------------------------------------------


_Nature = Literal["fixed", "filled", "object"]
"""fixed: cannot change. filled: a list, dict or array with elements; it counts as a constant unless code
writes to it explicitly. object: starts empty or is of an unknown type; it may change wherever it is
passed."""
_WORST: tuple[_Nature, ...] = ("fixed", "filled", "object")
_READ_ONLY_FUNCTIONS = set(
    "len sorted list tuple dict set frozenset sum min max any all enumerate zip range isinstance float int bool "
    "str abs round print reversed map filter super".split()
)
_RANDOM_NAMES = ("random", "rng", "generator", "count", "cycle", "iter", "randomstate", "seed")


def changed_while_running(
    symbols: Sequence[Symbol], libraries: Collection[str]
) -> tuple[Symbol, Symbol] | None:
    """A value of a file or class that may be changed while the task runs, and the code that may change it;
    None if there is none.

    Executing a file again creates its values again, which is right for a constant and wrong for a cache:
    after ``MESHES = {}`` has run again, the meshes that `_load_scene` had put into it are missing, while the
    env still has the old scene. A value counts as changed if code assigns to its items or attributes, calls a
    mutating method, or passes it to other code.
    """
    values = {symbol.short: symbol for symbol in symbols if symbol.kind == "value"}
    natures: dict[str, _Nature] = {}
    for symbol in symbols:
        if symbol.kind == "value":
            found = _nature(symbol, values, libraries)
            natures[symbol.short] = _worst([found, natures.get(symbol.short, "fixed")])
    for code in symbols:
        # Other symbols run once, while the file is executed.
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
    """Names of the attributes that a function sets or changes in place, or whose items it sets."""
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
        if any(word in name.lower() for word in _RANDOM_NAMES):
            return "object"
        known = root_name(value.func) in libraries or name in _READ_ONLY_FUNCTIONS
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
            # `self.count = 0` makes an attribute of the env, not of the class.
            if (stores and not own) or (
                not stores and _may_change(inner, natures[inner.attr], parents, libraries)
            ):
                yield inner.attr


def _may_change(
    use: ast.AST, nature: _Nature, parents: dict[int, ast.AST], libraries: Collection[str]
) -> bool:
    """Whether this use of a value may change it, or pass it to code that may."""
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
        looks = isinstance(function, ast.Name) and function.id in _READ_ONLY_FUNCTIONS
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
