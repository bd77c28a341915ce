"""Hot swap: a running env gets another class, and a rehearsal of hooks leaves no trace on it."""

# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.utils.structs.pose import Pose

from tests.drive.envs import PUSH_CUBE, batched
from tests.envs.written import Written
from workbench.envs.hot_swap import keep_observation_space, put_class, rehearse_hooks
from workbench.envs.scene.scene_index import read_poses
from workbench.envs.task_env import EnvOptions, TaskEnv, make_env

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning"),
]
N = 3
HOOKS = ["_initialize_episode", "evaluate"]


class Plain(PUSH_CUBE):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.looks = 0
        super().__init__(*args, **kwargs)


class Meddles(Plain):
    """``evaluate`` counts, draws and writes a pose; `mode` selects what else it does."""

    mode = "writes"

    def evaluate(self) -> dict:
        self.looks += 1
        pose = self.obj.pose.raw_pose.clone()
        pose[1, 2] += 0.1 * torch.rand(())  # moves env 1 only
        self.obj.set_pose(Pose.create(pose))
        if self.mode == "applies":
            self.scene._gpu_apply_all()
            self.scene._gpu_fetch_all()
        elif self.mode == "raises":
            raise ZeroDivisionError
        elif self.mode == "is interrupted":
            raise KeyboardInterrupt
        return {**super().evaluate(), "looks": torch.full((self.num_envs,), self.looks)}


def after_four_steps(task: type = Plain) -> Any:
    env = batched(
        task, N, control_mode="pd_joint_target_delta_pos", rules="warn", on_finding=lambda finding: None
    )
    env.reset(seed=[0, 1, 2])
    for _ in range(4):
        env.step(np.full((N, 8), 0.4, np.float32))
    return env


def full_state(env: Any) -> tuple[Any, ...]:
    target = env.agent.get_controller_state()["arm"]["target_qpos"]
    return (
        [system.pack() for system in env.scene.px.systems],
        env.get_state().tolist(),
        target.tolist(),
        [rng.get_state()[2] for rng in env._batched_episode_rng.rngs],
        torch.get_rng_state().tolist(),
        env.looks,
        env.elapsed_steps.tolist(),
    )


@pytest.mark.parametrize("mode", ["writes", "applies", "raises", "is interrupted"])
def test_a_rehearsal_of_hooks_leaves_no_trace(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = after_four_steps()
    monkeypatch.setattr(Meddles, "mode", mode)
    put_class(env, Meddles)
    before, hooks = full_state(env), HOOKS[1:] if mode == "applies" else HOOKS
    for _ in range(2):
        if mode in ("raises", "is interrupted"):
            with pytest.raises((ZeroDivisionError, KeyboardInterrupt)):
                rehearse_hooks(env, hooks)
        else:
            assert rehearse_hooks(env, hooks) == {}
        after = full_state(env)
        if mode == "applies":  # applied state is restored from a snapshot, which rounds
            np.testing.assert_allclose(after[1], before[1], atol=1e-5)
            assert after[2:] == before[2:]
        else:
            assert after == before
    raised = env.obj.pose.raw_pose + 0.1
    env.obj.set_pose(Pose.create(raised))
    assert torch.equal(env.obj.pose.raw_pose, raised), "a write must reach all envs again, as between resets"
    env.close()


def test_another_class_continues_from_the_same_state_with_the_same_rules() -> None:
    env, reference = after_four_steps(), after_four_steps()
    before = full_state(env)
    put_class(env, type("Edited", (Plain,), {"evaluate": lambda self: {"success": self.elapsed_steps > 4}}))
    assert full_state(env) == before
    action = np.full((N, 8), -0.4, np.float32)
    *_, info = env.step(action)
    reference.step(action)
    assert info["success"].tolist() == [True] * N and full_state(env)[:5] == full_state(reference)[:5]
    assert env.broken_rules.degree("rows-lost") == reference.broken_rules.degree("rows-lost") == "warn"
    env.close()
    reference.close()


def test_another_class_keeps_how_the_env_was_made_also_for_its_next_scene() -> None:
    made = EnvOptions(2, "cpu", render=False, pictures="fast", threads=1, rules="off")
    env: Any = make_env(Plain, made)
    put_class(env, type("Edited", (Plain,), {}))
    env.reset(seed=0, options={"reconfigure": True})
    assert env.scene.pictures == "fast" and env.scene.px.stepper.threads == 1
    assert TaskEnv(env).broken_rules is None
    env.close()


class SeesMore(Plain):
    def _get_obs_extra(self, info: dict) -> dict:
        return {**super()._get_obs_extra(info), "more": torch.zeros(self.num_envs, 5)}


def test_the_observation_space_follows_an_edited_hook() -> None:
    env = batched(Plain, 2, obs_mode="state")
    width = env.observation_space.shape[1]
    put_class(env, SeesMore)
    obs, _ = env.reset(seed=0)
    keep_observation_space(env, obs)
    assert env.observation_space.shape == obs.shape == (2, width + 5)
    assert env.single_observation_space.shape == (width + 5,)
    env.close()
    blind = batched(Plain, 2, obs_mode="none")
    space = blind.observation_space
    keep_observation_space(blind, {})
    assert blind.observation_space is space
    blind.close()


class WritesPastTheTensors(Written):
    """``evaluate`` with `meddles` changes what is in no tensor: masses, joints, SAPIEN's objects, static and removed bodies."""

    meddles = False

    def evaluate(self) -> dict:
        if self.meddles:
            self.falls.set_mass(9.0)
            self.first_joint.set_friction(0.9)
            self.first_joint.set_drive_properties(70, 7)
            self.falls._objs[0].set_pose(sapien.Pose([1, 2, 3]))
            self.lies._bodies[1].linear_velocity = [1, 2, 3]
            self.chain._objs[1].set_qpos(np.array([0.7, 0.7], np.float32))
            self.wall.set_pose(sapien.Pose([3, 2, 1]))
            self.wall._objs[1].pose = sapien.Pose([1, 1, 1])
            self.lies.remove_from_scene()
        return {}


def beside_the_tensors(env: Any) -> tuple[Any, ...]:
    joints = [joint for chain in env.chain._objs for joint in chain.active_joints]
    return (
        [system.pack() for system in env.scene.px.systems],
        [len(scene.entities) for scene in env.scene.sub_scenes],
        env.falls.mass.tolist(),
        [(joint.friction, joint.stiffness, joint.damping) for joint in joints],
        read_poses(env).tobytes(),
        env.scene.px.static_moves,
    )


def test_a_rehearsal_changes_nothing_that_is_in_no_tensor() -> None:
    env: Any = batched(WritesPastTheTensors, 2, rules="off", obs_mode="none", reward_mode="none")
    env.reset(seed=0)
    env.step(None)
    before = beside_the_tensors(env)
    env.meddles = True
    for _ in range(2):
        assert rehearse_hooks(env, ["evaluate"]) == {}
        assert beside_the_tensors(env) == before
    env.evaluate()
    after = beside_the_tensors(env)
    assert not any(now == was for now, was in zip(after, before, strict=True)), (
        "outside of it all are changed"
    )
    env.close()
