"""Index of the bodies of a built scene: where their poses are stored, and which have a state."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import wraps
from typing import Any, NamedTuple, TypeVar

import numpy as np
import sapien
import torch
from numpy.typing import NDArray

from workbench.envs import maniskill_private
from workbench.envs.scene.shapes import BodyKind
from workbench.envs.simulation.cpu_system import batched_system

_T = TypeVar("_T")
_HIDDEN_METRES = 5e4
"""An actor that is farther than this from its true pose, along each axis, is still hidden:
``Actor.hide_visual`` moves it by 99999 m."""


def once_a_scene(find: Callable[[Any], _T]) -> Callable[[Any], _T]:
    """Cache ``find(env)`` on the env's scene: `find` is called once per scene, and again after bodies were
    added or removed."""
    name = f"_workbench {find.__module__}.{find.__qualname__}"

    @wraps(find)
    def known(env: Any) -> _T:
        held, px = vars(env.scene), batched_system(env.scene)
        version = 0 if px is None else px.layout_version
        if name not in held or held[name][0] != version:
            held[name] = version, find(env)
        return held[name][1]

    return known


@dataclass(frozen=True)
class SceneIndex:
    """The bodies of one built scene.

    A getter for one body's pose takes 2 us, so 64 envs of 16 bodies would take 2 ms a frame. The index finds
    once which row of ``px.cuda_rigid_body_data`` belongs to which (env, body); one gather then reads all
    poses of a frame. Static bodies are not in that tensor: `fixed` has their poses. In GPU simulation a
    hidden body was moved 99999 m away; `hidden_poses` has its true pose. Objects that differ between envs
    (`Actor.merge`) are one body with the merged name.
    """

    names: tuple[str, ...]
    """(B,) an actor's name, or ``articulation/link``; unique."""
    kinds: tuple[BodyKind, ...]
    """(B,)"""
    owners: tuple[str, ...]
    """(B,) name of the actor or articulation that the body belongs to."""
    hidden: tuple[bool, ...]
    """(B,) whether the task hides the body from its sensors."""
    entities: NDArray[np.object_]
    """(N, B) the ``sapien.Entity`` of each body; None if the env lacks it."""
    states: dict[str, Any]
    """ManiSkill's structs by their names in its state dict: ``actors/cube`` (no static ones), ``articulations/panda``."""
    actors: tuple[tuple[Any, NDArray[np.int64]], ...]
    """Every Actor (merged actors and their parts too), each with the slots of its entities. A slot is a
    position in the flattened (N * B) array of bodies; -1 for an entity that is not in the array."""
    fixed: NDArray[np.float32]
    """(N, B, 7) poses of static bodies; NaN for all other bodies. Not needed where `rows` is None."""
    rows: Any
    """(K,) row of each moving (env, body) in ``px.cuda_rigid_body_data``, for `rows_of`; None on a stock CPU env."""
    slots: NDArray[np.int64]
    """(K,) slot of each entry of `rows`."""
    slot_of: dict[int, int]
    """Slot by ``id`` of an entity; `entities` keeps the entities alive, so ids stay valid."""

    def row_of(self, env: int, name: str) -> int | None:
        """Row of a moving body of this env in ``px.cuda_rigid_body_data``; None if it has none."""
        at = np.flatnonzero(np.asarray(self.slots) == env * len(self.names) + self.names.index(name))
        return int(self.rows[int(at[0])]) if len(at) else None

    def name_of(self, entity: Any) -> str | None:
        """Body name of an entity or SAPIEN component; None if ManiSkill does not manage it."""
        slot = self.slot_of.get(id(_entity(entity)))
        return None if slot is None else self.names[slot % len(self.names)]


