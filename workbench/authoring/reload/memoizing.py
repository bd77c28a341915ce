"""Whether a function may keep what it once computed, and not compute it again.

New code can be put on a live env only if nothing that the old code computed stands in its way. What a
function writes at every call is no trouble: the next call writes it anew. What it writes *once* is::

    if not hasattr(self, "weights"):
        self.weights = make_weights()      # edited: a fresh env has other weights, this one never will

Telling the one from the other is undecidable, so everything counts as remembered that is written to something
outliving the call (an attribute, an item of what is not a fresh local value, a global) and only under a
condition: in an ``if``, a ``while``, a ``try``, a nested function, after a ``return``, or as a value that is
chosen by ``or``. So do ``hasattr``, ``setdefault`` and decorators that may cache. Accumulators
(``self.best = torch.maximum(self.best, d)``) do not: they are the state of the moment.
"""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterator

from workbench.authoring.reload.symbols import bound_names

MUTATES = frozenset(
    (
        "append appendleft extend insert add update put push pop popitem clear remove discard set sort reverse "
        "register_buffer setdefault __setitem__ __delitem__ __setattr__ __delattr__ __iadd__ __ior__ __imul__"
    ).split()
)
_ASKS = {"hasattr", "setattr", "delattr", "vars"}
_NEW_VALUES = set("dict list set tuple zip range sorted float int bool len sum min max enumerate".split())
_MAKES_NEW = {"clone", "copy", "deepcopy", "tolist", "sum", "mean", "norm"}
_PLAIN_DECORATORS = {"property", "staticmethod", "classmethod", "override"}
_HOOK_ARGUMENTS = {"info", "obs", "action"}
"""ManiSkill makes them anew for every step."""


def remembers(function: ast.AST, imported: Collection[str]) -> str | None:
    """What in `function` may outlive a call without being written again, in words; None for nothing.

    Args:
        imported: names of libraries in the module (``torch``, ``np``): what their functions return and is
            kept in a local name is a new value.
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
    """``torch`` of ``torch.linalg.norm``; None if it begins with something else than a name."""
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
            conditional = True  # what comes after it may be passed over


def _writes(statement: ast.stmt, conditional: bool, fresh: set[str], imported: Collection[str]) -> bool:
    """Whether `statement` itself, without the statements in it, is a write that may not come again."""
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
        return function.id in _ASKS or (function.id == "getattr" and len(call.args) > 2)
    if not isinstance(function, ast.Attribute):
        return False
    if function.attr in ("setdefault", "__missing__"):
        return True
    writes = changes_in_place(function) or any(word.arg == "out" for word in call.keywords)
    return conditional and writes and _is_old(function.value, fresh, imported)


def changes_in_place(method: ast.Attribute) -> bool:
    """``append``, ``update``, torch's ``add_``."""
    return method.attr in MUTATES or (method.attr.endswith("_") and not method.attr.endswith("__"))


def _outlives(target: ast.expr, fresh: set[str], imported: Collection[str]) -> bool:
    """Whether a write to `target` is a write to something that was there before the call."""
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
    """Local names that are only ever bound to values made in this call."""
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
    """Whether an expression gives a value that nobody else has."""
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
    # Not `torch.from_numpy`, `np.asarray`: what they give may be what they were given.
    aliases = function.attr.startswith(("as", "from")) or function.attr.endswith("_")
    return root_name(function) in imported and not aliases


def _blocks(statement: ast.stmt) -> list[list[ast.stmt]]:
    """The statements within `statement`."""
    found = [block for name in ("body", "orelse", "finalbody") if (block := getattr(statement, name, None))]
    found += [handler.body for handler in getattr(statement, "handlers", ())]
    return found + [case.body for case in getattr(statement, "cases", ())]


def _expressions(statement: ast.stmt) -> Iterator[ast.AST]:
    """What is in `statement` but not in the statements within it."""
    for child in ast.iter_child_nodes(statement):
        if not isinstance(child, (ast.stmt, ast.ExceptHandler, ast.match_case)):
            yield child


def _mentions_options(node: ast.AST) -> bool:
    # ``if options.get("reconfigure"):`` is true at the first reset and never again.
    return (isinstance(node, ast.Name) and node.id == "options") or (
        isinstance(node, ast.Attribute) and "reconfig" in node.attr
    )
