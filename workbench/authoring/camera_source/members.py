"""Cameras added to a task, duplicated, renamed and removed.

A hook returns one config, a list or tuple of them, or a dict. One becomes a list when a second is added. Where
a hook does anything else (a name, a concatenation, several returns, a call of the parent's hook), the reason is told
and the text to copy is given.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import libcst as cst

from workbench.authoring.camera_source.definitions import Project
from workbench.authoring.camera_source.find import (
    HOOKS,
    CameraCall,
    camera_calls,
    candidates,
    check_own,
)
from workbench.authoring.camera_source.hooks import (
    HOOK_OF,
    appended,
    class_named,
    needed_imports,
    new_hook,
    returned,
)
from workbench.authoring.camera_source.read_camera import FIELDS, ReadCamera, mismatch, readings
from workbench.authoring.camera_source.result import Refusal, Refused, SourceEdit
from workbench.authoring.camera_source.snippet import repr_text, snippet
from workbench.authoring.camera_source.source_file import Replacement, SourceFile
from workbench.authoring.camera_source.values import PoseValue
from workbench.authoring.camera_source.wanted import check_wanted
from workbench.authoring.camera_source.write_pose import look_at_text
from workbench.core.camera_settings import CallSite, CameraSettings
from workbench.core.pictures import CameraKind


def plan_add(
    sources: Mapping[str, str],
    file: str,
    class_name: str,
    kind: CameraKind,
    uid: str,
    settings: CameraSettings,
    target: tuple[float, float, float] | None = None,
) -> SourceEdit | Refusal:
    """A new camera that stands still, in the hook of `class_name`, which is made if the class has none.

    Its pose is written as its siblings' is, where that can say it; `target` is the point that it looks at then.
    """
    try:
        check_wanted(settings)
    except Refused as refused:
        return Refusal(refused.reason)
    try:
        project = Project(sources)
        _check_uid(project, uid, kind, file, class_name)
        return _add(project, file, class_name, kind, uid, settings, target)
    except Refused as refused:
        return Refusal(refused.reason, snippet(uid, settings))


def plan_duplicate(
    sources: Mapping[str, str],
    uid: str,
    new_uid: str,
    settings: CameraSettings,
    site: CallSite | None = None,
    kind: CameraKind | None = None,
) -> SourceEdit | Refusal:
    """A copy of the camera `uid`, which has `settings`, beside it: on the same mount, written alike."""
    try:
        project = Project(sources)
        call = _one(project, uid, kind, site)
        _check_new_uid(project, new_uid, call)
        text = _renamed_text(project, call, new_uid)
        return _insert_beside(project, call, text, new_uid, settings)
    except Refused as refused:
        return Refusal(refused.reason, snippet(new_uid, settings))


def plan_rename(
    sources: Mapping[str, str],
    uid: str,
    new_uid: str,
    settings: CameraSettings,
    site: CallSite | None = None,
    kind: CameraKind | None = None,
) -> SourceEdit | Refusal:
    """The same camera under another name. Observations and `sensor_configs` know it by its name: that is said."""
    try:
        project = Project(sources)
        call = _one(project, uid, kind, site)
        _check_new_uid(project, new_uid, call)
        replacements = _renaming(project, call, new_uid)
        new_text = call.file.replaced(replacements)
        notes = [
            f"observations name this camera {new_uid!r} from now on, which a trained policy may not expect"
        ]
        elsewhere = len(re.findall(rf"[\"']{re.escape(uid)}[\"']", new_text))
        if elsewhere:
            notes.append(f"{uid!r} still stands in {elsewhere} other place(s) of {call.file.name}")
        checked(project, call.file, call, new_text, new_uid)
        return SourceEdit(call.file.path, call.file.text, new_text, tuple(notes), settings)
    except Refused as refused:
        return Refusal(refused.reason, snippet(new_uid, settings))


def plan_remove(
    sources: Mapping[str, str],
    uid: str,
    site: CallSite | None = None,
    kind: CameraKind | None = None,
) -> SourceEdit | Refusal:
    """The camera taken out of what its hook returns."""
    try:
        project = Project(sources)
        return _remove(project, _one(project, uid, kind, site), uid)
    except Refused as refused:
        return Refusal(refused.reason)


# --- which ---------------------------------------------------------------------------------------


def _one(project: Project, uid: str, kind: CameraKind | None, site: CallSite | None) -> CameraCall:
    found = candidates(project, uid, kind, site)
    if len(found) > 1:
        where = " and ".join(call.where for call in found)
        raise Refused(f"{uid!r} is made in several places ({where})")
    call = found[0]
    check_own(call.file.path)
    if call.loop is not None:
        raise Refused(f"{uid!r} is made in a loop or comprehension ({call.where})")
    return call


def _check_uid(project: Project, uid: str, kind: CameraKind, file: str, class_name: str) -> None:
    if not uid.isidentifier():
        raise Refused(f"{uid!r} is not a name; use letters, digits and _")
    if file not in project.texts:
        raise Refused(f"{file} is not one of your files")
    source = project.file(file)
    for call in camera_calls(project, source):
        classes = [s for s in source.scopes(call.node) if isinstance(s, cst.ClassDef)]
        if call.name == uid and call.hook is not None and HOOKS[call.hook] == kind:
            if classes and classes[-1].name.value == class_name:
                raise Refused(f"there is a camera {uid!r} already ({call.where})")


def _check_new_uid(project: Project, new_uid: str, call: CameraCall) -> None:
    classes = [s for s in call.file.scopes(call.node) if isinstance(s, cst.ClassDef)]
    if not new_uid.isidentifier():
        raise Refused(f"{new_uid!r} is not a name; use letters, digits and _")
    if call.hook is not None and classes:
        _check_uid(project, new_uid, HOOKS[call.hook], call.file.path, classes[-1].name.value)


def _is_hooks_own(call: CameraCall) -> bool:
    """True if what the call's function returns is what the hook returns."""
    function = call.file.scopes(call.node)[0]
    return isinstance(function, cst.FunctionDef) and function.name.value in HOOKS


