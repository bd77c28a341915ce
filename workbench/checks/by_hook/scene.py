"""Checks of what ``_load_agent`` and ``_load_scene`` build, and of the simulation's settings."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mani_skill.utils.structs.actor import Actor

from workbench.checks.by_hook.placement import immovable
from workbench.checks.evidence.builds import Built
from workbench.checks.evidence.checkup import Check, Checkup, Found, NotApplicable, Note, NotKnown
from workbench.checks.evidence.meshes import is_hollow, triangles_in
from workbench.checks.evidence.over_seeds import OverSeeds, together, tried
from workbench.checks.results import Seen
from workbench.envs.broken_rule import Place
from workbench.envs.maniskill_private import envs_of, named_to_hide, objects_of
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.simulation.hiding import why_not_hidden
from workbench.machine.text import listed

DEEP_AT_LOAD = 0.005
"""Metres."""
MOST_LINKS = 64
MOST_TRIANGLES = 100_000
_RESETS = ("_initialize_episode", "_load_scene", "_load_agent", "set_state_dict", "set_state")
STILL = 1e-5
"""Metres, and numbers of a quaternion."""


def robot_pose(checkup: Checkup) -> Iterator[Found | Note]:
    """Of what was built."""
    robots = [each for each in _builds(checkup) if each.of_robot and each.kind == "articulation"]
    if not robots:
        raise NotApplicable("it has no robot")
    for name in dict.fromkeys(each.name for each in robots if each.quaternion is None):
        yield Found(
            f"{name} is built without an initial pose, at the origin. Write "
            "`super()._load_agent(options, sapien.Pose(p=[...]))` with a place where it touches nothing.",
            checkup.places.hook("_load_agent"),
        )


def initial_pose(checkup: Checkup) -> Iterator[Found | Note]:
    """Of what was built: bodies that collide and are somewhere else later, or inside something. Others cannot hurt."""
    unposed: dict[Place | None, list[str]] = {}
    own = [*_own(checkup)]
    if not own:
        raise NotApplicable("its own lines build no body")
    for each in own:
        if _is_unposed(checkup, each) and each.collision:
            unposed.setdefault(each.place, []).append(each.name)
    for place, names in unposed.items():
        yield Found(
            f"{_several(names)} built without an initial pose, at the origin. Set "
            "`builder.initial_pose = sapien.Pose(p=[...])` before it is built, to a place where it touches nothing.",
            place,
            len(names),
        )


def _is_unposed(checkup: Checkup, each: Built) -> bool:
    """Whether it should have an initial pose and has none. What stays at the origin is where it belongs, and a kinematic body
    harms only what it is inside of."""
    if each.quaternion is not None or each.kind == "static":
        return False
    if each.kind == "kinematic" and each.name not in _inside_others(checkup):
        return False
    return each.kind == "dynamic" or not checkup.look(_stay_at_origin).issuperset([each.name])


def _stay_at_origin(checkup: Checkup) -> set[str]:
    """Evidence: names of what no contact moves, and that is at the origin after a reset."""
    task = checkup.task
    checkup.reset(task, next(checkup.batches()))
    index, fixed = scene_index(task.env), immovable(checkup)
    moved = {owner for owner, name in zip(index.owners, index.names, strict=True) if name not in fixed}
    structs = {**task.env.scene.actors, **task.env.scene.articulations}
    origin = np.array([0, 0, 0, 1, 0, 0, 0])
    return {
        name
        for name, struct in structs.items()
        if name not in moved and (np.abs(struct.pose.raw_pose.numpy(force=True) - origin) < STILL).all()
    }


def _inside_others(checkup: Checkup) -> set[str]:
    """Names of the bodies that are built inside others, and of the parts of what they were merged to."""
    names = {body.split("/", 1)[0] for overlap in checkup.alone.overlaps for body in overlap.bodies}
    return names.union(*(merge.parts for merge in _merges(checkup) if merge.name in names))


def overlap_at_load(checkup: Checkup) -> Iterator[Found | Note]:
    """With one env, all bodies where they are built and all joints at zero."""
    builds = _builds(checkup)
    # Those have a rule of their own.
    unposed = {each.name for each in builds if _is_unposed(checkup, each)}
    unposed |= {str(merge.name) for merge in _merges(checkup) if not unposed.isdisjoint(merge.parts)}
    places = {each.name: each.place for each in builds}
    fixed = immovable(checkup)
    for overlap in checkup.alone.overlaps:
        owners = [body.split("/", 1)[0] for body in overlap.bodies]
        harmless = overlap.depth < DEEP_AT_LOAD or fixed.issuperset(overlap.bodies)
        if harmless or not unposed.isdisjoint(owners):
            continue
        own = [places[owner] for owner in owners if places.get(owner) is not None]
        first, second = overlap.bodies
        yield Found(
            f"{first} and {second} are built {1000 * overlap.depth:.0f} mm inside each other. Give one of them another "
            "initial pose; _initialize_episode moves it to where an episode begins.",
            own[0] if own else checkup.places.hook("_load_agent", "_load_scene"),
        )


def see_kinematic_never_moved(checkup: Checkup) -> Iterator[Seen]:
    """Over the resets of all seeds and random episodes, where no hook of a step sets a pose: it may do so later."""
    if any(
        _sets_a_pose(function) for _, function in checkup.places.functions() if function.name not in _RESETS
    ):
        raise NotKnown("it sets poses in a step, perhaps later than in the steps that were tried")
    index = scene_index(checkup.task.env)
    poses = np.concatenate([checkup.starts.poses, checkup.random.poses])
    yield Seen(tried=poses.shape[1])
    own = {each.name: each for each in _own(checkup) if each.kind == "kinematic"}
    for body, name in enumerate(index.names):
        if name in own and index.kinds[body] == "kinematic" and not index.hidden[body]:
            ends = poses[:, :, body].max(axis=(0, 1)), poses[:, :, body].min(axis=(0, 1))
            yield Seen((name,), own[name].place, numbers=tuple(np.concatenate(ends).tolist()))


def kinematic_never_moved(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """Bodies that are at the same pose for all seeds."""
    if not any(row.names for row in rows):
        raise NotApplicable("its own lines build no kinematic body that is seen")
    if tried(rows) < 2:
        raise NotKnown("it needs two seeds")
    still: dict[Place | None, list[str]] = {}
    for row in together(rows):
        ends = np.array([one.numbers for one in rows if one.names == row.names])
        apart = ends[:, :7].max(axis=0) - ends[:, 7:].min(axis=0)
        if not (np.nan_to_num(apart) > STILL).any():
            still.setdefault(row.place, []).append(row.names[0])
    for place, names in still.items():
        yield Found(
            f"{_several(names)} kinematic and at the same pose in every reset and step. Build it with "
            f"`builder.build_static(name={names[0]!r})` at its initial_pose, and do not set its pose.",
            place,
            len(names),
        )


def body_names(checkup: Checkup) -> Iterator[Found | Note]:
    """Of what was built and merged. ManiSkill's builders refuse a name that is taken; merging does not."""
    merges = {merge.parts: merge for merge in _merges(checkup)}.values()
    taken = Counter(merge.name for merge in merges)
    built = {each.name for each in _builds(checkup)}
    for merge in merges:
        if merge.name is None:
            yield Found(
                f"{len(merge.parts)} bodies are merged without a name. Write `Actor.merge(parts, name='...')`.",
                merge.place or checkup.places.hook("_load_scene"),
            )
        elif taken[merge.name] > 1 or merge.name in built - merge.parts:
            yield Found(
                f"{merge.name} is the name of {taken[merge.name] + (merge.name in built)} bodies. Give each a name of its own.",
                merge.place or checkup.places.hook("_load_scene"),
            )


