"""Number fields for the chosen camera's pose, lens and picture."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import viser

from workbench.core.camera_data import CameraSettings
from workbench.core.cameras.conventions import (
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
from workbench.session.cameras.view import StudioCamera
from workbench.ui.cameras.pose_math import FARTHEST, Floats, Frame, Placing, kept_where_equal, rounded
from workbench.ui.server.control_values import limit_text
from workbench.ui.widgets.inputs import Control
from workbench.ui.widgets.templates import render

TYPED = 0.3
"""Seconds without another number until the last is taken: a person may hold down the arrows next to a field."""
RPY, WXYZ, AXES = "roll, pitch, yaw", "quaternion wxyz", "forward and up"
UNIT, DEGREES, QUATERNION, PIXELS = 4, 2, 6, 2
"""Digits of the shown numbers."""
FOV, INTRINSIC = "field of view", "intrinsic matrix"
GOES_ALONG = "The target moves with the position. To keep it fixed, set Handles to eye and target."
STAYS = "Each moves alone: the camera keeps looking at its target."
SHADERS: tuple[str, ...] = ("minimal", "default", "rt-fast", "rt-med", "rt")
"""The shader packs of ManiSkill 3."""
SMALLEST, LARGEST = 8, 4096
"""Pixels of a picture's side."""

Numbers = tuple[float, ...]


