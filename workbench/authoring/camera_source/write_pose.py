"""A new pose in the form that the author used, as long as that form can say it.

``look_at`` stays one while the camera is level and does not look along `up`: the target stays where it is if
the camera still looks at it, else it moves on the new line of sight, as far away as it was. Otherwise the pose is
written with a quaternion. Upstream's ``look_at`` gives no unit quaternion straight down or up (its `left` is
the zero vector there), so those are never written with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import libcst as cst

from workbench.authoring.camera_source import rotations
from workbench.authoring.camera_source.changes import Changes, settled
from workbench.authoring.camera_source.definitions import Project
from workbench.authoring.camera_source.evaluate import MANISKILL_POSE, SAPIEN_POSE
from workbench.authoring.camera_source.number_text import list_text, quaternion_texts
from workbench.authoring.camera_source.read_camera import ANGLE_STEP
from workbench.authoring.camera_source.source_file import Replacement, SourceFile
from workbench.authoring.camera_source.values import Angles, Number, PoseValue, Vector
from workbench.core.camera_settings import CameraSettings

_STILL_AT_TARGET = 3e-5
_LEAST_DISTANCE = 0.1
_METRES = (4, 5, 6)
"""Decimals: 0.1 mm, and more where what is looked at is so close that 0.1 mm would turn the camera."""

Triple = tuple[float, float, float]


def write_pose(
    changes: Changes, project: Project, pose: PoseValue, after: CameraSettings, target: Triple | None
) -> None:
    """`target` is where the camera was aimed at, if somebody has said so."""
    if pose.form == "look_at":
        if _look_at(changes, pose, after, target):
            return
        _as_quaternion(changes, project, pose, after)
        return
    _position(changes, pose, "p", after.position)
    if rotations.angle_between(pose.quaternion, after.quaternion) <= ANGLE_STEP / 10:
        return
    part = pose.parts.get("q")
    if isinstance(part, Angles) and _euler(changes, part, after):
        return
    wanted = _same_side(after.quaternion, pose.quaternion)
    texts = quaternion_texts(wanted)
    if part is None:
        changes.added.setdefault(pose, []).append(f"q=[{', '.join(texts)}]")
    elif isinstance(part, Vector) and part.literal:
        for item, text in zip(part.items, texts, strict=True):
            if isinstance(item, Number) and abs(item.value - float(text)) > 1e-7:
                changes.texts[item] = text
    else:
        changes.texts[part] = f"[{', '.join(texts)}]"


def _position(
    changes: Changes, pose: PoseValue, name: str, wanted: Sequence[float], decimals: int = 4
) -> None:
    part = pose.parts.get(name)
    if isinstance(part, Vector):
        _vector(changes, part, wanted, decimals)
    elif max(abs(a - b) for a, b in zip(pose.position, wanted, strict=True)) > 0.5 * 10**-decimals:
        changes.added.setdefault(pose, []).append(f"{name}={list_text(wanted, decimals)}")


def _vector(changes: Changes, vector: Vector, wanted: Sequence[float], decimals: int) -> None:
    if vector.literal:
        for item, number in zip(vector.items, wanted, strict=True):
            assert isinstance(item, Number)
            changes.number(item, number, decimals)
    elif _settled(vector, wanted, decimals) != vector.numbers:
        text = list_text(wanted, decimals)
        code = vector.at.file.code(vector.at.node)
        changes.texts[vector] = text
        changes.note(f"`{code}` became {text}: it is no longer computed")


def _settled(vector: Vector, wanted: Sequence[float], decimals: int) -> Triple:
    """What `vector` will be when `wanted` has been written."""
    if vector.literal:
        x, y, z = (
            settled(item, number, decimals)
            for item, number in zip(vector.items, wanted, strict=True)
            if isinstance(item, Number)
        )
    else:
        x, y, z = vector.numbers
        if max(abs(a - b) for a, b in zip((x, y, z), wanted, strict=True)) > 0.5 * 10**-decimals:
            x, y, z = (round(number, decimals) for number in wanted)
    return x, y, z


def _look_at(changes: Changes, pose: PoseValue, after: CameraSettings, aim: Triple | None) -> bool:
    """Write eye and target, if a look_at can say where the camera looks."""
    eye, target = pose.parts["eye"], pose.parts["target"]
    assert isinstance(eye, Vector) and isinstance(target, Vector)
    up_part = pose.parts.get("up")
    up = up_part.numbers if isinstance(up_part, Vector) else (0.0, 0.0, 1.0)
    forward = rotations.matrix(after.quaternion)[:, 0].tolist()
    # As close to `up` as this, 0.1 mm of the target turns the picture.
    if abs(_cosine(forward, up)) > math.cos(1e-3):
        return False

    def error(a: Sequence[float], b: Sequence[float]) -> float:
        quaternion = rotations.look_at(a, b, up)
        if abs(sum(part * part for part in quaternion) - 1) > 1e-3:
            return math.inf
        return rotations.angle_between(quaternion, after.quaternion)

    for point in (aim, target.numbers):
        if point is None or error(after.position, point) > _STILL_AT_TARGET:
            continue
        for decimals in _METRES:
            rounded = _settled(eye, after.position, decimals), _settled(target, point, decimals)
            if error(*rounded) <= ANGLE_STEP:
                _vector(changes, eye, after.position, decimals)
                _vector(changes, target, point, decimals)
                return True
    distance = max(_LEAST_DISTANCE, math.dist(pose.position, target.numbers))
    for decimals in _METRES:
        from_eye = _settled(eye, after.position, decimals)
        wanted = [a + distance * b for a, b in zip(from_eye, forward, strict=True)]
        if error(from_eye, _settled(target, wanted, decimals)) <= ANGLE_STEP:
            _vector(changes, eye, after.position, decimals)
            _vector(changes, target, wanted, decimals)
            return True
    return False


def look_at_text(name: str, settings: CameraSettings, aim: Triple | None) -> str | None:
    """A new camera's pose as a call of `name`, which is a look_at; None if that cannot say it.

    Args:
        aim: the point that it looks at; else it is one a metre ahead.
    """
    forward = rotations.matrix(settings.quaternion)[:, 0]
    ahead = [float(x) for x in settings.position + forward]
    if abs(_cosine(forward.tolist(), (0.0, 0.0, 1.0))) > math.cos(1e-3):
        return None
    for target in (ahead,) if aim is None else (aim, ahead):
        for decimals in _METRES:
            eye, point = ([round(x, decimals) for x in numbers] for numbers in (settings.position, target))
            if rotations.angle_between(rotations.look_at(eye, point), settings.quaternion) <= ANGLE_STEP:
                return f"{name}(eye={list_text(eye, decimals)}, target={list_text(point, decimals)})"
    return None


def _as_quaternion(changes: Changes, project: Project, pose: PoseValue, after: CameraSettings) -> None:
    """A pose in place of a look_at, with the author's own expression for where the camera stands."""
    file, node = pose.at.file, pose.at.node
    assert isinstance(node, cst.Call)
    height = float(rotations.matrix(after.quaternion)[2, 0])
    if abs(height) > math.cos(1e-3):
        changes.note(
            f"the camera looks straight {'down' if height < 0 else 'up'}; look_at gives no valid rotation there (its "
            "quaternion is not of unit length), so the pose is written with a quaternion"
        )
    else:
        changes.note(
            "the camera is turned about its own line of sight, which look_at cannot say, so the pose is written with "
            "a quaternion"
        )
    eye = pose.parts["eye"]
    assert isinstance(eye, Vector)
    _vector(changes, eye, after.position, 4)
    call = pose_call(changes, project, file)
    quaternion = f"[{', '.join(quaternion_texts(_same_side(after.quaternion, (1, 0, 0, 0))))}]"
    shared = any(read.others is not None for read in pose.at.reads)
    if len(node.args) == 2 and not shared:
        # Word by word, so that what the author remarked between the arguments stays.
        changes.replacements.append((file, Replacement(*file.span(node.func), call)))
        for index, arg in enumerate(node.args):
            name = ("eye", "target")[index] if arg.keyword is None else arg.keyword.value
            if arg.keyword is not None:
                new = "p" if name == "eye" else "q"
                changes.replacements.append((file, Replacement(*file.span(arg.keyword), new)))
            if name == "target":
                changes.replacements.append((file, Replacement(*file.span(arg.value), quaternion)))
        return
    position = changes.rendered(eye, len(pose.at.reads), file)
    for value in (eye, *eye.items):
        changes.texts.pop(value, None)
    changes.texts[pose] = f"{call}(p={position}, q={quaternion})"


