"""Arms of the robots: their end effectors, inverse kinematics, and the action that moves an arm to a pose.

The inverse kinematics are those of SAPIEN (``create_pinocchio_model``), which ManiSkill's end-effector controllers use on the
CPU. They need no URDF and work for one env at a time on any device.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.controllers.pd_ee_pose import (
    PDEEPosController,
    PDEEPosControllerConfig,
    PDEEPoseController,
)
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosController, PDJointPosMimicController
from mani_skill.agents.controllers.pd_joint_pos_vel import PDJointPosVelController
from mani_skill.agents.controllers.pd_joint_vel import PDJointVelController
from mani_skill.utils.geometry.rotation_conversions import matrix_to_euler_angles
from numpy.typing import NDArray

from workbench.envs import maniskill_private
from workbench.envs.action_vector import ActionPart, action_parts, unscaled
from workbench.envs.scene.scene_index import once_a_scene, scene_index

Floats = NDArray[np.floating[Any]]
Pose = Any
"""A ``sapien.Pose``. Any, because SAPIEN's type accepts only arrays of a known length."""
NEAR_METRES, NEAR_DEGREES = 0.005, 2.0
"""Largest errors of a pose that counts as reached."""
MIN_JOINTS = 3
"""Minimum number of joints of an arm."""
_ITERATIONS, _STEP = 40, 0.25
"""Iterations of one run of the solver, and share of the error that each iteration removes. The solver ignores
the joint limits: the result of a run is clipped to them, and the next run starts from there."""
_RUNS = 3
"""Maximum number of runs."""
_STEPS_TO_POSITION, _STEP_METRES, _DAMPING = 100, 0.15, 0.01
"""Maximum number of steps to a position, their length, and the damping in metres for each radian: near a stretched
arm, steps without damping would be huge."""
_STALLED_STEPS, _STALLED_METRES = 10, 1e-4
"""The steps end if the last of them brought the end effector less than this nearer to the position."""
_OTHER_STARTS = 6
"""Number of other joint positions from which the solver starts if it finds nothing from the present ones."""
_HALVINGS = 7
"""Number of bisections of the line to a target that is out of reach."""
_ORIGIN, _NO_TURN = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
_AT_LIMIT = 1e-3
"""Distance from a limit, in rad or m, below which a joint counts as being at the limit."""
_VELOCITY_GAIN = 0.25
"""Share of the remaining way that a velocity controller takes in one control step."""


@dataclass(frozen=True)
class Arm:
    """An end effector of a robot, and the joints that move it."""

    name: str
    """Name of the end effector's body, as in `SceneIndex.names`."""
    articulation: Any
    """ManiSkill's Articulation."""
    link: Any
    """ManiSkill's Link of the end effector."""
    joints: tuple[int, ...]
    """Indices of the arm's joints among the active joints of the articulation."""
    models: dict[int, Any] = field(default_factory=dict)
    """SAPIEN's PinocchioModel by env; each is made when `solve` first needs it."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(self.articulation.active_joints[k].name for k in self.joints)

    def row(self, env: int) -> int | None:
        """The env's row in the values of `articulation` and `link`; None if the env lacks the robot."""
        at = np.flatnonzero(maniskill_private.envs_of(self.articulation) == env)
        return int(at[0]) if len(at) else None

    def qpos(self, env: int) -> NDArray[np.float64]:
        """(J,) positions of all active joints of the articulation in this env."""
        return _numbers(self.articulation.get_qpos()[self.row(env)])

    def limits(self, env: int) -> NDArray[np.float64]:
        """(J, 2) limits of the active joints in this env."""
        return _numbers(self.articulation.get_qlimits()[self.row(env)])


@dataclass(frozen=True)
class ArmPose:
    """The joint positions that bring an end effector nearest to a target."""

    qpos: NDArray[np.float64]
    """(J,) of all active joints of the articulation; those outside the arm keep their present positions."""
    poses: NDArray[np.float32]
    """(L, 7) resulting poses of the articulation's links, in the env's frame."""
    metres: float
    degrees: float
    """Position and rotation errors that remain at the end effector."""
    why: str
    """Why the target is out of reach; empty if it is within."""


