"""Scenes of ManiSkill's own recordings, rebuilt in a subprocess and compared with the recorded env."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  (registers the tasks)
import numpy as np
import pytest
from mani_skill.utils.wrappers.record import RecordEpisode
from numpy.typing import NDArray

from workbench.envs.scene.scene_index import read_poses, scene_index
from workbench.episodes.episode import Episode
from workbench.episodes.reader.read_episode import read_maniskill
from workbench.review.recorded_scene import SceneError, SceneProcess

pytestmark = pytest.mark.usefixtures("child_process")

STEPS = 6


class GivenUp(Exception):
    """The scenes are no longer needed."""


@pytest.fixture(scope="module")
def recorded(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, list[NDArray[np.float32]], tuple[str, ...]]:
    """The .h5 of two episodes, the poses of all bodies in each, and the bodies' names."""
    folder = tmp_path_factory.mktemp("theirs")
    env: Any = gym.make("PushCube-v1", num_envs=1, sim_backend="physx_cpu", render_backend="none")
    env = RecordEpisode(env, str(folder), save_video=False, record_env_state=True)
    env.action_space.seed(0)
    base: Any = env.unwrapped
    poses, names = [], ()
    for seed in (4, 5):
        env.reset(seed=seed)
        names = scene_index(base).names
        track = [read_poses(base)[0]]
        for _ in range(STEPS):
            env.step(env.action_space.sample())
            track.append(read_poses(base)[0])
        poses.append(np.stack(track))
    env.close()
    return next(folder.glob("*.h5")), poses, names


def make(episodes: dict[int, Episode], files: tuple[Path, ...] = (), stop: bool = False) -> dict[int, Any]:
    messages: list[str] = []

    def check() -> None:
        if stop:
            raise GivenUp

    made = SceneProcess(files)([*episodes.values()], check, lambda _, words: messages.append(words))
    ended: dict[int, Any] = {}
    with suppress(GivenUp):
        for key, scene in zip(episodes, made, strict=True):
            ended[key] = scene if isinstance(scene, SceneError) else scene[0]
    assert messages
    return ended


def test_a_rebuilt_scene_has_every_body_at_its_pose(recorded: Any) -> None:
    file, poses, names = recorded
    episodes = {k: read_maniskill(file, f"traj_{k}") for k in (0, 1)}
    assert episodes[0].geometry is None
    lost = Episode(**vars(read_maniskill(file, "traj_0")))
    lost.info = type(lost.info)(**{**vars(lost.info), "task": "NobodyHasThis-v1"})
    ended = make({**episodes, 2: lost})
    for key, track in enumerate(poses):
        made = ended[key]
        assert made.geometry.num_envs == 1 and len(made.geometry.visuals) > 10
        rows = [made.geometry.body_names.index(name) for name in names]
        assert made.poses.shape == (STEPS + 1, len(made.geometry.body_names), 7)
        assert np.abs(made.poses[:, rows, :3] - track[..., :3]).max() < 1e-5
    assert isinstance(ended[2], SceneError)
    assert "no env NobodyHasThis-v1" in str(ended[2]) and "--task FILE" in str(ended[2])


def test_rebuilding_stops_on_request(recorded: Any) -> None:
    assert make({0: read_maniskill(recorded[0], "traj_0")}, stop=True) == {}


@pytest.mark.slow
def test_an_unreadable_message_of_the_process_is_reported(recorded: Any, tmp_path: Path) -> None:
    file = tmp_path / "sends.py"
    file.write_text(
        "import os, time\n"
        "for number in os.listdir('/proc/self/fd'):\n"
        "    path = f'/proc/self/fd/{number}'\n"
        "    if os.path.islink(path) and os.readlink(path).startswith('socket:'):\n"
        "        os.write(int(number), b'print(1)\\n')\n"
        "time.sleep(3600)\n"
    )
    ended = make({0: read_maniskill(recorded[0], "traj_0")}, (file,))
    assert isinstance(ended[0], SceneError)
    assert "sent unreadable data (its stated length is 1886546286 bytes)" in str(ended[0])
