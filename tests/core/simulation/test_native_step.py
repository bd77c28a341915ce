"""Exported names of SAPIEN that stepping without the interpreter lock needs."""

from __future__ import annotations

import threading
import time

import sapien
import sapien.physx as physx

from workbench.core.simulation import stepping


def falling_box() -> sapien.Scene:
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=(0.1, 0.1, 0.1))
    builder.build("box").set_pose(sapien.Pose((0, 0, 1)))
    return scene


def test_a_native_step_is_the_step_of_the_binding() -> None:
    native = stepping.native_step()
    assert native is not None
    ours, theirs = falling_box(), falling_box()
    address = native.address_of(ours.physx_system)  # type: ignore[arg-type]
    for _ in range(20):
        native.call(address)
        theirs.physx_system.step()
    assert ours.physx_system.pack() == theirs.physx_system.pack()  # type: ignore[attr-defined]
    assert ours.pack_poses() == theirs.pack_poses()
    assert ours.entities[0].pose.p[2] < 0.9, "nothing fell: the test proved nothing"


def test_the_interpreter_lock_is_free_during_a_native_step() -> None:
    native = stepping.native_step()
    assert native is not None
    scene = falling_box()
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=(0.1, 0.1, 0.1))
    for i in range(600):  # all in one place: a step that takes long
        builder.build(f"box {i}")
    counted, stop = 0, threading.Event()

    def count() -> None:
        nonlocal counted
        while not stop.is_set():
            counted += 1
            time.sleep(0)

    other = threading.Thread(target=count)
    other.start()
    address = native.address_of(scene.physx_system)  # type: ignore[arg-type]
    before = counted
    native.call(address)
    during = counted - before
    stop.set()
    other.join()
    assert during > 10
