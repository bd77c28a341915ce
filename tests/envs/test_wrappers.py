"""ManiSkill's own wrappers, unchanged, around a batched CPU env."""

# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportIndexIssue=false, reportOptionalSubscript=false, reportCallIssue=false
# pyright: reportOptionalIterable=false

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import torch
from mani_skill.trajectory import replay_trajectory
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.wrappers import (
    ActionRepeatWrapper,
    CachedResetWrapper,
    CPUGymWrapper,
    FlattenActionSpaceWrapper,
    FlattenObservationWrapper,
    FlattenRGBDObservationWrapper,
    FrameStack,
    RecordEpisode,
)
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

import workbench

pytestmark = [
    pytest.mark.thorough,
    # Some of ManiSkill's own tasks break rules: `tests/envs/test_strict.py` lists them.
    pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning"),
]

N = 4
SMALL = {"sensor_configs": {"width": 32, "height": 32}}
SMALL_HUMAN = {"human_render_camera_configs": {"width": 64, "height": 48}}


def made(task: Any = "PushCube-v1", num_envs: int = N, render: bool = False, **kwargs: Any) -> Any:
    if not render:
        kwargs["render_backend"] = "none"
    return workbench.make(task, num_envs, backend="cpu", **kwargs)


# --- ManiSkillVectorEnv ----------------------------------------------------------------------------


class SucceedsInTurn(REGISTERED_ENVS["PushCube-v1"].cls):
    """Env i succeeds in its step 2 + i."""

    def evaluate(self) -> dict[str, torch.Tensor]:
        return {"success": self.elapsed_steps == 2 + torch.arange(self.num_envs)}


def test_auto_reset_resets_the_envs_that_ended_and_keeps_their_last_observation() -> None:
    env = ManiSkillVectorEnv(made(SucceedsInTurn, obs_mode="state_dict", max_episode_steps=4))
    plain = made(SucceedsInTurn, obs_mode="state_dict", max_episode_steps=4)
    assert env.num_envs == N and env.action_space.shape == (N, 8) and env.single_action_space.shape == (8,)
    assert env.device == torch.device("cpu")
    env.reset(seed=[1, 2, 3, 4])
    plain.reset(seed=[1, 2, 3, 4])
    rng = np.random.default_rng(0)
    lengths = np.zeros(N, int)
    ended_once: set[int] = set()
    for _ in range(6):
        action = rng.uniform(-1, 1, (N, 8)).astype(np.float32)
        obs, _, terminated, truncated, info = env.step(action)
        lengths += 1
        expected = (lengths == 2 + np.arange(N)) | (lengths == 4)
        done = torch.as_tensor(terminated) | torch.as_tensor(truncated)
        assert done.tolist() == expected.tolist()
        assert terminated.tolist() == (lengths == 2 + np.arange(N)).tolist()
        assert truncated.tolist() == (lengths == 4).tolist()
        assert ("final_info" in info) == bool(done.any())
        if not ended_once:
            # The same steps without auto-reset give the expected final observations.
            plain_obs, _, _, _, plain_info = plain.step(action)
            final = info["final_observation"] if done.any() else obs
            qpos, plain_qpos = final["agent"]["qpos"], plain_obs["agent"]["qpos"]
            assert torch.equal(qpos, plain_qpos)
            if done.any():
                assert torch.equal(obs["agent"]["qpos"][~done], plain_qpos[~done])
                assert not torch.equal(obs["agent"]["qpos"][done], plain_qpos[done])
                assert info["_final_observation"].tolist() == info["_final_info"].tolist() == done.tolist()
                assert info["final_info"]["success"].tolist() == plain_info["success"].tolist()
                assert info["final_info"]["elapsed_steps"].tolist() == lengths.tolist()
        lengths[done.numpy()] = 0
        ended_once |= set(np.flatnonzero(done).tolist())
        assert info["elapsed_steps"].tolist() == lengths.tolist()
        assert env.base_env.elapsed_steps.tolist() == lengths.tolist()
    assert ended_once == set(range(N))
    env.close()
    plain.close()


def test_a_hidden_goal_moves_in_a_partial_reset(renderer: None) -> None:
    # A hidden object stands 99999 m away and its pose is stored separately: a reset must write the stored pose.
    env = ManiSkillVectorEnv(
        made("PickCube-v1", 3, render=True, obs_mode="rgb+state", max_episode_steps=3, **SMALL)
    )
    env.reset(seed=0)
    goals = env.base_env.goal_site.pose.p.clone()
    for _ in range(3):
        env.step(env.action_space.sample())
        assert env.base_env.goal_site.hidden
    moved = env.base_env.goal_site.pose.p.clone()
    assert (moved != goals).any(dim=1).all() and moved.abs().max() < 1.0
    env.reset(options={"env_idx": torch.tensor([1])})
    again = env.base_env.goal_site.pose.p
    assert (again != moved).any(dim=1).tolist() == [False, True, False]
    env.base_env.goal_site.show_visual()
    assert torch.equal(env.base_env.goal_site.pose.p, again)
    env.close()


