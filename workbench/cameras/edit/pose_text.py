"""Writes a new camera pose in the form that the author uses, if this form can express it."""

from __future__ import annotations

import ast
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from transforms3d.euler import euler2quat
from transforms3d.quaternions import mat2quat

from workbench.envs.camera_data import CameraSettings
from workbench.pictures.camera_conventions import angle_between, rotation_matrix, target_of
from workbench.source.parsed import Replacement, SourceFile, TracedValue
from workbench.source.traced_edits import Changes, list_text, quaternion_texts, same_side, written_value

POSITION_STEP_METRES = 1e-4
"""Precision of written positions: 0.1 mm."""
ANGLE_STEP_RADIANS = 1.745e-4
"""Precision of written angles: 0.01 degree."""
_SAPIEN_POSE = ("sapien.Pose", "sapien.core.Pose", "sapien.pysapien.Pose")
_MANISKILL_POSE = ("mani_skill.utils.structs.Pose", "mani_skill.utils.structs.pose.Pose")

_STILL_AT_TARGET = 3e-5
_MIN_DISTANCE_METRES = 0.1
_DECIMALS = (4, 5, 6)
"""Numbers of decimals to try for lengths in metres: 4 (0.1 mm), then more, since rounding to 0.1 mm rotates a
camera whose target is very close."""


def why_not_a_pose(changes: Changes, pose: TracedValue) -> str | None:
    """Reason why a pose cannot be edited in the form in which it is written; None if it can."""
    p, q = pose.parts.get("p"), pose.parts.get("q")
    if pose.function == "look_at":
        triples = [
            pose.parts.get("eye"),
            pose.parts.get("target"),
            pose.parts.get("up", pose.parts.get("eye")),
        ]
    elif pose.function == "pose":
        triples = [] if p is None or p.value is None else [p]
    else:
        return f"`{changes.one_line(pose.at)}` is computed when the task runs"
    if any(part is None or not _is_vector(part, 3) for part in triples):
        return f"`{changes.one_line(pose.at)}` is not a pose that can be read"
    if q is None or q.value is None or (not q.function and _is_vector(q, 4)):
        return None
    angles = [q.parts.get(name) for name in ("ai", "aj", "ak")]
    if q.function != "euler" or not all(
        part is not None and isinstance(part.value, float) for part in angles
    ):
        return f"`{changes.one_line(q.at)}` is computed when the task runs"
    axes = q.parts.get("axes")
    return (
        None
        if axes is None or axes.value == "sxyz"
        else f"`{changes.one_line(q.at)}` uses Euler axes other than sxyz"
    )


def _is_vector(part: TracedValue, length: int) -> bool:
    return isinstance(part.value, tuple) and len(part.value) == len(part.numbers) == length


def write_pose(changes: Changes, pose: TracedValue, after: CameraSettings) -> None:
    """Edit `pose` to the pose of `after`: in its written form if possible, else with a quaternion.

    A ``look_at`` remains a ``look_at`` if the camera is level and does not look along `up`. The target is
    kept if the camera still looks at it. Otherwise the target is put on the new line of sight, at the
    distance of `after`, or at the old distance if `after` has none. For a camera that looks straight down or
    up, ManiSkill's ``look_at`` returns no unit quaternion (its `left` is then the zero vector), so such a
    pose is written with a quaternion.
    """
    if pose.function == "look_at":
        if not _look_at(changes, pose, after):
            _as_quaternion(changes, pose, after)
        return
    write_pq(changes, pose, after.position, after.quaternion)


def write_pq(
    changes: Changes, pose: TracedValue, position: Sequence[float], quaternion: Sequence[float]
) -> None:
    """Edit a call of ``Pose`` to this position in metres and orientation wxyz."""
    _position(changes, pose, position)
    before = pose.numbers[3:]
    if angle_between(before, quaternion) <= ANGLE_STEP_RADIANS / 10:
        return
    part = pose.parts.get("q")
    if part is not None and part.function and _euler(changes, part, quaternion):
        return
    texts = quaternion_texts(same_side(quaternion, before))
    if part is None:
        changes.added.setdefault(pose, []).append(f"q=[{', '.join(texts)}]")
    elif part.literal and part.parts:
        for item, text in zip(part.parts.values(), texts, strict=True):
            if abs(item.numbers[0] - float(text)) > 1e-7:
                changes.texts[item] = text
    else:
        changes.texts[part] = f"[{', '.join(texts)}]"


def _position(changes: Changes, pose: TracedValue, requested: Sequence[float]) -> None:
    part = pose.parts.get("p")
    if part is not None and part.value is not None:
        _vector(changes, part, requested, 4)
    elif max(abs(a - b) for a, b in zip(pose.numbers, requested, strict=False)) > 0.5e-4:
        if part is None:
            changes.added.setdefault(pose, []).append(f"p={list_text(requested, 4)}")
        else:
            changes.texts[part] = list_text(requested, 4)


