"""The geometry sent to the browser matches what ManiSkill's own renderer draws."""

# SAPIEN and ManiSkill annotate vectors and poses as what they become.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from pathlib import Path
from typing import Any

import mani_skill.envs  # noqa: F401 (registers the tasks)
import numpy as np
import pytest
import sapien
import sapien.render
import trimesh
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.render import PREBUILT_SHADER_CONFIGS, set_shader_pack
from mani_skill.utils.structs import Pose
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from tests.drive.render_device import RENDER_BACKEND, RENDER_DEVICE
from tests.envs.drawn_envs import batched, stock
from tests.envs.stock_env import Bare, batch_of
from workbench.envs.scene.read_scene import read_geometry
from workbench.envs.scene.scene_index import read_poses, scene_index
from workbench.envs.scene.shapes import SceneGeometry, Visual
from workbench.pictures.render import list_cameras, segmentation_names, take_pictures

pytestmark = pytest.mark.usefixtures("renderer")

EVERYTHING: dict[str, int] = {"max_faces": 10**9, "max_texels": 10**9}


# --- appearance ----------------------------------------------------------------------------


def painted(
    visuals: list[Visual],
    poses: NDArray[np.float32],
    env: int,
    pose: NDArray[np.float32],
    k: NDArray,
    size: int,
) -> NDArray[np.int64]:
    """Paint triangles from far to near with numpy and PIL; return the body index of each pixel or -1, (size, size)."""
    fine = 4  # PIL also paints pixels that a triangle only touches; a finer grid reduces this error
    to_camera = np.linalg.inv(sapien.Pose(pose[:3].tolist(), pose[3:].tolist()).to_transformation_matrix())
    triangles, depths, bodies = [], [], []
    for visual in visuals:
        for body in visual.bodies[visual.envs == env]:
            at = poses[env, body]
            matrix = to_camera @ sapien.Pose(at[:3], at[3:]).to_transformation_matrix()
            points = visual.mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
            # ManiSkill's camera looks along x with y to the left; an image has v downwards.
            u = k[0, 0] * -points[:, 1] / points[:, 0] + k[0, 2]
            v = k[1, 1] * -points[:, 2] / points[:, 0] + k[1, 2]
            triangles.append(np.stack([u, v], -1)[visual.mesh.faces])
            depths.append(points[visual.mesh.faces, 0].mean(axis=1))
            bodies.append(np.full(len(visual.mesh.faces), body))
    image = Image.new("I", (size * fine, size * fine), -1)
    draw = ImageDraw.Draw(image)
    every, body_of = np.concatenate(triangles) * fine, np.concatenate(bodies)
    for i in np.argsort(-np.concatenate(depths)):
        draw.polygon([tuple(p) for p in every[i]], fill=int(body_of[i]))
    return np.asarray(image)[fine // 2 :: fine, fine // 2 :: fine].astype(np.int64)


def test_silhouettes_match_the_renderers() -> None:
    size = 512
    env = batched("PickCube-v1", 2, sensor_configs={"width": size, "height": size})
    env.step(None)
    table = scene_index(env)
    geometry, poses = read_geometry(env), read_poses(env)
    camera = next(c for c in list_cameras(env) if c.name == "base_camera")
    names = segmentation_names(env)
    drawn = [i for i, n in enumerate(table.names) if n == "cube" or n.startswith("panda/")]
    visuals = [v for v in geometry.visuals if v.bodies[0] in drawn]
    for index in range(2):
        (picture,) = take_pictures(env, index, [("base_camera", "sensor", ["segmentation"])])
        assert picture.segmentation is not None
        ids = np.full(max(names) + 1, -1)
        for number, name in names.items():
            ids[number] = table.names.index(name)
        seen = ids[picture.segmentation]
        mine = painted(visuals, poses, index, picture.pose, camera.intrinsic, size)
        cube = table.names.index("cube")
        for what, bodies in {"cube": [cube], "robot": [b for b in drawn if b != cube]}.items():
            a, b = np.isin(seen, bodies), np.isin(mine, bodies)
            assert a.sum() > 100, f"{what} is not in view"
            overlap = (a & b).sum() / (a | b).sum()
            assert overlap > 0.97, f"{what} of env {index}: {overlap:.3f}"
    env.close()


def redrawn(geometry: SceneGeometry, poses: NDArray[np.float32], env: Any) -> NDArray:
    """Render the albedo of the env's human camera in a new scene built from env 0 of `geometry`."""
    scene = sapien.Scene(
        [sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(sapien.Device(RENDER_DEVICE))]
    )
    scene.set_ambient_light([0.3, 0.3, 0.3])
    scene.add_directional_light([1, 1, -1], [1, 1, 1])
    scene.add_directional_light([0, 0, -1], [1, 1, 1])
    for visual in geometry.visuals:
        mesh, look = visual.mesh, visual.material
        material = sapien.render.RenderMaterial(
            base_color=list(look.base_color), metallic=look.metallic, roughness=look.roughness
        )
        if look.texture is not None:
            material.base_color_texture = sapien.render.RenderTexture2D(
                look.texture, "R8G8B8A8Unorm", mipmap_levels=4 if "ground" in visual.name else 1, srgb=True
            )
        assert mesh.normals is not None
        uvs = np.zeros((len(mesh.vertices), 2)) if mesh.uvs is None else mesh.uvs
        shape = sapien.render.RenderShapeTriangleMesh(mesh.vertices, mesh.faces, mesh.normals, uvs, material)
        for body in visual.bodies[visual.envs == 0]:
            at = poses[0, body]
            entity = sapien.Entity()
            entity.add_component(sapien.render.RenderBodyComponent().attach(shape.clone()))
            entity.pose = sapien.Pose(at[:3], at[3:])
            scene.add_entity(entity)
    original = env._human_render_cameras["render_camera"].camera._render_cameras[0]
    set_shader_pack(PREBUILT_SHADER_CONFIGS["default"])
    copy = sapien.render.RenderCameraComponent(original.width, original.height)
    copy.set_fovy(original.fovy, compute_x=True)
    copy.near, copy.far = original.near, original.far
    holder = sapien.Entity()
    holder.add_component(copy)
    holder.pose = original.get_global_pose()
    scene.add_entity(holder)
    scene.update_render()
    copy.take_picture()
    return np.array(copy.get_picture("Albedo")[..., :3])


def test_colours_and_textures_match_the_renderers() -> None:
    """Compares albedo, the unlit colour, so only colours, textures, uvs and shapes can differ."""
    env = stock("PickCube-v1", human_render_camera_configs={"shader_pack": "default"})
    geometry = read_geometry(env, **EVERYTHING)
    textured = {v.name.split("/")[0] for v in geometry.visuals if v.material.texture is not None}
    assert textured == {"table-workspace", "ground"}
    component = env._human_render_cameras["render_camera"].camera._render_cameras[0]
    env.scene.sub_scenes[0].update_render()
    component.take_picture()
    wanted = component.get_picture("Albedo")[..., :3]
    again = redrawn(geometry, read_poses(env), env)
    difference = np.abs(again - wanted).max(axis=-1)
    assert wanted.std() > 0.1
    assert (difference > 0.02).mean() < 1e-3
    env.close()


# --- instances, cost, names ------------------------------------------------------------------------


def test_equal_shapes_of_all_envs_are_one_visual() -> None:
    env = batched("PickCube-v1", 4)
    table = scene_index(env)
    geometry = read_geometry(env)
    assert len({v.name for v in geometry.visuals}) == len(geometry.visuals)
    assert geometry.body_names == table.names and geometry.num_envs == 4
    for visual in geometry.visuals:
        assert visual.envs.tolist() == [0, 1, 2, 3], visual.name
        assert len(set(visual.bodies.tolist())) == 1
        assert visual.name.rpartition("/")[0] == table.names[visual.bodies[0]]
    (ground,) = [v for v in geometry.visuals if v.name == "ground/0"]
    assert len(ground.mesh.faces) == 2
    panda = [v for v in geometry.visuals if v.name.startswith("panda/")]
    assert 5_000 < sum(len(v.mesh.faces) for v in panda) < 15_000
    assert (
        max(max(v.material.texture.shape) for v in geometry.visuals if v.material.texture is not None) == 1024
    )
    assert [n for n, h in zip(geometry.body_names, geometry.body_hidden, strict=True) if h] == ["goal_site"]
    assert "goal_site/0" in {v.name for v in geometry.visuals}
    env.close()


def test_shapes_that_differ_between_envs_are_visuals_of_their_own_env() -> None:
    env = batched("PegInsertionSide-v1", 3)
    table = scene_index(env)
    geometry = read_geometry(env)
    peg = table.names.index("peg")
    for index, half_size in enumerate(env.peg_half_sizes.numpy()):
        worn = [v for v in geometry.visuals if index in v.envs[v.bodies == peg]]
        points = np.concatenate([v.mesh.vertices for v in worn])
        np.testing.assert_allclose(points.max(axis=0), half_size, atol=1e-6)
        np.testing.assert_allclose(points.min(axis=0), -half_size, atol=1e-6)
    env.close()


@pytest.mark.parametrize("task", ["PegInsertionSide-v1", "MS-CartpoleBalance-v1"])
def test_every_mesh_is_sound(task: str) -> None:
    env = batched(task, 2)
    for visual in read_geometry(env).visuals:
        mesh = visual.mesh
        assert mesh.vertices.dtype == np.float32 and mesh.faces.dtype == np.uint32
        assert mesh.faces.max() < len(mesh.vertices) and np.isfinite(mesh.vertices).all()
        assert mesh.normals is not None and mesh.normals.shape == mesh.vertices.shape
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-3, err_msg=visual.name)
        assert (mesh.uvs is not None) == (visual.material.texture is not None)
        assert len(mesh.faces) <= 2000
        # Faces and normals must point the same way, or the browser culls the visible side.
        corner = mesh.vertices[mesh.faces].astype(float)
        across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        with_normal = np.einsum("ij,ij->i", across, mesh.normals[mesh.faces[:, 0]])
        size = np.linalg.norm(across, axis=1)
        assert size[with_normal > 0].sum() > 0.98 * size.sum(), visual.name
    env.close()


