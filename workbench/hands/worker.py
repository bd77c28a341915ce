"""Moves and pulls bodies, and sets joints, in the worker's env."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sapien
import sapien.physx as physx
import torch
from mani_skill.utils.structs.pose import Pose
from numpy.typing import NDArray

from workbench.envs import maniskill_private
from workbench.envs.read_robots import named_agents
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.simulation.cpu_system import batched_system
from workbench.envs.snapshots.snapshot import begin_anew
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv
from workbench.episodes.recorded_state import settle_robot
from workbench.live.messages import MoveBody, MoveJoints, PullBody
from workbench.task.description import Pulled, Restored

STIFFNESS = 400.0
"""Newtons per metre and kilogram of effective mass: a critically damped spring of 20 rad/s. It holds a body 2.5 cm below
the target."""
MAX_ACCELERATION = 200.0
"""Bound of the spring's force, in newtons per kilogram, so that a far target does not throw the body through a wall."""


def move_body(task: TaskEnv, request: MoveBody) -> tuple[StepResult, Restored] | None:
    """Put a body at a pose, at rest; None if the env has no such body that can be moved.

    The envs get new physics scenes, so the state is an exact point of the history (`begin_anew`).
    """
    env = task.env
    actor = _actor(env, request.body)
    if actor is None or actor.px_body_type == "static":
        return None
    # Lowest env first, the order of rows in ManiSkill's setters.
    envs = [i for i in maniskill_private.envs_of(actor).tolist() if i in request.env_idx]
    if not envs:
        return None
    rows = np.zeros((len(envs), 13), np.float32)
    rows[:, :7] = request.pose
    rows[:, 3:7] /= np.linalg.norm(rows[:, 3:7], axis=1, keepdims=True)
    actor.set_state(torch.as_tensor(rows, device=env.device), torch.as_tensor(envs, device=env.device))
    maniskill_private.apply_and_fetch(env)
    if batched_system(env.scene) is not None:
        begin_anew(env, envs)
    moved = tuple(envs)
    how = f"{request.body} was moved by hand."
    return task.rescore(), Restored(moved, moved, request.origin, None, {}, how=how, moved=request.body)


def move_joints(task: TaskEnv, request: MoveJoints) -> tuple[StepResult, Restored] | None:
    """Put joints of a robot at positions, at rest; None if the env has no such robot or joint."""
    env = task.env
    agent = named_agents(env).get(request.robot)
    envs = sorted(i for i in set(request.env_idx) if i < env.num_envs)
    if agent is None or not envs or max(request.joints, default=0) >= len(agent.robot.active_joints):
        return None
    qpos = agent.robot.get_qpos()[envs].clone()
    qpos[:, list(request.joints)] = torch.tensor(request.positions, device=qpos.device, dtype=qpos.dtype)
    step = put_joints(task, agent, envs, qpos, request.root)
    moved = tuple(envs)
    return step, Restored(moved, moved, request.origin, None, {}, how=request.how, moved=request.robot)


def put_joints(
    task: TaskEnv,
    agent: Any,
    envs: list[int],
    qpos: torch.Tensor,
    root_pose: Sequence[float] | None = None,
) -> StepResult:
    """Put all joints of an agent's robot at positions in these envs, at rest.

    Drive targets and controllers of the robot are set to the new positions, so that it stays there. The envs get new
    physics scenes, as in `move_body`.

    Args:
        envs: in ascending order.
        qpos: (len(envs), J) in rad or m.
        root_pose: (7,) new pose of the robot's root; None leaves it.
    """
    env, robot = task.env, agent.robot
    with maniskill_private.setting_only(env, envs):
        if root_pose is not None:
            root = torch.tensor(root_pose, device=qpos.device, dtype=qpos.dtype)
            root[3:] /= root[3:].norm()
            robot.set_root_pose(Pose.create(root.expand(len(envs), 7)))
            still = torch.zeros((len(envs), 3), device=qpos.device)
            robot.set_root_linear_velocity(still)
            robot.set_root_angular_velocity(still)
        robot.set_qpos(qpos)
        robot.set_qvel(torch.zeros_like(qpos))
        robot.set_qf(torch.zeros_like(qpos))
    maniskill_private.apply_and_fetch(env)
    settle_robot(env, envs, agent)
    if batched_system(env.scene) is not None:
        begin_anew(env, envs)
    return task.rescore()


def _actor(env: Any, name: str) -> Any:
    """The actor of this name, or the merged actor; None if there is none."""
    found = scene_index(env).states.get(f"actors/{name}")
    if found is not None:
        return found
    return next((actor for actor, _ in scene_index(env).actors if actor.name == name), None)