@once_a_scene
def scene_index(env: Any) -> SceneIndex:
    """The index of the present scene of a ManiSkill env (unwrapped, reset at least once).

    The bodies are all actors, then all links of all articulations. A body in a merged view has the view's
    name.

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
    owners: list[str] = []
    columns: list[list[Any]] = []
    for owner, name, structs in _named_structs(scene):
        # An actor may be called "panda/panda_hand".
        while name in names:
            name += "'"
        names.append(name)
        kinds.append("link" if owner else structs[0].px_body_type)
        owners.append(owner or name)
        columns.append(structs)
    shape = (env.num_envs, len(names))
    entities = np.full(shape, None, dtype=object)
    fixed = np.full((*shape, 7), np.nan, dtype=np.float32)
    slots: list[NDArray[np.int64]] = []
    rows: list[torch.Tensor] = []
    for body, structs in enumerate(columns):
        for struct in structs:
            envs = maniskill_private.envs_of(struct)
            for e, thing in zip(envs, maniskill_private.objects_of(struct), strict=True):
                entity = entities[e, body] = _entity(thing)
                if kinds[body] == "static":
                    fixed[e, body] = [*entity.pose.p, *entity.pose.q]
            if kinds[body] != "static" and scene.gpu_sim_enabled:
                own = maniskill_private.data_rows_of(struct)
                slots.append((envs * len(names) + body)[(own >= 0).numpy(force=True)])
                rows.append(own[own >= 0])  # a removed body has no row
    slot_of = {id(entity): slot for slot, entity in enumerate(entities.ravel()) if entity is not None}
    hidden = {
        id(entity)
        for actor in maniskill_private.hidden_objects(env)
        for entity in maniskill_private.objects_of(actor)
    }
    actors = {id(actor): actor for actor in [*scene.actors.values(), *scene.actor_views.values()]}
    registry = scene.state_dict_registry
    moving = {f"actors/{a.name}": a for a in registry.actors.values() if a.px_body_type != "static"}
    return SceneIndex(
        names=tuple(names),
        kinds=tuple(kinds),
        owners=tuple(owners),
        hidden=tuple(any(id(entity) in hidden for entity in column) for column in entities.T),
        entities=entities,
        states={**moving, **{f"articulations/{a.name}": a for a in registry.articulations.values()}},
        actors=tuple(
            (
                actor,
                np.array(
                    [slot_of.get(id(entity), -1) for entity in maniskill_private.objects_of(actor)], np.int64
                ),
            )
            for actor in actors.values()
        ),
        fixed=fixed,
        rows=row_index(torch.cat([torch.zeros(0, dtype=torch.int64, device=scene.device), *rows]))
        if scene.gpu_sim_enabled
        else None,
        slots=np.concatenate([np.zeros(0, np.int64), *slots]),
        slot_of=slot_of,
    )


def read_poses(env: Any) -> NDArray[np.float32]:
    """(N, B, 7) float32 pose of every body in its env's own frame: p in metres, q as wxyz.

    NaN for bodies that an env lacks; the true pose for hidden ones.
    """
    # First: after bodies were added or removed, this lays the scene out again, and rows belong to other bodies.
    data = env.scene.px.cuda_rigid_body_data if env.scene.gpu_sim_enabled else None
    index = scene_index(env)
    poses = index.fixed.copy()
    flat = poses.reshape(-1, 7)
    px = batched_system(env.scene)
    if px is not None and px.static_moves:
        for env_idx, body in np.argwhere(~np.isnan(index.fixed[:, :, 0])):
            entity: Any = index.entities[env_idx, body]
            pose = entity.pose
            poses[env_idx, body] = [*pose.p, *pose.q]
    if data is None:
        # A stock CPU env has no such tensor, and does not move bodies to hide them.
        for slot, entity in enumerate(index.entities.ravel()):
            if entity is not None:
                flat[slot] = [*entity.pose.p, *entity.pose.q]
        return poses
    # Gathered on the tensor's device, so that only a small copy goes to the host.
    moved = rows_of(data, index.rows)[:, :7]
    flat[index.slots] = moved if isinstance(moved, np.ndarray) else moved.cpu().numpy()
    for slots, kept in hidden_poses(env):
        flat[slots[slots >= 0]] = kept[slots >= 0]
    return poses


@once_a_scene
def joints_of_scene(env: Any) -> tuple[tuple[str, Any], ...]:
    """Name and articulation of each articulation that every env has, with the same number of active joints in
    each: only their joints can be compared between envs."""
    found = []
    for name, articulation in env.scene.articulations.items():
        count = len(articulation.active_joints)
        everywhere = len(maniskill_private.envs_of(articulation)) == env.num_envs
        if count and everywhere and tuple(articulation.get_qpos().shape) == (env.num_envs, count):
            found.append((name, articulation))
    return tuple(found)


def joint_names(env: Any) -> tuple[str, ...]:
    """(J,) names of the joints that `read_joints` reads: ``joint``, or ``articulation/joint`` if there are
    several articulations."""
    found = joints_of_scene(env)
    return tuple(
        joint.name if len(found) == 1 else f"{name}/{joint.name}"
        for name, articulation in found
        for joint in articulation.active_joints
    )


def read_joints(env: Any) -> NDArray[np.float32] | None:
    """(N, J) positions of the joints of all articulations that every env has, in rad or m; None if there are none."""
    found = joints_of_scene(env)
    if not found:
        return None
    rows = [articulation.get_qpos() for _, articulation in found]
    return np.concatenate([np.array(row.numpy(force=True), np.float32) for row in rows], axis=1)


def hidden_poses(env: Any) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float32]]]:
    """For each Actor that GPU simulation moved away to hide it: slots (M,) and true poses (M, 7) of its
    entities. Leaves out entities that were moved again since then."""
    for actor, slots in scene_index(env).actors:
        if (kept := maniskill_private.pose_before_hiding(actor)) is not None:
            now = rows_of(env.scene.px.cuda_rigid_body_data, maniskill_private.data_rows_of(actor).long())[
                :, :3
            ]
            away = ((now - kept[:, :3]).abs() > _HIDDEN_METRES).all(dim=1).cpu().numpy()
            yield slots[away], kept.cpu().numpy()[away]


def present_states(env: Any) -> dict[str, Any]:
    """State (N, D) of each of `SceneIndex.states`, laid out as by ``get_state()``.

    The row is NaN for an env that lacks the actor or articulation.

    Copies: tensors, or arrays on the CPU.
    """
    return state_rows(env).states()


class StateRows(NamedTuple):
    """Copies of the tensors (one call for each) from which the states of a moment are made."""

    still: list[int]
    """Positions of kinematic bodies along B of `data`; their velocity is set to zero."""
    places: dict[str, tuple[Any, int | None, Any, int]]
    data: Any
    """(N, B, 13)"""
    qpos: Any
    qvel: Any
    asked: dict[str, Any]
    """States that are not in these tensors."""

    def states(self) -> dict[str, Any]:
        """States as `present_states` returns them."""
        data = self.data
        if self.still:
            data[:, self.still, 7:] = 0.0
        join: Any = np.hstack if isinstance(data, np.ndarray) else torch.hstack
        states: dict[str, Any] = {}
        for name, (_, column, joints, dof) in self.places.items():
            if name in self.asked:
                states[name] = self.asked[name]
            elif joints is None:
                states[name] = data[:, column]
            else:
                states[name] = join([data[:, column], self.qpos[joints, :dof], self.qvel[joints, :dof]])
        return states


def state_rows(env: Any) -> StateRows:
    """Copy the present moment; ``states()`` then does the slow part of `present_states`."""
    px = env.scene.px
    data = px.cuda_rigid_body_data  # first, as in `read_poses`
    rows, still, places = _places_of_states(env)
    asked = {
        name: in_every_env(env, struct, struct.get_state())
        for name, (struct, column, joints, _) in places.items()
        if column is None or (joints is None and maniskill_private.pose_before_hiding(struct) is not None)
    }
    qpos, qvel = px.cuda_articulation_qpos.torch(), px.cuda_articulation_qvel.torch()
    qpos, qvel = (q.numpy().copy() if q.is_cpu else q.clone() for q in (qpos, qvel))
    return StateRows(still, places, rows_of(data, rows), qpos, qvel, asked)


@once_a_scene
def _places_of_states(env: Any) -> tuple[Any, list[int], dict[str, tuple[Any, int | None, Any, int]]]:
    """Where `state_rows` finds each state.

    Returns:
        Rows (N, B) of ``cuda_rigid_body_data``. Positions along B of kinematic bodies, which have no
        velocity. And by state: its struct; its position along B (None if an env lacks it); for an
        articulation, its rows (N,) in the joint tensors and its number of joints.
    """
    every, rows, still = np.arange(env.num_envs), [], []
    places: dict[str, tuple[Any, int | None, Any, int]] = {}
    for name, struct in scene_index(env).states.items():
        body = struct if name.startswith("actors/") else struct.root
        removed = bool((maniskill_private.data_rows_of(body) < 0).any())
        if removed or not np.array_equal(maniskill_private.envs_of(struct), every):
            places[name] = struct, None, None, 0
            continue
        if name.startswith("actors/"):
            if struct.px_body_type != "dynamic":
                still.append(len(rows))
            places[name] = struct, len(rows), None, 0
        else:
            joints = row_index(maniskill_private.data_rows_of_articulation(struct))
            places[name] = struct, len(rows), joints, maniskill_private.joints_of(struct)
        rows.append(maniskill_private.data_rows_of(body).long())
    none = torch.zeros((env.num_envs, 0), dtype=torch.long, device=env.device)
    return row_index(torch.stack(rows, dim=1) if rows else none), still, places


def in_every_env(env: Any, struct: Any, value: Any) -> Any:
    """`value` with a row for each env, NaN where an env lacks the struct; all NaN if the struct is unknown.

    Args:
        value: a value of `struct`, with a row for each env that has the struct; a single number holds for all envs.
    """
    if not isinstance(value, torch.Tensor) or value.shape[:1] == (env.num_envs,):
        return value
    if value.ndim == 0:
        return value.expand(env.num_envs)
    # Integers and bools have no NaN.
    dtype = value.dtype if value.is_floating_point() else torch.float32
    whole = value.new_full((env.num_envs, *value.shape[1:]), torch.nan, dtype=dtype)
    envs = () if struct is None else maniskill_private.envs_of(struct)
    if len(envs) == len(value):
        whole[torch.as_tensor(envs, device=value.device)] = value.to(dtype)
    return whole


def row_index(rows: torch.Tensor) -> Any:
    """(K,) rows for `rows_of`: on the tensor's device, or an array on the CPU."""
    return rows.long().numpy() if rows.is_cpu else rows.long()