def pose_call(changes: Changes, project: Project, file: SourceFile) -> str:
    """How `file` calls the class of poses. Imports sapien if it has none."""
    for name, bindings in project.bindings(file, file.module).items():
        dotted = bindings[-1].dotted
        if dotted is None:
            continue
        if f"{dotted}.Pose" in SAPIEN_POSE:
            return f"{name}.Pose"
        if dotted in SAPIEN_POSE:
            return name
        if dotted in MANISKILL_POSE:
            return f"{name}.create_from_pq"
    start = import_place(file)
    if not any(change.text == "import sapien\n" for _, change in changes.replacements):
        changes.replacements.append((file, Replacement(start, start, "import sapien\n")))
        changes.note("`import sapien` is added at the top of the file")
    return "sapien.Pose"


def import_place(file: SourceFile) -> int:
    """Where an import can be added: before the first one, after what has to come before any."""
    place = 0
    for index, statement in enumerate(file.module.body):
        small = statement.body[0] if isinstance(statement, cst.SimpleStatementLine) else None
        future = isinstance(small, cst.ImportFrom) and file.code(small.module or small) == "__future__"
        text = isinstance(small, cst.Expr) and isinstance(
            small.value, (cst.SimpleString, cst.ConcatenatedString)
        )
        if isinstance(small, (cst.Import, cst.ImportFrom)) and not future:
            return file.line_start(file.line(statement))
        if future or (text and index == 0):
            end = file.inner_span(statement)[1]
            place = (
                file.line_start(file.line_at(end) + 1) if file.line_at(end) < file.lines else len(file.text)
            )
        elif index == 0:
            # Above it may be lines that have to be the first: an interpreter's, an encoding's.
            decorators = getattr(statement, "decorators", ())
            place = file.line_start(file.line(decorators[0] if decorators else statement))
    return place


def _euler(changes: Changes, angles: Angles, after: CameraSettings) -> bool:
    old = [item.value for item in angles.items]
    wanted = rotations.to_euler(after.quaternion, old)
    for decimals in (4, 5, 6):
        found = [settled(item, w, decimals) for item, w in zip(angles.items, wanted, strict=True)]
        if rotations.angle_between(rotations.from_euler(*found), after.quaternion) <= ANGLE_STEP:
            for item, w in zip(angles.items, wanted, strict=True):
                changes.number(item, w, decimals)
            return True
    return False


def _same_side(quaternion: Sequence[float], old: Sequence[float]) -> rotations.Quaternion:
    """Of the two quaternions of one orientation the one that resembles what stood there."""
    w, x, y, z = rotations.unit(quaternion)
    if sum(a * b for a, b in zip((w, x, y, z), old, strict=True)) < 0:
        return -w, -x, -y, -z
    return w, x, y, z


def _cosine(a: Sequence[float], b: Sequence[float]) -> float:
    length = math.hypot(*a) * math.hypot(*b)
    return sum(x * y for x, y in zip(a, b, strict=True)) / length if length else 0.0
