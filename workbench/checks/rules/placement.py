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

from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note, NotKnown
from workbench.checks.evidence.over_seeds import together, tried
from workbench.checks.register_rule import rule
from workbench.checks.results import Seen
from workbench.envs.action_vector import random_action
from workbench.envs.broken_rule import Place
from workbench.envs.maniskill_private import agents, apply_and_fetch, objects_of
from workbench.envs.overlaps import OVERLAP_METRES, immovable
from workbench.envs.scene.scene_index import joints_of_scene, present_states, scene_index
from workbench.machine.text import listed, of
from workbench.task.problem import TaskError

MOVED_METRES, TURNED_RADIANS = 0.02, 0.35
"""Metres that a body may move and radians that it may turn in a second: a body that is put down 1 cm above
the table may settle."""
MOVING_SPEED = 0.01
"""Velocity after a reset, in m/s or rad/s, above which the motion counts as intended."""
SAG_LIMITS = {"prismatic": 0.02, "revolute": 0.1}
"""Metres and radians that a joint may move in a second."""
POSTURES = 40
"""Number of random postures of each env's robot from which its reach is found."""
REACH_MARGIN_METRES = 0.05
"""Metres by which the middle of a body may be beyond the reach."""
UNIT_TOLERANCE = 1e-3
"""Maximum difference between the length of a quaternion and 1."""
_CREATED = ("zeros", "ones", "rand", "randn", "randint", "empty", "full", "tile", "arange")
_SIZED = ("repeat", "expand", "new_zeros", "new_ones", "uniform", "normal", "view", "reshape")
_REORDERED = ("roll", "scalar_first", "wxyz", "[3, 0, 1, 2]", "xyzw")


def see_overlaps_at_reset(checkup: Checkup) -> Iterator[Seen]:
    """A row for each pair of bodies that overlaps after a reset."""
    fixed = immovable(checkup.task.env)
    seeds_of: dict[tuple[str, str], list[int]] = {}
    depths: dict[tuple[str, str], float] = {}
    for seed, overlaps in checkup.overlaps.items():
        for overlap in overlaps:
            if overlap.depth > OVERLAP_METRES and not fixed.issuperset(overlap.bodies):
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
        place = where_placed(checkup, mover)
        yield Seen(pair, place, seeds=tuple(seeds), size=depths[pair], texts=(advice,))


