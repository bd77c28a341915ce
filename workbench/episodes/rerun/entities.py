"""Lays out an episode as rerun entities."""

from __future__ import annotations

import io
import json
import math
import threading
import weakref
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache, lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
import xxhash
from numpy.typing import NDArray
from PIL import Image
from rerun.chunk import Chunk
from transforms3d.quaternions import qconjugate, qmult

from workbench.envs.camera_data import CameraInfo
from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, Visual
from workbench.envs.step_result import TERM_PREFIX
from workbench.episodes.encoded_pictures import MILLIMETRES_PER_METRE, Modality, decode
from workbench.episodes.episode import CameraTrack, Episode, camera_names
from workbench.episodes.rerun.chunks import LOOK, TimedChunks, series_chunk, static_chunk, static_pose
from workbench.episodes.rerun.drawings import drawing_chunks

WORLD = "/world"
CAMERAS = "/world/cameras"
LOGS = "/logs"
EVENTS = "/logs/events"
ENTRY_TEXTS = "/logs/evaluate"
OBSERVATION = "/observation/state"
"""All observations except pictures as one batch, as in LeRobot. A separate entity for an observation would
cost 5 kB per file and 40 B per step."""

_MAX_PIXELS, MAX_PICTURES = 1 << 20, 1024
"""Maximum pixels and pictures of one chunk, whose pictures are in memory together."""
_PNG_RGBA = 6
"""Value for RGBA of a PNG's colour type, which is byte 25 of the file (PNG specification, section 11.2.1)."""
FRUSTUM_METRES = 0.12
"""Distance from a camera to its picture in the 3-D view."""
_XYZW = [0, 1, 2, 4, 5, 6, 3]
"""Indices of a pose that turn wxyz into rerun's xyzw."""
_OPTICAL_FROM_CAMERA = (0.5, -0.5, 0.5, -0.5)
"""wxyz of the OpenCV camera axes (x right, y down, z forward) within ManiSkill's (x forward, y left,
z up): the rotation matrix [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]."""


def chunks(episode: Episode) -> Iterator[Chunk]:
    """All chunks of an episode with a scene, static ones first; pictures are read when they are needed.

    Other programs read these files, so the layout is a contract:

    - ``/world`` right-handed, z up; ``/world/<body>`` its pose, ``/world/<body>/<n>`` its static meshes;
    - ``/world/cameras/<name>`` pose and pinhole, with children ``rgb``, ``depth`` and ``segmentation``;
    - ``/action``, ``/reward`` and ``/reward/<term>``, ``/evaluate/<entry>``, ``/batch/<entry>`` for numbers that
      ``evaluate()`` returned without a row per env, ``/observation/state``,
      ``/episode/{success,fail,terminated,truncated}`` as numbers, ``/logs/events`` and ``/logs/evaluate`` as text;
    - ``/drawings/<kind>/<name>`` what the task drew (`rerun.drawings`).

    Timelines are ``step``, the state's number, and ``sim_time``. Row k is the state after k control steps, with the
    action that led to it and its reward: the action of row k is ``episode.action[k - 1]``, and row 0 has
    neither. A row of numbers or poses that equals both its neighbours is left out (`chunks.changed_rows`):
    the previous row is valid there.

    All data are columns, with one call per entity: forty times faster than one call per row (measured). Rerun uses xyzw
    quaternions and OpenCV cameras (x right, y down, z forward); ManiSkill uses wxyz and x forward, y left, z up.

    Raises:
        ValueError: rerun refuses a value.
        OSError: a picture cannot be read.
    """
    poses, bodies = episode.poses, _bodies(episode)
    assert poses is not None and episode.geometry is not None
    numbers = _numbers(episode)
    yield _world()
    yield from _meshes(episode.geometry, episode.info.env_index, bodies)
    yield from _series(numbers)
    still = _never_moves(poses)
    cameras = list(zip(episode.cameras, camera_entities([camera.info for camera in episode.cameras])))
    pieces = _pieces(episode.cameras)
    ids = _ids(episode.cameras, pieces)
    for body, entity in bodies.items():
        if still[body]:
            yield static_pose(entity, poses[0, body, :3], xyzw(poses[0, body, 3:]))
    if cameras:
        yield _classes(episode.segmentation)
    for (camera, entity), kind in zip(cameras, ids):
        yield from _pinhole(camera, entity, kind)
    timed = TimedChunks(episode.info.control_dt)
    yield timed.texts(EVENTS, events(episode))
    if episode.texts:
        yield timed.texts(ENTRY_TEXTS, _texts(episode))
    yield from drawing_chunks(episode.drawn, timed)
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


