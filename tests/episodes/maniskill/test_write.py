"""Our .h5 and .json match those of ManiSkill's RecordEpisode, and its files are read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import mani_skill.envs  # noqa: F401  (registers the tasks)
import numpy as np
import pytest
from mani_skill.trajectory.dataset import ManiSkillTrajectoryDataset
from mani_skill.trajectory.utils import dict_to_list_of_dicts
from mani_skill.utils.wrappers.record import RecordEpisode
from numpy.typing import NDArray

from tests.drive.episodes import Made
from tests.drive.equal import assert_equal
from tests.episodes.stock import flat, stacked
from workbench.envs.scene.shapes import SceneGeometry
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.reader.read_episode import read_episode, read_maniskill

STEPS = 6
SEED = 4


def record_both(task: str, folder: Path, **kwargs: Any) -> tuple[Path, Path]:
    """The .h5 of one episode from ManiSkill's wrapper (which asks git for its commit) and from ours."""
    stock: Any = gym.make(task, num_envs=1, render_backend="none", **kwargs)
    env: Any = RecordEpisode(stock, str(folder / "theirs"), trajectory_name="theirs", save_video=False)
    base = env.unwrapped
    obs, info = env.reset(seed=SEED)
    env.action_space.seed(SEED)
    rows: dict[str, list[Any]] = {name: [] for name in ("action", "reward", "terminated", "truncated")}
    states, seen, rescored = [flat(base.get_state_dict())], [flat(obs)], [base.evaluate()]
    for _ in range(STEPS):
        action = env.action_space.sample()
        obs, reward, terminated, truncated, info = env.step(action)
        for name, value in zip(rows, (action, float(reward), bool(terminated), bool(truncated))):
            rows[name].append(value)
        states.append(flat(base.get_state_dict()))
        seen.append(flat(obs))
        rescored.append(base.evaluate())
    actions = np.stack(rows["action"]).astype(np.float32)
    episode = Made(
        info=EpisodeInfo(
            task=task,
            env_index=0,
            seed=SEED,
            source_file=None,
            source_hash="",
            source={},
            control_dt=base.control_timestep,
            control_mode=base.control_mode,
            backend="cpu",
            env_kwargs=dict(num_envs=1, **kwargs),
            max_episode_steps=50,
        ),
        geometry=SceneGeometry(1, (), (), (), ()),
        segmentation={},
        poses=np.zeros((STEPS + 1, 0, 7), np.float32),
        action=actions,
        action_names=tuple(f"a{index}" for index in range(actions.shape[1])),
        reward=np.array(rows["reward"], np.float32),
        terminated=np.array(rows["terminated"]),
        truncated=np.array(rows["truncated"]),
        evaluate=stacked([flat(one) for one in rescored]),
        cameras=[],
        env_states=stacked(states),
        obs=stacked(seen),
    )
    env.close()
    return folder / "theirs" / "theirs.h5", episode.write(folder / "ours").h5


def tree(path: Path) -> dict[str, NDArray]:
    found: dict[str, NDArray] = {}
    with h5py.File(path) as file:
        file.visititems(
            lambda name, node: found.update({name: node[()]}) if isinstance(node, h5py.Dataset) else None
        )
    return found


@pytest.mark.parametrize(
    ("task", "obs_mode"),
    [("PickCube-v1", "state_dict"), ("PickCube-v1", "state"), ("MS-CartpoleBalance-v1", "state")],
)
def test_names_types_shapes_and_numbers_match_record_episode(
    child_process: None, tmp_path: Path, task: str, obs_mode: str
) -> None:
    theirs, ours = record_both(task, tmp_path, obs_mode=obs_mode)
    expected, found = tree(theirs), tree(ours)
    assert list(found) == list(expected)
    for name, values in expected.items():
        assert found[name].dtype == values.dtype, name
        np.testing.assert_array_equal(found[name], values, err_msg=name)

    theirs_json, document = (json.loads(path.with_suffix(".json").read_bytes()) for path in (theirs, ours))
    assert document.keys() >= theirs_json.keys()
    assert document["env_info"]["env_id"] == theirs_json["env_info"]["env_id"]
    assert document["env_info"]["max_episode_steps"] == 50
    (episode,), (expected_episode,) = document["episodes"], theirs_json["episodes"]
    expected_episode["reset_kwargs"]["options"] = {}  # as in ours where no options were given
    assert episode == expected_episode

    dataset = ManiSkillTrajectoryDataset(str(ours), load_count=-1)
    assert len(dataset) == STEPS
    with h5py.File(ours) as file:
        states = dict_to_list_of_dicts(file["traj_0/env_states"])
    assert len(states) == STEPS + 1


