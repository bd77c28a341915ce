"""Checks of where a reset puts things: inside each other, falling, out of reach, turned wrongly."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from mani_skill.agents.controllers.pd_ee_pose import PDEEPosController
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosController
from mani_skill.utils.structs.link import Link
from numpy.typing import NDArray

from workbench.checks.evidence.checkup import Check, Checkup, Found, NotApplicable, Note, NotKnown
from workbench.checks.evidence.episode_batches import SeenOutlier
from workbench.checks.evidence.over_seeds import OverSeeds, together, tried
from workbench.checks.results import Seen
from workbench.envs.action_vector import random_action
from workbench.envs.broken_rule import Place
from workbench.envs.maniskill_private import agents, apply_and_fetch, objects_of
from workbench.envs.scene.scene_index import SceneIndex, joints_of_scene, present_states, scene_index
from workbench.machine.text import listed, of
from workbench.task.problem import TaskError

DEEP = 0.002
"""Metres that two bodies may overlap: contacts of bodies at rest are about so deep."""
MOVED, TURNED = 0.02, 0.35
"""Metres and radians in a second. A body that is put down 1 cm above the table may settle."""
STARTS_MOVING = 0.01
"""Of a velocity, in m/s or rad/s: the task wants that body to move."""
SAGGED = {"prismatic": 0.02, "revolute": 0.1}
"""Metres and radians in a second."""
POSTURES = 40
"""Random postures of each env's robot from which its reach is found."""
REACH_MARGIN = 0.05
"""Metres that a body's middle may be further away than the robot comes."""
NOT_UNIT = 1e-3
_CREATED = ("zeros", "ones", "rand", "randn", "randint", "empty", "full", "tile", "arange")
_SIZED = ("repeat", "expand", "new_zeros", "new_ones", "uniform", "normal", "view", "reshape")
_REORDERED = ("roll", "scalar_first", "wxyz", "[3, 0, 1, 2]", "xyzw")


def batch_of_reset(checkup: Checkup) -> Iterator[Found | Note]:
    """Whether a partial reset fails, or breaks a rule, at a line that uses a tensor of self.num_envs rows."""
    checkup.require_several()
    task, rng = checkup.task, np.random.default_rng(4)
    checkup.reset(task, list(range(checkup.num_envs)))
    # So that what is kept for each env differs from what a reset gives it.
    checkup.step(task, random_action(task.parts, task.num_envs, rng))
    failed: TaskError | None = None
    try:
        for chosen in ([0], list(range(1, checkup.num_envs))):
            checkup.reset(task, None, chosen)
    except TaskError as error:
        failed = error
    lines = {(each.file, each.line) for each in checkup.findings}
    if failed is not None:
        lines.add((failed.problem.file, failed.problem.line))
    for module, function in checkup.places.methods:
        if function.name != "_initialize_episode":
            continue
        for node in _whole_batches_at(function, {line for file, line in lines if file == module.file}):
            yield Found(
                "tensors of self.num_envs rows are made in a reset of some envs. Take b = len(env_idx) for their "
                "number of rows.",
                module.place(node, function.name),
            )
            return
    if failed is not None:
        raise failed


def _whole_batches_at(function: ast.FunctionDef, lines: Collection[int | None]) -> Iterator[ast.AST]:
    """The calls that make a tensor of self.num_envs rows which is used in these lines, beyond its rows of ``env_idx``."""
    made: dict[str, ast.AST] = {}
    """By the local name, or the attribute of self, that such a tensor is kept in."""
    for statement in _statements(function):
        value = getattr(statement, "value", None)
        source = None if value is None else next(_uses(value, made), None)
        if set(range(statement.lineno, (statement.end_lineno or 0) + 1)).intersection(lines):
            if (used := source or next(_uses(statement, made), None)) is not None:
                yield used
        targets = getattr(statement, "targets", [getattr(statement, "target", None)])
        for name in map(_name_of, filter(None, targets)):
            if source is not None:
                made[name] = source
            elif not isinstance(statement, ast.AugAssign):
                made.pop(name, None)


def _statements(function: ast.FunctionDef) -> list[ast.stmt]:
    """The simple statements, in the order of the text."""
    found = (node for node in ast.walk(function) if isinstance(node, ast.stmt) and not hasattr(node, "body"))
    return sorted(found, key=lambda node: (node.lineno, node.col_offset))


