"""Which entity of a recording holds what: an `Episode` laid out for rerun.

A recording is read by people in the viewer and by programs, so where a thing lies is a contract:

- ``/world`` right-handed, z up; ``/world/<body>`` its pose, ``/world/<body>/<n>`` its static meshes;
- ``/world/cameras/<name>`` pose and pinhole, with children ``rgb``, ``depth`` and ``segmentation``;
- ``/action``, ``/reward``, ``/evaluate/<entry>``, ``/episode/{success,fail,terminated,truncated}``
  as numbers, ``/logs/events`` as text.

Two timelines index all of it: ``step``, the state's number, and ``sim_time``. Row k is what
`StepResult` k said: the state after k control steps, with the action that led there and the reward
that it earned, so the action of row k is ``episode.action[k - 1]`` and row 0 has neither.

Everything goes in as columns (one call an entity), which research measured at forty times the speed
of one call a row. Rerun writes quaternions as xyzw and cameras in the OpenCV frame (x right, y down,
z forward); ManiSkill has wxyz and x forward, y left, z up.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from PIL import Image

from workbench.core.geometry import Material, Mesh, SceneGeometry
from workbench.recording.episode import CameraTrack, Episode

STEP = "step"
SIM_TIME = "sim_time"
WORLD = "/world"
CAMERAS = "/world/cameras"
EVENTS = "/logs/events"

JPEG_QUALITY = 85
FRUSTUM_METRES = 0.12
"""How far in front of a camera its picture is drawn in the 3-D view."""
MILLIMETRES_PER_METRE = 1000.0
SERIES_COLORS = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (213, 94, 0),
    (0, 114, 178),
    (150, 150, 150),
    (136, 100, 220),
)
"""Okabe and Ito's palette, which the colour-blind can tell apart, with grey and violet for its black and
yellow: the viewer comes dark and light, and each of those vanishes on one of the two."""

_OPTICAL_FROM_CAMERA = (0.5, -0.5, 0.5, -0.5)
"""wxyz of the OpenCV camera axes (x right, y down, z forward) within ManiSkill's (x forward, y left,
z up): the rotation matrix [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]."""


@dataclass(frozen=True)
class Account:
    """What was handed to rerun, for the finished file to be held against.

    Rerun writes on threads of its own, and what those fail to write is at best a line on stderr.
    """

    rows: Counter[str] = field(default_factory=Counter)
    """Entity to number of rows in time."""
    statics: set[str] = field(default_factory=set)
    """Entities that hold something static."""


class _Log:
    """Rerun's two ways in, with an account of what went in."""

    def __init__(self, recording: rr.RecordingStream, control_dt: float) -> None:
        self._recording = recording
        self._control_dt = control_dt
        self.account = Account()

    def static(self, entity: str, values: Any) -> None:
        self._recording.log(entity, values, static=True)
        self.account.statics.add(entity)

    def columns(self, entity: str, steps: NDArray[np.int64], columns: Iterable[Any]) -> None:
        if len(steps) == 0:
            return
        times = [
            rr.TimeColumn(STEP, sequence=steps),
            # Whole nanoseconds by rounding: rerun itself cuts off, and 3 * 0.05 s would be 149999999 ns.
            rr.TimeColumn(
                SIM_TIME, duration=np.rint(steps * self._control_dt * 1e9).astype("timedelta64[ns]")
            ),
        ]
        self._recording.send_columns(entity, times, columns)
        self.account.rows[entity] += len(steps)

    def pose(
        self,
        entity: str,
        steps: NDArray[np.int64],
        translation: NDArray[np.float32],
        xyzw: NDArray[np.float32],
        still: bool,
    ) -> None:
        """`translation` (len(steps), 3) and `xyzw` (len(steps), 4); their first row alone if `still`."""
        if still:
            quaternion = rr.Quaternion(xyzw=xyzw[0])
            self.static(entity, rr.Transform3D(translation=translation[0], quaternion=quaternion))
        else:
            self.columns(entity, steps, rr.Transform3D.columns(translation=translation, quaternion=xyzw))

    def scalars(
        self,
        entity: str,
        steps: NDArray[np.int64],
        values: NDArray,
        names: Sequence[str],
        first_color: int = 0,
    ) -> None:
        """`values` (len(steps), ...) as one batched entity with a name and a colour a series."""
        flat = np.asarray(values, dtype=np.float64).reshape(len(steps), len(names))
        if flat.shape[1] == 0:
            return
        # Left to itself rerun gives all series of an entity one colour, and entities of one folder much the same.
        colors = [SERIES_COLORS[(first_color + index) % len(SERIES_COLORS)] for index in range(len(names))]
        self.static(entity, rr.SeriesLines(names=list(names), colors=colors))
        columns = rr.Scalars.columns(scalars=flat.reshape(-1))
        self.columns(entity, steps, columns.partition([flat.shape[1]] * len(flat)))


