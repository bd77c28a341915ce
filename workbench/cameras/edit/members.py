"""Plans edits that add, duplicate, rename or remove a camera, or override a camera of a parent class."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from workbench.cameras.edit.camera_edit import CameraEdit, check_camera, planning
from workbench.cameras.edit.hook_cameras import HOOKS, CameraCall, HookCameras, RunHooks
from workbench.cameras.edit.hook_text import (
    HOOK_OF,
    append_camera,
    at_end_of_class,
    class_named,
    needed_imports,
    new_hook,
    repr_text,
    returned_expression,
    snippet,
)
from workbench.cameras.edit.pose_text import look_at_text
from workbench.envs.camera_data import CallSite, CameraKey, CameraKind, CameraSettings
from workbench.source.parsed import FUNCTIONS, RefusedEdit, Replacement, SourceFile
from workbench.task.write_edits import SourceEdit, check_own


def plan_add(
    sources: Mapping[str, str],
    file: str,
    class_name: str,
    key: CameraKey,
    settings: CameraSettings,
    run: RunHooks,
) -> SourceEdit:
    """Add a fixed camera to the camera hook of `class_name`; adds the hook if the class has none.

    The hook may return one config (which is then put into a list), a list or tuple of configs, or a dict. The
    pose is written as a ``look_at`` if this can express the pose and another camera in the file uses one.

    Raises:
        RefusedEdit: the hook returns anything else (a name that is not assigned a list or dict, a
            concatenation, a call of the parent's hook), or has several returns. The exception has the reason
            and text to copy, as for all plans of this module except `plan_remove`.
    """
    check_camera(settings)
    kind, uid = key
    with planning(sources, run, uid, settings) as edit:
        source = edit.project.own_file(file)
        check_own(file)
        _check_new(edit.hook_cameras, key)
        cls, hook = class_named(source, class_name), HOOK_OF[kind]
        name = _look_at_name(edit, source, kind)
        pose = name and look_at_text(name, settings) or ""
        edit.add_imports(source, needed_imports(settings, pose))

        def text(indent: str) -> str:
            return snippet(uid, settings, indent, pose=pose)

        functions = [node for node in cls.body if isinstance(node, ast.FunctionDef) and node.name == hook]
        if functions:
            edit.change(source, *append_camera(source, returned_expression(source, functions[-1]), uid, text))
        else:
            edit.change(source, new_hook(edit.project, edit.hook_cameras, source, cls, hook, text))
        return edit.verified(source, None, key)


def plan_duplicate(
    sources: Mapping[str, str], key: CameraKey, new_uid: str, settings: CameraSettings, run: RunHooks
) -> SourceEdit:
    """Add a copy of a camera's call next to it, under the name `new_uid`. Raises RefusedEdit, with `settings`
    as text to copy."""
    new_key: CameraKey = (key[0], new_uid)
    with planning(sources, run, new_uid, settings) as edit:
        call = _single_call(edit, key)
        _check_new(edit.hook_cameras, new_key)
        file, outer = call.file, call.file.parents[call.node]
        alone = not (
            (isinstance(outer, ast.Return) and _is_in_hook(call))
            or isinstance(outer, (ast.List, ast.Tuple, ast.Dict))
            or call.key is not None
        )
        if alone:
            raise RefusedEdit(
                f"the camera ({call.where}) is not in a list or dict, to which a second camera could be added"
            )
        text, indent = _renamed_text(call, new_uid), file.indent(file.inner_span(call.node)[0])

        def indented(own: str) -> str:
            # The inner lines keep their indentation relative to the first line.
            first, *rest = text.split("\n")
            return "\n".join([first, *(own + r[len(indent) :] if r.startswith(indent) else r for r in rest)])

        value = call.node if isinstance(outer, ast.Return) else call.container
        edit.change(file, *append_camera(file, value, new_uid, indented))
        return edit.verified(file, None, new_key)


def plan_rename(
    sources: Mapping[str, str], key: CameraKey, new_uid: str, settings: CameraSettings, run: RunHooks
) -> SourceEdit:
    """Rename a camera. Notes of the edit warn that the observations get the new name, and count the places of
    the file that still have the old name. Raises RefusedEdit, with `settings` as text to copy."""
    new_key: CameraKey = (key[0], new_uid)
    with planning(sources, run, new_uid, settings) as edit:
        call = _single_call(edit, key)
        _check_new(edit.hook_cameras, new_key)
        edit.change(call.file, *_renaming(call, new_uid))
        edit.note(
            f"observations name this camera {new_uid!r} from now on, which a trained policy may not expect"
        )
        planned = edit.verified(call.file, key, new_key)
        elsewhere = len(re.findall(rf"[\"']{re.escape(key[1])}[\"']", planned.new_text))
        if elsewhere:
            edit.note(f"{key[1]!r} still occurs in {elsewhere} other place(s) of {planned.name}")
        return replace(planned, notes=tuple(edit.notes))


def plan_remove(sources: Mapping[str, str], key: CameraKey, run: RunHooks) -> SourceEdit:
    """Remove a camera from the result of its hook. Raises RefusedEdit."""
    with planning(sources, run) as edit:
        call = _single_call(edit, key)
        edit.change(call.file, _removal(call))
        pose = call.arguments.get("pose")
        if isinstance(pose, ast.Name):
            edit.note(f"`{pose.id}` is kept; it may be unused now")
        return edit.verified(call.file, key, None)


def override_text(
    kind: CameraKind,
    uid: str,
    settings: CameraSettings,
    parse: str,
    more: Sequence[str] = (),
    indent: str = "    ",
) -> str:
    """Text of a hook that returns the parent's cameras with one of them replaced.

    Args:
        parse: name of ManiSkill's function that turns a hook's result into a dict
            (`TaskDescription.parse_cameras`).
        more: further arguments of the camera, such as its mount.
    """
    hook, inner = HOOK_OF[kind], indent + "    "
    lines = (
        f"{indent}@property",
        f"{indent}def {hook}(self):",
        f"{inner}cameras = {parse}(super().{hook})",
        f"{inner}cameras[{repr_text(uid)}] = {snippet(uid, settings, inner, more)}",
        f"{inner}return cameras",
    )
    return "\n".join(lines) + "\n"


def plan_override(
    sources: Mapping[str, str],
    file: str,
    class_name: str,
    kind: CameraKind,
    uid: str,
    settings: CameraSettings,
    site: CallSite,
    run: RunHooks,
    parse: str,
    more: Sequence[str] = (),
) -> SourceEdit:
    """Add the hook of `override_text` to `class_name`; `site` is where the parent makes the camera. Raises RefusedEdit."""
    check_camera(settings)
    hook, parent = HOOK_OF[kind], site.function.rpartition(".")[0]
    with planning(sources, run, uid, settings, more) as edit:
        source = edit.project.own_file(file)
        check_own(file)
        cls = class_named(source, class_name)
        own = hook in edit.project.bindings(source, cls)
        owner, where = (class_name, file) if own else edit.hook_cameras.owners.get(hook, ("", ""))
        if where in sources:
            raise RefusedEdit(
                f"{uid} is made by {parent}, and the {hook} of {owner} ({edit.project.file(where).name}) "
                "returns it: replace it there by the text below"
            )
        edit.note(
            f"{uid} is made by {parent}, from which {class_name} inherits: {class_name} gets its own {hook}, "
            f"which returns the cameras of {parent} with {uid} replaced"
        )
        edit.add_imports(
            source, needed_imports(settings) | {parse: f"from mani_skill.sensors.camera import {parse}"}
        )
        text = at_end_of_class(
            source, cls, hook, lambda indent: override_text(kind, uid, settings, parse, more, indent)
        )
        edit.change(source, text)
        return edit.verified(source, (kind, uid), (kind, uid))


# --- finding cameras -----------------------------------------------------------------------------


def _single_call(edit: CameraEdit, key: CameraKey) -> CameraCall:
    call = edit.call(key)
    check_own(call.file.path)
    if call.loop is not None:
        raise RefusedEdit(f"{key[1]!r} is made in a loop or comprehension ({call.where})")
    return call


def _check_new(hook_cameras: HookCameras, key: CameraKey) -> None:
    if not key[1].isidentifier():
        raise RefusedEdit(f"{key[1]!r} is not a name; use letters, digits and _")
    if key in hook_cameras.cameras:
        raise RefusedEdit(f"there is a camera {key[1]!r} already")


def _is_in_hook(call: CameraCall) -> bool:
    """Whether the call is directly in a camera hook."""
    function = call.file.scopes(call.node)[0]
    return isinstance(function, FUNCTIONS) and not isinstance(function, ast.Lambda) and function.name in HOOKS


def _look_at_name(edit: CameraEdit, file: SourceFile, kind: CameraKind) -> str:
    """The name under which this file calls look_at for a camera, preferably one of this kind; empty if no
    camera in the file uses look_at."""
    for key in sorted(edit.hook_cameras.cameras, key=lambda key: key[0] != kind):
        trace = edit.hook_cameras.cameras[key].trace
        pose = None if trace is None else trace.parts.get("pose")
        if pose is not None and pose.function == "look_at" and pose.at.file == file.path:
            _, node = edit.find(pose.at)
            name = file.code(node.func) if isinstance(node, ast.Call) else ""
            if name.partition(".")[0] in edit.project.bindings(file, file.module):
                return name
    return ""


# --- renaming ------------------------------------------------------------------------------------


def _renaming(call: CameraCall, new_uid: str) -> list[Replacement]:
    """Edits that rename the camera, only at its call: elsewhere, an equal string may name something else."""
    file, key, uid = call.file, call.key, call.arguments.get("uid")
    found: list[Replacement] = []
    if isinstance(key, ast.keyword):
        start = file.inner_span(key)[0]
        found.append(Replacement(start, start + len(key.arg or ""), new_uid))
    elif key is not None:
        found.append(Replacement(*file.span(key), repr_text(new_uid)))
    if key is not None and not (isinstance(uid, ast.Constant) and uid.value == call.camera[1]):
        return found
    if uid is None:
        raise RefusedEdit(f"the name is not written in the call ({call.where})")
    single = isinstance(uid, ast.Constant) and file.text[file.inner_span(uid)[0]] == "'"
    return [*found, Replacement(*file.span(uid), f"'{new_uid}'" if single else repr_text(new_uid))]


def _renamed_text(call: CameraCall, new_uid: str) -> str:
    file = call.file
    start, end = file.span(call.node)
    text = file.text[start:end]
    uid = call.arguments.get("uid")
    if uid is not None:
        a, b = file.span(uid)
        text = text[: a - start] + repr_text(new_uid) + text[b - start :]
    return text


# --- removing ------------------------------------------------------------------------------------


def _removal(call: CameraCall) -> Replacement:
    file, outer, container = call.file, call.file.parents[call.node], call.container
    if isinstance(outer, ast.Return) and _is_in_hook(call):
        return Replacement(*file.span(call.node), "[]")
    if not (isinstance(outer, (ast.List, ast.Tuple, ast.Dict)) or call.key is not None):
        raise RefusedEdit(
            f"the camera is made at {call.where} and used elsewhere under a name; remove it by hand"
        )
    items = file.items(container)
    if isinstance(container, ast.Tuple) and len(items) <= 2:
        raise RefusedEdit(
            "the tuple would have one item or none, which is easily misread; remove the camera by hand"
        )
    place = file.inner_span(call.node)[0]
    return file.without_item(container, next(i for i, item in enumerate(items) if item[0] <= place < item[1]))