def _bodies(episode: Episode) -> dict[int, str]:
    """Entities, by body index, of the bodies in the episode's env."""
    assert episode.geometry is not None and episode.poses is not None
    present = np.asarray(np.isfinite(episode.poses).any(axis=(0, 2)))
    return {body: entity for body, entity in enumerate(body_entities(episode.geometry)) if present[body]}


def _never_moves(poses: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether all R poses in `poses` (R, ..., 7) are equal, for each body or camera: an array (...)."""
    bits = poses.view(np.int32)  # as bits, so that NaN equals NaN
    return np.asarray((bits == bits[0]).all(axis=(0, -1)))


def _pieces(cameras: Sequence[CameraTrack]) -> list[tuple[int, slice]]:
    """(camera, slice of its pictures) of each chunk, in order of time."""
    found = []
    for number, camera in enumerate(cameras):
        many = min(max(_MAX_PIXELS // (camera.info.width * camera.info.height), 1), MAX_PICTURES)
        for begin in range(0, len(camera.frame), many):
            found.append((camera.frame[begin], number, slice(begin, begin + many)))
    return [(number, some) for _, number, some in sorted(found, key=lambda piece: piece[:2])]


# --- names ----------------------------------------------------------------------------------------


def body_entities(geometry: SceneGeometry) -> tuple[str, ...]:
    """(B,) entity path of each body: ``/world/<actor>`` or ``/world/<articulation>/<link>``.

    Rerun composes the transforms of nested entities, so no body may be below another one: an actor with the name of an
    articulation, or of the cameras' folder, gets an underscore.
    """
    return _entities_of(geometry.body_names)


@lru_cache(maxsize=64)
def _entities_of(body_names: tuple[str, ...]) -> tuple[str, ...]:
    names = [tuple(part for part in name.split("/") if part) or ("unnamed",) for name in body_names]
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
    """Entity of an entry of ``evaluate()``; terms of the reward are below ``/reward``."""
    if name.startswith(TERM_PREFIX):
        return rr.new_entity_path(["reward", name[len(TERM_PREFIX) :] or "unnamed"])
    return rr.new_entity_path(["evaluate", name or "unnamed"])


def batch_entity(name: str) -> str:
    """Entity of an entry of ``evaluate()`` that is a number of the whole batch."""
    return rr.new_entity_path(["batch", name or "unnamed"])


# --- scene ----------------------------------------------------------------------------------------


def _meshes(geometry: SceneGeometry, env: int, bodies: Mapping[int, str]) -> Iterator[Chunk]:
    count: Counter[int] = Counter()
    for visual in geometry.visuals:
        for body in map(int, visual.bodies[visual.envs == env]):
            if body in bodies and (drawn := _mesh_chunk(visual, f"{bodies[body]}/{count[body]}")) is not None:
                yield drawn
                count[body] += 1


@cache
def _world() -> Chunk:
    return static_chunk(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)


_TEXTURE_QUALITY = 64
VIEWER_TEXELS = 96
"""Longest side, in texels, of a texture for rerun's viewer; the workbench reads the full texture, which is stored next to
it as WebP."""
_made: dict[int, tuple[weakref.ref[Visual], dict[str, Chunk | None]]] = {}
"""Cache of `_mesh_chunk` by the visual's id, for the life of the visual: the next episode of the scene avoids converting
megabytes of textures."""
_MAX_ENTITIES = 64
"""Maximum number of cached entities per visual. A visual has one entity for each env if the names of its
bodies differ between envs."""
_encoded: dict[bytes, bytes] = {}
_MAX_ENCODED_TEXTURES = 256
_making = threading.Lock()
"""Guards the caches: several threads may write episodes of one scene."""


def _mesh_chunk(visual: Visual, entity: str) -> Chunk | None:
    """The chunk of `visual` at `entity`; None if it has no triangles."""
    key = id(visual)
    with _making:
        held = _made.get(key)
        if held is None or held[0]() is not visual:
            held = _made[key] = (weakref.ref(visual, lambda _: _made.pop(key, None)), {})
        made = held[1]
        if entity not in made:
            chunk = next((chunk for chunk in made.values() if chunk is not None), None)
            if len(made) >= _MAX_ENTITIES:
                made.clear()
            made[entity] = _visual_chunk(visual, entity) if chunk is None else chunk.with_entity_path(entity)
        return made[entity]


def _visual_chunk(visual: Visual, entity: str) -> Chunk | None:
    mesh = _mesh(visual.mesh, visual.material)
    if mesh is None:
        return None
    # Values that rerun's mesh lacks, for reading the scene back; in one component, since each component takes 350 bytes.
    material = visual.material
    look = [visual.name, *map(float, (*material.base_color, material.metallic, material.roughness))]
    extras: dict[str, Any] = {LOOK: json.dumps(look)}
    if material.texture is not None and visual.mesh.uvs is not None and _is_large(material.texture):
        # Rerun stores textures uncompressed: that of ManiSkill's table would be 3/4 of most recordings.
        extras["texture"] = pa.array(np.frombuffer(_webp(material.texture), np.uint8))
    return static_chunk(entity, mesh, rr.AnyValues(**extras))


def _is_large(texture: NDArray[np.uint8]) -> bool:
    return max(texture.shape[:2]) > VIEWER_TEXELS


def _webp(texture: NDArray[np.uint8]) -> bytes:
    """The texture as WebP, cached by content: encoding one takes 0.2 s, and every recorder reads the scene again."""
    pixels = np.ascontiguousarray(texture[..., :3])
    digest = xxhash.xxh3_128_digest(pixels.data)
    if digest not in _encoded:
        content = io.BytesIO()
        Image.fromarray(pixels).save(content, "WEBP", quality=_TEXTURE_QUALITY, method=6)
        if len(_encoded) >= _MAX_ENCODED_TEXTURES:
            _encoded.clear()
        _encoded[digest] = content.getvalue()
    return _encoded[digest]


def _small(texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The texture (H, W, 3) for rerun's viewer."""
    if not _is_large(texture):
        return np.ascontiguousarray(texture[..., :3])
    image = Image.fromarray(np.ascontiguousarray(texture[..., :3]))
    image.thumbnail((VIEWER_TEXELS, VIEWER_TEXELS), Image.Resampling.BOX)
    # The last two bits are invisible, and without them the file is a third smaller.
    return np.asarray(image) & np.uint8(0xFC) | np.uint8(2)


def _mesh(mesh: Mesh, material: Material) -> rr.Mesh3D | None:
    if len(mesh.faces) == 0:
        return None
    # SAPIEN and rerun agree on uv: v = 0 is the first row of the texture, values beyond 0..1 repeat.
    texture = None if material.texture is None or mesh.uvs is None else _small(material.texture)
    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        vertex_normals=mesh.normals,
        vertex_texcoords=None if texture is None else mesh.uvs,
        albedo_texture=texture,
        albedo_factor=np.rint(np.clip(material.srgb_color, 0.0, 1.0) * 255).astype(np.uint8),
    )


