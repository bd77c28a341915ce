"""Keyword arguments that ManiSkill refuses are reported as the caller's error, with the existing names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import workbench
from workbench.envs.wrong_options import WrongOption

pytestmark = pytest.mark.usefixtures("renderer")


@pytest.mark.parametrize(
    ("given", "names"),
    [
        ({"robot_uids": "pnada"}, ["robot_uids", "pnada", "panda"]),
        ({"robot_uid": "panda"}, ["robot_uid", "robot_uids"]),
        ({"control_mode": "pd_joint_delta"}, ["control_mode", "pd_joint_delta_pos"]),
        ({"obs_mode": "state+rbg"}, ["obs_mode", "'rbg'", "rgb"]),
        ({"reward_mode": "dens"}, ["reward_mode", "'dens'", "dense"]),
        ({"sensor_configs": {"base_camra": {"width": 64}}}, ["sensor_configs", "base_camra", "base_camera"]),
        ({"sensor_configs": {"base_camera": {"shader_pack": "rt-fats"}}}, ["base_camera", "rt-fast"]),
        ({"sensor_configs": {"widht": 64}}, ["widht", "width"]),
        ({"sensor_configs": {"base_camera": {"heigth": 64}}}, ["base_camera", "heigth", "height"]),
        ({"human_render_camera_configs": {"shader_pack": "defualt"}}, ["human_render", "defualt", "default"]),
        ({"sim_config": {"sim_frq": 100}}, ["sim_config", "sim_frq", "sim_freq"]),
        ({"robot_uids": ("panda", "fecth")}, ["robot_uids", "fecth", "fetch"]),
        ({"sim_config": {"scene_config": {"gravty": [0, 0, 0]}}}, ["scene_config", "gravty", "gravity"]),
    ],
)
def test_an_unknown_option_is_named_with_the_nearest_existing_one(
    given: dict[str, Any], names: list[str]
) -> None:
    with pytest.raises(WrongOption) as caught:
        workbench.make("PickCube-v1", num_envs=2, **given)
    for name in names:
        assert name in str(caught.value)


@pytest.mark.parametrize("given", [{"sim_freq": 0}, {"control_freq": -20}, {"control_freq": "20"}])
def test_a_frequency_that_is_not_above_0_is_refused_by_name(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(given))} must be a number of Hz above 0"):
        workbench.make("PickCube-v1", num_envs=2, sim_config=given)


def test_an_error_in_the_tasks_constructor_is_reported_as_the_tasks(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text(
        "from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv\n"
        "from mani_skill.utils.registration import register_env\n"
        "@register_env('OwnOptions-v1')\n"
        "class Own(PickCubeEnv):\n"
        "    def __init__(self, *args, **kwargs):\n"
        "        size = kwargs.pop('size')\n"
        "        if size > 1:\n"
        "            raise TypeError('too large')\n"
        "        super().__init__(*args, **kwargs)\n"
    )
    workbench.make(str(file), num_envs=2, size=1).close()
    with pytest.raises(TypeError) as caught:
        workbench.make(str(file), num_envs=2, size=2)
    assert not isinstance(caught.value, WrongOption)


def test_a_task_without_a_robot_is_reported_with_the_option_that_sets_one(tmp_path: Path) -> None:
    file = tmp_path / "nobody.py"
    file.write_text(
        "from mani_skill.envs.sapien_env import BaseEnv\n"
        "from mani_skill.utils.registration import register_env\n"
        "@register_env('Nobody-v1')\n"
        "class Nobody(BaseEnv):\n"
        "    def _load_scene(self, options):\n"
        "        pass\n"
    )
    with pytest.raises(IndexError) as caught:
        workbench.make(str(file), num_envs=2)
    assert "robot_uids" in " ".join(caught.value.__notes__)
    workbench.make(str(file), num_envs=2, robot_uids="panda").close()