def too_many_links(checkup: Checkup) -> Iterator[Found | Note]:
    """Of what was built."""
    places = _places_of(checkup)
    if not checkup.task.env.scene.articulations:
        raise NotApplicable("it has no articulation")
    for name, articulation in checkup.task.env.scene.articulations.items():
        if (count := len(articulation.links)) > MOST_LINKS:
            yield Found(
                f"{name} has {count} links. Join those with fixed joints between them, or divide it.",
                places.get(name) or checkup.places.hook("_load_agent", "_load_scene"),
            )


def hull_fills_hollow(checkup: Checkup) -> Iterator[Found | Note]:
    """Of the mesh files that bodies of the task collide as one convex hull."""
    files = _mesh_files(checkup, "convex_mesh")
    if not files:
        raise NotApplicable("no body of its own collides as the convex hull of a mesh file")
    unknown: list[str] = []
    for file, each in files.items():
        if (hollow := is_hollow(file)) is None:
            unknown.append(Path(file).name)
        elif hollow:
            yield Found(
                f"{each.name} collides as the convex hull of {Path(file).name}, which is hollow: nothing can be put into "
                "it. Use add_multiple_convex_collisions_from_file with a decomposed mesh, or boxes; for a body that "
                "never moves, add_nonconvex_collision_from_file.",
                each.place,
            )
    _require_read(unknown)


