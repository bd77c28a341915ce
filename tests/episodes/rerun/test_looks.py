"""How rerun shows the scene, cameras and curves of a recording, and that the scene's looks are read back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.drive.episodes import Made, Track
from tests.drive.rows import append
from tests.episodes.read_rrd import read_rrd
from workbench.envs.camera_data import CameraInfo
from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, SharedShapes, Visual
from workbench.envs.step_result import OtherEntry
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.rerun.entities import VIEWER_TEXELS

Maker = Callable[..., Made]


def mesh(first: float) -> Mesh:
    """A triangle with normals and texture coordinates, all numbers different."""
    numbers = np.arange(3)[:, None] + first
    vertices, normals, uvs = np.eye(3) + numbers, numbers * [0, 0.1, 1], numbers * [0.25, 0.5]
    faces = np.array([[2, 0, 1]], np.uint32)
    single = np.float32
    return Mesh(vertices.astype(single), faces, normals.astype(single), uvs.astype(single))


def scene() -> SceneGeometry:
    small = np.arange(2 * 3 * 4).reshape(2, 3, 4).astype(np.uint8)
    large = np.zeros((100, 200, 4), np.uint8)
    large[:50, :, 0], large[:, 100:, 2], large[..., 3] = 200, 160, 255
    small[..., 3] = 255
    both, zeros = np.array([1, 2], np.int32), np.zeros(2, np.int32)
    shiny = Material((0.1, 0.2, 0.4, 0.5), 0.25, 0.75)
    visuals = (
        Visual("floor/0", mesh(1.0), Material((1, 1, 1, 1), 0.25, 0.75, large), zeros[:1], zeros[:1]),
        Visual("shared", mesh(2.0), shiny, zeros, both),
        Visual("arm/hand/1", mesh(3.0), Material((1, 0, 0, 1), texture=small), zeros[:1], both[:1]),
        Visual("nothing", replace(mesh(4.0), faces=np.zeros((0, 3), np.uint32)), shiny, zeros[:1], both[1:]),
    )
    kinds = ("static", "link", "dynamic")
    return SceneGeometry(1, ("floor", "arm/hand", "cube"), kinds, (False, False, True), visuals)


@pytest.fixture
def episode(make_episode: Maker) -> Made:
    poses = np.zeros((4, 3, 7), np.float32)
    poses[..., 3] = 1
    matrix = np.array([[90, 0, 16], [0, 70, 12], [0, 0, 1]], np.float32)
    info = CameraInfo("eye", "sensor", 4, 3, 1.0, 0.01, 9.0, matrix, None, ("depth", "segmentation"))
    pose = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (4, 1))
    ids = np.arange(4 * 3 * 4, dtype=np.int32).reshape(4, 3, 4)
    eye = Track(info, np.arange(4), pose, depth=ids.astype(np.float32), segmentation=ids)
    evaluate = {
        "success": np.zeros(4, bool),
        "xy": np.zeros((4, 2)),
        "reward_terms/reach": np.zeros(4),
        "reward_terms/grasp": np.zeros(4),
    }
    return make_episode(
        3, geometry=scene(), poses=poses, cameras=[eye], evaluate=evaluate, segmentation={0: "sky", 7: "cube", -1: "x"},
        obs={"agent/qpos": np.zeros((4, 2)), "": np.zeros(4)},
    )  # fmt: skip


@pytest.mark.parametrize("shared", [False, True])
def test_meshes_and_materials_are_read_back_for_each_body(
    episode: Made, tmp_path: Path, shared: bool
) -> None:
    shapes = SharedShapes() if shared else None
    # The second time the scene is known from the first recording.
    for number in range(2):
        found = read_episode(episode.write(tmp_path / str(number)).rrd, shapes).geometry
        assert found is not None and found.body_kinds == episode.geometry.body_kinds
        assert found.body_hidden == (False, False, True)
        wanted = {visual.name: visual for visual in episode.geometry.visuals[:3]}
        assert {visual.name for visual in found.visuals} == wanted.keys()
        for visual in found.visuals:
            original = wanted[visual.name]
            for name in ("vertices", "faces", "normals"):
                np.testing.assert_allclose(getattr(visual.mesh, name), getattr(original.mesh, name))
            assert visual.bodies.tolist() == original.bodies.tolist() and not visual.envs.any()
            look, then = visual.material, original.material
            np.testing.assert_allclose(look.base_color, then.base_color, rtol=1e-6)
            assert (look.metallic, look.roughness) == (then.metallic, then.roughness)
            if then.texture is None:
                assert look.texture is None
                continue
            assert visual.mesh.uvs is not None and original.mesh.uvs is not None
            np.testing.assert_allclose(visual.mesh.uvs, original.mesh.uvs)
            assert look.texture is not None and look.texture.shape == then.texture.shape
            off = np.abs(look.texture.astype(int) - then.texture).mean()
            assert off <= (4 if max(then.texture.shape) > VIEWER_TEXELS else 0)


def test_rerun_shows_colours_textures_and_names_of_ids(episode: Made, tmp_path: Path) -> None:
    entities = read_rrd(episode.write(tmp_path).rrd)
    shiny = entities["/world/cube/0"]
    # Linear 0.1, 0.2 and 0.4 as sRGB; alpha is linear.
    factor = int(shiny["Mesh3D:albedo_factor"].values[0][0])
    assert list(factor.to_bytes(4, "big")) == [89, 124, 170, 128]
    normals = mesh(2.0).normals
    assert normals is not None
    np.testing.assert_allclose(shiny["Mesh3D:vertex_normals"].values[0], normals)
    assert "/world/cube/1" not in entities and "/world/arm/hand/1" in entities
    form = entities["/world/floor/0"]["Mesh3D:albedo_texture_format"].values[0][0]
    assert (form["width"], form["height"]) == (VIEWER_TEXELS, VIEWER_TEXELS // 2)
    (buffer,) = entities["/world/floor/0"]["Mesh3D:albedo_texture_buffer"].values[0]
    shown = np.frombuffer(bytes(buffer), np.uint8).reshape(VIEWER_TEXELS // 2, VIEWER_TEXELS, 3).astype(int)
    corners = shown[[10, 10, 40], [20, 80, 80]]
    assert np.abs(corners - [[200, 0, 0], [200, 0, 160], [0, 0, 160]]).max() < 4
    eye = entities["/world/cameras/eye"]
    assert eye["Pinhole:resolution"].values[0][0].tolist() == [4, 3]
    assert entities["/world/cameras/eye/depth"]["EncodedDepthImage:meter"].values[0].tolist() == [1000]
    (context,) = entities["/world/cameras"]["AnnotationContext:context"].values
    names = {one["class_id"]: one["class_description"]["info"]["label"] for one in context[0]}
    assert names == {0: "sky", 7: "cube"}


def test_curves_of_one_view_have_names_and_colours_of_their_own(episode: Made, tmp_path: Path) -> None:
    writer = episode.writer(tmp_path)
    for row in episode.rows():
        append(writer, replace(row, others={"mean": OtherEntry("float", numbers=np.array(0.5))}))
    entities = read_rrd(writer.finish().rrd)

    def curves(*names: str) -> dict[str, int]:
        found: dict[str, int] = {}
        for held in (entities[name] for name in names):
            shown, colours = held["SeriesLines:names"].values[0], held["SeriesLines:colors"].values[0]
            found |= dict(zip(shown, colours.tolist(), strict=True))
        return found

    evaluated = curves("/evaluate/success", "/evaluate/xy", "/batch/mean")
    assert list(evaluated) == ["success", "xy[0]", "xy[1]", "mean"] and len(set(evaluated.values())) == 4
    rewards = curves("/reward", "/reward/reach", "/reward/grasp")
    assert list(rewards) == ["reward", "reach", "grasp"] and len(set(rewards.values())) == 3
    assert list(curves("/observation/state")) == ["agent/qpos[0]", "agent/qpos[1]", "obs"]
