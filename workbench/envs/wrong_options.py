"""Finds the keyword argument (``--env``) that ManiSkill refused: one with an unknown name or an unknown value."""

from __future__ import annotations

import dataclasses
import difflib
import os
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from traceback import walk_tb
from typing import Any

from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.render import PREBUILT_SHADER_CONFIGS
from mani_skill.sensors.camera import CameraConfig, update_camera_configs_from_dict
from mani_skill.utils.structs.types import SimConfig

from workbench.envs.error_notes import CoreRefusal, chain_of
from workbench.envs.keywords import parameters_of
from workbench.machine.library_files import is_installed

_CAMERAS = ("sensor_configs", "human_render_camera_configs", "viewer_camera_configs")
_OBS_PARTS = (
    *("state", "state_dict", "none", "sensor_data", "pointcloud"),
    *("rgb", "depth", "segmentation", "position", "normal", "albedo"),
)
_CORE_FOLDER = f"{Path(__file__).parent}{os.sep}"
"""The folder of the core, which wraps constructors."""
_MAX_NAMES = 12
"""Maximum number of names that a message lists if no name is similar."""


class WrongOption(CoreRefusal, ValueError):
    """ManiSkill refused a keyword argument from the caller. The task's code is not at fault."""


def wrong_option(task: type[BaseEnv], given: Mapping[str, Any], error: BaseException) -> WrongOption | None:
    """Error for the argument in `given` that does not exist or has an unknown value; None if `error` is not
    ManiSkill's own, or every argument is known.

    Args:
        given: the user's arguments, without those of the registration.
    """
    first = [*chain_of(error)][-1]
    frames = [frame for frame, _ in walk_tb(first.__traceback__)]
    if isinstance(first, CoreRefusal) or not frames:
        return None
    raised_in = frames[-1].f_code
    if isinstance(first, TypeError) and (
        raised_in.co_name == "__init__" or raised_in.co_filename.startswith(_CORE_FOLDER)
    ):
        # Python raises for an unknown keyword in the frame that makes the call: a constructor, or the core.
        known, popped = {name for name, _ in parameters_of(task, object)}, _taken_by_name(task)
        for name in given:
            if name not in known and name not in popped:
                return WrongOption(
                    f"{task.__name__} takes no keyword argument {name!r}.{_instead(name, known)}"
                )
    if not is_installed(raised_in.co_filename):  # raised by the task's own code
        return None
    cameras = _local(first, update_camera_configs_from_dict, "camera_configs")
    agent = _local(first, BaseAgent.set_control_mode, "self")
    modes = agent.supported_control_modes if agent is not None else ()
    for name, value in given.items():
        for problem, wrong, names in _unknown(task, name, value, cameras, modes):
            return WrongOption(f"{problem}.{_instead(wrong, names)}")
    return None


def _taken_by_name(task: type[BaseEnv]) -> set[str]:
    """All strings in the code of the constructors: ``kwargs.pop("size")`` takes a keyword too."""
    codes = [getattr(vars(owner).get("__init__"), "__code__", None) for owner in task.__mro__]
    return {text for code in codes if code is not None for text in code.co_consts if isinstance(text, str)}


def _unknown(
    task: type[BaseEnv],
    name: str,
    value: Any,
    cameras: Collection[str] | None,
    control_modes: Collection[str],
) -> Iterator[tuple[str, str, Collection[str]]]:
    """For each problem: its text, the unknown name or value, and the known ones."""
    if name in _CAMERAS and isinstance(value, Mapping):
        yield from _unknown_of_cameras(name, value, cameras)
    elif name == "sim_config" and isinstance(value, Mapping):
        yield from _unknown_fields(name, value, SimConfig)
    elif name == "robot_uids":
        for uid in [value] if isinstance(value, str) else value if isinstance(value, tuple) else []:
            if isinstance(uid, str) and uid not in REGISTERED_AGENTS and uid != "none":
                yield _no_value(name, uid), uid, REGISTERED_AGENTS
    elif name == "control_mode" and control_modes and isinstance(value, str) and value not in control_modes:
        yield _no_value(name, value), value, control_modes
    elif name == "reward_mode" and isinstance(value, str) and value not in task.SUPPORTED_REWARD_MODES:
        yield _no_value(name, value), value, task.SUPPORTED_REWARD_MODES
    elif name == "obs_mode" and isinstance(value, str) and value not in task.SUPPORTED_OBS_MODES:
        own = [mode for mode in task.SUPPORTED_OBS_MODES if mode not in ("any_textures", *_OBS_PARTS)]
        for part in value.split("+"):
            if part not in _OBS_PARTS:
                yield _no_value(name, part), part, (*own, *_OBS_PARTS)


def _unknown_of_cameras(
    name: str, value: Mapping[str, Any], cameras: Collection[str] | None
) -> Iterator[tuple[str, str, Collection[str]]]:
    attributes = {field.name for field in dataclasses.fields(CameraConfig)}
    own, places = {}, [(name, value)]
    for key, of in value.items():
        if cameras is not None and key in cameras and isinstance(of, Mapping):
            places.append((f"{name}.{key}", of))
        else:
            own[key] = of
    places[0] = (name, own)
    for path, settings in places:
        for key, setting in settings.items():
            if key in attributes or key == "use_stereo_depth":
                if key == "shader_pack" and setting not in PREBUILT_SHADER_CONFIGS:
                    yield _no_value(f"{path}.{key}", setting), str(setting), PREBUILT_SHADER_CONFIGS
            elif cameras is not None:
                yield _no_key(path, key), key, cameras if isinstance(setting, Mapping) else attributes


def _unknown_fields(
    path: str, value: Mapping[str, Any], cls: type
) -> Iterator[tuple[str, str, Collection[str]]]:
    """Like `_unknown`, for the keys of nested dicts that the dataclass `cls` does not have."""
    fields = {field.name: field for field in dataclasses.fields(cls)}
    for key, inner in value.items():
        if key not in fields:
            yield _no_key(path, key), key, fields
        elif isinstance(inner, Mapping) and dataclasses.is_dataclass(kind := fields[key].type):
            yield from _unknown_fields(f"{path}.{key}", inner, kind)  # type: ignore[arg-type]


def _no_value(path: str, value: object) -> str:
    return f"{path}={value!r} does not exist"


def _no_key(path: str, key: str) -> str:
    return f"{path} takes no {key!r}"


def _instead(wrong: str, names: Collection[str]) -> str:
    near = difflib.get_close_matches(wrong, names, n=3, cutoff=0.6)
    if near:
        return f" Did you mean {' or '.join(near)}?"
    return (
        f" Choose from: {', '.join(sorted(names)[:_MAX_NAMES])}{', ...' if len(names) > _MAX_NAMES else ''}."
    )


def _local(error: BaseException, function: Any, name: str) -> Any:
    """A local variable of the innermost call of `function` on the traceback."""
    frames = [frame for frame, _ in walk_tb(error.__traceback__) if frame.f_code is function.__code__]
    return frames[-1].f_locals.get(name) if frames else None
