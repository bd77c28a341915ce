"""The numbers before the places of the grid."""

from __future__ import annotations

import io

import numpy as np
import trimesh

from tests.ui.scenes import table_scene
from workbench.ui.env_layout import lay_out
from workbench.ui.ground_numbers import ground_glb


def test_each_word_is_painted_on_a_plate_before_its_place() -> None:
    layout = lay_out(*table_scene(5))
    words = ("A", "", "C", "D", "5")
    scene = trimesh.load_scene(io.BytesIO(ground_glb(layout, words)), file_type="glb")
    (mesh,) = scene.geometry.values()
    plates = mesh.vertices.reshape(-1, 4, 3)
    assert len(plates) == 4, "none where there is no word"
    for plate, index in zip(plates, (0, 2, 3, 4), strict=True):
        own = plate - layout.offsets[index]
        assert (own[:, 0] >= layout.high[0] - 1e-5).all(), "nothing of the env is under it"
        assert layout.low[1] - 1e-5 <= own[:, 1].min() and own[:, 1].max() <= layout.high[1] + 1e-5
        assert own[:, 2].min() > layout.floor_height
    picture = np.asarray(mesh.visual.material.emissiveTexture.convert("L"))
    corners = mesh.visual.uv.reshape(-1, 4, 2)
    places = set()
    for low, high in zip(corners.min(axis=1), corners.max(axis=1), strict=True):
        # trimesh counts v from the bottom of the picture.
        (x0, x1), (y1, y0) = (
            np.rint(np.array((low[0], high[0])) * picture.shape[1]).astype(int),
            np.rint((1 - np.array((low[1], high[1]))) * picture.shape[0]).astype(int),
        )
        part = picture[y0:y1, x0:x1]
        assert 0.02 < (part < 100).mean() < 0.5, "dark ink on a light plate"
        places.add(part.tobytes())
    assert len(places) == 4, "each its own word"