class OddShapesEnv(PushCubeEnv):
    """Every kind of render shape, a mirrored mesh, a ghost, and textures of unusual formats."""

    mesh_file = ""

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        color = sapien.render.RenderMaterial(base_color=[0.2, 0.4, 0.6, 1.0])
        turned = sapien.Pose([0.01, 0.02, 0.03], [0.5, 0.5, 0.5, 0.5])

        def kinematic(name: str, add: Any) -> Any:
            builder = self.scene.create_actor_builder()
            builder.initial_pose = Pose.create(sapien.Pose([0, 0, 2]))
            add(builder)
            return builder.build_kinematic(name)

        kinematic("box", lambda b: b.add_box_visual(turned, half_size=[0.1, 0.2, 0.3], material=color))
        kinematic("ball", lambda b: b.add_sphere_visual(turned, radius=0.1, material=color))
        kinematic("pill", lambda b: b.add_capsule_visual(turned, radius=0.1, half_length=0.3, material=color))
        kinematic("can", lambda b: b.add_cylinder_visual(turned, radius=0.1, half_length=0.3, material=color))
        kinematic(
            "mirrored", lambda b: b.add_visual_from_file(self.mesh_file, turned, [-2.0, 1.0, 0.5], color)
        )
        ghost = kinematic("ghost", lambda b: b.add_box_visual(half_size=[0.1, 0.1, 0.1], material=color))
        ghost._objs[0].find_component_by_type(sapien.render.RenderBodyComponent).visibility = 0.25
        grey = sapien.render.RenderMaterial()
        pixels = np.zeros((4, 4, 4), np.float32)
        pixels[0], pixels[..., 3] = 0.5, 1.0
        grey.base_color_texture = sapien.render.RenderTexture2D(pixels, "R32G32B32A32Sfloat")
        kinematic("linear", lambda b: b.add_box_visual(half_size=[0.1, 0.1, 0.1], material=grey))
        wide = np.repeat(np.arange(2, dtype=np.uint8)[:, None, None] * 200, 4096, axis=1).repeat(4, axis=2)
        for name, texels in (
            ("one byte", np.full((4, 4, 1), 51, np.uint8)),
            ("bytes", PIXELS),
            ("wide", wide),
        ):
            plain = sapien.render.RenderMaterial(base_color=[1, 0, 0, 1], metallic=0.25, roughness=0.75)
            formats = {1: "R8Unorm", 4: "R8G8B8A8Unorm"}
            plain.base_color_texture = sapien.render.RenderTexture2D(texels, formats[texels.shape[-1]])
            kinematic(name, lambda b, m=plain: b.add_box_visual(half_size=[0.1, 0.1, 0.1], material=m))
        clear = sapien.render.RenderMaterial(base_color=[0.2, 0.4, 0.6, 0.0])
        kinematic("clear", lambda b: b.add_box_visual(half_size=[0.1, 0.1, 0.1], material=clear))

        def several(b: Any) -> None:
            b.add_box_visual(half_size=[0.1, 0.2, 0.3], material=color)
            b.add_box_visual(turned, half_size=[0.1, 0.2, 0.3], material=color)
            b.add_box_visual(sapien.Pose(q=[0, 1, 0, 0]), half_size=[0.1, 0.2, 0.4], material=color)
            b.add_cylinder_visual(radius=0.1, half_length=0.2, material=color)
            b.add_cylinder_visual(radius=0.1, half_length=0.3, material=color)

        kinematic("several", several)