# --- adding --------------------------------------------------------------------------------------


def _add(
    project: Project,
    path: str,
    class_name: str,
    kind: CameraKind,
    uid: str,
    settings: CameraSettings,
    target: tuple[float, float, float] | None,
) -> SourceEdit:
    file = project.file(path)
    check_own(path)
    cls = class_named(file, class_name)
    hook = HOOK_OF[kind]
    name = _siblings_look_at(project, file, hook)
    pose = name and look_at_text(name, settings, target) or ""
    imports, notes = needed_imports(project, file, settings, with_sapien=not pose)

    def text(indent: str) -> str:
        return snippet(uid, settings, indent, pose=pose)

    functions = [n for n in cls.body.body if isinstance(n, cst.FunctionDef) and n.name.value == hook]
    if functions:
        value = returned(file, functions[-1])
        replacement = appended(file, value, uid, text)
    else:
        replacement = new_hook(project, file, cls, hook, text)
    new_text = file.replaced([*imports, *replacement])
    found = checked(project, file, None, new_text, uid)
    return SourceEdit(file.path, file.text, new_text, tuple(notes), as_written(found, settings))


def _siblings_look_at(project: Project, file: SourceFile, hook: str) -> str:
    """How a camera of this file calls look_at, one of that hook before others; empty if none does."""
    calls = sorted(camera_calls(project, file), key=lambda call: call.hook != hook)
    for pose in (read.values.get("pose") for call in calls for read in readings(project, call)):
        if isinstance(pose, PoseValue) and pose.form == "look_at" and pose.at.file is file:
            assert isinstance(pose.at.node, cst.Call)
            name = file.code(pose.at.node.func)
            if name.partition(".")[0] in project.bindings(file, file.module):
                return name
    return ""


def _insert_beside(
    project: Project, call: CameraCall, text: str, uid: str, settings: CameraSettings
) -> SourceEdit:
    file = call.file
    outer = file.parents[call.node]
    value: cst.CSTNode | None
    if isinstance(outer, cst.Return) and _is_hooks_own(call):
        value = call.node
    elif isinstance(outer, (cst.Element, cst.DictElement)):
        value = file.parents[outer]
    elif isinstance(outer, cst.Arg) and call.key is not None:
        value = file.parents[outer]
    else:
        value = None
    if not isinstance(value, (cst.Call, cst.List, cst.Tuple, cst.Dict)):
        raise Refused(
            f"the camera ({call.where}) stands alone, and where a second one belongs cannot be told"
        )
    old_line = file.line_text(call.line)
    old_indent = old_line[: len(old_line) - len(old_line.lstrip())]

    def indented(indent: str) -> str:
        # The copy's inner lines keep their distance from its first one.
        first, *rest = text.split("\n")
        return "\n".join(
            [first, *(indent + r[len(old_indent) :] if r.startswith(old_indent) else r for r in rest)]
        )

    new_text = file.replaced(appended(file, value, uid, indented))
    found = checked(project, file, None, new_text, uid)
    return SourceEdit(file.path, file.text, new_text, (), as_written(found, settings))


# --- renaming ------------------------------------------------------------------------------------


def _renaming(project: Project, call: CameraCall, new_uid: str) -> list[Replacement]:
    """The name at its call alone: a constant that holds it may name other things too."""
    file = call.file
    found: list[Replacement] = []
    uid = call.arguments.get("uid")
    if call.key is not None:
        keyword = isinstance(call.key, cst.Name) and isinstance(file.parents[call.key], cst.Arg)
        found.append(Replacement(*file.span(call.key), new_uid if keyword else repr_text(new_uid)))
        if uid is None or not isinstance(uid.value, cst.SimpleString):
            return found
        if uid.value.evaluated_value != call.name:
            return found
    if uid is None:
        raise Refused(f"the name is not written in the call ({call.where})")
    quote = uid.value.quote if isinstance(uid.value, cst.SimpleString) else '"'
    text = f"'{new_uid}'" if quote == "'" else repr_text(new_uid)
    return [*found, Replacement(*file.span(uid.value), text)]


