"""Finds where in the author's files the arguments of a running call are written."""

from __future__ import annotations

import ast
import copy
import importlib.util
import inspect
import math
import operator
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice
from types import FrameType, ModuleType, SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import sapien
import torch
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs.pose import Pose
from transforms3d import euler

from workbench.envs import maniskill_private
from workbench.source.definitions import Binding, Project, reaching
from workbench.source.parsed import (
    DEGREE,
    FUNCTIONS,
    Place,
    Plain,
    Read,
    Scope,
    SourceFile,
    Trace,
    TracedValue,
    arguments,
    is_starred,
)

_MAX_NAME_CHAIN = 40
"""Maximum length of a chain of names that is followed; a longer chain counts as a cycle."""
_CONDITION_NODES = (
    ast.Name,
    ast.Attribute,
    ast.Constant,
    ast.Compare,
    ast.cmpop,
    ast.BoolOp,
    ast.boolop,
    ast.UnaryOp,
    ast.Not,
    ast.expr_context,
)
_PRESENT_NODES = (
    *(ast.Name, ast.Attribute, ast.Subscript, ast.Constant, ast.List, ast.Tuple, ast.expr_context),
    *(ast.BinOp, ast.operator, ast.UnaryOp, ast.unaryop),
)
_NAME_NODES = (ast.Name, ast.Attribute, ast.Subscript)
Reads = tuple[Read, ...]
_Made = TypeVar("_Made")


class Unknown(Exception):
    """A value cannot be followed to the text that defines it; the message tells the author why."""


def trace_call(
    project: Project, frame: FrameType, parameters: Sequence[str], values: Mapping[str, Any]
) -> Trace | None:
    """Trace the call that `frame` is making.

    Args:
        parameters: parameters of the called function, in order.
        values: run-time value of each parameter to trace.

    Returns:
        None if the call is not in one of the project's files.
    """
    found = running_call(project, frame)
    if found is None:
        return None
    file, call = found
    reader = ValueReader(project, file, call, frame)
    parts: dict[str, TracedValue] = {}
    unknown: dict[str, str] = {}
    given, starred = arguments(call, parameters), is_starred(call)
    for name, value in values.items():
        if name not in given:
            if starred:
                unknown[name] = f"`{name}` is given by * or **"
            continue
        try:
            parts[name] = part = reader.part(file, given[name])
            if not _same(part.value, plain_value(value)):
                raise reader.computed(file, given[name])
        except Unknown as exc:
            parts.pop(name, None)
            unknown[name] = str(exc)
    return Trace(Place(file.path, *file.inner_span(call)), file.qualname(call), parts, unknown)


