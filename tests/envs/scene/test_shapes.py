"""Shapes that look the same are recognised, shared and coloured as SAPIEN means them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.drive.scenes import box_mesh, table_scene
from workbench.envs.scene.shapes import Material, Mesh, SharedShapes, Visual, fingerprint, srgb

ONE = np.zeros(1, np.int32)
UVS = np.zeros((36, 2), np.float32)
PIXELS = np.full((2, 2, 4), 7, np.uint8)


def visual(mesh: Mesh, material: Material, name: str = "box/0") -> Visual:
    return Visual(name, mesh, material, ONE, ONE)


def looks() -> dict[str, tuple[Mesh, Material]]:
    """Shapes that differ from the first in one thing each."""
    box, grey = box_mesh((1, 2, 3)), Material((0.5, 0.5, 0.5, 1.0), 0.1, 0.2)
    assert box.normals is not None
    return {
        "first": (box, grey),
        "vertices": (replace(box, vertices=box.vertices + 1), grey),
        "faces": (replace(box, faces=box.faces[:, ::-1]), grey),
        "normals": (replace(box, normals=-box.normals), grey),
        "no normals": (replace(box, normals=None), grey),
        "uvs": (replace(box, uvs=UVS), grey),
        "other uvs": (replace(box, uvs=UVS + 1), grey),
        "colour": (box, replace(grey, base_color=(0.5, 0.5, 0.6, 1.0))),
        "transparency": (box, replace(grey, base_color=(0.5, 0.5, 0.5, 0.9))),
        "metallic": (box, replace(grey, metallic=0.3)),
        "roughness": (box, replace(grey, roughness=0.3)),
        "texture": (box, replace(grey, texture=PIXELS)),
        "other texture": (box, replace(grey, texture=PIXELS + 1)),
    }


def test_each_visible_difference_changes_the_fingerprint_and_nothing_else_does() -> None:
    first, again = looks(), looks()
    prints = {name: fingerprint((visual(*look),)) for name, look in first.items()}
    assert len(set(prints.values())) == len(prints)
    for name, look in again.items():
        moved = replace(visual(*look, name="other/3"), envs=ONE + 4, bodies=ONE + 2)
        assert fingerprint((moved,)) == prints[name]
    both = fingerprint((visual(*first["first"]), visual(*first["colour"])))
    assert both not in prints.values()
    assert both != fingerprint((visual(*first["colour"]), visual(*first["first"])))


def test_shapes_that_look_the_same_are_kept_once() -> None:
    shared, first, again = SharedShapes(), looks(), looks()
    for name, look in first.items():
        assert all(kept is given for kept, given in zip(shared.shared(*look), look, strict=True)), name
    for name, look in again.items():
        assert all(kept is one for kept, one in zip(shared.shared(*look), first[name], strict=True)), name
    geometry, _ = table_scene(2)
    mesh, material = again["colour"]
    given = replace(geometry, visuals=(visual(mesh, material, "a/0"), visual(mesh, material, "b/0")))
    made = shared.share(given)
    assert [one.name for one in made.visuals] == ["a/0", "b/0"]
    assert all(one.mesh is first["colour"][0] for one in made.visuals)
    shared.learn("mark", "a/0", mesh, material)
    assert shared.known("mark") == ("a/0", mesh, material) and shared.known("other") is None


def test_linear_colours_are_encoded_and_transparency_is_not() -> None:
    encoded = srgb(np.array([0.0, 0.001, 0.0031308, 0.21404114, 0.5, 1.0]))
    np.testing.assert_allclose(encoded, [0, 0.01292, 0.040450, 0.5, 0.735357, 1], atol=1e-5)
    assert Material((0.21404114, 0.5, 1.0, 0.3)).srgb_color == pytest.approx(
        (0.5, 0.735357, 1.0, 0.3), abs=1e-5
    )


def test_a_scene_lists_hidden_bodies_and_collision_shapes() -> None:
    geometry, _ = table_scene(2)
    collisions = (visual(*looks()["first"], name="hull/0"),)
    made = replace(geometry, body_hidden=(False, True, False, True), collisions=collisions)
    assert made.hidden_names == (made.body_names[1], made.body_names[3])
    assert made.as_collisions.visuals == collisions and made.as_collisions.body_names == made.body_names
