"""Finds where the first pose of a body is written in the author's files, and plans the edit that changes it.

Only the text is read. Whether the edit does what was asked is decided by running it (`start_jobs`).
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from workbench.cameras.edit.pose_text import write_pq
from workbench.source.definitions import Project
from workbench.source.parsed import (
    FUNCTIONS,
    Place,
    Plain,
    RefusedEdit,
    SourceFile,
    TracedValue,
    arguments,
    is_starred,
)
from workbench.source.traced_edits import Changes, list_text, quaternion_texts
from workbench.task.write_edits import FileChange, SourceEdit, check_own

Floats = Sequence[float]
_POSE_CALLS = ("Pose", "create_from_pq")
_CONVERT = ("tensor", "as_tensor", "array", "asarray")
_REPEAT = ("repeat", "expand", "tile", "to", "float")
_RESET_HOOK = "_initialize_episode"


@dataclass(frozen=True, eq=False)
class PoseCall:
    """The call that makes the first pose of a body: ``sapien.Pose(p=[0, 0, 0.1])``."""

    file: SourceFile
    node: ast.Call

    @property
    def where(self) -> str:
        return f"{self.file.name}, line {self.file.line(self.node)}"


def plan_pose(
    texts: Mapping[str, str], task_file: str, class_name: str, body: str, before: Floats, after: Floats
) -> SourceEdit:
    """Plan the edit that changes the first pose of a body. Nothing is written.

    Args:
        texts: the author's files by path.
        task_file, class_name: file and name of the task's class.
        before: (7,) where resets put the body now: position in metres and quaternion wxyz, in the env's frame.
        after: (7,) where they shall put it.

    Raises:
        RefusedEdit: the text does not determine which numbers to change. The error has lines to copy.
    """
    attribute = ""
    try:
        project = Project(texts)
        classes = _own_classes(project, project.own_file(task_file), class_name)
        built = _build_call(classes, body)
        attribute = _attribute_of(built)
        pose = _pose_call(classes, built, attribute, body)
        check_own(pose.file.path)
        changes = Changes(project)
        value = _traced(project, pose, before)
        write_pq(changes, value, after[:3], after[3:])
        changes.emit(value)
        if not changes.replacements:
            raise RefusedEdit(
                "the body was moved by less than the precision of the written numbers (0.1 mm, 0.01 degree)"
            )
        new_text = pose.file.replaced([change for _, change in changes.replacements])
    except RefusedEdit as refused:
        raise RefusedEdit(refused.reason, lines_to_copy(attribute, after)) from None
    change = FileChange(pose.file.path, pose.file.text, new_text)
    return SourceEdit(**vars(change), notes=tuple(changes.notes), settings=None)


def lines_to_copy(attribute: str, pose: Floats) -> str:
    """Lines that give a body this pose, for the author to copy."""
    made = f"sapien.Pose(p={list_text(pose[:3], 4)}, q=[{', '.join(quaternion_texts(pose[3:]))}])"
    if not attribute:
        return made
    return f"# in {_RESET_HOOK}\n{attribute}.set_pose({made})"


def _own_classes(
    project: Project, file: SourceFile, class_name: str
) -> list[tuple[SourceFile, ast.ClassDef]]:
    """The task's class and its base classes in the author's files."""
    found: list[tuple[SourceFile, ast.ClassDef]] = []
    waiting = [class_name]
    while waiting:
        name = waiting.pop()
        for where in dict.fromkeys((file, *project.files_with_word(name))):
            for node in where.nodes:
                if isinstance(node, ast.ClassDef) and node.name == name and (where, node) not in found:
                    found.append((where, node))
                    waiting += [where.code(base).rpartition(".")[2] for base in node.bases]
    return found


def _calls(
    classes: Sequence[tuple[SourceFile, ast.ClassDef]],
) -> Iterator[tuple[SourceFile, ast.Call]]:
    for file, cls in classes:
        for node in ast.walk(cls):
            if isinstance(node, ast.Call):
                yield file, node


def _build_call(classes: Sequence[tuple[SourceFile, ast.ClassDef]], body: str) -> PoseCall:
    """The call that builds the body."""
    found = [PoseCall(file, call) for file, call in _calls(classes) if _builds(file, call, body)]
    if len(found) == 1:
        return found[0]
    if not found:
        raise RefusedEdit(f'no call in your task builds a body with name="{body}"')
    raise RefusedEdit(f"{' and '.join(call.where for call in found)} both build {body}")


def _builds(file: SourceFile, call: ast.Call, body: str) -> bool:
    if not file.code(call.func).rpartition(".")[2].startswith("build"):
        return False
    named = [keyword.value for keyword in call.keywords if keyword.arg == "name"] or call.args[:1]
    return any(isinstance(value, ast.Constant) and value.value == body for value in named)


def _attribute_of(built: PoseCall) -> str:
    """The attribute that the body is assigned to: ``self.cube``; empty if there is none."""
    statement = built.file.parents[built.node]
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    if isinstance(statement, ast.AnnAssign):
        targets = [statement.target]
    attributes = [target for target in targets if isinstance(target, ast.Attribute)]
    return built.file.code(attributes[0]) if len(attributes) == 1 else ""


def _pose_call(
    classes: Sequence[tuple[SourceFile, ast.ClassDef]], built: PoseCall, attribute: str, body: str
) -> PoseCall:
    """The call that makes the pose: the one set after the body is built, else the builder's
    ``initial_pose``."""
    at_reset = [*_poses_set(classes, attribute)] if attribute else []
    if len(at_reset) > 1:
        lines = " and ".join(str(file.line(node)) for file, node in at_reset)
        raise RefusedEdit(f"the pose of {body} is set in several places (lines {lines})")
    file, value = at_reset[0] if at_reset else _built_at(built, body)
    if isinstance(value, ast.Call) and not is_starred(value):
        if file.code(value.func).rpartition(".")[2] in _POSE_CALLS:
            return PoseCall(file, value)
    raise RefusedEdit(
        f"the pose of {body} is not written with numbers: `{file.one_line(value)}` (line {file.line(value)})"
    )


def _poses_set(
    classes: Sequence[tuple[SourceFile, ast.ClassDef]], attribute: str
) -> Iterator[tuple[SourceFile, ast.expr]]:
    """The values that ``attribute.set_pose(...)`` and ``attribute.pose = ...`` set."""
    for file, cls in classes:
        for node in ast.walk(cls):
            if isinstance(node, ast.Call) and file.code(node.func) == f"{attribute}.set_pose":
                yield file, (node.args or [keyword.value for keyword in node.keywords] or [node])[0]
            elif isinstance(node, ast.Assign) and any(
                isinstance(target, ast.Attribute) and file.code(target) == f"{attribute}.pose"
                for target in node.targets
            ):
                yield file, node.value


def _built_at(built: PoseCall, body: str) -> tuple[SourceFile, ast.expr]:
    """The value of ``initial_pose``, an argument of the call that builds the body or an attribute of its builder."""
    file, call = built.file, built.node
    given = [keyword.value for keyword in call.keywords if keyword.arg == "initial_pose"]
    if given:
        return file, given[0]
    builder = call.func.value if isinstance(call.func, ast.Attribute) else None
    scope = file.scopes(call)[0]
    if not isinstance(builder, ast.Name) or not isinstance(scope, FUNCTIONS):
        raise RefusedEdit(f"the call that builds {body} ({built.where}) has no initial_pose")
    here = file.inner_span(call)[0]
    made = [
        file.inner_span(node)[0]
        for node in ast.walk(scope)
        if isinstance(node, ast.Name) and node.id == builder.id and isinstance(node.ctx, ast.Store)
    ]
    begins = max((at for at in made if at < here), default=0)
    values = [
        node.value
        for node in ast.walk(scope)
        if isinstance(node, ast.Assign)
        and begins <= file.inner_span(node)[0] < here
        and any(file.code(target) == f"{builder.id}.initial_pose" for target in node.targets)
    ]
    if len(values) != 1:
        raise RefusedEdit(
            f"the builder of {body} ({built.where}) gets its initial_pose in {len(values)} places; one is needed"
        )
    return file, values[0]


def _traced(project: Project, pose: PoseCall, before: Floats) -> TracedValue:
    """The pose call as a value whose numbers can be edited.

    The value of the pose is `before`. Raises RefusedEdit if a written number differs from it.
    """
    file, node = pose.file, pose.node
    given = arguments(node, ("p", "q"))
    if set(given) - {"p", "q", "device"}:
        raise RefusedEdit(f"`{file.one_line(node)}` is not a pose that can be read ({pose.where})")
    parts = {
        name: _vector(pose, _written(project, pose.file, given[name]), numbers)
        for name, numbers in (("p", before[:3]), ("q", before[3:]))
        if name in given
    }
    return TracedValue(_place(file, node), (), tuple(map(float, before)), "pose", parts)


def _written(project: Project, file: SourceFile, node: ast.expr) -> ast.expr:
    """The list in ``torch.tensor([0, 0, 0.1]).repeat(b, 1)``, or in the value of a name; other expressions
    are returned unchanged."""
    while True:
        inner: ast.expr | None = None
        if isinstance(node, ast.Name):
            bindings = project.bindings_of(file, node)
            inner = bindings[0].value if len(bindings) == 1 and bindings[0].file is file else None
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            if node.func.attr in _CONVERT and node.args:
                inner = node.args[0]
            elif node.func.attr in _REPEAT:
                inner = node.func.value
        if inner is None:
            return node
        node = inner


def _vector(pose: PoseCall, node: ast.expr, numbers: Floats) -> TracedValue:
    file = pose.file
    if not isinstance(node, ast.List | ast.Tuple) or len(node.elts) != len(numbers):
        raise RefusedEdit(
            f"the pose is not written with numbers: `{file.one_line(node)}` is computed ({pose.where})"
        )
    items: dict[str, TracedValue] = {}
    for index, (item, number) in enumerate(zip(node.elts, numbers, strict=True)):
        written = _number(item)
        if written is not None and abs(written - number) > 1e-4:
            raise RefusedEdit(
                f"`{file.one_line(pose.node)}` ({pose.where}) is not where resets put the body: something else moves it"
            )
        items[str(index)] = TracedValue(_place(file, item), (), float(number), literal=written is not None)
    value: Plain = tuple(map(float, numbers))
    return TracedValue(_place(file, node), (), value, parts=items, literal=True)


def _number(node: ast.expr) -> float | None:
    """The value of a plain number, perhaps with a sign; None for other expressions."""
    sign = 1.0
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        sign, node = (-1.0 if isinstance(node.op, ast.USub) else 1.0), node.operand
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return sign * float(node.value)  # type: ignore[arg-type]
    return None


def _place(file: SourceFile, node: ast.AST) -> Place:
    return Place(file.path, *file.inner_span(node))
