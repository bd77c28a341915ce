"""Pictures taken from the observation equal those that would be rendered."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.envs.drawn_envs import batched
from workbench.envs.task_env import TaskEnv
from workbench.pictures import render as module
from workbench.pictures.render import list_cameras, recorded_pictures, step_pictures, take_pictures

pytestmark = pytest.mark.usefixtures("renderer")

ALL = ("rgb", "depth", "segmentation")


@pytest.mark.slow
def test_observed_pictures_are_not_rendered_again(monkeypatch: pytest.MonkeyPatch) -> None:
    task = TaskEnv(batched("PickCube-v1", obs_mode="rgb+depth+segmentation", robot_uids="panda_wristcam"))
    task.reset(seed=1)
    drawn: list[str] = []

    def draw(env: Any, env_index: int, requests: Any) -> Any:
        drawn.extend(name for name, _, _ in requests)
        return take_pictures(env, env_index, requests)

    monkeypatch.setattr(module, "take_pictures", draw)
    task.step(np.ones((task.num_envs, 8), np.float32))
    wanted = [
        ("hand_camera", "sensor", ALL),
        ("render_camera", "human", ("rgb",)),
        ("base_camera", "sensor", ALL),
    ]
    assert sorted(recorded_pictures(list_cameras(task.env))) == sorted(wanted)
    every = step_pictures(task, [1, 0], wanted)  # type: ignore[arg-type]
    assert step_pictures(task, [1, 0], ()) == []
    for env, pictures in ((1, every[:3]), (0, every[3:])):
        assert [picture.camera for picture in pictures] == ["hand_camera", "render_camera", "base_camera"]
        for picture, again in zip(pictures, take_pictures(task.env, env, wanted), strict=True):  # type: ignore[arg-type]
            assert (picture.kind, picture.env) == (again.kind, again.env)
            np.testing.assert_array_equal(picture.pose, again.pose)
            assert picture.depth is None or picture.depth.dtype == np.int16
            for modality in ALL:
                seen = getattr(picture, modality)
                if modality == "depth" and seen is not None:
                    seen = seen / np.float32(1000)
                np.testing.assert_array_equal(seen, getattr(again, modality))
    assert set(drawn) == {"render_camera"}
    task.close()
