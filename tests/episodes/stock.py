"""Short episodes of stock ManiSkill tasks: real physics, and pictures of a fixed and of a mounted camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  (registers the tasks)
import numpy as np
from numpy.typing import NDArray

from tests.drive.episodes import Made, Track
from tests.drive.render_device import RENDER_BACKEND
from workbench.envs.camera_data import CameraInfo
from workbench.envs.scene.read_scene import read_geometry
from workbench.envs.scene.scene_index import read_poses
from workbench.episodes.episode import EpisodeInfo

STEPS = 8
SEED = 3
SIZE_PIXELS = 96


@dataclass(frozen=True)
class Recorded:
    """An episode, and ManiSkill's own parameters of its cameras at each of the T + 1 states."""

    episode: Made
    extrinsic_cv: dict[str, NDArray[np.float32]]
    """Camera name to (T + 1, 3, 4)."""
    intrinsic_cv: dict[str, NDArray[np.float32]]
    """Camera name to (T + 1, 3, 3)."""
    depth_mm: dict[str, NDArray[np.int16]]
    """Camera name to (T + 1, H, W)."""


def record_stock(task: str, size: int = SIZE_PIXELS, steps: int = STEPS, **kwargs: Any) -> Recorded:
    """Record `steps` random steps of a stock single env."""
    env = gym.make(
        task,
        num_envs=1,
        obs_mode="rgb+depth+segmentation",
        render_backend=RENDER_BACKEND,
        sensor_configs={"width": size, "height": size},
        **kwargs,
    )
    try:
        return _play(env, task, steps)
    finally:
        env.close()


def _play(env: gym.Env, task: str, steps: int) -> Recorded:
    base: Any = env.unwrapped
    obs, _ = env.reset(seed=SEED)
    seen = [obs]
    states = [_state(base)]
    outcomes: list[tuple[NDArray, float, bool, bool]] = []
    env.action_space.seed(SEED)
    for _ in range(steps):
        action = env.action_space.sample()
        obs, reward, ended, cut, _ = env.step(action)
        seen.append(obs)
        states.append(_state(base))
        outcomes.append((action, float(reward), bool(ended), bool(cut)))

    def of_cameras(group: str, key: str) -> dict[str, NDArray]:
        return {name: np.stack([o[group][name][key][0].numpy() for o in seen]) for name in base._sensors}

    rgb, depth, ids = (of_cameras("sensor_data", key) for key in ("rgb", "depth", "segmentation"))
    tracks = [
        Track(
            _camera_info(name, sensor, obs),
            np.arange(steps + 1),
            np.stack([state["camera poses"][name] for state in states]),
            rgb[name],
            (depth[name][..., 0] / np.float32(1000)).astype(np.float32),
            ids[name][..., 0].astype(np.int32),
        )
        for name, sensor in base._sensors.items()
    ]
    actions, rewards, ended, cut = zip(*outcomes)
    episode = Made(
        info=EpisodeInfo(
            task=task,
            env_index=0,
            seed=SEED,
            source_file="some/folder/task.py",
            source_hash="0123456789ab",
            acted_by=((0, "random"), (5, "sliders")),
            source={"some/folder/task.py": "class Task: ...\n", "some/folder/parts.py": "SIZE = 2\n"},
            control_dt=base.control_timestep,
            control_mode=base.control_mode,
            backend="cpu",
            versions={"mani_skill": "3.0.1", "rerun-sdk": "0.41.0"},
            env_kwargs={"robot_uids": "panda_wristcam"},
            max_episode_steps=50,
        ),
        geometry=read_geometry(base),
        segmentation={int(key): body.name for key, body in base.segmentation_id_map.items()},
        poses=np.stack([state["poses"] for state in states]),
        action=np.stack(actions).astype(np.float32),
        action_names=tuple(f"action{index}" for index in range(len(actions[0]))),
        reward=np.array(rewards, dtype=np.float32),
        terminated=np.array(ended),
        truncated=np.array(cut),
        evaluate=stacked([state["evaluate"] for state in states]),
        cameras=tracks,
        env_states=stacked([state["env_states"] for state in states]),
        obs=stacked([flat({"agent": o["agent"], "extra": o["extra"]}) for o in seen]),
    )
    return Recorded(
        episode=episode,
        extrinsic_cv=of_cameras("sensor_param", "extrinsic_cv"),
        intrinsic_cv=of_cameras("sensor_param", "intrinsic_cv"),
        depth_mm={name: values[..., 0] for name, values in depth.items()},
    )


def _state(base: Any) -> dict[str, Any]:
    return {
        "poses": read_poses(base)[0].copy(),
        "evaluate": {key: value[0].numpy().copy() for key, value in base.evaluate().items()},
        "env_states": flat(base.get_state_dict()),
        "camera poses": {
            name: sensor.camera.get_global_pose().raw_pose[0].numpy().copy()
            for name, sensor in base._sensors.items()
        },
    }


def flat(nested: Any, prefix: str = "") -> dict[str, NDArray]:
    """Env 0 of a tensor (1, ...), or of nested ones by their path."""
    if isinstance(nested, dict):
        return {
            key: value for name in nested for key, value in flat(nested[name], f"{prefix}/{name}").items()
        }
    return {prefix.lstrip("/"): nested[0].numpy().copy()}


def stacked(rows: list[dict[str, NDArray]]) -> dict[str, NDArray]:
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def _camera_info(name: str, sensor: Any, obs: dict[str, Any]) -> CameraInfo:
    config = sensor.config
    return CameraInfo(
        name=name,
        kind="sensor",
        width=config.width,
        height=config.height,
        fovy=float(config.fov),
        near=config.near,
        far=config.far,
        intrinsic=obs["sensor_param"][name]["intrinsic_cv"][0].numpy(),
        mount=config.mount.name if config.mount is not None else config.entity_uid,
        modalities=("rgb", "depth", "segmentation"),
    )
