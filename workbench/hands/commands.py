"""Commands that move the selected body, the robot's joints, and the robot itself."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from workbench.live.commands import MAX_SEED
from workbench.page.command import Command

Axis = Literal["x", "y", "z"]
Angle = Literal["roll", "pitch", "yaw"]
Side = Literal["x_min", "x_max", "y_min", "y_max"]
Deflection = Annotated[float, msgspec.Meta(ge=-1, le=1)]
Number = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
BodyName = Annotated[str, msgspec.Meta(max_length=256)]
RobotName = Annotated[str, msgspec.Meta(max_length=256)]
JointNumber = Annotated[int, msgspec.Meta(ge=0)]


class SetBodyPosition(Command, frozen=True):
    """Move the selected body to this coordinate in the env's frame, in metres."""

    of: Axis
    to: Number


class SetBodyAngle(Command, frozen=True):
    """Rotate the selected body to this angle about a fixed axis, in degrees."""

    of: Angle
    to: Number


class ToggleHandles(Command, frozen=True):
    """Show handles that move and rotate the selected body while the envs are paused."""

    key = "m"
    context = "live"


class WriteBodyPose(Command, frozen=True):
    """Show the change of the file that makes the selected body begin where it is now."""

    context = "live"


class ShowSpawn(Command, frozen=True):
    """Show the range in which resets put the selected body, with handles to drag its sides."""

    context = "live"


class HideSpawn(Command, frozen=True):
    """Hide the range in which resets put a body."""

    context = "live"


class SetSpawnSide(Command, frozen=True):
    """Put a side of the spawn range at this coordinate in the env's frame, in metres."""

    side: Side
    to: Number


class WriteSpawn(Command, frozen=True):
    """Show the change of the file that makes resets put the body in the shown range."""

    context = "live"


class SaveStartChange(Command, frozen=True):
    """Save the shown change of how episodes begin to the file."""

    context = "live"


class RevertStartChange(Command, frozen=True):
    """Revert the saved change of how episodes begin in the file."""

    context = "live"


class DropStartChange(Command, frozen=True):
    """Close the change of how episodes begin; the file stays as it is."""

    context = "live"


class SampleResets(Command, frozen=True):
    """Show where resets with other seeds put the selected body."""

    context = "live"


class HideResets(Command, frozen=True):
    """Hide where resets put the selected body."""

    context = "live"


class ResetUntil(Command, frozen=True):
    """Reset with successive seeds until the first state of an env meets the condition of Pause when."""

    context = "live"


class StopResetUntil(Command, frozen=True):
    """Stop resetting until a condition is met."""

    context = "live"


class ShowReset(Command, frozen=True):
    """Select an env, and reset all envs with this seed."""

    seed: Annotated[int, msgspec.Meta(ge=0, le=MAX_SEED)]
    env: Annotated[int, msgspec.Meta(ge=0)]


class ToggleGhosts(Command, frozen=True):
    """Draw the selected body's shape where resets put it, or only points."""

    context = "live"


class ToggleDriving(Command, frozen=True):
    """Drive the robot of the selected env by keys, or stop driving."""

    key = "k"
    context = "live"


class BeginAgain(Command, frozen=True):
    """Reset the driven env with the next seed, without keeping its episode."""

    key = "z"
    context = "driving"


class DiscardEpisode(Command, frozen=True):
    """Discard the driven episode, and begin it again with the same seed."""

    key = "x"
    context = "driving"


class KeepEpisode(Command, frozen=True):
    """Save the driven episode, and begin the next one with the next seed."""

    key = "c"
    context = "driving"


class DriveRobot(Command, frozen=True):
    """Report the held driving keys, and the deflections of the gamepad."""

    keys: Annotated[tuple[str, ...], msgspec.Meta(max_length=16)]
    axes: Annotated[tuple[Deflection, ...], msgspec.Meta(max_length=4)] = ()
    buttons: Annotated[tuple[Deflection, ...], msgspec.Meta(max_length=17)] = ()


class ToggleReach(Command, frozen=True):
    """Show or hide handles at the end effectors; the arms follow the handles."""

    key = "i"
    context = "live"


class ChooseMovedEnvs(Command, frozen=True):
    """Move the body or the robot in the selected env, or in all envs."""

    all_envs: bool


class FrameBody(Command, frozen=True):
    """Frame the selected body."""

    key = "shift+f"
    context = "live"


class TrackBody(Command, frozen=True):
    """Let the viewpoint follow the selected body, or stop following."""

    context = "live"


class HideBody(Command, frozen=True):
    """Hide the selected body in the 3D view, or show it; cameras and physics do not change."""

    key = "h"
    context = "live"


class ShowHiddenBodies(Command, frozen=True):
    """Show all hidden bodies."""

    key = "shift+h"
    context = "live"


class MeasureFrom(Command, frozen=True):
    """Measure distances from the selected body to the next one that is selected."""

    context = "live"


class WatchForce(Command, frozen=True):
    """Add the contact force between two bodies to the curves and to Pause when, or remove it."""

    context = "live"
    body: BodyName
    other: BodyName
    on: bool


class DragJoint(Command, frozen=True):
    """Show a joint at the position of its dragged slider; while playing, drive the joint there."""

    robot: RobotName
    joint: JointNumber
    to: Number
    """Degrees for a revolute joint, metres for a prismatic one."""


class SetJoint(Command, frozen=True):
    """Put a joint at a position; while playing, drive the joint there."""

    robot: RobotName
    joint: JointNumber
    to: Number
    """Degrees for a revolute joint, metres for a prismatic one."""


class WriteQpos(Command, frozen=True):
    """Show the change of the file that makes the robot begin with its present joint positions."""

    robot: RobotName


class UseKeyframe(Command, frozen=True):
    """Put the robot into this keyframe of its agent."""

    robot: RobotName
    name: Annotated[str, msgspec.Meta(max_length=256)]