# --- cameras --------------------------------------------------------------------------------------


def _classes(segmentation: Mapping[int, str]) -> Chunk:
    names = {0: "background", **segmentation}
    # Rerun's class ids have 16 bits; names of larger ids are dropped (ManiSkill's are int16).
    classes = [(int(id_), name) for id_, name in sorted(names.items()) if 0 <= id_ <= 0xFFFF]
    return static_chunk(CAMERAS, rr.AnnotationContext([(*c, (0, 0, 0)) if c[0] == 0 else c for c in classes]))


def _pinhole(camera: CameraTrack, entity: str, ids: np.dtype) -> Iterator[Chunk]:
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
    """Dtype of each camera's segmentation ids: int32 if one of its pictures has ids beyond 16 bits."""
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
    # Rerun shows names of ids only for uncompressed pictures; its files compress them anyway.
    ids = np.stack([decode("segmentation", blob) for blob in blobs]).astype(kind)
    return rr.SegmentationImage.columns(buffer=ids.reshape(len(ids), -1).view(np.uint8))


# --- numbers and texts ----------------------------------------------------------------------------


def _numbers(episode: Episode) -> list[tuple[str, list[str], NDArray]]:
    """(entity, names of its curves, rows of numbers) for each entity. There are T + 1 rows, one per state, or
    T rows for numbers that the state after the reset lacks."""
    found = [
        ("/action", list(episode.action_names), episode.action),
        ("/reward", ["reward"], episode.reward),
        # Without names and colours, which would take 2 kB each: the blueprint draws nothing below /episode.
        ("/episode/terminated", [], episode.terminated),
        ("/episode/truncated", [], episode.truncated),
    ]
    for name, column in episode.evaluate.items():
        series = series_names(name.removeprefix(TERM_PREFIX), column)
        found.append((evaluate_entity(name), series, column))
    found += [(batch_entity(name), series_names(name, held), held) for name, held in episode.batch.items()]
    found += [(f"/episode/{name}", [], flag) for name, flag in episode.flags.items()]
    if observed := episode.obs.items():
        names = [one for name, column in observed for one in series_names(name or "obs", column)]
        flat = [np.asarray(v, dtype=np.float64).reshape(len(v), math.prod(v.shape[1:])) for _, v in observed]
        found.append((OBSERVATION, names, np.concatenate(flat, axis=1)))
    return found