def running_call(project: Project, frame: FrameType) -> tuple[SourceFile, ast.Call] | None:
    """The file and the call that `frame` is making; None if the call is not in one of the project's files."""
    code = frame.f_code
    place = next(islice(code.co_positions(), frame.f_lasti // 2, None), (None,) * 4)
    if code.co_filename not in project.texts or None in place:
        return None
    file = project.file(code.co_filename)
    line, end_line, column, end_column = place
    call = file.at(line, end_line, column, end_column)  # type: ignore[arg-type]
    return (file, call) if isinstance(call, ast.Call) else None


def _same(a: Plain, b: Plain) -> bool:
    """Whether two values are equal within single precision."""
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=1e-5, abs_tol=1e-6)
    return a == b


class ValueReader:
    """Follows the arguments of one call while its frame exists.

    The frame has the value of every name, and the frame's code has the exact position of the call. A name is
    followed to its assignment. If several assignments may apply, the name is followed to the one whose value
    equals the name's present value. Any doubt raises `Unknown`, because the result decides which line of the
    author's file is edited.

    Args:
        together: names that are edited together; none of them counts as another reader of their value.
    """

    def __init__(
        self,
        project: Project,
        file: SourceFile,
        call: ast.expr,
        frame: FrameType,
        together: Collection[ast.AST] = (),
    ) -> None:
        self._project, self._frame = project, frame
        self._around = file.scopes(call)
        self._together = together

    def computed(self, file: SourceFile, node: ast.AST) -> Unknown:
        return Unknown(f"`{file.one_line(node)}` is computed when the task runs")

    def part(self, file: SourceFile, node: ast.expr, reads: Reads = ()) -> TracedValue:
        """The traced value of an expression that the names `reads` lead to. Raises Unknown."""
        if len(reads) > _MAX_NAME_CHAIN:
            raise Unknown(f"`{file.code(node)}` is defined by itself")
        if isinstance(node, ast.IfExp):
            return self.part(file, node.body if self._test(file, node.test) else node.orelse, reads)
        if isinstance(node, _NAME_NODES) and not self._is_from_library(file, node):
            where, value, others = self._follow(file, node)
            return self.part(where, value, (*reads, Read(Place(file.path, *file.inner_span(node)), others)))
        place = Place(file.path, *file.inner_span(node))
        if isinstance(node, ast.Call):
            return self._call(file, node, place, reads)
        self._check(file, node)
        value = self._value(file, node)
        if isinstance(node, (ast.List, ast.Tuple)):
            parts = {str(i): self.part(file, item, reads) for i, item in enumerate(node.elts)}
            return TracedValue(place, reads, value, parts=parts, literal=True)
        if _is_number(node) or not isinstance(value, float):
            return TracedValue(place, reads, value, literal=_is_number(node))
        return self._with_editable_number(file, node, TracedValue(place, reads, value))

    # --- values -------------------------------------------------------------------------------------

    def present_value(self, file: SourceFile, node: ast.expr) -> Plain:
        """The value of an expression of names and numbers, wherever they are defined. Raises Unknown."""
        if not all(isinstance(inner, _PRESENT_NODES) for inner in ast.walk(node)):
            raise self.computed(file, node)  # evaluating it again may have effects
        return self._value(file, node)

    def _value(self, file: SourceFile, node: ast.expr) -> Plain:
        """The value of an expression that `_check` accepts."""
        return self._evaluate(file, node, node, plain_value)

    def _evaluate(
        self, file: SourceFile, node: ast.expr, whole: ast.expr, made: Callable[[Any], _Made]
    ) -> _Made:
        """`made(value of node)`. Raises Unknown with the expression `whole` in its message."""
        try:
            return made(self._run(file, node))
        except Exception as exc:  # the author's classes may raise anything
            raise self.computed(file, whole) from exc

    def _run(self, file: SourceFile, node: ast.expr, at: ast.AST | None = None) -> Any:
        names, own = self._namespace(file, file.scopes(node if at is None else at)[0])
        return eval(compile(ast.Expression(node), file.path, "eval"), names, own)

    def _namespace(self, file: SourceFile, scope: Scope) -> tuple[dict[str, Any], Mapping[str, Any]]:
        """Current globals and locals of code in a scope."""
        running = self._frame
        names = running.f_globals if file.path == running.f_code.co_filename else vars(module_of(file.path))
        if scope in self._around and isinstance(scope, FUNCTIONS):
            return names, running.f_locals
        if isinstance(scope, ast.ClassDef):
            return names, vars(operator.attrgetter(file.qualname(scope))(SimpleNamespace(**names)))
        # Another method of the same object, such as its constructor.
        return names, {name: running.f_locals[name] for name in ("self", "cls") if name in running.f_locals}

    def _check(self, file: SourceFile, node: ast.AST) -> None:
        """Raise Unknown unless `node` is made of numbers, names that can be followed, and known functions."""
        if isinstance(node, _NAME_NODES):
            if not self._is_from_library(file, node):
                self.part(file, node)
        elif isinstance(node, ast.Call):
            self._function(file, node)
            for given in (*node.args, *(keyword.value for keyword in node.keywords)):
                self._check(file, given)
        elif isinstance(node, (ast.List, ast.Tuple, ast.BinOp)) or (
            isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd))
        ):
            for child in ast.iter_child_nodes(node):
                if isinstance(child, ast.expr):
                    self._check(file, child)
        elif not isinstance(node, ast.Constant) or isinstance(node.value, (bytes, bool)):
            raise self.computed(file, node)

    def _test(self, file: SourceFile, node: ast.expr) -> bool:
        """The value of a condition. Raises Unknown."""
        if not all(isinstance(inner, _CONDITION_NODES) for inner in ast.walk(node)):
            raise self.computed(file, node)
        return self._evaluate(file, node, node, bool)

    def _with_editable_number(self, file: SourceFile, node: ast.expr, whole: TracedValue) -> TracedValue:
        """`whole`. If a number within the expression can be edited instead, it is added as the part ``of``.

        Examples: the 60 of ``60 * np.pi / 180``; the 0.2 of ``HEIGHT + 0.2``, so that the value still follows
        HEIGHT.
        """
        leaves = list(_leaves(node))
        named = any(not _is_number(leaf) and not self._is_from_library(file, leaf) for leaf in leaves)
        best: tuple[bool, ast.expr, float, float] | None = None
        for leaf in leaves:
            if self._is_from_library(file, leaf):
                continue
            at = self._value(file, leaf)
            literal = _is_number(leaf)
            if not isinstance(at, float):
                continue
            values = [self._value_with(file, node, leaf, at + step) for step in (0.0, 1.0, 2.0)]
            slope, further = values[1] - values[0], values[2] - values[1]
            offset = values[0] - slope * at
            of_degrees = math.isclose(slope, DEGREE, rel_tol=1e-9)
            added = literal and named and math.isclose(abs(slope), 1.0, rel_tol=1e-9)
            if math.isclose(slope, further, rel_tol=1e-6) and (of_degrees or added):
                if best is None or literal >= best[0]:
                    best = literal, leaf, DEGREE if of_degrees else float(round(slope)), offset
        if best is None:
            return whole
        _, leaf, slope, offset = best
        parts = {"of": self.part(file, leaf, whole.reads)}
        return TracedValue(whole.at, whole.reads, whole.value, parts=parts, slope=slope, offset=offset)

    def _value_with(self, file: SourceFile, node: ast.expr, leaf: ast.expr, value: float) -> float:
        """The value of the expression with `value` in place of `leaf`."""
        try:
            with np.errstate(all="ignore"):
                found = plain_value(self._run(file, _substitute(node, leaf, value), node))
        except (ValueError, ArithmeticError):  # such as math.acos(1.5)
            return math.nan
        return found if isinstance(found, float) else math.nan

    # --- calls --------------------------------------------------------------------------------------

    def _function(self, file: SourceFile, node: ast.Call) -> KnownFunction:
        """The function that `node` calls. Raises Unknown for an unknown function, and for arguments by
        ``*``."""
        if not is_starred(node) and _is_named(node.func):
            found = self._evaluate(file, node.func, node, known_functions().get)
            if found is not None:
                return found
        raise self.computed(file, node)

    def _call(self, file: SourceFile, node: ast.Call, place: Place, reads: Reads) -> TracedValue:
        known = self._function(file, node)
        if known.converts and (node.args or node.keywords):
            inner = self.part(file, node.args[0] if node.args else node.keywords[0].value, reads)
            if inner.function or isinstance(inner.value, float) or (inner.literal and inner.reads == reads):
                return inner  # the argument is edited, the call stays
            return TracedValue(place, reads, inner.value, parts=inner.parts, literal=inner.literal)
        if not known.parameters:
            self._check(file, node)
            return self._with_editable_number(file, node, TracedValue(place, reads, self._value(file, node)))
        given = arguments(node, known.parameters)
        if len(given) != len(node.args) + len(node.keywords) or not set(given) <= set(known.parameters):
            raise self.computed(file, node)
        given.pop("device", None)
        parts = {name: self.part(file, value, reads) for name, value in given.items()}
        return TracedValue(place, reads, self._value(file, node), known.name, parts)

    # --- names --------------------------------------------------------------------------------------

    def _is_from_library(self, file: SourceFile, node: ast.AST) -> bool:
        """Whether a name comes from a library: ``np.pi``, or an imported ``pi``."""
        if isinstance(node, ast.Attribute):
            owner = self._object(file, node.value)
            return (
                isinstance(owner, ModuleType) and getattr(owner, "__file__", None) not in self._project.texts
            )
        if not isinstance(node, ast.Name):
            return False
        found = self._project.bindings_of(file, node)
        if not found:  # by ``from x import *``
            return node.id in self._namespace(file, file.module)[0]
        imported = [b for b in found if b.imported is not None and b.imported[1]]
        return (
            bool(imported)
            and len(imported) == len(found)
            and all(self._imported_file(b) is None for b in imported)
        )

    def _object(self, file: SourceFile, node: ast.expr) -> Any:
        """The object that a name or a module's attribute is bound to; None for other expressions."""
        if isinstance(node, ast.Attribute):
            owner = self._object(file, node.value)
            return vars(owner).get(node.attr) if isinstance(owner, ModuleType) else None
        try:
            return self._run(file, node) if isinstance(node, ast.Name) else None
        except (NameError, AttributeError):  # a class that is not defined yet
            return None

    def _imported_file(self, binding: Binding) -> SourceFile | None:
        """The author's file that a binding is imported from; None for a library."""
        assert binding.imported is not None
        names = self._namespace(binding.file, binding.file.module)[0]
        try:
            name = importlib.util.resolve_name(binding.imported[0], names.get("__package__") or "")
        except ImportError:
            return None
        path = str(getattr(sys.modules.get(name), "__file__", None))
        return self._project.file(path) if path in self._project.texts else None

    def _follow(self, file: SourceFile, node: ast.expr) -> tuple[SourceFile, ast.expr, str | None]:
        """The file and the expression that define a name, and a place where other code reads the name (None
        if there is none). Raises Unknown."""
        project = self._project
        if isinstance(node, ast.Subscript):
            return self._element(file, node)
        if isinstance(node, ast.Name):
            return self._follow_bindings(file, node, project.bindings_of(file, node))
        assert isinstance(node, ast.Attribute)
        owner = self._object(file, node.value)
        if isinstance(owner, ModuleType):
            module = project.file(owner.__file__ or "")
            return self._follow_bindings(
                file, node, project.bindings(module, module.module).get(node.attr, [])
            )
        return self._follow_bindings(file, node, self._attribute_bindings(file, node))

    def _follow_bindings(
        self, file: SourceFile, node: ast.expr, bindings: Sequence[Binding]
    ) -> tuple[SourceFile, ast.expr, str | None]:
        code = file.code(node)
        if not bindings:
            raise Unknown(f"the assignment of `{code}` is not found in the file")
        binding = bindings[0] if len(bindings) == 1 else self._binding_of_run(file, node, bindings)
        if binding.imported is not None:
            source = self._imported_file(binding) if binding.imported[1] else None
            inside = (
                []
                if source is None
                else self._project.bindings(source, source.module).get(binding.imported[1], [])
            )
            if not inside:
                raise Unknown(f"`{code}` comes from {binding.dotted}, which is not one of your files")
            others = self._readers(binding, file, node)
            where, value, more = self._follow_bindings(file, node, inside)
            return where, value, others or more
        if binding.value is None:
            home = "the file" if binding.file is file else binding.file.name
            raise Unknown(f"`{code}` cannot be read in {home}: {binding.why}")
        others = self._readers(binding, file, node)
        if isinstance(binding.node, ast.Assign) and len(binding.node.targets) > 1:
            others = others or f"line {binding.file.line(binding.node)} gives it to several names"
        return binding.file, binding.value, others

    def _readers(self, binding: Binding, file: SourceFile, node: ast.expr) -> str | None:
        return self._project.readers(binding, file, node, _concerned_by(binding), self._together)

    def _binding_of_run(self, file: SourceFile, node: ast.expr, bindings: Sequence[Binding]) -> Binding:
        """The binding whose value is the name's present value. Raises Unknown unless there is exactly one."""
        fitting = []
        for binding in bindings:
            try:
                if binding.value is not None and _same(
                    self.part(binding.file, binding.value).value, self._value(file, node)
                ):
                    fitting.append(binding)
            except (Unknown, LookupError, AttributeError):
                continue  # its value is unknown
        if len(fitting) == 1:
            return fitting[0]
        lines = " and ".join(str(b.file.line(b.node)) for b in fitting or bindings)
        code = file.code(node)
        if fitting:
            raise Unknown(
                f"`{code}` gets the same value in lines {lines}, and it is unknown which of them ran"
            )
        raise Unknown(f"none of the assignments to `{code}` (lines {lines}) gives its current value")

    def _attribute_bindings(self, file: SourceFile, node: ast.Attribute) -> list[Binding]:
        """The bindings of ``self.NAME``, ``cls.NAME`` or ``Class.NAME``."""
        if not _is_named(node.value):
            raise self.computed(file, node)  # evaluating it again may have effects
        owner = self._run(file, node.value)
        kind = owner if isinstance(owner, type) else type(owner)
        stores = self._project.attribute_stores(node.attr, classes_of(kind))
        own: list[Binding] = []
        for cls in kind.__mro__:
            if node.attr in vars(cls):
                own = self._class_bindings(cls, node.attr)
                break
        if not stores:
            return own
        if len(stores) == 1 and not own:
            return stores
        every = [*own, *stores]
        why = f"it is set at {' and at '.join(_place_text(binding) for binding in every)}"
        return [Binding(every[0].file, node.attr, every[0].node, None, why)]

    def _class_bindings(self, cls: type, name: str) -> list[Binding]:
        path = str(getattr(sys.modules.get(cls.__module__), "__file__", None))
        if path not in self._project.texts:
            return []
        file = self._project.file(path)
        for node in file.nodes:
            if isinstance(node, ast.ClassDef) and file.qualname(node) == cls.__qualname__:
                return reaching(file, self._project.bindings(file, node).get(name, []), None, node)
        return []

    def _element(self, file: SourceFile, node: ast.Subscript) -> tuple[SourceFile, ast.expr, str | None]:
        code = file.one_line(node)
        try:
            key = self.part(file, node.slice).value
        except Unknown as exc:
            raise Unknown(f"`{code}` depends on a value that only the running task has") from exc
        where, base, others = file, node.value, None
        for _ in range(_MAX_NAME_CHAIN):
            if isinstance(base, _NAME_NODES):
                where, base, more = self._follow(where, base)
                others = others or more
        found = _entry(where, base, key)
        if found is None:
            raise Unknown(f"`{code}` is computed when the task runs")
        return where, found, others


