# pyright: reportArgumentType=false, reportOptionalMemberAccess=false, reportAttributeAccessIssue=false
"""Every private name of ManiSkill and SAPIEN that the core relies upon: an upgrade fails here first."""

from __future__ import annotations

import inspect
import re

import sapien
import sapien.physx as physx
from mani_skill.envs import sapien_env
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.articulation import Articulation

from workbench.core.simulation.cpu_system import BatchedCpuSystem


def test_every_call_that_maniskill_makes_on_the_gpu_system_exists_here() -> None:
    owners = (sapien_env.BaseEnv, ManiSkillScene, Actor, Articulation)
    sources = "".join(inspect.getsource(inspect.getmodule(owner)) for owner in owners)
    called = set()
    for part in sources.split("px.")[1:]:
        name = re.match(r"\w*", part).group()
        if name.startswith(("gpu_", "cuda_", "sync_")) and not name.endswith("_"):
            called.add(name)
    assert len(called) > 15, "the sources no longer look as expected"
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    system = BatchedCpuSystem([scene])
    system.gpu_init()
    missing = {name for name in called if not hasattr(system, name)}
    assert not missing
