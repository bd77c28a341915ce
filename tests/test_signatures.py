"""Each replacement of a ManiSkill or SAPIEN function accepts the original's parameters."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import mani_skill.envs  # noqa: F401  imports all modules that are replaced in
import pytest
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.scene import ManiSkillScene

import workbench
from tests.drive.envs import PUSH_CUBE, batched
from workbench.checks.evidence.builds import noting_builds, noting_poses
from workbench.envs.assets import refuse_downloads
from workbench.envs.cpu_scene import BatchedCpuScene
from workbench.envs.maniskill_private import mark_camera_configs, noting_cameras

OURS = str(Path(workbench.__file__).parent)
Parameters = dict[str, inspect.Parameter]
_VAR = {inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD}


@pytest.fixture(scope="module")
def replaced() -> Iterator[dict[str, tuple[Callable[..., Any], Callable[..., Any]]]]:
    """Our and the original function, by name, with every replacement active."""
    env: Any = batched(PUSH_CUBE, 2)
    mark_camera_configs()
    with ExitStack() as stack:
        for within in (noting_builds([], [], ()), noting_poses([], ()), refuse_downloads("PushCube")):
            stack.enter_context(within)
        stack.enter_context(noting_cameras(lambda config, frame: None))
        yield dict(_replaced())
    env.close()


def _replaced() -> Iterator[tuple[str, tuple[Callable[..., Any], Callable[..., Any]]]]:
    modules = [m for name, m in sorted(sys.modules.items()) if name.split(".")[0] in ("mani_skill", "sapien")]
    owners: dict[int, Any] = {id(module): module for module in modules}
    owners |= {
        id(value): value for module in modules for value in vars(module).values() if isinstance(value, type)
    }
    for owner in owners.values():
        for name, member in list(vars(owner).items()):
            for suffix, function in _functions(member).items():
                code = getattr(function, "__code__", None)
                if code is not None and code.co_filename.startswith(OURS):
                    called = f"{owner.__name__.rpartition('.')[2]}.{name}{suffix}"
                    original = getattr(function, "__wrapped__", None)
                    assert original is not None, f"{called} has no __wrapped__"
                    yield called, (function, original)


def _functions(member: Any) -> dict[str, Any]:
    """The functions behind a member, such as a property's getter and setter, by name suffix."""
    if isinstance(member, property):
        return {"": member.fget, " = ...": member.fset}
    return {"()": getattr(member, "__func__", member)}


def test_each_replacement_accepts_the_originals_parameters(replaced: Any) -> None:
    known = {"Articulation.merge()", "Actor.pose = ...", "Entity.set_pose()", "download_asset.download()"}
    assert known <= replaced.keys() and len(replaced) > 60, "the search finds too little"
    called = {name: both for name, both in replaced.items() if name.endswith("()")}
    wrong = {name: problem for name, both in called.items() if (problem := _refuses(*both))}
    assert wrong == {}


@pytest.mark.parametrize("base", [ManiSkillScene, BaseEnv], ids=lambda base: base.__name__)
def test_each_override_of_a_maniskill_method_accepts_its_parameters(base: type) -> None:
    env: Any = batched(PUSH_CUBE, 1)
    cls = type(env.scene) if base is ManiSkillScene else type(env)
    assert issubclass(cls, base) and (base is BaseEnv or cls is BatchedCpuScene)
    wrong = {}
    for owner in cls.__mro__:
        if not owner.__module__.startswith("workbench."):
            continue
        for name, member in vars(owner).items():
            theirs = getattr(base, name, None)
            if inspect.isfunction(member) and inspect.isfunction(theirs) and name != "__init__":
                wrong |= {name: problem} if (problem := _refuses(member, theirs)) else {}
    env.close()
    assert wrong == {}


def _parameters(function: Callable[..., Any]) -> Parameters:
    return dict(inspect.signature(function, follow_wrapped=False).parameters)


def _refuses(ours: Callable[..., Any], theirs: Callable[..., Any]) -> str:
    """What `theirs` accepts and `ours` does not; empty if nothing, or if SAPIEN has no signature."""
    try:
        theirs_of = _parameters(theirs)
    except ValueError:
        return ""
    return _differences(_parameters(ours), theirs_of)


def _differences(ours: Parameters, theirs: Parameters) -> str:
    kinds = {each.kind for each in ours.values()}
    by_position = [
        each for each in ours.values() if each.kind not in _VAR and each.kind is not each.KEYWORD_ONLY
    ]
    wrong = []
    positions = 0
    for name, each in theirs.items():
        if each.kind in _VAR:
            wrong += [] if each.kind in kinds else [f"takes no {each}"]
            continue
        own = ours.get(name)
        named = own is not None or inspect.Parameter.VAR_KEYWORD in kinds
        if each.kind is not each.KEYWORD_ONLY:
            placed = positions < len(by_position) or inspect.Parameter.VAR_POSITIONAL in kinds
            if placed and own is None and positions < len(by_position):
                own = by_position[positions]
                named = named or positions == 0 or name == "self" or each.kind is each.POSITIONAL_ONLY
            positions += 1
            wrong += [] if placed else [f"takes no {name} by position"]
        wrong += [] if named else [f"takes no {name}="]
        optional = own is None or own.default is not own.empty or own.kind in _VAR
        wrong += [] if each.default is each.empty or optional else [f"wants {name}"]
    wanted = [e.name for e in ours.values() if e.kind not in _VAR and e.default is e.empty]
    wrong += [f"wants {name}" for name in wanted[len(theirs) :]]
    return ", ".join(wrong)
