"""The cameras that a text of the author's files makes, as a worker tells of them, and the calls that make them."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import PurePath

from workbench.authoring.source.names import Project
from workbench.authoring.source.text import LOOPS, Refused, SourceFile, arguments
from workbench.authoring.source.trace import Trace
from workbench.core.camera_settings import CallSite, CameraKey, CameraSettings, differences
from workbench.core.pictures import CameraKind

FIELDS = ("pose", "fov", "intrinsic", "width", "height", "near", "far", "shader_pack")
PARAMETERS = (
    *("uid", "pose", "width", "height", "fov", "near", "far", "intrinsic", "entity_uid", "mount"),
    *("shader_pack", "shader_config"),
)
"""Of mani_skill 3.0.1's ``CameraConfig``, in order."""
HOOKS: dict[str, CameraKind] = {
    "_default_sensor_configs": "sensor",
    "_sensor_configs": "sensor",
    "_default_human_render_camera_configs": "human",
}
_SAME = 1e-5
_INSTALLED = re.compile(r"[\\/](site-packages|dist-packages)[\\/]")


@dataclass(frozen=True, eq=False)
class CameraRun:
    """One camera, as its hook gave it."""

    made: CameraSettings | None
    """As the call made it; None where it was not noted, or cannot be said in these words."""
    settings: CameraSettings | None
    """As the hook gave it in the end."""
    mount: str
    """What it rides on, in words that differ for different things."""
    site: CallSite | None
    trace: Trace | None
    """Of the call; None where that stands in none of the author's files."""


@dataclass(frozen=True, eq=False)
class Ran:
    """What the camera hooks of the open task gave, with a text of the author's files."""

    cameras: Mapping[CameraKey, CameraRun]
    owners: Mapping[str, tuple[str, str]]
    """Hook of the task's class to the name and the file of the class that has it; ManiSkill's empty ones are left out."""


Run = Callable[[Mapping[str, str]], Ran]
"""Runs the hooks with these texts in place of the author's files, by path. Raises Refused with the reason."""


@dataclass(frozen=True, eq=False)
class CameraCall:
    """The ``CameraConfig(...)`` in the text that made a camera."""

    file: SourceFile
    node: ast.Call
    name: str
    function: str
    arguments: dict[str, ast.expr]
    run: CameraRun
    trace: Trace

    @property
    def where(self) -> str:
        return f"{self.file.name}, line {self.file.line(self.node)}"

    @property
    def hook(self) -> str | None:
        """The hook of ManiSkill's that it is in."""
        return next((name for name in reversed(self.function.split(".")) if name in HOOKS), None)

    @property
    def key(self) -> ast.expr | ast.keyword | None:
        """The key, where it stands in a dict."""
        outer = self.file.parents[self.node]
        if isinstance(outer, ast.Dict):
            return outer.keys[outer.values.index(self.node)]
        call = self.container
        of_dict = isinstance(call, ast.Call) and self.file.code(call.func) == "dict"
        return outer if isinstance(outer, ast.keyword) and of_dict else None

    @property
    def container(self) -> ast.AST:
        """What it stands in."""
        outer = self.file.parents[self.node]
        return self.file.parents[outer] if isinstance(outer, ast.keyword) else outer

    @property
    def loop(self) -> ast.AST | None:
        """The loop that it is in, within its function."""
        scope = self.file.scopes(self.node)[0]
        outers = self.file.ancestors(self.node)
        return next((o for o in outers if isinstance(o, LOOPS) and scope in self.file.ancestors(o)), None)


def run_first(sources: Mapping[str, str], run: Run) -> tuple[Project, Ran]:
    """The files, each of which can be read, and what they make as they stand. Raises Refused."""
    project = Project(sources)
    for path in sources:
        project.file(path)
    return project, run(sources)


def camera_call(project: Project, ran: Ran, key: CameraKey) -> CameraCall:
    """Raises Refused where the call is not to be found in the author's files."""
    uid = key[1]
    if key not in ran.cameras:
        raise Refused(
            f"as the files stand they make no {key[0]} camera {uid!r}: another makes it, or they were edited since"
        )
    run = ran.cameras[key]
    if run.site is not None:
        check_own(run.site.file)
    if run.trace is None:
        if run.site is None:
            raise Refused(f"what makes the camera {uid!r} is no CameraConfig(...) in your files")
        if run.site.file not in project.texts:
            raise Refused(
                f"the camera {uid!r} is made in {run.site.file}, line {run.site.line}, which is not one of your files"
            )
        raise Refused(
            f"line {run.site.line} of {PurePath(run.site.file).name} made the camera {uid!r}, but there is no "
            "CameraConfig(...) for it: it is made in a function or class of its own"
        )
    file = project.given(run.trace.at.file)
    node = file.expression((run.trace.at.start, run.trace.at.end))
    if not isinstance(node, ast.Call):
        raise Refused(f"what makes the camera {uid!r} is no call")
    return CameraCall(file, node, uid, run.trace.function, arguments(node, PARAMETERS), run, run.trace)


def check_own(path: str) -> None:
    """Raises `Refused` for a file of an installed package: the next installation would take the change away."""
    if _INSTALLED.search(path):
        raise Refused(
            f"{path} belongs to an installed package; copy the task into a folder of your own first"
        )


def changed_fields(a: CameraSettings, b: CameraSettings) -> list[str]:
    """Which of `FIELDS` are not the same."""
    apart = differences(a, b, _SAME)
    return [
        name
        for name in FIELDS
        if name in apart or (name == "pose" and {"position", "orientation"} & set(apart))
    ]


def with_fields(settings: CameraSettings, other: CameraSettings, names: list[str]) -> CameraSettings:
    """`settings` with those fields from `other`."""
    fields = [f for name in names for f in (("position", "quaternion") if name == "pose" else (name,))]
    return replace(settings, **{name: getattr(other, name) for name in fields})


def check_others(
    before: Ran, after: Ran, key: CameraKey | None, expected: CameraKey | None
) -> CameraSettings | None:
    """The proof of an edit: it leaves all cameras as they were but `key`, in whose place there is `expected`.

    Returns:
        what `expected` came out as.

    Raises:
        Refused: another camera is changed, or there is another one more or less.
    """
    for other in before.cameras.keys() - {key}:
        old, new = before.cameras[other], after.cameras.get(other)
        if new is None or new.mount != old.mount or (old.settings is None) != (new.settings is None):
            raise Refused(f"the change would be one of the camera {other[1]} as well")
        if old.settings is not None and new.settings is not None and differences(old.settings, new.settings):
            raise Refused(f"the change would be one of the camera {other[1]} as well")
    wanted = before.cameras.keys() - {key} | ({expected} if expected is not None else set())
    if after.cameras.keys() != wanted:
        raise Refused("the file could not be changed without changing what else it does")
    if expected is None:
        return None
    found = after.cameras[expected]
    if key is not None and key in before.cameras and found.mount != before.cameras[key].mount:
        raise Refused("the change would put the camera on another mount")
    return found.settings
