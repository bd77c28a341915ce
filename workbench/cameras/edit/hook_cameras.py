"""The cameras made by the author's camera hooks, as reported by a worker, and the calls that make them."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from workbench.envs.camera_data import CallSite, CameraKey, CameraKind, CameraSettings, differences
from workbench.source.parsed import LOOPS, SourceFile, Trace

FIELDS = ("pose", "fov", "intrinsic", "width", "height", "near", "far", "shader_pack")
PARAMETERS = (
    *("uid", "pose", "width", "height", "fov", "near", "far", "intrinsic", "entity_uid", "mount"),
    *("shader_pack", "shader_config"),
)
"""Parameters of mani_skill 3.0.1's ``CameraConfig``, in order."""
HOOKS: dict[str, CameraKind] = {
    "_default_sensor_configs": "sensor",
    "_sensor_configs": "sensor",
    "_default_human_render_camera_configs": "human",
}
_SAME = 1e-5


@dataclass(frozen=True, eq=False)
class HookCamera:
    """One camera that a hook made."""

    made: CameraSettings | None
    """Settings in the ``CameraConfig`` call; None if the call was not recorded, or if `CameraSettings` cannot
    describe them."""
    settings: CameraSettings | None
    """Settings of the config that the hook returned; None if `CameraSettings` cannot describe it."""
    mount: str
    """Text that identifies the body that the camera is mounted on."""
    site: CallSite | None
    trace: Trace | None
    """Trace of the call; None if the call is not in the author's files."""


@dataclass(frozen=True, eq=False)
class HookCameras:
    """The cameras that the hooks of the open task return for given texts of the author's files."""

    cameras: Mapping[CameraKey, HookCamera]
    owners: Mapping[str, tuple[str, str]]
    """Name and file of the class that defines each hook; ManiSkill's empty hooks are left out."""


RunHooks = Callable[[Mapping[str, str]], HookCameras]
"""Runs the hooks as if the author's files had these texts (path to text). Raises RefusedEdit with the reason
if that fails."""


@dataclass(frozen=True, eq=False)
class CameraCall:
    """The ``CameraConfig(...)`` call that made a camera."""

    file: SourceFile
    node: ast.Call
    camera: CameraKey
    arguments: dict[str, ast.expr]
    run: HookCamera
    trace: Trace

    @property
    def where(self) -> str:
        return f"{self.file.name}, line {self.file.line(self.node)}"

    @property
    def hook(self) -> str | None:
        """Name of ManiSkill's hook that contains the call; None if no hook does."""
        return next((name for name in reversed(self.trace.function.split(".")) if name in HOOKS), None)

    @property
    def key(self) -> ast.expr | ast.keyword | None:
        """The dict key or ``dict(...)`` keyword that has the call as its value; None if there is none."""
        outer = self.file.parents[self.node]
        if isinstance(outer, ast.Dict):
            return outer.keys[outer.values.index(self.node)]
        call = self.container
        of_dict = isinstance(call, ast.Call) and self.file.code(call.func) == "dict"
        return outer if isinstance(outer, ast.keyword) and of_dict else None

    @property
    def container(self) -> ast.AST:
        """The expression or statement that directly contains the call."""
        outer = self.file.parents[self.node]
        return self.file.parents[outer] if isinstance(outer, ast.keyword) else outer

    @property
    def loop(self) -> ast.AST | None:
        """The loop or comprehension around the call, in the call's own function; None if there is none."""
        scope = self.file.scopes(self.node)[0]
        outers = self.file.ancestors(self.node)
        return next((o for o in outers if isinstance(o, LOOPS) and scope in self.file.ancestors(o)), None)


def changed_fields(a: CameraSettings, b: CameraSettings) -> list[str]:
    """The names of `FIELDS` in which `a` and `b` differ."""
    apart = differences(a, b, _SAME)
    return [
        name
        for name in FIELDS
        if name in apart or (name == "pose" and {"position", "orientation"} & set(apart))
    ]


def with_fields(settings: CameraSettings, other: CameraSettings, names: list[str]) -> CameraSettings:
    """`settings`, with the fields `names` taken from `other`."""
    fields = [f for name in names for f in (("position", "quaternion") if name == "pose" else (name,))]
    return replace(settings, **{name: getattr(other, name) for name in fields})
