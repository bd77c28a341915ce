"""Cameras added to a task, duplicated, renamed and removed; and one that a parent class makes, put elsewhere by a hook of
one's own that takes the parent's cameras and puts another in its place.

A hook returns one config, a list or tuple of them, or a dict. One becomes a list when a second is added. Where
a hook does anything else (a name, a concatenation, several returns, a call of the parent's hook), the reason is told
and the text to copy is given.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from workbench.authoring.camera_source.cameras import HOOKS, CameraCall, Ran, Run
from workbench.authoring.camera_source.disk import SourceEdit, check_own
from workbench.authoring.camera_source.edit import CameraEdit, check_camera, planning
from workbench.authoring.camera_source.hooks import (
    HOOK_OF,
    appended,
    at_end_of_class,
    class_named,
    imports_of,
    new_hook,
    repr_text,
    returned,
    snippet,
)
from workbench.authoring.camera_source.write_pose import look_at_text
from workbench.authoring.source.text import FUNCTIONS, RefusedEdit, Replacement, SourceFile
from workbench.core.camera_data import CallSite, CameraKey, CameraKind, CameraSettings


def plan_add(
    sources: Mapping[str, str],
    file: str,
    class_name: str,
    key: CameraKey,
    settings: CameraSettings,
    run: Run,
) -> SourceEdit:
    """A new camera that stands still, in the hook of `class_name`, which is made if the class has none.

    Its pose is written as its siblings' is, where that can say it. It and the others raise Refused.
    """
    check_camera(settings)
    kind, uid = key
    with planning(sources, run, uid, settings) as edit:
        source = edit.project.given(file)
        check_own(file)
        _check_new(edit.ran, key)
        cls, hook = class_named(source, class_name), HOOK_OF[kind]
        name = _siblings_look_at(edit, source, kind)
        pose = name and look_at_text(name, settings) or ""
        edit.importing(source, imports_of(settings, pose))

        def text(indent: str) -> str:
            return snippet(uid, settings, indent, pose=pose)

        functions = [node for node in cls.body if isinstance(node, ast.FunctionDef) and node.name == hook]
        if functions:
            edit.change(source, *appended(source, returned(source, functions[-1]), uid, text))
        else:
            edit.change(source, new_hook(edit.project, edit.ran, source, cls, hook, text))
        return edit.proven(source, None, key)


def plan_duplicate(
    sources: Mapping[str, str], key: CameraKey, new_uid: str, settings: CameraSettings, run: Run
) -> SourceEdit:
    """A copy of a camera, which has `settings`, beside it: on the same mount, written alike."""
    new_key: CameraKey = (key[0], new_uid)
    with planning(sources, run, new_uid, settings) as edit:
        call = _one(edit, key)
        _check_new(edit.ran, new_key)
        file, outer = call.file, call.file.parents[call.node]
        alone = not (
            (isinstance(outer, ast.Return) and _is_hooks_own(call))
            or isinstance(outer, (ast.List, ast.Tuple, ast.Dict))
            or call.key is not None
        )
        if alone:
            raise RefusedEdit(
                f"the camera ({call.where}) stands alone, and where a second one belongs cannot be told"
            )
        text, indent = _renamed_text(call, new_uid), file.indent(file.inner_span(call.node)[0])

        def indented(own: str) -> str:
            # The copy's inner lines keep their distance from its first one.
            first, *rest = text.split("\n")
            return "\n".join([first, *(own + r[len(indent) :] if r.startswith(indent) else r for r in rest)])

        value = call.node if isinstance(outer, ast.Return) else call.container
        edit.change(file, *appended(file, value, new_uid, indented))
        return edit.proven(file, None, new_key)


def plan_rename(
    sources: Mapping[str, str], key: CameraKey, new_uid: str, settings: CameraSettings, run: Run
) -> SourceEdit:
    """The same camera under another name. Observations and `sensor_configs` know it by its name: that is said."""
    new_key: CameraKey = (key[0], new_uid)
    with planning(sources, run, new_uid, settings) as edit:
        call = _one(edit, key)
        _check_new(edit.ran, new_key)
        edit.change(call.file, *_renaming(call, new_uid))
        edit.note(
            f"observations name this camera {new_uid!r} from now on, which a trained policy may not expect"
        )
        planned = edit.proven(call.file, key, new_key)
        elsewhere = len(re.findall(rf"[\"']{re.escape(key[1])}[\"']", planned.new_text))
        if elsewhere:
            edit.note(f"{key[1]!r} still stands in {elsewhere} other place(s) of {planned.name}")
        return replace(planned, notes=tuple(edit.notes))


def plan_remove(sources: Mapping[str, str], key: CameraKey, run: Run) -> SourceEdit:
    """The camera taken out of what its hook returns."""
    with planning(sources, run) as edit:
        call = _one(edit, key)
        edit.change(call.file, _removal(call))
        pose = call.arguments.get("pose")
        if isinstance(pose, ast.Name):
            edit.note(f"`{pose.id}` is left where it is; nothing may need it any more")
        return edit.proven(call.file, key, None)


_PARSE = {"parse_camera_configs": "from mani_skill.sensors.camera import parse_camera_configs"}


def override_text(
    kind: CameraKind, uid: str, settings: CameraSettings, more: Sequence[str] = (), indent: str = "    "
) -> str:
    """The whole hook, to be copied into a class; `more` are arguments of the camera, such as its mount."""
    hook, inner = HOOK_OF[kind], indent + "    "
    lines = (
        f"{indent}@property",
        f"{indent}def {hook}(self):",
        f"{inner}cameras = parse_camera_configs(super().{hook})",
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
    run: Run,
    more: Sequence[str] = (),
) -> SourceEdit:
    """The edit that gives `class_name` such a hook; `site` is where the parent makes the camera."""
    check_camera(settings)
    hook, parent = HOOK_OF[kind], site.function.rpartition(".")[0]
    with planning(sources, run, uid, settings, more) as edit:
        source = edit.project.given(file)
        check_own(file)
        cls = class_named(source, class_name)
        own = hook in edit.project.bindings(source, cls)
        owner, where = (class_name, file) if own else edit.ran.owners.get(hook, ("", ""))
        if where in sources:
            raise RefusedEdit(
                f"{uid} is made by {parent}, and the {hook} of {owner} ({edit.project.file(where).name}) hands it on: put "
                "the text below in its place there"
            )
        edit.note(
            f"{uid} is made by {parent}, from which {class_name} inherits: {class_name} gets a {hook} of its own, with all "
            f"cameras of {parent} and this one in place of its {uid}"
        )
        edit.importing(source, imports_of(settings) | _PARSE)
        text = at_end_of_class(
            source, cls, hook, lambda indent: override_text(kind, uid, settings, more, indent)
        )
        edit.change(source, text)
        return edit.proven(source, (kind, uid), (kind, uid))


# --- which ---------------------------------------------------------------------------------------


def _one(edit: CameraEdit, key: CameraKey) -> CameraCall:
    call = edit.call(key)
    check_own(call.file.path)
    if call.loop is not None:
        raise RefusedEdit(f"{key[1]!r} is made in a loop or comprehension ({call.where})")
    return call


def _check_new(ran: Ran, key: CameraKey) -> None:
    if not key[1].isidentifier():
        raise RefusedEdit(f"{key[1]!r} is not a name; use letters, digits and _")
    if key in ran.cameras:
        raise RefusedEdit(f"there is a camera {key[1]!r} already")


def _is_hooks_own(call: CameraCall) -> bool:
    """True if what the call's function returns is what the hook returns."""
    function = call.file.scopes(call.node)[0]
    return isinstance(function, FUNCTIONS) and not isinstance(function, ast.Lambda) and function.name in HOOKS


