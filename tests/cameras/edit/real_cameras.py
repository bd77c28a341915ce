"""Ground truth for these tests: ManiSkill's own cameras, built by running a source text."""

from __future__ import annotations

import io
import math
import sys
import tokenize
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import PurePath
from typing import Any

import numpy as np
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils

from workbench.cameras.edit.hook_cameras import HOOKS as KINDS
from workbench.cameras.edit.hook_cameras import HookCameras, RunHooks
from workbench.cameras.edit.run_hooks import hook_camera, owners, recording_calls
from workbench.envs.camera_data import CameraKey, CameraSettings
from workbench.envs.maniskill_private import parse_cameras
from workbench.source.parsed import RefusedEdit
from workbench.task.write_edits import SourceEdit

FILE = "/author/task.py"
HEADER = """\
import math

import numpy as np
import sapien
import torch
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs import Pose
from transforms3d.euler import euler2quat


class Base:
    robot_uids = "panda"
    camera_link = None


"""
HOOKS = ("_default_sensor_configs", "_default_human_render_camera_configs", "_sensor_configs")


def unit(quaternion: Sequence[float]) -> tuple[float, float, float, float]:
    w, x, y, z = (float(part) / math.hypot(*quaternion) for part in quaternion)
    return w, x, y, z


def planned(plan: Callable[..., SourceEdit], *given: object) -> SourceEdit | RefusedEdit:
    """Return the result of a plan."""
    try:
        return plan(*given)
    except RefusedEdit as refused:
        return refused


@contextmanager
def modules(sources: Mapping[str, str], **names: Any) -> Iterator[dict[str, Any]]:
    """Execute the sources as modules, with `names` defined in the first."""
    loaded = {PurePath(path).stem: types.ModuleType(PurePath(path).stem) for path in sources}
    for path in sources:
        loaded[PurePath(path).stem].__file__ = path
    before = {name: sys.modules.get(name) for name in loaded}
    vars(loaded[PurePath(FILE).stem]).update(names)
    try:
        for path in sorted(sources, key=lambda path: path == FILE):
            name = PurePath(path).stem
            sys.modules[name] = loaded[name]
            exec(compile(sources[path].removeprefix("\ufeff"), path, "exec"), vars(loaded[name]))
        yield vars(loaded[PurePath(FILE).stem])
    finally:
        for name, module in before.items():
            if module is None:
                sys.modules.pop(name, None)
            else:
                sys.modules[name] = module


def real_configs(sources: Mapping[str, str], class_name: str = "Task") -> dict[tuple[str, str], CameraConfig]:
    """Return every camera of the class by hook and name, built by the class's own code."""
    with modules(sources) as names:
        task = names[class_name]()
        return {
            (hook, name): config
            for hook in HOOKS
            if hasattr(task, hook)
            for name, config in parse_cameras(getattr(task, hook)).items()
        }


def run_class(sources: Mapping[str, str], class_name: str = "Task") -> HookCameras:
    """Run the hooks of an object of the class from these sources, as a worker does with an env's hooks."""
    try:
        with recording_calls(sources) as recorded, modules(sources) as names:
            cls = names[class_name]
            task = cls.__new__(cls) if issubclass(cls, BaseEnv) else cls()
            configs: dict[CameraKey, CameraConfig] = {
                (KINDS[hook], name): config
                for hook in (() if issubclass(cls, BaseEnv) else HOOKS)
                if hasattr(task, hook)
                for name, config in parse_cameras(getattr(task, hook)).items()
            }
            return HookCameras(
                {key: hook_camera(config, recorded) for key, config in configs.items()}, owners(cls)
            )
    except (SyntaxError, NameError, TypeError, AttributeError) as error:
        raise RefusedEdit(f"with it the file fails: {error}") from error


def run_as(class_name: str) -> RunHooks:
    return lambda sources: run_class(sources, class_name)


def looking(eye: Sequence[float], target: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the orientation of ManiSkill's own look_at, normalized."""
    return unit(sapien_utils.look_at(list(eye), list(target)).raw_pose[0, 3:].tolist())


def settings_of(config: CameraConfig) -> CameraSettings:
    pose = config.pose.raw_pose[0].double().tolist()
    intrinsic = None
    if config.intrinsic is not None:
        rows = np.array(config.intrinsic, float).tolist()
        intrinsic = (tuple(rows[0]), tuple(rows[1]), tuple(rows[2]))
    return CameraSettings(
        position=(pose[0], pose[1], pose[2]),
        quaternion=unit(pose[3:]),
        fov=None if config.fov is None else float(config.fov),
        intrinsic=intrinsic,
        width=config.width,
        height=config.height,
        near=float(config.near),
        far=float(config.far),
        shader_pack=str(config.shader_pack),
    )


def real_settings(
    sources: Mapping[str, str], uid: str, hook: str | None = None, class_name: str = "Task"
) -> CameraSettings:
    found = [
        config
        for (in_hook, name), config in real_configs(sources, class_name).items()
        if name == uid and hook in (None, in_hook)
    ]
    assert len(found) == 1, (uid, found)
    return settings_of(found[0])


def close(a: CameraSettings, b: CameraSettings, tolerance: float = 1e-6) -> bool:
    """Return whether both are equal up to single precision; q and -q are the same orientation."""
    sign = 1 if sum(x * y for x, y in zip(a.quaternion, b.quaternion, strict=True)) >= 0 else -1
    apart = [x - y for x, y in zip(a.position, b.position, strict=True)]
    apart += [x - sign * y for x, y in zip(a.quaternion, b.quaternion, strict=True)]
    if a.fov is not None and b.fov is not None:
        apart.append(a.fov - b.fov)
    if a.intrinsic is not None and b.intrinsic is not None:
        apart += (np.array(a.intrinsic) - np.array(b.intrinsic)).ravel().tolist()
    apart += [a.near - b.near, a.far - b.far]
    same = (a.width, a.height, a.shader_pack, a.fov is None, a.intrinsic is None)
    return max(map(abs, apart)) <= tolerance and same == (
        b.width,
        b.height,
        b.shader_pack,
        b.fov is None,
        b.intrinsic is None,
    )


def comments(text: str) -> list[str]:
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return [token.string for token in tokens if token.type == tokenize.COMMENT]