# --- RecordEpisode ---------------------------------------------------------------------------------


def record(env: Any, tmp_path: Path, **kwargs: Any) -> Any:
    return RecordEpisode(env, str(tmp_path), trajectory_name="episodes", **{"save_video": False, **kwargs})


def test_recorded_episodes_equal_the_steps_taken(child_process: None, tmp_path: Path) -> None:
    env = ManiSkillVectorEnv(record(made(max_episode_steps=5), tmp_path), ignore_terminations=True)
    obs, _ = env.reset(seed=[3, 4, 5, 6])
    seen, actions, states = [obs], [], [env.base_env.get_state_dict()]
    rng = np.random.default_rng(0)
    for _ in range(4):
        actions.append(rng.uniform(-1, 1, (N, 8)).astype(np.float32))
        seen.append(env.step(actions[-1])[0])
        states.append(env.base_env.get_state_dict())
    env.reset(options={"env_idx": torch.tensor([2])})  # ends one episode early
    for _ in range(5):
        env.step(rng.uniform(-1, 1, (N, 8)).astype(np.float32))
    env.close()

    about = json.loads((tmp_path / "episodes.json").read_text())
    assert about["env_info"] == {
        "env_id": "PushCube-v1",
        "env_kwargs": {"num_envs": N, "render_backend": "none"},
        "max_episode_steps": 5,
    }
    episodes = about["episodes"]
    # Env 2 ends first; the other three end after five steps, in env 2's second episode.
    assert [e["elapsed_steps"] for e in episodes[:4]] == [4, 5, 5, 5]
    assert [e["episode_seed"] for e in episodes[:4]] == [5, 3, 4, 6]
    with h5py.File(tmp_path / "episodes.h5") as file:
        assert len(file) == len(episodes)
        for k, env_of in enumerate([2, 0, 1, 3]):
            trajectory: Any = file[f"traj_{k}"]
            steps = 4
            assert np.array_equal(trajectory["obs"][: steps + 1], [o[env_of].numpy() for o in seen])
            assert np.array_equal(trajectory["actions"][:steps], [a[env_of] for a in actions])
            cube = trajectory["env_states"]["actors"]["cube"][: steps + 1]
            assert np.array_equal(cube, [s["actors"]["cube"][env_of].numpy() for s in states])
            assert trajectory["truncated"][:].tolist() == [False] * 4 + [True] * (env_of != 2)


def test_stock_maniskill_replays_recorded_episodes(child_process: None, tmp_path: Path) -> None:
    """ManiSkill's own tool replays in its single CPU env, from the recorded first state."""
    env = record(made(num_envs=2, max_episode_steps=6), tmp_path)
    env.reset(seed=[3, 4])
    rng = np.random.default_rng(1)
    for _ in range(6):
        env.step(rng.uniform(-1, 1, (2, 8)).astype(np.float32))
    env.close()
    replay_trajectory.main(
        replay_trajectory.Args(
            traj_path=str(tmp_path / "episodes.h5"),
            save_traj=True,
            obs_mode="state",
            use_first_env_state=True,
            allow_failure=True,
            record_rewards=True,
        )
    )
    (replayed,) = tmp_path.glob("episodes.state.*physx_cpu.h5")
    with h5py.File(tmp_path / "episodes.h5") as ours, h5py.File(replayed) as stocks:
        assert set(ours) == set(stocks) == {"traj_0", "traj_1"}
        for name in ours:
            a: Any = ours[name]
            b: Any = stocks[name]
            assert np.array_equal(a["actions"][:], b["actions"][:])
            # Not bit for bit: set_state_dict rounds the root pose, and the first state's drive targets
            # are not recorded.
            np.testing.assert_allclose(a["obs"][1:], b["obs"][1:], atol=2e-3)
            np.testing.assert_allclose(a["rewards"][:], b["rewards"][:], atol=1e-4)


def test_substeps_are_filmed(renderer: None, tmp_path: Path) -> None:
    # The wrapper replaces a hook on the env, so substeps must not be merged.
    env = made("MS-CartpoleBalance-v1", 2, render=True, render_mode="rgb_array", **SMALL_HUMAN)
    env = RecordEpisode(
        env, str(tmp_path), save_trajectory=False, max_steps_per_video=100, render_substeps=True
    )
    base = env.unwrapped
    env.reset(seed=0)
    base.agent.robot.set_qvel(torch.tensor([[2.0, 5.0]] * 2))
    base.scene._gpu_apply_all()
    base.scene._gpu_fetch_all()
    angles = []
    stock_capture = env.capture_image

    def capture(*args: Any) -> Any:
        angles.append(float(base.agent.robot.get_qpos()[0, 1]))
        return stock_capture(*args)

    env.capture_image = capture
    env.step(np.zeros((2, 1), np.float32))
    substeps = base._sim_steps_per_control
    assert len(env.render_images) == substeps + 2 and len(angles) == substeps + 2
    assert substeps < 2 or len(set(angles)) == substeps + 1, "several substeps show the same state"
    env.close()


