"""The calls in the given files that make a camera's config, and which of them is the one meant."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import libcst as cst

from workbench.authoring.camera_source.definitions import LOOPS, Project
from workbench.authoring.camera_source.evaluate import Branches, Evaluator, Unknown
from workbench.authoring.camera_source.result import Refused
from workbench.authoring.camera_source.source_file import SourceFile
from workbench.authoring.camera_source.values import Text
from workbench.core.camera_settings import CallSite
from workbench.core.pictures import CameraKind

Parameter = Literal[
    "uid",
    "pose",
    "width",
    "height",
    "fov",
    "near",
    "far",
    "intrinsic",
    "entity_uid",
    "mount",
    "shader_pack",
    "shader_config",
    "min_depth",
]
PARAMETERS: tuple[Parameter, ...] = (
    "uid",
    "pose",
    "width",
    "height",
    "fov",
    "near",
    "far",
    "intrinsic",
    "entity_uid",
    "mount",
    "shader_pack",
    "shader_config",
)
"""Of mani_skill 3.0.1's ``CameraConfig``, in order."""

CLASSES = ("CameraConfig", "StereoDepthCameraConfig")
HOOKS: dict[str, CameraKind] = {
    "_default_sensor_configs": "sensor",
    "_sensor_configs": "sensor",
    "_default_human_render_camera_configs": "human",
}
_INSTALLED = re.compile(r"[\\/](site-packages|dist-packages)[\\/]")


@dataclass(frozen=True, eq=False)
class CameraCall:
    """One ``CameraConfig(...)`` in the text."""

    file: SourceFile
    node: cst.Call
    name: str | None
    """Under which ManiSkill knows the camera: the key of the dict that it stands in, else its uid. None where
    that is computed."""
    key: cst.BaseExpression | None
    """The key, where it stands in a dict."""
    arguments: dict[str, cst.Arg]
    """By parameter."""
    starred: bool
    """More arguments come by ``*`` or ``**``."""

    @property
    def line(self) -> int:
        return self.file.line(self.node)

    @property
    def where(self) -> str:
        return f"{self.file.name}, line {self.line}"

    @property
    def hook(self) -> str | None:
        """The hook of ManiSkill's that it is in."""
        names = [s.name.value for s in self.file.scopes(self.node) if isinstance(s, cst.FunctionDef)]
        return next((name for name in names if name in HOOKS), None)

    @property
    def loop(self) -> cst.CSTNode | None:
        """The loop that it is in, within its function."""
        for outer in self.file.ancestors(self.node):
            if isinstance(outer, LOOPS):
                return outer
            if isinstance(outer, (cst.FunctionDef, cst.Lambda, cst.Module)):
                return None
        return None


def camera_calls(project: Project, file: SourceFile) -> Iterator[CameraCall]:
    """In the order of the text."""
    names: set[str] = set(CLASSES)
    for node in file.nodes:
        if isinstance(node, cst.ImportAlias) and node.asname is not None and node.evaluated_name in CLASSES:
            names.add(node.evaluated_alias or "")
    for node in file.nodes:
        if not isinstance(node, cst.Call) or not isinstance(node.func, (cst.Name, cst.Attribute)):
            continue
        short = node.func.value if isinstance(node.func, cst.Name) else node.func.attr.value
        if short not in names:
            continue
        # From whichever library: some hand ManiSkill's class on. One in the author's own files is another.
        module, _, cls = (project.dotted(file, node.func) or "").rpartition(".")
        if cls not in CLASSES or project.module(module, file) is not None:
            continue
        yield _camera_call(project, file, node)


def _camera_call(project: Project, file: SourceFile, node: cst.Call) -> CameraCall:
    arguments: dict[str, cst.Arg] = {}
    starred = False
    for index, arg in enumerate(node.args):
        if arg.star:
            starred = True
        elif arg.keyword is not None:
            arguments[arg.keyword.value] = arg
        elif not starred and index < len(PARAMETERS):
            arguments[PARAMETERS[index]] = arg
    key: cst.BaseExpression | None = None
    name: str | None = None
    outer = file.parents[node]
    if isinstance(outer, cst.DictElement) and outer.value is node:
        key = outer.key
    elif isinstance(outer, cst.Arg) and outer.keyword is not None:
        call = file.parents[outer]
        if isinstance(call, cst.Call) and file.code(call.func) == "dict":
            key, name = outer.keyword, outer.keyword.value
    if name is None:
        named = key if key is not None else arguments["uid"].value if "uid" in arguments else None
        name = None if named is None else _text(project, file, named)
    return CameraCall(file, node, name, key, arguments, starred)


def _text(project: Project, file: SourceFile, node: cst.BaseExpression) -> str | None:
    try:
        value = Evaluator(project, {}).value(file, node)
    except (Unknown, Branches):
        return None
    return value.value if isinstance(value, Text) else None


def candidates(
    project: Project, uid: str, kind: CameraKind | None, site: CallSite | None
) -> list[CameraCall]:
    """The calls that may make this camera. Raises `Refused` where there is none."""
    if site is not None:
        return _at_site(project, uid, site)
    calls = [call for file in project.mentioning(uid) for call in camera_calls(project, file)]
    found = [call for call in calls if call.name == uid]
    if kind is not None:
        # A sensor and a camera for people may have the same name.
        found = [call for call in found if call.hook is None or HOOKS[call.hook] == kind]
    if not found:
        raise Refused(
            f"no CameraConfig(...) in your files has the name {uid!r} written out; it comes from the robot, from a "
            "class that yours inherits from, or its name is computed"
        )
    return found


def _at_site(project: Project, uid: str, site: CallSite) -> list[CameraCall]:
    check_own(site.file)
    if site.file not in project.texts:
        raise Refused(
            f"the camera {uid!r} is made in {site.file}, line {site.line}, which is not one of your files"
        )
    file = project.file(site.file)
    calls = [call for call in camera_calls(project, file) if call.name in (uid, None)]
    within = [call for call in calls if file.function(call.node) == site.function]
    found = [call for call in within if _covers(call, site.line)]
    if not found:
        # Remarks above it move a line without a reload, and the env still says where it was.
        found = [call for call in within if call.name == uid]
    if not found:
        found = [call for call in calls if _covers(call, site.line)]
    if not found:
        raise Refused(
            f"line {site.line} of {file.name} made the camera {uid!r}, but there is no CameraConfig(...) for it as "
            "the file stands: it is made in a function or class of its own, or the file was edited since"
        )
    named = [call for call in found if call.name == uid]
    return named or found


def _covers(call: CameraCall, line: int) -> bool:
    start, end = call.file.inner_span(call.node)
    return call.file.line_at(start) <= line <= call.file.line_at(end)


def check_own(path: str) -> None:
    """Raises `Refused` for a file of an installed package: the next installation would take the change away."""
    if _INSTALLED.search(path):
        raise Refused(
            f"{path} belongs to an installed package; copy the task into a folder of your own first"
        )
