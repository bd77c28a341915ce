"""The camera that is chosen in the Studio: its place, its picture, what it sees."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from workbench.page.command import Command

FARTHEST = 1000.0
"""Most metres from the origin."""
Axis = Literal["x", "y", "z"]
Angle = Literal["roll", "pitch", "yaw"]
RotationForm = Literal["roll, pitch, yaw", "quaternion wxyz", "forward and up"]
LensForm = Literal["field of view", "intrinsic matrix"]
Number = Annotated[float, msgspec.Meta(ge=-FARTHEST, le=FARTHEST)]


class SelectCamera(Command, frozen=True):
    """Choose this camera in the Studio."""

    kind: Literal["sensor", "human"]
    name: str


class UndoCamera(Command, frozen=True):
    """Undo the last camera change."""

    key = "ctrl+z"
    context = "live"


class RedoCamera(Command, frozen=True):
    """Redo the camera change."""

    key = "ctrl+shift+z"
    context = "live"


class MoveCameraLeft(Command, frozen=True):
    """Move the chosen camera left."""

    key = "alt+arrowleft"
    context = "live"
    repeats = True


class MoveCameraRight(Command, frozen=True):
    """Move the chosen camera right."""

    key = "alt+arrowright"
    context = "live"
    repeats = True


class MoveCameraUp(Command, frozen=True):
    """Move the chosen camera up."""

    key = "alt+arrowup"
    context = "live"
    repeats = True


class MoveCameraDown(Command, frozen=True):
    """Move the chosen camera down."""

    key = "alt+arrowdown"
    context = "live"
    repeats = True


class MoveCameraForward(Command, frozen=True):
    """Move the chosen camera forward."""

    key = "alt+pageup"
    context = "live"
    repeats = True


class MoveCameraBack(Command, frozen=True):
    """Move the chosen camera back."""

    key = "alt+pagedown"
    context = "live"
    repeats = True


class TurnCameraLeft(Command, frozen=True):
    """Rotate the chosen camera left."""

    key = "alt+shift+arrowleft"
    context = "live"
    repeats = True


class TurnCameraRight(Command, frozen=True):
    """Rotate the chosen camera right."""

    key = "alt+shift+arrowright"
    context = "live"
    repeats = True


class TurnCameraUp(Command, frozen=True):
    """Rotate the chosen camera up."""

    key = "alt+shift+arrowup"
    context = "live"
    repeats = True


class TurnCameraDown(Command, frozen=True):
    """Rotate the chosen camera down."""

    key = "alt+shift+arrowdown"
    context = "live"
    repeats = True


class ToggleLookThrough(Command, frozen=True):
    """Look through the chosen camera, or go back to my view."""


class MoveCameraToView(Command, frozen=True):
    """Move the chosen camera to my view."""


class ResetCamera(Command, frozen=True):
    """Put the chosen camera back to the placement in the file."""


class PutMovedCamerasBack(Command, frozen=True):
    """Put all cameras back that were moved by hand."""


class ShowCameraChange(Command, frozen=True):
    """Show the change of the file for the camera that was moved."""


class ChooseHandles(Command, frozen=True):
    """Place the camera by its pose, or by eye and target."""

    look_at: bool


class ChooseAxes(Command, frozen=True):
    """Move the camera along the world's axes, or along its own."""

    own: bool


class ChooseSnap(Command, frozen=True):
    """Move and turn the camera in steps of this size."""

    snap: str


class ShowOneEnv(Command, frozen=True):
    """Show the selected env alone, or all."""

    one: bool


class ShowModality(Command, frozen=True):
    """Show the camera's colours, depth, normals or segmentation."""

    kind: str


class ScalePreview(Command, frozen=True):
    """Draw the preview in another size."""

    scale: float


class PickPixel(Command, frozen=True):
    """Say what the camera sees at a place of its picture."""

    x: float
    """0 at the left border, 1 at the right."""
    y: float
    """0 at the upper border, 1 at the lower."""


class ShowMeasuredMoment(Command, frozen=True):
    """Show a moment that the camera was measured at."""

    number: int


class UseSuggestedPlane(Command, frozen=True):
    """Use the near or far plane that the report suggests."""

    plane: Literal["near", "far"]


