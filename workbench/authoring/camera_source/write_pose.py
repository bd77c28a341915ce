"""A new pose in the form that the author used, as long as that form can say it.

``look_at`` stays one while the camera is level and does not look along `up`: the target stays where it is if
the camera still looks at it, else it moves on the new line of sight, as far away as it was. Otherwise the pose is
written with a quaternion. Upstream's ``look_at`` gives no unit quaternion straight down or up (its `left` is
the zero vector there), so those are never written with it.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Sequence
from dataclasses import replace

from numpy.typing import ArrayLike
from transforms3d.euler import euler2quat

from workbench.authoring.source.changes import Changes, settled
from workbench.authoring.source.numbers import list_text, look_at, quaternion_texts, same_side, to_euler
from workbench.authoring.source.text import Replacement, SourceFile
from workbench.authoring.source.trace import Part
from workbench.core.camera_data import CameraSettings
from workbench.core.cameras.conventions import angle_between, rotation_matrix, target_of

POSITION_STEP = 1e-4
"""0.1 mm: what is written."""
ANGLE_STEP = 1.745e-4
"""0.01 degree."""
_SAPIEN_POSE = ("sapien.Pose", "sapien.core.Pose", "sapien.pysapien.Pose")
_MANISKILL_POSE = ("mani_skill.utils.structs.Pose", "mani_skill.utils.structs.pose.Pose")

_STILL_AT_TARGET = 3e-5
_LEAST_DISTANCE = 0.1
_METRES = (4, 5, 6)
"""Decimals: 0.1 mm, and more where what is looked at is so close that 0.1 mm would turn the camera."""


def why_not_a_pose(changes: Changes, pose: Part) -> str | None:
    """Why a pose cannot be written in the form that it has; None where it can."""
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
        return f"`{changes.short(pose.at)}` is computed when the task runs"
    if any(part is None or not _is_vector(part, 3) for part in triples):
        return f"`{changes.short(pose.at)}` is not a pose that can be read"
    if q is None or q.value is None or (not q.function and _is_vector(q, 4)):
        return None
    angles = [q.parts.get(name) for name in ("ai", "aj", "ak")]
    if q.function != "euler" or not all(
        part is not None and isinstance(part.value, float) for part in angles
    ):
        return f"`{changes.short(q.at)}` is computed when the task runs"
    axes = q.parts.get("axes")
    return (
        None if axes is None or axes.value == "sxyz" else f"`{changes.short(q.at)}` uses other axes than sxyz"
    )


def _is_vector(part: Part, length: int) -> bool:
    return isinstance(part.value, tuple) and len(part.value) == len(part.numbers) == length


def write_pose(changes: Changes, pose: Part, after: CameraSettings) -> None:
    """Change it in its form, or to one that can say where `after` stands."""
    if pose.function == "look_at":
        if not _look_at(changes, pose, after):
            _as_quaternion(changes, pose, after)
        return
    _position(changes, pose, after.position)
    quaternion = pose.numbers[3:]
    if angle_between(quaternion, after.quaternion) <= ANGLE_STEP / 10:
        return
    part = pose.parts.get("q")
    if part is not None and part.function and _euler(changes, part, after):
        return
    texts = quaternion_texts(same_side(after.quaternion, quaternion))
    if part is None:
        changes.added.setdefault(pose, []).append(f"q=[{', '.join(texts)}]")
    elif part.literal and part.parts:
        for item, text in zip(part.parts.values(), texts, strict=True):
            if abs(item.numbers[0] - float(text)) > 1e-7:
                changes.texts[item] = text
    else:
        changes.texts[part] = f"[{', '.join(texts)}]"


def _position(changes: Changes, pose: Part, wanted: Sequence[float]) -> None:
    part = pose.parts.get("p")
    if part is not None and part.value is not None:
        _vector(changes, part, wanted, 4)
    elif max(abs(a - b) for a, b in zip(pose.numbers, wanted, strict=False)) > 0.5e-4:
        if part is None:
            changes.added.setdefault(pose, []).append(f"p={list_text(wanted, 4)}")
        else:
            changes.texts[part] = list_text(wanted, 4)


def _vector(changes: Changes, vector: Part, wanted: Sequence[float], decimals: int) -> None:
    if vector.literal:
        for item, number in zip(vector.parts.values(), wanted, strict=True):
            changes.number(item, number, decimals)
    elif _settled(vector, wanted, decimals) != vector.numbers:
        text = list_text(wanted, decimals)
        code = changes.code(vector.at)
        changes.texts[vector] = text
        changes.note(f"`{code}` became {text}: it is no longer computed")


def _settled(vector: Part, wanted: Sequence[float], decimals: int) -> tuple[float, ...]:
    """What `vector` will be when `wanted` has been written."""
    if vector.literal:
        pairs = zip(vector.parts.values(), wanted, strict=True)
        return tuple(settled(item, number, decimals) for item, number in pairs)
    if max(abs(a - b) for a, b in zip(vector.numbers, wanted, strict=True)) > 0.5 * 10**-decimals:
        return tuple(round(number, decimals) for number in wanted)
    return vector.numbers


def _look_at(changes: Changes, pose: Part, after: CameraSettings) -> bool:
    """Write eye and target, if a look_at can say where the camera looks."""
    eye, target = pose.parts["eye"], pose.parts["target"]
    up = pose.parts["up"].numbers if "up" in pose.parts else (0.0, 0.0, 1.0)
    forward = rotation_matrix(after.quaternion)[:, 0].tolist()
    # As close to `up` as this, 0.1 mm of the target turns the picture.
    if abs(_cosine(forward, up)) > math.cos(1e-3):
        return False

    def error(a: Sequence[float], b: Sequence[float]) -> float:
        return _turned(look_at(a, b, up), after)

    still = error(after.position, target.numbers) <= _STILL_AT_TARGET
    for decimals in _METRES if still else ():
        if error(_settled(eye, after.position, decimals), target.numbers) <= ANGLE_STEP:
            _vector(changes, eye, after.position, decimals)
            return True
    distance = max(_LEAST_DISTANCE, math.dist(pose.numbers[:3], target.numbers))
    for decimals in _METRES:
        from_eye = _settled(eye, after.position, decimals)
        wanted = [a + distance * b for a, b in zip(from_eye, forward, strict=True)]
        if error(from_eye, _settled(target, wanted, decimals)) <= ANGLE_STEP:
            _vector(changes, eye, after.position, decimals)
            _vector(changes, target, wanted, decimals)
            return True
    return False


def look_at_text(name: str, settings: CameraSettings) -> str | None:
    """A new camera's pose as a call of `name`, which is a look_at; None if that cannot say it."""
    forward = rotation_matrix(settings.quaternion)[:, 0]
    if abs(_cosine(forward.tolist(), (0.0, 0.0, 1.0))) > math.cos(1e-3):
        return None
    for aimed in (settings, replace(settings, distance=None)):
        target = target_of(aimed).tolist()
        for decimals in _METRES:
            eye, point = ([round(x, decimals) for x in numbers] for numbers in (settings.position, target))
            if _turned(look_at(eye, point), settings) <= ANGLE_STEP:
                return f"{name}(eye={list_text(eye, decimals)}, target={list_text(point, decimals)})"
    return None


