"""Which entity of a recording holds what: an episode laid out for rerun.

A recording is read by people in the viewer and by programs, so where a thing lies is a contract:

- ``/world`` right-handed, z up; ``/world/<body>`` its pose, ``/world/<body>/<n>`` its static meshes;
- ``/world/cameras/<name>`` pose and pinhole, with children ``rgb``, ``depth`` and ``segmentation``;
- ``/action``, ``/reward`` and ``/reward/<term>``, ``/evaluate/<entry>``, ``/batch/<entry>`` for numbers that ``evaluate()``
  returned without a row for each env, ``/observation/state``,
  ``/episode/{success,fail,terminated,truncated}`` as numbers, ``/logs/events`` and ``/logs/evaluate`` as text.

Two timelines index all of it: ``step``, the state's number, and ``sim_time``. Row k is what
`StepResult` k said: the state after k control steps, with the action that led there and the reward
that it earned, so the action of row k is ``episode.action[k - 1]`` and row 0 has neither.

A row of numbers or of a pose that is between two equal ones is left out (`rerun_chunks.changed_rows`): the state before it says what it is.

Everything goes in as columns (one call an entity), which research measured at forty times the speed
of one call a row. Rerun writes quaternions as xyzw and cameras in the OpenCV frame (x right, y down,
z forward); ManiSkill has wxyz and x forward, y left, z up.
"""

from __future__ import annotations

import math
import threading
import weakref
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk
from transforms3d.quaternions import qconjugate, qmult

from workbench.core.camera_data import CameraInfo
from workbench.core.scene.shapes import Material, Mesh, SceneGeometry, Visual
from workbench.recording.episode.encoded_pictures import MILLIMETRES_PER_METRE, Modality, decode
from workbench.recording.episode.episode import CameraTrack, Episode, camera_names
from workbench.recording.rerun.chunks import TimedChunks, series_chunk, static_chunk, static_pose

WORLD = "/world"
CAMERAS = "/world/cameras"
LOGS = "/logs"
EVENTS = "/logs/events"
ENTRY_TEXTS = "/logs/evaluate"
OBSERVATION = "/observation/state"
"""All observations but pictures as one batch, as LeRobot has them: an entity each would be 5 kB a file and 40 B a step."""
REWARD_TERMS = "reward_terms/"
"""What an entry of ``evaluate()`` begins with that is a part of the reward."""

_MOST_PIXELS, _MOST_PICTURES = 1 << 20, 1024
"""Of the pictures of one chunk, which are in memory together."""
_PNG_RGBA = 6
"""Colour type of a PNG, its byte 25 (PNG specification, section 11.2.1)."""
FRUSTUM_METRES = 0.12
"""How far in front of a camera its picture is drawn in the 3-D view."""
_XYZW = [0, 1, 2, 4, 5, 6, 3]
"""Of a pose: rerun's order of a quaternion from ours."""
_OPTICAL_FROM_CAMERA = (0.5, -0.5, 0.5, -0.5)
"""wxyz of the OpenCV camera axes (x right, y down, z forward) within ManiSkill's (x forward, y left,
z up): the rotation matrix [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]."""


