"""Plans the smallest edit of the author's file that changes a camera's settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from workbench.cameras.edit.camera_edit import CameraEdit, check_camera, planning
from workbench.cameras.edit.hook_cameras import FIELDS, CameraCall, RunHooks, changed_fields, with_fields
from workbench.cameras.edit.pose_text import (
    ANGLE_STEP_RADIANS,
    POSITION_STEP_METRES,
    why_not_a_pose,
    write_pose,
)
from workbench.envs.camera_data import CameraKey, CameraSettings, setting_text
from workbench.pictures.camera_conventions import angle_between
from workbench.source.parsed import RefusedEdit, Replacement
from workbench.source.traced_edits import Changes, matrix_text, number_text
from workbench.task.write_edits import SourceEdit


def plan_edit(
    sources: Mapping[str, str],
    key: CameraKey,
    before: CameraSettings,
    after: CameraSettings,
    run: RunHooks,
) -> SourceEdit:
    """Plan the edit that changes a camera from `before`, its settings in the running env, to `after`. Nothing is written.

    This function runs the files, finds the ``CameraConfig(...)`` call of the camera and changes the arguments
    that differ. Then it runs the new text, and checks that this camera has the new settings and that no other
    camera changed.

    Args:
        sources: the author's files on disk, by path.

    Raises:
        RefusedEdit: the edit is not possible, or the settings of the call differ from `before`: in that case
            other code sets them, and an edit would have no effect.
    """
    check_camera(after)
    mount: list[str] = []
    with planning(sources, run, key[1], after, mount) as edit:
        fields = changed_fields(before, after)
        if not fields:
            raise RefusedEdit("no setting of this camera was changed")
        call = edit.call(key)
        # The pose is relative to the mount, so the text to copy needs the mount too.
        names = [name for name in ("entity_uid", "mount") if name in call.arguments]
        mount += [f"{name}={call.file.code(call.arguments[name])}" for name in names]
        return _plan(edit, call, fields, before, after)


def _plan(
    edit: CameraEdit, call: CameraCall, fields: list[str], before: CameraSettings, after: CameraSettings
) -> SourceEdit:
    if call.loop is not None:
        raise RefusedEdit(
            f"the camera is made in a loop or comprehension (line {call.file.line(call.loop)} of {call.file.name}), "
            "and a change there would change all its cameras"
        )
    made = call.run.made
    if made is None:
        raise RefusedEdit(f"the settings of the camera at {call.where} cannot be read")
    differs_from_file = changed_fields(made, before)
    for name in fields:
        why = call.trace.unknown.get(name) or _why_not(edit, call, name)
        if name in differs_from_file and not why:
            why = _difference_text(name, made, before)
        if why:
            raise RefusedEdit(f"{why} ({call.where})")
    if call.hook is None:
        edit.note(f"the camera is made outside of a hook ({call.where}): other code that uses it changes too")
    _write_fields(edit, call, fields, after)
    for name in FIELDS:
        if name in call.trace.parts:
            edit.emit(call.trace.parts[name])
    planned = edit.verified(call.file, call.camera, call.camera)
    left = [name for name in differs_from_file if name not in fields]
    settings = with_fields(_check_asked(planned.settings, fields, made, after), before, left)
    if planned.others:
        edit.note(f"{len(planned.changes)} files change together: {planned.names}")
    if left:
        be = "is" if len(left) == 1 else "are"
        edit.note(
            f"{' and '.join(left)} of the running camera {be} not as in the file, and {be} not changed there"
        )
    return replace(planned, notes=tuple(edit.notes), settings=settings)


def _why_not(changes: Changes, call: CameraCall, name: str) -> str | None:
    """Reason why an argument cannot be edited in the form in which it is written; None if it can."""
    part = call.trace.parts.get(name)
    if part is None:
        return "the call that makes the camera sets no pose" if name == "pose" else None
    if name == "pose":
        return why_not_a_pose(changes, part)
    readable = {
        "shader_pack": isinstance(part.value, str),
        "intrinsic": part.value is None or (isinstance(part.value, tuple) and len(part.numbers) == 9),
        "fov": part.value is None or isinstance(part.value, float),
    }
    if readable.get(name, isinstance(part.value, float)):
        return None
    return f"`{changes.code(part.at)}` is not a {name} that can be read"


def _write_fields(changes: Changes, call: CameraCall, fields: list[str], after: CameraSettings) -> None:
    added: list[str] = []
    for name in fields:
        part = call.trace.parts.get(name)
        if name == "pose":
            assert part is not None
            write_pose(changes, part, after)
        elif name in ("fov", "intrinsic"):
            continue
        elif name == "shader_pack":
            text = f'"{after.shader_pack}"'
            if part is None:
                added.append(f"shader_pack={text}")
            else:
                changes.texts[part] = text
        elif part is not None:
            changes.number(part, getattr(after, name), 0 if name in ("width", "height") else 4)
        elif name in ("width", "height"):
            raise RefusedEdit(f"the call that makes the camera does not set {name} ({call.where})")
        else:
            added.append(f"{name}={number_text(getattr(after, name), 4)}")
    if "fov" in fields or "intrinsic" in fields:
        added += _write_lens(changes, call, after)
    changes.change(call.file, *call.file.added_arguments(call.node, added))


def _write_lens(changes: Changes, call: CameraCall, after: CameraSettings) -> list[str]:
    """Write `fov` or `intrinsic`; ManiSkill needs exactly one of them. Returns arguments to add."""
    file = call.file
    if after.intrinsic is None:
        assert after.fov is not None
        name, other, text = "fov", "intrinsic", number_text(after.fov, 4)
    else:
        imported = changes.project.bindings(file, file.module).get("np", [])
        rows = matrix_text(after.intrinsic)
        has_numpy = any(binding.dotted == "numpy" for binding in imported)
        name, other, text = "intrinsic", "fov", f"np.array({rows})" if has_numpy else rows
    part, given, unwanted = call.trace.parts.get(name), call.arguments.get(name), call.arguments.get(other)
    there = call.trace.parts.get(other)
    if unwanted is not None and (there is None or there.value is not None):
        outer = file.parents[unwanted]
        if outer is not call.node and given is None:
            start, end = file.inner_span(outer)[0], file.span(unwanted)[1]
            changes.change(file, Replacement(start, end, f"{name}={text}"))
            return []
        changes.replace(file, unwanted, "None")
    if part is not None and isinstance(part.value, float) and after.fov is not None:
        changes.number(part, after.fov, 4)
    elif part is not None and part.value is not None and part.literal and after.intrinsic is not None:
        for row, numbers in zip(part.parts.values(), after.intrinsic, strict=True):
            for item, number in zip(row.parts.values(), numbers, strict=True):
                changes.number(item, number, 3)
    elif part is not None:
        changes.texts[part] = text
    elif given is None:
        return [f"{name}={text}"]
    return []


def _check_asked(
    found: CameraSettings | None, fields: list[str], made: CameraSettings, after: CameraSettings
) -> CameraSettings:
    """Check that `found`, the edited camera, has the `fields` of `after` and all other fields of `made`;
    returns `found`. Raises RefusedEdit."""
    if found is None:
        raise RefusedEdit("the settings of the edited camera cannot be read")
    as_requested = not set(changed_fields(made, found)) - set(fields)
    for name in fields:
        was, requested = getattr(found, name, None), getattr(after, name, None)
        if name == "pose":
            moved = max(abs(a - b) for a, b in zip(found.position, after.position, strict=True))
            turned = angle_between(found.quaternion, after.quaternion)
            as_requested = (
                as_requested and moved <= POSITION_STEP_METRES and turned <= 1.5 * ANGLE_STEP_RADIANS
            )
        elif name == "intrinsic" and found.intrinsic is not None and after.intrinsic is not None:
            flat = [[x for row in matrix for x in row] for matrix in (found.intrinsic, after.intrinsic)]
            as_requested = as_requested and max(abs(a - b) for a, b in zip(*flat, strict=True)) <= 1e-3
        elif isinstance(was, (int, float)) and isinstance(requested, (int, float)):
            as_requested = as_requested and abs(was - requested) <= 2e-4
        else:
            as_requested = as_requested and was == requested
    if not as_requested:
        raise RefusedEdit("the edited file does not give the camera the requested settings")
    return found


def _difference_text(name: str, written: CameraSettings, has: CameraSettings) -> str:
    there, here = (
        (*s.position, *s.quaternion) if name == "pose" else getattr(s, name) for s in (written, has)
    )
    return (
        f"{name} is {setting_text(there)} in the file and {setting_text(here)} in the env, so something else changes it: an argument of "
        "gym.make, a subclass, or code that runs later"
    )
