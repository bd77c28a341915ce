"""Tracks pages that render in software and simplifies the scene for them."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from functools import partial

import numpy as np
import viser

from workbench.envs.scene.mesh_levels import from_afar
from workbench.envs.scene.shapes import SceneGeometry
from workbench.machine.loop import BlockingPool, begin, later, post
from workbench.machine.processes.watched_thread import report_failure
from workbench.page.commands import TellDrawnInSoftware
from workbench.page.scene.bodies import DrawStyle
from workbench.page.scene.env_grid import EnvLayout
from workbench.page.scene.visible_motion import NEAR_METRES, Eye, eyes_of
from workbench.page.widgets.templates import render
from workbench.page.widgets.visitors import Visitor

TOLERANCE_PIXELS = 0.75
"""Maximum distance, in pixels, of 99 % of a simplified surface from the exact one. With 1.5 a white part
shows through the black part around it."""
MIN_TRIANGLES = 25_000
"""Number of triangles in the view below which shapes are not simplified: then pixels, not triangles, take the time."""
TOLERANCE_FACTOR = 1.6
"""Minimum factor by which the wanted tolerance must be larger or smaller than the present one before the
tolerance changes: each change sends new meshes to the pages."""
AT_REST_SECONDS = 0.4
"""Time without motion of any page's camera after which the view counts as still."""
REPORT_TIMEOUT_SECONDS = 3.0
"""Timeout for a page to report that it renders in software. Until the report or the timeout, the shapes do
not change: otherwise, a reloaded page would first be sent fine shapes and then simple ones."""
Scene = tuple[SceneGeometry, EnvLayout, bool]
"""A drawn scene, the grid of its envs, and whether a single env is shown."""


class InSoftware:
    """Knows which pages render in software, and chooses the drawing style for them. Outlives the pages of a server.

    All pages of a server get the same shapes: simplified ones only while every open page renders in software.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._pages: dict[int, bool | None] = {}
        """Whether each open page renders in software; None if not known yet."""
        self.all_pages = False
        """Whether all open pages render in software."""
        self._drawn: Scene | None = None
        """The drawn scene, if its shapes may be simplified."""
        self._made: tuple[SceneGeometry, float] | None = None
        """Scene and tolerance for which the simplified shapes are ready."""
        self._simplifying: asyncio.Task[None] | None = None
        self._aside = BlockingPool("simplify")
        server.on_client_connect(self._on_connect)
        server.on_client_disconnect(self._on_disconnect)

    def ask(self) -> None:
        """Ask the browsers to report (``browser.js``). Call it in the main panel of each new page."""
        self._server.gui.add_html(render("tell", command=TellDrawnInSoftware(), only="drawn-in-software"))

    def report_arrived(self, visitor: Visitor) -> None:
        """Handle the report that a page renders in software."""
        post(partial(self._set_in_software, visitor.client.client_id, True))

    async def _on_connect(self, client: viser.ClientHandle) -> None:
        post(partial(self._expect, client.client_id))

    async def _on_disconnect(self, client: viser.ClientHandle) -> None:
        post(partial(self._forget, client.client_id))

    def _expect(self, page: int) -> None:
        self._pages[page] = None
        self._decide()
        later(REPORT_TIMEOUT_SECONDS, lambda: self._set_in_software(page, self._pages.get(page) or False))

    def _set_in_software(self, page: int, in_software: bool) -> None:
        if page in self._pages:
            self._pages[page] = in_software
            self._decide()

    def _forget(self, page: int) -> None:
        self._pages.pop(page, None)
        self._decide()

    def _decide(self) -> None:
        known = self._pages.values()
        if False in known:
            self.all_pages = False
        elif known and None not in known:
            self.all_pages = True
        if self._simplifying is None and self.all_pages and known:
            self._simplifying = begin(self._simplify())

    def looks(self, looks: DrawStyle, geometry: SceneGeometry, layout: EnvLayout, alone: bool) -> DrawStyle:
        """The style to draw with: `looks`, or a cheaper one whose shapes differ by about a pixel in the open
        pages.

        Simplified shapes are made in the background, and used when they are ready. Shapes are not simplified
        if the user chose a finer level of detail than the default, or if the view has few triangles.

        Args:
            looks: The style that the user has chosen.
            geometry: Geometry of the scene.
            layout: The grid of the envs.
            alone: Whether a single env is shown, at the origin.
        """
        usual = not self.all_pages or looks.triangles > DrawStyle().triangles
        if usual or _triangles(geometry, alone) <= MIN_TRIANGLES:
            self._drawn = None
            return looks
        self._drawn, made = (geometry, layout, alone), self._made
        return replace(looks, error=made[1] if made is not None and made[0] is geometry else 0.0)

    async def _simplify(self) -> None:
        """Simplify the drawn shapes while all pages render in software."""
        seen: object = None
        unfit: SceneGeometry | None = None
        try:
            while self.all_pages and self._pages:
                await asyncio.sleep(AT_REST_SECONDS)
                eyes, before = eyes_of(self._server), seen
                seen = [(eye.position.tobytes(), eye.pixel) for eye in eyes]
                wanted = self._wanted(eyes, seen == before)
                if wanted is None or wanted[0] is unfit:
                    continue
                try:
                    await self._aside.run(partial(_simplify_shapes, *wanted))
                except Exception as why:
                    unfit = wanted[0]  # do not retry a scene that fails
                    report_failure("Shapes cannot be simplified for pages that draw in software", why)
                else:
                    self._made = wanted
        finally:
            self._simplifying = None

    def _wanted(self, eyes: tuple[Eye, ...], at_rest: bool) -> tuple[SceneGeometry, float] | None:
        """The scene to simplify, and its tolerance; None if the present shapes are good enough."""
        if not eyes or self._drawn is None:
            return None
        geometry, layout, alone = self._drawn
        error = 2.0 ** (round(2 * np.log2(TOLERANCE_PIXELS * pixel_of(eyes, layout, alone))) / 2)
        if self._made is not None and self._made[0] is geometry:
            if not at_rest or 1 / TOLERANCE_FACTOR < error / self._made[1] < TOLERANCE_FACTOR:
                return None
        return geometry, error


def _simplify_shapes(geometry: SceneGeometry, error: float) -> None:
    for visual in geometry.visuals:
        from_afar(visual.mesh, error)


def _triangles(geometry: SceneGeometry, alone: bool) -> int:
    everywhere = sum(len(visual.mesh.faces) * len(visual.envs) for visual in geometry.visuals)
    return everywhere // geometry.num_envs if alone else everywhere


def pixel_of(eyes: tuple[Eye, ...], layout: EnvLayout, alone: bool) -> float:
    """Size of a pixel in metres at the env nearest to an eye.

    Args:
        alone: Whether a single env is shown, at the origin.
    """
    offsets = np.zeros((1, 3)) if alone else layout.offsets
    sizes = []
    for eye in eyes:
        at = eye.position - offsets
        away = np.linalg.norm(at - np.clip(at, layout.low, layout.high), axis=1).min()
        sizes.append(eye.pixel * max(float(away), NEAR_METRES))
    return min(sizes)