def decomposition_at_load(checkup: Checkup) -> Iterator[Found | Note]:
    """Of the source: building would need the package that decomposes."""
    checkup.require_source()
    for module, function in checkup.places.functions():
        for node in ast.walk(function):
            for keyword in node.keywords if isinstance(node, ast.Call) else ():
                value = keyword.value
                if (
                    keyword.arg == "decomposition"
                    and isinstance(value, ast.Constant)
                    and value.value != "none"
                ):
                    yield Found(
                        f"a mesh is decomposed with {value.value} where it is built. Do it once, ship the file that it "
                        "writes beside the mesh (.coacd.ply), and load that with decomposition='none'.",
                        module.place(value, function.name),
                    )


def heavy_mesh(checkup: Checkup) -> Iterator[Found | Note]:
    """Of the mesh files that bodies of the task are drawn with."""
    files = _mesh_files(checkup, "file")
    if not files:
        raise NotApplicable("no body of its own is drawn from a mesh file")
    unknown: list[str] = []
    for file, each in files.items():
        if (count := triangles_in(file, MOST_TRIANGLES)) is None:
            unknown.append(Path(file).name)
        elif count > MOST_TRIANGLES:
            yield Found(
                f"{each.name} is drawn with {count:,} triangles ({Path(file).name}). Reduce the mesh "
                "(trimesh: mesh.simplify_quadric_decimation(face_count=20_000)).",
                each.place,
            )
    _require_read(unknown)


def _require_read(unknown: list[str]) -> None:
    if unknown:
        raise NotKnown(f"cannot be read, or has too many triangles to look at: {listed(unknown)}")


def merged_actors(checkup: Checkup) -> Iterator[Found | Note]:
    """Of the structs in the state dict."""
    index, count = scene_index(checkup.task.env), checkup.num_envs
    places = _places_of(checkup)
    part = {name: merge for merge in _merges(checkup) for name in merge.parts}
    partial = [name for name, struct in index.states.items() if len(envs_of(struct)) != count]
    if partial:
        names = [name.split("/", 1)[1] for name in partial]
        merge = next((part[name] for name in names if name in part), None)
        rows = sorted({len(envs_of(index.states[name])) for name in partial})
        advice = (
            f"Merge those that stand for one body: Actor.merge([...], name={names[0].rstrip('0123456789_-')!r}), and"
            if merge is None
            else "After the merge,"
        )
        yield Found(
            f"{_several(names, 'has', 'have')} {listed(rows)} rows in the state of {count} envs. "
            f"{advice} call self.remove_from_state_dict_registry(part) for each part and "
            "self.add_to_state_dict_registry(merged).",
            merge.place if merge is not None and merge.place else places.get(names[0]),
            len(partial),
        )
    kept = {id(thing) for struct in index.states.values() for thing in objects_of(struct)}
    for name, actor in checkup.task.env.scene.actors.items():
        lost = [thing for thing in objects_of(actor) if id(thing) not in kept]
        if lost and actor.px_body_type == "dynamic":
            yield Found(
                f"{name} moves, and is not in the state. Call self.add_to_state_dict_registry(merged) with what it was "
                "merged into.",
                places.get(name) or checkup.places.hook("_load_scene"),
            )
            return
    if not partial:
        # One that stands in each env alone has as many rows then as all others.
        checkup.require_several()