def _siblings_look_at(edit: CameraEdit, file: SourceFile, kind: CameraKind) -> str:
    """How a camera of this file calls look_at, one of that kind before others; empty if none does."""
    for key in sorted(edit.ran.cameras, key=lambda key: key[0] != kind):
        trace = edit.ran.cameras[key].trace
        pose = None if trace is None else trace.parts.get("pose")
        if pose is not None and pose.function == "look_at" and pose.at.file == file.path:
            _, node = edit.find(pose.at)
            name = file.code(node.func) if isinstance(node, ast.Call) else ""
            if name.partition(".")[0] in edit.project.bindings(file, file.module):
                return name
    return ""


# --- renaming ------------------------------------------------------------------------------------


def _renaming(call: CameraCall, new_uid: str) -> list[Replacement]:
    """The name at its call alone: a constant that holds it may name other things too."""
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
    if isinstance(outer, ast.Return) and _is_hooks_own(call):
        return Replacement(*file.span(call.node), "[]")
    if not (isinstance(outer, (ast.List, ast.Tuple, ast.Dict)) or call.key is not None):
        raise RefusedEdit(
            f"the camera is made at {call.where} and used elsewhere under a name; take it out by hand"
        )
    items = file.items(container)
    if isinstance(container, ast.Tuple) and len(items) <= 2:
        raise RefusedEdit("a tuple of one or none is easily misread; take the camera out by hand")
    place = file.inner_span(call.node)[0]
    return file.without_item(container, next(i for i, item in enumerate(items) if item[0] <= place < item[1]))