PIXELS = np.zeros((4, 4, 4), np.uint8)
PIXELS[..., 0], PIXELS[..., 3] = 51, 102


def wedge_file(folder: Path) -> str:
    wedge = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    )
    wedge.export(folder / "wedge.obj")
    return str(folder / "wedge.obj")


@pytest.fixture
def odd_shapes(tmp_path: Path) -> Any:
    OddShapesEnv.mesh_file = wedge_file(tmp_path)
    env: Any = OddShapesEnv(render_backend=RENDER_BACKEND, reward_mode="none")
    env.reset(seed=0)
    yield env
    env.close()


def test_primitives_have_their_size_and_place(odd_shapes: Any) -> None:
    visual = {v.name: v for v in read_geometry(odd_shapes).visuals}
    half = {
        "box/0": [0.3, 0.1, 0.2],
        "ball/0": [0.1] * 3,
        "pill/0": [0.1, 0.4, 0.1],
        "can/0": [0.1, 0.3, 0.1],
    }
    for name, size in half.items():
        points = visual[name].mesh.vertices
        np.testing.assert_allclose(np.ptp(points, axis=0) / 2, size, atol=2e-3, err_msg=name)
        np.testing.assert_allclose((points.max(0) + points.min(0)) / 2, [0.01, 0.02, 0.03], atol=1e-3)
    assert visual["box/0"].material.base_color == pytest.approx((0.2, 0.4, 0.6, 1.0))
    assert visual["box/0"].material.srgb_color == pytest.approx((0.4845, 0.6652, 0.7977, 1.0), abs=1e-3)