@once_a_scene
def find_arms(env: Any) -> tuple[Arm, ...]:
    """The arms of all robots of a ManiSkill env (unwrapped, reset at least once)."""
    return tuple(arm for agent in maniskill_private.agents(env) for arm in _arms_of(env, agent))


def without_arms(env: Any) -> tuple[str, ...]:
    """Names of the robots that have no arm."""
    armed = {id(arm.articulation) for arm in find_arms(env)}
    return tuple(str(a.uid) for a in maniskill_private.agents(env) if id(a.robot) not in armed)


def _arms_of(env: Any, agent: Any) -> Iterator[Arm]:
    found = list(_ends_with_joints(agent))
    shared = [joint for _, joints in found for joint in set(joints)]
    for link, joints in found:
        own = tuple(joint for joint in joints if shared.count(joint) == 1) if len(found) > 1 else joints
        name = scene_index(env).name_of(maniskill_private.objects_of(link)[0])
        if len(own) >= MIN_JOINTS and name is not None:
            yield Arm(name, agent.robot, link, own)


def _ends_with_joints(agent: Any) -> Iterator[tuple[Any, tuple[int, ...]]]:
    """The end effectors with their joints, from the first of these that the agent has: end-effector
    controllers; tools (`tools_of`), with all joints that move them; the chain of joints up to the first
    branch, which is a hand."""
    robot = agent.robot
    index = {joint.name: k for k, joint in enumerate(robot.active_joints)}
    controlled = {
        part.ee_link: tuple(index[name] for name in part.joint_names)
        for part in maniskill_private.controller_configs(agent)
        if isinstance(part, PDEEPosControllerConfig)
        # ManiSkill reads only the mode in use: the names of another mode may be wrong.
        and part.ee_link in robot.links_map
        and index.keys() >= set(part.joint_names)
    }
    if controlled:
        yield from ((robot.links_map[link], joints) for link, joints in controlled.items())
    elif tools := maniskill_private.tools_of(agent):
        yield from ((tool, _ancestors(tool)) for tool in tools)
    else:
        link = robot.root
        chain: list[int] = []
        while len(below := _moved_by_next_joints(robot, link)) == 1:
            link = below[0]
            chain.append(_active(link))
        if chain:
            yield link, tuple(chain)


def _active(link: Any) -> int:
    return int(link.joint.active_index[0])


def _ancestors(link: Any) -> tuple[int, ...]:
    """Active joints from the root to the link."""
    found: list[int] = []
    while link is not None:
        if link.joint.active_index is not None:
            found.append(_active(link))
        link = link.joint.parent_link
    return tuple(reversed(found))


def _moved_by_next_joints(robot: Any, link: Any) -> list[Any]:
    """The links that the next active joints below a link move."""
    found = []
    for one in robot.links:
        if one.joint.active_index is None:
            continue
        parent = one.joint.parent_link
        while parent is not None and parent.name != link.name and parent.joint.active_index is None:
            parent = parent.joint.parent_link
        if parent is not None and parent.name == link.name:
            found.append(one)
    return found


# --- inverse kinematics ----------------------------------------------------------------------------------


def solve(arm: Arm, env: int, target: Floats) -> ArmPose:
    """The joint positions within the limits that bring the end effector to a target, starting from the present ones.

    If the solver finds none for the whole pose, it solves for the position alone. If it finds none for the
    position, the end effector goes as far along the straight line to the target as it can.

    Args:
        env: an env that has the robot.
        target: (7,) position and quaternion wxyz in the env's frame.
    """
    chain, root = _chain(arm, env)
    wanted = root.inv() * _pose_of(target[:3], target[3:] / np.linalg.norm(target[3:]))
    qpos, limits = arm.qpos(env), chain.limits
    starts = [qpos, *chain.other_starts(qpos)]
    found = chain.solve(starts, wanted)
    if found is None:
        found = chain.approach(qpos, wanted)
    metres, degrees = left = _apart(chain.pose(found), wanted)
    poses = [root * chain.model.get_link_pose(k) for k in range(len(arm.articulation.links))]
    why = "" if _is_near(left) else _why_not(arm, found, limits, left)
    return ArmPose(found, np.array([[*p.p, *p.q] for p in poses], np.float32), metres, degrees, why)


