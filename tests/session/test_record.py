"""``workbench record``: several envs at once, one file an episode."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest

from workbench.authoring.problem import TaskError
from workbench.recording.read import read_properties, read_rrd
from workbench.recording.verify import verify_rrd
from workbench.session.messages import TaskOptions
from workbench.session.record import Progress, RecordOptions, record

TASKS = Path(__file__).parents[2] / "tasks"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three short episodes on two envs, without pictures."""
    out = tmp_path_factory.mktemp("recorded")
    seen: list[Progress] = []
    what = RecordOptions(
        "PushCube-v1", out, episodes=3, pictures=False, max_steps=5, options=TaskOptions(num_envs=2, seed=10)
    )
    episodes = record(what, on_progress=seen.append)
    assert [episode.steps for episode in episodes] == [5, 5, 5]
    assert seen[-1].episodes == 3
    return out


def test_every_episode_is_a_file_that_rerun_verifies(written: Path) -> None:
    files = sorted(written.iterdir())
    assert [file.suffix for file in files] == [".rrd"] * 3
    assert [verify_rrd(file) for file in files] == [None] * 3


def test_an_episode_starts_as_the_stock_env_starts_with_its_seed(written: Path) -> None:
    stock: Any = gym.make("PushCube-v1", num_envs=1, obs_mode="state", render_backend="none").unwrapped
    seeds = set()
    for file in sorted(written.iterdir()):
        properties = str(read_properties(file))
        seed = next(s for s in (10, 11, 12) if f"seed{s:04d}" in file.name)
        seeds.add(seed)
        assert "PushCube-v1" in properties
        stock.reset(seed=seed)
        columns = read_rrd(file)
        cube = next(name for name in columns if name.rsplit("/", 1)[-1] == "cube")
        start = np.asarray(columns[cube]["Transform3D:translation"].values[0]).reshape(-1)[:3]
        assert np.allclose(start, stock.obj.pose.p[0].numpy(), atol=1e-6)
    assert seeds == {10, 11, 12}
    stock.close()


def test_pictures_of_every_camera_are_recorded(tmp_path: Path) -> None:
    what = RecordOptions(
        str(TASKS / "push_cube.py"), tmp_path, episodes=1, max_steps=2, options=TaskOptions(num_envs=1)
    )
    (episode,) = record(what)
    entities = read_rrd(episode.path)
    for name in ("base_camera", "render_camera"):
        assert any(name in entity and entity.endswith("rgb") for entity in entities), name
    assert any(entity.endswith("depth") for entity in entities)


def test_a_task_that_fails_while_recording_says_where(tmp_path: Path) -> None:
    broken = tmp_path / "broken.py"
    text = (TASKS / "minimal.py").read_text()
    broken.write_text(text + "\n\nraise RuntimeError('not today')\n")
    with pytest.raises(TaskError, match="not today"):
        record(RecordOptions(str(broken), tmp_path / "out", options=TaskOptions(num_envs=1)))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["record", "nothing_here.py"], "nothing_here.py"),
        (["record", "PickCub-v1"], "PickCube-v1"),
        (["open", "PickCub-v1", "--port", "0"], "PickCube-v1"),
        (["open", "nothing_here.py", "--port", "0"], "nothing_here.py"),
        (["record", "PickCube-v1", "--num-envs", "0"], "num-envs"),
        (["view", "nothing_here.rrd"], "nothing_here.rrd"),
        (["open", "PickCube-v1", "--host", "0.0.0.0", "--no-token"], "token"),
        (["open", "PickCube-v1", "--env", "robot"], "name=value"),
    ],
)
def test_the_command_line_refuses_with_a_sentence(arguments: list[str], says: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "workbench.cli", *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=tmp_path,
        stdin=subprocess.DEVNULL,
    )
    assert done.returncode != 0
    assert says in done.stderr
    assert not any(tmp_path.iterdir())
