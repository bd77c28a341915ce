"""A short, real episode: stock ManiSkill, real physics and pictures of a real camera."""

from __future__ import annotations

import os

# Before rerun is imported anywhere: without it rerun turns what it refuses into warnings.
os.environ["RERUN_STRICT"] = "1"

from dataclasses import dataclass  # noqa: E402
from typing import Any  # noqa: E402

import gymnasium as gym  # noqa: E402
import mani_skill.envs  # noqa: E402, F401  (registers the tasks)
import numpy as np  # noqa: E402
import pytest  # noqa: E402
import sapien.render  # noqa: E402
import torch  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from workbench.core.geometry import Material, Mesh, SceneGeometry, Visual  # noqa: E402
from workbench.core.pictures import CameraInfo, Picture  # noqa: E402
from workbench.core.step import StepResult  # noqa: E402
from workbench.recording.columns import EpisodeBuilder  # noqa: E402
from workbench.recording.episode import Episode, EpisodeInfo  # noqa: E402

STEPS = 8
SEED = 3


@dataclass(frozen=True)
class Recorded:
    episode: Episode
    extrinsic_cv: NDArray[np.float32]
    """(T + 1, 3, 4) of ``base_camera``, by ManiSkill itself."""
    intrinsic_cv: NDArray[np.float32]
    """(T + 1, 3, 3)"""
    depth_mm: NDArray[np.int16]
    """(T + 1, H, W) as ManiSkill gave it."""


@pytest.fixture(scope="session")
def recorded() -> Recorded:
    return record_stock("PickCube-v1")


def record_stock(task: str, size: int = 96, steps: int = STEPS, **kwargs: Any) -> Recorded:
    """`steps` random steps of a stock single env, through `EpisodeBuilder`."""
    env = gym.make(
        task,
        num_envs=1,
        obs_mode="rgb+depth+segmentation",
        render_backend="cpu",
        sensor_configs={"width": size, "height": size},
        **kwargs,
    )
    try:
        return _play(env, task, size, steps)
    finally:
        env.close()


def _play(env: gym.Env, task: str, size: int, steps: int) -> Recorded:
    base: Any = env.unwrapped
    obs, _ = env.reset(seed=SEED)
    env.action_space.seed(SEED)
    geometry, bodies = scene_of(base)
    params, depths = [], []

    def pictures() -> list[Picture]:
        found = []
        for name, images in obs["sensor_data"].items():
            depth = images["depth"][0, ..., 0].numpy()
            depths.append(depth)
            params.append({key: value[0].numpy().copy() for key, value in obs["sensor_param"][name].items()})
            found.append(
                Picture(
                    camera=name,
                    kind="sensor",
                    env=0,
                    pose=base._sensors[name].camera.get_global_pose().raw_pose[0].numpy().copy(),
                    rgb=images["rgb"][0].numpy(),
                    depth=depth.astype(np.float32) / 1000,
                    segmentation=images["segmentation"][0, ..., 0].numpy().astype(np.int32),
                )
            )
        return found

    def state(action: NDArray | None, reward: float = 0.0, ended: bool = False, cut: bool = False) -> StepResult:
        return StepResult(
            elapsed_steps=base.elapsed_steps.numpy().astype(np.int32).reshape(1),
            reward=np.array([reward], dtype=np.float32),
            terminated=np.array([ended]),
            truncated=np.array([cut]),
            evaluate={key: value.numpy().copy() for key, value in base.evaluate().items()},
            poses=np.stack([[body.pose.raw_pose[0].numpy() for body in bodies]]).astype(np.float32),
            action=None if action is None else action.astype(np.float32)[None],
        )

    camera = base._sensors["base_camera"]
    first = pictures()
    info = CameraInfo(
        name="base_camera",
        kind="sensor",
        width=size,
        height=size,
        fovy=float(camera.config.fov),
        near=camera.config.near,
        far=camera.config.far,
        intrinsic=params[0]["intrinsic_cv"],
        mount=None,
        modalities=("rgb", "depth", "segmentation"),
    )
    builder = EpisodeBuilder(
        EpisodeInfo(
            task=task,
            env_index=0,
            seed=SEED,
            source_file="some/folder/task.py",
            source_hash="0123456789ab",
            source={"some/folder/task.py": "class Task: ...\n", "some/folder/parts.py": "SIZE = 2\n"},
            control_dt=base.control_timestep,
            control_mode=base.control_mode,
            backend="cpu",
            versions={"mani_skill": "3.0.1", "rerun-sdk": "0.41.0"},
        ),
        geometry,
        {int(key): body.name for key, body in base.segmentation_id_map.items()},
        [f"action{index}" for index in range(env.action_space.shape[-1])],
        [info],
    )
    builder.start(state(None), 0, first)
    for _ in range(steps):
        action = env.action_space.sample()
        obs, reward, ended, cut, _ = env.step(action)
        builder.append(state(action, float(reward), bool(ended), bool(cut)), 0, pictures())
    return Recorded(
        episode=builder.finish(),
        extrinsic_cv=np.stack([param["extrinsic_cv"] for param in params]),
        intrinsic_cv=np.stack([param["intrinsic_cv"] for param in params]),
        depth_mm=np.stack(depths),
    )


