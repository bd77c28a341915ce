"""Where a name gets its value, and who else reads it there.

Python's scopes are followed as far as reading files can follow them: locals, enclosing functions, the module,
class attributes through the classes of the given files, ``from beside import NAME``. Who else reads a definition is
asked before it is changed, and there any file that has the name counts, since too many readers only means that
the value is written elsewhere.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePath

import libcst as cst

from workbench.authoring.camera_source.bindings import Binding, attribute_stores, bindings_of, reaching
from workbench.authoring.camera_source.source_file import Scope, SourceFile, parsed, walk

LOOPS = (cst.For, cst.While, cst.ListComp, cst.SetComp, cst.DictComp, cst.GeneratorExp)


class Project:
    """The given files, parsed as they are asked for."""

    def __init__(self, texts: Mapping[str, str]) -> None:
        self.texts = texts
        self._files: dict[str, SourceFile] = {}
        self._bindings: dict[cst.CSTNode, dict[str, list[Binding]]] = {}

    def file(self, path: str) -> SourceFile:
        if path not in self._files:
            self._files[path] = parsed(path, self.texts[path])
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
            for binding in bindings_of(file, scope):
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

    def name_readers(self, binding: Binding, file: SourceFile, read: cst.CSTNode) -> str | None:
        """Who reads a plain name's `binding`, other than `read` in `file`."""
        name = binding.name
        for node in binding.file.nodes:
            if not isinstance(node, cst.Name) or node.value != name or node is read:
                continue
            if _other_element(binding.file, node, read) or _inside(binding.file, node, read):
                continue
            if _is_read(binding.file, node) and binding in self.of_name(binding.file, node):
                return self._where(binding.file, node, file)
        if binding.dotted is not None or not isinstance(binding.file.scopes(binding.node)[0], cst.Module):
            return None
        for other in self.mentioning(name):
            if other is binding.file:
                continue
            for node in other.nodes:
                if not isinstance(node, cst.Name) or node.value != name or node is read:
                    continue
                outer = other.parents[node]
                if isinstance(outer, cst.ImportAlias) and other is file:
                    continue
                if isinstance(outer, cst.Arg) and outer.keyword is node:
                    continue
                if outer is not read and not _other_element(other, node, read):
                    return self._where(other, node, file)
        return None

    def _where(self, file: SourceFile, node: cst.CSTNode, reader: SourceFile) -> str:
        line = f"line {file.line(node)}"
        return line if file is reader else f"{file.name}, {line}"

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
            stores += attribute_stores(other, name)
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

    def attribute_readers(self, binding: Binding, reader: SourceFile, read: cst.CSTNode) -> str | None:
        """Who reads an attribute of that name, other than `read`."""
        name = binding.name
        for file in self.mentioning(name):
            for node in file.nodes:
                if node is read or node is binding.node:
                    continue
                if isinstance(node, cst.Attribute) and node.attr.value == name:
                    outer = file.parents[node]
                    if isinstance(outer, (cst.AssignTarget, cst.AnnAssign)):
                        continue
                    if _other_element(file, node, read):
                        continue
                elif isinstance(node, cst.SimpleString) and node.raw_value == name:
                    pass
                elif isinstance(node, cst.Name) and node.value == name and _is_read(file, node):
                    if binding not in self.of_name(file, node):
                        continue
                else:
                    continue
                return self._where(file, node, reader)
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
        above = self.above(file, cls, [])
        below: list[tuple[SourceFile, cst.ClassDef]] = []
        for other in self.mentioning("class"):
            for node in other.nodes:
                if isinstance(node, cst.ClassDef) and node is not cls:
                    if any(base is cls for _, base in self.above(other, node, [])):
                        below.append((other, node))
        return Project.Family(above, below)

    def above(
        self, file: SourceFile, cls: cst.ClassDef, seen: list[cst.ClassDef]
    ) -> list[tuple[SourceFile, cst.ClassDef]]:
        """`cls` and its bases in the given files, in nearly the order in which Python asks them."""
        if cls in seen:
            return []
        seen.append(cls)
        found = [(file, cls)]
        for base in cls.bases:
            named = self.class_named(file, base.value)
            if named is not None:
                found += self.above(*named, seen)
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


def _starred(file: SourceFile) -> list[str]:
    return [
        file.module.code_for_node(node.module)
        for node in file.nodes
        if isinstance(node, cst.ImportFrom) and isinstance(node.names, cst.ImportStar) and node.module
    ]
