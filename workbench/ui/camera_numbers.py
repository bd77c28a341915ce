"""Where the chosen camera stands and looks, and its lens and picture, in numbers that can be typed, and the fields that
hold them.

All ways to say a pose are shown of the same camera and each writes it; of the three for the orientation one at a time,
since nobody reads eleven fields. What a typed eye means follows the handles in the view: with one handle on the camera
the target goes with it, with an eye and a target each is typed alone. Of a mounted camera all is in the frame of its
link. The lens is set once and then left, so its folder is closed. It can be said in two ways that exclude each other in
ManiSkill's config; the choice between them is a change of the config, after which the camera sees the same.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import viser
from numpy.typing import ArrayLike

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
from workbench.ui.camera_moves import FARTHEST, Floats, Placing, kept_where_equal, rounded
from workbench.ui.control_values import limit_text
from workbench.ui.controls import Control
from workbench.ui.fragments import render

TYPED = 0.3
"""Seconds without another number after which the last is taken: the arrows beside a field are held down."""


def numbers_field(
    gui: viser.GuiApi,
    label: str,
    send: Callable[[Any], None],
    count: int = 3,
    *,
    digits: int = 4,
    step: float = 0.01,
    low: float = -FARTHEST,
    high: float = FARTHEST,
    hint: str,
) -> Control[Any, Any]:
    """A field of one to three numbers; what is sent, and shown, is a number or a tuple of them."""

    def each(number: float) -> Any:
        return number if count == 1 else (number,) * count

    add: Any = (gui.add_number, gui.add_vector2, gui.add_vector3)[count - 1]
    handle = add(label, each(max(low, 0.0)), min=each(low), max=each(high), step=step, hint=hint)
    # Digits that are shown and can be typed; viser takes them from the step.
    handle.precision = digits
    return Control(
        handle,
        send,
        shown=lambda shown: rounded([shown], digits)[0] if count == 1 else rounded(shown, digits),
        settle=TYPED,
    )


RPY, WXYZ, AXES = "roll, pitch, yaw", "quaternion wxyz", "forward and up"
ORIENTATIONS = (RPY, WXYZ, AXES)
METRES, UNIT, DEGREES, QUATERNION, PIXELS = 4, 4, 2, 6, 2
"""Digits that are shown."""
GOES_ALONG = "What it looks at goes along with the position. To keep it: Place, eye and target."
STAYS = "Each moves alone: the camera goes on looking at its target."


class CameraNumbers:
    """The folder in the present container.

    Args:
        look_at: whether eye and target are placed, each alone, and not a pose.
    """

    def __init__(self, server: viser.ViserServer, placing: Placing, look_at: Callable[[], bool]) -> None:
        self._placing, self._look_at = placing, look_at
        gui = server.gui
        with gui.add_folder("Where it is") as self._folder:
            # Hides the little arrows in what follows: three numbers with four digits do not fit beside them.
            gui.add_html(render("tight"))
            self._build_points(gui)
            self._build_orientation(gui)

    def _build_points(self, gui: viser.GuiApi) -> None:
        self._position = numbers_field(
            gui,
            "Position",
            self._set_position,
            hint="Of the eye, in metres. The arrow keys up and down change the number by a centimetre.",
        )
        self._target = numbers_field(
            gui,
            "Looks at",
            self._set_target,
            hint="A point on the line of sight, in metres: the camera stays where it is and turns towards it.",
        )
        self._about = gui.add_html("")

    def _build_orientation(self, gui: viser.GuiApi) -> None:
        self._orientation = gui.add_dropdown(
            "Turned", ORIENTATIONS, initial_value=RPY, hint="How its orientation is said below."
        )
        self._rpy = numbers_field(
            gui,
            "Degrees",
            self._set_rpy,
            digits=DEGREES,
            step=1.0,
            hint="R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF and ROS. Yaw turns it to the left, a positive pitch "
            "looks down, roll turns it clockwise.",
        )
        self._wxyz: Control[Any, Any] = Control(
            gui.add_text(
                "w x y z", "", hint="As sapien.Pose(q=...) has it: w first. It is brought to length 1."
            ),
            read=_read_quaternion,
            send=lambda q: self._placing.change("quaternion", lambda s: _turned(s, q)),
            settle=0.8,
        )
        limit_text(self._wxyz.handle, 200)
        about = "The line of sight: ManiSkill's x axis of a camera."
        self._forward = numbers_field(gui, "Forward", partial(self._set_axis, 0), step=0.1, hint=about)
        about = "The top of the picture: ManiSkill's z axis of a camera."
        self._up = numbers_field(gui, "Up", partial(self._set_axis, 1), step=0.1, hint=about)
        self._left = gui.add_html("")

    def draw(self, camera: StudioCamera | None) -> None:
        """Show this camera's; None hides all."""
        self._folder.visible = camera is not None
        if camera is None or camera.now is None:
            return
        now, alone = camera.now, self._look_at()
        for control, label in (
            (self._position, "Eye" if alone else "Position"),
            (self._target, "Target" if alone else "Looks at"),
        ):
            control.handle.label = label
        self._about.content = render("aside", text=STAYS if alone else GOES_ALONG)
        self._position.show(now.position)
        self._target.show(self._placing.target(camera, now))
        self._draw_orientation(now)

    def _draw_orientation(self, now: CameraSettings) -> None:
        said = self._orientation.value
        for control, name in (
            (self._rpy, RPY),
            (self._wxyz, WXYZ),
            (self._forward, AXES),
            (self._up, AXES),
        ):
            control.handle.visible = said == name
        self._left.visible = said == AXES
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
            self._left.content = text

    # --- what is typed -----------------------------------------------------------------------------------

    def _set_position(self, typed: tuple[float, ...]) -> None:
        camera, now, _ = self._placing.require()
        x, y, z = kept_where_equal(now.position, typed, METRES)
        moved = replace(now, position=(x, y, z))
        if moved == now:
            return
        if self._look_at():
            self._placing.look(camera, moved, self._placing.target_in_view(camera, now), "eye")
        else:
            self._placing.place(camera.key, moved, "position")

    def _set_target(self, typed: tuple[float, ...]) -> None:
        camera, now, frame = self._placing.require()
        target = kept_where_equal(self._placing.target(camera, now), typed, METRES)
        self._placing.look(camera, now, frame.point_to_view(target), "target")

    def _set_rpy(self, typed: tuple[float, ...]) -> None:
        self._placing.change(
            "angles",
            lambda s: _turned(
                s, quaternion_from_rpy(*kept_where_equal(rpy_of(s.quaternion), typed, DEGREES))
            ),
        )

    def _set_axis(self, place: int, typed: tuple[float, ...]) -> None:
        def change(s: CameraSettings) -> CameraSettings:
            axes: list[ArrayLike] = [*axes_of(s.quaternion)[::2]]
            axes[place] = kept_where_equal(axes_of(s.quaternion)[2 * place], typed, UNIT)
            return _turned(s, quaternion_from_axes(*axes))

        self._placing.change(("forward", "up")[place], change)


