"""Which bodies a task has, and where all of them are, as one array.

A viewer, a recorder and a timeline each want the pose of every body of every env, thirty times a
second. Asked one by one a body costs 2 us, so 64 envs of 16 bodies cost 2 ms a frame. The idea is to
settle once, when a scene is built, which number of which buffer belongs to which (env, body), so that
a frame is one gather:

* Where ManiSkill keeps poses in one tensor (its GPU simulation, and our batched CPU one) that tensor
  is ``px.cuda_rigid_body_data``. Static bodies are not in it and do not move: theirs are kept here.
* A stock CPU env has one sub-scene, whose ``Scene.pack_poses()`` gives all its entities in one call.

Two things would make that array a lie. A body that is hidden from the sensors in GPU simulation has
been moved 99999 m away (SAPIEN cannot switch off drawing there); its true pose is what ManiSkill kept
aside. And objects that differ from env to env (`Actor.merge`) are one body by the merged name, or
every env would have its own column with NaN in all other rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sapien
import torch
from numpy.typing import NDArray

from workbench.core import seams
from workbench.core.geometry import BodyKind

_PACKED_POSE = np.array([4, 5, 6, 0, 1, 2, 3])
"""Where [p, q] finds its columns in a row of ``Scene.pack_poses()``, which is [q wxyz, p]."""


@dataclass(frozen=True)
class _Body:
    """One (env, body) and the ManiSkill struct that manages it."""

    env: int
    body: int
    struct: Any
    position: int
    """Which of the struct's objects this is."""


@dataclass
class BodyTable:
    """The bodies of one built scene. Make a new one when the scene is rebuilt (`scene` tells)."""

    scene: Any
    """The ``ManiSkillScene`` that this describes."""
    num_envs: int
    names: tuple[str, ...]
    """(B,) an actor's name, or ``articulation/link``; unique."""
    kinds: tuple[BodyKind, ...]
    """(B,)"""
    hidden: tuple[bool, ...]
    """(B,) True for what the task hides from its sensors."""
    entities: NDArray[np.object_]
    """(N, B) the ``sapien.Entity`` of each body in each env, None where an env lacks it."""
    actors: tuple[Any, ...]
    """Every Actor that can be hidden, merged ones and their parts alike, for `read_poses`."""
    fixed: NDArray[np.float32]
    """(N, B, 7) poses of static bodies; NaN elsewhere. Only used with `rows`."""
    rows: torch.Tensor | None = None
    """(K,) row of each moving (env, body) in ``px.cuda_rigid_body_data``; None on a stock CPU env."""
    slots: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(K,) where each of `rows` (or of `packed`) goes in the flattened (N * B) array of poses."""
    packed: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(K, 7) columns in ``pack_poses()``, for a stock CPU env."""
    entity_count: int = -1
    """Entities of the sub-scene when `packed` was made; another count means that it is out of date."""
    slot_of: dict[int, int] = field(default_factory=dict)
    """``id`` of an entity to its slot. The entities are held by `entities`, so ids stay theirs."""


def build_body_table(env: Any) -> BodyTable:
    """List the bodies of a ManiSkill env (unwrapped, reset at least once).

    Bodies are all actors, then all links of all articulations, each by the name of the merged view
    that it is part of, if any.

    Raises:
        NotImplementedError: the env was made with ``parallel_in_single_scene``.
    """
    scene = env.scene
    if scene.parallel_in_single_scene:
        raise NotImplementedError(
            "parallel_in_single_scene puts all envs into one sub-scene, which the workbench cannot take "
            "apart. Make the env without it: the page shows all envs side by side."
        )
    names: list[str] = []
    kinds: list[BodyKind] = []
    bodies: list[_Body] = []
    taken: set[str] = set()
    for name, kind, parts in _named_parts(scene):
        unique = name
        # Nothing forbids an actor that is called "panda/panda_hand".
        while unique in taken:
            unique += "'"
        taken.add(unique)
        for struct, position, env_index in parts:
            bodies.append(_Body(env_index, len(names), struct, position))
        names.append(unique)
        kinds.append(kind)

    shape = (env.num_envs, len(names))
    entities = np.full(shape, None, dtype=object)
    for b in bodies:
        entities[b.env, b.body] = _entity(seams.objects_of(b.struct)[b.position])
    hidden_entities = {
        id(entity) for actor in seams.hidden_objects(env) for entity in seams.objects_of(actor)
    }
    table = BodyTable(
        scene=scene,
        num_envs=env.num_envs,
        names=tuple(names),
        kinds=tuple(kinds),
        hidden=tuple(any(id(e) in hidden_entities for e in column) for column in entities.T),
        entities=entities,
        actors=tuple({id(a): a for a in [*scene.actors.values(), *scene.actor_views.values()]}.values()),
        fixed=np.full((*shape, 7), np.nan, dtype=np.float32),
        slot_of={id(e): i for i, e in enumerate(entities.ravel()) if e is not None},
    )
    if scene.gpu_sim_enabled:
        _find_rows(table, bodies)
    else:
        _find_packed(table)
    return table


