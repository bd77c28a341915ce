"""Where a name gets its value, and who else reads it there.

Python's scopes are followed as far as reading a file can follow them: locals, enclosing functions, the module,
class attributes through the classes of the given files, ``from beside import NAME``. What gives a name its value is
a binding; of several the ones that can hold at the place of reading are told, since branches depend on what
only the running task knows. A binding whose value cannot be read (a parameter, a loop's variable, ``+=``) is one
without an expression.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePath

import libcst as cst

from workbench.authoring.camera_source.source_file import Scope, SourceFile, walk

LOOPS = (cst.For, cst.While, cst.ListComp, cst.SetComp, cst.DictComp, cst.GeneratorExp)


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


class Project:
    """The given files, parsed as they are asked for."""

    def __init__(self, texts: Mapping[str, str]) -> None:
        self.texts = texts
        self._files: dict[str, SourceFile] = {}
        self._bindings: dict[cst.CSTNode, dict[str, list[Binding]]] = {}

    def file(self, path: str) -> SourceFile:
        if path not in self._files:
            self._files[path] = SourceFile(path, self.texts[path])
        return self._files[path]

    def mentioning(self, word: str) -> Iterator[SourceFile]:
        """The files in which `word` stands as a word."""
        pattern = re.compile(rf"\b{re.escape(word)}\b")
        for path, text in self.texts.items():
            if pattern.search(text):
                yield self.file(path)

    def module(self, dotted: str, beside: SourceFile) -> SourceFile | None:
        """The given file that ``import dotted`` means, as far as names tell."""
        tail = PurePath(*dotted.split("."))
        folder = PurePath(beside.path).parent
        wanted = {str(folder / tail) + ".py", str(folder / tail / "__init__.py")}
        found = [path for path in self.texts if path in wanted]
        if not found:
            ends = (f"/{tail.as_posix()}.py", f"/{tail.as_posix()}/__init__.py")
            found = [path for path in self.texts if PurePath(path).as_posix().endswith(ends)]
        return self.file(found[0]) if len(found) == 1 else None

    def bindings(self, file: SourceFile, scope: Scope) -> dict[str, list[Binding]]:
        """What `scope` itself binds, in the order of the text."""
        if scope not in self._bindings:
            found: dict[str, list[Binding]] = {}
            for binding in _bindings(file, scope):
                found.setdefault(binding.name, []).append(binding)
            self._bindings[scope] = found
        return self._bindings[scope]

    # --- names --------------------------------------------------------------------------------------

    def of_name(self, file: SourceFile, node: cst.Name) -> list[Binding]:
        """The bindings that may hold where `node` is read; none for a builtin or a starred import's name."""
        for outer in file.ancestors(node):
            if isinstance(outer, (cst.ListComp, cst.SetComp, cst.DictComp, cst.GeneratorExp)):
                inside = [n for n in walk(outer.for_in) if isinstance(n, cst.CompFor)]
                for comp in inside:
                    if any(isinstance(n, cst.Name) and n.value == node.value for n in walk(comp.target)):
                        return [Binding(file, node.value, comp, None, "it changes in a comprehension")]
        for depth, scope in enumerate(file.scopes(node)):
            if isinstance(scope, cst.ClassDef) and depth > 0:
                continue
            here = self.bindings(file, scope).get(node.value)
            if here:
                return reaching(file, here, node if depth == 0 else None, scope)
        return []

    def name_readers(self, binding: Binding, except_for: cst.CSTNode) -> str | None:
        """Who else reads a plain name's `binding`."""
        file, name = binding.file, binding.name
        for node in file.nodes:
            if not isinstance(node, cst.Name) or node.value != name or node is except_for:
                continue
            if _other_element(file, node, except_for):
                continue
            if _is_read(file, node) and binding in self.of_name(file, node):
                return f"line {file.line(node)}" if not _inside(file, node, except_for) else None
        if not isinstance(file.scopes(binding.node)[0], cst.Module):
            return None
        for other in self.mentioning(name):
            if other is file:
                continue
            for node in other.nodes:
                outer = other.parents.get(node)
                if not isinstance(node, cst.Name) or node.value != name or node is except_for:
                    continue
                if isinstance(outer, (cst.ImportAlias, cst.Arg)) or outer is except_for:
                    continue
                if _other_element(other, node, except_for):
                    continue
                return f"{other.name}, line {other.line(node)}"
        return None

    # --- attributes ---------------------------------------------------------------------------------

    def of_attribute(self, file: SourceFile, node: cst.Attribute) -> list[Binding]:
        """The bindings of ``self.NAME``, ``cls.NAME`` or ``Class.NAME`` in the classes of the given files."""
        owner, name = node.value, node.attr.value
        classes = [scope for scope in file.scopes(node) if isinstance(scope, cst.ClassDef)]
        if isinstance(owner, cst.Name) and owner.value not in ("self", "cls"):
            found = self.class_named(file, owner)
            if found is None:
                return []
            start = [found]
        elif isinstance(owner, cst.Name) and classes:
            start = [(file, classes[0])]
        elif classes and file.code(owner) in ("type(self)", "self.__class__"):
            start = [(file, classes[0])]
        else:
            return []
        stores: list[Binding] = []
        for other in self.mentioning(name):
            stores += _attribute_stores(other, name)
        family = self._family(*start[0])
        options: list[Binding] = []
        for other, cls in family.below:
            options += self.bindings(other, cls).get(name, [])
        for other, cls in family.above:
            own = self.bindings(other, cls).get(name)
            if own:
                options += reaching(other, own, None, cls)
                break
        if not stores:
            return options
        if len(stores) == 1 and not options:
            return stores
        which = stores[0]
        why = f"it is set again at line {which.file.line(which.node)}"
        return [Binding(which.file, name, which.node, None, why)]

    def attribute_readers(self, binding: Binding, except_for: cst.CSTNode) -> str | None:
        """Who else reads an attribute of that name."""
        name = binding.name
        for file in self.mentioning(name):
            for node in file.nodes:
                if node is except_for or node is binding.node:
                    continue
                if isinstance(node, cst.Attribute) and node.attr.value == name:
                    outer = file.parents[node]
                    if isinstance(outer, (cst.AssignTarget, cst.AnnAssign)):
                        continue
                    if _other_element(file, node, except_for):
                        continue
                elif isinstance(node, cst.SimpleString) and node.raw_value == name:
                    pass
                elif isinstance(node, cst.Name) and node.value == name and _is_read(file, node):
                    if binding not in self.of_name(file, node):
                        continue
                else:
                    continue
                where = f"line {file.line(node)}"
                return where if file is binding.file else f"{file.name}, {where}"
        return None

    def class_named(
        self, file: SourceFile, node: cst.BaseExpression
    ) -> tuple[SourceFile, cst.ClassDef] | None:
        if isinstance(node, cst.Attribute):
            dotted = self.dotted(file, node)
        elif isinstance(node, cst.Name):
            found = self.of_name(file, node)
            if len(found) == 1 and isinstance(found[0].node, cst.ClassDef):
                return found[0].file, found[0].node
            dotted = found[0].dotted if len(found) == 1 else None
        else:
            return None
        if dotted is None or "." not in dotted:
            return None
        module, _, name = dotted.rpartition(".")
        other = self.module(module, file)
        if other is None:
            return None
        inside = self.bindings(other, other.module).get(name, [])
        if len(inside) == 1 and isinstance(inside[0].node, cst.ClassDef):
            return other, inside[0].node
        return None

    @dataclass(frozen=True)
    class Family:
        above: list[tuple[SourceFile, cst.ClassDef]]
        """The class itself, and its bases in the order in which Python asks them, nearly."""
        below: list[tuple[SourceFile, cst.ClassDef]]

    def _family(self, file: SourceFile, cls: cst.ClassDef) -> Family:
        above = self._above(file, cls, [])
        below: list[tuple[SourceFile, cst.ClassDef]] = []
        for other in self.mentioning("class"):
            for node in other.nodes:
                if isinstance(node, cst.ClassDef) and node is not cls:
                    if any(base is cls for _, base in self._above(other, node, [])):
                        below.append((other, node))
        return Project.Family(above, below)

    def _above(
        self, file: SourceFile, cls: cst.ClassDef, seen: list[cst.ClassDef]
    ) -> list[tuple[SourceFile, cst.ClassDef]]:
        if cls in seen:
            return []
        seen.append(cls)
        found = [(file, cls)]
        for base in cls.bases:
            named = self.class_named(file, base.value)
            if named is not None:
                found += self._above(*named, seen)
        return found

    # --- libraries ----------------------------------------------------------------------------------

    def dotted(self, file: SourceFile, node: cst.BaseExpression) -> str | None:
        """The full name of what `node` means in some library: ``numpy.pi``. None if it is none's."""
        if isinstance(node, cst.Attribute):
            owner = self.dotted(file, node.value)
            return None if owner is None else f"{owner}.{node.attr.value}"
        if not isinstance(node, cst.Name):
            return None
        found = self.of_name(file, node)
        if found:
            return found[-1].dotted if all(b.dotted == found[-1].dotted for b in found) else None
        for star in _starred(file):
            if f"{star}.{node.value}" in _STARRED:
                return f"{star}.{node.value}"
        return None


