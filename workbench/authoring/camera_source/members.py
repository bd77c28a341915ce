"""Cameras added to a task, duplicated, renamed and removed.

A hook returns one config, a list or tuple of them, or a dict. One becomes a list when a second is added. Where
a hook does anything else (a name, a concatenation, several returns, a call of the parent's hook), the reason is told
and the text to copy is given.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Literal

import libcst as cst

from workbench.authoring.camera_source.definitions import Project
from workbench.authoring.camera_source.find import (
    HOOKS,
    CameraCall,
    camera_calls,
    candidates,
    check_own,
)
from workbench.authoring.camera_source.read_camera import readings
from workbench.authoring.camera_source.result import Refusal, Refused, SourceEdit
from workbench.authoring.camera_source.snippet import repr_text, snippet
from workbench.authoring.camera_source.source_file import Replacement, SourceFile, walk
from workbench.authoring.camera_source.write_pose import import_place
from workbench.core.camera_settings import CallSite, CameraSettings
from workbench.core.pictures import CameraKind

Hook = Literal["_default_sensor_configs", "_default_human_render_camera_configs"]
_HOOK: dict[CameraKind, Hook] = {
    "sensor": "_default_sensor_configs",
    "human": "_default_human_render_camera_configs",
}
_CONFIG = "from mani_skill.sensors.camera import CameraConfig\n"


def plan_add(
    sources: Mapping[str, str],
    file: str,
    class_name: str,
    kind: CameraKind,
    uid: str,
    settings: CameraSettings,
) -> SourceEdit | Refusal:
    """A new camera that stands still, in the hook of `class_name`, which is made if the class has none."""
    try:
        project = Project(sources)
        _check_uid(project, uid, kind, file, class_name)
        return _add(project, file, class_name, kind, uid, settings, None)
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
        _check(project, call, new_text, added=None, removed=uid, renamed=new_uid)
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


# --- adding --------------------------------------------------------------------------------------


def _add(
    project: Project,
    path: str,
    class_name: str,
    kind: CameraKind,
    uid: str,
    settings: CameraSettings,
    text: str | None,
) -> SourceEdit:
    file = project.file(path)
    check_own(path)
    cls = next(
        (n for n in file.module.body if isinstance(n, cst.ClassDef) and n.name.value == class_name), None
    )
    if cls is None:
        raise Refused(f"there is no class {class_name} in {file.name}")
    imports, notes = _imports(project, file, settings)
    hook = _HOOK[kind]
    functions = [n for n in cls.body.body if isinstance(n, cst.FunctionDef) and n.name.value == hook]
    if functions:
        returned = _returned(file, functions[-1])
        replacement = _appended(file, returned, uid, lambda indent: snippet(uid, settings, indent))
    else:
        replacement = _new_hook(project, file, cls, hook, uid, settings)
    new_text = file.replaced([*imports, *replacement])
    _check(project, None, new_text, added=uid, removed=None, file=file)
    return SourceEdit(file.path, file.text, new_text, tuple(notes), settings)


def _imports(
    project: Project, file: SourceFile, settings: CameraSettings
) -> tuple[list[Replacement], list[str]]:
    wanted = [("CameraConfig", _CONFIG), ("sapien", "import sapien\n")]
    if settings.intrinsic is not None:
        wanted.append(("np", "import numpy as np\n"))
    bindings = project.bindings(file, file.module)
    missing = [line for name, line in wanted if not _imported_as(bindings.get(name, []), name)]
    if not missing:
        return [], []
    place = import_place(file)
    text = "".join(sorted(missing, key=lambda line: line.startswith("from")))
    return [Replacement(place, place, text)], [
        f"`{line.strip()}` is added at the top of the file" for line in missing
    ]


def _imported_as(bindings: list, name: str) -> bool:
    dotted = bindings[-1].dotted if bindings else None
    if bindings and dotted is None:
        raise Refused(
            f"`{name}` means something else in this file (line {bindings[-1].file.line(bindings[-1].node)})"
        )
    return dotted is not None


def _returned(file: SourceFile, function: cst.FunctionDef) -> cst.BaseExpression:
    """The one expression that a hook returns."""
    found = [node for node in walk(function.body) if isinstance(node, cst.Return)]
    found = [node for node in found if file.scopes(node)[0] is function]
    name = function.name.value
    if len(found) != 1 or found[0].value is None:
        raise Refused(
            f"{name} (line {file.line(function)}) has {len(found)} returns; one is needed to add to"
        )
    value = found[0].value
    if isinstance(value, cst.Name):
        assigned = [
            node
            for node in walk(function.body)
            if isinstance(node, cst.Assign)
            and any(isinstance(t.target, cst.Name) and t.target.value == value.value for t in node.targets)
        ]
        if len(assigned) == 1 and isinstance(assigned[0].value, (cst.List, cst.Dict)):
            return assigned[0].value
    return value


def _appended(file: SourceFile, value: cst.BaseExpression, uid: str, text) -> list[Replacement]:
    """`text(indent)` as one more of what `value` holds."""
    line = file.line_text(file.line(value))
    indent = line[: len(line) - len(line.lstrip())]
    if isinstance(value, (cst.List, cst.Tuple)):
        start, end = file.span(value)
        return _into_brackets(file, value.elements, start, end, indent, text)
    if isinstance(value, cst.Dict):
        start, end = file.span(value)
        return _into_brackets(
            file, value.elements, start, end, indent, lambda i: f"{repr_text(uid)}: {text(i)}"
        )
    if isinstance(value, cst.Call) and file.code(value.func) == "dict":
        close = file.inner_span(value)[1] - 1
        open_ = file.span(value.func)[1]
        return _into_brackets(file, value.args, open_, close + 1, indent, lambda i: f"{uid}={text(i)}")
    if isinstance(value, cst.Call) and file.code(value.func).rpartition(".")[2].endswith("CameraConfig"):
        start, end = file.span(value)
        inner = file.text[start:end].replace("\n", "\n    ")
        new = f"[\n{indent}    {inner},\n{indent}    {text(indent + '    ')},\n{indent}]"
        return [Replacement(start, end, new)]
    raise Refused(
        f"what is returned at line {file.line(value)} is neither a CameraConfig(...) nor a list or dict of them"
    )


def _into_brackets(file: SourceFile, elements, start: int, end: int, indent: str, text) -> list[Replacement]:
    close = end - 1
    if not elements:
        new = f"\n{indent}    {text(indent + '    ')},\n{indent}"
        return [Replacement(start + 1, close, new)]
    last = elements[-1]
    last_end = file.span(last.value)[1]
    comma = isinstance(last.comma, cst.Comma)
    closing = file.line_at(close)
    before = file.text[file.line_start(closing) : close]
    if not before.strip() and closing != file.line_at(start):
        own = before + "    "
        at = file.line_start(closing)
        found = [Replacement(at, at, f"{own}{text(own)},\n")]
        return found if comma else [Replacement(last_end, last_end, ","), *found]
    own = indent + "    "
    if comma:
        last_end = file.text.index(",", last_end) + 1
    return [Replacement(last_end, close, f"{'' if comma else ','}\n{own}{text(own)},\n{indent}")]


def _new_hook(
    project: Project, file: SourceFile, cls: cst.ClassDef, hook: Hook, uid: str, settings: CameraSettings
) -> list[Replacement]:
    if not isinstance(cls.body, cst.IndentedBlock) or not cls.body.body:
        raise Refused(f"the class {cls.name.value} has no body to add {hook} to")
    for base in cls.bases:
        named = project.class_named(file, base.value)
        if named is not None and hook in project.bindings(*named):
            raise Refused(
                f"{cls.name.value} inherits {hook} from {named[1].name.value} ({named[0].name}); add the camera there"
            )
    first = cls.body.body[0]
    line = file.line_text(file.line(first))
    indent = line[: len(line) - len(line.lstrip())]
    inner = indent + "    "
    end = file.span(cls.body.body[-1])[1]
    end = file.text.find("\n", end)
    at = len(file.text) if end < 0 else end + 1
    lead = "\n" if end >= 0 else "\n\n"
    text = (
        f"{lead}{indent}@property\n{indent}def {hook}(self):\n{inner}return [\n"
        f"{inner}    {snippet(uid, settings, inner + '    ')},\n{inner}]\n"
    )
    return [Replacement(at, at, text)]


def _insert_beside(
    project: Project, call: CameraCall, text: str, uid: str, settings: CameraSettings
) -> SourceEdit:
    file = call.file
    outer = file.parents[call.node]
    value: cst.CSTNode | None
    if isinstance(outer, cst.Return):
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

    new_text = file.replaced(_appended(file, value, uid, indented))
    _check(project, None, new_text, added=uid, removed=None, file=file)
    return SourceEdit(file.path, file.text, new_text, (), settings)


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
    if isinstance(outer, cst.Return):
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
        raise Refused(f"the camera is made at {call.where} and used under a name; take it out by hand")
    new_text = file.replaced([replacement])
    _check(project, call, new_text, added=None, removed=uid)
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


def _check(
    project: Project,
    call: CameraCall | None,
    new_text: str,
    *,
    added: str | None,
    removed: str | None,
    renamed: str | None = None,
    file: SourceFile | None = None,
) -> None:
    """Read the new text again: the other cameras must be what they were."""
    file = file or (call.file if call is not None else None)
    assert file is not None
    changed = Project({**project.texts, file.path: new_text})
    old = [_said(project, c) for c in camera_calls(project, file) if call is None or c.node is not call.node]
    new = [_said(changed, c) for c in camera_calls(changed, changed.file(file.path))]
    for kept in old:
        if kept not in new:
            raise Refused("the change would be one of another camera as well")
        new.remove(kept)
    names = [said[0] for said in new]
    wanted = [name for name in (added, renamed) if name is not None]
    if names != wanted and not (removed is not None and renamed is None and not names):
        raise Refused("the file could not be changed without changing what else it does")


def _said(project: Project, call: CameraCall) -> tuple[str | None, int, tuple[str, ...]]:
    arguments = tuple(" ".join(call.file.code(arg.value).split()) for arg in call.node.args)
    return call.name, len(list(readings(project, call))), arguments