@rule("overlap-at-reset", "warn", "_initialize_episode", see=see_overlaps_at_reset)
def overlap_at_reset(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """Bodies do not overlap after a reset.

    Physics pushes the bodies apart in the first steps, often far away, and the policy learns from these
    steps.

    ## Why
    Physics pushes overlapping bodies apart in the first steps, often at high speed. The episode begins in
    another state than the one that the reset sets. The motion of these bodies changes the reward, and a
    policy learns to exploit this.

    ## Fix
    Set z of a body to half of its height, and sample places that do not overlap.

    ```python fragment
    p = torch.zeros((b, 3))
    p[:, :2] = torch.rand((b, 2)) * 0.2 - 0.1
    p[:, 2] = self.cube_half_size  # z = 0 is the top of the table
    self.cube.set_pose(Pose.create_from_pq(p=p, q=[1, 0, 0, 0]))
    ```

    ## How it is checked
    The rule resets all seeds (32 by default) and reads the contacts of one substep. Overlaps of more than 2
    mm count. It leaves out links of one articulation and pairs in which neither body can move; of all pairs
    of links between the same two objects it reports only the deepest one. Bodies without a collision shape
    cannot overlap.
    """
    # Many links of a robot may be in a table: each pair of owners gets one finding, about the deepest pair of
    # bodies.
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
    """Rows of three kinds: objects that are left out (``wanted``), objects that move freely (``loose``), and
    bodies that move while the robot holds still for a second (``body``)."""
    index, still = scene_index(checkup.task.env), checkup.still
    robots = _robots(checkup)
    # A body in the hand may slip, and a body that is pushed out of the robot breaks another rule.
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
        # A body that an env lacks is NaN both before and after.
        lost = ~np.isfinite(after[:, body]).all(axis=1) & np.isfinite(before[:, body]).all(axis=1)
        bad = (moved > MOVED_METRES) | (turned > TURNED_RADIANS) | lost
        if not bad.any():
            continue
        furthest = np.nan_to_num(np.where(bad, moved, 0), nan=np.inf)
        worst = int(furthest.argmax())
        falls = away[worst, 2] < -0.7 * moved[worst]
        how = f"{'falls' if falls else 'moves'} {moved[worst]:.2f} m and turns {np.degrees(turned[worst]):.0f} degrees"
        seeds = [still.seeds[i] for i in np.flatnonzero(bad)]
        yield Seen(
            ("body", name, index.owners[body]),
            where_placed(checkup, index.owners[body]),
            seeds=tuple(seeds),
            size=float(furthest[worst]),
            texts=("goes to a place that is not finite" if lost[worst] else how,),
        )


@rule("falls-at-reset", "warn", "_initialize_episode", see=see_falls_at_reset)
def falls_at_reset(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """Bodies stay where a reset puts them while the robot holds still.

    Episodes begin with falling, drifting or exploding bodies, in another state than the one that the reset
    sets.

    ## Why
    If a body falls, rolls or explodes before the robot has moved, the episode does not begin in the state
    that the reset sets. Rewards change without an action, and `success` may become true or impossible by
    itself.

    ## Fix
    Place bodies where they rest. Give a velocity to bodies that should move.

    ```python fragment
    p[:, 2] = self.cube_half_size  # not 0.2
    self.cube.set_pose(Pose.create_from_pq(p=p, q=[1, 0, 0, 0]))
    self.ball.set_linear_velocity(velocity)  # a ball that is to roll
    ```

    ## How it is checked
    The rule resets all seeds, and the robot holds the pose of the reset for one second. It reports a body
    that moves by more than 2 cm or turns by more than 20 degrees in that second. It leaves out bodies that a
    reset gives a velocity, and bodies that touch the robot after the reset of some seed; if no other bodies
    move freely, the result is *not known*. It does not see what falls after the first second.
    """
    wanted, loose = (
        {row.names[1] for row in rows if row.names[:1] == (what,)} for what in ("wanted", "loose")
    )
    if not loose:
        raise NotApplicable("nothing but the robot moves freely")
    if loose <= wanted:
        raise NotKnown(f"{listed(sorted(loose))} moves from the start, or touches the robot after the reset")
    # Many links of a rope may fall: each owner gets one finding, about the body that moves furthest.
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


@rule("batch-of-reset", "warn", "_initialize_episode")
def batch_of_reset(checkup: Checkup) -> Iterator[Found | Note]:
    """_initialize_episode makes tensors of len(env_idx) rows, not of self.num_envs.

    A partial reset, which every trainer does, fails or writes rows of other envs.

    ## Why
    Trainers reset the envs whose episodes are over, and only those: `env_idx` has fewer rows than
    `self.num_envs`. A tensor of `self.num_envs` rows causes a shape error, or overwrites what the task
    keeps for envs that are in the middle of an episode.

    ## Fix
    Take the number of rows from `env_idx`, and write into the rows of those envs.

    ```python fragment
    def _initialize_episode(self, env_idx, options):
        b = len(env_idx)
        p = torch.rand((b, 3), device=self.device)
        self.cube.set_pose(Pose.create_from_pq(p=p))
        self.travelled[env_idx] = 0
    ```

    ## How it is checked
    After a step, the rule resets env 0 alone, and then all others. If a reset raises, or breaks a rule of GPU
    simulation, at a line of the task's `_initialize_episode` that uses a tensor of `self.num_envs` rows, the
    rule reports the line that makes this tensor. The rule accepts such a tensor if only its rows `[env_idx]`
    are used. The result is *not known* if the task raises elsewhere or cannot be built, and with one env.
    """
    checkup.require_several()
    task, rng = checkup.task, np.random.default_rng(4)
    checkup.reset(task, list(range(checkup.num_envs)))
    # Make a step, so that what the task keeps for each env differs from its value after a reset.
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
                "This line makes a tensor of self.num_envs rows in a reset of some envs. Give it b = len(env_idx) "
                "rows.",
                module.place(node, function.name),
            )
            return
    if failed is not None:
        raise failed


def _whole_batches_at(function: ast.FunctionDef, lines: Collection[int | None]) -> Iterator[ast.AST]:
    """Calls that make a tensor of self.num_envs rows, if these lines use more of the tensor than the rows of
    ``env_idx``."""
    made: dict[str, ast.AST] = {}
    """The call that made the tensor of a local variable or attribute of self, by its name."""
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
    """The name of a local variable or attribute, such as ``p`` or ``self.begun``; empty for anything else."""
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "self":
        return f"self.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def _uses(node: ast.AST, made: Mapping[str, ast.AST]) -> Iterator[ast.AST]:
    """Calls that make a whole batch (`_whole_batches`), if this part of the source contains the call or names
    its result. Uses that take only some rows of the batch do not count."""
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
    """Whether the index takes rows, as ``x[env_idx]``, ``x[env_idx, :2]`` and ``x[mask]`` do; ``x[:, :2]`` has all rows."""
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
    """Whether the node is ``self.num_envs``, or a tuple or list with it."""
    if isinstance(node, (ast.Tuple, ast.List)):
        return any(_is_num_envs(item) for item in node.elts)
    return isinstance(node, ast.Attribute) and node.attr == "num_envs"


@rule("quaternion-order", "warn", "_initialize_episode")
def quaternion_order(checkup: Checkup) -> Iterator[Found | Note]:
    """Quaternions are in the order w, x, y, z.

    Bodies lie on their sides or upside down (SciPy and ROS use x, y, z, w).

    ## Why
    SAPIEN and ManiSkill write quaternions as (w, x, y, z). SciPy, ROS and PyBullet write (x, y, z, w). In the
    wrong order, a rotation about the z axis becomes a body that lies upside down or on its side, without an
    error.

    ## Fix
    Write w first. From SciPy 1.14 on, `as_quat(scalar_first=True)` does so; with earlier versions, write
    `np.roll(q, 1, axis=-1)`.

    ```python fragment
    half = torch.rand(b) * torch.pi
    zero = torch.zeros(b)
    q = torch.stack([half.cos(), zero, zero, half.sin()], dim=1)  # w, x, y, z
    q_scipy = Rotation.from_euler("z", angle).as_quat(scalar_first=True)
    ```

    ## How it is checked
    The rule notes the quaternions that the author's lines set in a reset of the first seeds. If those of a
    body are (0, 0, a, b) in all envs, and a and b differ from env to env, they are rotations about the z axis
    in the wrong order. The rule also searches the source for `as_quat()` in functions that neither ask for
    `scalar_first` nor reorder the numbers. (0, 0, 0, 1) in all envs is only noted, since it may be meant as
    half a turn. The rule does not recognise other rotations in the wrong order.
    """
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
                f"The quaternions of {name} are (0, 0, ...) in every env, such as {_text(rows[0])}: a rotation about the "
                "z axis, in the order x, y, z, w. Write w first: (w, x, y, z).",
                place,
                len(rows),
            )
        elif name not in robots and (np.abs(rows[:, 3]) > 1 - 1e-6).all():
            yield Note(
                f"{name} has the quaternion (0, 0, 0, 1) in every env, half a turn about z; in the order x, y, z, w it would "
                "be no turn"
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


@rule("unit-quaternion", "warn", "_initialize_episode")
def unit_quaternion(checkup: Checkup) -> Iterator[Found | Note]:
    """Quaternions that are set have length 1.

    Pictures, matrices and distances are scaled or turned.

    ## Why
    A quaternion whose length is not 1 is not a rotation. Matrices made of it are scaled or sheared, and
    distances between rotations are wrong. PhysX may or may not normalise the quaternion, so CPU and GPU may
    differ.

    ## Fix
    Divide by the length, or make the quaternion from angles.

    ```python fragment
    q = torch.nn.functional.normalize(q, dim=-1)
    q = randomization.random_quaternions(b, lock_x=True, lock_y=True)
    self.cube.set_pose(Pose.create_from_pq(p=p, q=q))
    ```

    ## How it is checked
    The rule notes the poses that the author's lines set in a reset of the first seeds, as they are given, and
    the initial poses of builders. It reports a length that differs from 1 by more than 0.001. It does not see
    poses that are set in a step.
    """
    if not any(True for _ in _quaternions(checkup)):
        raise NotApplicable("the author's files set no pose")
    for name, quaternions, place in _quaternions(checkup):
        length = np.linalg.norm(quaternions, axis=1)
        wrong = np.abs(length - 1) > UNIT_TOLERANCE
        if wrong.any():
            yield Found(
                f"The quaternion of {name} has length {length[wrong][0]:.3g}: {_text(quaternions[wrong][0])}. Divide it "
                "by its norm, or make it with euler2quat or random_quaternions.",
                place,
            )


def _quaternions(checkup: Checkup) -> Iterator[tuple[str, NDArray[np.float32], Place | None]]:
    """Name, quaternions (b, 4) wxyz and place of each pose that the author's lines set."""
    placed = checkup.placed
    for each in checkup.builds:
        if each.place is not None and each.quaternion is not None:
            yield each.name, each.quaternion, each.place
    for each in placed:
        if each.place is not None:
            yield each.name, each.quaternions, each.place


def see_robot_holds(checkup: Checkup) -> Iterator[Seen]:
    """A row for each driven joint: how far it moves while the controllers hold the pose of the reset for a
    second."""
    env = checkup.task.env
    if not checkup.task.parts:
        raise NotApplicable("the task has no robot")
    for part in checkup.task.parts:
        delta = getattr(part.controller.config, "use_delta", False)
        absolute = isinstance(part.controller, PDJointPosController) and not isinstance(
            part.controller, PDEEPosController
        )
        if not delta and not absolute:
            raise NotKnown(f"no action holds a robot in control mode {env.control_mode}")
    if any(not _is_fixed(robot.robot) for robot in agents(env)):
        raise NotApplicable("the robot stands freely on the floor: a policy has to learn to balance it")
    driven = {joint.name for part in checkup.task.parts for joint in part.controller.joints}
    still, robots = checkup.still, _robots(checkup)
    if still.qpos is None:
        raise NotKnown("the robots have different joints in each env")
    place = checkup.places.hook("_initialize_episode")
    column = 0
    for owner, articulation in joints_of_scene(env):
        for joint in articulation.active_joints:
            kind = "prismatic" if str(joint.type[0]) == "prismatic" else "revolute"
            away = np.abs(still.qpos[-1, :, column] - still.qpos[0, :, column])
            column += 1
            if owner not in robots or joint.name not in driven:
                continue
            bad = away > SAG_LIMITS[kind]
            yield Seen(
                (owner, joint.name),
                place,
                tried=len(away),
                seeds=tuple(still.seeds[i] for i in np.flatnonzero(bad)),
                size=float(np.nan_to_num(away).max(initial=0)),
                texts=("m" if kind == "prismatic" else "rad",),
            )


@rule("robot-holds", "warn", "_initialize_episode", see=see_robot_holds)
def robot_holds(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """The robot holds the pose of a reset while its targets do not change.

    The robot sags or swings before the policy acts; stiffness, damping or force limits are too low.

    ## Why
    A robot that sags after a reset begins each episode with a movement that no action asked for. Most often
    its controllers are too weak for its weight, or the reset puts it outside its joint limits or into another
    body. Recorded actions in absolute joint positions then lead elsewhere.

    ## Fix
    Raise stiffness, damping or force limit of the controller, or reset to a pose that the robot can hold.

    ```python fragment
    arm = PDJointPosControllerConfig(
        arm_joints, lower=None, upper=None, stiffness=1e3, damping=1e2, force_limit=100, normalize_action=False
    )
    ```

    ## How it is checked
    The rule resets all seeds and commands the controllers for one second to hold their pose. It reports a
    driven joint that moves by more than 0.1 rad, or 2 cm. The result is *not known* for control by velocity,
    by effort or by absolute poses of the hand, and *not applicable* for robots that stand on the floor.
    """
    if not rows:
        raise NotApplicable("no controller moves a joint of the robot")
    for row in together(rows):
        if row.seeds:
            yield Found(
                f"Joint {row.names[1]} moves {row.size:.2f} {row.texts[0]} in a second after the reset of "
                f"{of(len(row.seeds), row.tried, 'seed')}, while its target does not change. Raise the stiffness or force "
                "limit of its controller, or reset the robot to a pose within its limits that touches nothing.",
                row.place,
                len(row.seeds),
            )
            return


def see_outside_reach(checkup: Checkup) -> Iterator[Seen]:
    """A row for each dynamic body, with its largest distance from the robot's base over all resets."""
    task = checkup.task
    robots = agents(task.env)
    if not robots:
        raise NotApplicable("the task has no robot")
    if len(robots) > 1:
        raise NotKnown(
            "the task has several robots, and the rule cannot know which robot must touch which body"
        )
    if not _is_fixed(robots[0].robot):
        raise NotApplicable("the robot moves around")
    tool = getattr(robots[0], "tcp", None)  # an error in the author's property is reported
    if not isinstance(tool, Link):
        raise NotKnown("the robot has no tcp, and the reach is the largest distance of the tcp from the base")
    base, reach = _reach(checkup, robots[0].robot, tool)
    index, poses = scene_index(task.env), checkup.starts.poses[0]
    for body, name in enumerate(index.names):
        if index.kinds[body] != "dynamic":
            continue
        distance = np.nan_to_num(np.linalg.norm(poses[:, body, :3] - base, axis=1))
        beyond = np.flatnonzero(distance > reach + REACH_MARGIN_METRES)
        yield Seen(
            (name,),
            where_placed(checkup, name) if len(beyond) else None,
            tried=len(distance),
            seeds=tuple(checkup.starts.seeds[i] for i in beyond),
            size=float(distance.max(initial=0)),
            numbers=(reach,),
        )


@rule("outside-reach", "warn", "_initialize_episode", see=see_outside_reach)
def outside_reach(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """Bodies that the robot is to touch lie within its reach.

    Some episodes cannot be solved.

    ## Why
    If a body is placed in a range that is wider than the robot's reach, some of the episodes cannot be
    solved. The success rate then has a ceiling that no training lifts, and nothing says why.

    ## Fix
    Narrow the range, or move the robot nearer.

    ```python fragment
    p[:, :2] = (2 * torch.rand((b, 2)) - 1) * 0.15  # the arm reaches 0.8 m from x = -0.6
    self.cube.set_pose(Pose.create_from_pq(p=p, q=[1, 0, 0, 0]))
    ```

    ## How it is checked
    The reach is the largest distance from the base to the `tcp` over 40 random postures of each env's robot
    within the joint limits. The rule reports a dynamic body that is more than 5 cm beyond the reach after
    some resets, but not after all. The result is *not known* if a body is always beyond the reach: it may be
    part of the scene, or be fetched with a tool. It is also *not known* for several robots, and for a robot
    without a `tcp`. It is *not applicable* for robots that drive or walk.
    """
    bodies = together(rows, worst=True)
    if not bodies:
        raise NotApplicable("no actor of the task moves freely")
    for row in bodies:
        if 0 < len(row.seeds) < row.tried:
            yield Found(
                f"{row.names[0]} is up to {row.size:.2f} m from the robot's base, and the tcp reaches {row.numbers[0]:.2f} m: "
                f"the body is out of reach in {of(len(row.seeds), row.tried, 'seed')} (seed {listed(row.seeds)}). Narrow the "
                "range in which it is placed.",
                row.place,
                len(row.seeds),
            )
    if far := [row.names[0] for row in bodies if len(row.seeds) == row.tried]:
        raise NotKnown(
            f"out of reach at every seed: {listed(far)}. Whether the robot must touch them is not known"
        )


def _reach(checkup: Checkup, articulation: Any, tool: Any) -> tuple[NDArray[np.float32], float]:
    """Position (3,) of the base, and the reach of the tcp in metres, from random postures within the joint limits."""
    task = checkup.task
    checkup.reset(task, next(checkup.batches()))
    limits = articulation.get_qlimits()
    if not torch.isfinite(limits).all():
        limits = limits.clamp(-np.pi, np.pi)
        if any(str(joint.type[0]) == "prismatic" and not np.isfinite(np.ravel(joint.limits.cpu())).all()
               for joint in articulation.active_joints):  # fmt: skip
            raise NotApplicable("the robot drives around")
    base = articulation.pose.p.cpu().numpy()
    generator = torch.Generator(device=limits.device).manual_seed(0)
    reach = 0.0
    for _ in range(POSTURES):
        part = torch.rand(limits.shape[:2], generator=generator, device=limits.device)
        articulation.set_qpos(limits[..., 0] + part * (limits[..., 1] - limits[..., 0]))
        apply_and_fetch(task.env)
        reach = max(reach, float(np.linalg.norm(tool.pose.p.cpu().numpy() - base, axis=1).max()))
    return base[0], reach


def where_placed(checkup: Checkup, body: str) -> Place | None:
    """The author's line that sets the body's pose in a reset; else the line that `Places.body` finds."""
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
    """Names of the bodies that a reset gives a velocity."""
    moving: set[str] = set()
    checkup.reset(checkup.task, next(checkup.batches()))
    for name, rows in present_states(checkup.task.env).items():
        rows = np.asarray(rows)
        joints = (rows.shape[1] - 13) // 2
        speeds = np.concatenate([rows[:, 7:13], rows[:, 13 + joints :]], axis=1)
        if (np.abs(np.nan_to_num(speeds)) > MOVING_SPEED).any():
            moving.add(name.split("/", 1)[1])
    return moving


def _touched(checkup: Checkup, robots: set[str]) -> set[str]:
    """Names of the bodies that touch a robot after the reset of some seed."""
    pairs = [
        [body.split("/", 1)[0] for body in overlap.bodies]
        for overlaps in checkup.overlaps.values()
        for overlap in overlaps
    ]
    return {owner for pair in pairs if not robots.isdisjoint(pair) for owner in pair}


def _is_fixed(articulation: Any) -> bool:
    """Whether the root link cannot move."""
    return all(each.links[0].joint.type == "fixed" for each in objects_of(articulation))