class ToggleWantedObject(Command, frozen=True):
    """Ask that an object be visible from a suggested placement, or no longer."""

    name: str


class ToggleAllLinks(Command, frozen=True):
    """List all links of the robot, or a few."""


class UsePlacement(Command, frozen=True):
    """Put the camera where a suggestion has it."""

    number: int


class ChooseCamera(Command, frozen=True):
    """Choose a camera in the Studio by its name in the list there, or none."""

    name: str


class SetCameraPosition(Command, frozen=True):
    """Place the chosen camera at this coordinate, in metres."""

    of: Axis
    to: Number


class SetCameraTarget(Command, frozen=True):
    """Turn the chosen camera to a target with this coordinate, in metres."""

    of: Axis
    to: Number


class ChooseRotationForm(Command, frozen=True):
    """Write the rotation of the chosen camera as angles, as a quaternion, or as two axes."""

    form: RotationForm


class SetCameraAngle(Command, frozen=True):
    """Turn the chosen camera to this angle, in degrees."""

    of: Angle
    to: Number


class SetCameraQuaternion(Command, frozen=True):
    """Turn the chosen camera as this quaternion says: four numbers, w first."""

    wxyz: Annotated[str, msgspec.Meta(max_length=200)]


class SetCameraForward(Command, frozen=True):
    """Turn the chosen camera so that its line of sight has this component."""

    of: Axis
    to: Number


class SetCameraUp(Command, frozen=True):
    """Turn the chosen camera so that the top of its picture has this component."""

    of: Axis
    to: Number


class ChooseLensForm(Command, frozen=True):
    """Say the lens of the chosen camera by a field of view, or by an intrinsic matrix of the same picture."""

    form: LensForm


class SetFieldOfView(Command, frozen=True):
    """Give the chosen camera this vertical field of view, in degrees."""

    degrees: Annotated[float, msgspec.Meta(ge=1.0, le=175.0)]


class SetFieldOfViewInRadians(Command, frozen=True):
    """Give the chosen camera this vertical field of view, in radians."""

    radians: Annotated[float, msgspec.Meta(ge=0.02, le=3.05)]


class SetFocalLength(Command, frozen=True):
    """Give the chosen camera this focal length, in pixels."""

    of: Literal["fx", "fy"]
    to: Annotated[float, msgspec.Meta(ge=1.0, le=1e5)]


class SetOpticalCentre(Command, frozen=True):
    """Put the optical axis of the chosen camera at this place of its picture, in pixels."""

    of: Literal["cx", "cy"]
    to: Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]


class SetPictureSize(Command, frozen=True):
    """Give the chosen camera's picture this width or height, in pixels."""

    of: Literal["width", "height"]
    to: Annotated[int, msgspec.Meta(ge=8, le=4096)]


class SetNearOrFar(Command, frozen=True):
    """Draw nothing that is nearer or farther from the chosen camera than this, in metres."""

    of: Literal["near", "far"]
    to: Annotated[float, msgspec.Meta(ge=1e-4, le=1e4)]


class ChooseShader(Command, frozen=True):
    """Draw the chosen camera's picture with this shader pack."""

    shader: str


class ShowFrustums(Command, frozen=True):
    """Draw the cameras, with their pictures, in the 3D view, or not."""

    on: bool


class ShowPictures(Command, frozen=True):
    """Show a camera's colours, depth, segmentation or another of its modalities, or not."""

    kind: Literal["sensor", "human"]
    name: str
    modality: str
    on: bool


MOST_MEASURED = 1000
"""Steps, or resets, that a camera is measured over."""

Measured = Literal["envs", "steps", "resets"]


class ChooseMeasured(Command, frozen=True):
    """Choose what a camera is measured over: all envs now, the episode so far, or fresh resets."""

    over: Measured


class ChooseMeasuredSteps(Command, frozen=True):
    """Choose how many steps of the episode a camera is measured over at most."""

    steps: Annotated[int, msgspec.Meta(ge=1, le=MOST_MEASURED)]


