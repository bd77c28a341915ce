"""Joints, links and keyframes of a task's robots as plain data, without a simulator."""

from __future__ import annotations

from dataclasses import dataclass

Pose = tuple[float, float, float, float, float, float, float]
"""Position in metres and quaternion wxyz."""


@dataclass(frozen=True)
class JointTarget:
    """The number of the action that is a joint's absolute position target: ``scale * (position - zero)``."""

    dimension: int
    scale: float
    """Per radian or metre."""
    zero: float
    """Position at which the number is 0, in radians or metres."""


@dataclass(frozen=True)
class Joint:
    """An active joint of a robot."""

    name: str
    prismatic: bool
    """Whether positions are in metres; if False, in radians."""
    low: float
    """Lower limit; infinite for a joint without a limit."""
    high: float
    column: int
    """The joint's place along J of `StepResult.qpos`."""
    target: JointTarget | None = None
    """None if the control mode takes no absolute target for this joint."""


@dataclass(frozen=True)
class RobotLink:
    """A link and the joint that connects it to its parent. A joint moves about or along the x axis of its frame."""

    body: int
    """The link's place along B of `StepResult.poses`."""
    parent: int
    """Index of the parent in `RobotDescription.links`; -1 for the root."""
    joint: int
    """Index in `RobotDescription.joints`; -1 for a fixed joint."""
    in_parent: Pose
    """The joint's frame in the parent's frame."""
    in_link: Pose
    """The joint's frame in the link's frame."""


@dataclass(frozen=True)
class RobotKeyframe:
    """A keyframe of the robot's agent class."""

    name: str
    qpos: tuple[float, ...]
    """A position for each of `RobotDescription.joints`."""
    root: Pose | None
    """Pose of the root; None leaves the root where it is: it is fixed, or the keyframe has no pose."""


@dataclass(frozen=True)
class RobotDescription:
    """A robot that every env has."""

    name: str
    """The agent's uid; with several robots, the robot's key in the action dict."""
    joints: tuple[Joint, ...]
    """In the order of the robot's qpos."""
    links: tuple[RobotLink, ...]
    """Parents come before their children."""
    keyframes: tuple[RobotKeyframe, ...] = ()
