"""A new PhysX scene under an env that stays: the one way to make PhysX forget what it did before.

PhysX solves contacts one after the other, and their order follows the numbers that it gave to pairs of
shapes. Numbers of pairs that came apart are given out again, last returned first, so the order, and with it
the last bits of every result, depends on all that was ever touched in that scene. No call takes it back, not
``unpack``, not moving everything apart and together again (tried: the order turns round each time). In a grasp
that is visible at once: the same state, written twice into the same env, went on differently in five of
eight envs.

A scene that was just made has no such history, and making one is cheap: what is expensive in an env are its
meshes, materials, bodies and pictures, and they belong to the entities. So the entities of the env are taken
out of their ``sapien.Scene`` and put, in the same order, into a new one with a new ``PhysxCpuSystem`` and the
same ``RenderSystem``: 0.2 ms for a Panda, a table and a cube. SAPIEN's components stay the same Python
objects, so nothing that ManiSkill or the task holds is out of date.
"""

from __future__ import annotations

from typing import Any

import sapien
import sapien.physx as physx

from workbench.core.cpu_system import BatchedCpuSystem


def renew_physics(scene: Any, env_idx: list[int]) -> list[int]:
    """Give these envs of a batched CPU scene a PhysX scene without a past.

    Poses, velocities and drive targets stay; joint forces (``set_qf``) and contacts are gone.

    Args:
        scene: the env's ``ManiSkillScene``, over a `BatchedCpuSystem`.

    Returns:
        Envs that were left as they are: entities were removed from them since they were built, so that SAPIEN
        would give the others new numbers, by which ManiSkill's segmentation pictures name them.
    """
    px: BatchedCpuSystem = scene.px
    px.packs()  # substeps that are still owed are made by the old systems
    default = physx.get_scene_config()
    left = [i for i in env_idx if not _is_numbered_anew_alike(px.scenes[i])]
    try:
        for i in sorted(set(env_idx) - set(left)):
            old = px.systems[i]
            # A system takes its gravity and solver from the process's default, which is another env's by now.
            physx.set_scene_config(old.config)
            system = physx.PhysxCpuSystem()
            system.timestep = old.timestep
            scene.sub_scenes[i] = _moved(px.scenes[i], system)
            px.replace(i, scene.sub_scenes[i])
    finally:
        physx.set_scene_config(default)
    px.note_change()
    return left


def _is_numbered_anew_alike(scene: sapien.Scene) -> bool:
    return [entity.per_scene_id for entity in scene.entities] == [*range(1, len(scene.entities) + 1)]


def _moved(old: sapien.Scene, system: physx.PhysxCpuSystem) -> sapien.Scene:
    """A scene over `system` that has all entities of `old`, in their order, and its render system."""
    entities = old.entities
    new = sapien.Scene([system, *_render_systems(old)])
    for entity in entities:
        entity.remove_from_scene()
    for entity in entities:
        new.add_entity(entity)
    return new


def _render_systems(scene: sapien.Scene) -> list[Any]:
    try:
        return [scene.render_system]
    except RuntimeError:
        return []  # made without rendering; SAPIEN offers no way to ask
