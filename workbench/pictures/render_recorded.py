"""Renders a recorded scene from its shapes and poses."""

from __future__ import annotations

from typing import Any

import numpy as np
import sapien
import sapien.render
from numpy.typing import NDArray

from workbench.envs.backends import find_renderer, give_brdf_table, keep_render_device
from workbench.envs.rendering.camera_shader import DEFAULT, selected
from workbench.envs.rendering.drawing import drawing
from workbench.envs.scene.normals import with_normals
from workbench.envs.scene.shapes import Material, SceneGeometry, Visual

NEAR_METRES, FAR_METRES = 0.01, 300.0


class RecordedScene:
    """The recorded bodies of one env, as a SAPIEN scene with one camera. Needs no env, task file or physics.

    Args:
        geometry: Shapes of the bodies.
        env: Index of the env in `geometry`.
        width: Width of the pictures in pixels.
        height: Height of the pictures in pixels.
        fovy: Vertical field of view in radians.

    Raises:
        RuntimeError: this machine has nothing to render with; the message says what to install.
    """

    def __init__(self, geometry: SceneGeometry, env: int, width: int, height: int, fovy: float) -> None:
        renderer = find_renderer()
        device = "cpu" if renderer is None or renderer.render_backend == "cpu" else "cuda"
        keep_render_device(device)
        self._scene = sapien.Scene([sapien.render.RenderSystem(sapien.Device(device))])
        self._scene.set_ambient_light([0.45, 0.45, 0.47])
        self._scene.add_directional_light([-0.5, 0.35, -1.0], [1.05, 1.03, 1.0])
        self._scene.add_directional_light([0.6, -0.2, -0.5], [0.3, 0.31, 0.34])
        components: dict[int, sapien.render.RenderBodyComponent] = {}
        for visual in geometry.visuals:
            if len(visual.mesh.faces):
                for body in visual.bodies[visual.envs == env].tolist():
                    # Each body needs its own shape: SAPIEN keeps a shape only in the last body that got it.
                    components.setdefault(body, sapien.render.RenderBodyComponent()).attach(_shape(visual))
        self._bodies: dict[int, sapien.Entity] = {}
        for body, shapes in components.items():
            self._bodies[body] = entity = sapien.Entity()
            entity.add_component(shapes)
            self._scene.add_entity(entity)
        self._eye = sapien.Entity()
        camera: Any = sapien.render.RenderCameraComponent(width, height)
        camera.set_fovy(fovy)
        camera.near, camera.far = NEAR_METRES, FAR_METRES
        self._eye.add_component(camera)
        with selected(DEFAULT):
            self._scene.add_entity(self._eye)
        give_brdf_table(camera)
        self._camera = camera

    def picture(self, poses: NDArray[np.float32], eye: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Render an RGB picture (H, W, 3).

        Args:
            poses: (B, 7) poses of the bodies, position and wxyz; NaN for an absent body.
            eye: (7,) pose of the camera, x forward, y left, z up.
        """
        for body, entity in self._bodies.items():
            pose = poses[body]
            there = bool(np.isfinite(pose).all())
            entity.pose = (
                sapien.Pose(pose[:3].tolist(), pose[3:].tolist()) if there else sapien.Pose([0, 0, -1000])
            )
        self._eye.pose = sapien.Pose(eye[:3].tolist(), eye[3:].tolist())
        with drawing(("human", "film")):
            self._scene.update_render()
            self._camera.take_picture()
            colour = np.asarray(self._camera.get_picture("Color"))[..., :3]
        if colour.dtype != np.uint8:
            colour = np.rint(np.clip(colour, 0.0, 1.0) * 255).astype(np.uint8)
        return np.ascontiguousarray(colour)


def _shape(visual: Visual) -> sapien.render.RenderShapeTriangleMesh:
    mesh = visual.mesh if visual.mesh.normals is not None else with_normals(visual.mesh)
    normals: Any = mesh.normals
    uvs = mesh.uvs if mesh.uvs is not None else np.zeros((len(mesh.vertices), 2), np.float32)
    return sapien.render.RenderShapeTriangleMesh(
        mesh.vertices, mesh.faces.astype(np.uint32), normals, uvs, _material(visual.material)
    )


def _material(material: Material) -> sapien.render.RenderMaterial:
    made = sapien.render.RenderMaterial()
    made.base_color = list(material.base_color)
    made.metallic = float(material.metallic)
    made.roughness = float(material.roughness)
    if material.texture is not None:
        # SAPIEN compares the dtype by identity; an array that was received from another process has another dtype object.
        pixels = np.empty(material.texture.shape, np.uint8)
        pixels[...] = material.texture
        made.base_color_texture = sapien.render.RenderTexture2D(
            pixels, "R8G8B8A8Unorm", _levels(pixels), srgb=True
        )
    return made


def _levels(pixels: NDArray[np.uint8]) -> int:
    """Number of mipmap levels, the smallest a few pixels wide: without them, distant wood is noise."""
    return max(1, int(np.log2(min(pixels.shape[:2]))) - 2)
