"""Lean copies replace uniform textures by constants and render the same image, and are dropped when the author changes a material."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import sapien.render
from numpy.typing import NDArray

from tests.envs.drawn_envs import batched
from workbench.envs.maniskill_private import camera_components
from workbench.envs.rendering.fast_shapes import shown
from workbench.envs.rendering.lean_materials import LeanBody, LeanMaterials

SPOTS = np.zeros((4, 4, 4), np.uint8)
SPOTS[1, 2] = 255
pytestmark = pytest.mark.usefixtures("renderer")


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    env = batched("PullCube-v1", obs_mode="rgb", sensor_configs={"width": 256, "height": 256})
    yield env
    env.close()


def body_of(env: Any, name: str) -> Any:
    (found,) = (entity for entity in env.scene.sub_scenes[0].entities if name in entity.name)
    return found.find_component_by_type(sapien.render.RenderBodyComponent)


@pytest.fixture
def table(env: Any) -> Iterator[tuple[Any, LeanBody]]:
    """ManiSkill's table, whose metallic texture is 1 everywhere, and its lean copy on the same entity."""
    body = body_of(env, "table-workspace")
    lean = LeanMaterials().lean_copy(body)
    assert lean is not None
    lean.component.visibility = 0.0
    body.entity.add_component(lean.component)
    yield body, lean
    body.entity.remove_component(lean.component)


def picture(env: Any) -> NDArray[Any]:
    camera = camera_components(env._sensors["base_camera"])[0]
    env.scene.sub_scenes[0].update_render()
    camera.take_picture()
    return camera.get_picture("Color")


def materials_of(body: Any) -> list[Any]:
    return [part.material for shape in body.render_shapes for part in shape.parts]


def test_a_lean_copy_renders_the_same_image_bit_for_bit(env: Any, table: tuple[Any, LeanBody]) -> None:
    body, lean = table
    before = picture(env)
    with shown(((body, lean.component),)):
        np.testing.assert_array_equal(picture(env), before)
    with shown(((body, None),)):
        assert (picture(env) != before).mean() > 0.1, "the table is not in view"
    wood, own = materials_of(body)[0], materials_of(lean.component)[0]
    assert wood.metallic_texture is not None and own.metallic_texture is None and own.metallic == 1.0
    assert own.roughness_texture == wood.roughness_texture, (
        "the roughness texture is not uniform and must stay"
    )


def test_a_lean_copy_of_a_body_without_a_segmentation_id_has_none(env: Any) -> None:
    (shape, *_) = body_of(env, "table-workspace").render_shapes
    body = sapien.render.RenderBodyComponent()
    body.attach(sapien.render.RenderShapeTriangleMesh(shape.filename, shape.scale))
    body.disable_render_id()
    lean = LeanMaterials().lean_copy(body)
    assert lean is not None and lean.component.is_render_id_disabled


@pytest.mark.parametrize(
    "changed",
    [
        {"base_color_texture": None, "base_color": [0, 1, 0, 1]},
        {"metallic_texture": None, "metallic": 0.2},
        {"metallic_texture": SPOTS},
        {"roughness": 0.2},
    ],
    ids=str,
)
def test_a_lean_copy_is_invalid_after_the_author_changes_the_material(
    table: tuple[Any, LeanBody], changed: dict[str, Any]
) -> None:
    body, lean = table
    assert lean.is_like_exact()
    wood = materials_of(body)[0]
    was = {name: getattr(wood, name) for name in changed}
    try:
        for name, value in changed.items():
            texture = isinstance(value, np.ndarray)
            setattr(wood, name, sapien.render.RenderTexture2D(value, "R8G8B8A8Unorm") if texture else value)
        assert not lean.is_like_exact()
        if "metallic_texture" in changed:
            assert LeanMaterials().lean_copy(body) is None, "no texture is uniform any more"
    finally:
        for name, value in was.items():
            setattr(wood, name, value)
    assert lean.is_like_exact()