def classes_of(cls: type) -> set[tuple[str, str]]:
    """File and name of a class and of its base classes."""
    modules = [(sys.modules.get(base.__module__), base.__qualname__) for base in cls.__mro__]
    return {(str(getattr(module, "__file__", None)), name) for module, name in modules}


def _concerned_by(binding: Binding) -> Callable[[str, str], bool]:
    """The argument `concerns` of `Project.readers` for a binding."""
    file = binding.file
    around = next((scope for scope in file.scopes(binding.node) if isinstance(scope, ast.ClassDef)), None)
    home = None if around is None else _class_named(file.path, file.qualname(around))
    if home is None:
        return lambda path, owner: True

    def concerns(path: str, owner: str) -> bool:
        # In a method of `owner`, ``self`` can be an object of `cls` only if `cls` is `owner` or inherits from it.
        return any((path, owner) in classes_of(cls) for cls in (home, *_subclasses(home)))

    return concerns


def _class_named(path: str, name: str) -> type | None:
    try:
        found = operator.attrgetter(name)(module_of(path))
    except (LookupError, AttributeError):  # a class within a function
        return None
    return found if isinstance(found, type) else None


def _subclasses(cls: type) -> Iterator[type]:
    for each in type.__subclasses__(cls):
        yield each
        yield from _subclasses(each)