class CameraNumbers:
    """Two folders in the present container: pose, and lens and picture.

    All forms of the pose show the same camera and each writes it; of the three forms of the orientation one is shown at
    a time. With one gizmo on the camera a typed eye takes the target along; with an eye and a target each is typed
    alone. A mounted camera's numbers are in the frame of its link. The lens is a field of view or an intrinsic matrix,
    which exclude each other in ManiSkill's config; the picture stays the same when the form is changed.

    Args:
        look_at: whether eye and target are placed separately, instead of a pose.
    """

    def __init__(self, server: viser.ViserServer, placing: Placing, look_at: Callable[[], bool]) -> None:
        self._placing, self._look_at, self._gui = placing, look_at, server.gui
        with self._gui.add_folder("Pose") as where:
            # Hides the arrows of the fields below: three numbers with four digits do not fit next to them.
            self._gui.add_html(render("tight"))
            self._build_points()
            self._build_orientation()
        with self._gui.add_folder("Lens and image", expand_by_default=False) as lens:
            self._gui.add_html(render("tight"))
            self._build_lens()
            self._build_picture()
        self._folders = where, lens

    def _field(
        self,
        label: str,
        read: Callable[[CameraSettings], Sequence[float] | Floats],
        write: Callable[[CameraSettings, Numbers, Frame], CameraSettings],
        count: int = 3,
        *,
        digits: int = 4,
        step: float = 0.01,
        low: float = -FARTHEST,
        high: float = FARTHEST,
        hint: str,
    ) -> Control[Any, Any]:
        """A field of one to three numbers.

        Args:
            read: the numbers of a camera.
            write: the camera with other numbers; raises ValueError with a sentence.
        """

        def each(number: float) -> Any:
            return number if count == 1 else (number,) * count

        def send(typed: Any) -> None:
            numbers = (typed,) if count == 1 else typed

            def change(now: CameraSettings, frame: Frame) -> CameraSettings:
                # A field of whole numbers rounds nothing.
                return write(now, kept_where_equal(read(now), numbers, digits or 9), frame)

            self._placing.change(label, change)

        def shown(now: CameraSettings) -> Any:
            numbers = rounded(read(now), digits)
            return numbers[0] if count == 1 else numbers

        add: Any = (self._gui.add_number, self._gui.add_vector2, self._gui.add_vector3)[count - 1]
        handle = add(label, each(max(low, 0.0)), min=each(low), max=each(high), step=step, hint=hint)
        # Digits that are shown and can be typed; viser would take them from the step.
        handle.precision = digits
        return Control(handle, send, shown=shown, settle=TYPED)

    def _build_points(self) -> None:
        self._position = self._field(
            "Position",
            lambda s: s.position,
            self._at,
            hint="Position of the eye, in metres. The up and down keys change a number by a centimetre.",
        )
        self._target = self._field(
            "Looks at",
            target_of,
            lambda s, target, frame: frame.turned_to(s, target),
            hint="A point on the line of sight, in metres: the camera stays where it is and turns towards it.",
        )
        self._about = self._gui.add_html("")

    def _build_orientation(self) -> None:
        self._orientation = self._gui.add_dropdown(
            "Rotation", (RPY, WXYZ, AXES), initial_value=RPY, hint="How its rotation is written below."
        )
        self._rpy = self._field(
            "Degrees",
            _angles,
            lambda s, angles, _: _turned(s, quaternion_from_rpy(*angles)),
            digits=DEGREES,
            step=1.0,
            hint="R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF and ROS. Yaw turns it to the left, a positive pitch "
            "looks down, roll turns it clockwise.",
        )
        self._wxyz: Control[Any, Any] = Control(
            self._gui.add_text("w x y z", "", hint="As in sapien.Pose(q=...), w first. It is normalised."),
            read=_read_quaternion,
            send=lambda q: self._placing.change("quaternion", lambda s, _: _turned(s, q)),
            shown=lambda s: " ".join(f"{n:.{QUATERNION}f}" for n in rounded(s.quaternion, QUATERNION)),
            settle=0.8,
        )
        limit_text(self._wxyz.handle, 200)
        self._forward = self._field(
            "Forward",
            lambda s: axes_of(s.quaternion)[0],
            lambda s, forward, _: _turned(s, quaternion_from_axes(forward, axes_of(s.quaternion)[2])),
            step=0.1,
            hint="The line of sight: ManiSkill's x axis of a camera.",
        )
        self._up = self._field(
            "Up",
            lambda s: axes_of(s.quaternion)[2],
            lambda s, up, _: _turned(s, quaternion_from_axes(axes_of(s.quaternion)[0], up)),
            step=0.1,
            hint="The top of the picture: ManiSkill's z axis of a camera.",
        )
        self._left = self._gui.add_html("")

    def _build_lens(self) -> None:
        self._lens: Control[Any, Any] = Control(
            self._gui.add_dropdown("Lens as", (FOV, INTRINSIC), initial_value=FOV),
            send=lambda said: self._placing.change("lens", lambda s, _: _with_lens(s, said)),
            shown=lambda s: FOV if s.intrinsic is None else INTRINSIC,
        )
        vertical = "The vertical field of view, in degrees."
        self._degrees = self._field(
            "Vertical fov",
            lambda s: [math.degrees(_fov(s))],
            lambda s, typed, _: _with_fov(s, math.radians(typed[0])),
            1,
            digits=DEGREES,
            step=1.0,
            low=1.0,
            high=175.0,
            hint=vertical,
        )
        self._radians = self._field(
            "Radians",
            lambda s: [_fov(s)],
            lambda s, typed, _: _with_fov(s, typed[0]),
            1,
            low=0.02,
            high=3.05,
            hint=vertical,
        )
        self._focal, self._centre = (
            self._field(
                label,
                lambda s, column=column: intrinsic_of(s)[[0, 1], column],
                partial(_with_intrinsic, column),
                2,
                digits=PIXELS,
                step=1.0,
                low=low,
                high=1e5,
                hint=hint,
            )
            for label, column, low, hint in (
                ("fx, fy", [0, 1], 1.0, "Pixels."),
                ("cx, cy", [2, 2], -1e5, "Pixels from the picture's upper left corner to the optical axis."),
            )
        )

    def _build_picture(self) -> None:
        self._size = self._field(
            "Width, height",
            lambda s: (s.width, s.height),
            _with_size,
            2,
            digits=0,
            step=1.0,
            low=SMALLEST,
            high=LARGEST,
            hint="Pixels of the picture.",
        )
        self._range = self._field(
            "Near, far",
            lambda s: (s.near, s.far),
            _with_range,
            2,
            low=1e-4,
            high=1e4,
            hint="Metres. What is nearer or farther is not drawn.",
        )
        self._shader: Control[Any, Any] = Control(
            self._gui.add_dropdown(
                "Shader",
                SHADERS,
                initial_value="minimal",
                hint="minimal is what ManiSkill trains with; the rt shaders trace rays, slowly.",
            ),
            send=lambda name: self._placing.change("shader", lambda s, _: replace(s, shader_pack=name)),
            shown=lambda s: s.shader_pack,
        )

    def draw(self, camera: StudioCamera | None) -> None:
        """Show this camera's numbers; None hides the fields."""
        for folder in self._folders:
            folder.visible = camera is not None
        if camera is None or camera.now is None:
            return
        now, alone, said = camera.now, self._look_at(), self._orientation.value
        by_matrix = now.intrinsic is not None
        self._position.handle.label = "Eye" if alone else "Position"
        self._target.handle.label = "Target" if alone else "Looks at"
        self._about.content = render("aside", text=STAYS if alone else GOES_ALONG)
        self._left.visible = said == AXES
        if said == AXES:
            left = ", ".join(f"{n:.{UNIT}f}" for n in rounded(axes_of(now.quaternion)[1], UNIT))
            self._left.content = render("note", text=f"Left: {left}")
        if now.shader_pack not in self._shader.handle.options:
            # A task may have a shader pack of its own.
            self._shader.handle.options = (*SHADERS, now.shader_pack)
        for control, shown in (
            *((each, True) for each in (self._position, self._target)),
            (self._rpy, said == RPY),
            (self._wxyz, said == WXYZ),
            *((each, said == AXES) for each in (self._forward, self._up)),
            *((each, not by_matrix) for each in (self._degrees, self._radians)),
            *((each, by_matrix) for each in (self._focal, self._centre)),
            *((each, True) for each in (self._lens, self._size, self._range, self._shader)),
        ):
            control.handle.visible = shown
            if shown:
                control.show(now)

    def _at(self, settings: CameraSettings, position: Numbers, frame: Frame) -> CameraSettings:
        moved = replace(settings, position=triple(position))
        if self._look_at() and moved != settings:
            return frame.turned_to(moved, target_of(settings))
        return moved


