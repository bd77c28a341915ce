"""Where the chosen camera stands and looks, in numbers that can be typed, and the fields that hold them.

All ways to say a pose are shown of the same camera and each writes it; of the three for the orientation one at a time,
since nobody reads eleven fields. What a typed eye means follows the handles in the view: with one handle on the camera
the target goes with it, with an eye and a target each is typed alone. Of a mounted camera all is in the frame of its
link.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import viser
from numpy.typing import ArrayLike

from workbench.core.camera_frames import (
    axes_of,
    normalised,
    pose_of,
    quaternion_from_axes,
    quaternion_from_rpy,
    rpy_of,
    with_pose,
)
from workbench.core.camera_settings import CameraSettings
from workbench.session.studio_view import StudioCamera
from workbench.ui.camera_moves import Floats, kept_where_equal, rounded
from workbench.ui.control_values import limit_text
from workbench.ui.controls import Control
from workbench.ui.fragments import render
from workbench.ui.placing import FARTHEST, Placing

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
METRES, UNIT, DEGREES, QUATERNION = 4, 4, 2, 6
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


def _read_quaternion(text: str) -> Floats:
    words = re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", text)
    if len(words) != 4 or re.search(r"[^\d\s,;()\[\].eE+-]", text):
        raise ValueError("A quaternion is four numbers, w first: 1 0 0 0 turns nothing.")
    return normalised([float(word) for word in words])


def _turned(settings: CameraSettings, quaternion: Floats) -> CameraSettings:
    pose = pose_of(settings)
    pose[3:] = quaternion
    return with_pose(settings, pose)