def _renamed_text(project: Project, call: CameraCall, new_uid: str) -> str:
    file = call.file
    start, end = file.span(call.node)
    text = file.text[start:end]
    uid = call.arguments.get("uid")
    if uid is not None:
        a, b = file.span(uid.value)
        text = text[: a - start] + repr_text(new_uid) + text[b - start :]
    return text.replace("\r\n", "\n")


# --- removing ------------------------------------------------------------------------------------


def _remove(project: Project, call: CameraCall, uid: str) -> SourceEdit:
    file = call.file
    outer = file.parents[call.node]
    if isinstance(outer, cst.Return) and _is_hooks_own(call):
        start, end = file.span(call.node)
        replacement = Replacement(start, end, "[]")
    elif isinstance(outer, (cst.Element, cst.DictElement)) or (
        isinstance(outer, cst.Arg) and call.key is not None
    ):
        container = file.parents[outer]
        assert isinstance(container, (cst.List, cst.Tuple, cst.Dict, cst.Call))
        elements = list(container.args if isinstance(container, cst.Call) else container.elements)
        replacement = _without(file, elements, elements.index(outer), isinstance(container, cst.Tuple))
    else:
        raise Refused(
            f"the camera is made at {call.where} and used elsewhere under a name; take it out by hand"
        )
    new_text = file.replaced([replacement])
    checked(project, file, call, new_text, None)
    pose = call.arguments.get("pose")
    notes = []
    if pose is not None and isinstance(pose.value, cst.Name):
        notes.append(f"`{pose.value.value}` is left where it is; nothing may need it any more")
    return SourceEdit(file.path, file.text, new_text, tuple(notes), None)


def _without(file: SourceFile, elements: list, index: int, is_tuple: bool) -> Replacement:
    element = elements[index]
    start = (
        file.inner_span(element)[0] if not isinstance(element, cst.Element) else file.span(element.value)[0]
    )
    end = file.span(element.value)[1]
    if is_tuple and len(elements) <= 2:
        raise Refused("a tuple of one or none is easily misread; take the camera out by hand")
    if isinstance(element.comma, cst.Comma):
        end = file.text.index(",", end) + 1
    line_start = file.line_start(file.line_at(start))
    rest_end = file.text.find("\n", end)
    rest = file.text[end : rest_end if rest_end >= 0 else len(file.text)]
    if not file.text[line_start:start].strip() and (not rest.strip() or rest.strip().startswith("#")):
        # It has its lines for itself: they go with it, and a remark at their end.
        return Replacement(line_start, rest_end + 1 if rest_end >= 0 else len(file.text), "")
    if index + 1 < len(elements):
        following = elements[index + 1]
        after = (
            file.span(following.value)[0]
            if isinstance(following, cst.Element)
            else file.inner_span(following)[0]
        )
        return (
            Replacement(start, after, "") if not file.text[end:after].strip() else Replacement(start, end, "")
        )
    if index > 0:
        start = file.span(elements[index - 1].value)[1]
    return Replacement(start, end, "")


# --- is it right ---------------------------------------------------------------------------------


def checked(
    project: Project, file: SourceFile, without: CameraCall | None, new_text: str, uid: str | None
) -> list[ReadCamera]:
    """Read the new text again: the cameras of before but `without` one, and one more if it has a `uid`.

    Returns how that one reads.
    """
    changed = Project({**project.texts, file.path: new_text})
    kept = [
        _said(project, call)
        for call in camera_calls(project, file)
        if without is None or call.node is not without.node
    ]
    more: list[CameraCall] = []
    for call in camera_calls(changed, changed.file(file.path)):
        said = _said(changed, call)
        if said in kept:
            kept.remove(said)
        else:
            more.append(call)
    if kept:
        raise Refused("the change would be one of another camera as well")
    if [call.name for call in more] != ([] if uid is None else [uid]):
        raise Refused("the file could not be changed without changing what else it does")
    return list(readings(changed, more[0])) if more else []


def as_written(found: list[ReadCamera], settings: CameraSettings) -> CameraSettings:
    """`settings` as the text has them, rounded; of several branches the one that is closest."""

    def apart(read: ReadCamera) -> int:
        return sum(mismatch(read, name, settings) is not None for name in FIELDS)

    return min(found, key=apart).settings(settings) if found else settings


def _said(project: Project, call: CameraCall) -> tuple[str | None, int, tuple[str, ...]]:
    arguments = tuple(" ".join(call.file.code(arg.value).split()) for arg in call.node.args)
    return call.name, len(list(readings(project, call))), arguments