def hidden_objects(checkup: Checkup) -> Iterator[Found | Note]:
    """Of ``_hidden_objects``, and of the actors that those are merged into."""
    env: Any = checkup.task.env
    hidden = named_to_hide(env)
    if not hidden:
        raise NotApplicable("it hides nothing from pictures")
    for thing in hidden:
        if why := why_not_hidden(thing):
            yield Found(
                f"ManiSkill cannot hide {thing.name}: {why}. Every picture of a sensor fails.",
                _hiding_line(checkup, thing),
            )
    known = {id(thing) for thing in hidden}
    for merged in env.scene.actor_views.values():
        of_view = {id(thing) for thing in objects_of(merged)}
        parts = [
            each
            for each in hidden
            if isinstance(each, Actor) and not of_view.isdisjoint(map(id, objects_of(each)))
        ]
        if parts and id(merged) not in known:
            name = _name_on(env, merged) or merged.name
            yield Found(
                f"{_several([part.name for part in parts], 'is', 'are')} hidden, and {merged.name}, which "
                f"{'it is' if len(parts) == 1 else 'they are'} merged into, is not: on a GPU hiding moves a body 99999 m away, "
                f"so the pose of {merged.name} is wrong, and sensors see it again once that is set. Hide the merged actor "
                f"instead: {name}.has_collision_shapes = False, then self._hidden_objects.append({name}).",
                _hiding_line(checkup, parts[0]),
                len(parts),
            )


def _name_on(env: Any, thing: Any) -> str:
    """``self.goal`` of what the task keeps as that; empty if it does not."""
    return next((f"self.{name}" for name, value in vars(env).items() if value is thing), "")


def _hiding_line(checkup: Checkup, thing: Any) -> Place | None:
    """The line that puts it into ``_hidden_objects``: one that names it, else the first."""
    name = _name_on(checkup.task.env, thing)
    lines = [
        (name != "" and name in ast.unparse(statement), module.place(statement))
        for module, function in checkup.places.functions()
        for statement in ast.walk(function)
        if isinstance(statement, ast.Expr | ast.Assign | ast.AugAssign)
        and any(
            isinstance(node, ast.Attribute) and node.attr == "_hidden_objects" for node in ast.walk(statement)
        )
    ]
    lines.sort(key=lambda line: not line[0])
    return lines[0][1] if lines else checkup.places.hook("_load_scene")


def reconfigures(checkup: Checkup) -> Iterator[Found | Note]:
    """With one env, built for several seeds."""
    alone = checkup.alone
    if len(set(alone.shapes.values())) > 1 and not alone.rebuilds:
        yield Found(
            "One env is built with other shapes or colours for another seed, and never rebuilt after the first. In "
            "__init__, take `reconfiguration_freq=None` and, if it is None, hand on 1 for num_envs == 1 and 0 otherwise.",
            checkup.places.hook("__init__", "_load_scene"),
        )
    elif not alone.rebuilds:
        raise NotApplicable(f"the seeds {listed(alone.seeds)} build the same")


