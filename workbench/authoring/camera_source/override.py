"""A camera that a parent class makes: the hook of one's own that takes the parent's cameras and puts another in its place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from workbench.authoring.camera_source.cameras import Run, check_others, check_own, run_first
from workbench.authoring.camera_source.hooks import (
    HOOK_OF,
    at_end_of_class,
    class_named,
    needed_imports,
)
from workbench.authoring.camera_source.result import Refusal, SourceEdit
from workbench.authoring.camera_source.snippet import repr_text, snippet
from workbench.authoring.source.text import Refused
from workbench.core.camera_settings import CallSite, CameraSettings, why_no_camera
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
        new_text = source.replaced([*imports, replacement])
        found = check_others(ran, run({**sources, file: new_text}), (kind, uid), (kind, uid))
    except Refused as refused:
        return Refusal(refused.reason, snippet(uid, settings, more=more))
    told = (
        f"{uid} is made by {parent}, from which {class_name} inherits: {class_name} gets a {hook} of its own, with all "
        f"cameras of {parent} and this one in place of its {uid}"
    )
    return SourceEdit(file, source.text, new_text, (told, *notes), found)
