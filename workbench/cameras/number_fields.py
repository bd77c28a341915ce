"""Input fields for the chosen camera's pose, lens and picture."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import get_args

import viser

from workbench.cameras.commands import (
    Angle,
    Axis,
    ChooseLensForm,
    ChooseRotationForm,
    ChooseShader,
    LensForm,
    RotationForm,
    SetCameraAngle,
    SetCameraForward,
    SetCameraPosition,
    SetCameraQuaternion,
    SetCameraTarget,
    SetCameraUp,
    SetFieldOfView,
    SetFieldOfViewInRadians,
    SetFocalLength,
    SetNearOrFar,
    SetOpticalCentre,
    SetPictureSize,
)
from workbench.cameras.pose_math import Floats, Frame, Placing, rounded
from workbench.cameras.view import StudioCamera
from workbench.envs.camera_data import CameraSettings
from workbench.page.command import Command
from workbench.page.widgets.fields import Field, by_name, choice
from workbench.page.widgets.parts import name_fold
from workbench.page.widgets.templates import render
from workbench.page.widgets.visitors import Visitor
from workbench.pictures.camera_conventions import (
    axes_of,
    intrinsic_of,
    matrix3,
    normalised,
    pose_of,
    quaternion_from_axes,
    quaternion_from_rpy,
    rpy_of,
    scaled_intrinsic,
    target_of,
    triple,
    vertical_fov,
    with_pose,
)

RPY, WXYZ, AXES = ROTATIONS = get_args(RotationForm)
FOV, INTRINSIC = LENSES = get_args(LensForm)
XYZ, ANGLES = get_args(Axis), get_args(Angle)
UNIT, DEGREES, QUATERNION, PIXELS = 4, 2, 6, 2
"""Number of decimals shown. `UNIT` is for metres, radians and directions."""
LENS = "Lens and image"
ROTATION = "Rotation"
GOES_ALONG = "The target moves with the position. To keep it fixed, set Handles to eye and target."
STAYS = "Eye and target move separately: the camera keeps looking at the target."
SHADERS: tuple[str, ...] = ("minimal", "default", "rt-fast", "rt-med", "rt")
"""The shader packs of ManiSkill 3."""


class CameraNumbers:
    """Two folders in the present container: pose (with the rotation, folded), and lens and picture.

    All forms of the pose show the same camera and can change it; one of the three forms of the orientation is
    shown at a time. With the pose handle, a new position also moves the target; with the eye and target
    handles, a new position leaves the target where it is. The numbers of a mounted camera are in the frame of
    its link. The lens is a field of view or an intrinsic matrix, which exclude each other in ManiSkill's
    config; changing the form keeps the picture.

    Args:
        look_at: returns whether eye and target are placed separately, instead of a pose.
    """

    does = (
        SetCameraPosition,
        SetCameraTarget,
        ChooseRotationForm,
        SetCameraAngle,
        SetCameraQuaternion,
        SetCameraForward,
        SetCameraUp,
        ChooseLensForm,
        SetFieldOfView,
        SetFieldOfViewInRadians,
        SetFocalLength,
        SetOpticalCentre,
        SetPictureSize,
        SetNearOrFar,
        ChooseShader,
    )

    def __init__(self, server: viser.ViserServer, placing: Placing, look_at: Callable[[], bool]) -> None:
        self._server, self._placing, self._look_at = server, placing, look_at
        self._rotation: RotationForm = RPY
        self._shaders = SHADERS
        with server.gui.add_folder("Pose") as where:
            self._build_points()
            with server.gui.add_folder(ROTATION, expand_by_default=False) as self._rotation_fold:
                self._build_orientation()
        with server.gui.add_folder(LENS, expand_by_default=False) as lens:
            self._build_lens()
            self._build_picture()
        self._folders = where, lens

    def _row(
        self, label: str, kind: type[Command], parts: Sequence[str], hint: str, step: float = 0.01
    ) -> Field:
        """A field of several numbers; `parts` are the possible values of the command's `of`."""
        given = [{"of": part} for part in parts]
        return Field(self._server, label, kind, "to", [0.0] * len(parts), given=given, hint=hint, step=step)

    def _build_points(self) -> None:
        self._points = {
            separately: (
                self._row(
                    at,
                    SetCameraPosition,
                    XYZ,
                    "Position of the eye, in metres. The up and down keys change a number by a centimetre.",
                ),
                self._row(
                    to,
                    SetCameraTarget,
                    XYZ,
                    "A point on the line of sight, in metres. A new point rotates the camera in place.",
                ),
            )
            for separately, at, to in ((False, "Position", "Looks at"), (True, "Eye", "Target"))
        }
        """Fields by whether eye and target are placed separately."""
        self._about = self._server.gui.add_html("")

    def _build_orientation(self) -> None:
        self._form = choice(
            self._server,
            "Written as",
            ChooseRotationForm,
            "form",
            ROTATIONS,
            RPY,
            hint="How the camera's rotation is shown below.",
        )
        self._rpy = self._row(
            "Degrees",
            SetCameraAngle,
            ANGLES,
            "R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF and ROS. Yaw turns the camera to the left, a "
            "positive pitch looks down, roll turns it clockwise.",
            step=1.0,
        )
        self._wxyz = Field(
            self._server,
            "w x y z",
            SetCameraQuaternion,
            "wxyz",
            hint="As in sapien.Pose(q=...), w first. The quaternion is normalised.",
            longest=200,
        )
        self._forward = self._row(
            "Forward", SetCameraForward, XYZ, "The line of sight: ManiSkill's x axis of a camera.", step=0.1
        )
        self._up = self._row(
            "Up", SetCameraUp, XYZ, "The top of the picture: ManiSkill's z axis of a camera.", step=0.1
        )
        self._left = self._server.gui.add_html("")

    def _build_lens(self) -> None:
        vertical = "The vertical field of view, in degrees."
        self._lens = choice(self._server, "Lens as", ChooseLensForm, "form", LENSES, FOV)
        self._degrees = Field(self._server, "Vertical fov", SetFieldOfView, "degrees", hint=vertical)
        self._radians = Field(
            self._server, "Radians", SetFieldOfViewInRadians, "radians", hint=vertical, step=0.01
        )
        self._focal = self._row("fx, fy", SetFocalLength, ("fx", "fy"), "Pixels.", step=1.0)
        self._centre = self._row(
            "cx, cy",
            SetOpticalCentre,
            ("cx", "cy"),
            "Pixels from the picture's upper left corner to the optical axis.",
            step=1.0,
        )

    def _build_picture(self) -> None:
        self._size = self._row(
            "Width, height", SetPictureSize, ("width", "height"), "Pixels of the picture.", step=1.0
        )
        self._range = self._row(
            "Near, far", SetNearOrFar, ("near", "far"), "Metres. Nearer and farther things are not drawn."
        )
        self._shader = choice(
            self._server,
            "Shader",
            ChooseShader,
            "shader",
            SHADERS,
            "minimal",
            hint="minimal is what ManiSkill trains with; the rt shaders trace rays, slowly.",
        )

    def draw(self, camera: StudioCamera | None) -> None:
        """Show this camera's numbers; None hides the fields."""
        for folder in self._folders:
            folder.visible = camera is not None
        if camera is None or camera.now is None:
            return
        now, alone, form = camera.now, self._look_at(), self._rotation
        forward, left, up = axes_of(now.quaternion)
        by_matrix = now.intrinsic is not None
        for separately, (position, target) in self._points.items():
            position.visible = target.visible = separately == alone
            position.show(rounded(now.position, UNIT))
            target.show(rounded(target_of(now), UNIT))
        self._about.content = render("aside", text=STAYS if alone else GOES_ALONG)
        self._form.show(form)
        self._rpy.visible = form == RPY
        angles = rounded(_angles(now), DEGREES)
        self._rpy.show(angles)
        name_fold(self._rotation_fold, ROTATION, ", ".join(f"{angle:.0f}\N{DEGREE SIGN}" for angle in angles))
        self._wxyz.visible = form == WXYZ
        self._wxyz.show(" ".join(f"{n:.{QUATERNION}f}" for n in rounded(now.quaternion, QUATERNION)))
        self._forward.visible = self._up.visible = self._left.visible = form == AXES
        self._forward.show(rounded(forward, UNIT))
        self._up.show(rounded(up, UNIT))
        if form == AXES:
            text = ", ".join(f"{n:.{UNIT}f}" for n in rounded(left, UNIT))
            self._left.content = render("note", text=f"Left: {text}")
        self._lens.show(INTRINSIC if by_matrix else FOV)
        self._degrees.visible = self._radians.visible = not by_matrix
        self._degrees.show(round(math.degrees(_fov(now)), DEGREES))
        self._radians.show(round(_fov(now), UNIT))
        self._focal.visible = self._centre.visible = by_matrix
        k = intrinsic_of(now)
        self._focal.show(rounded((k[0, 0], k[1, 1]), PIXELS))
        self._centre.show(rounded((k[0, 2], k[1, 2]), PIXELS))
        self._size.show((now.width, now.height))
        name_fold(
            self._folders[1],
            LENS,
            f"{math.degrees(_fov(now)):.0f}\N{DEGREE SIGN}, {now.width} \N{MULTIPLICATION SIGN} {now.height}",
        )
        self._range.show(rounded((now.near, now.far), UNIT))
        if now.shader_pack not in self._shaders:
            # A task may use its own shader pack.
            self._shaders = (*SHADERS, now.shader_pack)
        self._shader.show(now.shader_pack, options=by_name(self._shaders))

    def do(self, command: Command, visitor: Visitor) -> None:
        if isinstance(command, ChooseRotationForm):
            self._rotation = command.form
        else:
            self._placing.change(type(command), partial(self._changed, command))

    def _changed(self, command: Command, now: CameraSettings, frame: Frame) -> CameraSettings:
        """The camera's settings after this command. Raises ValueError with a message for the user."""
        forward, _, up = axes_of(now.quaternion)
        match command:
            case SetCameraPosition(of=axis, to=metres):
                return self._at(now, _with_part(now.position, XYZ, axis, metres), frame)
            case SetCameraTarget(of=axis, to=metres):
                return frame.turned_to(now, _with_part(target_of(now), XYZ, axis, metres))
            case SetCameraAngle(of=angle, to=degrees):
                return _turned(now, quaternion_from_rpy(*_with_part(_angles(now), ANGLES, angle, degrees)))
            case SetCameraQuaternion(wxyz=text):
                return _turned(now, _read_quaternion(text))
            case SetCameraForward(of=axis, to=to):
                return _turned(now, quaternion_from_axes(_with_part(forward, XYZ, axis, to), up))
            case SetCameraUp(of=axis, to=to):
                return _turned(now, quaternion_from_axes(forward, _with_part(up, XYZ, axis, to)))
            case ChooseLensForm(form=form):
                return _with_lens(now, form)
            case SetFieldOfView(degrees=degrees):
                return _with_fov(now, math.radians(degrees))
            case SetFieldOfViewInRadians(radians=radians):
                return _with_fov(now, radians)
            case SetFocalLength(of=of, to=pixels):
                at = 0 if of == "fx" else 1
                return _with_intrinsic(now, at, at, pixels)
            case SetOpticalCentre(of=of, to=pixels):
                return _with_intrinsic(now, 0 if of == "cx" else 1, 2, pixels)
            case SetPictureSize(of=of, to=pixels):
                return _with_size(now, replace(now, **{of: pixels}))
            case SetNearOrFar(of=of, to=metres):
                planes = replace(now, **{of: metres})
                if planes.near >= planes.far:
                    raise ValueError("Near must be less than far.")
                return planes
            case ChooseShader(shader=shader):
                if shader not in self._shaders:
                    raise ValueError(
                        f"There is no shader pack {shader!r}; choose from: {', '.join(self._shaders)}."
                    )
                return replace(now, shader_pack=shader)
        raise AssertionError(command)

    def _at(self, settings: CameraSettings, position: Sequence[float], frame: Frame) -> CameraSettings:
        moved = replace(settings, position=triple(position))
        if self._look_at() and moved != settings:
            return frame.turned_to(moved, target_of(settings))
        return moved


