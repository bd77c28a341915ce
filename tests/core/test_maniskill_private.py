# pyright: reportArgumentType=false, reportOptionalMemberAccess=false, reportAttributeAccessIssue=false
"""Every private name of ManiSkill and SAPIEN that the core relies upon: an upgrade fails here first."""

from __future__ import annotations

import inspect
import re

import pytest
import sapien
import sapien.physx as physx
from mani_skill.agents.controllers import pd_ee_pose
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosController
from mani_skill.agents.controllers.utils.kinematics import Kinematics
from mani_skill.envs import sapien_env
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from mani_skill.envs.utils.system.backend import CPU_SIM_BACKENDS, BackendInfo
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.articulation import Articulation
from mani_skill.utils.structs.articulation_joint import ArticulationJoint
from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct
from mani_skill.utils.structs.link import Link
from mani_skill.utils.structs.render_camera import RenderCamera
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

from workbench.core.env.cpu_scene import SIM_BACKEND
from workbench.core.simulation.cpu_system import BatchedCpuSystem


@pytest.mark.parametrize(
    ("owner", "name", "asks"),
    [
        (PhysxRigidBodyComponentStruct, "_body_data_index", "gpu_pose_index"),
        (Articulation, "_data_index", "gpu_index"),
        (ArticulationJoint, "_data_index", "gpu_index"),
    ],
)
def test_index_properties_ask_the_body(owner: type, name: str, asks: str) -> None:
    assert name in owner.__dict__
    source = inspect.getsource(inspect.getmodule(owner))
    assert asks in source


def test_bodies_name_the_tensor_that_holds_them_by_the_type_of_the_system() -> None:
    assert isinstance(PhysxRigidBodyComponentStruct.__dict__["_body_data"], property)
    for create in (Actor.create_from_entities, Link.create):
        assert "isinstance(scene.px, physx.PhysxGpuSystem)" in inspect.getsource(create)
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    assert isinstance(BatchedCpuSystem([scene]), physx.PhysxGpuSystem)
    assert type(BatchedCpuSystem([scene])) is BatchedCpuSystem


def test_the_scene_has_the_methods_that_are_overridden() -> None:
    for name in ("_sapien_add_camera", "_sapien_update_render", "_gpu_apply_all", "_gpu_fetch_all", "_setup"):
        assert callable(getattr(ManiSkillScene, name)), name
    assert "_needs_fetch" in inspect.getsource(ManiSkillScene._gpu_apply_all)
    assert "camera_group" in RenderCamera.__dataclass_fields__
    assert "_render_cameras" in RenderCamera.__dataclass_fields__


def test_the_env_refuses_several_cpu_envs_by_the_name_of_the_backend() -> None:
    init = inspect.getsource(sapien_env.BaseEnv.__init__)
    assert "self.backend.sim_backend in CPU_SIM_BACKENDS and num_envs > 1" in init
    assert SIM_BACKEND not in CPU_SIM_BACKENDS
    assert "sim_backend" in BackendInfo.__dataclass_fields__


def test_the_env_applies_drive_targets_where_its_sim_device_is_cuda() -> None:
    step = inspect.getsource(sapien_env.BaseEnv._step_action)
    assert "self._sim_device.is_cuda()" in step
    assert "gpu_apply_articulation_target_position" in step


def test_the_env_builds_its_scene_and_seeds_where_the_core_does() -> None:
    for name in ("_setup_scene", "_set_scene_config", "_set_episode_rng"):
        assert callable(getattr(sapien_env.BaseEnv, name)), name
    source = inspect.getsource(sapien_env.BaseEnv)
    for name in (
        "_episode_seed",
        "_batched_episode_rng",
        "_batched_rng_backend",
        "_episode_rng",
        "_sim_freq",
    ):
        assert name in source, name
    assert callable(BatchedRNG.from_seeds)


def test_end_effector_control_solves_by_device_and_aims_by_the_scene() -> None:
    assert 'self.device.type == "cuda"' in inspect.getsource(Kinematics.__init__)
    solve = inspect.getsource(Kinematics.compute_ik)
    assert "return None" in solve and "pose.sp" in solve  # what is done where no answer is found; one env
    # `maniskill_private._set_ee_action_of_each_env` repeats this for all envs: word for word as it was read.
    action = inspect.getsource(pd_ee_pose)
    for line in (
        "ik_via_target_pose = self.config.use_target or not self.scene.gpu_sim_enabled",
        "self._target_pose = self.compute_target_pose(prev_ee_pose_at_base, action)",
        "q0=self.articulation.get_qpos()",
        "self._target_qpos = self._start_qpos",
        "self._step_size = (self._target_qpos - self._start_qpos) / self._sim_steps",
    ):
        assert line in action, line


def test_one_wrapper_asks_for_a_gpu_by_asking_for_the_path() -> None:
    assert "not self.base_env.gpu_sim_enabled" in inspect.getsource(CPUGymWrapper.__init__)
    assert isinstance(sapien_env.BaseEnv.__dict__["gpu_sim_enabled"], property)


def test_cpu_systems_can_be_packed() -> None:
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    assert isinstance(scene.physx_system.pack(), bytes)
    assert isinstance(scene.pack_poses(), bytes)


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


def test_a_reset_resets_the_controllers_of_all_envs_and_then_asks_for_info() -> None:
    """What `partial_reset.KeptControllers` mends, and where it does: out of work once upstream keeps the mask."""
    source = inspect.getsource(sapien_env.BaseEnv.reset)
    everyone = source.index("self.scene._reset_mask = torch.ones(")
    controllers = source.index("self.agent.controller.reset()")
    assert everyone < controllers < source.index("info = self.get_info()")
    assert "self.scene._reset_mask" in inspect.getsource(PDJointPosController.reset)
