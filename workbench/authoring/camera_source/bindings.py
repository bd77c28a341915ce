"""What gives names their values in one scope, and which of several such places can hold where a name is read.

A binding whose value cannot be read (a parameter, a loop's variable, ``+=``) is one without an expression. Branches
depend on what only the running task knows, so what stands in them may hold afterwards and may not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import libcst as cst

from workbench.authoring.camera_source.source_file import Scope, SourceFile, children, walk


@dataclass(frozen=True, eq=False)
class Binding:
    file: SourceFile
    name: str
    node: cst.CSTNode
    """What binds it."""
    value: cst.BaseExpression | None
    """The expression of its value; None where reading does not tell it."""
    why: str = ""
    """What it is, where `value` is None."""
    dotted: str | None = None
    """What an import binds it to."""


def _own_nodes(scope: Scope) -> Iterator[cst.CSTNode]:
    """The nodes that are in `scope` and in no scope within it, in the order of the text."""
    waiting: list[cst.CSTNode] = (
        [scope.body] if not isinstance(scope, cst.Module) else [*reversed(scope.body)]
    )
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, (cst.FunctionDef, cst.ClassDef, cst.Lambda)):
            waiting += reversed(children(node))


def bindings_of(file: SourceFile, scope: Scope) -> Iterator[Binding]:
    if isinstance(scope, (cst.FunctionDef, cst.Lambda)):
        for node in walk(scope.params):
            if isinstance(node, cst.Param):
                what = scope.name.value if isinstance(scope, cst.FunctionDef) else "a lambda"
                yield Binding(file, node.name.value, node, None, f"it is a parameter of {what}")
    for node in _own_nodes(scope):
        yield from _bound_by(file, node)


def _bound_by(file: SourceFile, node: cst.CSTNode) -> Iterator[Binding]:
    if isinstance(node, cst.Assign):
        for target in node.targets:
            yield from _targets(file, node, target.target, node.value)
    elif isinstance(node, cst.AnnAssign) and node.value is not None:
        yield from _targets(file, node, node.target, node.value)
    elif isinstance(node, cst.AugAssign):
        yield from _targets(file, node, node.target, None)
    elif isinstance(node, cst.NamedExpr):
        yield from _targets(file, node, node.target, node.value)
    elif isinstance(node, cst.For):
        yield from _targets(file, node, node.target, None, "it changes in a loop")
    elif isinstance(node, (cst.AsName, cst.Del)):
        named = node.name if isinstance(node, cst.AsName) else node.target
        if not isinstance(file.parents[node], cst.ImportAlias):
            yield from _targets(file, node, named, None)
    elif isinstance(node, (cst.FunctionDef, cst.ClassDef)):
        yield Binding(file, node.name.value, node, None, f"it is the file's own {node.name.value}")
    elif isinstance(node, (cst.Import, cst.ImportFrom)):
        yield from _imported(file, node)
    elif isinstance(node, (cst.MatchAs, cst.MatchStar)) and node.name is not None:
        yield Binding(file, node.name.value, node, None, "it is matched by a pattern")


def _targets(
    file: SourceFile,
    node: cst.CSTNode,
    target: cst.CSTNode,
    value: cst.BaseExpression | None,
    why: str = "it is computed",
) -> Iterator[Binding]:
    if isinstance(target, cst.Name):
        yield Binding(file, target.value, node, value, why)
    elif isinstance(target, (cst.Tuple, cst.List)):
        given = value.elements if isinstance(value, (cst.Tuple, cst.List)) else ()
        plain = len(given) == len(target.elements) and not any(
            isinstance(e, cst.StarredElement) for e in (*given, *target.elements)
        )
        for index, element in enumerate(target.elements):
            yield from _targets(file, node, element.value, given[index].value if plain else None, why)
    elif isinstance(target, cst.Subscript):
        # NAME[0] = ...: what the name stands for is no longer what was assigned to it.
        yield from _targets(file, node, target.value, None, "a part of it is set")


def _imported(file: SourceFile, node: cst.Import | cst.ImportFrom) -> Iterator[Binding]:
    if isinstance(node.names, cst.ImportStar):
        return
    module = ""
    if isinstance(node, cst.ImportFrom):
        # What is relative is beside the file, and `Project.module` looks there first.
        module = "" if node.module is None else file.module.code_for_node(node.module)
    for alias in node.names:
        name = file.module.code_for_node(alias.name)
        dotted = f"{module}.{name}" if module else name
        if alias.asname is not None:
            bound = file.module.code_for_node(alias.asname.name)
        elif isinstance(node, cst.Import):
            bound = dotted = name.partition(".")[0]
        else:
            bound = name
        yield Binding(file, bound, node, None, f"it is imported: {dotted}", dotted)


def attribute_stores(file: SourceFile, name: str) -> list[Binding]:
    """Everything that sets an attribute of that name, of whatever object."""
    found: list[Binding] = []
    for node in file.nodes:
        if not isinstance(node, cst.Attribute) or node.attr.value != name:
            continue
        inner: cst.CSTNode = node
        outer = file.parents[node]
        while isinstance(outer, cst.Subscript) and outer.value is inner:
            inner, outer = outer, file.parents[outer]
        if isinstance(outer, cst.AssignTarget):
            statement = file.parents[outer]
            assert isinstance(statement, cst.Assign)
            looped = any(isinstance(o, (cst.For, cst.While, cst.If)) for o in file.ancestors(outer))
            plain = inner is node and file.code(node.value) == "self" and not looped
            found.append(Binding(file, name, statement, statement.value if plain else None, "it is set"))
        elif isinstance(outer, cst.AnnAssign) and outer.target is inner and outer.value is not None:
            plain = inner is node and file.code(node.value) == "self"
            found.append(Binding(file, name, outer, outer.value if plain else None, "it is set"))
        elif (isinstance(outer, (cst.AugAssign, cst.For)) and outer.target is inner) or (
            isinstance(outer, cst.Element) and _is_target(file, outer)
        ):
            found.append(Binding(file, name, outer, None, "it is set"))
    return found


def _is_target(file: SourceFile, element: cst.Element) -> bool:
    inner: cst.CSTNode = element
    for outer in file.ancestors(element):
        if isinstance(outer, (cst.AssignTarget,)):
            return True
        if isinstance(outer, cst.For):
            return outer.target is inner
        if not isinstance(outer, (cst.Tuple, cst.List, cst.Element)):
            return False
        inner = outer
    return False


_ASSIGNING = (cst.Assign, cst.AnnAssign, cst.AugAssign, cst.NamedExpr)


def reaching(
    file: SourceFile, bindings: list[Binding], use: cst.CSTNode | None, scope: Scope
) -> list[Binding]:
    """Those of one name's `bindings` that may hold at `use`; at the end of their scope for None."""
    found: list[Binding] = []
    around = list(file.ancestors(use)) if use is not None else [scope.body, scope]
    for binding in bindings:
        if use is not None and file.inner_span(binding.node)[0] >= file.inner_span(use)[0]:
            if any(isinstance(o, (cst.For, cst.While)) and o in around for o in file.ancestors(binding.node)):
                found.append(Binding(file, binding.name, binding.node, None, "it changes in a loop"))
            continue
        if isinstance(binding.node, _ASSIGNING) and binding.node in around:
            continue  # the right-hand side of its own assignment
        if use is not None and _exclusive(file, binding.node, use):
            continue
        block = next(
            (
                o
                for o in file.ancestors(binding.node)
                if isinstance(o, (cst.Module, cst.IndentedBlock, cst.SimpleStatementSuite))
            ),
            None,
        )
        if block in around or binding.node is scope or isinstance(binding.node, cst.Param):
            found = [binding]
        else:
            found.append(binding)
    return found


def _exclusive(file: SourceFile, a: cst.CSTNode, b: cst.CSTNode) -> bool:
    """True if they are in two branches of one ``if``."""
    above = {outer: inner for inner, outer in _steps(file, a)}
    for inner, outer in _steps(file, b):
        if outer in above:
            other = above[outer]
            return (
                isinstance(outer, cst.If)
                and inner is not other
                and {inner, other} == {outer.body, outer.orelse}
            )
    return False


def _steps(file: SourceFile, node: cst.CSTNode) -> Iterator[tuple[cst.CSTNode, cst.CSTNode]]:
    for outer in file.ancestors(node):
        yield node, outer
        node = outer
