"""SAPIEN's exported symbols that stepping without the GIL needs."""

from __future__ import annotations

import sapien
import sapien.physx as physx

from workbench.envs.simulation import stepping


def falling_box() -> sapien.Scene:
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=(0.1, 0.1, 0.1))
    builder.build("box").set_pose(sapien.Pose((0, 0, 1)))
    return scene


def test_a_native_step_equals_the_bindings_step() -> None:
    native = stepping.native_step()
    assert native is not None, stepping.why_not_native()
    ours, theirs = falling_box(), falling_box()
    address = native.address_of(ours.physx_system)  # type: ignore[arg-type]
    for _ in range(20):
        native.call(address)
        theirs.physx_system.step()
    assert ours.physx_system.pack() == theirs.physx_system.pack()  # type: ignore[attr-defined]
    assert ours.pack_poses() == theirs.pack_poses()
    assert ours.entities[0].pose.p[2] < 0.9, "nothing fell, so the test proved nothing"
