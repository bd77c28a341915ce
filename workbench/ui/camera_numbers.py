"""The chosen camera in numbers: where it stands, where it looks, its lens. Each can be typed.

A pose has several ways to be said, and an author knows theirs: the target is what they mean, roll, pitch and yaw is
what their robot's drawing has, the quaternion what they copied from somewhere. All are shown of the same camera and
each writes it; one of the three for the orientation at a time, since eleven fields are not read by anybody.

Numbers are those of the camera's config: of a mounted camera in the frame of its link.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import viser

from workbench.core.camera_frames import (
    axes_of,
    intrinsic_from_fov,
    intrinsic_of,
    matrix3,
    normalised,
    pose_of,
    quaternion_from_axes,
    quaternion_from_rpy,
    rpy_of,
    scaled_intrinsic,
    vertical_fov,
    with_pose,
)
from workbench.core.camera_settings import CameraSettings
from workbench.session.studio_view import StudioCamera
from workbench.ui.camera_moves import Floats, kept_where_equal, looking_at, rounded
from workbench.ui.changed import fill, show
from workbench.ui.checked import checked_choice, checked_int, checked_number, checked_text
from workbench.ui.controls import Control
from workbench.ui.fragments import render
from workbench.ui.placing import FARTHEST, Placing

RPY, WXYZ, AXES = "roll, pitch, yaw", "quaternion wxyz", "forward and up"
ORIENTATIONS = (RPY, WXYZ, AXES)
FOV, INTRINSIC = "field of view", "intrinsic matrix"
LENSES = (FOV, INTRINSIC)
SHADERS: tuple[str, ...] = ("minimal", "default", "rt-fast", "rt-med", "rt")
"""Those that ManiSkill 3 brings."""
METRES, UNIT, DEGREES, RADIANS, PIXELS, QUATERNION = 4, 4, 2, 4, 2, 6
"""Digits that are shown."""
SMALLEST, LARGEST = 8, 4096
"""Pixels of a picture's side."""
TYPED = 0.3
"""Seconds without a key after which what was typed is taken."""

Change = Callable[[StudioCamera, CameraSettings], CameraSettings]