def read_poses(env: Any, table: BodyTable) -> NDArray[np.float32]:
    """(N, B, 7) float32 pose of every body in its env's own frame: p in metres, q as wxyz.

    NaN for bodies that an env does not have. What is hidden now is where it would be if it were shown.

    Raises:
        ValueError: the env was rebuilt since the table was made.
    """
    if env.scene is not table.scene:
        raise ValueError("the scene was rebuilt since this table was made: call build_body_table(env) again")
    if table.rows is None:
        return _read_packed(table)
    poses = table.fixed.copy()
    flat = poses.reshape(-1, 7)
    # Gathered on the tensor's own device: one small copy to the host, not the whole buffer.
    flat[table.slots] = table.scene.px.cuda_rigid_body_data.torch()[table.rows, :7].cpu().numpy()
    for actor in table.actors:
        if actor.hidden:
            _put_back(table, actor, flat)
    return poses


def _put_back(table: BodyTable, actor: Any, flat: NDArray[np.float32]) -> None:
    kept = seams.pose_before_hiding(actor)
    if kept is None:
        return
    objects = seams.objects_of(actor)
    true_poses = np.broadcast_to(kept.cpu().numpy(), (len(objects), 7))
    for entity, pose in zip(objects, true_poses, strict=True):
        slot = table.slot_of.get(id(entity))
        if slot is not None:
            flat[slot] = pose


def _find_rows(table: BodyTable, bodies: list[_Body]) -> None:
    slots, rows = [], []
    # Read whole, once a struct: on a GPU every number that is read by itself waits for the device.
    rows_of = {
        id(b.struct): seams.data_rows_of(b.struct).tolist() for b in bodies if table.kinds[b.body] != "static"
    }
    for b in bodies:
        slot = b.env * len(table.names) + b.body
        if table.kinds[b.body] == "static":
            pose = table.entities[b.env, b.body].pose
            table.fixed[b.env, b.body] = [*pose.p, *pose.q]
        else:
            slots.append(slot)
            rows.append(rows_of[id(b.struct)][b.position])
    table.slots = np.array(slots, dtype=np.int64)
    table.rows = torch.tensor(rows, dtype=torch.int64, device=table.scene.device)


def _find_packed(table: BodyTable) -> None:
    entities = table.scene.sub_scenes[0].entities
    found = [(table.slot_of[id(e)], i) for i, e in enumerate(entities) if id(e) in table.slot_of]
    table.slots = np.array([slot for slot, _ in found], dtype=np.int64)
    at = np.array([i for _, i in found], dtype=np.int64)
    table.packed = 7 * at[:, None] + _PACKED_POSE
    table.entity_count = len(entities)


def _read_packed(table: BodyTable) -> NDArray[np.float32]:
    numbers = np.frombuffer(table.scene.sub_scenes[0].pack_poses(), dtype=np.float32)
    if len(numbers) != 7 * table.entity_count:
        # A stock CPU env can add and remove entities while it runs (a camera, a removed actor).
        _find_packed(table)
    poses = np.full((table.num_envs, len(table.names), 7), np.nan, dtype=np.float32)
    poses.reshape(-1, 7)[table.slots] = numbers[table.packed]
    return poses


def _named_parts(scene: Any) -> Iterator[tuple[str, BodyKind, list[tuple[Any, int, int]]]]:
    """Name, kind, and (struct, position in the struct, env) of every object, of each body in turn."""
    covered: dict[int, str] = {}
    merged: dict[str, list[Any]] = {}
    for name, view in scene.actor_views.items():
        # Two objects of one env under one view (merging is not bound to one an env) cannot be one
        # column of the array: those keep their own names.
        if len(set(seams.envs_of(view))) != len(seams.objects_of(view)):
            continue
        label = str(name if name is not None else view.name)
        for entity in seams.objects_of(view):
            covered.setdefault(id(entity), label)
    for name, actor in scene.actors.items():
        labels = {covered.get(id(entity)) for entity in seams.objects_of(actor)}
        label = labels.pop() if len(labels) == 1 else None
        merged.setdefault(label if label is not None else name, []).append(actor)
    for name, actors in merged.items():
        yield name, actors[0].px_body_type, _parts(actors)

    grouped: dict[str, list[Any]] = {}
    part_of: dict[int, str] = {}
    for name, view in scene.articulation_views.items():
        if len(set(seams.envs_of(view))) == len(seams.objects_of(view)):
            for articulation in seams.objects_of(view):
                part_of.setdefault(id(articulation), str(name if name is not None else view.name))
    for name, articulation in scene.articulations.items():
        labels = {part_of.get(id(a)) for a in seams.objects_of(articulation)}
        label = labels.pop() if len(labels) == 1 else None
        grouped.setdefault(label if label is not None else name, []).append(articulation)
    for name, articulations in grouped.items():
        links: dict[str, list[Any]] = {}
        for articulation in articulations:
            for link in articulation.links:
                links.setdefault(link.name, []).append(link)
        for link_name, same in links.items():
            yield f"{name}/{link_name}", "link", _parts(same)


def _parts(structs: list[Any]) -> list[tuple[Any, int, int]]:
    return [(s, i, int(env)) for s in structs for i, env in enumerate(seams.envs_of(s))]


def _entity(thing: Any) -> sapien.Entity:
    return thing if isinstance(thing, sapien.Entity) else thing.entity
