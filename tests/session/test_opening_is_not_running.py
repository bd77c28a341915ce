"""A folder of recordings from elsewhere is looked at: nothing of the code that it names or holds runs."""

from __future__ import annotations

import json
import time
from pathlib import Path

import gymnasium as gym
import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
from mani_skill.utils.wrappers.record import RecordEpisode

from workbench.recording.library import Library
from workbench.session.recorded_scene import SceneProcess
from workbench.session.review import Review

PATIENCE = 90.0


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ManiSkill's own wrapper writes; its .json is edited by the tests."""
    folder = tmp_path_factory.mktemp("demos")
    env = RecordEpisode(
        gym.make("PickCube-v1", obs_mode="state", render_backend="none"),
        str(folder),
        save_video=False,
        trajectory_name="demos",
        source_type="test",
    )
    env.reset(seed=1)
    for _ in range(2):
        env.step(np.zeros(8, np.float32))
    env.close()
    return folder


def plant(folder: Path, name: str) -> tuple[Path, Path]:
    """A task file that leaves a mark where it is imported; and the mark."""
    mark = folder / f"{name}_ran"
    file = folder / f"{name}.py"
    file.write_text(f"open({str(mark)!r}, 'w').write('ran')\nfrom mani_skill.envs.tasks import PickCubeEnv\n")
    return file, mark


@pytest.mark.parametrize(
    "named", ["{file}", "{file}:PickCubeEnv", "./evil.py", "evil.py:Evil", "evil:Evil-v0"]
)
def test_a_path_in_place_of_an_id_is_not_loaded_when_its_row_is_opened(
    demos: Path, tmp_path: Path, named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in demos.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    file, mark = plant(tmp_path, "evil")
    document = json.loads((tmp_path / "demos.json").read_text())
    document["env_info"]["env_id"] = named.format(file=file)
    (tmp_path / "demos.json").write_text(json.dumps(document))
    monkeypatch.chdir(tmp_path)
    library = Library(tmp_path)
    review = Review(library, make_scene=SceneProcess())
    try:
        library.watch()
        deadline = time.monotonic() + PATIENCE
        while not library.rows() and time.monotonic() < deadline:
            time.sleep(0.05)
        (row,) = library.rows()
        review.open((row.id,))
        while time.monotonic() < deadline:
            view = review.view()
            if view.opened and not view.opened[0].making and view.opened[0].scene:
                break
            time.sleep(0.05)
        assert "no env" in review.view().opened[0].scene, review.view().opened
    finally:
        review.close()
        library.close()
    assert not mark.exists()