def _name_of(node: ast.AST) -> str:
    """``p``, ``self.begun``; empty for anything else."""
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "self":
        return f"self.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def _uses(node: ast.AST, made: Mapping[str, ast.AST]) -> Iterator[ast.AST]:
    """Of the whole batches that a part of the source makes or names, the calls that make them; not where only rows are
    taken."""
    batches = {id(batch): batch for batch in _whole_batches(node)}
    waiting: list[ast.AST] = [node]
    while waiting:
        part = waiting.pop()
        if id(part) in batches:
            yield part
        elif name := _name_of(part):
            if name in made and not isinstance(getattr(part, "ctx", None), ast.Store):
                yield made[name]
        elif isinstance(part, ast.Subscript) and _takes_rows(part):
            waiting.append(part.slice)
        else:
            waiting.extend(ast.iter_child_nodes(part))


def _takes_rows(node: ast.Subscript) -> bool:
    """Whether it is ``x[env_idx]``, ``x[env_idx, :2]``, ``x[mask]``; not ``x[:, :2]``, which has all rows."""
    first = node.slice.elts[0] if isinstance(node.slice, ast.Tuple) and node.slice.elts else node.slice
    if isinstance(first, ast.Slice):
        return first.lower is not None or first.upper is not None
    return not (isinstance(first, ast.Constant) and first.value is ...)


def _whole_batches(within: ast.AST) -> Iterator[ast.AST]:
    """Calls that make a tensor with self.num_envs in its size."""
    for node in ast.walk(within):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        given = [*node.args, *(keyword.value for keyword in node.keywords)]
        if node.func.attr in _CREATED + _SIZED and any(_is_num_envs(part) for part in given):
            yield node


def _is_num_envs(node: ast.AST) -> bool:
    """Whether it is ``self.num_envs``, or a tuple or list with it."""
    if isinstance(node, (ast.Tuple, ast.List)):
        return any(_is_num_envs(item) for item in node.elts)
    return isinstance(node, ast.Attribute) and node.attr == "num_envs"


def see_overlaps_at_reset(checkup: Checkup) -> Iterator[Seen]:
    """Over all seeds: a row for each pair of bodies."""
    fixed = immovable(checkup)
    seeds_of: dict[tuple[str, str], list[int]] = {}
    depths: dict[tuple[str, str], float] = {}
    for seed, overlaps in checkup.overlaps.items():
        for overlap in overlaps:
            if overlap.depth > DEEP and not fixed.issuperset(overlap.bodies):
                seeds_of.setdefault(overlap.bodies, []).append(seed)
                depths[overlap.bodies] = max(depths.get(overlap.bodies, 0), overlap.depth)
    yield Seen(tried=len(checkup.overlaps))
    for pair, seeds in seeds_of.items():
        loose = [body for body in pair if body not in fixed]
        mover = min(loose, key=lambda body: "/" in body)
        still = [body for body in pair if body in fixed and "/" not in body]
        if "/" in mover:
            advice = "Raise its root, or reset it to joint positions with which it touches nothing."
        elif still:
            advice = (
                f"Place {mover} higher: on a table of height 0, the middle of a body is at half its height."
            )
        else:
            advice = f"Place {mover} further away, or draw again while they are too near."
        place = _where_placed(checkup, mover)
        yield Seen(pair, place, seeds=tuple(seeds), size=depths[pair], texts=(advice,))