class CameraNumbers:
    def __init__(self, server: viser.ViserServer, placing: Placing) -> None:
        self._placing = placing
        self._gui = gui = server.gui
        self._place_folder = gui.add_folder("Where it is")
        with self._place_folder:
            # Hides the little arrows in what follows: three numbers with four digits do not fit beside them.
            gui.add_html(render("tight"))
            self._position = self._vector(
                "Position",
                METRES,
                0.01,
                "Of the eye, in metres. The arrow keys up and down change the number by a centimetre.",
                self._set_position,
            )
            self._target = self._vector(
                "Looks at",
                METRES,
                0.01,
                "A point on the line of sight, in metres: the camera stays where it is and turns towards it.",
                self._set_target,
            )
            self._orientation = gui.add_dropdown(
                "Turned", ORIENTATIONS, initial_value=RPY, hint="How its orientation is said below."
            )
            self._rpy = self._vector(
                "Degrees",
                DEGREES,
                1.0,
                "R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF and ROS. Yaw turns it to the left, a positive pitch "
                "looks down, roll turns it clockwise.",
                self._set_rpy,
            )
            self._wxyz: Control[Any, Any] = Control(
                gui.add_text(
                    "w x y z", "", hint="As sapien.Pose(q=...) has it: w first. It is brought to length 1."
                ),
                read=_read_quaternion,
                send=lambda q: self._change("quaternion", lambda _, s: _turned(s, q)),
                settle=0.8,
            )
            self._forward = self._vector(
                "Forward", UNIT, 0.1, "The line of sight: ManiSkill's x axis of a camera.", self._set_forward
            )
            self._up = self._vector(
                "Up", UNIT, 0.1, "The top of the picture: ManiSkill's z axis of a camera.", self._set_up
            )
            self._left = gui.add_html("")
        self._lens_folder = gui.add_folder("Lens and picture", expand_by_default=False)
        with self._lens_folder:
            gui.add_html(render("tight"))
            self._lens = Control(
                gui.add_dropdown("Lens as", LENSES, initial_value=FOV),
                read=lambda value: checked_choice(value, LENSES, "way to say a lens"),
                send=self._set_lens,
            )
            self._degrees = self._number(
                "Degrees high", DEGREES, 1.0, 1.0, 175.0, lambda fov: self._set_fov(math.radians(fov))
            )
            self._radians = self._number("Radians", RADIANS, 0.01, 0.02, 3.05, self._set_fov)
            self._focal = self._pair("fx, fy", PIXELS, 1.0, 1.0, 1e5, self._set_focal, "Pixels.")
            self._centre = self._pair(
                "cx, cy",
                PIXELS,
                1.0,
                -1e5,
                1e5,
                self._set_centre,
                "Pixels from the picture's upper left corner to the optical axis.",
            )
            self._size = self._pair(
                "Width, height", 0, 1.0, SMALLEST, LARGEST, self._set_size, "Pixels of the picture."
            )
            self._range = self._pair(
                "Near, far",
                METRES,
                0.01,
                1e-4,
                1e4,
                self._set_range,
                "Metres. What is nearer or farther is not drawn.",
            )
            self._shader = Control(
                gui.add_dropdown(
                    "Shader",
                    SHADERS,
                    initial_value="minimal",
                    hint="minimal is what ManiSkill trains with; the rt ones trace rays, slowly.",
                ),
                read=lambda value: checked_choice(value, self._shader.handle.options, "shader"),
                send=lambda name: self._change("shader", lambda _, s: replace(s, shader_pack=name)),
            )

    def draw(self, camera: StudioCamera | None) -> None:
        """Show this camera; None hides all."""
        for folder in (self._place_folder, self._lens_folder):
            show(folder, camera is not None)
        if camera is None or camera.now is None:
            return
        now = camera.now
        self._position.show(now.position)
        self._target.show(self._target_of(camera, now))
        self._draw_orientation(now)
        self._draw_lens(now)

    def _draw_orientation(self, now: CameraSettings) -> None:
        said = self._orientation.value
        for control, name in (
            (self._rpy, RPY),
            (self._wxyz, WXYZ),
            (self._forward, AXES),
            (self._up, AXES),
        ):
            show(control.handle, said == name)
        show(self._left, said == AXES)
        if said == RPY:
            # Half a turn is the same both ways round; it would flicker between the two.
            self._rpy.show([180.0 if round(a, DEGREES) == -180 else a for a in rpy_of(now.quaternion)])
        elif said == WXYZ:
            self._wxyz.show(" ".join(f"{n:.{QUATERNION}f}" for n in rounded(now.quaternion, QUATERNION)))
        else:
            forward, left, up = axes_of(now.quaternion)
            self._forward.show(forward)
            self._up.show(up)
            text = render("note", text=f"Left: {', '.join(f'{n:.{UNIT}f}' for n in rounded(left, UNIT))}")
            fill(self._left, text)

    def _draw_lens(self, now: CameraSettings) -> None:
        by_matrix = now.intrinsic is not None
        self._lens.show(INTRINSIC if by_matrix else FOV)
        for control, shown in (
            (self._degrees, not by_matrix),
            (self._radians, not by_matrix),
            (self._focal, by_matrix),
            (self._centre, by_matrix),
        ):
            show(control.handle, shown)
        k = intrinsic_of(now)
        if by_matrix:
            self._focal.show((k[0, 0], k[1, 1]))
            self._centre.show((k[0, 2], k[1, 2]))
        else:
            fov = vertical_fov(k, now.height)
            self._degrees.show(math.degrees(fov))
            self._radians.show(fov)
        self._size.show((now.width, now.height))
        self._range.show((now.near, now.far))
        if now.shader_pack not in self._shader.handle.options:
            # A task may bring a shader pack of its own.
            self._shader.handle.options = (*SHADERS, now.shader_pack)
        self._shader.show(now.shader_pack)

    # --- what is typed -----------------------------------------------------------------------------------

    def _change(self, hand: str, change: Change) -> None:
        camera, now, _ = self._placing.require()
        changed = change(camera, now)
        if changed != now:
            self._placing.place(camera.key, changed, hand)

    def _set_position(self, typed: tuple[float, ...]) -> None:
        def change(_: StudioCamera, s: CameraSettings) -> CameraSettings:
            x, y, z = kept_where_equal(s.position, typed, METRES)
            return replace(s, position=(x, y, z))

        self._change("position", change)

    def _target_of(self, camera: StudioCamera, now: CameraSettings) -> Floats:
        """(3,) in the frame that the numbers are said in."""
        return self._placing.frame(camera).point_from_view(self._placing.target_in_view(camera, now))

    def _set_target(self, typed: tuple[float, ...]) -> None:
        camera, now, frame = self._placing.require()
        target = frame.point_to_view(kept_where_equal(self._target_of(camera, now), typed, METRES))
        pose = frame.to_view(now)
        turned = frame.from_view(now, looking_at(pose, pose[:3], target))
        self._placing.set_distance(camera.key, turned, float(np.linalg.norm(target - pose[:3])))
        self._placing.place(camera.key, turned, "target")

    def _set_rpy(self, typed: tuple[float, ...]) -> None:
        self._change(
            "angles",
            lambda _, s: _turned(
                s, quaternion_from_rpy(*kept_where_equal(rpy_of(s.quaternion), typed, DEGREES))
            ),
        )

    def _set_forward(self, typed: tuple[float, ...]) -> None:
        def change(_: StudioCamera, s: CameraSettings) -> CameraSettings:
            forward, _left, up = axes_of(s.quaternion)
            return _turned(s, quaternion_from_axes(kept_where_equal(forward, typed, UNIT), up))

        self._change("forward", change)

    def _set_up(self, typed: tuple[float, ...]) -> None:
        def change(_: StudioCamera, s: CameraSettings) -> CameraSettings:
            forward, _left, up = axes_of(s.quaternion)
            return _turned(s, quaternion_from_axes(forward, kept_where_equal(up, typed, UNIT)))

        self._change("up", change)

    def _set_lens(self, said: str) -> None:
        def change(_: StudioCamera, s: CameraSettings) -> CameraSettings:
            if said == INTRINSIC and s.intrinsic is None:
                return replace(s, fov=None, intrinsic=matrix3(intrinsic_of(s)))
            if said == FOV and s.fov is None:
                return replace(s, fov=vertical_fov(intrinsic_of(s), s.height), intrinsic=None)
            return s

        self._change("lens", change)

    def _set_fov(self, fov: float) -> None:
        def change(_: StudioCamera, s: CameraSettings) -> CameraSettings:
            intrinsic_from_fov(fov, s.width, s.height)  # refuses what is no fov
            return s if s.fov is None else replace(s, fov=fov)

        self._change("fov", change)

    def _set_focal(self, typed: tuple[float, ...]) -> None:
        self._set_intrinsic(typed, ((0, 0), (1, 1)))

    def _set_centre(self, typed: tuple[float, ...]) -> None:
        self._set_intrinsic(typed, ((0, 2), (1, 2)))

    def _set_intrinsic(self, typed: tuple[float, ...], places: tuple[tuple[int, int], ...]) -> None:
        def change(_: StudioCamera, s: CameraSettings) -> CameraSettings:
            k = intrinsic_of(s)
            kept = kept_where_equal([k[place] for place in places], typed, PIXELS)
            for place, number in zip(places, kept, strict=True):
                k[place] = number
            return s if s.intrinsic is None else replace(s, intrinsic=matrix3(k))

        self._change("intrinsic", change)

    def _set_size(self, typed: tuple[float, ...]) -> None:
        width, height = (checked_int(n, SMALLEST, LARGEST, "number of pixels") for n in typed)

        def change(_: StudioCamera, s: CameraSettings) -> CameraSettings:
            sized = replace(s, width=width, height=height)
            if s.intrinsic is None:
                return sized
            # In pixels of the other size, so that it shows the same.
            k = scaled_intrinsic(s.intrinsic, (s.width, s.height), (width, height))
            return replace(sized, intrinsic=matrix3(k))

        self._change("size", change)

    def _set_range(self, typed: tuple[float, ...]) -> None:
        def change(_: StudioCamera, s: CameraSettings) -> CameraSettings:
            near, far = kept_where_equal((s.near, s.far), typed, METRES)
            if near >= far:
                raise ValueError("What is near must be nearer than what is far.")
            return replace(s, near=near, far=far)

        self._change("range", change)

    # --- fields ------------------------------------------------------------------------------------------

    def _vector(
        self, label: str, digits: int, step: float, hint: str, send: Callable[[tuple[float, ...]], None]
    ) -> Control[Any, Any]:
        handle = self._gui.add_vector3(label, (0.0, 0.0, 0.0), step=step, hint=hint)
        return self._field(handle, label, digits, 3, -FARTHEST, FARTHEST, send)

    def _pair(
        self,
        label: str,
        digits: int,
        step: float,
        low: float,
        high: float,
        send: Callable[[tuple[float, ...]], None],
        hint: str,
    ) -> Control[Any, Any]:
        handle = self._gui.add_vector2(label, (0.0, 0.0), step=step, hint=hint)
        return self._field(handle, label, digits, 2, low, high, send)

    def _field(
        self,
        handle: Any,
        label: str,
        digits: int,
        length: int,
        low: float,
        high: float,
        send: Callable[[tuple[float, ...]], None],
    ) -> Control[Any, Any]:
        # Digits that are shown and can be typed; viser takes them from the step.
        handle.precision = digits
        return Control(
            handle,
            read=lambda value: tuple(
                checked_number(n, low, high, label) for n in _of_length(value, length, label)
            ),
            send=send,
            shown=lambda numbers: rounded(numbers, digits),
            settle=TYPED,
        )

    def _number(
        self, label: str, digits: int, step: float, low: float, high: float, send: Callable[[float], None]
    ) -> Control[Any, Any]:
        handle = self._gui.add_number(label, low, step=step, hint="The vertical field of view.")
        handle.precision = digits
        return Control(
            handle,
            read=lambda value: checked_number(value, low, high, "field of view"),
            send=send,
            shown=lambda number: rounded([number], digits)[0],
            settle=TYPED,
        )


def _of_length(value: object, length: int, name: str) -> tuple[object, ...]:
    if not isinstance(value, (tuple, list)) or len(value) != length:
        raise ValueError(f"{name} has {length} numbers.")
    return tuple(value)


def _read_quaternion(value: object) -> Floats:
    text = checked_text(value, 200, "quaternion")
    words = re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", text)
    if len(words) != 4 or re.search(r"[^\d\s,;()\[\].eE+-]", text):
        raise ValueError("A quaternion is four numbers, w first: 1 0 0 0 turns nothing.")
    return normalised([float(word) for word in words])


def _turned(settings: CameraSettings, quaternion: Floats) -> CameraSettings:
    pose = pose_of(settings)
    pose[3:] = quaternion
    return with_pose(settings, pose)