def reaches(arm: Arm, env: int, points: Floats) -> NDArray[np.bool_]:
    """(K,) whether the end effector can be at each point, in any rotation, within the limits of the joints. Collisions
    are not considered.

    Args:
        env: an env that has the robot.
        points: (K, 3) in the env's frame.
    """
    chain, root = _chain(arm, env)
    qpos, to_root = arm.qpos(env), root.inv()
    starts = [qpos, *chain.other_starts(qpos)]
    goals = [to_root * _pose_of(point, _NO_TURN) for point in points]
    return np.array([any(chain.to_position(q, goal) is not None for q in starts) for goal in goals], bool)


def _chain(arm: Arm, env: int) -> tuple[_Chain, Pose]:
    """The chain of the arm in an env that has the robot, and the pose of the articulation's root."""
    row = arm.row(env)
    assert row is not None, "the env has the robot"
    if env not in arm.models:
        arm.models[env] = maniskill_private.objects_of(arm.articulation)[row].create_pinocchio_model()
    link = maniskill_private.objects_of(arm.link)[row].index
    chain = _Chain(arm.models[env], link, arm.joints, arm.limits(env))
    return chain, _pose(arm.articulation.pose.raw_pose[row])


@dataclass(frozen=True)
class _Chain:
    """The chain of an arm in one env; poses are in the frame of the articulation's root."""

    model: Any
    """SAPIEN's PinocchioModel."""
    link: int
    joints: tuple[int, ...]
    limits: Floats
    """(J, 2)"""

    def pose(self, qpos: Floats) -> Pose:
        """Pose of the end effector."""
        self.model.compute_forward_kinematics(qpos)
        return self.model.get_link_pose(self.link)

    def other_starts(self, qpos: Floats) -> list[Floats]:
        """Random joint positions (J,) within the limits, from a fixed seed. From one of these, the
        solver may find a solution that it does not find from a stretched arm or a joint limit."""
        rng = np.random.default_rng(0)
        starts = []
        for _ in range(_OTHER_STARTS):
            start = np.array(qpos, np.float64)
            for joint in self.joints:
                low, high = self.limits[joint]
                is_bounded = np.isfinite(low) and np.isfinite(high)
                start[joint] = (
                    rng.uniform(low, high) if is_bounded else qpos[joint] + rng.uniform(-np.pi, np.pi)
                )
            starts.append(start)
        return starts

    def solve(self, starts: Sequence[Floats], wanted: Pose) -> NDArray[np.float64] | None:
        """Joint positions (J,) within the limits that give the pose or, without any, its position; None if none is
        found from the joint positions `starts`."""
        for find in (self._to_pose, self.to_position):
            for q in starts:
                if (found := find(q, wanted)) is not None:
                    return found
        return None

    def _to_pose(self, qpos: Floats, wanted: Pose) -> NDArray[np.float64] | None:
        mask = np.zeros(len(qpos), bool)
        mask[list(self.joints)] = True
        low, high = (np.where(mask, bound, qpos) for bound in self.limits.T)
        q = np.asarray(qpos, np.float64)
        for _ in range(_RUNS):
            result, _, _ = self.model.compute_inverse_kinematics(
                self.link, wanted, initial_qpos=q, active_qmask=mask, max_iterations=_ITERATIONS, dt=_STEP
            )
            q = np.clip(np.asarray(result, np.float64), low, high)
            if _is_near(_apart(self.pose(q), wanted)):
                return q
        return None

    def to_position(self, qpos: Floats, wanted: Pose) -> NDArray[np.float64] | None:
        """Joint positions (J,) within the limits that give the position, in any rotation; None if none is found from
        `qpos`. By damped least squares of the position alone: SAPIEN's solver weighs metres like radians, and misses
        positions that an arm reaches."""
        own, q = list(self.joints), np.array(qpos, np.float64)
        low, high = self.limits[own].T
        errors: list[float] = []
        for _ in range(_STEPS_TO_POSITION):
            now = self.pose(q)
            way = wanted.p - now.p
            errors.append(float(np.linalg.norm(way)))
            if errors[-1] < NEAR_METRES / 2:
                return q
            if (
                min(errors[:-_STALLED_STEPS], default=np.inf)
                < min(errors[-_STALLED_STEPS:]) + _STALLED_METRES
            ):
                return None
            way *= min(1.0, _STEP_METRES / errors[-1])
            turned = now.to_transformation_matrix()[:3, :3]
            jacobian = turned @ self.model.compute_single_link_local_jacobian(q, self.link)[:3, own]
            moved = _least_step(jacobian, way)
            # The other joints make up for those that are held at a limit.
            within = (q[own] + moved >= low) & (q[own] + moved <= high)
            q[own] = np.clip(
                q[own] + (moved if within.all() else _least_step(jacobian * within, way)), low, high
            )
        return None

    def approach(self, qpos: Floats, wanted: Pose) -> NDArray[np.float64]:
        """Joint positions (J,) that bring the end effector as far along the line to the pose as it can."""
        start, found = self.pose(qpos).p, np.asarray(qpos, np.float64)
        reached, beyond = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = (reached + beyond) / 2
            goal = _pose_of(start + middle * (wanted.p - start), wanted.q)
            between = self.solve([found], goal)
            if between is None:
                beyond = middle
            else:
                reached, found = middle, between
        return found


