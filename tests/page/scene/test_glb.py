from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from tests.drive.scenes import box_mesh
from workbench.envs.scene.shapes import Material
from workbench.page.scene.glb import LAYER_METRES, as_glb, lift_painted_layers


def read_back(glb: bytes) -> list[Any]:
    scene: Any = trimesh.load(io.BytesIO(glb), file_type="glb", force="scene")
    return [mesh for mesh in scene.geometry.values() if isinstance(mesh, trimesh.Trimesh)]


def test_glb_keeps_triangles_normals_and_colours() -> None:
    mesh = box_mesh((1.0, 2.0, 3.0))
    red = Material((1.0, 0.0, 0.0, 1.0), metallic=0.1, roughness=0.3)
    see_through = Material((0.0, 1.0, 0.0, 0.5))
    first, second = read_back(as_glb([(mesh, red), (mesh, see_through)]))
    np.testing.assert_allclose(first.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(first.faces, mesh.faces)
    assert mesh.normals is not None
    np.testing.assert_allclose(first.vertex_normals, mesh.normals, atol=1e-5)
    np.testing.assert_allclose(first.visual.material.baseColorFactor[:3], [255, 0, 0], atol=1)
    assert first.visual.material.alphaMode == "OPAQUE"
    assert second.visual.material.alphaMode == "BLEND"


def test_an_untextured_part_next_to_a_textured_one_gets_uvs_too() -> None:
    """The browser does not merge parts with different attributes, and then shows none of them."""
    plain = box_mesh((1, 1, 1))
    uvs = np.random.default_rng(0).random((len(plain.vertices), 2)).astype(np.float32)
    texture = np.full((4, 4, 4), 200, np.uint8)
    parts = read_back(
        as_glb(
            [
                (replace(plain, uvs=uvs), Material((1, 1, 1, 1), texture=texture)),
                (plain, Material((0, 0, 1, 1))),
            ]
        )
    )
    assert all(part.visual.uv is not None for part in parts)
    # In the file v counts from the top as in `Mesh`; trimesh flips it on loading.
    np.testing.assert_allclose(parts[0].visual.uv, np.column_stack([uvs[:, 0], 1 - uvs[:, 1]]), atol=1e-6)


def test_flat_painted_layers_are_separated_and_solids_are_not() -> None:
    discs = [box_mesh((0.1 / (n + 1), 0.1 / (n + 1), 2e-5 + 2e-5 * n)) for n in range(3)]
    solid = box_mesh((0.1, 0.1, 0.1))
    *lifted, same = lift_painted_layers([*discs, solid])
    tops = [float(mesh.vertices[:, 2].max()) for mesh in lifted]
    assert np.diff(tops).min() > 0.9 * LAYER_METRES
    assert same is solid