def log_episode(recording: rr.RecordingStream, episode: Episode) -> Account:
    """Hand the whole of `episode` to `recording`; returns the account of it."""
    log = _Log(recording, episode.info.control_dt)
    _log_bodies(log, episode)
    _log_cameras(log, episode)
    _log_numbers(log, episode)
    _log_events(log, episode)
    return log.account


# --- names ----------------------------------------------------------------------------------------


def body_entities(geometry: SceneGeometry) -> tuple[str, ...]:
    """(B,) entity path of each body: ``/world/<actor>`` or ``/world/<articulation>/<link>``.

    Rerun composes the transforms of nested entities, so no body may lie below another one: an actor
    that is called like an articulation, or like the folder of the cameras, gets an underscore.
    """
    names = [tuple(part for part in name.split("/") if part) or ("unnamed",) for name in geometry.body_names]
    names = [("cameras_", *name[1:]) if name[0] == "cameras" else name for name in names]
    folders = {name[:depth] for name in names for depth in range(1, len(name))}
    taken: set[tuple[str, ...]] = set()
    entities: list[str] = []
    for name in names:
        while name in folders or name in taken:
            name = (*name[:-1], name[-1] + "_")
        taken.add(name)
        entities.append(rr.new_entity_path(["world", *name]))
    return tuple(entities)


def camera_entities(cameras: Sequence[CameraTrack]) -> tuple[str, ...]:
    """Entity path of each camera; a human-render camera gives way to a sensor of the same name."""
    taken: set[str] = set()
    entities = [""] * len(cameras)
    for index in sorted(range(len(cameras)), key=lambda i: cameras[i].info.kind != "sensor"):
        name = cameras[index].info.name or "unnamed"
        while name in taken:
            name += f"_{cameras[index].info.kind}"
        taken.add(name)
        entities[index] = rr.new_entity_path(["world", "cameras", name])
    return tuple(entities)


def evaluate_entity(name: str) -> str:
    return rr.new_entity_path(["evaluate", name or "unnamed"])


# --- bodies ---------------------------------------------------------------------------------------


def _log_bodies(log: _Log, episode: Episode) -> None:
    log.static(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    steps = np.arange(len(episode.poses), dtype=np.int64)
    entities = body_entities(episode.geometry)
    present: NDArray[np.bool_] = np.any(np.isfinite(episode.poses), axis=(0, 2))
    for body, entity in enumerate(entities):
        if not present[body]:
            continue
        poses = episode.poses[:, body]
        still = episode.geometry.body_kinds[body] == "static" and is_constant(poses)
        log.pose(entity, steps, poses[:, :3], xyzw(poses[:, 3:]), still)
    worn: Counter[int] = Counter()
    for visual in episode.geometry.visuals:
        mesh = _mesh(visual.mesh, visual.material) if episode.info.env_index in visual.envs else None
        if mesh is None:
            continue
        for body in visual.bodies[visual.envs == episode.info.env_index]:
            if present[body]:
                log.static(f"{entities[body]}/{worn[int(body)]}", mesh)
                worn[int(body)] += 1


def _mesh(mesh: Mesh, material: Material) -> rr.Mesh3D | None:
    if len(mesh.faces) == 0:
        return None
    # SAPIEN and rerun agree on uv: v = 0 is the first row of the texture, and beyond 0..1 it repeats.
    texture = None if material.texture is None or mesh.uvs is None else material.texture[..., :3]
    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        vertex_normals=mesh.normals,
        vertex_texcoords=None if texture is None else mesh.uvs,
        albedo_texture=None if texture is None else np.ascontiguousarray(texture),
        albedo_factor=np.rint(np.clip(material.srgb_color, 0.0, 1.0) * 255).astype(np.uint8),
    )


