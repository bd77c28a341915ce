"""Builders of boxes and hinged chains for test scenes."""

from __future__ import annotations

from typing import Any

import sapien

BOX = [0.05, 0.05, 0.05]


def box(env: Any, name: str, half_size: list[float] = BOX, pose: Any = None, kind: str = "dynamic") -> Any:
    builder = env.scene.create_actor_builder()
    builder.add_box_collision(half_size=half_size)
    builder.initial_pose = sapien.Pose() if pose is None else pose
    return builder.build(name) if kind == "dynamic" else getattr(builder, f"build_{kind}")(name)


def by_hand(
    env: Any, joints: int, name: str = "chain", scene_idxs: list[int] | None = None, fixed: bool = True
) -> Any:
    """Build a chain of links below a base, joined by `joints` hinges."""
    builder = env.scene.create_articulation_builder()
    if scene_idxs is not None:
        builder.set_scene_idxs(scene_idxs)
    parent = builder.create_link_builder()
    parent.set_name("base")
    parent.add_box_collision(half_size=BOX)
    for i in range(joints):
        parent = builder.create_link_builder(parent)
        parent.set_name(f"link{i}")
        parent.set_joint_name(f"hinge{i}")
        parent.add_box_collision(pose=sapien.Pose([0.15, 0, 0]), half_size=[0.1, 0.03, 0.03])
        parent.set_joint_properties(
            "revolute",
            limits=[[-2.0, 2.0]],
            pose_in_parent=sapien.Pose([0.1 if i == 0 else 0.3, 0, 0], [0.7071068, 0, 0, 0.7071068]),
            pose_in_child=sapien.Pose([0, 0, 0], [0.7071068, 0, 0, 0.7071068]),
            friction=0.05,
            damping=0.02,
        )
    builder.initial_pose = sapien.Pose([0, 0, 1])
    return builder.build(name, fix_root_link=fixed)