def _place_text(binding: Binding) -> str:
    """The place of a binding, as text: ``push.py:12 in PushEnv.__init__``."""
    file = binding.file
    return f"{file.name}:{file.line(binding.node)} in {file.qualname(binding.node)}"


def _entry(file: SourceFile, base: ast.expr, key: Plain) -> ast.expr | None:
    """The expression of an element of a list, a dict or a ``dict(...)``."""
    if isinstance(base, (ast.List, ast.Tuple)) and isinstance(key, float) and key == int(key):
        if -len(base.elts) <= key < len(base.elts) and not any(isinstance(e, ast.Starred) for e in base.elts):
            return base.elts[int(key)]
    entries: list[tuple[ast.expr | None, ast.expr]] = []
    if isinstance(base, ast.Dict):
        entries = list(zip(base.keys, base.values, strict=True))
    elif isinstance(base, ast.Call) and file.code(base.func) == "dict":
        entries = [(k.arg and ast.Constant(k.arg), k.value) for k in base.keywords]  # type: ignore[misc]
    if any(name is None for name, _ in entries):
        return None
    return next((v for name, v in entries if isinstance(name, ast.Constant) and name.value == key), None)


def _is_named(node: ast.AST) -> bool:
    """Whether `node` is a name or attribute, which can be evaluated again without side effects."""
    return all(isinstance(inner, (ast.Name, ast.Attribute, ast.Load)) for inner in ast.walk(node))