def chunks(episode: Episode) -> Iterator[Chunk]:
    """All of an episode that has a scene, what does not change first; of its pictures some at a time.

    Raises:
        ValueError: rerun refuses something in it.
        OSError: one of its pictures cannot be read.
    """
    geometry, poses = episode.geometry, episode.poses
    assert geometry is not None and poses is not None
    still, present = _never_moves(poses), np.asarray(np.isfinite(poses).any(axis=(0, 2)))
    bodies = {body: entity for body, entity in enumerate(body_entities(geometry)) if present[body]}
    cameras = list(zip(episode.cameras, camera_entities([camera.info for camera in episode.cameras])))
    numbers, pieces = _numbers(episode), _pieces(episode.cameras)
    ids = _ids(episode.cameras, pieces)
    yield _world()
    for body, entity in bodies.items():
        if still[body]:
            yield static_pose(entity, poses[0, body, :3], xyzw(poses[0, body, 3:]))
    yield from _meshes(geometry, episode.info.env_index, bodies)
    if cameras:
        yield _classes(episode.segmentation)
    for (camera, entity), kind in zip(cameras, ids):
        yield from _lens(camera, entity, kind)
    yield from _series(numbers)
    timed = TimedChunks(episode.info.control_dt)
    yield _log(timed, EVENTS, events(episode))
    if episode.texts:
        yield _log(timed, ENTRY_TEXTS, _texts(episode))
    states = np.arange(len(poses), dtype=np.int64)
    moving = {body: entity for body, entity in bodies.items() if not still[body]}
    yield from timed.poses(list(moving.values()), states, poses[:, list(moving)][..., _XYZW])
    for camera, entity in cameras:
        if not _never_moves(camera.pose):
            pose = np.concatenate(optical_pose(camera.pose), axis=1)
            yield from timed.poses([entity], camera.frame, pose[:, None])
    for entity, _, values in numbers:
        if values.size:
            yield timed.scalars(entity, states[len(states) - len(values) :], values)
    for number, some in pieces:
        camera, entity = cameras[number]
        for modality, pictures in camera.pictures.items():
            columns = _picture_columns(modality, pictures.blobs[some], ids[number])
            yield timed.of(f"{entity}/{modality}", camera.frame[some], columns)


