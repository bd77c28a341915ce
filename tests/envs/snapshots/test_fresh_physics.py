"""Renewed physics: an env gets a PhysX scene without history, and all references to its bodies stay valid."""

# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false

from __future__ import annotations

import gc
from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import sapien
import sapien.physx as physx
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.building import actors
from mani_skill.utils.structs.pose import Pose

from tests.drive.envs import PICK_CUBE, batched
from tests.envs.written import Written
from workbench.envs.maniskill_private import setting_only
from workbench.envs.snapshots.cpu_state import renew_physics
from workbench.envs.snapshots.snapshot import restore_snapshot, take_snapshot


def packs(env: BaseEnv) -> list[bytes]:
    return [system.pack() for system in env.scene.px.systems]


@pytest.mark.thorough
def test_a_restored_grasp_does_not_depend_on_earlier_contacts() -> None:
    env = batched(PICK_CUBE, 6)
    env.reset(seed=list(range(6)))
    state = env.get_state_dict()
    state["actors"]["cube"][:, :3] = env.agent.tcp.pose.p
    env.set_state_dict(state)
    rng = np.random.default_rng(0)

    def action(gripper: float) -> np.ndarray:
        values = rng.uniform(-1, 1, (6, 8)).astype(np.float32)
        values[:, -1] = gripper
        return values

    for _ in range(10):
        env.step(action(-1.0))
    snapshot, actions = take_snapshot(env), [action(-1.0) for _ in range(12)]

    def run(source: list[int]) -> list[list[bytes]]:
        restore_snapshot(env, snapshot, range(6), source)
        states = []
        for values in actions:
            env.step(values[source])
            states.append(packs(env))
        return states

    reference = run(list(range(6)))
    assert env.agent.is_grasping(env.cube).any(), "nothing is grasped, so the test would prove nothing"
    for trial in range(6):
        for _ in range(trial):
            env.step(action(1.0 if trial % 2 else -1.0))
        source = rng.permutation(6).tolist()
        assert run(source) == [[states[i] for i in source] for states in reference], trial
    env.close()


def test_only_the_systems_are_replaced() -> None:
    env = batched(PICK_CUBE, 3)
    env.reset(seed=[0, 1, 2])
    for _ in range(3):
        env.step(env.action_space.sample())
    px: Any = env.scene.px
    before, poses = packs(env), [scene.pack_poses() for scene in env.scene.sub_scenes]
    state, systems, timestep = env.get_state(), list(px.systems), px.timestep
    numbers = [[e.per_scene_id for e in scene.entities] for scene in env.scene.sub_scenes]
    assert renew_physics(env.scene, [0, 2]) == []
    assert [new is old for new, old in zip(px.systems, systems, strict=True)] == [False, True, False]
    assert packs(env) == before and [scene.pack_poses() for scene in env.scene.sub_scenes] == poses
    assert [[e.per_scene_id for e in scene.entities] for scene in env.scene.sub_scenes] == numbers
    env.scene._gpu_fetch_all()
    assert torch.equal(env.get_state(), state) and px.timestep == timestep
    assert [system.timestep for system in px.systems] == [timestep] * 3
    cube = env.cube._bodies[2]
    assert cube.entity.scene is env.scene.sub_scenes[2] is px.scenes[2]
    env.step(env.action_space.sample())
    env.close()


def test_the_timestep_is_kept() -> None:
    slow = batched(PICK_CUBE, 2, sim_config={"sim_freq": 60, "control_freq": 20})
    renew_physics(slow.scene, [1])
    assert [system.timestep for system in slow.scene.px.systems] == [pytest.approx(1 / 60)] * 2
    slow.close()


def test_the_envs_gravity_and_the_processs_default_are_kept() -> None:
    light = batched(PICK_CUBE, 1, sim_config={"scene_config": {"gravity": np.array([0.0, 0.0, -1.0])}})
    other = batched(PICK_CUBE, 1)
    renew_physics(light.scene, [0])
    assert light.scene.px.systems[0].config.gravity.tolist() == [0.0, 0.0, -1.0]
    assert np.allclose(physx.get_scene_config().gravity, other.scene.px.systems[0].config.gravity)
    light.close()
    other.close()


@pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")
def test_an_env_from_which_bodies_were_removed_keeps_its_scene_and_is_restored() -> None:
    env: Any = batched(Written, 3, obs_mode="none", reward_mode="none")
    env.reset(seed=0)
    with setting_only(env, [1]):
        env.lies.remove_from_scene()
    env.step(None)
    snapshot, systems = take_snapshot(env), list(env.scene.px.systems)
    before = env.falls.pose.raw_pose.clone()
    for _ in range(2):
        env.step(None)
    report = restore_snapshot(env, snapshot)
    assert [name for name in report.not_carried if name.startswith("fresh physics")] == [
        "fresh physics of env 1"
    ]
    assert [new is old for new, old in zip(env.scene.px.systems, systems, strict=True)] == [
        False,
        True,
        False,
    ]
    assert torch.allclose(env.falls.pose.raw_pose, before, atol=1e-6)
    env.close()


def test_a_reset_that_begins_anew_renews_the_envs_that_it_resets() -> None:
    env: Any = batched(PICK_CUBE, 3)
    for begins_anew in (True, False):
        env.begins_anew = begins_anew
        for chosen in ([1], [0, 2], None):
            systems = list(env.scene.px.systems)
            env.reset(options={} if chosen is None else {"env_idx": torch.tensor(chosen)})
            renewed = [k for k, old in enumerate(systems) if env.scene.px.systems[k] is not old]
            assert renewed == ((chosen or [0, 1, 2]) if begins_anew else [])
            env.step(None)
    env.close()


class Leash(PICK_CUBE):
    """A ball that a drive holds in mid-air."""

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        pose = Pose.create_from_pq([0.0, 0.5, 0.4])
        self.ball = actors.build_sphere(self.scene, 0.02, [1, 0, 0, 1], "ball", initial_pose=pose)
        self.post = actors.build_sphere(
            self.scene,
            0.01,
            [0, 1, 0, 1],
            "post",
            body_type="kinematic",
            add_collision=False,
            initial_pose=pose,
        )
        drive = self.scene.create_drive(self.post, sapien.Pose(), self.ball, sapien.Pose())
        drive.set_limit_x(0, 0)
        drive.set_limit_y(0, 0)
        drive.set_limit_z(0, 0)


def test_a_drive_between_two_bodies_still_holds() -> None:
    env: Any = batched(Leash, 2)
    env.reset(seed=[0, 1])
    for _ in range(3):
        env.step(None)
    restore_snapshot(env, take_snapshot(env))
    for _ in range(10):
        env.step(None)
    heights = env.ball.pose.p[:, 2]
    assert torch.allclose(heights, torch.tensor(0.4), atol=0.02), heights
    env.close()


class ManyShaders(PICK_CUBE):
    """A minimal and a default sensor camera on one link, and a default human render camera, which is built last."""

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        hand = self.agent.robot.links_map["panda_hand"]
        pose = sapien.Pose([0.1, 0, 0], [0.70710678, 0, -0.70710678, 0])
        on_hand = [
            CameraConfig(f"hand_{pack}", pose, 32, 32, 1.5, 0.01, 10, mount=hand, shader_pack=pack)
            for pack in ("default", "minimal")
        ]
        return [*super()._default_sensor_configs, *on_hand]

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        config = super()._default_human_render_camera_configs
        return CameraConfig("render_camera", config.pose, 64, 64, 1, 0.01, 10, shader_pack="default")


def test_each_camera_keeps_its_shader(renderer: None) -> None:
    env: Any = batched(
        ManyShaders, 2, render=True, obs_mode="rgb+depth+segmentation", render_mode="rgb_array"
    )
    env.reset(seed=[0, 1])
    restore_snapshot(env, take_snapshot(env))

    def pictures() -> dict[str, torch.Tensor]:
        data = env.get_obs()["sensor_data"]
        seen = {f"{camera}/{name}": rows for camera, of in data.items() for name, rows in of.items()}
        return {**seen, "human": env.render()}

    before = {name: picture.clone() for name, picture in pictures().items()}
    assert {"hand_default/rgb", "hand_minimal/depth"} <= before.keys()
    assert not torch.equal(before["hand_default/rgb"], before["hand_minimal/rgb"]), (
        "the shaders must differ, or the test proves nothing"
    )
    renew_physics(env.scene, [0, 1])
    env.scene._gpu_fetch_all()
    again = pictures()
    for name, picture in before.items():
        assert torch.equal(again[name], picture), name
    env.close()


@pytest.mark.slow
def test_memory_is_flat_over_a_thousand_renewals() -> None:
    import psutil

    env = batched(PICK_CUBE, 4)
    env.reset(seed=[0, 1, 2, 3])
    snapshot = take_snapshot(env)

    def used(rounds: int) -> int:
        for _ in range(rounds):
            restore_snapshot(env, snapshot)
            env.step(None)
        gc.collect()
        return psutil.Process().memory_info().rss

    first = used(50)
    assert used(250) - first < 20 * 2**20
    env.close()
