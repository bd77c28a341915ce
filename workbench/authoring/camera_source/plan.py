"""From "this camera should be so" to the smallest change of the author's file that makes it so.

The way: find the ``CameraConfig(...)`` that made the camera; read what it says; refuse unless that is what the
running env has, since otherwise something else decides and an edit would not do what it seems to; change the
arguments that differ; then read the new text again, as a stranger, and let it go only if this camera is what was
asked for and every other camera is what it was.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from workbench.authoring.camera_source import rotations
from workbench.authoring.camera_source.arguments import added_arguments, argument_span
from workbench.authoring.camera_source.changes import Changes
from workbench.authoring.camera_source.definitions import Project
from workbench.authoring.camera_source.find import CameraCall, camera_calls, candidates, check_own
from workbench.authoring.camera_source.number_text import matrix_text, number_text
from workbench.authoring.camera_source.read_camera import (
    ANGLE_STEP,
    FIELDS,
    POSITION_STEP,
    ReadCamera,
    changed_fields,
    mismatch,
    readings,
    same_value,
)
from workbench.authoring.camera_source.result import FileChange, Refusal, Refused, SourceEdit
from workbench.authoring.camera_source.snippet import snippet
from workbench.authoring.camera_source.source_file import Replacement, SourceFile
from workbench.authoring.camera_source.values import Nothing, Number, PoseValue, Text, Vector
from workbench.authoring.camera_source.wanted import check_wanted
from workbench.authoring.camera_source.write_pose import write_pose
from workbench.core.camera_settings import CallSite, CameraSettings
from workbench.core.pictures import CameraKind


def plan_edit(
    sources: Mapping[str, str],
    uid: str,
    before: CameraSettings,
    after: CameraSettings,
    site: CallSite | None = None,
    kind: CameraKind | None = None,
    target: tuple[float, float, float] | None = None,
) -> SourceEdit | Refusal:
    """The edit that turns the camera `uid` from `before`, which the running env has, into `after`.

    `sources` are the author's files by path, as they are on disk. `site` says where the camera was made and wins
    over the name; `kind` tells apart a sensor and a camera for people of one name. `target` is the point that the
    camera was aimed at, in the frame of its position: a look_at gets it as long as `after` looks there. Nothing is
    written.
    """
    project = Project(sources)
    try:
        check_wanted(after)
    except Refused as refused:
        return Refusal(refused.reason)
    try:
        return _plan(project, uid, before, after, site, kind, target)
    except Refused as refused:
        return Refusal(refused.reason, snippet(uid, after, more=_mount(project, uid, kind, site)))


def _plan(
    project: Project,
    uid: str,
    before: CameraSettings,
    after: CameraSettings,
    site: CallSite | None,
    kind: CameraKind | None,
    target: tuple[float, float, float] | None,
) -> SourceEdit:
    fields = changed_fields(before, after)
    if not fields:
        raise Refused("nothing of this camera was changed")
    read = _the_one(candidates(project, uid, kind, site), project, uid, fields, before)
    call = read.call
    if call.loop is not None:
        raise Refused(
            f"the camera is made in a loop or comprehension (line {call.file.line(call.loop)} of {call.file.name}), "
            "and a change there would be one of all its cameras"
        )
    changes = Changes()
    if call.hook is None:
        changes.note(
            f"the camera is made outside of a hook ({call.where}): whatever else uses it changes along"
        )
    _write_fields(changes, project, read, fields, after, target)
    for name in FIELDS:
        if name in read.values:
            changes.emit(read.values[name])
    return _edit(project, read, changes, fields, before, after)


def _mount(project: Project, uid: str, kind: CameraKind | None, site: CallSite | None) -> list[str]:
    """What a copy of the camera has to have too: without its mount the pose is one of another frame."""
    try:
        call = candidates(project, uid, kind, site)[0]
    except Refused:
        return []
    names = [name for name in ("entity_uid", "mount") if name in call.arguments]
    return [f"{name}={call.file.code(call.arguments[name].value)}" for name in names]


def _the_one(
    calls: list[CameraCall], project: Project, uid: str, fields: list[str], before: CameraSettings
) -> ReadCamera:
    """The reading that agrees with the env in all that is to be changed."""
    agreeing: list[ReadCamera] = []
    reasons: list[str] = []
    for call in calls:
        check_own(call.file.path)
        for read in readings(project, call):
            wrong = [why for name in fields if (why := mismatch(read, name, before)) is not None]
            if wrong:
                reasons.append(f"{wrong[0]} ({call.where})")
            else:
                agreeing.append(read)
    if not agreeing:
        raise Refused(reasons[0] if reasons else f"{uid!r} cannot be read")
    # Of several ways through the branches the one that agrees in everything else, too.
    least = min(_strange(read, fields, before) for read in agreeing)
    agreeing = [read for read in agreeing if _strange(read, fields, before) == least]
    places = {tuple(_places(read, fields)) for read in agreeing}
    if len(places) > 1:
        lines = sorted({read.call.line for read in agreeing})
        where = f"lines {' and '.join(map(str, lines))}" if len(lines) > 1 else "several branches"
        raise Refused(
            f"{uid!r} is written in {where} of {agreeing[0].call.file.name} with the same values, and which of them "
            "made this camera cannot be told"
        )
    return agreeing[0]


def _strange(read: ReadCamera, fields: list[str], before: CameraSettings) -> int:
    """In how many of the fields that stay as they are it does not say what the env has."""
    return sum(mismatch(read, name, before) is not None for name in FIELDS if name not in fields)


def _places(read: ReadCamera, fields: list[str]) -> list[object]:
    return [read.call.node, *(read.values[name].at.node for name in fields if name in read.values)]


def _write_fields(
    changes: Changes,
    project: Project,
    read: ReadCamera,
    fields: list[str],
    after: CameraSettings,
    target: tuple[float, float, float] | None,
) -> None:
    added: list[str] = []
    call = read.call
    for name in fields:
        value = read.values.get(name)
        wanted: Any = getattr(after, name, None)  # a pose is two of its fields
        if name == "pose":
            assert isinstance(value, PoseValue)
            write_pose(changes, project, value, after, target)
        elif name in ("fov", "intrinsic"):
            continue
        elif isinstance(value, Number):
            changes.number(value, wanted, 0 if name in ("width", "height") else 4)
        elif isinstance(value, Text):
            changes.texts[value] = f'"{wanted}"'
        elif name in ("width", "height"):
            raise Refused(f"{call.where} gives no {name}")
        else:
            added.append(
                f'{name}="{wanted}"' if name == "shader_pack" else f"{name}={number_text(wanted, 4)}"
            )
    if "fov" in fields or "intrinsic" in fields:
        added += _write_lens(changes, project, read, after)
    for replacement in added_arguments(call.file, call.node, added):
        changes.replacements.append((call.file, replacement))


def _write_lens(changes: Changes, project: Project, read: ReadCamera, after: CameraSettings) -> list[str]:
    """`fov` or `intrinsic`, of which ManiSkill wants exactly one. Returns arguments to add."""
    call = read.call
    name, other = ("fov", "intrinsic") if after.fov is not None else ("intrinsic", "fov")
    if after.fov is not None:
        text = number_text(after.fov, 4)
    elif after.intrinsic is not None:
        rows = matrix_text(after.intrinsic)
        text = f"np.array({rows})" if _has_numpy(project, call.file) else rows
    else:
        raise Refused("a camera needs a fov or an intrinsic")
    value, arg = read.values.get(name), call.arguments.get(name)
    unwanted = call.arguments.get(other)
    stands_there = unwanted is not None and not isinstance(read.values.get(other), Nothing)
    if stands_there and unwanted is not None and unwanted.keyword is not None and arg is None:
        changes.replacements.append(
            (call.file, Replacement(*argument_span(call.file, unwanted), f"{name}={text}"))
        )
        return []
    if stands_there and unwanted is not None:
        changes.replacements.append((call.file, Replacement(*call.file.span(unwanted.value), "None")))
    if isinstance(value, Number) and after.fov is not None:
        changes.number(value, after.fov, 4)
    elif isinstance(value, Vector) and after.intrinsic is not None and value.literal:
        rows = [row for row in value.items if isinstance(row, Vector)]
        for row, numbers in zip(rows, after.intrinsic, strict=True):
            for item, number in zip(row.items, numbers, strict=True):
                if isinstance(item, Number):
                    changes.number(item, number, 3)
    elif value is not None:
        changes.texts[value] = text
    elif arg is None:
        return [f"{name}={text}"]
    return []


def _has_numpy(project: Project, file: SourceFile) -> bool:
    bindings = project.bindings(file, file.module).get("np", [])
    return any(binding.dotted == "numpy" for binding in bindings)


def _edit(
    project: Project,
    read: ReadCamera,
    changes: Changes,
    fields: list[str],
    before: CameraSettings,
    after: CameraSettings,
) -> SourceEdit:
    files = {file.path: file for file, _ in changes.replacements}
    if not files:
        raise Refused("the change is smaller than what is written (0.1 mm, 0.01 degree)")
    # The file that makes the camera first: it is what the author thinks of.
    ordered = sorted(files.values(), key=lambda file: (file.path != read.call.file.path, file.path))
    made: list[FileChange] = []
    for file in ordered:
        check_own(file.path)
        new_text = file.replaced([change for of, change in changes.replacements if of.path == file.path])
        made.append(FileChange(file.path, file.text, new_text))
    if len(made) > 1:
        changes.note(f"{len(made)} files change together: {' and '.join(file.name for file in ordered)}")
    found = _read_again(project, read, made, fields, before, after)
    left = [n for n in FIELDS if n not in fields and n not in read.unknown and mismatch(read, n, before)]
    if left:
        changes.note(
            f"{' and '.join(left)} of the running camera {'is' if len(left) == 1 else 'are'} not what the file says, "
            f"and {'is' if len(left) == 1 else 'are'} left alone there"
        )
    settings = found.settings(before)
    return SourceEdit(
        file=made[0].file,
        old_text=made[0].old_text,
        new_text=made[0].new_text,
        notes=tuple(changes.notes),
        settings=_with(settings, before, left),
        others=tuple(made[1:]),
    )


def _with(settings: CameraSettings, env: CameraSettings, names: list[str]) -> CameraSettings:
    """`settings` with those fields from `env` that something else than the file decides."""
    values = {}
    for name in names:
        if name == "pose":
            values |= {"position": env.position, "quaternion": env.quaternion}
        else:
            values[name] = getattr(env, name)
    return dataclasses.replace(settings, **values)


def _read_again(
    project: Project,
    read: ReadCamera,
    made: list[FileChange],
    fields: list[str],
    before: CameraSettings,
    after: CameraSettings,
) -> ReadCamera:
    """The camera as the new text has it. Raises `Refused` if it, or another camera, is not as it should be."""
    changed = Project({**project.texts, **{change.file: change.new_text for change in made}})
    result: ReadCamera | None = None
    for path in {*(change.file for change in made), read.call.file.path}:
        old_calls = list(camera_calls(project, project.file(path)))
        new_calls = list(camera_calls(changed, changed.file(path)))
        if len(old_calls) != len(new_calls):
            raise Refused("the file could not be changed without changing what else it does")
        for old, new in zip(old_calls, new_calls, strict=True):
            if old.node is not read.call.node:
                if _said(project, old) != _said(changed, new):
                    raise Refused(f"the change would be one of the camera {old.name or old.where} as well")
                continue
            found = [r for r in readings(changed, new) if _is_as_asked(r, fields, after)]
            result = min(found, key=lambda r: _strange(r, fields, before), default=None)
    if result is None:
        raise Refused("what was to be written does not read back as what was asked for")
    return result


def _said(project: Project, call: CameraCall) -> list[tuple[object, ...]]:
    """Everything that can be read of one call, to be compared."""
    found: list[tuple[object, ...]] = []
    for read in readings(project, call):
        said: list[object] = []
        for name in FIELDS:
            value = read.values.get(name)
            if isinstance(value, PoseValue):
                said.append((value.position, value.quaternion))
            elif isinstance(value, Vector):
                said.append(value.numbers)
            else:
                said.append(value.value if isinstance(value, (Number, Text)) else None)
        found.append((call.name, *said))
    return found


def _is_as_asked(read: ReadCamera, fields: list[str], after: CameraSettings) -> bool:
    for name in fields:
        if name in read.unknown:
            return False
        if name == "pose":
            pose = read.values["pose"]
            assert isinstance(pose, PoseValue)
            apart = max(abs(a - b) for a, b in zip(pose.position, after.position, strict=True))
            if apart > POSITION_STEP or abs(sum(x * x for x in pose.quaternion) - 1) > 0.05:
                return False
            if rotations.angle_between(pose.quaternion, after.quaternion) > 1.5 * ANGLE_STEP:
                return False
        elif name == "intrinsic" and after.intrinsic is not None:
            value = read.values.get(name)
            if not isinstance(value, Vector):
                return False
            pairs = zip(value.numbers, (x for row in after.intrinsic for x in row), strict=True)
            if max(abs(a - b) for a, b in pairs) > 1e-3:
                return False
        else:
            found, wanted = read.field(name, None), getattr(after, name)
            if isinstance(found, float) and isinstance(wanted, (int, float)):
                if abs(found - wanted) > 2e-4:
                    return False
            elif not same_value(found, wanted):
                return False
    return True
