from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import sapien
from mani_skill.utils.structs import Actor

from tests.drive.envs import PUSH_CUBE, batched
from workbench.planning.rollouts import bodies_of

SIZE = (0.02, 0.03, 0.04)
TURNED = (np.cos(0.3), 0.0, 0.0, np.sin(0.3))


class Built(PUSH_CUBE):
    """PushCube with a box that is built differently in the second env."""

    second: dict[str, Any]

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        boxes = []
        for env in range(self.num_envs):
            builder = self.scene.create_actor_builder()
            builder.set_scene_idxs([env])
            builder.add_box_collision(**{"half_size": SIZE, **(self.second if env == 1 else {})})
            builder.initial_pose = sapien.Pose([0, 0, 1])
            boxes.append(builder.build_dynamic(f"box {env}"))
        self.box = Actor.merge(boxes, "box")


@pytest.mark.parametrize(
    ("second", "equal"),
    [
        ({}, True),
        ({"half_size": SIZE[::-1]}, False),
        ({"density": 900.0}, False),
        ({"pose": sapien.Pose([0, 0, 0.01])}, False),
        ({"pose": sapien.Pose(q=TURNED)}, False),
    ],
    ids=["alike", "size", "mass", "offset", "rotation"],
)
def test_bodies_are_alike_only_if_they_move_and_collide_alike(second: dict[str, Any], equal: bool) -> None:
    env = batched(type("Built", (Built,), {"second": second}), 2)
    env.reset(seed=0)
    first, other = bodies_of(env)
    assert (first["box"] == other["box"]) == equal and first["cube"] == other["cube"]
    env.close()