_STARRED = frozenset(
    (
        "mani_skill.utils.sapien_utils.look_at mani_skill.sensors.camera.CameraConfig "
        "mani_skill.utils.structs.Pose mani_skill.utils.structs.pose.Pose numpy.pi math.pi "
        "transforms3d.euler.euler2quat"
    ).split()
)
"""What the cameras of a file with ``from x import *`` are likely to get by it."""


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
        if use is not None and use in walk(binding.node):
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


def _inside(file: SourceFile, node: cst.CSTNode, outer: cst.CSTNode) -> bool:
    return any(found is outer for found in file.ancestors(node))


def _other_element(file: SourceFile, node: cst.CSTNode, mine: cst.CSTNode) -> bool:
    """True for ``CAMERA["fov"]`` where mine is the name in ``CAMERA["eye"]``."""
    keys = []
    for name in (node, mine):
        outer = file.parents.get(name)
        if not isinstance(outer, cst.Subscript) or outer.value is not name or len(outer.slice) != 1:
            return False
        index = outer.slice[0].slice
        if not isinstance(index, cst.Index) or not isinstance(index.value, (cst.SimpleString, cst.Integer)):
            return False
        keys.append(index.value.evaluated_value)
    return keys[0] != keys[1]


def _is_read(file: SourceFile, node: cst.Name) -> bool:
    outer = file.parents[node]
    if isinstance(outer, (cst.AssignTarget, cst.Param, cst.ImportAlias, cst.AsName, cst.FunctionDef)):
        return False
    if isinstance(outer, (cst.ClassDef, cst.NameItem, cst.CompFor)):
        return False
    if isinstance(outer, (cst.AnnAssign, cst.NamedExpr, cst.For)) and outer.target is node:
        return False
    if isinstance(outer, cst.Attribute):
        return outer.value is node
    return not (isinstance(outer, cst.Arg) and outer.keyword is node)


def _own_nodes(scope: Scope) -> Iterator[cst.CSTNode]:
    """The nodes that are in `scope` and in no scope within it, in the order of the text."""
    waiting: list[cst.CSTNode] = (
        [scope.body] if not isinstance(scope, cst.Module) else [*reversed(scope.body)]
    )
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, (cst.FunctionDef, cst.ClassDef, cst.Lambda)):
            waiting += reversed(node.children)


def _bindings(file: SourceFile, scope: Scope) -> Iterator[Binding]:
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


def _starred(file: SourceFile) -> list[str]:
    return [
        file.module.code_for_node(node.module)
        for node in file.nodes
        if isinstance(node, cst.ImportFrom) and isinstance(node.names, cst.ImportStar) and node.module
    ]


def _attribute_stores(file: SourceFile, name: str) -> list[Binding]:
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
