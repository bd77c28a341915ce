"""Checks of what ``_load_agent`` and ``_load_scene`` build, and of the simulation's settings."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mani_skill.utils.structs.actor import Actor

from workbench.checks.evidence.builds import Built
from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note, NotKnown
from workbench.checks.evidence.meshes import is_hollow, triangles_in
from workbench.checks.evidence.over_seeds import together, tried
from workbench.checks.register_rule import rule
from workbench.checks.results import Seen
from workbench.envs.broken_rule import Place
from workbench.envs.maniskill_private import envs_of, named_to_hide, objects_of
from workbench.envs.overlaps import immovable
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.simulation.hiding import why_not_hidden
from workbench.machine.text import listed

OVERLAP_METRES = 0.005
"""Minimum depth in metres of an overlap that counts."""
MAX_LINKS = 64
"""Maximum number of links of an articulation in PhysX on the GPU."""
MAX_TRIANGLES = 100_000
"""Maximum number of triangles of a drawn mesh."""
_RESETS = ("_initialize_episode", "_load_scene", "_load_agent", "set_state_dict", "set_state")
STILL_TOLERANCE = 1e-5
"""Maximum difference of poses that count as equal, in metres and in components of a quaternion."""


@rule("robot-pose", "warn", "_load_agent")
def robot_pose(checkup: Checkup) -> Iterator[Found | Note]:
    """_load_agent gives the robot an initial pose.

    The robot is built at the origin, inside the bodies that are there, and the GPU simulation starts with the
    collision.

    ## Why
    Without a pose, ManiSkill builds the robot at the origin and prints a warning. The GPU simulation makes a
    first step before `_initialize_episode` is called. A robot that stands in the table or in a cube at that
    moment is pushed out with great force, in each of 4096 envs.

    ## Fix
    Give the robot the place where it stands, or any other place where it touches nothing.

    ```python fragment
    def _load_agent(self, options: dict):
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))
    ```

    ## How it is checked
    The rule notes the builders of robots while the task is built, and reports a robot whose builder has no
    `initial_pose`. The result is *not applicable* for a task without a robot. The rule does not see whether
    the given pose is a good one ([overlap-at-load](overlap-at-load.md) does).
    """
    robots = [each for each in _builds(checkup) if each.of_robot and each.kind == "articulation"]
    if not robots:
        raise NotApplicable("the task has no robot")
    for name in dict.fromkeys(each.name for each in robots if each.quaternion is None):
        yield Found(
            f"{name} is built without an initial pose, at the origin. Write "
            "`super()._load_agent(options, sapien.Pose(p=[...]))` with a place where it touches nothing.",
            checkup.places.hook("_load_agent"),
        )


@rule("initial-pose", "warn", "_load_scene")
def initial_pose(checkup: Checkup) -> Iterator[Found | Note]:
    """Every builder has an initial_pose before its body is built.

    The GPU simulation makes its first step with the bodies inside each other at the origin.

    ## Why
    A builder without `initial_pose` puts its body at the origin, and ManiSkill prints a warning. Several such
    bodies are inside each other there. The GPU simulation makes a first step before `_initialize_episode` is
    called: the collision takes memory for contacts and can throw bodies away.

    ## Fix
    Set a pose before the body is built, a different one for each body.

    ```python fragment
    builder = self.scene.create_actor_builder()
    builder.add_box_collision(half_size=[0.02] * 3)
    builder.initial_pose = sapien.Pose(p=[0, 0, 0.02])
    self.cube = builder.build(name="cube")
    ```

    ## How it is checked
    The rule notes the builders that the author's files use while the task is built, including those of
    `actors.build_cube` and the like. It leaves out bodies without a collision shape. It also leaves out
    bodies that stay at the origin for good: static bodies, and, if no reset moves them, kinematic bodies and
    fixed articulations without a movable joint. [overlap-at-load](overlap-at-load.md) reports other bodies
    inside them. The rule also leaves out a kinematic body that a reset moves, unless it is built inside
    another body. Robots have their own rule ([robot-pose](robot-pose.md)).
    """
    unposed: dict[Place | None, list[str]] = {}
    own = [*_own(checkup)]
    if not own:
        raise NotApplicable("your files build no body")
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
    """Whether a body should have an initial pose and has none. A body that stays at the origin needs no pose,
    and a kinematic body does harm only if it is built inside another body."""
    if each.quaternion is not None or each.kind == "static":
        return False
    if each.kind == "kinematic" and each.name not in _inside_others(checkup):
        return False
    return each.kind == "dynamic" or not checkup.look(_stay_at_origin).issuperset([each.name])


def _stay_at_origin(checkup: Checkup) -> set[str]:
    """Evidence: names of the bodies that no contact moves and that are at the origin after a reset."""
    task = checkup.task
    checkup.reset(task, next(checkup.batches()))
    index, fixed = scene_index(task.env), immovable(checkup.task.env)
    moved = {owner for owner, name in zip(index.owners, index.names, strict=True) if name not in fixed}
    structs = {**task.env.scene.actors, **task.env.scene.articulations}
    origin = np.array([0, 0, 0, 1, 0, 0, 0])
    return {
        name
        for name, struct in structs.items()
        if name not in moved
        and (np.abs(struct.pose.raw_pose.numpy(force=True) - origin) < STILL_TOLERANCE).all()
    }


def _inside_others(checkup: Checkup) -> set[str]:
    """Names of the bodies that are built inside others, and of the parts of merged bodies among them."""
    names = {body.split("/", 1)[0] for overlap in checkup.alone.overlaps for body in overlap.bodies}
    return names.union(*(merge.parts for merge in _merges(checkup) if merge.name in names))


@rule("overlap-at-load", "warn", "_load_scene")
def overlap_at_load(checkup: Checkup) -> Iterator[Found | Note]:
    """Bodies do not overlap where they are built, before the first reset.

    The first step of the GPU simulation may throw the bodies apart, and needs more memory
    for contacts.

    ## Why
    The GPU simulation makes a first step with all bodies where their builders put them and all joints at
    zero, before `_initialize_episode` is called. Bodies inside each other get large velocities and many
    contacts in that step. With 4096 envs the buffers for contacts may overflow, and a body may be far away
    when training begins.

    ## Fix
    Choose initial poses that are apart; the reset moves the bodies to where an episode begins.

    ```python fragment
    builder.initial_pose = sapien.Pose(p=[0, 0, 0.02])  # on the table, not in it
    self.cube_a = builder.build(name="cube_a")
    other.initial_pose = sapien.Pose(p=[1, 0, 0.02])  # far from the first
    self.cube_b = other.build(name="cube_b")
    ```

    ## How it is checked
    The rule builds one env, puts all bodies to their initial poses with joints at zero, and reads the
    contacts of one substep. Overlaps of at least 5 mm count. The rule leaves out links of one articulation,
    pairs in which neither body can move, and what [initial-pose](initial-pose.md) reports. It does not see
    overlaps in other envs, whose bodies may have other shapes.
    """
    builds = _builds(checkup)
    # The rule initial-pose reports these.
    unposed = {each.name for each in builds if _is_unposed(checkup, each)}
    unposed |= {str(merge.name) for merge in _merges(checkup) if not unposed.isdisjoint(merge.parts)}
    places = {each.name: each.place for each in builds}
    fixed = immovable(checkup.task.env)
    for overlap in checkup.alone.overlaps:
        owners = [body.split("/", 1)[0] for body in overlap.bodies]
        harmless = overlap.depth < OVERLAP_METRES or fixed.issuperset(overlap.bodies)
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
    """A row for each kinematic body, with the range of its pose over resets and random episodes. Raises
    NotKnown if a function outside `_RESETS` sets a pose: it may move a body after the steps that were
    tried."""
    if any(
        _sets_a_pose(function) for _, function in checkup.places.functions() if function.name not in _RESETS
    ):
        raise NotKnown("the task sets poses in a step, perhaps later than in the steps that were tried")
    index = scene_index(checkup.task.env)
    poses = np.concatenate([checkup.starts.poses, checkup.random.poses])
    yield Seen(tried=poses.shape[1])
    own = {each.name: each for each in _own(checkup) if each.kind == "kinematic"}
    for body, name in enumerate(index.names):
        if name in own and index.kinds[body] == "kinematic" and not index.hidden[body]:
            ends = poses[:, :, body].max(axis=(0, 1)), poses[:, :, body].min(axis=(0, 1))
            yield Seen((name,), own[name].place, numbers=tuple(np.concatenate(ends).tolist()))


@rule("kinematic-never-moved", "warn", "_load_scene", see=see_kinematic_never_moved)
def kinematic_never_moved(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """A body that is never moved is built static.

    A kinematic body costs GPU memory and time in each of thousands of envs.

    ## Why
    A kinematic body has a row in the state of each env, and PhysX looks at it in each step. A static body has
    neither cost. With thousands of envs the difference in memory and time is large.

    ## Fix
    Build the body static. Its place is its initial pose; a static body cannot be moved afterwards.

    ```python fragment
    builder.initial_pose = sapien.Pose(p=[0.3, 0, 0.1])
    self.wall = builder.build_static(name="wall")
    ```

    ## How it is checked
    The rule compares the poses of all seeds after their reset and of random episodes. It reports a kinematic
    body that the author's files build and that has one pose in all of them. The result is *not known* if a
    function other than `_load_agent`, `_load_scene`, `_initialize_episode`, `set_state` and `set_state_dict`
    sets a pose: it might move the body in an episode that was not seen. The result is also *not known* with
    one seed. Hidden bodies are left out.
    """
    if not any(row.names for row in rows):
        raise NotApplicable("the author's files build no visible kinematic body")
    if tried(rows) < 2:
        raise NotKnown("the rule needs two seeds")
    still: dict[Place | None, list[str]] = {}
    for row in together(rows):
        ends = np.array([one.numbers for one in rows if one.names == row.names])
        apart = ends[:, :7].max(axis=0) - ends[:, 7:].min(axis=0)
        if not (np.nan_to_num(apart) > STILL_TOLERANCE).any():
            still.setdefault(row.place, []).append(row.names[0])
    for place, names in still.items():
        yield Found(
            f"{_several(names)} kinematic and at the same pose in every reset and step. Build it with "
            f"`builder.build_static(name={names[0]!r})` at its initial_pose, and do not set its pose.",
            place,
            len(names),
        )


@rule("body-names", "warn", "_load_scene")
def body_names(checkup: Checkup) -> Iterator[Found | Note]:
    """Each body has its own name.

    The second body that is merged under a name replaces the first one, in the scene and in the state.

    ## Why
    A scene finds bodies by name, and so does its state. `Actor.merge` accepts a name that is taken, and None:
    the second body replaces the first one in `scene.actor_views`, and the state of one of them is neither
    saved nor restored.

    ## Fix
    Give each merged body its own name.

    ```python fragment
    self.pegs = Actor.merge(pegs, name="peg")
    self.boxes = Actor.merge(boxes, name="box_with_hole")
    ```

    ## How it is checked
    The rule notes calls of `Actor.merge` and `Articulation.merge` while the task is built. ManiSkill itself
    refuses two builders with one name, at the line that builds the second body. The rule does not see a body
    that is renamed later.
    """
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


@rule("too-many-links", "warn", "_load_scene")
def too_many_links(checkup: Checkup) -> Iterator[Found | Note]:
    """An articulation has at most 64 links.

    PhysX on the GPU refuses more.

    ## Why
    PhysX on the GPU takes articulations of at most 64 links. A longer one works on the CPU, so the task fails
    only where it is to train.

    ## Fix
    Weld links that need no joint into one, or divide the articulation.

    ```python fragment
    base = builder.create_link_builder(None)
    for box in boxes:  # one link with many shapes, not a link for each
        base.add_box_collision(pose=box.pose, half_size=box.half_size)
    ```

    ## How it is checked
    The rule counts the links of each articulation after the task is built. Links with a fixed joint count
    too.
    """
    places = _places_of(checkup)
    if not checkup.task.env.scene.articulations:
        raise NotApplicable("the task has no articulation")
    for name, articulation in checkup.task.env.scene.articulations.items():
        if (count := len(articulation.links)) > MAX_LINKS:
            yield Found(
                f"{name} has {count} links, more than PhysX on the GPU accepts. Join links that have a fixed joint between "
                "them, or divide the articulation.",
                places.get(name) or checkup.places.hook("_load_agent", "_load_scene"),
            )


@rule("hull-fills-hollow", "warn", "_load_scene")
def hull_fills_hollow(checkup: Checkup) -> Iterator[Found | Note]:
    """A hollow mesh is not replaced by its convex hull for collisions.

    Nothing can be put into a bowl or a box: an invisible lid is in the way.

    ## Why
    `add_convex_collision_from_file` collides as the convex hull of the mesh. A bowl, a cup or a box then has
    a lid that is not drawn: what is put into it lies on top, and no policy can solve the task.

    ## Fix
    Collide as several convex parts, or as the mesh itself if the body never moves.

    ```python fragment
    builder.add_multiple_convex_collisions_from_file("bowl.coacd.ply")
    builder.add_visual_from_file("bowl.glb")
    self.bowl = builder.build(name="bowl")
    ```

    ## How it is checked
    For each mesh file whose convex hull is a collision shape of a body of the author's files, the rule casts
    rays from the middle of the hull in 162 directions. The mesh is hollow if most rays meet a wall, and the
    rays that meet nothing are on one side. The result is *not applicable* without such a mesh, and *not
    known* for meshes of more than 50,000 triangles. Flat plates and rings do not count as hollow. The rule
    does not know whether the task puts anything into the body.
    """
    files = _mesh_files(checkup, "convex_mesh")
    if not files:
        raise NotApplicable("no body of the author's files collides as the convex hull of a mesh file")
    unknown: list[str] = []
    for file, each in files.items():
        if (hollow := is_hollow(file)) is None:
            unknown.append(Path(file).name)
        elif hollow:
            yield Found(
                f"The collision shape of {each.name} is the convex hull of {Path(file).name}, which is hollow: nothing can be put into "
                "it. Use add_multiple_convex_collisions_from_file with a decomposed mesh, or boxes; for a body that "
                "never moves, add_nonconvex_collision_from_file.",
                each.place,
            )
    _require_read(unknown)


@rule("decomposition-at-load", "warn", "_load_scene")
def decomposition_at_load(checkup: Checkup) -> Iterator[Found | Note]:
    """Convex decompositions are loaded from files, not made while a task loads.

    The first process on each machine waits for the decomposition, seconds to minutes for a mesh, and needs
    the package coacd.

    ## Why
    A convex decomposition takes seconds to minutes for each mesh. The first process on each machine makes it,
    and writes it to a file next to the mesh. On a cluster each node waits for it and several processes write
    the same file; where the folder is read-only, the decomposition is made again each time. Making it also
    needs the package coacd on each machine.

    ## Fix
    Make the decomposition once, ship the file that it writes, and load that file.

    ```python fragment
    builder.add_multiple_convex_collisions_from_file(
        "bowl.ply.coacd.ply",  # written by decomposition="coacd", once
        decomposition="none",
    )
    ```

    ## How it is checked
    The rule reads the author's source for calls with `decomposition=` and a constant other than "none". It
    does not see a value that is computed.
    """
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
                        f"This line decomposes a mesh with {value.value} while the task is built. Decompose it once, ship "
                        "the file that is written next to it (.coacd.ply), and load that file with decomposition='none'.",
                        module.place(value, function.name),
                    )


@rule("heavy-mesh", "warn", "_load_scene")
def heavy_mesh(checkup: Checkup) -> Iterator[Found | Note]:
    """Drawn meshes have at most 100,000 triangles.

    Pictures are slow, and the mesh takes memory of the GPU renderer.

    ## Why
    A mesh from a scanner or a CAD program may have millions of triangles. Every render of every env draws
    them, and a renderer on the GPU keeps them in memory. A picture of 128 x 128 pixels shows none of that
    detail.

    ## Fix
    Reduce the mesh once, and draw the reduced one.

    ```python fragment
    import trimesh

    mesh = trimesh.load("engine.glb", force="mesh")
    mesh.simplify_quadric_decimation(face_count=20_000).export("engine_small.glb")
    ```

    ## How it is checked
    The rule counts the triangles of each mesh file that draws a body of the author's files, and reports
    more than 100,000. It does not read files that are too small to have so many. Robots are left out.
    """
    files = _mesh_files(checkup, "file")
    if not files:
        raise NotApplicable("no body of the author's files is drawn from a mesh file")
    unknown: list[str] = []
    for file, each in files.items():
        if (count := triangles_in(file, MAX_TRIANGLES)) is None:
            unknown.append(Path(file).name)
        elif count > MAX_TRIANGLES:
            yield Found(
                f"{each.name} is drawn with {count:,} triangles ({Path(file).name}). Reduce the mesh "
                "(trimesh: mesh.simplify_quadric_decimation(face_count=20_000)).",
                each.place,
            )
    _require_read(unknown)


def _require_read(unknown: list[str]) -> None:
    if unknown:
        raise NotKnown(f"mesh files that cannot be read or have too many triangles: {listed(unknown)}")


@rule("merged-actors", "warn", "_load_scene")
def merged_actors(checkup: Checkup) -> Iterator[Found | Note]:
    """If actors are made for each env and merged, only the merged actor is in the state.

    The state dict has entries with another batch size: it cannot be saved, sliced or restored.

    ## Why
    Objects that differ from env to env are built one by one and merged. For each part, the state dict then
    still has an entry of one row, next to entries of N rows. Such a state cannot be sliced by env, written to a
    trajectory file of all envs, or restored in another env. If the merged body is not in the state at all,
    replays do not restore its pose.

    ## Fix
    Remove the parts from the state dict, and add the merged actor.

    ```python fragment
    self.peg = Actor.merge(pegs, name="peg")
    for part in pegs:
        self.remove_from_state_dict_registry(part)
    self.add_to_state_dict_registry(self.peg)
    ```

    ## How it is checked
    The rule compares the number of rows of each body in the state with the N envs of the check, and looks for
    each dynamic body in the state. It also reports bodies that only some envs have. The result is *not known*
    with one env, since each body then has as many rows as there are envs.
    """
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
                f"{name} is a dynamic body and not in the state. Call self.add_to_state_dict_registry(...) with {name}, "
                "or with the actor that it was merged into.",
                places.get(name) or checkup.places.hook("_load_scene"),
            )
            return
    if not partial:
        # With one env each body has as many rows as there are envs.
        checkup.require_several()


@rule("hidden-objects", "warn", "_load_scene")
def hidden_objects(checkup: Checkup) -> Iterator[Found | Note]:
    """_hidden_objects has only actors without collision shapes, and a merged actor instead of its parts.

    Poses are wrong and sensors see what should be hidden, or every picture fails.

    ## Why
    GPU simulation hides an actor by moving it 99999 m away; ManiSkill keeps the real pose on that actor. If
    only the parts of a merged actor are hidden, ManiSkill keeps no real pose for the merged actor: its `pose`
    is 99999 m off, in `evaluate()` and in the observation, and setting its pose brings the parts back into
    the view of the sensors for good. The CPU backends, stock and batched, do not show this, since they hide
    an actor by its visibility.

    An articulation, a static actor, an actor with collision shapes, and a merged actor that may have
    collision shapes cannot be hidden at all: every picture of a sensor fails.

    ## Fix
    Hide the merged actor, and declare that this actor does not collide: ManiSkill does not determine that
    itself.

    ```python fragment
    self.goal = Actor.merge(goals, name="goal")
    self.goal.has_collision_shapes = False
    self._hidden_objects.append(self.goal)
    ```

    ## How it is checked
    The rule reads `_hidden_objects` after a reset. It reports an entry that cannot be hidden, and an entry
    that is part of a merged actor if the merged actor is not in the list. The result is *not applicable* if
    nothing is hidden.
    """
    env: Any = checkup.task.env
    hidden = named_to_hide(env)
    if not hidden:
        raise NotApplicable("the task hides nothing from pictures")
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
                f"so the pose of {merged.name} is wrong, and sensors see it again after its pose is set. Hide the merged actor "
                f"instead: {name}.has_collision_shapes = False, then self._hidden_objects.append({name}).",
                _hiding_line(checkup, parts[0]),
                len(parts),
            )


def _name_on(env: Any, thing: Any) -> str:
    """The attribute that holds a body, such as ``self.goal``; empty if none does."""
    return next((f"self.{name}" for name, value in vars(env).items() if value is thing), "")


def _hiding_line(checkup: Checkup, thing: Any) -> Place | None:
    """The line that puts a body into ``_hidden_objects``: the first line that names both, else the first line
    that names ``_hidden_objects``."""
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


@rule("reconfigures", "warn", "_load_scene")
def reconfigures(checkup: Checkup) -> Iterator[Found | Note]:
    """A scene with random shapes is rebuilt regularly (reconfiguration_freq); with one env, at each
    reset.

    A single env trains on the same objects forever.

    ## Why
    A scene is built when the env is made, and again only if `reconfiguration_freq` says so. With thousands of
    envs each env has another object, which is variety enough. A single env, as in evaluation and in data
    collection, has the same object forever.

    ## Fix
    Rebuild one env at each reset, and many envs never.

    ```python fragment
    def __init__(self, *args, num_envs=1, reconfiguration_freq=None, **kwargs):
        if reconfiguration_freq is None:
            reconfiguration_freq = 1 if num_envs == 1 else 0
        super().__init__(*args, num_envs=num_envs, reconfiguration_freq=reconfiguration_freq, **kwargs)
    ```

    ## How it is checked
    The rule builds one env for two seeds. It reports a task whose shapes, sizes, colours, frictions or mesh
    files differ between the seeds and whose `reconfiguration_freq` is 0 with one env. The result is *not
    applicable* if the two builds are equal. The builds of two seeds may be equal by chance, and the rule does
    not look at the random numbers of a reset.
    """
    alone = checkup.alone
    if len(set(alone.shapes.values())) > 1 and not alone.rebuilds:
        yield Found(
            "The shapes or colours depend on the seed, but a single env keeps those of its first seed. Let __init__ accept "
            "`reconfiguration_freq=None` and, if it is None, pass 1 to BaseEnv for num_envs == 1, else 0.",
            checkup.places.hook("__init__", "_load_scene"),
        )
    elif not alone.rebuilds:
        raise NotApplicable(f"the seeds {listed(alone.seeds)} build the same scene")


def see_env_spacing(checkup: Checkup) -> Iterator[Seen]:
    """A row for each body that is ever further from the middle of its env, in x or y, than half of the
    spacing between envs. Looks at resets and random episodes."""
    index, half = scene_index(checkup.task.env), checkup.task.env.sim_config.spacing / 2
    moving = [i for i, kind in enumerate(index.kinds) if kind in ("dynamic", "link") and not index.hidden[i]]
    poses = np.concatenate([checkup.starts.poses, checkup.random.poses])[:, :, moving]
    if not moving:
        raise NotApplicable("nothing in the task moves")
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


@rule("env-spacing", "warn", "_default_sim_config", see=see_env_spacing)
def env_spacing(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """Bodies that move stay within half of the spacing between envs (scene_config, sim_config.spacing).

    All envs of a GPU simulation share one space: bodies of neighbours meet.

    ## Why
    All envs of a GPU simulation are in one space, `spacing` metres apart (5 by default). A body that is
    further than half of the spacing from the middle of its env meets the bodies of a neighbour: it is pushed
    out of nowhere, and episodes depend on each other. On the CPU each env has its own space, so nothing shows
    there.

    ## Fix
    Raise the spacing, or keep the bodies nearer.

    ```python fragment
    @property
    def _default_sim_config(self):
        return SimConfig(spacing=12)
    ```

    ## How it is checked
    The rule follows the x and y of all moving bodies over the resets of all seeds and random episodes of 50
    steps. It looks at the middle of a body, not at its edge, and does not see how far a trained policy goes.
    """
    found = together(rows)
    if found:
        row = max(found, key=lambda row: row.size)
        yield Found(
            f"{row.names[0]} is up to {row.size:.1f} m from the middle of its env in {len(row.seeds)} of "
            f"{tried(rows)} episodes, and the envs are {2 * row.numbers[0]:g} m apart. Return "
            f"`SimConfig(spacing={np.ceil(2.5 * row.size):g})` from _default_sim_config, or keep the body closer to the middle.",
            row.place,
            len(row.seeds),
        )


def _sets_a_pose(function: ast.FunctionDef) -> bool:
    """Whether a function calls set_pose or set_state, or assigns a pose."""
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
    """Bodies that the author's files build, except robots. A body that is built once for each env is given
    only once."""
    lines = set()
    for each in _builds(checkup):
        if each.place is not None and not each.of_robot and (each.place, each.name) not in lines:
            lines.add((each.place, each.name))
            yield each


def _places_of(checkup: Checkup) -> dict[str, Place | None]:
    return {each.name: each.place for each in _builds(checkup)}


def _mesh_files(checkup: Checkup, kind: str) -> dict[str, Built]:
    """The files that bodies of the task use as this kind of shape, each with the first body that uses it."""
    found: dict[str, Built] = {}
    for each in _own(checkup):
        for shape in each.collision + each.visual:
            if shape.kind == kind and shape.file:
                found.setdefault(shape.file, each)
    return found