def scene_of(base: Any) -> tuple[SceneGeometry, list[Any]]:
    """What the bodies of a stock single env look like, and the bodies."""
    named = [(actor.name, actor.px_body_type, actor)
             for actor in base.scene.actors.values()]
    for articulation in base.scene.articulations.values():
        named += [(f"{articulation.name}/{link.name}", "link", link) for link in articulation.links]
    visuals = []
    for index, (name, _, body) in enumerate(named):
        entity = body._objs[0] if hasattr(body._objs[0], "find_component_by_type") else body._objs[0].entity
        rendered = entity.find_component_by_type(sapien.render.RenderBodyComponent)
        for shape in rendered.render_shapes if rendered is not None else []:
            parts = shape.parts if isinstance(shape, sapien.render.RenderShapeTriangleMesh) else [shape]
            for part in parts:
                visuals.append(_visual(f"{name}/{len(visuals)}", shape, part, index))
    geometry = SceneGeometry(
        num_envs=1,
        body_names=tuple(name for name, _, _ in named),
        body_kinds=tuple(kind for _, kind, _ in named),  # type: ignore[misc]
        body_hidden=tuple(body in base._hidden_objects for _, _, body in named),
        visuals=tuple(visuals),
    )
    return geometry, [body for _, _, body in named]


def _scale(shape: Any) -> NDArray[np.float32]:
    """SAPIEN keeps its primitives as unit shapes, all but the capsule."""
    if isinstance(shape, sapien.render.RenderShapeBox):
        return np.asarray(shape.half_size, dtype=np.float32)
    if isinstance(shape, sapien.render.RenderShapeSphere):
        return np.full(3, shape.radius, dtype=np.float32)
    if isinstance(shape, sapien.render.RenderShapeCylinder):
        return np.array([shape.half_length, shape.radius, shape.radius], dtype=np.float32)
    return np.asarray(getattr(shape, "scale", (1, 1, 1)), dtype=np.float32)


def _visual(name: str, shape: Any, part: Any, body: int) -> Visual:
    local = shape.local_pose.to_transformation_matrix()
    scale = _scale(shape)
    vertices = (part.vertices * scale) @ local[:3, :3].T + local[:3, 3]
    normals = part.get_vertex_normal() @ local[:3, :3].T
    uvs = part.get_vertex_uv()
    color = part.material.base_color_texture
    texture = None
    if color is not None and len(uvs) == len(vertices):
        texture = color.download()
        if texture.dtype != np.uint8:
            texture = (np.clip(texture, 0, 1) * 255).astype(np.uint8)
    return Visual(
        name=name,
        mesh=Mesh(
            vertices=vertices.astype(np.float32),
            faces=part.triangles.astype(np.uint32),
            normals=normals.astype(np.float32) if len(normals) == len(vertices) else None,
            uvs=uvs.astype(np.float32) if texture is not None else None,
        ),
        material=Material(base_color=tuple(part.material.base_color), texture=texture),
        envs=np.zeros(1, dtype=np.int32),
        bodies=np.array([body], dtype=np.int32),
    )


torch.set_num_threads(1)
