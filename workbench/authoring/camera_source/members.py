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

from workbench.authoring.camera_source.cameras import (
    HOOKS,
    CameraCall,
    Ran,
    Run,
    camera_call,
    check_others,
    check_own,
    run_first,
)
from workbench.authoring.camera_source.hooks import (
    HOOK_OF,
    appended,
    at_end_of_class,
    class_named,
    needed_imports,
    new_hook,
    repr_text,
    returned,
    snippet,
)
from workbench.authoring.camera_source.result import Refusal, SourceEdit
from workbench.authoring.camera_source.write_pose import look_at_text
from workbench.authoring.source.names import Project
from workbench.authoring.source.text import FUNCTIONS, Refused, Replacement, SourceFile
from workbench.core.camera_settings import CallSite, CameraKey, CameraSettings, why_no_camera
from workbench.core.pictures import CameraKind


def plan_add(
    sources: Mapping[str, str],
    file: str,
    class_name: str,
    key: CameraKey,
    settings: CameraSettings,
    run: Run,
    target: tuple[float, float, float] | None = None,
) -> SourceEdit | Refusal:
    """A new camera that stands still, in the hook of `class_name`, which is made if the class has none.

    Its pose is written as its siblings' is, where that can say it; `target` is the point that it looks at then.
    """
    why = why_no_camera(settings)
    if why is not None:
        return Refusal(why)
    kind, uid = key
    try:
        project, ran = run_first(sources, run)
        source = project.given(file)
        check_own(file)
        _check_new(ran, key)
        cls, hook = class_named(source, class_name), HOOK_OF[kind]
        name = _siblings_look_at(project, ran, source, kind)
        pose = name and look_at_text(name, settings, target) or ""
        imports, notes = needed_imports(project, source, settings, with_sapien=not pose)

        def text(indent: str) -> str:
            return snippet(uid, settings, indent, pose=pose)

        functions = [node for node in cls.body if isinstance(node, ast.FunctionDef) and node.name == hook]
        if functions:
            replacement = appended(source, returned(source, functions[-1]), uid, text)
        else:
            replacement = new_hook(project, ran, source, cls, hook, text)
        new_text = source.replaced([*imports, *replacement])
        return _proven(project, source, new_text, notes, ran, run, None, key)
    except Refused as refused:
        return Refusal(refused.reason, snippet(uid, settings))


def plan_duplicate(
    sources: Mapping[str, str], key: CameraKey, new_uid: str, settings: CameraSettings, run: Run
) -> SourceEdit | Refusal:
    """A copy of a camera, which has `settings`, beside it: on the same mount, written alike."""
    new_key: CameraKey = (key[0], new_uid)
    try:
        project, ran = run_first(sources, run)
        call = _one(project, ran, key)
        _check_new(ran, new_key)
        file, outer = call.file, call.file.parents[call.node]
        alone = not (
            (isinstance(outer, ast.Return) and _is_hooks_own(call))
            or isinstance(outer, (ast.List, ast.Tuple, ast.Dict))
            or call.key is not None
        )
        if alone:
            raise Refused(
                f"the camera ({call.where}) stands alone, and where a second one belongs cannot be told"
            )
        text, indent = _renamed_text(call, new_uid), file.indent(file.inner_span(call.node)[0])

        def indented(own: str) -> str:
            # The copy's inner lines keep their distance from its first one.
            first, *rest = text.split("\n")
            return "\n".join([first, *(own + r[len(indent) :] if r.startswith(indent) else r for r in rest)])

        value = call.node if isinstance(outer, ast.Return) else call.container
        new_text = file.replaced(appended(file, value, new_uid, indented))
        return _proven(project, file, new_text, [], ran, run, None, new_key)
    except Refused as refused:
        return Refusal(refused.reason, snippet(new_uid, settings))


def plan_rename(
    sources: Mapping[str, str], key: CameraKey, new_uid: str, settings: CameraSettings, run: Run
) -> SourceEdit | Refusal:
    """The same camera under another name. Observations and `sensor_configs` know it by its name: that is said."""
    uid = key[1]
    new_key: CameraKey = (key[0], new_uid)
    try:
        project, ran = run_first(sources, run)
        call = _one(project, ran, key)
        _check_new(ran, new_key)
        new_text = call.file.replaced(_renaming(call, new_uid))
        notes = [
            f"observations name this camera {new_uid!r} from now on, which a trained policy may not expect"
        ]
        elsewhere = len(re.findall(rf"[\"']{re.escape(uid)}[\"']", new_text))
        if elsewhere:
            notes.append(f"{uid!r} still stands in {elsewhere} other place(s) of {call.file.name}")
        return _proven(project, call.file, new_text, notes, ran, run, key, new_key)
    except Refused as refused:
        return Refusal(refused.reason, snippet(new_uid, settings))