def _vector(changes: Changes, vector: TracedValue, requested: Sequence[float], decimals: int) -> None:
    if vector.literal:
        for item, number in zip(vector.parts.values(), requested, strict=True):
            changes.number(item, number, decimals)
    elif _written_values(vector, requested, decimals) != vector.numbers:
        text = list_text(requested, decimals)
        code = changes.code(vector.at)
        changes.texts[vector] = text
        changes.note(f"`{code}` became {text}: it is no longer computed")


def _written_values(vector: TracedValue, requested: Sequence[float], decimals: int) -> tuple[float, ...]:
    """The vector's numbers after `requested` is written with this many decimals."""
    if vector.literal:
        pairs = zip(vector.parts.values(), requested, strict=True)
        return tuple(written_value(item, number, decimals) for item, number in pairs)
    if max(abs(a - b) for a, b in zip(vector.numbers, requested, strict=True)) > 0.5 * 10**-decimals:
        return tuple(round(number, decimals) for number in requested)
    return vector.numbers


def _look_at(changes: Changes, pose: TracedValue, after: CameraSettings) -> bool:
    """Write eye and target; returns False if a look_at cannot express the orientation."""
    eye, target = pose.parts["eye"], pose.parts["target"]
    up = pose.parts["up"].numbers if "up" in pose.parts else (0.0, 0.0, 1.0)
    forward = rotation_matrix(after.quaternion)[:, 0].tolist()
    # If the line of sight is this close to `up`, moving the target by 0.1 mm rotates the picture.
    if abs(_cosine(forward, up)) > math.cos(1e-3):
        return False

    def error(a: Sequence[float], b: Sequence[float]) -> float:
        return _turned(look_at(a, b, up), after)

    still = error(after.position, target.numbers) <= _STILL_AT_TARGET
    for decimals in _DECIMALS if still else ():
        if error(_written_values(eye, after.position, decimals), target.numbers) <= ANGLE_STEP_RADIANS:
            _vector(changes, eye, after.position, decimals)
            return True
    distance = max(_MIN_DISTANCE_METRES, after.distance or math.dist(pose.numbers[:3], target.numbers))
    for decimals in _DECIMALS:
        from_eye = _written_values(eye, after.position, decimals)
        requested = [a + distance * b for a, b in zip(from_eye, forward, strict=True)]
        if error(from_eye, _written_values(target, requested, decimals)) <= ANGLE_STEP_RADIANS:
            _vector(changes, eye, after.position, decimals)
            _vector(changes, target, requested, decimals)
            return True
    return False


def look_at_text(name: str, settings: CameraSettings) -> str | None:
    """A new camera's pose as a call of the look_at function `name`; None if look_at cannot express it."""
    forward = rotation_matrix(settings.quaternion)[:, 0]
    if abs(_cosine(forward.tolist(), (0.0, 0.0, 1.0))) > math.cos(1e-3):
        return None
    for aimed in (settings, replace(settings, distance=None)):
        target = target_of(aimed).tolist()
        for decimals in _DECIMALS:
            eye, point = ([round(x, decimals) for x in numbers] for numbers in (settings.position, target))
            if _turned(look_at(eye, point), settings) <= ANGLE_STEP_RADIANS:
                return f"{name}(eye={list_text(eye, decimals)}, target={list_text(point, decimals)})"
    return None


def _as_quaternion(changes: Changes, pose: TracedValue, after: CameraSettings) -> None:
    """Replace a look_at with a pose that has a quaternion; keeps the author's expression for the position."""
    file, node = changes.find(pose.at)
    assert isinstance(node, ast.Call)
    height = float(rotation_matrix(after.quaternion)[2, 0])
    if abs(height) > math.cos(1e-3):
        changes.note(
            f"the camera looks straight {'down' if height < 0 else 'up'}; look_at gives no valid rotation there (its "
            "quaternion is not of unit length), so the pose is written with a quaternion"
        )
    else:
        changes.note(
            "the camera is turned about its own line of sight, which look_at cannot express, so the pose is written with "
            "a quaternion"
        )
    eye = pose.parts["eye"]
    _vector(changes, eye, after.position, 4)
    call = pose_call(changes, file)
    quaternion = f"[{', '.join(quaternion_texts(same_side(after.quaternion, (1, 0, 0, 0))))}]"
    shared = any(read.others is not None for read in pose.reads)
    if len(node.args) + len(node.keywords) == 2 and not shared:
        # Argument by argument, so that the author's comments between them are kept.
        changes.replace(file, node.func, call)
        for index, arg in enumerate((*node.args, *node.keywords)):
            name = ("eye", "target")[index] if isinstance(arg, ast.expr) else arg.arg
            if isinstance(arg, ast.keyword):
                start = file.inner_span(arg)[0]
                new = "p" if name == "eye" else "q"
                changes.change(file, Replacement(start, start + len(arg.arg or ""), new))
            if name == "target":
                changes.replace(file, arg.value if isinstance(arg, ast.keyword) else arg, quaternion)
        return
    position = changes.rendered(eye, len(pose.reads), file)
    for value in eye.walk():
        changes.texts.pop(value, None)
    changes.texts[pose] = f"{call}(p={position}, q={quaternion})"


