"""Pictures taken from the observation equal those that would be rendered."""

# A sensor has colours and depth.
# pyright: reportArgumentType=false

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.envs.stock_env import batch_of
from tests.envs.watched import RENDERED, Watched
from workbench.envs.task_env import TaskEnv
from workbench.pictures import render as module
from workbench.pictures.render import list_cameras, recorded_pictures, step_pictures, take_pictures

pytestmark = pytest.mark.usefixtures("renderer")

ALL = ("rgb", "depth", "segmentation")


def test_each_env_has_its_own_picture_in_the_order_of_the_requests_and_none_is_rendered_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rendered: list[str] = []

    def render(env: Any, number: int, requests: Any) -> Any:
        rendered.extend(name for name, _, _ in requests)
        return take_pictures(env, number, requests)

    monkeypatch.setattr(module, "take_pictures", render)
    task = TaskEnv(batch_of(Watched, 3, **RENDERED))
    task.reset(seed=[0, 1, 2])
    cameras = list_cameras(task.env)
    wanted = recorded_pictures(cameras)
    assert {(name, kind): tuple(given) for name, kind, given in wanted} == {
        (camera.name, camera.kind): ALL if camera.kind == "sensor" else ("rgb",) for camera in cameras
    }
    only_depth: Any = [
        ("people", "human", ("rgb",)),
        ("on_actor", "sensor", ("depth",)),
        ("beside", "sensor", ALL),
    ]
    assert step_pictures(task, [2, 0], ()) == []
    found = step_pictures(task, [2, 0], only_depth)
    assert rendered == ["people", "people"], "the sensors' are in the observation"
    assert [(one.camera, one.env) for one in found] == [
        (name, env) for env in (2, 0) for name in ("people", "on_actor", "beside")
    ]
    drawn = [one for env in (2, 0) for one in take_pictures(task.env, env, only_depth)]
    for mine, theirs in zip(found, drawn, strict=True):
        assert (mine.kind, mine.env) == (theirs.kind, theirs.env)
        np.testing.assert_array_equal(mine.pose, theirs.pose)
        for modality in ALL:
            seen, wanted_ = getattr(mine, modality), getattr(theirs, modality)
            if seen is not None and seen.dtype == np.int16 and modality == "depth":
                seen = seen / np.float32(1000)
            np.testing.assert_array_equal(seen, wanted_)
    assert found[1].rgb is None and found[1].depth is not None and found[1].depth.dtype == np.int16
    assert not np.array_equal(found[0].rgb, found[3].rgb) or not np.array_equal(
        found[1].depth, found[4].depth
    )
    task.obs = {}
    (fresh,) = step_pictures(task, [1], only_depth[1:2])
    assert fresh.depth is not None and fresh.depth.dtype == np.float32 and fresh.env == 1
    task.close()