def plan_remove(sources: Mapping[str, str], key: CameraKey, run: Run) -> SourceEdit | Refusal:
    """The camera taken out of what its hook returns."""
    try:
        project, ran = run_first(sources, run)
        call = _one(project, ran, key)
        new_text = call.file.replaced([_removal(call)])
        pose = call.arguments.get("pose")
        notes = []
        if isinstance(pose, ast.Name):
            notes.append(f"`{pose.id}` is left where it is; nothing may need it any more")
        return _proven(project, call.file, new_text, notes, ran, run, key, None)
    except Refused as refused:
        return Refusal(refused.reason)


_PARSE = ("parse_camera_configs", "from mani_skill.sensors.camera import parse_camera_configs\n")


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
) -> SourceEdit | Refusal:
    """The edit that gives `class_name` such a hook; `site` is where the parent makes the camera."""
    why = why_no_camera(settings)
    if why is not None:
        return Refusal(why)
    hook, parent = HOOK_OF[kind], site.function.rpartition(".")[0]
    try:
        project, ran = run_first(sources, run)
        source = project.given(file)
        check_own(file)
        cls = class_named(source, class_name)
        own = hook in project.bindings(source, cls)
        owner, where = (class_name, file) if own else ran.owners.get(hook, ("", ""))
        if where in sources:
            raise Refused(
                f"{uid} is made by {parent}, and the {hook} of {owner} ({project.file(where).name}) hands it on: put the "
                "text below in its place there"
            )
        imports, notes = needed_imports(project, source, settings, more=(_PARSE,))
        replacement = at_end_of_class(
            source, cls, hook, lambda indent: override_text(kind, uid, settings, more, indent)
        )
        told = (
            f"{uid} is made by {parent}, from which {class_name} inherits: {class_name} gets a {hook} of its own, with all "
            f"cameras of {parent} and this one in place of its {uid}"
        )
        new_text = source.replaced([*imports, replacement])
        return _proven(project, source, new_text, [told, *notes], ran, run, (kind, uid), (kind, uid))
    except Refused as refused:
        return Refusal(refused.reason, snippet(uid, settings, more=more))


def _proven(
    project: Project,
    file: SourceFile,
    new_text: str,
    notes: list[str],
    ran: Ran,
    run: Run,
    key: CameraKey | None,
    expected: CameraKey | None,
) -> SourceEdit:
    """See `check_others`."""
    found = check_others(ran, run({**project.texts, file.path: new_text}), key, expected)
    return SourceEdit(file.path, file.text, new_text, tuple(notes), found)


# --- which ---------------------------------------------------------------------------------------


def _one(project: Project, ran: Ran, key: CameraKey) -> CameraCall:
    call = camera_call(project, ran, key)
    check_own(call.file.path)
    if call.loop is not None:
        raise Refused(f"{key[1]!r} is made in a loop or comprehension ({call.where})")
    return call


def _check_new(ran: Ran, key: CameraKey) -> None:
    if not key[1].isidentifier():
        raise Refused(f"{key[1]!r} is not a name; use letters, digits and _")
    if key in ran.cameras:
        raise Refused(f"there is a camera {key[1]!r} already")


def _is_hooks_own(call: CameraCall) -> bool:
    """True if what the call's function returns is what the hook returns."""
    function = call.file.scopes(call.node)[0]
    return isinstance(function, FUNCTIONS) and not isinstance(function, ast.Lambda) and function.name in HOOKS


def _siblings_look_at(project: Project, ran: Ran, file: SourceFile, kind: CameraKind) -> str:
    """How a camera of this file calls look_at, one of that kind before others; empty if none does."""
    for key in sorted(ran.cameras, key=lambda key: key[0] != kind):
        trace = ran.cameras[key].trace
        pose = None if trace is None else trace.parts.get("pose")
        if pose is not None and pose.function == "look_at" and pose.at.file == file.path:
            node = file.expression((pose.at.start, pose.at.end))
            name = file.code(node.func) if isinstance(node, ast.Call) else ""
            if name.partition(".")[0] in project.bindings(file, file.module):
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
    if key is not None and not (isinstance(uid, ast.Constant) and uid.value == call.name):
        return found
    if uid is None:
        raise Refused(f"the name is not written in the call ({call.where})")
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
        raise Refused(
            f"the camera is made at {call.where} and used elsewhere under a name; take it out by hand"
        )
    items = file.items(container)
    if isinstance(container, ast.Tuple) and len(items) <= 2:
        raise Refused("a tuple of one or none is easily misread; take the camera out by hand")
    place = file.inner_span(call.node)[0]
    return file.without_item(container, next(i for i, item in enumerate(items) if item[0] <= place < item[1]))