def test_a_ghost_is_transparent_and_linear_textures_are_encoded(odd_shapes: Any) -> None:
    visual = {v.name: v for v in read_geometry(odd_shapes).visuals}
    assert visual["ghost/0"].material.base_color[3] == pytest.approx(0.25)
    texture = visual["linear/0"].material.texture
    assert texture is not None and texture.shape == (4, 4, 4)
    assert (texture[0, :, :3] == 188).all() and (texture[1:, :, :3] == 0).all()  # 0.5 linear is 188 sRGB


def test_materials_and_textures_of_other_formats_are_read(odd_shapes: Any) -> None:
    visual = {v.name: v for v in read_geometry(odd_shapes).visuals}
    one, four = visual["one byte/0"].material, visual["bytes/0"].material
    assert one.texture is not None and four.texture is not None
    encoded = round(255 * (1.055 * (51 / 255) ** (1 / 2.4) - 0.055))
    assert one.texture[0, 0].tolist() == [encoded, encoded, encoded, 255]
    assert four.texture[0, 0].tolist() == [encoded, 0, 0, 102]
    for material in (one, four):
        assert material.base_color == (1, 1, 1, 1), "a texture replaces the colour"
        assert (material.metallic, material.roughness) == (0.25, 0.75)
    assert not any(name.startswith("clear/") for name in visual), "what is invisible is left out"


def test_a_large_texture_is_scaled_by_its_longer_side(odd_shapes: Any) -> None:
    visual = {v.name: v for v in read_geometry(odd_shapes).visuals}
    texture = visual["wide/0"].material.texture
    assert texture is not None and texture.shape == (1, 1024, 4)


def test_shapes_of_a_body_are_told_apart_by_size_and_place(odd_shapes: Any) -> None:
    names = {v.name: v for v in read_geometry(odd_shapes).visuals}
    extents = [np.ptp(names[f"several/{k}"].mesh.vertices, axis=0) / 2 for k in range(4)]
    # The second is that of the body "box", which was read before.
    np.testing.assert_allclose(
        extents, [[0.1, 0.2, 0.3], [0.1, 0.2, 0.4], [0.2, 0.1, 0.1], [0.3, 0.1, 0.1]], atol=2e-3
    )
    box = names["box/0"]
    owners = [odd_shapes.scene.actors["box"], odd_shapes.scene.actors["several"]]
    index = scene_index(odd_shapes)
    assert [index.names[body] for body in box.bodies] == [owner.name for owner in owners]