def _least_step(jacobian: Floats, way: Floats) -> Floats:
    """(J,) smallest change of the joints that moves the end effector along `way` (3,)."""
    return jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + _DAMPING**2 * np.eye(3), way)


def _is_near(error: tuple[float, float]) -> bool:
    return error[0] < NEAR_METRES and error[1] < NEAR_DEGREES


def _why_not(arm: Arm, qpos: Floats, limits: Floats, left: tuple[float, float]) -> str:
    names = [arm.articulation.active_joints[k].name for k in arm.joints if _at_limit(qpos[k], limits[k])]
    if names:
        return f"no solution within the limits of {', '.join(names)}"
    if left[0] < NEAR_METRES:
        return f"{len(arm.joints)} joints cannot give the tool this rotation here"
    return "no solution was found; it may be too far away"


def _at_limit(value: float, limits: Floats) -> bool:
    return bool(value < limits[0] + _AT_LIMIT or value > limits[1] - _AT_LIMIT)


def _apart(one: Pose, other: Pose) -> tuple[float, float]:
    """Distance in metres, and angle in degrees."""
    cosine = min(1.0, abs(float(np.dot(one.q, other.q))))
    return float(np.linalg.norm(one.p - other.p)), float(np.rad2deg(2 * np.arccos(cosine)))


# --- the action that leads there -------------------------------------------------------------------------


def steer(env: Any, arm: Arm, of: int, goal: ArmPose, action: NDArray[np.float32]) -> bool:
    """Set the numbers of the arm in the flat action (A,) of env `of`, so that the next control step goes towards the goal.

    Returns:
        Whether the control mode can move the arm.
    """
    first, moves = 0, False
    for part in action_parts(env):
        columns = slice(first, first + len(part.names))
        first = columns.stop
        if part.controller.articulation is arm.articulation:
            values = _values(env, part, arm, of, goal)
            if values is not None:
                action[columns], moves = np.clip(values, part.low, part.high), True
    return moves


