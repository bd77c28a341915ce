"""Writes a camera as Python text, and adds this text to an existing or a new camera hook."""

from __future__ import annotations

import ast
import json
from collections.abc import Callable, Sequence

from workbench.cameras.edit.hook_cameras import HOOKS, HookCameras
from workbench.envs.camera_data import CameraKind, CameraSettings
from workbench.source.definitions import Project
from workbench.source.parsed import Function, RefusedEdit, Replacement, SourceFile, walk
from workbench.source.traced_edits import list_text, matrix_text, number_text, quaternion_texts

HOOK_OF: dict[CameraKind, str] = {kind: hook for hook, kind in HOOKS.items() if hook.startswith("_default")}


def needed_imports(settings: CameraSettings, pose: str = "") -> dict[str, str]:
    """Imports that a `snippet` needs, by the name that each import binds."""
    lines = {"CameraConfig": "from mani_skill.sensors.camera import CameraConfig"}
    if not pose:
        lines["sapien"] = "import sapien"
    if settings.intrinsic is not None:
        lines["np"] = "import numpy as np"
    return lines


def returned_expression(file: SourceFile, function: Function) -> ast.expr:
    """The expression that a hook returns; if it returns a name, the list or dict that is assigned to the
    name. Raises RefusedEdit unless the hook has exactly one return with a value."""
    found = [
        node for node in walk(function) if isinstance(node, ast.Return) and file.scopes(node)[0] is function
    ]
    if len(found) != 1 or found[0].value is None:
        raise RefusedEdit(
            f"{function.name} (line {file.line(function)}) has {len(found)} returns; exactly one is needed"
        )
    value = found[0].value
    if isinstance(value, ast.Name):
        assigned = [
            node
            for node in walk(function)
            if isinstance(node, ast.Assign)
            and any(isinstance(t, ast.Name) and t.id == value.id for t in node.targets)
        ]
        if len(assigned) == 1 and isinstance(assigned[0].value, (ast.List, ast.Dict)):
            return assigned[0].value
    return value


def append_camera(
    file: SourceFile, value: ast.AST, uid: str, text: Callable[[str], str]
) -> list[Replacement]:
    """Add the camera `text(indent)` to `value`, the expression that a hook returns. Raises RefusedEdit if
    `value` is neither a config nor a list, tuple or dict."""
    start, end = file.inner_span(value)
    indent = file.indent(start)
    called = file.code(value.func) if isinstance(value, ast.Call) else ""
    if isinstance(value, ast.Tuple) and (file.text[start] != "(" or file.items(value)[0][0] == start):
        # A tuple without parentheses.
        own = indent + "    "
        held = [file.code(element).replace("\n", "\n    ") for element in value.elts]
        lines = "".join(f"{own}{line},\n" for line in (*held, text(own)))
        return [Replacement(start, end, f"[\n{lines}{indent}]")]
    if isinstance(value, (ast.List, ast.Tuple)):
        return file.added_item(value, indent, text)
    if isinstance(value, ast.Dict):
        return file.added_item(value, indent, lambda i: f"{repr_text(uid)}: {text(i)}")
    if called == "dict":
        return file.added_item(value, indent, lambda i: f"{uid}={text(i)}")
    if called.rpartition(".")[2].endswith("CameraConfig"):
        start, end = file.span(value)
        inner = file.text[start:end].replace("\n", "\n    ")
        new = f"[\n{indent}    {inner},\n{indent}    {text(indent + '    ')},\n{indent}]"
        return [Replacement(start, end, new)]
    raise RefusedEdit(
        f"the value returned at line {file.line(value)} is neither a CameraConfig(...) nor a list or dict "
        "of them"
    )


def new_hook(
    project: Project,
    hook_cameras: HookCameras,
    file: SourceFile,
    cls: ast.ClassDef,
    hook: str,
    text: Callable[[str], str],
) -> Replacement:
    """Add `hook` to the class; the hook returns the camera `text(indent)`. Raises RefusedEdit if the class
    inherits this hook."""
    owner, where = hook_cameras.owners.get(hook, ("", ""))
    if where in project.texts:
        raise RefusedEdit(
            f"{cls.name} inherits {hook} from {owner} ({project.file(where).name}); add the camera there"
        )
    if owner:
        raise RefusedEdit(
            f"{cls.name} inherits the cameras of {owner}, which a {hook} of its own would remove"
        )

    def whole(indent: str) -> str:
        inner = indent + "    "
        return (
            f"{indent}@property\n{indent}def {hook}(self):\n{inner}return [\n"
            f"{inner}    {text(inner + '    ')},\n{inner}]\n"
        )

    return at_end_of_class(file, cls, hook, whole)


def class_named(file: SourceFile, name: str) -> ast.ClassDef:
    """The class `name` at the top level of the file. Raises RefusedEdit."""
    for node in file.module.body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return node
    raise RefusedEdit(f"there is no class {name} in {file.name}")


def at_end_of_class(
    file: SourceFile, cls: ast.ClassDef, hook: str, text: Callable[[str], str]
) -> Replacement:
    """Add `text(indent)`, the whole hook, at the end of the class. Raises RefusedEdit if the class is written
    in one line."""
    first = file.inner_span(cls.body[0])[0]
    if file.line_at(first) == file.line(cls):
        raise RefusedEdit(f"the class {cls.name} is written in one line, so {hook} cannot be added to it")
    indent = file.indent(first)
    at = file.line_start(file.line_at(file.inner_span(cls.body[-1])[1]) + 1)
    lead = "\n" if file.text[:at].endswith(("\n", "\r")) else "\n\n"
    return Replacement(at, at, f"{lead}{text(indent)}")


def snippet(
    uid: str, settings: CameraSettings, indent: str = "", more: Sequence[str] = (), pose: str = ""
) -> str:
    """``CameraConfig(...)`` with one argument per line and the further arguments `more`.

    The text needs ``import sapien`` unless `pose` is given, and ``import numpy as np`` for an intrinsic.
    """
    quaternion = ", ".join(quaternion_texts(settings.quaternion))
    pose = pose or f"sapien.Pose(p={list_text(settings.position, 4)}, q=[{quaternion}])"
    lines = [
        repr_text(uid),
        f"pose={pose}",
        f"width={settings.width}",
        f"height={settings.height}",
    ]
    if settings.intrinsic is not None:
        lines.append(f"intrinsic=np.array({matrix_text(settings.intrinsic)})")
    elif settings.fov is not None:
        lines.append(f"fov={number_text(settings.fov, 4)}")
    lines += [f"near={number_text(settings.near, 4)}", f"far={number_text(settings.far, 4)}"]
    if settings.shader_pack != "minimal":
        lines.append(f"shader_pack={repr_text(settings.shader_pack)}")
    lines += more
    inside = "".join(f"{indent}    {line},\n" for line in lines)
    return f"CameraConfig(\n{inside}{indent})"


def repr_text(text: str) -> str:
    """`text` as a Python string in double quotes; JSON's escapes are all valid in Python."""
    return json.dumps(text, ensure_ascii=False)
