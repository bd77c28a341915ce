"""Commands of the camera that is chosen in the Studio: placement, lens, pictures, reports, changes of the file."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from workbench.page.command import Command

MAX_COORDINATE_METRES = 1000.0
"""Maximum absolute value of a coordinate."""
Axis = Literal["x", "y", "z"]
Angle = Literal["roll", "pitch", "yaw"]
RotationForm = Literal["roll, pitch, yaw", "quaternion wxyz", "forward and up"]
LensForm = Literal["field of view", "intrinsic matrix"]
Number = Annotated[float, msgspec.Meta(ge=-MAX_COORDINATE_METRES, le=MAX_COORDINATE_METRES)]


class SelectCamera(Command, frozen=True):
    """Choose this camera in the Studio."""

    kind: Literal["sensor", "human"]
    name: str


class UndoCamera(Command, frozen=True):
    """Undo the last camera change."""

    key = "ctrl+z"
    context = "live"


class RedoCamera(Command, frozen=True):
    """Redo the last undone camera change."""

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
    """Look through the chosen camera, or return to my view."""


class MoveCameraToView(Command, frozen=True):
    """Move the chosen camera to my view."""


class ResetCamera(Command, frozen=True):
    """Return the chosen camera to its placement in the file."""


class PutMovedCamerasBack(Command, frozen=True):
    """Return all moved cameras to their placement in the file."""


class ShowCameraChange(Command, frozen=True):
    """Show the change of the file for the moved camera."""


class ChooseHandles(Command, frozen=True):
    """Place the camera by its pose, or by eye and target."""

    look_at: bool


class ChooseAxes(Command, frozen=True):
    """Move the camera along the world's axes or along its own."""

    own: bool


class ChooseSnap(Command, frozen=True):
    """Move and rotate the camera in steps of this size."""

    snap: str


class ShowModality(Command, frozen=True):
    """Show the camera's colours, depth, normals or segmentation."""

    kind: str


class ScalePreview(Command, frozen=True):
    """Render the preview at this scale."""

    scale: float


class PickPixel(Command, frozen=True):
    """Show what the camera sees at a pixel of its picture."""

    x: float
    """0 at the left edge, 1 at the right."""
    y: float
    """0 at the top edge, 1 at the bottom."""


class ShowMeasuredMoment(Command, frozen=True):
    """Go to a moment at which the camera was measured."""

    number: int


class UseSuggestedPlane(Command, frozen=True):
    """Use the near or far plane that the report suggests."""

    plane: Literal["near", "far"]


class ToggleWantedObject(Command, frozen=True):
    """Require that suggested placements see this object, or no longer require it."""

    name: str


class ToggleAllLinks(Command, frozen=True):
    """List all links of the robot, or only a few."""


class UsePlacement(Command, frozen=True):
    """Move the camera to a suggested placement."""

    number: int


class ChooseCamera(Command, frozen=True):
    """Choose a camera in the Studio by its name in the list, or none."""

    name: str


class SetCameraPosition(Command, frozen=True):
    """Set this coordinate of the chosen camera's position, in metres."""

    of: Axis
    to: Number


class SetCameraTarget(Command, frozen=True):
    """Set this coordinate of the target that the chosen camera looks at, in metres."""

    of: Axis
    to: Number


class ChooseRotationForm(Command, frozen=True):
    """Show the rotation of the chosen camera as angles, as a quaternion, or as two axes."""

    form: RotationForm


class SetCameraAngle(Command, frozen=True):
    """Set this angle of the chosen camera's rotation, in degrees."""

    of: Angle
    to: Number


class SetCameraQuaternion(Command, frozen=True):
    """Set the rotation of the chosen camera as a quaternion: four numbers, w first."""

    wxyz: Annotated[str, msgspec.Meta(max_length=200)]


class SetCameraForward(Command, frozen=True):
    """Set this component of the chosen camera's forward direction."""

    of: Axis
    to: Number


class SetCameraUp(Command, frozen=True):
    """Set this component of the chosen camera's up direction."""

    of: Axis
    to: Number


class ChooseLensForm(Command, frozen=True):
    """Describe the chosen camera's lens by a field of view, or by the equivalent intrinsic matrix."""

    form: LensForm


class SetFieldOfView(Command, frozen=True):
    """Set the vertical field of view of the chosen camera, in degrees."""

    degrees: Annotated[float, msgspec.Meta(ge=1.0, le=175.0)]


class SetFieldOfViewInRadians(Command, frozen=True):
    """Set the vertical field of view of the chosen camera, in radians."""

    radians: Annotated[float, msgspec.Meta(ge=0.02, le=3.05)]


class SetFocalLength(Command, frozen=True):
    """Set a focal length of the chosen camera, in pixels."""

    of: Literal["fx", "fy"]
    to: Annotated[float, msgspec.Meta(ge=1.0, le=1e5)]


class SetOpticalCentre(Command, frozen=True):
    """Set the optical centre (principal point) of the chosen camera, in pixels."""

    of: Literal["cx", "cy"]
    to: Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]


