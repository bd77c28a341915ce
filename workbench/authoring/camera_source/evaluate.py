"""What an expression is worth, found by reading: literals, arithmetic, constants, and the calls that make poses.

Nothing of the author's is executed. What reading cannot tell is said to be unknown, with the reason; that is
the answer wherever there is doubt, since on it rests whether a line of somebody's file is changed. Where a value
depends on a branch (two assignments of a name, ``a if x else b``), the branches are tried one after the
other, and the camera that the running env has tells which of them it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import libcst as cst

from workbench.authoring.camera_source import rotations
from workbench.authoring.camera_source.bindings import Binding
from workbench.authoring.camera_source.definitions import Project
from workbench.authoring.camera_source.source_file import SourceFile, walk
from workbench.authoring.camera_source.values import (
    Angles,
    Nothing,
    Number,
    Place,
    PoseValue,
    Read,
    Text,
    Value,
    Vector,
)


class Unknown(Exception):
    """Reading does not tell; the reason is for the author."""


class Branches(Exception):
    """What holds depends on the run. `place` is the fork, `count` how many ways there are."""

    def __init__(self, place: cst.CSTNode, count: int) -> None:
        super().__init__(place, count)
        self.place, self.count = place, count


LOOK_AT = frozenset(("mani_skill.utils.sapien_utils.look_at",))
SAPIEN_POSE = frozenset(("sapien.Pose", "sapien.core.Pose", "sapien.pysapien.Pose"))
MANISKILL_POSE = frozenset(("mani_skill.utils.structs.Pose", "mani_skill.utils.structs.pose.Pose"))
EULER = frozenset(("transforms3d.euler.euler2quat",))
RADIANS = frozenset(("numpy.deg2rad", "numpy.radians", "math.radians"))
DEGREES = frozenset(("numpy.rad2deg", "numpy.degrees", "math.degrees"))
PI = frozenset(("numpy.pi", "math.pi", "torch.pi"))
ARRAY = frozenset(("numpy.array", "numpy.asarray", "torch.tensor", "torch.as_tensor"))
FUNCTIONS: Mapping[str, Callable[[float], float]] = {
    f"{module}.{name}": getattr(math, name)
    for module in ("numpy", "math")
    for name in ("sin", "cos", "tan", "sqrt")
} | {
    "numpy.arctan": math.atan,
    "numpy.arcsin": math.asin,
    "numpy.arccos": math.acos,
    "math.atan": math.atan,
    "math.asin": math.asin,
    "math.acos": math.acos,
}

_DEPTH = 40
"""Names defined by names: beyond this they go in a circle."""


class Evaluator:
    """`chosen` says which way to go at a fork; `Branches` is raised at one that it does not have."""

    def __init__(self, project: Project, chosen: dict[cst.CSTNode, int]) -> None:
        self.project = project
        self.chosen = chosen

    def value(self, file: SourceFile, node: cst.BaseExpression, reads: tuple[Read, ...] = ()) -> Value:
        """Raises `Unknown` or `Branches`."""
        if len(reads) > _DEPTH:
            raise Unknown(f"`{file.code(node)}` is defined by itself")
        if isinstance(node, cst.Name) and node.value == "None":
            return Nothing(Place(file, node, reads))
        if isinstance(node, cst.IfExp):
            way = self._choose(node, 2)
            return self.value(file, node.orelse if way else node.body, reads)
        if isinstance(node, (cst.Name, cst.Attribute, cst.Subscript)):
            known = self.project.dotted(file, node) if not isinstance(node, cst.Subscript) else None
            if known in PI:
                return Number(math.pi, Place(file, node, reads), literal=False)
            return self._read(file, node, reads)
        place = Place(file, node, reads)
        if isinstance(node, (cst.Integer, cst.Float)):
            return Number(float(node.evaluated_value), place, literal=True)
        if isinstance(node, (cst.SimpleString, cst.ConcatenatedString)):
            text = node.evaluated_value
            if isinstance(text, str):
                return Text(text, place)
        elif isinstance(node, cst.UnaryOperation):
            return self._unary(node, place)
        elif isinstance(node, cst.BinaryOperation):
            return self._binary(node, place)
        elif isinstance(node, (cst.List, cst.Tuple)):
            return self._vector(node, place)
        elif isinstance(node, cst.Call):
            return self._call(node, place)
        raise Unknown(f"`{_short(file.code(node))}` is computed when the task runs")

    def _choose(self, fork: cst.CSTNode, count: int) -> int:
        if fork not in self.chosen:
            raise Branches(fork, count)
        return self.chosen[fork]

    # --- names --------------------------------------------------------------------------------------

    def _read(self, file: SourceFile, node: cst.BaseExpression, reads: tuple[Read, ...]) -> Value:
        found, others = self.followed(file, node)
        where, value = found
        return self.value(where, value, (*reads, Read(file, node, others)))

    def followed(
        self, file: SourceFile, node: cst.BaseExpression
    ) -> tuple[tuple[SourceFile, cst.BaseExpression], str | None]:
        """The expression that a name stands for, and who else reads it there."""
        if isinstance(node, cst.Subscript):
            return self._element(file, node)
        if isinstance(node, cst.Name):
            return self._bound(file, node, self.project.of_name(file, node), self.project.name_readers)
        assert isinstance(node, cst.Attribute)
        owner = self.project.dotted(file, node.value)
        beside = None if owner is None else self.project.module(owner, file)
        if beside is not None:
            inside = self.project.bindings(beside, beside.module).get(node.attr.value, [])
            return self._bound(file, node, inside, self.project.name_readers)
        bindings = self.project.of_attribute(file, node)
        return self._bound(file, node, bindings, self.project.attribute_readers)

    def _bound(
        self,
        file: SourceFile,
        node: cst.Name | cst.Attribute,
        bindings: list[Binding],
        readers: Callable[[Binding, SourceFile, cst.CSTNode], str | None],
    ) -> tuple[tuple[SourceFile, cst.BaseExpression], str | None]:
        code = file.code(node)
        if not bindings:
            raise Unknown(f"where `{code}` gets its value cannot be read in the file")
        binding = bindings[0 if len(bindings) == 1 else self._choose(node, len(bindings))]
        if binding.dotted is not None and binding.value is None:
            return self._imported(file, node, binding, readers(binding, file, node))
        if binding.value is None:
            raise Unknown(f"`{code}` cannot be read in the file: {binding.why}")
        others = readers(binding, file, node)
        if isinstance(binding.node, cst.Assign) and len(binding.node.targets) > 1:
            others = others or f"line {binding.file.line(binding.node)} gives it to several names"
        return (binding.file, binding.value), others

    def _imported(
        self, file: SourceFile, node: cst.Name | cst.Attribute, binding: Binding, others: str | None
    ) -> tuple[tuple[SourceFile, cst.BaseExpression], str | None]:
        module, _, name = (binding.dotted or "").rpartition(".")
        other = self.project.module(module, file) if module else None
        inside = [] if other is None else self.project.bindings(other, other.module).get(name, [])
        if other is None or not inside:
            raise Unknown(f"`{file.code(node)}` comes from {binding.dotted}, which is not one of your files")
        found = inside[0 if len(inside) == 1 else self._choose(node, len(inside))]
        if found.value is None:
            raise Unknown(f"`{file.code(node)}` cannot be read in {other.name}: {found.why}")
        return (found.file, found.value), others or self.project.name_readers(found, file, node)

    def _element(
        self, file: SourceFile, node: cst.Subscript
    ) -> tuple[tuple[SourceFile, cst.BaseExpression], str | None]:
        code = _short(file.code(node))
        index = node.slice[0].slice if len(node.slice) == 1 else None
        if not isinstance(index, cst.Index):
            raise Unknown(f"`{code}` is computed when the task runs")
        try:
            key = self.value(file, index.value)
        except Unknown as exc:
            raise Unknown(f"`{code}` depends on what only the running task knows") from exc
        where, base, others = file, node.value, None
        for _ in range(_DEPTH):
            if not isinstance(base, (cst.Name, cst.Attribute, cst.Subscript)):
                break
            (where, base), more = self.followed(where, base)
            others = others or more
        if isinstance(base, (cst.List, cst.Tuple)) and isinstance(key, Number):
            at = int(key.value)
            if at == key.value and -len(base.elements) <= at < len(base.elements):
                if not any(isinstance(e, cst.StarredElement) for e in base.elements):
                    return (where, base.elements[at].value), others
        for name, value in _entries(self.project, where, base):
            if isinstance(key, Text) and name == key.value:
                return (where, value), others
        raise Unknown(f"`{code}` is computed when the task runs")

    # --- numbers ------------------------------------------------------------------------------------

    def _unary(self, node: cst.UnaryOperation, place: Place) -> Value:
        inner = self.value(place.file, node.expression, place.reads)
        if isinstance(inner, Number) and isinstance(node.operator, (cst.Minus, cst.Plus)):
            sign = -1.0 if isinstance(node.operator, cst.Minus) else 1.0
            return Number(
                sign * inner.value, place, literal=inner.literal and inner.at.node is node.expression
            )
        if isinstance(inner, Vector) and inner.array and isinstance(node.operator, cst.Minus):
            return Vector(_mapped(inner, place, lambda x: -x), place, array=True, literal=False)
        raise self._computed(place)

    def _binary(self, node: cst.BinaryOperation, place: Place) -> Value:
        left = self.value(place.file, node.left, place.reads)
        right = self.value(place.file, node.right, place.reads)
        operation = _OPERATIONS.get(type(node.operator))
        if operation is None:
            raise self._computed(place)
        try:
            if isinstance(left, Number) and isinstance(right, Number):
                value = operation(left.value, right.value)
                if not isinstance(value, float):
                    raise self._computed(place)
                return Number(value, place, literal=False, part=self._part(node, place, left, right))
            if isinstance(left, Vector) or isinstance(right, Vector):
                items = _elementwise(left, right, place, operation)
                if items is not None:
                    return Vector(items, place, array=True, literal=False)
        except (ArithmeticError, ValueError) as exc:
            raise self._computed(place) from exc
        raise self._computed(place)

    def _part(
        self, node: cst.BinaryOperation, place: Place, left: Number, right: Number
    ) -> tuple[Number, float, float] | None:
        """The number of the expression that is best changed, if there is one."""
        if isinstance(node.operator, (cst.Multiply, cst.Divide)):
            over, under = self._factors(node, place)
            rest = [n for n in over if n.literal or n.value != math.pi]
            if len(rest) == 1 and len(over) == 2 and [n.value for n in under] == [180.0]:
                return rest[0], math.pi / 180, 0.0  # the 60 of 60 * np.pi / 180
        # HEIGHT + 0.2: it goes on following HEIGHT when 0.2 is changed.
        if isinstance(node.operator, cst.Add) and left.literal and _has_name(right):
            return left, 1.0, right.value
        if isinstance(node.operator, cst.Add) and right.literal and _has_name(left):
            return right, 1.0, left.value
        if isinstance(node.operator, cst.Subtract) and right.literal and _has_name(left):
            return right, -1.0, left.value
        return None

    def _factors(self, node: cst.BaseExpression, place: Place) -> tuple[list[Number], list[Number]]:
        """What is multiplied, and what it is divided by."""
        if isinstance(node, cst.BinaryOperation) and isinstance(node.operator, (cst.Multiply, cst.Divide)):
            over, under = self._factors(node.left, place)
            more, less = self._factors(node.right, place)
            if isinstance(node.operator, cst.Multiply):
                return over + more, under + less
            return over + less, under + more
        value = self.value(place.file, node, place.reads)
        return ([value], []) if isinstance(value, Number) else ([], [])

    def _computed(self, place: Place) -> Unknown:
        return Unknown(f"`{_short(place.file.code(place.node))}` is computed when the task runs")

    def _vector(self, node: cst.List | cst.Tuple, place: Place, array: bool = False) -> Vector:
        items: list[Number | Vector] = []
        for element in node.elements:
            if isinstance(element, cst.StarredElement):
                raise self._computed(place)
            item = self.value(place.file, element.value, place.reads)
            if not isinstance(item, (Number, Vector)):
                raise self._computed(place)
            items.append(item)
        return Vector(tuple(items), place, array=array, literal=True)

    # --- calls --------------------------------------------------------------------------------------

    def _call(self, node: cst.Call, place: Place) -> Value:
        file = place.file
        name = self.project.dotted(file, node.func)
        if name is None and isinstance(node.func, cst.Name) and not self.project.of_name(file, node.func):
            name = node.func.value
        if any(arg.star for arg in node.args):
            raise self._computed(place)
        if name in LOOK_AT:
            return self._look_at(node, place)
        if name in SAPIEN_POSE:
            given = self._given(node, place, ("p", "q"))
            return self._pose(given, place)
        owner, _, method = (name or "").rpartition(".")
        if owner in MANISKILL_POSE and method == "create_from_pq":
            given = self._given(node, place, ("p", "q", "device"))
            return self._pose({k: v for k, v in given.items() if k != "device"}, place)
        if owner in MANISKILL_POSE and method == "create":
            given = self._given(node, place, ("pose", "device"))
            if "pose" in given:
                return self.value(file, given["pose"], place.reads)
        arguments = [arg for arg in node.args if arg.keyword is None]
        first = arguments[0].value if len(arguments) == 1 else None
        if (name in ARRAY or name in ("list", "tuple")) and first is not None:
            inner = self.value(file, first, place.reads)
            if isinstance(inner, Vector):
                # The list within is what is changed, and the call around it stays.
                own = inner.literal and inner.at.reads == place.reads
                at = inner.at if own else place
                return Vector(inner.items, at, array=name in ARRAY, literal=inner.literal)
        if first is not None and len(node.args) == 1:
            inner = None
            if name in RADIANS or name in DEGREES or name in FUNCTIONS or name == "float":
                inner = self.value(file, first, place.reads)
            if isinstance(inner, Number):
                if name == "float":
                    return inner
                if name in RADIANS:
                    return Number(math.radians(inner.value), place, False, part=(inner, math.pi / 180, 0.0))
                try:
                    function = math.degrees if name in DEGREES else FUNCTIONS[name or ""]
                    return Number(function(inner.value), place, literal=False)
                except ValueError as exc:
                    raise self._computed(place) from exc
        if name in EULER:
            return self._angles(node, place)
        raise self._computed(place)

    def _given(self, node: cst.Call, place: Place, names: tuple[str, ...]) -> dict[str, cst.BaseExpression]:
        """The arguments of a call by the names of its parameters."""
        given: dict[str, cst.BaseExpression] = {}
        for index, arg in enumerate(node.args):
            if arg.keyword is None and index >= len(names):
                raise self._computed(place)
            given[names[index] if arg.keyword is None else arg.keyword.value] = arg.value
        if not set(given) <= set(names):
            raise self._computed(place)
        return given

    def _triple(self, expression: cst.BaseExpression, place: Place, length: int) -> Vector:
        value = self.value(place.file, expression, place.reads)
        if not isinstance(value, Vector) or len(value.items) != length:
            raise self._computed(place)
        if any(isinstance(item, Vector) for item in value.items):
            raise self._computed(place)
        return value

    def _look_at(self, node: cst.Call, place: Place) -> PoseValue:
        given = self._given(node, place, ("eye", "target", "up", "device"))
        if "eye" not in given or "target" not in given:
            raise self._computed(place)
        parts: dict[str, Vector | Angles] = {
            name: self._triple(given[name], place, 3) for name in ("eye", "target", "up") if name in given
        }
        eye, target = _numbers(parts["eye"]), _numbers(parts["target"])
        up = _numbers(parts["up"]) if "up" in parts else (0.0, 0.0, 1.0)
        quaternion = rotations.look_at(eye, target, up)
        return PoseValue("look_at", place, parts, (eye[0], eye[1], eye[2]), quaternion)

    def _pose(self, given: dict[str, cst.BaseExpression], place: Place) -> PoseValue:
        parts: dict[str, Vector | Angles] = {}
        position, quaternion = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
        if "p" in given and not _is_none(given["p"]):
            parts["p"] = vector = self._triple(given["p"], place, 3)
            x, y, z = vector.numbers
            position = (x, y, z)
        form = "pose"
        if "q" in given and not _is_none(given["q"]):
            value = self.value(place.file, given["q"], place.reads)
            if isinstance(value, Angles):
                form = "euler"
                quaternion = rotations.from_euler(*(item.value for item in value.items))
            elif isinstance(value, Vector) and len(value.numbers) == len(value.items) == 4:
                w, x, y, z = value.numbers
                quaternion = (w, x, y, z)
            else:
                raise self._computed(place)
            parts["q"] = value
        return PoseValue(form, place, parts, position, quaternion)

    def _angles(self, node: cst.Call, place: Place) -> Angles:
        given = self._given(node, place, ("ai", "aj", "ak", "axes"))
        axes = given.pop("axes", None)
        if axes is not None and place.file.code(axes).strip("\"'") != "sxyz":
            raise Unknown(f"`{_short(place.file.code(node))}` uses other axes than sxyz")
        items = [
            self.value(place.file, given[name], place.reads) for name in ("ai", "aj", "ak") if name in given
        ]
        if len(items) != 3 or not all(isinstance(item, Number) for item in items):
            raise self._computed(place)
        roll, pitch, yaw = (item for item in items if isinstance(item, Number))
        return Angles(place, (roll, pitch, yaw))


_OPERATIONS: dict[type[cst.BaseBinaryOp], Callable[[float, float], float]] = {
    cst.Add: lambda a, b: a + b,
    cst.Subtract: lambda a, b: a - b,
    cst.Multiply: lambda a, b: a * b,
    cst.Divide: lambda a, b: a / b,
    cst.Power: lambda a, b: a**b,
    cst.FloorDivide: lambda a, b: a // b,
    cst.Modulo: lambda a, b: a % b,
}


def _has_name(number: Number) -> bool:
    return any(isinstance(node, cst.Name) for node in walk(number.at.node)) or bool(number.at.reads)


def _mapped(vector: Vector, place: Place, change: Callable[[float], float]) -> tuple[Number | Vector, ...]:
    return tuple(
        Vector(_mapped(item, place, change), place, True, False)
        if isinstance(item, Vector)
        else Number(change(item.value), place, literal=False)
        for item in vector.items
    )


def _elementwise(
    left: Value, right: Value, place: Place, operation: Callable[[float, float], float]
) -> tuple[Number | Vector, ...] | None:
    """Arithmetic with arrays; None where lists would do something else."""
    if isinstance(left, Vector) and isinstance(right, Number) and left.array:
        return _mapped(left, place, lambda x: operation(x, right.value))
    if isinstance(right, Vector) and isinstance(left, Number) and right.array:
        return _mapped(right, place, lambda x: operation(left.value, x))
    if isinstance(left, Vector) and isinstance(right, Vector) and (left.array or right.array):
        a, b = left.numbers, right.numbers
        if len(a) == len(left.items) == len(b) == len(right.items):
            return tuple(Number(operation(x, y), place, literal=False) for x, y in zip(a, b, strict=True))
    return None


def _numbers(part: Vector | Angles) -> tuple[float, ...]:
    return part.numbers if isinstance(part, Vector) else tuple(item.value for item in part.items)


def _is_none(node: cst.BaseExpression) -> bool:
    return isinstance(node, cst.Name) and node.value == "None"


def _entries(
    project: Project, file: SourceFile, node: cst.BaseExpression
) -> list[tuple[str, cst.BaseExpression]]:
    """The items of ``{"a": 1}`` or ``dict(a=1)`` whose keys are plain strings."""
    found: list[tuple[str, cst.BaseExpression]] = []
    if isinstance(node, cst.Dict):
        for element in node.elements:
            if not isinstance(element, cst.DictElement):
                return []
            if isinstance(element.key, cst.SimpleString) and isinstance(element.key.evaluated_value, str):
                found.append((element.key.evaluated_value, element.value))
    elif isinstance(node, cst.Call) and file.code(node.func) == "dict":
        for arg in node.args:
            if arg.keyword is None:
                return []
            found.append((arg.keyword.value, arg.value))
    return found


def _short(code: str) -> str:
    line = " ".join(code.split())
    return line if len(line) <= 60 else line[:57] + "..."