class ChooseMeasuredResets(Command, frozen=True):
    """Choose how many fresh resets a camera is measured over."""

    resets: Annotated[int, msgspec.Meta(ge=1, le=MOST_MEASURED)]


class MeasureChosenCamera(Command, frozen=True):
    """Measure what the chosen camera sees."""


class DrawSheet(Command, frozen=True):
    """Show the chosen camera's pictures of all envs."""


class StopMeasuring(Command, frozen=True):
    """Stop what measures, compares or searches for a camera."""


class ChooseCompared(Command, frozen=True):
    """Choose the placement that the chosen camera's present one is compared with."""

    other: Literal["file", "before", "kept"]


class KeepPlacement(Command, frozen=True):
    """Keep the chosen camera's placement as A, to compare it later or return to it."""


class ComparePlacements(Command, frozen=True):
    """Show two placements of the chosen camera side by side."""


class ReturnToKept(Command, frozen=True):
    """Put the chosen camera back to the placement that was kept as A."""


class SetSearchBox(Command, frozen=True):
    """Bound the box in which a placement is searched, and draw it."""

    corner: Literal["from", "to"]
    axis: Literal[0, 1, 2]
    metres: Annotated[float, msgspec.Meta(ge=-1000.0, le=1000.0)]


class ShowSearchBox(Command, frozen=True):
    """Draw the box in which a placement is searched, or not."""

    on: bool


MOST_SEARCHED = 256
"""Resets that a placement is searched over."""


class ChooseSearchResets(Command, frozen=True):
    """Choose how many fresh resets a placement is searched over."""

    resets: Annotated[int, msgspec.Meta(ge=1, le=MOST_SEARCHED)]


class SearchPlacements(Command, frozen=True):
    """Search placements of the chosen camera that see the wanted objects."""


class ChooseConvention(Command, frozen=True):
    """Choose the convention of the camera's own axes, for what is shown and what is pasted."""

    convention: Literal["opencv", "opengl", "maniskill"]


class ChooseDirection(Command, frozen=True):
    """Choose the direction of a camera's matrix, for what is shown and what is pasted."""

    direction: Literal["world_to_camera", "camera_to_world"]


Form = Literal["json", "opencv", "ros"]


class ChooseCameraFile(Command, frozen=True):
    """Choose the format in which cameras are downloaded."""

    form: Form


class ChooseDownloaded(Command, frozen=True):
    """Choose whether all cameras are downloaded, or the chosen one."""

    every: bool


class DownloadCamera(Command, frozen=True):
    """Download the chosen camera, or all of them, as a file."""


class PasteCalibration(Command, frozen=True):
    """Paste the calibration that the chosen camera will be placed by."""

    text: Annotated[str, msgspec.Meta(max_length=20_000)]


class ChooseUnits(Command, frozen=True):
    """Choose the units of a pasted calibration."""

    units: Literal["metres", "centimetres", "millimetres"]


class ApplyCalibration(Command, frozen=True):
    """Place the chosen camera by the pasted calibration."""


class PlanCameraChange(Command, frozen=True):
    """Show the change of the file for the chosen camera."""


class SaveCameraChange(Command, frozen=True):
    """Save the shown change of a camera to the file."""


class RevertCameraChange(Command, frozen=True):
    """Take the last saved change of a camera out of the file."""


class CopyTask(Command, frozen=True):
    """Copy the task to a file of my own, and open it."""


class DropCameraChange(Command, frozen=True):
    """Discard the shown change of a camera, or close what is said of it."""


LONGEST_CAMERA_NAME = 64
"""Characters."""


class NameCamera(Command, frozen=True):
    """Name the camera that is added, copied or renamed next."""

    name: Annotated[str, msgspec.Meta(max_length=LONGEST_CAMERA_NAME)]


class AddCamera(Command, frozen=True):
    """Add a camera at my view, and show the change of the file for it."""

    kind: Literal["sensor", "human"]


class DuplicateCamera(Command, frozen=True):
    """Duplicate the chosen camera, and show the change of the file for it."""


class RenameCamera(Command, frozen=True):
    """Rename the chosen camera, and show the change of the file for it."""


class RemoveCamera(Command, frozen=True):
    """Remove the chosen camera, and show the change of the file for it."""