def _is_number(node: ast.AST) -> bool:
    """Whether `node` is a plain number, perhaps with a sign."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
        node = node.operand
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def _leaves(node: ast.AST) -> Iterator[ast.expr]:
    """The numbers and names of an expression."""
    if _is_number(node) or isinstance(node, _NAME_NODES):
        assert isinstance(node, ast.expr)
        yield node
        return
    inside = [*node.args, *node.keywords] if isinstance(node, ast.Call) else ast.iter_child_nodes(node)
    for child in inside:
        yield from _leaves(child)


def _substitute(node: ast.AST, leaf: ast.AST, value: float) -> Any:
    """A copy of `node` with a number in place of `leaf`."""
    if node is leaf:
        return ast.copy_location(ast.Constant(value), node)
    made = copy.copy(node)
    for name, held in ast.iter_fields(node):
        if isinstance(held, ast.AST):
            setattr(made, name, _substitute(held, leaf, value))
        elif isinstance(held, list):
            setattr(made, name, [_substitute(h, leaf, value) if isinstance(h, ast.AST) else h for h in held])
    return made


def module_of(path: str) -> ModuleType:
    """The module of a file. Raises LookupError."""
    for module in list(sys.modules.values()):
        if getattr(module, "__dict__", {}).get("__file__") == path:
            return module
    raise LookupError(f"{path} was not imported")


# --- functions and values of libraries ------------------------------------------------------------


@dataclass(frozen=True)
class KnownFunction:
    """A library function whose value depends only on its arguments, so that a call may be evaluated again."""

    name: str = ""
    """Name for `TracedValue.function`; empty if `parameters` is empty."""
    parameters: tuple[str, ...] = ()
    """The function's parameters, in order, if its arguments may be edited; else empty."""
    converts: bool = False
    """Whether the function only converts the type of its first argument; then the argument is edited, not the
    call."""


