"""Contact forces of one env as arrows in the 3-D view.

One arrow a contact point, from the point in the direction of the force on the first body of the pair. Forces span
five decades (a cube's weight on four corners, a hand that is pressed into a table), so the length grows with the
cube root of the force and is bounded: it says "much" or "little", the numbers are in the Inspect tab.
"""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.core.inspection import Inspection

COLOUR = (255, 0, 200)
"""Magenta: wood, steel, goals and cubes are not."""
METRES_AT_ONE_NEWTON = 0.07
LONGEST = 0.3
SHAFT, HEAD, HEAD_LENGTH = 0.005, 0.012, 0.028
"""Metres; an arrow shorter than its head would be drawn as something else."""
WEAKEST = 1e-3
"""Newtons; weaker is drawn by nobody's wish."""


class ForceArrows:
    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._handle: viser.ArrowsHandle | None = None
        self._drawn: tuple[int, bytes] | None = None

    def draw(self, inspection: Inspection | None, offset: NDArray[np.float32]) -> None:
        """Show the contacts of this reading, or nothing.

        Args:
            offset: (3,) where the env stands in the view.
        """
        wanted = (id(inspection), offset.tobytes())
        if wanted == self._drawn:
            return
        self._drawn = wanted
        arrows = np.zeros((0, 2, 3), np.float32) if inspection is None else arrows_of(inspection) + offset
        if not len(arrows):
            if self._handle is not None:
                self._handle.remove()
                self._handle = None
        elif self._handle is None:
            self._handle = self._server.scene.add_arrows(
                "/forces", arrows, COLOUR, shaft_radius=SHAFT, head_radius=HEAD, head_length=HEAD_LENGTH
            )
        else:
            self._handle.points = arrows


def arrows_of(inspection: Inspection) -> NDArray[np.float32]:
    """(A, 2, 3) start and end of each arrow, metres, in the env's own frame."""
    pairs = inspection.contacts or ()
    if not pairs:
        return np.zeros((0, 2, 3), np.float32)
    points = np.concatenate([pair.points for pair in pairs])
    forces = np.concatenate([pair.forces for pair in pairs])
    size = np.linalg.norm(forces, axis=1)
    shown = np.isfinite(size) & (size > WEAKEST)
    points, forces, size = points[shown], forces[shown], size[shown]
    length = np.minimum(METRES_AT_ONE_NEWTON * np.cbrt(size), LONGEST)
    return np.stack([points, points + forces / size[:, None] * length[:, None]], axis=1).astype(np.float32)
