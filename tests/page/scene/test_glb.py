from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from tests.drive.scenes import box_mesh, visual
from workbench.envs.scene.shapes import Material, Mesh
from workbench.page.scene.glb import LAYER_METRES, as_glb, face_limit, lift_painted_layers, lightened


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


def strip_of(triangles: int) -> Mesh:
    vertices = np.zeros((triangles + 2, 3), np.float32)
    faces = np.stack([np.arange(triangles) + k for k in range(3)], axis=1).astype(np.uint32)
    return Mesh(vertices, faces)


def test_the_triangles_of_all_shown_instances_stay_within_the_budget() -> None:
    visuals = visual("a", strip_of(50_000), 4, 0), visual("b", strip_of(300), 4, 1)
    assert face_limit(visuals, 4, 4, 10**9) == 50_000, "all of them fit"
    for shown in (1, 2, 4):
        limit = face_limit(visuals, shown, 4, 40_000)
        used = [shown * (min(50_000, one) + min(300, one)) for one in (limit, limit + 1)]
        assert used[0] <= 40_000 < used[1]
    assert face_limit(visuals, 4, 4, 100) == 200, "a shape needs some"
    assert face_limit((), 1, 1, 100) == 200


def test_a_dark_floor_is_lightened_and_a_light_one_is_not() -> None:
    texture = np.full((4, 4, 4), 100, np.uint8)
    texture[..., 3] = 7
    dark = lightened(Material((1, 1, 1, 1), texture=texture))
    assert dark.texture is not None
    assert (dark.texture[..., :3] == 208).all() and (dark.texture[..., 3] == 7).all()
    light = Material((1, 1, 1, 1), texture=np.full((4, 4, 3), 200, np.uint8))
    assert lightened(light) is light
    colours = Material((0.1, 0.2, 0.3, 0.5)), Material((0.9, 0.9, 0.9, 1.0))
    lighter = lightened(colours[0])
    assert lighter.base_color[3] == 0.5 and all(
        one > was + 0.5 for one, was in zip(lighter.base_color[:3], colours[0].base_color)
    )
    assert lightened(colours[1]) is colours[1]


def test_a_large_texture_is_shrunk_and_only_a_transparent_one_is_blended() -> None:
    box = box_mesh((1, 1, 1))
    mesh = replace(box, uvs=np.zeros((len(box.vertices), 2), np.float32))
    opaque = np.full((1500, 3000, 4), 255, np.uint8)
    holes = np.full((8, 8, 4), 255, np.uint8)
    holes[0, 0, 3] = 0
    for pixels, size, mode in ((opaque, (1024, 512), "OPAQUE"), (holes, (8, 8), "BLEND")):
        (part,) = read_back(as_glb([(mesh, Material((1, 1, 1, 1), texture=pixels))]))
        assert part.visual.material.baseColorTexture.size == size
        assert part.visual.material.alphaMode == mode
    shining = Material((1, 1, 1, 1), metallic=1.0, roughness=0.25)
    (part,) = read_back(as_glb([(box, shining)]))
    assert part.visual.material.metallicFactor < 0.5 and part.visual.material.roughnessFactor == 0.25
    assert part.visual.material.doubleSided