@cache
def known_functions() -> dict[Callable[..., Any], KnownFunction]:
    """Known functions by identity, so that a file may import them under any name."""
    # This wraps look_at. A file may have imported the original before, so both are in the table.
    maniskill_private.mark_camera_configs()
    converts, number, look_at = (
        KnownFunction(converts=True),
        KnownFunction(),
        KnownFunction("look_at", ("eye", "target", "up", "device")),
    )
    table: dict[Callable[..., Any], KnownFunction] = {
        sapien_utils.look_at: look_at,
        inspect.unwrap(sapien_utils.look_at): look_at,
        sapien.Pose: KnownFunction("pose", ("p", "q")),
        Pose.create_from_pq: KnownFunction("pose", ("p", "q", "device")),
        euler.euler2quat: KnownFunction("euler", ("ai", "aj", "ak", "axes")),
    }
    for function in (Pose.create, float, list, tuple, np.array, np.asarray, torch.tensor, torch.as_tensor):
        table[function] = converts
    for name in ("sin", "cos", "tan", "sqrt", "radians", "degrees"):
        table[getattr(np, name)] = table[getattr(math, name)] = number
    for name in ("deg2rad", "rad2deg", "arctan", "arcsin", "arccos"):
        table[getattr(np, name)] = number
    for name in ("atan", "asin", "acos"):
        table[getattr(math, name)] = number
    return table


def plain_value(value: Any) -> Plain:
    """`value` with numbers as floats, sequences and arrays as tuples, a pose as seven numbers.

    Raises:
        ValueError: it is not made of numbers.
    """
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, sapien.Pose):
        return plain_value([*value.p, *value.q])
    if isinstance(value, Pose):
        return plain_value(value.raw_pose[0])
    if isinstance(value, (list, tuple)):
        return tuple(plain_value(item) for item in value)
    if isinstance(value, (int, float, np.number)) and not isinstance(value, bool):
        return float(value)
    if isinstance(value, (np.ndarray, torch.Tensor)):
        return plain_value(value.tolist())
    raise ValueError(f"a {type(value).__name__} is not a number")