def pose_call(changes: Changes, file: SourceFile) -> str:
    """The expression that `file` calls to make a pose, such as ``sapien.Pose``; adds ``import sapien`` if the
    file imports no pose class."""
    for name, bindings in changes.project.bindings(file, file.module).items():
        dotted = bindings[-1].dotted
        if f"{dotted}.Pose" in _SAPIEN_POSE:
            return f"{name}.Pose"
        if dotted in _SAPIEN_POSE:
            return name
        if dotted in _MANISKILL_POSE:
            return f"{name}.create_from_pq"
    changes.add_imports(file, {"sapien": "import sapien"})
    return "sapien.Pose"


def look_at(
    eye: Sequence[float], target: Sequence[float], up: Sequence[float] = (0, 0, 1)
) -> NDArray[np.float64] | None:
    """The orientation of ManiSkill's ``look_at`` as a quaternion (wxyz); None if the line of sight is along
    `up`, where ``look_at`` has no orientation."""
    # ManiSkill computes in float32, whose rounding rotates the picture if the eye is nearly above its target.
    seen = np.asarray(target, np.float32).astype(float), np.asarray(eye, np.float32).astype(float)
    forward, upward = np.subtract(*seen), np.asarray(up, float)
    left = np.cross(upward, forward)
    if np.linalg.norm(left) <= 1e-6 * np.linalg.norm(forward) * np.linalg.norm(upward):
        return None
    columns = (forward, left, np.cross(forward, left))
    return mat2quat(np.stack([column / np.linalg.norm(column) for column in columns], axis=-1))


def to_euler(quaternion: ArrayLike, near: Sequence[float]) -> tuple[float, float, float]:
    """Roll, pitch and yaw in radians for transforms3d's ``euler2quat``: the equivalent angles closest to `near`."""
    m = rotation_matrix(quaternion)
    level = math.hypot(m[0, 0], m[1, 0])
    if level > 1e-6:
        roll, pitch = math.atan2(m[2, 1], m[2, 2]), math.atan2(-m[2, 0], level)
        yaw = math.atan2(m[1, 0], m[0, 0])
        candidates = [(roll, pitch, yaw), (roll + math.pi, math.pi - pitch, yaw + math.pi)]
    else:
        # Gimbal lock: the camera looks along z, and only the sum or difference of roll and yaw is defined. Keep yaw.
        pitch = math.copysign(math.pi / 2, -m[2, 0])
        whole = math.atan2(m[0, 1], m[1, 1]) if pitch > 0 else math.atan2(-m[0, 1], m[1, 1])
        candidates = [(whole + near[2] if pitch > 0 else whole - near[2], pitch, near[2])]
    turned = [
        tuple(a - 2 * math.pi * round((a - b) / (2 * math.pi)) for a, b in zip(angles, near, strict=True))
        for angles in candidates
    ]
    best = min(turned, key=lambda angles: sum(abs(a - b) for a, b in zip(angles, near, strict=True)))
    return best[0], best[1], best[2]


def _euler(changes: Changes, part: TracedValue, quaternion: Sequence[float]) -> bool:
    items = [part.parts[name] for name in ("ai", "aj", "ak")]
    requested = to_euler(quaternion, [item.numbers[0] for item in items])
    for decimals in (4, 5, 6):
        roll, pitch, yaw = (
            written_value(item, w, decimals) for item, w in zip(items, requested, strict=True)
        )
        if angle_between(euler2quat(roll, pitch, yaw), quaternion) <= ANGLE_STEP_RADIANS:
            for item, w in zip(items, requested, strict=True):
                changes.number(item, w, decimals)
            return True
    return False


def _turned(quaternion: ArrayLike | None, requested: CameraSettings) -> float:
    """Angle in radians between `quaternion` and the orientation of `requested`; inf for None."""
    return math.inf if quaternion is None else angle_between(quaternion, requested.quaternion)


def _cosine(a: Sequence[float], b: Sequence[float]) -> float:
    length = math.hypot(*a) * math.hypot(*b)
    return sum(x * y for x, y in zip(a, b, strict=True)) / length if length else 0.0