class Hand:
    """Pulls one body with a spring while the envs step."""

    def __init__(self) -> None:
        self._request = PullBody()
        self._spring: _Spring | None = None

    def take(self, request: PullBody) -> None:
        """Pull as requested from now on; without a body, let go."""
        self._request = request

    @contextmanager
    def pulling(self, env: Any) -> Iterator[None]:
        """Context for one control step: the spring pulls in each of its substeps."""
        self._spring = _spring(env, self._request)
        if self._spring is None:
            yield
        else:
            with maniskill_private.before_each_substep(env, self._spring.push):
                yield

    @property
    def pulled(self) -> Pulled | None:
        """The pull during the last control step; None if nothing was pulled."""
        spring, request = self._spring, self._request
        if spring is None:
            return None
        return Pulled(request.env, request.body, float(np.mean(spring.newtons)) if spring.newtons else 0.0)


@dataclass
class _Spring:
    px: Any
    component: Any
    """SAPIEN's component of the body."""
    row: int
    """The body's row in the tensors of the simulation."""
    mass: NDArray[np.float64]
    """(3, 3) effective mass at the grabbed point in kg, in the body's frame. A force on a point far from the centre also turns
    the body: with the mass of the whole body, the spring would be too stiff there and throw the body about."""
    grabbed: NDArray[np.float64]
    target: NDArray[np.float64]
    newtons: list[float] = field(default_factory=list)
    """Norm of the force in each substep so far."""

    def push(self) -> None:
        """Apply the spring's force for one substep."""
        px = self.px
        px.gpu_fetch_rigid_dynamic_data()
        px.gpu_fetch_articulation_link_pose()
        px.gpu_fetch_articulation_link_velocity()
        state = px.cuda_rigid_body_data.torch()[self.row].double().cpu().numpy()
        pose = sapien.Pose(state[:3], state[3:7])
        centre = (pose * self.component.cmass_local_pose).p
        arm = (pose * sapien.Pose(self.grabbed)).p - centre
        velocity = state[7:10] + np.cross(state[10:13], arm)
        pull = STIFFNESS * (self.target - centre - arm) - 2 * np.sqrt(STIFFNESS) * velocity
        size = float(np.linalg.norm(pull))
        if not np.isfinite(size):
            return
        turn = pose.to_transformation_matrix()[:3, :3].astype(np.float64)
        force = turn @ self.mass @ turn.T @ pull * min(1.0, MAX_ACCELERATION / max(size, 1e-9))
        self.newtons.append(float(np.linalg.norm(force)))
        for tensor, value in (
            (px.cuda_rigid_body_force, force),
            (px.cuda_rigid_body_torque, np.cross(arm, force)),
        ):
            data = tensor.torch()
            data[self.row, :3] = torch.as_tensor(value, dtype=data.dtype, device=data.device)
        px.gpu_apply_rigid_dynamic_force()
        px.gpu_apply_rigid_dynamic_torque()


def _spring(env: Any, request: PullBody) -> _Spring | None:
    """The spring of a request; None if there is nothing to pull."""
    if not request.body:
        return None
    index = scene_index(env)
    if request.body not in index.names or request.env >= env.num_envs:
        return None
    body = index.names.index(request.body)
    entity = index.entities[request.env, body]
    row = index.row_of(request.env, request.body)
    if entity is None or index.kinds[body] not in ("dynamic", "link") or row is None:
        return None
    component = entity.find_component_by_type(physx.PhysxRigidBodyComponent)
    grabbed, target = (np.array(point, np.float64) for point in (request.grabbed, request.target))
    mass = _link_mass if index.kinds[body] == "link" else _free_mass
    return _Spring(env.scene.px, component, row, mass(component, grabbed), grabbed, target)


def _free_mass(component: Any, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) effective mass in kg of a free body at a point (3,), both in the body's frame."""
    centre = component.cmass_local_pose
    turn = centre.to_transformation_matrix()[:3, :3].astype(np.float64)
    arm = _cross_matrix(point - centre.p)
    turning = turn @ np.diag(1 / component.inertia) @ turn.T
    return np.linalg.inv(np.eye(3) / component.mass + arm.T @ turning @ arm)


def _link_mass(component: Any, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) effective mass in kg of a link at a point (3,), both in the link's frame, with free joints: inverse of
    J M^-1 J^T (Khatib 1987, the operational space inertia). In directions in which the joints hardly let the point move, it
    is the mass of the whole articulation."""
    robot = component.articulation
    total = sum(link.mass for link in robot.links)
    mobility = np.eye(3) * (0.0 if robot.root.joint.type == "fixed" else 1 / total)
    if robot.dof:
        model, qpos = robot.create_pinocchio_model(), robot.qpos
        jacobian = model.compute_single_link_local_jacobian(qpos, component.index)
        linear = jacobian[:3] - _cross_matrix(point) @ jacobian[3:]
        mobility += linear @ np.linalg.solve(model.compute_generalized_mass_matrix(qpos), linear.T)
    values, directions = np.linalg.eigh(mobility)
    return directions @ np.diag(1 / np.maximum(values, 1 / total)) @ directions.T


def _cross_matrix(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) matrix M with ``M @ w == np.cross(v, w)``."""
    return np.cross(np.eye(3), v)