# --- cameras --------------------------------------------------------------------------------------


def _log_cameras(log: _Log, episode: Episode) -> None:
    if not episode.cameras:
        return
    names = {0: "background", **episode.segmentation}
    # Class ids are 16 bit in rerun; a name beyond that has nowhere to go (ManiSkill's ids are int16).
    classes = [(int(id_), name) for id_, name in sorted(names.items()) if 0 <= id_ <= 0xFFFF]
    log.static(CAMERAS, rr.AnnotationContext([(*c, (0, 0, 0)) if c[0] == 0 else c for c in classes]))
    for camera, entity in zip(episode.cameras, camera_entities(episode.cameras)):
        translation, quaternion = optical_pose(camera.pose)
        log.pose(entity, camera.frame, translation, quaternion, still=is_constant(camera.pose))
        pinhole = rr.Pinhole(
            image_from_camera=camera.info.intrinsic,
            resolution=[camera.info.width, camera.info.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=FRUSTUM_METRES,
        )
        log.static(entity, pinhole)
        _log_pictures(log, entity, camera)


def _log_pictures(log: _Log, entity: str, camera: CameraTrack) -> None:
    if camera.rgb is not None:
        rgb = f"{entity}/rgb"
        log.static(rgb, rr.EncodedImage.from_fields(media_type="image/jpeg"))
        log.columns(
            rgb, camera.frame, rr.EncodedImage.columns(blob=[encode_jpeg(image) for image in camera.rgb])
        )
    if camera.depth is not None:
        depth = f"{entity}/depth"
        meter = rr.EncodedDepthImage.from_fields(media_type="image/png", meter=MILLIMETRES_PER_METRE)
        log.static(depth, meter)
        blobs = [encode_depth_png(image) for image in camera.depth]
        log.columns(depth, camera.frame, rr.EncodedDepthImage.columns(blob=blobs))
    if camera.segmentation is not None:
        segmentation = f"{entity}/segmentation"
        small = camera.segmentation.min() >= 0 and camera.segmentation.max() <= 0xFFFF
        ids = np.ascontiguousarray(camera.segmentation, dtype=np.uint16 if small else np.int32)
        height, width = ids.shape[1:]
        form = rr.components.ImageFormat(
            width=width,
            height=height,
            channel_datatype=rr.ChannelDatatype.from_np_dtype(ids.dtype),
        )
        log.static(segmentation, rr.SegmentationImage.from_fields(format=form))
        buffers = ids.reshape(len(ids), -1).view(np.uint8)
        log.columns(segmentation, camera.frame, rr.SegmentationImage.columns(buffer=buffers))


def encode_jpeg(image: NDArray[np.uint8]) -> bytes:
    """(H, W, 3) as JPEG, colour at full resolution (the edges of small pictures blur otherwise)."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="JPEG", quality=JPEG_QUALITY, subsampling=0)
    return buffer.getvalue()


def encode_depth_png(depth: NDArray[np.float32]) -> bytes:
    """(H, W) metres as 16-bit PNG in millimetres, which is what ManiSkill itself measures in.

    What is not a distance (NaN, infinite, behind the camera) becomes 0, "nothing"; 65.535 m is the
    farthest that 16 bits hold, and what is farther stays there.
    """
    millimetres = np.nan_to_num(depth * MILLIMETRES_PER_METRE, nan=0.0, posinf=0.0, neginf=0.0)
    buffer = io.BytesIO()
    Image.fromarray(np.rint(np.clip(millimetres, 0, 0xFFFF)).astype(np.uint16)).save(
        buffer, format="PNG", compress_level=3
    )
    return buffer.getvalue()


# --- numbers and words ----------------------------------------------------------------------------


def _log_numbers(log: _Log, episode: Episode) -> None:
    states = np.arange(len(episode.poses), dtype=np.int64)
    transitions = states[1:]
    log.scalars("/action", transitions, episode.action, episode.action_names)
    log.scalars("/reward", transitions, episode.reward, ["reward"])
    drawn = 0
    for name, values in episode.evaluate.items():
        series = [name]
        if values.ndim > 1:
            series = [f"{name}[{', '.join(map(str, index))}]" for index in np.ndindex(values.shape[1:])]
        log.scalars(evaluate_entity(name), states, values, series, first_color=drawn)
        drawn += len(series)
    for name in ("success", "fail"):
        if is_flag(episode, name):
            log.scalars(f"/episode/{name}", states, episode.evaluate[name], [name])
    log.scalars("/episode/terminated", transitions, episode.terminated, ["terminated"])
    log.scalars("/episode/truncated", transitions, episode.truncated, ["truncated"])


def is_flag(episode: Episode, name: str) -> bool:
    """Whether ``evaluate()`` gave one number a step under `name`, as it should for ``success``."""
    return name in episode.evaluate and episode.evaluate[name].ndim == 1


def flag(episode: Episode, name: str) -> NDArray[np.bool_]:
    """(T + 1,) `name` of ``evaluate()`` as yes or no; a step that lacks it says no."""
    if not is_flag(episode, name):
        return np.zeros(len(episode.poses), dtype=np.bool_)
    return np.nan_to_num(episode.evaluate[name].astype(np.float64)) != 0


def events(episode: Episode) -> list[tuple[int, str, str]]:
    """(step, level, text) of every moment at which something began, in order of time."""
    found = [(0, "INFO", f"reset with seed {episode.info.seed}" if episode.info.seed >= 0 else "reset")]
    for name, level in (("success", "INFO"), ("fail", "WARN")):
        found += [(step, level, name) for step in _onsets(flag(episode, name))]
    for name, values in (("terminated", episode.terminated), ("truncated", episode.truncated)):
        found += [(step, "INFO", name) for step in _onsets(np.concatenate([[False], values]))]
    return sorted(found, key=lambda event: event[0])


def _onsets(values: NDArray[np.bool_]) -> list[int]:
    before = np.concatenate([[False], values[:-1]])
    return np.flatnonzero(values & ~before).tolist()


def _log_events(log: _Log, episode: Episode) -> None:
    steps, levels, texts = zip(*events(episode))
    columns = rr.TextLog.columns(text=list(texts), level=list(levels))
    log.columns(EVENTS, np.array(steps, dtype=np.int64), columns)


def is_constant(rows: NDArray) -> bool:
    return bool(np.all(rows == rows[:1]))


# --- frames ---------------------------------------------------------------------------------------


def xyzw(wxyz: NDArray) -> NDArray:
    """(..., 4) quaternions from our order to rerun's."""
    return np.roll(wxyz, -1, axis=-1)


def optical_pose(pose: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Translation (P, 3) and xyzw (P, 4) of the OpenCV camera frame, from ManiSkill poses (P, 7)."""
    w, x, y, z = pose[:, 3:].astype(np.float64).T
    a, b, c, d = _OPTICAL_FROM_CAMERA
    product = [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]
    return pose[:, :3], xyzw(np.stack(product, axis=-1)).astype(np.float32)
