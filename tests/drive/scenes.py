"""Small synthetic scenes and session views, with numbers that can be checked by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from workbench.envs.camera_data import CameraInfo, CameraKind
from workbench.envs.gpu_rules import Finding
from workbench.envs.outliers import OUTLIER_RULES
from workbench.envs.scene.shapes import BodyKind, Material, Mesh, SceneGeometry, Visual
from workbench.envs.step_result import StepResult
from workbench.live.messages import Settings
from workbench.live.view import SessionView
from workbench.record.state import RecordingStatus
from workbench.solve.questions import PlannedEnv
from workbench.task.description import ActionDimension, TaskDescription
from workbench.task.problem import Problem


def box_mesh(size: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> Mesh:
    box = trimesh.creation.box(size)
    vertices = (box.vertices[box.faces].reshape(-1, 3) + centre).astype(np.float32)
    faces = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    return Mesh(vertices, faces, np.repeat(box.face_normals, 3, axis=0).astype(np.float32))


def visual(
    name: str,
    mesh: Mesh,
    num_envs: int,
    body: int,
    colour: tuple[float, float, float, float] = (1, 1, 1, 1),
    texture: np.ndarray | None = None,
) -> Visual:
    envs = np.arange(num_envs, dtype=np.int32)
    return Visual(name, mesh, Material(colour, texture=texture), envs, np.full(num_envs, body, np.int32))


OUTLIER_FINDINGS = {rule: Finding(rule, "warn", "", None, None, "", "", 0, 0) for rule in OUTLIER_RULES}
"""`TaskDescription.outlier_rules` of a task without files."""

BODIES: tuple[tuple[str, BodyKind], ...] = (
    ("ground", "static"),
    ("table", "kinematic"),
    ("arm/hand", "link"),
    ("cube", "dynamic"),
)


def table_scene(num_envs: int) -> tuple[SceneGeometry, np.ndarray]:
    """A floor, a 1.2 x 2.4 m table, a two-part hand and a cube; and their (N, B, 7) poses."""
    ground = box_mesh((40, 40, 0.001), (0, 0, -0.92))
    visuals = (
        visual("ground/0", ground, num_envs, 0),
        visual("table/0", box_mesh((1.2, 2.4, 0.92), (0, 0, -0.46)), num_envs, 1),
        visual("arm/hand/0", box_mesh((0.1, 0.1, 0.2)), num_envs, 2),
        visual("arm/hand/1", box_mesh((0.02, 0.02, 0.3)), num_envs, 2, (0, 0, 0, 1)),
        visual("cube/0", box_mesh((0.04, 0.04, 0.04)), num_envs, 3, (1, 0, 0, 1)),
    )
    names, kinds = (tuple(column) for column in zip(*BODIES, strict=True))
    geometry = SceneGeometry(num_envs, names, kinds, (False,) * len(names), visuals)
    poses = np.zeros((num_envs, len(names), 7), np.float32)
    poses[..., 3] = 1.0
    poses[:, 2, 2] = 0.5
    poses[:, 3, :3] = np.stack([np.arange(num_envs) * 0.01, np.zeros(num_envs), np.full(num_envs, 0.02)], -1)
    return geometry, poses


def step_of(poses: np.ndarray, **evaluate: object) -> StepResult:
    count = len(poses)
    return StepResult(
        elapsed_steps=np.full(count, 7, np.int32),
        reward=np.linspace(0, 1, count, dtype=np.float32),
        terminated=np.zeros(count, bool),
        truncated=np.zeros(count, bool),
        evaluate={name: np.asarray(value) for name, value in evaluate.items()},
        poses=poses,
    )


def camera(name: str = "base_camera", kind: CameraKind = "sensor") -> CameraInfo:
    return CameraInfo(
        name, kind, 8, 6, 1.0, 0.01, 10.0, np.eye(3, dtype=np.float32), None, ("rgb", "depth", "segmentation")
    )


def description(geometry: SceneGeometry, cameras: tuple[CameraInfo, ...] = ()) -> TaskDescription:
    return TaskDescription(
        env_id="Push-v1",
        class_name="PushEnv",
        file="push.py",
        source_files=("push.py",),
        source_hash="0" * 12,
        source={"push.py": ""},
        backend="cpu (batched)",
        device="cpu",
        num_envs=geometry.num_envs,
        max_episode_steps=50,
        obs_mode="state",
        reward_mode="dense",
        control_mode="pd_joint_delta_pos",
        control_dt=0.05,
        actions=(ActionDimension("arm/joint1", -1.0, 1.0), ActionDimension("gripper", 0.0, 0.04)),
        geometry=geometry,
        cameras=cameras,
        segmentation={1: "table"},
        can_render=True,
        outlier_rules=OUTLIER_FINDINGS,
    )


EMPTY = SessionView(
    activity="a worker process", features={RecordingStatus: RecordingStatus(folder="recordings")}
)
"""View of a session that has just started."""


_PATHS = np.broadcast_to(np.arange(5, dtype=np.float32)[:, None] / 10, (3, 5, 3)).astype(np.float32)
PLAN = PlannedEnv(
    env=0,
    actions=np.zeros((1, 2), np.float32),
    horizon=4,
    returns=np.array([3.5, 2.0, 1.25, 1.0, 0.5], np.float32),
    plan=1,
    hold=3,
    success_at=np.array([3, 0, 0, 0, 0], np.int32),
    paths=_PATHS,
    drawn=(0, 2, 4),
    traced="arm/hand",
    seconds=0.25,
)
"""Five rollouts of four steps; three of them are drawn."""


def running(num_envs: int, *, selected_env: int = 0, speed: float = 1.0, **changes: object) -> SessionView:
    """View of a session that plays the table scene."""
    geometry, poses = table_scene(num_envs)
    view = replace(
        EMPTY,
        state="running",
        activity="",
        settings=Settings(speed, selected_env=selected_env),
        playing=True,
        task=description(geometry),
        task_serial=1,
        step=step_of(poses, success=np.zeros(num_envs, bool)),
        step_serial=1,
        steps_per_second=20.0,
        real_time_factor=1.0,
    )
    return changed(view, **changes)


def changed(view: SessionView, **changes: Any) -> SessionView:
    """The view with these fields, or the fields of its feature views, replaced."""
    own = {name: value for name, value in changes.items() if hasattr(EMPTY, name)}
    features = {type(value): value for name, value in changes.items() if name not in own}
    return replace(view, features={**view.features, **features}, **own)


def problem(message: str = "KeyError: 'goal'") -> Problem:
    return Problem(
        "evaluate", message, "/home/me/push.py", 88, "return goal[<0>]", "Traceback ...\nKeyError: 'goal'"
    )