def rows_of(tensor: Any, rows: Any) -> Any:
    """(K, D) copy from a tensor of the simulation; on the CPU an array, since numpy takes a quarter of torch's time for a
    few hundred numbers."""
    data = tensor.torch()
    return data.numpy().take(rows, axis=0) if data.is_cpu else data[rows]


def _named_structs(scene: Any) -> Iterator[tuple[str, str, list[Any]]]:
    """The articulation ("" for an actor), name and structs of each body."""
    for name, actors in _merged(scene.actors, scene.actor_views):
        yield "", name, actors
    for name, articulations in _merged(scene.articulations, scene.articulation_views):
        links: dict[str, list[Any]] = {}
        for articulation in articulations:
            for link in articulation.links:
                links.setdefault(link.name, []).append(link)
        for link_name, same in links.items():
            yield name, f"{name}/{link_name}", same


def _merged(structs: dict[str, Any], views: dict[Any, Any]) -> Iterator[tuple[str, list[Any]]]:
    """Structs by name; the parts of a merged view share one name."""
    view_of: dict[int, str] = {}
    for name, view in views.items():
        # Two objects of one env in one view cannot share a column, so they keep their own names.
        if len(set(maniskill_private.envs_of(view))) == len(maniskill_private.objects_of(view)):
            for thing in maniskill_private.objects_of(view):
                view_of.setdefault(id(thing), str(name if name is not None else view.name))
    grouped: dict[str, list[Any]] = {}
    for name, struct in structs.items():
        labels = {view_of.get(id(thing)) for thing in maniskill_private.objects_of(struct)}
        label = labels.pop() if len(labels) == 1 else None
        grouped.setdefault(name if label is None else label, []).append(struct)
    yield from grouped.items()


def _entity(thing: Any) -> sapien.Entity:
    return thing if isinstance(thing, sapien.Entity) else thing.entity