def see_env_spacing(checkup: Checkup) -> Iterator[Seen]:
    """Over the resets of all seeds and random episodes: a row for each body that comes too far."""
    index, half = scene_index(checkup.task.env), checkup.task.env.sim_config.spacing / 2
    moving = [i for i, kind in enumerate(index.kinds) if kind in ("dynamic", "link") and not index.hidden[i]]
    poses = np.concatenate([checkup.starts.poses, checkup.random.poses])[:, :, moving]
    if not moving:
        raise NotApplicable("nothing in it moves")
    away = np.nan_to_num(np.abs(poses[..., :2]).max(axis=-1))
    yield Seen(tried=away.shape[1])
    for row, body in enumerate(moving):
        far = away[:, :, row]
        if far.max() > half:
            seeds = tuple(checkup.starts.seeds[i] for i in np.flatnonzero((far > half).any(axis=0)))
            place = _settings(checkup)
            yield Seen(
                (index.names[body],), place, seeds=seeds, size=float(far.max()), numbers=(float(half),)
            )


def env_spacing(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    found = together(rows)
    if found:
        row = max(found, key=lambda row: row.size)
        yield Found(
            f"{row.names[0]} comes {row.size:.1f} m from the middle of its env in {len(row.seeds)} of "
            f"{tried(rows)} episodes, and the middles are {2 * row.numbers[0]:g} m apart. Return "
            f"`SimConfig(spacing={np.ceil(2.5 * row.size):g})` from _default_sim_config, or keep it nearer.",
            row.place,
            len(row.seeds),
        )


def _sets_a_pose(function: ast.FunctionDef) -> bool:
    """Whether it calls set_pose or set_state, or assigns a pose."""
    for node in ast.walk(function):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            if node.func.attr in ("set_pose", "set_state", "set_state_dict"):
                return True
        elif isinstance(node, ast.Assign):
            if any(isinstance(to, ast.Attribute) and to.attr == "pose" for to in node.targets):
                return True
    return False


def _several(names: list[str], one: str = "is", many: str = "are") -> str:
    return f"{names[0]} {one}" if len(names) == 1 else f"{names[0]} and {len(names) - 1} more {many}"


def _settings(checkup: Checkup) -> Place | None:
    return checkup.places.hook("_default_sim_config")


def _builds(checkup: Checkup) -> list[Built]:
    assert checkup.task
    return checkup.builds


def _merges(checkup: Checkup) -> list:
    assert checkup.task
    return checkup.merges


def _own(checkup: Checkup) -> Iterator[Built]:
    """What the author's files build, of bodies of one kind for each env only the first; without robots."""
    lines = set()
    for each in _builds(checkup):
        if each.place is not None and not each.of_robot and (each.place, each.name) not in lines:
            lines.add((each.place, each.name))
            yield each


def _places_of(checkup: Checkup) -> dict[str, Place | None]:
    return {each.name: each.place for each in _builds(checkup)}


def _mesh_files(checkup: Checkup, kind: str) -> dict[str, Built]:
    """The files of the task's bodies that are used as this kind of shape, each with the first body that uses it."""
    found: dict[str, Built] = {}
    for each in _own(checkup):
        for shape in each.collision + each.visual:
            if shape.kind == kind and shape.file:
                found.setdefault(shape.file, each)
    return found


CHECKS: Mapping[str, Check] = {
    "robot-pose": robot_pose,
    "initial-pose": initial_pose,
    "overlap-at-load": overlap_at_load,
    "kinematic-never-moved": OverSeeds(see_kinematic_never_moved, kinematic_never_moved),
    "body-names": body_names,
    "too-many-links": too_many_links,
    "hull-fills-hollow": hull_fills_hollow,
    "decomposition-at-load": decomposition_at_load,
    "heavy-mesh": heavy_mesh,
    "merged-actors": merged_actors,
    "hidden-objects": hidden_objects,
    "reconfigures": reconfigures,
    "env-spacing": OverSeeds(see_env_spacing, env_spacing),
}
