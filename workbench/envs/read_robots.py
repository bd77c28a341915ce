"""Reads the joints, links and keyframes of an env's robots."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import sapien
import torch
from mani_skill.agents.base_agent import Keyframe
from mani_skill.utils.structs.pose import Pose as ManiSkillPose

from workbench.envs import action_vector, maniskill_private
from workbench.envs.robots import Joint, JointTarget, Pose, RobotDescription, RobotKeyframe, RobotLink
from workbench.envs.scene.scene_index import joints_of_scene, scene_index


def named_agents(env: Any) -> dict[str, Any]:
    """The agent of each robot by `RobotDescription.name`, in the order of the action."""
    found = maniskill_private.agents(env)
    return {agent.uid if len(found) == 1 else f"{agent.uid}-{i}": agent for i, agent in enumerate(found)}


def read_robots(env: Any) -> tuple[RobotDescription, ...]:
    """The robots of a ManiSkill env, which must have been reset at least once.

    Leaves out a robot whose joints are not in `StepResult.qpos`.
    """
    return tuple(
        RobotDescription(name, joints, tuple(_links(env, agent.robot)), tuple(_keyframes(agent)))
        for name, agent in named_agents(env).items()
        if (joints := tuple(_joints(env, agent)))
    )


def _joints(env: Any, agent: Any) -> Iterator[Joint]:
    column = 0
    for _, articulation in joints_of_scene(env):
        if articulation is not agent.robot:
            column += len(articulation.active_joints)
            continue
        limits = articulation.get_qlimits()[0].cpu().numpy().tolist()
        active = maniskill_private.objects_of(articulation)[0].active_joints
        targets = _targets(env, articulation)
        for k, (joint, own) in enumerate(zip(articulation.active_joints, active, strict=True)):
            low, high = limits[k]
            prismatic = own.type == "prismatic"
            yield Joint(joint.name, prismatic, low, high, column + k, targets.get(joint.name))


def _targets(env: Any, articulation: Any) -> dict[str, JointTarget]:
    """Absolute position targets in the action, by the joint's name."""
    found: dict[str, JointTarget] = {}
    first = 0
    for part in action_vector.action_parts(env):
        joints = action_vector.target_joints(part)
        if joints and part.controller.articulation is articulation and len(joints) == len(part.names):
            for k, joint in enumerate(joints):
                low, high = _normalized_bounds(part.controller, k)
                if low < high:
                    found[joint.name] = JointTarget(first + k, 2 / (high - low), (high + low) / 2)
        first += len(part.names)
    return found


def _normalized_bounds(controller: Any, k: int) -> tuple[float, float]:
    """The positions at which number k of the controller's action is -1 and 1."""
    if not controller.config.normalize_action:
        return -1.0, 1.0
    return float(controller.action_space_low[k]), float(controller.action_space_high[k])


def _links(env: Any, articulation: Any) -> Iterator[RobotLink]:
    index, first = scene_index(env), maniskill_private.objects_of(articulation)[0]
    place = {id(link.entity): k for k, link in enumerate(first.links)}
    joint_of = {id(joint): k for k, joint in enumerate(first.active_joints)}
    for link in first.links:
        name = index.name_of(link)
        assert name is not None, "ManiSkill manages every link of an articulation"
        parent = -1 if link.parent is None else place[id(link.parent.entity)]
        joint = link.joint
        yield RobotLink(
            index.names.index(name),
            parent,
            joint_of.get(id(joint), -1),
            _pose(joint.pose_in_parent),
            _pose(joint.pose_in_child),
        )


def _keyframes(agent: Any) -> Iterator[RobotKeyframe]:
    """The keyframes that have a finite position for each joint."""
    fixed = bool(agent.robot.fixed_root_link.all())
    for name, keyframe in agent.keyframes.items():
        if not isinstance(keyframe, Keyframe) or keyframe.qpos is None:
            continue
        try:
            qpos = torch.as_tensor(keyframe.qpos, dtype=torch.float64).flatten()
        except (TypeError, ValueError):
            continue  # ManiSkill does not read the keyframes of a task that does not use them
        if len(qpos) == len(agent.robot.active_joints) and qpos.isfinite().all():
            root = None if fixed or keyframe.pose is None else _root_pose(keyframe.pose)
            yield RobotKeyframe(name, tuple(qpos.tolist()), root)


def _root_pose(pose: Any) -> Pose | None:
    """The pose of a keyframe, of the first env if it has one for each; None if it is not a pose."""
    row = ManiSkillPose.create(pose).raw_pose[0].double().cpu()
    if not row.isfinite().all() or row[3:].norm() == 0:
        return None
    x, y, z, w, a, b, c = row.tolist()
    return x, y, z, w, a, b, c


def _pose(pose: Any) -> Pose:
    own = pose if isinstance(pose, sapien.Pose) else pose.sp
    x, y, z = map(float, own.p)
    w, a, b, c = map(float, own.q)
    return x, y, z, w, a, b, c