def _as_quaternion(changes: Changes, pose: Part, after: CameraSettings) -> None:
    """A pose in place of a look_at, with the author's own expression for where the camera stands."""
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
            "the camera is turned about its own line of sight, which look_at cannot say, so the pose is written with "
            "a quaternion"
        )
    eye = pose.parts["eye"]
    _vector(changes, eye, after.position, 4)
    call = pose_call(changes, file)
    quaternion = f"[{', '.join(quaternion_texts(same_side(after.quaternion, (1, 0, 0, 0))))}]"
    shared = any(read.others is not None for read in pose.reads)
    if len(node.args) + len(node.keywords) == 2 and not shared:
        # Word by word, so that what the author remarked between the arguments stays.
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
    """How `file` calls the class of poses. Imports sapien if it has none."""
    for name, bindings in changes.project.bindings(file, file.module).items():
        dotted = bindings[-1].dotted
        if f"{dotted}.Pose" in _SAPIEN_POSE:
            return f"{name}.Pose"
        if dotted in _SAPIEN_POSE:
            return name
        if dotted in _MANISKILL_POSE:
            return f"{name}.create_from_pq"
    changes.importing(file, {"sapien": "import sapien"})
    return "sapien.Pose"


def _euler(changes: Changes, part: Part, after: CameraSettings) -> bool:
    items = [part.parts[name] for name in ("ai", "aj", "ak")]
    wanted = to_euler(after.quaternion, [item.numbers[0] for item in items])
    for decimals in (4, 5, 6):
        roll, pitch, yaw = (settled(item, w, decimals) for item, w in zip(items, wanted, strict=True))
        if _turned(euler2quat(roll, pitch, yaw), after) <= ANGLE_STEP:
            for item, w in zip(items, wanted, strict=True):
                changes.number(item, w, decimals)
            return True
    return False


def _turned(quaternion: ArrayLike | None, wanted: CameraSettings) -> float:
    """Radians from an orientation, if there is one, to the wanted one."""
    return math.inf if quaternion is None else angle_between(quaternion, wanted.quaternion)


def _cosine(a: Sequence[float], b: Sequence[float]) -> float:
    length = math.hypot(*a) * math.hypot(*b)
    return sum(x * y for x, y in zip(a, b, strict=True)) / length if length else 0.0