def test_cached_resets() -> None:
    # A multiple of num_envs, since stock raises IndexError for others: mani_skill 3.0.1 counts whole batches
    # (cached_reset.py, `_num_cached_resets += self.num_envs`) and stores fewer.
    env = CachedResetWrapper(made(), config={"num_resets": 2 * N, "seed": 3})
    cubes = env._cached_resets_env_states["actors"]["cube"]
    assert cubes.shape == (2 * N, 13) and len(torch.unique(cubes[:, 0])) == 2 * N
    vector = ManiSkillVectorEnv(env, ignore_terminations=True)

    def are_cached(rows: list[int]) -> bool:
        now = env.base_env.obj.pose.p[rows]
        return all((cubes[:, :3] - p).abs().max(dim=1).values.min() < 1e-6 for p in now)

    vector.reset()
    assert are_cached([0, 1, 2, 3])
    for _ in range(3):
        vector.step(vector.action_space.sample())
    before = env.base_env.get_state()
    obs, _ = vector.reset(options={"env_idx": torch.tensor([1, 2])})
    assert are_cached([1, 2])
    assert torch.equal(env.base_env.get_state()[[0, 3]], before[[0, 3]])
    torch.testing.assert_close(obs, env.base_env.get_obs(), atol=1e-5, rtol=0)
    vector.close()


# --- other wrappers, around a batch of one and around stock's env -----------------------------------

WRAPPERS: dict[str, tuple[str, Any, dict[str, Any]]] = {
    "actions of two robots": ("TwoRobotPickCube-v1", FlattenActionSpaceWrapper, {}),
    "repeated actions": ("PushCube-v1", lambda env: ActionRepeatWrapper(env, repeat=3), {}),
    "stacked frames": ("PushCube-v1", lambda env: FrameStack(env, num_stack=3), {}),
    "plain gymnasium": ("PushCube-v1", lambda env: CPUGymWrapper(env, record_metrics=True), {}),
    "pictures": ("PickCube-v1", FlattenRGBDObservationWrapper, {"obs_mode": "rgb+depth", **SMALL}),
    "flat": (
        "PickCube-v1",
        lambda env: FlattenObservationWrapper(FlattenRGBDObservationWrapper(env, rgb=False, depth=False)),
        {"obs_mode": "rgb", **SMALL},
    ),
}


def leaves(nest: Any) -> list[np.ndarray]:
    if isinstance(nest, dict):
        return [leaf for key in sorted(nest) for leaf in leaves(nest[key])]
    return [np.asarray(nest, np.float64)]


@pytest.mark.slow
@pytest.mark.parametrize("name", WRAPPERS)
def test_a_wrapper_returns_for_one_env_what_it_returns_for_stock(renderer: None, name: str) -> None:
    task, wrap, kwargs = WRAPPERS[name]
    backend = "cpu" if "obs_mode" in kwargs else "none"
    ours = wrap(workbench.make(task, 1, backend="cpu", render_backend=backend, **kwargs))
    stock = wrap(gym.make(task, render_backend=backend, **kwargs))
    assert ours.observation_space == stock.observation_space and ours.action_space == stock.action_space
    results = []
    for env in (ours, stock):
        env.action_space.seed(0)
        results.append([leaves(env.reset(seed=7)[0])])
        for _ in range(4):
            obs, reward, *ends, _ = env.step(env.action_space.sample())
            results[-1].append([*leaves(obs), *map(np.asarray, (reward, *ends))])
        env.close()
    for mine, theirs in zip(*results, strict=True):
        for a, b in zip(mine, theirs, strict=True):
            # The last bits of physics may differ, and so may edge pixels.
            assert a.shape == b.shape and np.mean(~np.isclose(a, b, atol=1e-4, rtol=1e-3)) < 0.02


def test_frames_of_a_batch_are_stacked_env_by_env() -> None:
    env, plain = FrameStack(made(), num_stack=3), made()
    env.reset(seed=0)
    singles = [plain.reset(seed=0)[0]]
    rng = np.random.default_rng(0)
    for _ in range(4):
        action = rng.uniform(-1, 1, (N, 8)).astype(np.float32)
        stacked = env.step(action)[0]
        singles.append(plain.step(action)[0])
    assert torch.equal(stacked, torch.stack(singles[-3:], dim=1))
    env.close()
    plain.close()
