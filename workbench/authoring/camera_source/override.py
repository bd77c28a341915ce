"""A camera that a parent class makes: the hook of one's own that takes the parent's cameras and puts another in its place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from workbench.authoring.camera_source.definitions import Project
from workbench.authoring.camera_source.find import check_own
from workbench.authoring.camera_source.hooks import (
    HOOK_OF,
    Hook,
    at_end_of_class,
    class_named,
    needed_imports,
)
from workbench.authoring.camera_source.members import as_written, checked
from workbench.authoring.camera_source.result import Refusal, Refused, SourceEdit
from workbench.authoring.camera_source.snippet import repr_text, snippet
from workbench.authoring.camera_source.wanted import check_wanted
from workbench.core.camera_settings import CallSite, CameraSettings
from workbench.core.pictures import CameraKind

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
    more: Sequence[str] = (),
) -> SourceEdit | Refusal:
    """The edit that gives `class_name` such a hook; `site` is where the parent makes the camera."""
    try:
        check_wanted(settings)
    except Refused as refused:
        return Refusal(refused.reason)
    hook, parent = HOOK_OF[kind], site.function.rpartition(".")[0]
    try:
        project = Project(sources)
        return _plan(project, file, class_name, hook, kind, uid, settings, parent, more)
    except Refused as refused:
        return Refusal(refused.reason, snippet(uid, settings, more=more))


def _plan(
    project: Project,
    path: str,
    class_name: str,
    hook: Hook,
    kind: CameraKind,
    uid: str,
    settings: CameraSettings,
    parent: str,
    more: Sequence[str],
) -> SourceEdit:
    file = project.file(path)
    check_own(path)
    cls = class_named(file, class_name)
    for where, owner in project.above(file, cls, []):
        if hook in project.bindings(where, owner):
            raise Refused(
                f"{uid} is made by {parent}, and the {hook} of {owner.name.value} ({where.name}) hands it on: put the text "
                "below in its place there"
            )
    imports, notes = needed_imports(project, file, settings, more=(_PARSE,))
    replacement = at_end_of_class(
        file, cls, hook, lambda indent: override_text(kind, uid, settings, more, indent)
    )
    new_text = file.replaced([*imports, replacement])
    found = checked(project, file, None, new_text, uid)
    told = (
        f"{uid} is made by {parent}, from which {class_name} inherits: {class_name} gets a {hook} of its own, with all "
        f"cameras of {parent} and this one in place of its {uid}"
    )
    return SourceEdit(file.path, file.text, new_text, (told, *notes), as_written(found, settings))