def _never_moves(poses: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(...) of poses (R, ..., 7): whether it never moved."""
    bits = poses.view(np.int32)  # a NaN is no movement
    return np.asarray((bits == bits[0]).all(axis=(0, -1)))


def _pieces(cameras: Sequence[CameraTrack]) -> list[tuple[int, slice]]:
    """Which pictures of which camera go into one chunk, in order of time."""
    found = []
    for number, camera in enumerate(cameras):
        many = min(max(_MOST_PIXELS // (camera.info.width * camera.info.height), 1), _MOST_PICTURES)
        for begin in range(0, len(camera.frame), many):
            found.append((camera.frame[begin], number, slice(begin, begin + many)))
    return [(number, some) for _, number, some in sorted(found, key=lambda piece: piece[:2])]


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


def camera_entities(cameras: Sequence[CameraInfo]) -> tuple[str, ...]:
    """Entity path of each camera."""
    return tuple(rr.new_entity_path(["world", "cameras", name]) for name in camera_names(cameras))


def evaluate_entity(name: str) -> str:
    """Of an entry of ``evaluate()``; the terms of the reward, as the task names them, lie below ``/reward``."""
    if name.startswith(REWARD_TERMS):
        return rr.new_entity_path(["reward", name[len(REWARD_TERMS) :] or "unnamed"])
    return rr.new_entity_path(["evaluate", name or "unnamed"])


def batch_entity(name: str) -> str:
    """Of an entry of ``evaluate()`` that is a number of the whole batch."""
    return rr.new_entity_path(["batch", name or "unnamed"])


# --- scene ----------------------------------------------------------------------------------------


def _meshes(geometry: SceneGeometry, env: int, bodies: Mapping[int, str]) -> Iterator[Chunk]:
    worn: Counter[int] = Counter()
    for visual in geometry.visuals:
        for body in map(int, visual.bodies[visual.envs == env]):
            if body in bodies and (drawn := _drawn(visual, f"{bodies[body]}/{worn[body]}")) is not None:
                yield drawn
                worn[body] += 1


@cache
def _world() -> Chunk:
    return static_chunk(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)


_made: dict[int, tuple[weakref.ref[Visual], dict[str, Chunk | None]]] = {}
"""What `_drawn` made, by the visual's id, for as long as the visual lives: episodes follow each other in one scene, and its textures
are megabytes to convert."""
_MOST_MADE = 64
"""Of one visual. In a scene that names its bodies by env each env has an entity, and a copy, of its own."""
_making = threading.Lock()
"""Several threads make files, of episodes of one scene too."""


def _drawn(visual: Visual, entity: str) -> Chunk | None:
    """`visual` as rerun is to have it at `entity`; None where it has no triangles."""
    key = id(visual)
    with _making:
        held = _made.get(key)
        if held is None or held[0]() is not visual:
            held = _made[key] = (weakref.ref(visual, lambda _: _made.pop(key, None)), {})
        made = held[1]
        if entity not in made:
            chunk = next((chunk for chunk in made.values() if chunk is not None), None)
            if len(made) >= _MOST_MADE:
                made.clear()
            made[entity] = _visual_chunk(visual, entity) if chunk is None else chunk.with_entity_path(entity)
        return made[entity]


def _visual_chunk(visual: Visual, entity: str) -> Chunk | None:
    mesh = _mesh(visual.mesh, visual.material)
    if mesh is None:
        return None
    # What rerun's mesh does not say, for whoever reads the scene back. With types: rerun takes those of the first value in
    # the process for all that follow, so behind a colour of whole numbers every other one would be cut down to 0 or 1.
    material = visual.material
    said = rr.AnyValues(
        visual=visual.name,
        base_color=pa.array(material.base_color, pa.float64()),
        metallic=pa.array([material.metallic], pa.float64()),
        roughness=pa.array([material.roughness], pa.float64()),
    )
    return static_chunk(entity, mesh, said)


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


def _classes(segmentation: Mapping[int, str]) -> Chunk:
    names = {0: "background", **segmentation}
    # Class ids are 16 bit in rerun; a name beyond that has nowhere to go (ManiSkill's ids are int16).
    classes = [(int(id_), name) for id_, name in sorted(names.items()) if 0 <= id_ <= 0xFFFF]
    return static_chunk(CAMERAS, rr.AnnotationContext([(*c, (0, 0, 0)) if c[0] == 0 else c for c in classes]))


def _lens(camera: CameraTrack, entity: str, ids: np.dtype) -> Iterator[Chunk]:
    info = camera.info
    if _never_moves(camera.pose):
        translation, quaternion = optical_pose(camera.pose[:1])
        yield static_pose(entity, translation[0], quaternion[0])
    pinhole = rr.Pinhole(
        image_from_camera=info.intrinsic,
        resolution=[info.width, info.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=FRUSTUM_METRES,
    )
    yield static_chunk(entity, pinhole)
    if camera.rgb is not None:
        yield static_chunk(f"{entity}/rgb", rr.EncodedImage.from_fields(media_type="image/jpeg"))
    if camera.depth is not None:
        meter = rr.EncodedDepthImage.from_fields(media_type="image/png", meter=MILLIMETRES_PER_METRE)
        yield static_chunk(f"{entity}/depth", meter)
    if camera.segmentation is not None:
        form = rr.components.ImageFormat(
            width=info.width, height=info.height, channel_datatype=rr.ChannelDatatype.from_np_dtype(ids)
        )
        yield static_chunk(f"{entity}/segmentation", rr.SegmentationImage.from_fields(format=form))


def _ids(cameras: Sequence[CameraTrack], pieces: Iterable[tuple[int, slice]]) -> list[np.dtype]:
    """Of the segmentation of each camera; wide where one of its pictures has ids that 16 bits do not hold."""
    wide = set()
    for number, some in pieces:
        held = cameras[number].segmentation
        if held is not None and any(blob[25] == _PNG_RGBA for blob in held.blobs[some]):
            wide.add(number)
    return [np.dtype(np.int32 if number in wide else np.uint16) for number in range(len(cameras))]


def _picture_columns(modality: Modality, blobs: Sequence[bytes], kind: np.dtype) -> Iterable[Any]:
    if modality == "rgb":
        return rr.EncodedImage.columns(blob=blobs)
    if modality == "depth":
        return rr.EncodedDepthImage.columns(blob=blobs)
    # Rerun shows names over ids only where they are plain; its files compress them again.
    ids = np.stack([decode("segmentation", blob) for blob in blobs]).astype(kind)
    return rr.SegmentationImage.columns(buffer=ids.reshape(len(ids), -1).view(np.uint8))


# --- numbers and words ----------------------------------------------------------------------------


def _numbers(episode: Episode) -> list[tuple[str, list[str], NDArray]]:
    """Entity, the name of each number in it, and their rows: one a state, or one less where a reset has none."""
    found = [
        ("/action", list(episode.action_names), episode.action),
        ("/reward", ["reward"], episode.reward),
        ("/episode/terminated", ["terminated"], episode.terminated),
        ("/episode/truncated", ["truncated"], episode.truncated),
    ]
    for name, column in episode.evaluate.items():
        series = series_names(name.removeprefix(REWARD_TERMS), column)
        found.append((evaluate_entity(name), series, column))
    found += [(batch_entity(name), series_names(name, held), held) for name, held in episode.batch.items()]
    found += [(f"/episode/{name}", [name], flag) for name, flag in episode.flags.items()]
    if observed := episode.obs.items():
        names = [one for name, column in observed for one in series_names(name or "obs", column)]
        flat = [np.asarray(v, dtype=np.float64).reshape(len(v), math.prod(v.shape[1:])) for _, v in observed]
        found.append((OBSERVATION, names, np.concatenate(flat, axis=1)))
    return found


def series_names(name: str, column: NDArray) -> list[str]:
    """``name``, or ``name[0]``, ``name[1]`` ... where a step has more than one number of it."""
    if column.ndim == 1:
        return [name]
    return [f"{name}[{', '.join(map(str, index))}]" for index in np.ndindex(column.shape[1:])]


def _series(numbers: Iterable[tuple[str, list[str], NDArray]]) -> Iterator[Chunk]:
    drawn: Counter[str] = Counter()
    for entity, series, _ in numbers:
        # One view shows all entities of a folder, and those of the whole batch with those of the env.
        folder = entity.split("/")[1].replace("batch", "evaluate")
        if series:
            yield series_chunk(
                entity, tuple(series), drawn[folder] if folder in ("evaluate", "reward") else 0
            )
        drawn[folder] += len(series)


def events(episode: Episode) -> list[tuple[int, str, str]]:
    """(step, level, text) of every moment at which something began, in order of time."""
    seed, flags = episode.info.seed, episode.flags
    found = [(0, "INFO", f"reset with seed {seed}" if seed >= 0 else "reset")]
    for name, level in (("success", "INFO"), ("fail", "WARN")):
        if name in flags:
            found += [(step, level, name) for step in rising_edges(flags[name])]
    for name, values in (("terminated", episode.terminated), ("truncated", episode.truncated)):
        found += [(step + 1, "INFO", name) for step in rising_edges(values)]
    return sorted(found, key=lambda event: event[0])


def rising_edges(values: NDArray[np.bool_]) -> list[int]:
    """Indices at which `values` becomes true."""
    before = np.concatenate([[False], values[:-1]])
    return np.flatnonzero(values & ~before).tolist()


def _texts(episode: Episode) -> list[tuple[int, str, str]]:
    """Entries that are no numbers, where they change."""
    said = [
        (
            state,
            "INFO",
            f"{name}: {entry.text}" if entry is not None else f"{name} is not returned any more",
        )
        for name, track in episode.texts.items()
        for state, entry in track
    ]
    return sorted(said, key=lambda line: line[0])


def _log(timed: TimedChunks, entity: str, lines: Sequence[tuple[int, str, str]]) -> Chunk:
    steps, levels, texts = zip(*lines)
    columns = rr.TextLog.columns(text=list(texts), level=list(levels))
    return timed.of(entity, np.array(steps, dtype=np.int64), columns)


# --- frames ---------------------------------------------------------------------------------------


def xyzw(wxyz: NDArray) -> NDArray:
    """(..., 4) quaternions from our order to rerun's."""
    return wxyz[..., [1, 2, 3, 0]]


def optical_pose(pose: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Translation (P, 3) and xyzw (P, 4) of the OpenCV camera frame, from ManiSkill poses (P, 7)."""
    turned = qmult(pose[:, 3:].T.astype(np.float64), _OPTICAL_FROM_CAMERA).T
    return pose[:, :3], xyzw(turned).astype(np.float32)


def wxyz_from_optical(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """ManiSkill poses (P, 7) of cameras, from translation and xyzw of their OpenCV frame: `optical_pose`, undone."""
    wxyz = np.roll(rows[:, 3:], 1, axis=1).T.astype(np.float64)
    turned = qmult(wxyz, qconjugate(_OPTICAL_FROM_CAMERA)).T
    return np.concatenate([rows[:, :3], turned.astype(np.float32)], axis=1)