# --- typed numbers to settings of a camera -----------------------------------------------------------


def _fov(settings: CameraSettings) -> float:
    return settings.fov or vertical_fov(intrinsic_of(settings), settings.height)


def _with_fov(settings: CameraSettings, fov: float) -> CameraSettings:
    return settings if settings.fov is None else replace(settings, fov=fov)


def _with_lens(settings: CameraSettings, said: str) -> CameraSettings:
    if said == FOV:
        return replace(settings, fov=_fov(settings), intrinsic=None)
    return replace(settings, fov=None, intrinsic=matrix3(intrinsic_of(settings)))


def _with_intrinsic(
    columns: list[int], settings: CameraSettings, typed: Numbers, frame: Frame
) -> CameraSettings:
    k = intrinsic_of(settings)
    k[[0, 1], columns] = typed
    return settings if settings.intrinsic is None else replace(settings, intrinsic=matrix3(k))


def _with_size(settings: CameraSettings, typed: Numbers, frame: Frame) -> CameraSettings:
    if any(n % 1 for n in typed):
        raise ValueError("A number of pixels is a whole number.")
    width, height = map(int, typed)
    sized = replace(settings, width=width, height=height)
    if settings.intrinsic is None:
        return sized
    # In pixels of the new size, so that the picture stays the same.
    k = scaled_intrinsic(settings.intrinsic, (settings.width, settings.height), (width, height))
    return replace(sized, intrinsic=matrix3(k))


def _with_range(settings: CameraSettings, typed: Numbers, frame: Frame) -> CameraSettings:
    if typed[0] >= typed[1]:
        raise ValueError("Near must be less than far.")
    return replace(settings, near=typed[0], far=typed[1])


def _angles(settings: CameraSettings) -> list[float]:
    # 180 and -180 degrees are the same; the field would flicker between the two.
    return [180.0 if round(a, DEGREES) == -180 else a for a in rpy_of(settings.quaternion)]


def _read_quaternion(text: str) -> Floats:
    words = re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", text)
    if len(words) != 4 or re.search(r"[^\d\s,;()\[\].eE+-]", text):
        raise ValueError("A quaternion is four numbers, w first: 1 0 0 0 is no rotation.")
    return normalised([float(word) for word in words])


def _turned(settings: CameraSettings, quaternion: Floats) -> CameraSettings:
    pose = pose_of(settings)
    pose[3:] = quaternion
    return with_pose(settings, pose)