def test_success_belongs_to_the_state_after_the_step(
    make_episode: Callable[..., Made], tmp_path: Path
) -> None:
    success = np.array([False, False, False, True])
    files = make_episode(3, evaluate={"success": success}).write(tmp_path)
    with h5py.File(files.h5) as file:
        group: Any = file["traj_0"]
        assert group["success"][:].tolist() == [False, False, True]


def test_columns_whose_names_are_folders_of_others_are_all_kept(
    make_episode: Callable[..., Made], tmp_path: Path
) -> None:
    names = ["a", "a/b", "a/b/c", "a_b", "d/e", "d", "d_", "./x", "../x", "f//g"]
    obs = {name: np.full(4, k, np.float32) for k, name in enumerate(names)}
    found = read_episode(make_episode(3, obs=obs).write(tmp_path).h5).obs
    assert sorted(values.tolist() for values in found.values()) == [[k] * 4 for k in range(len(names))]
    kept = {name: int(found[name][0]) for name in ("a", "a_b_c", "d/e", "f/g")}
    assert kept == {"a": 0, "a_b_c": 2, "d/e": 4, "f/g": 9}


def test_long_columns_are_compressed_and_read_back(make_episode: Callable[..., Made], tmp_path: Path) -> None:
    """The columns are longer than a batch of the journal and than a chunk of the file."""
    count = np.arange(3001, dtype=np.float32)
    states = np.stack([count, np.sin(count), np.zeros_like(count)] * 10, axis=1)
    files = make_episode(3000, env_states={"actors/cube": states}, reward=count[1:]).write(tmp_path)
    with h5py.File(files.h5) as file:
        group: Any = file["traj_0"]
        assert group["env_states/actors/cube"].chunks[0] < 3001
        np.testing.assert_array_equal(group["env_states/actors/cube"][:], states)
        np.testing.assert_array_equal(group["rewards"][:], count[1:])
    assert files.h5.stat().st_size < states.nbytes / 2
    found = read_episode(files.rrd)
    np.testing.assert_array_equal(found.env_states["actors/cube"], states)
    np.testing.assert_array_equal(found.reward, count[1:])
    assert found.poses is not None
    np.testing.assert_array_equal(found.poses[:, 1, 0], np.arange(3001))


def test_a_file_of_record_episode_is_read_like_ours(child_process: None, tmp_path: Path) -> None:
    theirs, ours = record_both("PickCube-v1", tmp_path, obs_mode="state_dict")
    found, expected = read_maniskill(theirs, "traj_0"), read_episode(ours)
    assert found.geometry is None and found.poses is None and found.cameras == []
    for name in ("action", "reward", "terminated", "truncated", "env_states", "obs"):
        assert_equal(getattr(found, name), getattr(expected, name), name)
    np.testing.assert_array_equal(found.evaluate["success"][1:], expected.evaluate["success"][1:])
    assert (found.info.task, found.info.seed, found.info.control_dt) == ("PickCube-v1", SEED, 0.05)
    assert found.info.env_kwargs["obs_mode"] == "state_dict"


@pytest.mark.parametrize(("suffix", "lost"), [(".rrd", "poses"), (".h5", "env_states"), (".json", "")])
def test_a_truncated_file_loses_only_its_own_data(
    make_episode: Callable[..., Made], tmp_path: Path, suffix: str, lost: str
) -> None:
    states = {"actors/cube": np.zeros((7, 13), np.float32)}
    made = make_episode(6, reward=np.arange(6, dtype=np.float32), env_states=states)
    path = made.write(tmp_path).rrd
    file = path.with_suffix(suffix)
    file.write_bytes(file.read_bytes()[:-100])
    read = read_episode(path)
    (broken,) = read.broken_files
    assert broken.file == file.name
    np.testing.assert_array_equal(read.reward, made.reward)
    assert read.info == made.info
    assert (read.poses is None, not read.env_states) == (lost == "poses", lost == "env_states")