# --- typed numbers to settings of a camera -----------------------------------------------------------


def _with_part(
    numbers: Sequence[float] | Floats, parts: Sequence[str], of: str, to: float
) -> tuple[float, ...]:
    """These numbers with the part `of` set to `to`; the others are exactly as before."""
    return tuple(to if part == of else float(n) for part, n in zip(parts, numbers, strict=True))


def _fov(settings: CameraSettings) -> float:
    return settings.fov or vertical_fov(intrinsic_of(settings), settings.height)


def _with_fov(settings: CameraSettings, fov: float) -> CameraSettings:
    return settings if settings.fov is None else replace(settings, fov=fov)


def _with_lens(settings: CameraSettings, form: LensForm) -> CameraSettings:
    if form == FOV:
        return replace(settings, fov=_fov(settings), intrinsic=None)
    return replace(settings, fov=None, intrinsic=matrix3(intrinsic_of(settings)))


def _with_intrinsic(settings: CameraSettings, row: int, column: int, pixels: float) -> CameraSettings:
    k = intrinsic_of(settings)
    k[row, column] = pixels
    return settings if settings.intrinsic is None else replace(settings, intrinsic=matrix3(k))


def _with_size(settings: CameraSettings, sized: CameraSettings) -> CameraSettings:
    if settings.intrinsic is None:
        return sized
    # Scale to the pixels of the new size, so that the picture stays the same.
    sizes = (settings.width, settings.height), (sized.width, sized.height)
    return replace(sized, intrinsic=matrix3(scaled_intrinsic(settings.intrinsic, *sizes)))


def _angles(settings: CameraSettings) -> list[float]:
    # 180 and -180 degrees are the same angle; without this, the field would flicker between the two.
    return [180.0 if round(a, DEGREES) == -180 else a for a in rpy_of(settings.quaternion)]


def _read_quaternion(text: str) -> Floats:
    words = re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", text)
    if len(words) != 4 or re.search(r"[^\d\s,;()\[\].eE+-]", text):
        raise ValueError("A quaternion is four numbers, w first; the identity is 1 0 0 0.")
    return normalised([float(word) for word in words])


def _turned(settings: CameraSettings, quaternion: Floats) -> CameraSettings:
    pose = pose_of(settings)
    pose[3:] = quaternion
    return with_pose(settings, pose)
