"""What one ``CameraConfig(...)`` in the text says of its camera, field by field."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import libcst as cst

from workbench.authoring.camera_source import rotations
from workbench.authoring.camera_source.definitions import Project
from workbench.authoring.camera_source.evaluate import Branches, Evaluator, Unknown
from workbench.authoring.camera_source.find import CameraCall
from workbench.authoring.camera_source.values import Nothing, Number, PoseValue, Text, Value, Vector
from workbench.core.camera_settings import CameraSettings, Matrix3

FIELDS = ("pose", "fov", "intrinsic", "width", "height", "near", "far", "shader_pack")
DEFAULTS: dict[str, float | str | None] = {
    "fov": None,
    "intrinsic": None,
    "near": 0.01,
    "far": 100.0,
    "shader_pack": "minimal",
}
"""Of mani_skill 3.0.1's ``CameraConfig``."""

POSITION_STEP = 1e-4
"""0.1 mm: what is written."""
ANGLE_STEP = 1.745e-4
"""0.01 degree."""
_SAME_POSITION = 2e-6
_SAME_ANGLE = 2e-5
_SAME_NUMBER = 1e-5
_MOST_WAYS = 64


@dataclass(frozen=True, eq=False)
class ReadCamera:
    """The values of the arguments that are given; why, for those that cannot be read."""

    call: CameraCall
    values: dict[str, Value]
    unknown: dict[str, str]

    def settings(self, instead: CameraSettings) -> CameraSettings:
        """As the text has it; what cannot be read is taken from `instead`."""
        pose = self.values.get("pose")
        position, quaternion = instead.position, instead.quaternion
        if isinstance(pose, PoseValue) and not is_broken(pose):
            position, quaternion = pose.position, rotations.unit(pose.quaternion)
        intrinsic = self.field("intrinsic", instead.intrinsic)
        fov = self.field("fov", instead.fov)
        return CameraSettings(
            position=position,
            quaternion=quaternion,
            fov=fov if fov is None else float(fov),  # type: ignore[arg-type]
            intrinsic=intrinsic,  # type: ignore[arg-type]
            width=int(self.field("width", instead.width)),  # type: ignore[call-overload]
            height=int(self.field("height", instead.height)),  # type: ignore[call-overload]
            near=float(self.field("near", instead.near)),  # type: ignore[arg-type]
            far=float(self.field("far", instead.far)),  # type: ignore[arg-type]
            shader_pack=str(self.field("shader_pack", instead.shader_pack)),
        )

    def field(self, name: str, instead: object) -> object:
        """One field's plain value; `instead` where it cannot be read."""
        if name in self.unknown:
            return instead
        value = self.values.get(name)
        if value is None:
            return DEFAULTS[name]
        if isinstance(value, (Number, Text)):
            return value.value
        return matrix3(value) if isinstance(value, Vector) else None


def matrix3(vector: Vector) -> Matrix3:
    a, b, c, d, e, f, g, h, i = vector.numbers
    return (a, b, c), (d, e, f), (g, h, i)


def readings(project: Project, call: CameraCall) -> Iterator[ReadCamera]:
    """`call` read in every way that its branches allow."""
    waiting: list[dict[cst.CSTNode, int]] = [{}]
    for _ in range(_MOST_WAYS):
        if not waiting:
            return
        chosen = waiting.pop()
        try:
            yield _read(Evaluator(project, chosen), call)
        except Branches as fork:
            waiting += [{**chosen, fork.place: way} for way in reversed(range(fork.count))]


def _read(evaluator: Evaluator, call: CameraCall) -> ReadCamera:
    values: dict[str, Value] = {}
    unknown: dict[str, str] = {}
    for name in FIELDS:
        arg = call.arguments.get(name)
        if arg is None:
            if call.starred:
                unknown[name] = f"`{name}` is given by * or **"
            continue
        try:
            value = evaluator.value(call.file, arg.value)
            _check(name, value)
        except Unknown as exc:
            unknown[name] = str(exc)
        else:
            values[name] = value
    if "shader_config" in call.arguments:
        unknown["shader_pack"] = "`shader_config` is given"
    return ReadCamera(call, values, unknown)


def _check(name: str, value: Value) -> None:
    code = value.at.file.code(value.at.node)
    if isinstance(value, Nothing) and name in ("fov", "intrinsic"):
        return
    if name == "pose" and isinstance(value, PoseValue):
        return
    if name == "intrinsic" and isinstance(value, Vector):
        rows = [item for item in value.items if isinstance(item, Vector)]
        if len(rows) == len(value.items) == 3 and all(len(row.items) == 3 for row in rows):
            return
    if name == "shader_pack" and isinstance(value, Text):
        return
    if name in ("fov", "width", "height", "near", "far") and isinstance(value, Number):
        return
    raise Unknown(f"`{code}` is not a {name} that can be read")


def changed_fields(before: CameraSettings, after: CameraSettings) -> list[str]:
    found: list[str] = []
    if not same_pose(before, after):
        found.append("pose")
    for name in FIELDS[1:]:
        if not same_value(getattr(before, name), getattr(after, name)):
            found.append(name)
    return found


def same_pose(a: CameraSettings, b: CameraSettings) -> bool:
    return (
        max(abs(x - y) for x, y in zip(a.position, b.position, strict=True)) <= _SAME_POSITION
        and rotations.angle_between(a.quaternion, b.quaternion) <= _SAME_ANGLE
    )


def same_value(a: object, b: object) -> bool:
    if isinstance(a, (int, float)) and isinstance(b, (int, float)):
        return abs(a - b) <= _SAME_NUMBER * max(1.0, abs(a), abs(b))
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(same_value(x, y) for x, y in zip(a, b, strict=True))
    return a == b


def mismatch(read: ReadCamera, name: str, env: CameraSettings) -> str | None:
    """Why the text does not say of one field what the env has; None if it does."""
    if name in read.unknown:
        return read.unknown[name]
    if name == "pose":
        pose = read.values.get("pose")
        if pose is None:
            return "it is given no pose"
        assert isinstance(pose, PoseValue)
        if is_broken(pose):
            # Upstream's quaternion is none there, and what an env makes of it is not ours to say.
            near = max(abs(x - y) for x, y in zip(pose.position, env.position, strict=True))
            return None if near <= _SAME_POSITION else _differs("pose", pose.position, env.position)
        if not same_pose(read.settings(env), env):
            there = (*pose.position, *rotations.unit(pose.quaternion))
            return _differs("pose", there, (*env.position, *env.quaternion))
        return None
    written, has = read.field(name, None), getattr(env, name)
    return None if same_value(written, has) else _differs(name, written, has)


def is_broken(pose: PoseValue) -> bool:
    """True for a look_at straight along its `up`."""
    return abs(sum(x * x for x in pose.quaternion) - 1) > 1e-3 and pose.form == "look_at"


def _differs(name: str, written: object, has: object) -> str:
    def say(value: object) -> str:
        if isinstance(value, tuple):
            return "(" + ", ".join(say(item) for item in value) + ")"
        return f"{value:.5g}" if isinstance(value, float) else str(value)

    return (
        f"{name} is {say(written)} in the file and {say(has)} in the env, so something else changes it: an "
        "argument of gym.make, a class that inherits, or code that runs later"
    )
