"""Pages that draw their view in software, and the simplified scene for them."""

from __future__ import annotations

import threading
import time
from collections.abc import Hashable
from dataclasses import replace

import numpy as np
import viser

from workbench.commands.page import TellDrawnInSoftware
from workbench.core.scene.mesh_levels import from_afar
from workbench.core.scene.shapes import SceneGeometry
from workbench.machine.processes.watched_thread import report_failure
from workbench.ui.scene.bodies import Looks
from workbench.ui.scene.env_grid import EnvLayout
from workbench.ui.scene.pixels import NEAREST, Eye, eyes_of
from workbench.ui.widgets.parts import Clock
from workbench.ui.widgets.templates import render
from workbench.ui.widgets.visitors import Visitor

TOLERANCE = 0.75
"""Pixels within which 99 % of a surface must stay. With 1.5 a white part comes through the black one around it."""
FEW = 25_000
"""Number of triangles in the view below which shapes are not simplified: pixels, not triangles, then take the time."""
STEADY = 1.6
"""Factor by which a wanted tolerance must differ before the tolerance is changed: each tolerance is other meshes
for the page."""
AT_REST = 0.4
"""Seconds without a motion of any page's camera after which the view counts as still."""
PATIENCE = 3.0
"""Timeout in seconds within which a page says that it draws in software. Until then nothing changes: a reloaded
page would be sent fine shapes and then simple ones."""


class InSoftware:
    """Which pages draw in software, and the looks for them. Outlives the pages of a server.

    All pages of a server are sent the same shapes: simplified ones only while every open page draws in software.
    """

    def __init__(self, server: viser.ViserServer, clock: Clock = time.monotonic) -> None:
        self._server, self._clock = server, clock
        self._told: set[int] = set()
        self._came: dict[int, float] = {}
        """Time when each page was seen first, by page."""
        self._all = False
        self._eyes: tuple[Hashable, ...] = ()
        self._since = clock()
        self._made: tuple[SceneGeometry, float] | None = None
        """Scene and tolerance for which the simplified shapes are ready."""
        self._unfit: SceneGeometry | None = None
        """The scene whose shapes cannot be simplified."""
        self._making: threading.Thread | None = None

    def ask(self) -> None:
        """Let the pages tell (``browser.js``). Call it in the main panel of each new page."""
        self._server.gui.add_html(render("tell", command=TellDrawnInSoftware(), only="drawn-in-software"))

    def told_by(self, visitor: Visitor) -> None:
        """Handle that a page draws its view in software."""
        self._told.add(visitor.client.client_id)

    @property
    def all_pages(self) -> bool:
        """Whether all open pages draw in software."""
        clients, now = self._server.get_clients().keys(), self._clock()
        self._came = {page: self._came.get(page, now) for page in clients}
        self._told &= clients
        untold = clients - self._told
        if any(now - self._came[page] >= PATIENCE for page in untold):
            self._all = False
        elif clients and not untold:
            self._all = True
        return self._all

    def looks(self, looks: Looks, geometry: SceneGeometry, layout: EnvLayout, alone: bool) -> Looks:
        """These looks, or cheaper ones that differ by about a pixel in the pages that are open.

        Shapes are simplified in a thread, and drawn so when they are ready. Who asks for finer ones than usual has them, and
        so has who looks at few.

        Args:
            looks: As the person has chosen.
            geometry: Of the scene.
            layout: The grid of the envs.
            alone: One env is shown, at the origin.
        """
        if not self.all_pages or geometry is self._unfit:
            return looks
        if looks.triangles > Looks().triangles or _triangles(geometry, alone) <= FEW:
            return looks
        eyes = eyes_of(self._server)
        known = self._made is not None and self._made[0] is geometry
        now = self._made[1] if known and self._made is not None else 0.0
        if not eyes or (known and not self._rest(eyes)):
            return replace(looks, error=now)
        wanted = 2.0 ** (round(2 * np.log2(TOLERANCE * pixel_of(eyes, layout, alone))) / 2)
        if not known or not 1 / STEADY < wanted / now < STEADY:
            self._begin_to_make(geometry, wanted)
        return replace(looks, error=now)

    def _rest(self, eyes: tuple[Eye, ...]) -> bool:
        seen = tuple((eye.position.tobytes(), eye.pixel) for eye in eyes)
        if seen != self._eyes:
            self._eyes, self._since = seen, self._clock()
        return self._clock() - self._since >= AT_REST

    def _begin_to_make(self, geometry: SceneGeometry, error: float) -> None:
        if self._making is None or not self._making.is_alive():
            self._making = threading.Thread(target=self._make, args=(geometry, error), daemon=True)
            self._making.start()

    def _make(self, geometry: SceneGeometry, error: float) -> None:
        try:
            for visual in geometry.visuals:
                from_afar(visual.mesh, error)
        except Exception as why:
            # Else it would be tried again at each step.
            self._unfit = geometry
            report_failure("Shapes cannot be simplified for pages that draw in software", why)
        else:
            self._made = geometry, error


def _triangles(geometry: SceneGeometry, alone: bool) -> int:
    everywhere = sum(len(visual.mesh.faces) * len(visual.envs) for visual in geometry.visuals)
    return everywhere // geometry.num_envs if alone else everywhere


def pixel_of(eyes: tuple[Eye, ...], layout: EnvLayout, alone: bool) -> float:
    """Metres of a pixel at the env that is nearest to an eye.

    Args:
        alone: One env, at the origin.
    """
    offsets = np.zeros((1, 3)) if alone else layout.offsets
    sizes = []
    for eye in eyes:
        at = eye.position - offsets
        away = np.linalg.norm(at - np.clip(at, layout.low, layout.high), axis=1).min()
        sizes.append(eye.pixel * max(float(away), NEAREST))
    return min(sizes)