FOV, INTRINSIC = "field of view", "intrinsic matrix"
LENSES = (FOV, INTRINSIC)
SHADERS: tuple[str, ...] = ("minimal", "default", "rt-fast", "rt-med", "rt")
"""Those that ManiSkill 3 brings."""
SMALLEST, LARGEST = 8, 4096
"""Pixels of a picture's side."""


class CameraLens:
    """The folder in the present container."""

    def __init__(self, server: viser.ViserServer, placing: Placing) -> None:
        self._placing = placing
        gui = server.gui
        with gui.add_folder("Lens and picture", expand_by_default=False) as self._folder:
            gui.add_html(render("tight"))
            self._build_lens(gui)
            self._build_picture(gui)

    def _build_lens(self, gui: viser.GuiApi) -> None:
        self._lens = Control(gui.add_dropdown("Lens as", LENSES, initial_value=FOV), self._set_lens)
        vertical = "The vertical field of view."
        self._degrees = numbers_field(
            gui,
            "Degrees high",
            lambda fov: self._set_fov(math.radians(fov)),
            1,
            digits=DEGREES,
            step=1.0,
            low=1.0,
            high=175.0,
            hint=vertical,
        )
        self._radians = numbers_field(gui, "Radians", self._set_fov, 1, low=0.02, high=3.05, hint=vertical)
        self._focal = numbers_field(
            gui,
            "fx, fy",
            partial(self._set_intrinsic, ((0, 0), (1, 1))),
            2,
            digits=PIXELS,
            step=1.0,
            low=1.0,
            high=1e5,
            hint="Pixels.",
        )
        self._centre = numbers_field(
            gui,
            "cx, cy",
            partial(self._set_intrinsic, ((0, 2), (1, 2))),
            2,
            digits=PIXELS,
            step=1.0,
            low=-1e5,
            high=1e5,
            hint="Pixels from the picture's upper left corner to the optical axis.",
        )

    def _build_picture(self, gui: viser.GuiApi) -> None:
        self._size = numbers_field(
            gui,
            "Width, height",
            self._set_size,
            2,
            digits=0,
            step=1.0,
            low=SMALLEST,
            high=LARGEST,
            hint="Pixels of the picture.",
        )
        self._range = numbers_field(
            gui,
            "Near, far",
            self._set_range,
            2,
            low=1e-4,
            high=1e4,
            hint="Metres. What is nearer or farther is not drawn.",
        )
        self._shader = Control(
            gui.add_dropdown(
                "Shader",
                SHADERS,
                initial_value="minimal",
                hint="minimal is what ManiSkill trains with; the rt ones trace rays, slowly.",
            ),
            send=lambda name: self._placing.change("shader", lambda s: replace(s, shader_pack=name)),
        )

    def draw(self, camera: StudioCamera | None) -> None:
        """Show this camera's; None hides all."""
        self._folder.visible = camera is not None
        if camera is not None and camera.now is not None:
            self._draw_lens(camera.now)

    def _draw_lens(self, now: CameraSettings) -> None:
        by_matrix = now.intrinsic is not None
        self._lens.show(INTRINSIC if by_matrix else FOV)
        for control, shown in (
            (self._degrees, not by_matrix),
            (self._radians, not by_matrix),
            (self._focal, by_matrix),
            (self._centre, by_matrix),
        ):
            control.handle.visible = shown
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

    def _set_lens(self, said: str) -> None:
        def change(s: CameraSettings) -> CameraSettings:
            if said == INTRINSIC and s.intrinsic is None:
                return replace(s, fov=None, intrinsic=matrix3(intrinsic_of(s)))
            if said == FOV and s.fov is None:
                return replace(s, fov=vertical_fov(intrinsic_of(s), s.height), intrinsic=None)
            return s

        self._placing.change("lens", change)

    def _set_fov(self, fov: float) -> None:
        def change(s: CameraSettings) -> CameraSettings:
            intrinsic_from_fov(fov, s.width, s.height)  # refuses what is no fov
            return s if s.fov is None else replace(s, fov=fov)

        self._placing.change("fov", change)

    def _set_intrinsic(self, places: tuple[tuple[int, int], ...], typed: tuple[float, ...]) -> None:
        def change(s: CameraSettings) -> CameraSettings:
            k = intrinsic_of(s)
            kept = kept_where_equal([k[place] for place in places], typed, PIXELS)
            for place, number in zip(places, kept, strict=True):
                k[place] = number
            return s if s.intrinsic is None else replace(s, intrinsic=matrix3(k))

        self._placing.change("intrinsic", change)

    def _set_size(self, typed: tuple[float, ...]) -> None:
        if any(n % 1 for n in typed):
            raise ValueError("A number of pixels is a whole number.")
        width, height = map(int, typed)

        def change(s: CameraSettings) -> CameraSettings:
            sized = replace(s, width=width, height=height)
            if s.intrinsic is None:
                return sized
            # In pixels of the other size, so that it shows the same.
            k = scaled_intrinsic(s.intrinsic, (s.width, s.height), (width, height))
            return replace(sized, intrinsic=matrix3(k))

        self._placing.change("size", change)

    def _set_range(self, typed: tuple[float, ...]) -> None:
        def change(s: CameraSettings) -> CameraSettings:
            near, far = kept_where_equal((s.near, s.far), typed, METRES)
            if near >= far:
                raise ValueError("What is near must be nearer than what is far.")
            return replace(s, near=near, far=far)

        self._placing.change("range", change)


def _read_quaternion(text: str) -> Floats:
    words = re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", text)
    if len(words) != 4 or re.search(r"[^\d\s,;()\[\].eE+-]", text):
        raise ValueError("A quaternion is four numbers, w first: 1 0 0 0 turns nothing.")
    return normalised([float(word) for word in words])


def _turned(settings: CameraSettings, quaternion: Floats) -> CameraSettings:
    pose = pose_of(settings)
    pose[3:] = quaternion
    return with_pose(settings, pose)