def overlap_at_reset(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    # One robot in a table has many links in it: a finding for each pair of owners, of the deepest bodies.
    deepest: dict[frozenset[str], Seen] = {}
    for row in sorted(together(rows), key=lambda row: -row.size):
        deepest.setdefault(frozenset(body.split("/", 1)[0] for body in row.names), row)
    for row in deepest.values():
        first, second = row.names
        yield Found(
            f"{first} and {second} are {1000 * row.size:.0f} mm inside each other after the reset of "
            f"{of(len(row.seeds), tried(rows), 'seed')} (seed {listed(row.seeds)}). {row.texts[0]}",
            row.place,
            len(row.seeds),
        )


def see_falls_at_reset(checkup: Checkup) -> Iterator[Seen]:
    """Over all seeds, while the robot holds still for a second."""
    index, still = scene_index(checkup.task.env), checkup.still
    robots = _robots(checkup)
    # What a hand holds may slip, and what is pushed out of the robot has a rule of its own.
    wanted = _start_moving(checkup) | _touched(checkup, robots)
    yield from (Seen(("wanted", owner)) for owner in sorted(wanted))
    before, after = still.poses[0], still.poses[-1]
    yield Seen(tried=len(still.seeds))
    loose_bodies = {
        index.owners[body]
        for body, kind in enumerate(index.kinds)
        if kind == "dynamic" or (kind == "link" and index.owners[body] not in robots)
    }
    yield from (Seen(("loose", owner)) for owner in sorted(loose_bodies))
    for body, name in enumerate(index.names):
        loose = index.kinds[body] == "dynamic" or (
            index.kinds[body] == "link" and index.owners[body] not in robots
        )
        if not loose or index.owners[body] in wanted:
            continue
        away = after[:, body, :3] - before[:, body, :3]
        moved = np.linalg.norm(away, axis=1)
        turned = _angle(before[:, body, 3:], after[:, body, 3:])
        # A body that an env lacks is NaN in both.
        lost = ~np.isfinite(after[:, body]).all(axis=1) & np.isfinite(before[:, body]).all(axis=1)
        bad = (moved > MOVED) | (turned > TURNED) | lost
        if not bad.any():
            continue
        furthest = np.nan_to_num(np.where(bad, moved, 0), nan=np.inf)
        worst = int(furthest.argmax())
        how = "falls" if away[worst, 2] < -0.7 * moved[worst] else "moves"
        seeds = [still.seeds[i] for i in np.flatnonzero(bad)]
        yield Seen(
            ("body", name, index.owners[body]),
            _where_placed(checkup, index.owners[body]),
            seeds=tuple(seeds),
            size=float(furthest[worst]),
            texts=(f"{how} {moved[worst]:.2f} m and turns {np.degrees(turned[worst]):.0f} degrees",),
        )


def falls_at_reset(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    wanted, loose = (
        {row.names[1] for row in rows if row.names[:1] == (what,)} for what in ("wanted", "loose")
    )
    if not loose:
        raise NotApplicable("nothing but its robot moves freely")
    if loose <= wanted:
        raise NotKnown(f"{listed(sorted(loose))} moves from the start, or touches the robot then")
    # One rope has many links that fall: a finding for each owner, of the body that moves furthest.
    bodies_of: dict[str, list[Seen]] = {}
    for row in together((row for row in rows if row.names[:1] == ("body",)), worst=True):
        if row.names[2] not in wanted:
            bodies_of.setdefault(row.names[2], []).append(row)
    for owner, bodies in bodies_of.items():
        worst, seeds = (
            max(bodies, key=lambda row: row.size),
            sorted({seed for row in bodies for seed in row.seeds}),
        )
        more = f" {len(bodies) - 1} more links of {owner} move too." if len(bodies) > 1 else ""
        yield Found(
            f"{worst.names[1]} {worst.texts[0]} in the first second of {of(len(worst.seeds), tried(rows), 'seed')} "
            f"(seed {listed(worst.seeds)}) while the robot holds still.{more} Place it where it rests.",
            worst.place,
            len(seeds),
        )


def see_robot_holds(checkup: Checkup) -> Iterator[Seen]:
    """Over all seeds, while the controllers are asked to hold, for a second: a row for each joint."""
    env = checkup.task.env
    if not checkup.task.parts:
        raise NotApplicable("it has no robot")
    for part in checkup.task.parts:
        delta = getattr(part.controller.config, "use_delta", False)
        absolute = isinstance(part.controller, PDJointPosController) and not isinstance(
            part.controller, PDEEPosController
        )
        if not delta and not absolute:
            raise NotKnown(f"no action holds a robot in control mode {env.control_mode}")
    if any(not _is_fixed(robot.robot) for robot in agents(env)):
        raise NotApplicable("its robot stands on the floor: balancing is what a policy learns")
    driven = {joint.name for part in checkup.task.parts for joint in part.controller.joints}
    still, robots = checkup.still, _robots(checkup)
    if still.qpos is None:
        raise NotKnown("its robots have different joints in each env")
    place = checkup.places.hook("_initialize_episode")
    column = 0
    for owner, articulation in joints_of_scene(env):
        for joint in articulation.active_joints:
            kind = "prismatic" if str(joint.type[0]) == "prismatic" else "revolute"
            away = np.abs(still.qpos[-1, :, column] - still.qpos[0, :, column])
            column += 1
            if owner not in robots or joint.name not in driven:
                continue
            bad = away > SAGGED[kind]
            yield Seen(
                (owner, joint.name),
                place,
                tried=len(away),
                seeds=tuple(still.seeds[i] for i in np.flatnonzero(bad)),
                size=float(np.nan_to_num(away).max(initial=0)),
                texts=("m" if kind == "prismatic" else "rad",),
            )


def robot_holds(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    if not rows:
        raise NotApplicable("no controller moves a joint of its robot")
    for row in together(rows):
        if row.seeds:
            yield Found(
                f"joint {row.names[1]} moves {row.size:.2f} {row.texts[0]} in a second after the reset of "
                f"{of(len(row.seeds), row.tried, 'seed')}, with the targets of the reset. Raise the stiffness or force limit "
                "of its controller, or reset it to a pose within its limits that touches nothing.",
                row.place,
                len(row.seeds),
            )
            return


def see_outside_reach(checkup: Checkup) -> Iterator[Seen]:
    """Over all seeds: how far each body is."""
    task = checkup.task
    robots = agents(task.env)
    if not robots:
        raise NotApplicable("it has no robot")
    if len(robots) > 1:
        raise NotKnown("it has several robots: which one is to touch what is not known")
    if not _is_fixed(robots[0].robot):
        raise NotApplicable("its robot moves around")
    tool = getattr(robots[0], "tcp", None)  # what a property of the author's raises is told
    if not isinstance(tool, Link):
        raise NotKnown("its robot has no tcp, whose reach is measured")
    base, reach = _reach(checkup, robots[0].robot, tool)
    index, poses = scene_index(task.env), checkup.starts.poses[0]
    for body, name in enumerate(index.names):
        if index.kinds[body] != "dynamic":
            continue
        distance = np.nan_to_num(np.linalg.norm(poses[:, body, :3] - base, axis=1))
        beyond = np.flatnonzero(distance > reach + REACH_MARGIN)
        yield Seen(
            (name,),
            _where_placed(checkup, name) if len(beyond) else None,
            tried=len(distance),
            seeds=tuple(checkup.starts.seeds[i] for i in beyond),
            size=float(distance.max(initial=0)),
            numbers=(reach,),
        )


def outside_reach(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """Of bodies that are within reach at some seeds, and beyond at others."""
    bodies = together(rows, worst=True)
    if not bodies:
        raise NotApplicable("no actor of it moves freely")
    for row in bodies:
        if 0 < len(row.seeds) < row.tried:
            yield Found(
                f"{row.names[0]} is up to {row.size:.2f} m from the robot's base, whose tcp reaches {row.numbers[0]:.2f} m, in "
                f"{of(len(row.seeds), row.tried, 'seed')} (seed {listed(row.seeds)}). Narrow the range in which it is placed.",
                row.place,
                len(row.seeds),
            )
    if far := [row.names[0] for row in bodies if len(row.seeds) == row.tried]:
        raise NotKnown(f"out of reach at every seed: {listed(far)}. Whether it is to be touched is not known")


def _reach(checkup: Checkup, articulation: Any, tool: Any) -> tuple[NDArray[np.float32], float]:
    """(3,) the base, and how far the tcp comes from it, from random postures within the joints' limits."""
    task = checkup.task
    checkup.reset(task, next(checkup.batches()))
    limits = articulation.get_qlimits()
    if not torch.isfinite(limits).all():
        limits = limits.clamp(-np.pi, np.pi)
        if any(str(joint.type[0]) == "prismatic" and not np.isfinite(np.ravel(joint.limits.cpu())).all()
               for joint in articulation.active_joints):  # fmt: skip
            raise NotApplicable("its robot drives around")
    base = articulation.pose.p.cpu().numpy()
    generator = torch.Generator(device=limits.device).manual_seed(0)
    reach = 0.0
    for _ in range(POSTURES):
        part = torch.rand(limits.shape[:2], generator=generator, device=limits.device)
        articulation.set_qpos(limits[..., 0] + part * (limits[..., 1] - limits[..., 0]))
        apply_and_fetch(task.env)
        reach = max(reach, float(np.linalg.norm(tool.pose.p.cpu().numpy() - base, axis=1).max()))
    return base[0], reach


def unit_quaternion(checkup: Checkup) -> Iterator[Found | Note]:
    """Of the poses that the task sets in a reset, and of its initial poses."""
    if not any(True for _ in _quaternions(checkup)):
        raise NotApplicable("its own lines set no pose")
    for name, quaternions, place in _quaternions(checkup):
        length = np.linalg.norm(quaternions, axis=1)
        wrong = np.abs(length - 1) > NOT_UNIT
        if wrong.any():
            yield Found(
                f"the quaternion of {name} has length {length[wrong][0]:.3g}: {_text(quaternions[wrong][0])}. Divide it "
                "by its norm, or make it with euler2quat or random_quaternions.",
                place,
            )


def quaternion_order(checkup: Checkup) -> Iterator[Found | Note]:
    """Of the poses that the task sets in a reset, and of calls of SciPy's as_quat."""
    by_name: dict[str, list[tuple[NDArray[np.float32], Place | None]]] = {}
    for name, quaternions, place in _quaternions(checkup):
        by_name.setdefault(name, []).append((quaternions, place))
    robots, found = _robots(checkup), False
    one_row: list[str] = []
    for name, given in by_name.items():
        rows, place = np.concatenate([rows for rows, _ in given[-1:]]), given[-1][1]
        flat = (np.abs(rows[:, :2]) < 1e-6).all(axis=1).all()
        if not flat:
            continue
        if len(rows) < 2:
            one_row.append(name)
            continue
        if np.ptp(rows[:, 2:], axis=0).max() > 0.05:
            found = True
            yield Found(
                f"the quaternions of {name} are (0, 0, ...) in every env, such as {_text(rows[0])}: a turn about the "
                "vertical, in the order x, y, z, w. Write w first: (w, x, y, z).",
                place,
                len(rows),
            )
        elif name not in robots and (np.abs(rows[:, 3]) > 1 - 1e-6).all():
            yield Note(
                f"{name} is turned by half a turn about z in every env: (0, 0, 0, 1) is no turn in the order x, y, z, w"
            )
    if found:
        return
    for module, function in checkup.places.functions():
        text = ast.unparse(function)
        for node in ast.walk(function):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                if node.func.attr == "as_quat" and not any(word in text for word in _REORDERED):
                    yield Found(
                        "as_quat() gives x, y, z, w. Write np.roll(q, 1, axis=-1) after it, or, from SciPy 1.14 on, "
                        "as_quat(scalar_first=True).",
                        module.place(node),
                    )
                    found = True
    if not by_name:
        checkup.require_source()
    if one_row and not found:
        checkup.require_several()


def _quaternions(checkup: Checkup) -> Iterator[tuple[str, NDArray[np.float32], Place | None]]:
    """Name, (b, 4) and place of what the author's lines set."""
    placed = checkup.placed
    for each in checkup.builds:
        if each.place is not None and each.quaternion is not None:
            yield each.name, each.quaternion, each.place
    for each in placed:
        if each.place is not None:
            yield each.name, each.quaternions, each.place


def see_bodies_stay(checkup: Checkup) -> Iterator[Seen]:
    """Over random rollouts, each until its end."""
    rollouts = checkup.random
    of_owner: dict[str, list[SeenOutlier]] = {}
    for seen in sorted(rollouts.outliers, key=lambda seen: (seen.step, seen.seed)):
        if seen.kind.rule == "bodies-stay":
            of_owner.setdefault(seen.body.split("/", 1)[0], []).append(seen)
    moves = any(kind in ("dynamic", "link") for kind in scene_index(checkup.task.env).kinds)
    yield Seen(tried=len(rollouts.seeds), count=int(moves))
    for owner, every in of_owner.items():
        first, seeds = every[0], sorted({seen.seed for seen in every})
        yield Seen(
            (owner,),
            _where_placed(checkup, first.body),
            seeds=tuple(seeds),
            size=-float(first.step),
            texts=(f"{first.reason} at step {first.step} of seed {first.seed}",),
        )


def bodies_stay(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    if not any(row.count for row in rows if not row.names):
        raise NotApplicable("nothing in it moves")
    for row in sorted(together(rows, worst=True), key=lambda row: -row.size):
        yield Found(
            f"{row.texts[0]}; in this way or another it leaves the scene in "
            f"{of(len(row.seeds), tried(rows), 'random episode')} (seed {listed(row.seeds)}). Let nothing overlap and "
            "nothing be thrown, or end an episode without it: return `fail` from evaluate().",
            row.place,
            len(row.seeds),
        )


def _where_placed(checkup: Checkup, body: str) -> Place | None:
    """The author's line that sets its pose in a reset."""
    owner = body.split("/", 1)[0]
    lines = [each.place for each in checkup.placed if each.name == owner and each.place is not None]
    return lines[-1] if lines else checkup.places.body(body, "_initialize_episode")


def _text(quaternion: NDArray[np.float32]) -> str:
    return "(" + ", ".join(f"{number:.3g}" for number in quaternion) + ")"


def _angle(before: NDArray[np.float32], after: NDArray[np.float32]) -> NDArray[np.float32]:
    """(K,) radians between quaternions (K, 4)."""
    product = np.abs(np.einsum("ki,ki->k", before, after))
    lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    return 2 * np.arccos(np.clip(product / np.maximum(lengths, 1e-9), 0, 1))


def _robots(checkup: Checkup) -> set[str]:
    """Names of the articulations that agents move."""
    return {str(agent.robot.name) for agent in agents(checkup.task.env)} | {
        each.name for each in checkup.builds if each.of_robot
    }


def _start_moving(checkup: Checkup) -> set[str]:
    """Names of what a reset gives a velocity."""
    moving: set[str] = set()
    checkup.reset(checkup.task, next(checkup.batches()))
    for name, rows in present_states(checkup.task.env).items():
        rows = np.asarray(rows)
        joints = (rows.shape[1] - 13) // 2
        speeds = np.concatenate([rows[:, 7:13], rows[:, 13 + joints :]], axis=1)
        if (np.abs(np.nan_to_num(speeds)) > STARTS_MOVING).any():
            moving.add(name.split("/", 1)[1])
    return moving


def _touched(checkup: Checkup, robots: set[str]) -> set[str]:
    """Names of what touches a robot after the reset of some seed."""
    pairs = [
        [body.split("/", 1)[0] for body in overlap.bodies]
        for overlaps in checkup.overlaps.values()
        for overlap in overlaps
    ]
    return {owner for pair in pairs if not robots.isdisjoint(pair) for owner in pair}


def _is_fixed(articulation: Any) -> bool:
    """Whether its root cannot move."""
    return all(each.links[0].joint.type == "fixed" for each in objects_of(articulation))


def immovable(checkup: Checkup) -> set[str]:
    """Bodies that no contact moves: static and kinematic ones, and links between which and a fixed root no joint is."""
    index: SceneIndex = scene_index(checkup.task.env)
    found = {
        name for name, kind in zip(index.names, index.kinds, strict=True) if kind in ("static", "kinematic")
    }
    for articulation in checkup.task.env.scene.articulations.values():
        for link in objects_of(articulation)[0].links:
            name, above = index.name_of(link), link
            while above is not None and above.joint.type == "fixed":
                above = above.parent
            if name is not None and above is None:
                found.add(name)
    return found


RUN_CHECKS: Mapping[str, Check] = {"bodies-stay": OverSeeds(see_bodies_stay, bodies_stay)}
"""They look at random rollouts."""
CHECKS: Mapping[str, Check] = {
    "overlap-at-reset": OverSeeds(see_overlaps_at_reset, overlap_at_reset),
    "falls-at-reset": OverSeeds(see_falls_at_reset, falls_at_reset),
    "batch-of-reset": batch_of_reset,
    "quaternion-order": quaternion_order,
    "unit-quaternion": unit_quaternion,
    "robot-holds": OverSeeds(see_robot_holds, robot_holds),
    "outside-reach": OverSeeds(see_outside_reach, outside_reach),
}
