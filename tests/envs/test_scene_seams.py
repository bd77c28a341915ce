# pyright: reportArgumentType=false
"""ManiSkill's private names that drawing and pictures rely on; an incompatible upgrade fails here first."""

from __future__ import annotations

import copy
import inspect
import sys

import pytest
import sapien
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils

from workbench.envs import maniskill_private


def test_a_config_knows_where_it_was_made(monkeypatch: pytest.MonkeyPatch) -> None:
    # Running an author's hooks patches the class for the rest of the process: restore ManiSkill's own.
    stock = getattr(CameraConfig.__init__, "_workbench_stock", CameraConfig.__init__)
    monkeypatch.setattr(CameraConfig, "__init__", stock)
    monkeypatch.setattr(sapien_utils, "look_at", sapien_utils.look_at)  # restored after the test
    maniskill_private.mark_camera_configs()
    maniskill_private.mark_camera_configs()

    def hook() -> list[CameraConfig]:
        pose = sapien.Pose()
        return [
            CameraConfig("a", pose, 8, 6, fov=1.0),
            CameraConfig(
                "b",
                pose=sapien.Pose(
                    [0, 0, 1]
                ),
                width=8, height=6, fov=1.0,
            ),
        ]  # fmt: skip

    first = inspect.getsourcelines(hook)[1]
    sites = [maniskill_private.camera_site(copy.copy(config)) for config in hook()]
    assert [site and (site.file, site.line - first) for site in sites] == [(__file__, 3), (__file__, 4)]
    if sys.version_info >= (3, 11):
        assert sites[0].function == "test_a_config_knows_where_it_was_made.<locals>.hook"  # type: ignore[union-attr]
    monkeypatch.setattr(CameraConfig, "__init__", stock)
    assert maniskill_private.camera_site(hook()[0]) is None