class SetPictureSize(Command, frozen=True):
    """Set the width or height of the chosen camera's picture, in pixels."""

    of: Literal["width", "height"]
    to: Annotated[int, msgspec.Meta(ge=8, le=4096)]


class SetNearOrFar(Command, frozen=True):
    """Set the near or far plane of the chosen camera, in metres."""

    of: Literal["near", "far"]
    to: Annotated[float, msgspec.Meta(ge=1e-4, le=1e4)]


class ChooseShader(Command, frozen=True):
    """Render the chosen camera's picture with this shader pack."""

    shader: str


class ShowPictures(Command, frozen=True):
    """Show or hide a camera's colours, depth, segmentation or another modality."""

    kind: Literal["sensor", "human"]
    name: str
    modality: str
    on: bool


MAX_MEASURED = 1000
"""Maximum number of steps or resets that a camera is measured over."""

Measured = Literal["envs", "steps", "resets"]


class ChooseMeasured(Command, frozen=True):
    """Choose what a camera is measured over: all envs now, the episode so far, or fresh resets."""

    over: Measured


class ChooseMeasuredSteps(Command, frozen=True):
    """Set the maximum number of steps of the episode over which a camera is measured."""

    steps: Annotated[int, msgspec.Meta(ge=1, le=MAX_MEASURED)]


class ChooseMeasuredResets(Command, frozen=True):
    """Choose over how many fresh resets a camera is measured."""

    resets: Annotated[int, msgspec.Meta(ge=1, le=MAX_MEASURED)]


class MeasureChosenCamera(Command, frozen=True):
    """Measure what the chosen camera sees."""


class DrawSheet(Command, frozen=True):
    """Show the chosen camera's pictures of all envs."""


class StopMeasuring(Command, frozen=True):
    """Stop measuring, comparing or searching for a camera."""


class ChooseCompared(Command, frozen=True):
    """Choose the placement to compare with the current one of the chosen camera."""

    other: Literal["file", "before", "kept"]


class KeepPlacement(Command, frozen=True):
    """Keep the chosen camera's placement as A, to compare with it or return to it later."""


class ComparePlacements(Command, frozen=True):
    """Show two placements of the chosen camera side by side."""


class ReturnToKept(Command, frozen=True):
    """Return the chosen camera to the placement kept as A."""


class SetSearchBox(Command, frozen=True):
    """Set a bound of the box in which placements are searched, and draw the box."""

    corner: Literal["from", "to"]
    axis: Literal[0, 1, 2]
    metres: Annotated[float, msgspec.Meta(ge=-1000.0, le=1000.0)]


class ShowSearchBox(Command, frozen=True):
    """Show or hide the box in which placements are searched."""

    on: bool


MAX_SEARCH_RESETS = 256
"""Maximum number of fresh resets that a search for placements covers."""


class ChooseSearchResets(Command, frozen=True):
    """Choose how many fresh resets a search for placements covers."""

    resets: Annotated[int, msgspec.Meta(ge=1, le=MAX_SEARCH_RESETS)]


class SearchPlacements(Command, frozen=True):
    """Search for placements of the chosen camera that see the wanted objects."""


class ChooseConvention(Command, frozen=True):
    """Choose the axis convention of shown and pasted camera poses."""

    convention: Literal["opencv", "opengl", "maniskill"]


class ChooseDirection(Command, frozen=True):
    """Choose the direction of shown and pasted camera matrices."""

    direction: Literal["world_to_camera", "camera_to_world"]


Form = Literal["json", "opencv", "ros"]


class ChooseCameraFile(Command, frozen=True):
    """Choose the format in which cameras are downloaded."""

    form: Form


class ChooseDownloaded(Command, frozen=True):
    """Choose whether all cameras or only the chosen one are downloaded."""

    every: bool


class DownloadCamera(Command, frozen=True):
    """Download the chosen camera, or all of them, as a file."""


class PasteCalibration(Command, frozen=True):
    """Paste a calibration for the chosen camera."""

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
    """Revert the last saved change of a camera in the file."""


class CopyTask(Command, frozen=True):
    """Copy the task to a file of my own and open it."""


class DropCameraChange(Command, frozen=True):
    """Discard the shown change of a camera, or close the notice about it."""


MAX_CAMERA_NAME_CHARACTERS = 64


class NameCamera(Command, frozen=True):
    """Set the new name for the next camera that is added, copied or renamed."""

    name: Annotated[str, msgspec.Meta(max_length=MAX_CAMERA_NAME_CHARACTERS)]


class AddCamera(Command, frozen=True):
    """Add a camera at my view, and show the change of the file for it."""

    kind: Literal["sensor", "human"]


class DuplicateCamera(Command, frozen=True):
    """Duplicate the chosen camera, and show the change of the file for it."""


class RenameCamera(Command, frozen=True):
    """Rename the chosen camera, and show the change of the file for it."""


class RemoveCamera(Command, frozen=True):
    """Remove the chosen camera, and show the change of the file for it."""