class CollisionsEnv(Bare):
    """Collision shapes of every kind; the same ball as a static, a kinematic and a dynamic body."""

    mesh_file = ""

    def _load_scene(self, options: dict) -> None:
        turned = sapien.Pose([0.01, 0.02, 0.03], [0.7071068, 0, 0, 0.7071068])  # a quarter turn about z

        def built(name: str, add: Any, kind: str = "dynamic") -> None:
            builder = self.scene.create_actor_builder()
            add(builder)
            builder.initial_pose = sapien.Pose([0, 0, 2])
            builder.build_dynamic(name) if kind == "dynamic" else getattr(builder, f"build_{kind}")(name)

        for kind in ("static", "kinematic", "dynamic"):
            built(kind, lambda b: b.add_sphere_collision(radius=0.1), kind)
        built("pill", lambda b: b.add_capsule_collision(turned, radius=0.1, half_length=0.3))
        built("can", lambda b: b.add_cylinder_collision(turned, radius=0.1, half_length=0.2))
        for name, scale in (("wedge", [1.0, 1.0, 1.0]), ("mirrored", [-2.0, 1.0, 0.5])):
            built(name, lambda b, s=scale: b.add_convex_collision_from_file(self.mesh_file, scale=s))


def test_collision_shapes_have_their_size_place_and_the_colour_of_their_kind(tmp_path: Path) -> None:
    CollisionsEnv.mesh_file = wedge_file(tmp_path)
    env = batch_of(CollisionsEnv, 2)
    visual = {v.name: v for v in read_geometry(env).visuals}
    bounds = {
        "pill/0": ([-0.09, -0.38, -0.07], [0.11, 0.42, 0.13]),
        "can/0": ([-0.09, -0.18, -0.07], [0.11, 0.22, 0.13]),
        "static/0": ([-0.1] * 3, [0.1] * 3),
        "wedge/0": ([0, 0, 0], [1, 1, 1]),
        "mirrored/0": ([-2, 0, 0], [0, 1, 0.5]),
    }
    for name, (low, high) in bounds.items():
        mesh = visual[name].mesh
        np.testing.assert_allclose(mesh.vertices.min(axis=0), low, atol=3e-3, err_msg=name)
        np.testing.assert_allclose(mesh.vertices.max(axis=0), high, atol=3e-3, err_msg=name)
        assert trimesh.Trimesh(mesh.vertices, mesh.faces).volume > 0, name
        assert visual[name].envs.tolist() == [0, 1]
    colours = {visual[f"{kind}/0"].material.base_color for kind in ("static", "kinematic", "dynamic")}
    assert (
        len(colours) == 3 and visual["pill/0"].material.base_color == visual["dynamic/0"].material.base_color
    )
    env.close()


def test_without_a_renderer_the_collision_shapes_are_drawn() -> None:
    env = batched("PickCube-v1", 2, render=False)
    geometry = read_geometry(env)
    visual = {v.name: v for v in geometry.visuals}
    np.testing.assert_allclose(np.ptp(visual["cube/0"].mesh.vertices, axis=0), 0.04, atol=1e-6)
    assert {"table-workspace/0", "ground/0", "panda/panda_hand/0"} <= set(visual)
    assert 1000 < sum(len(v.mesh.faces) for v in geometry.visuals) < 10_000
    hull = visual["panda/panda_link2/0"].mesh
    rendered = batched("PickCube-v1", 1)
    whole = read_geometry(rendered, **EVERYTHING)
    link = np.concatenate([v.mesh.vertices for v in whole.visuals if v.name.startswith("panda/panda_link2/")])
    np.testing.assert_allclose(hull.vertices.min(0), link.min(0), atol=0.02)
    np.testing.assert_allclose(hull.vertices.max(0), link.max(0), atol=0.02)
    assert trimesh.Trimesh(hull.vertices, hull.faces).volume > 0
    assert not geometry.collisions
    beside = {v.name: v.mesh for v in whole.as_collisions.visuals}
    np.testing.assert_array_equal(beside["panda/panda_link2/0"].vertices, hull.vertices)
    assert "goal_site/0" in {v.name for v in whole.visuals} and "goal_site/0" not in beside
    env.close()
    rendered.close()