def series_names(name: str, column: NDArray) -> list[str]:
    """``name``, or ``name[0]``, ``name[1]`` ... for several numbers per step."""
    return list(_series_names(name, column.shape[1:]))


@lru_cache(maxsize=512)
def _series_names(name: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    if not shape:
        return (name,)
    return tuple(f"{name}[{', '.join(map(str, index))}]" for index in np.ndindex(shape))


def _series(numbers: Iterable[tuple[str, list[str], NDArray]]) -> Iterator[Chunk]:
    drawn: Counter[str] = Counter()
    for entity, series, _ in numbers:
        # One view draws all entities of a folder, and those of /batch together with those of /evaluate: the
        # curves of a view should have different colours.
        folder = entity.split("/")[1].replace("batch", "evaluate")
        if series:
            yield series_chunk(
                entity, tuple(series), drawn[folder] if folder in ("evaluate", "reward") else 0
            )
        drawn[folder] += len(series)


def events(episode: Episode) -> list[tuple[int, str, str]]:
    """(step, level, text) of each event, in order of time."""
    seed, flags = episode.info.seed, episode.flags
    found = [(0, "INFO", f"reset with seed {seed}" if seed >= 0 else "reset")]
    for name, level in (("success", "INFO"), ("fail", "WARN")):
        if name in flags:
            found += [(step, level, name) for step in rising_edges(flags[name])]
    for name, values in (("terminated", episode.terminated), ("truncated", episode.truncated)):
        found += [(step + 1, "INFO", name) for step in rising_edges(values)]
    return sorted(found, key=lambda event: event[0])


def rising_edges(values: NDArray[np.bool_]) -> list[int]:
    """Indices at which `values` turns true."""
    before = np.concatenate([[False], values[:-1]])
    return np.flatnonzero(values & ~before).tolist()


def _texts(episode: Episode) -> list[tuple[int, str, str]]:
    """Changes of the entries that are not numbers."""
    lines = [
        (
            state,
            "INFO",
            f"{name}: {entry.text}" if entry is not None else f"{name} is no longer returned",
        )
        for name, track in episode.texts.items()
        for state, entry in track
    ]
    return sorted(lines, key=lambda line: line[0])


# --- frames ---------------------------------------------------------------------------------------


def xyzw(wxyz: NDArray) -> NDArray:
    """(..., 4) quaternions from wxyz to xyzw."""
    return wxyz[..., [1, 2, 3, 0]]


def optical_pose(pose: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Translation (P, 3) and xyzw (P, 4) of the OpenCV camera frame, from ManiSkill poses (P, 7)."""
    turned = qmult(pose[:, 3:].T.astype(np.float64), _OPTICAL_FROM_CAMERA).T
    return pose[:, :3], xyzw(turned).astype(np.float32)


def wxyz_from_optical(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """The inverse of `optical_pose`: camera poses (P, 7) from translation and xyzw (P, 7)."""
    wxyz = np.roll(rows[:, 3:], 1, axis=1).T.astype(np.float64)
    turned = qmult(wxyz, qconjugate(_OPTICAL_FROM_CAMERA)).T
    return np.concatenate([rows[:, :3], turned.astype(np.float32)], axis=1)
