"""The chosen camera's lens and picture in numbers: field of view or intrinsic matrix, size, near and far, shader.

It is set once and then left, so its folder is closed. What a lens is can be said in two ways that exclude each other
in ManiSkill's config; the choice between them is a change of the config, after which the camera sees the same.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import viser

from workbench.core.camera_frames import (
    intrinsic_from_fov,
    intrinsic_of,
    matrix3,
    scaled_intrinsic,
    vertical_fov,
)
from workbench.core.camera_settings import CameraSettings
from workbench.session.studio_view import StudioCamera
from workbench.ui.camera_moves import kept_where_equal
from workbench.ui.camera_numbers import numbers_field
from workbench.ui.controls import Control
from workbench.ui.fragments import render
from workbench.ui.placing import Placing

FOV, INTRINSIC = "field of view", "intrinsic matrix"
LENSES = (FOV, INTRINSIC)
SHADERS: tuple[str, ...] = ("minimal", "default", "rt-fast", "rt-med", "rt")
"""Those that ManiSkill 3 brings."""
METRES, DEGREES, PIXELS = 4, 2, 2
"""Digits that are shown."""
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