def _values(env: Any, part: ActionPart, arm: Arm, of: int, goal: ArmPose) -> Floats | None:
    """The part's numbers of the action; None if the part does not move the arm."""
    controller: Any = part.controller
    row = arm.row(of)
    if isinstance(controller, PDEEPosController):
        if controller.ee_link.name != arm.link.name:
            return None
        return _pose_values(env, part, arm, of, goal)
    own = controller.active_joint_indices.tolist()
    if not set(own) & set(arm.joints) or isinstance(controller, PDJointPosMimicController):
        return None
    now = arm.qpos(of)
    moved = np.isin(own, arm.joints)
    wanted = np.where(moved, goal.qpos[own], now[own])
    if isinstance(controller, PDJointVelController):
        return _in_bounds(_action_for(env, part, _VELOCITY_GAIN * (wanted - now[own]) / _step_seconds(env)))
    if not isinstance(controller, PDJointPosController):
        return None
    relative = controller.config.use_delta
    if relative:
        state = controller.get_state()
        wanted = wanted - (_numbers(state["target_qpos"][row]) if state else now[own])
        wanted = np.where(moved, wanted, 0.0)
    if isinstance(controller, PDJointPosVelController):
        wanted = np.concatenate([wanted, np.zeros(len(own))])
    values = _action_for(env, part, wanted)
    return _in_bounds(values) if relative else values


def _pose_values(env: Any, part: ActionPart, arm: Arm, of: int, goal: ArmPose) -> Floats:
    """The part's numbers of the action, for an end-effector controller."""
    controller: Any = part.controller
    row, turns = arm.row(of), isinstance(controller, PDEEPoseController)
    assert row is not None, "the env has the robot"
    base = _pose(controller.root_link.pose.raw_pose[row])
    link = maniskill_private.objects_of(arm.link)[row].index
    wanted = base.inv() * _pose_of(goal.poses[link, :3], goal.poses[link, 3:])
    if not controller.config.use_delta:
        rotation = _euler(wanted) if turns else []
        return _action_for(env, part, np.array([*wanted.p, *rotation]))
    state = controller.get_state()
    before = _pose(state["target_pose"][row]) if state else base.inv() * _pose(arm.link.pose.raw_pose[row])
    frame = str(controller.config.frame)
    move = wanted.p - before.p
    if "body_translation" in frame:
        move = _pose_of(_ORIGIN, before.q).inv().to_transformation_matrix()[:3, :3] @ move
    if not turns:
        return _in_bounds(_action_for(env, part, move))
    now, then = _pose_of(_ORIGIN, before.q), _pose_of(_ORIGIN, wanted.q)
    turn = now.inv() * then if "body_aligned" in frame else then * now.inv()
    values = _action_for(env, part, np.array([*move, *_euler(turn)]))
    values[:3] = _in_bounds(values[:3])
    values[3:] /= max(1.0, float(np.linalg.norm(values[3:])))
    return values


def _action_for(env: Any, part: ActionPart, wanted: Floats) -> Floats:
    """The part's numbers (D,) that its controller scales to `wanted` (D,); they may exceed the bounds."""
    return unscaled(part, np.broadcast_to(wanted, (env.num_envs, len(wanted))))[0].astype(np.float64)


def _in_bounds(values: Floats) -> Floats:
    """A relative action, scaled down to -1 to 1 without changing its direction."""
    return values / max(1.0, float(np.abs(values).max(initial=0.0)))


def _step_seconds(env: Any) -> float:
    return 1.0 / env.control_freq


def _euler(pose: Pose) -> list[float]:
    matrix = torch.as_tensor(pose.to_transformation_matrix()[:3, :3])
    return matrix_to_euler_angles(matrix, "XYZ").tolist()


def _numbers(tensor: torch.Tensor) -> NDArray[np.float64]:
    return np.asarray(tensor.numpy(force=True), np.float64)


def _pose(raw: torch.Tensor) -> Pose:
    values = raw.numpy(force=True)
    return _pose_of(values[:3], values[3:7])


def _pose_of(p: Any, q: Any) -> Pose:
    return sapien.Pose(p, q)
