"""What stands where, on a plate before each place of the grid, all as one thing to draw.

A label of viser's is text that is laid out anew at every frame of the view: with sixty of them the browser draws half
as often (measured). So the words are painted into one picture, and each place has a plate that shows its part of it.
Plates lean back below the edge of a table, where they hide nothing and face whoever looks at the grid as it is framed
at first; where the ground is at that height they lie on it.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

import numpy as np
import trimesh
import viser
from PIL import Image, ImageDraw, ImageFont
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from workbench.ui.env_layout import MARGIN, EnvLayout

DEPTH = MARGIN
"""Metres of the way between two places that the words take."""
_PIXELS = 64
"""How high a word is painted."""
_WIDE = 1.5
"""Times as wide as high."""
LEAN = 0.55
"""Metres that the lower edge of a plate is below its upper one."""
_PLATE, _INK = (240, 240, 240), (10, 10, 10)


class GroundNumbers:
    """The words under ``/labels``."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._node: viser.GlbHandle | None = None
        self._drawn: tuple[int, tuple[str, ...]] | None = None

    def draw(self, layout: EnvLayout, words: Sequence[str]) -> None:
        """Write a word before each place of the grid; none where it is empty."""
        wanted = (id(layout), tuple(words))
        if wanted == self._drawn:
            return
        self.clear()
        self._drawn = wanted
        if any(words):
            self._node = self._server.scene.add_glb(
                "/labels", ground_glb(layout, words), cast_shadow=False, receive_shadow=False
            )

    def clear(self) -> None:
        self._drawn = None
        if self._node is not None:
            self._node.remove()
            self._node = None


def ground_glb(layout: EnvLayout, words: Sequence[str]) -> bytes:
    """One mesh of a rectangle a word, with one picture of all of them."""
    across = max(1, math.isqrt(len(words)))
    down = -(-len(words) // across)
    places = [index for index, word in enumerate(words) if word]
    # Where the selection's frame lies: on the ground it would be hidden by the tables in front.
    z = max(layout.floor_height, min(0.0, float(layout.high[2]))) + 0.01
    x = float(layout.high[0])
    half = DEPTH * _WIDE / 2
    # At the end of the edge: in its middle robots in front would stand before it.
    y = float(layout.low[1]) + half
    # Read from the side that the grid is looked at from: up is away from there, along -x.
    corners = np.array(
        [(x + DEPTH, y - half, z), (x + DEPTH, y + half, z), (x, y + half, z), (x, y - half, z)]
    )
    vertices = np.concatenate([corners + layout.offsets[index] for index in places])
    faces = np.concatenate([np.array([(0, 1, 2), (0, 2, 3)]) + 4 * number for number in range(len(places))])
    cells = np.array([(index % across, down - 1 - index // across) for index in places], float)
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    uvs = ((cells[:, None] + square[None]) / (across, down)).reshape(-1, 2)
    painted = TextureVisuals(
        uv=uvs,
        material=PBRMaterial(
            baseColorFactor=[0.0, 0.0, 0.0, 1.0],
            # By its own light: words in the shade of a lamp are grey on grey.
            emissiveFactor=[1.0, 1.0, 1.0],
            emissiveTexture=_painted(words, across, down),
            metallicFactor=0.0,
            roughnessFactor=1.0,
            doubleSided=True,
        ),
    )
    mesh = trimesh.Trimesh(vertices, faces, visual=painted, process=False, validate=False)
    buffer = io.BytesIO()
    mesh.export(buffer, file_type="glb", include_normals=True)
    return buffer.getvalue()


def _painted(words: Sequence[str], across: int, down: int) -> Image.Image:
    wide = int(_WIDE * _PIXELS)
    picture = Image.new("RGB", (across * wide, down * _PIXELS), _PLATE)
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=0.85 * _PIXELS)
    for index, word in enumerate(words):
        middle = ((index % across + 0.5) * wide, (index // across + 0.5) * _PIXELS)
        pen.text(middle, word, fill=_INK, font=font, anchor="mm", stroke_width=2)
    return picture
