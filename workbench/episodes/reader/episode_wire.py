"""Packs an episode in the reader, and validates and unpacks it in the server."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, SharedShapes, Visual
from workbench.episodes.columns import MAX_TEXT_LINES
from workbench.episodes.document import CameraJson
from workbench.episodes.drawings import wrong_drawings
from workbench.episodes.encoded_pictures import MAX_PIXELS, EncodedPictures, LazyPictures, Modality
from workbench.episodes.episode import BrokenFile, CameraTrack, Episode
from workbench.episodes.reader.requests import CameraRead, EpisodeRead, PictureRead, ShapeRead, VisualRead

FetchPicture = Callable[[int, Modality, int, bool], PictureRead]
"""Arguments: camera, modality, index, encoded. Raises OSError."""


class InvalidEpisode(Exception):
    """Parts of a received episode do not fit together."""


# --- in the reader -----------------------------------------------------------------------------------


class SentShapes:
    """Shapes that were already sent for one number of `OpenEpisode.sharing`."""

    _numbers = itertools.count()

    def __init__(self) -> None:
        self.shapes = SharedShapes()
        self._sent: dict[tuple[int, int], ShapeRead] = {}

    def sent(self, mesh: Mesh, material: Material) -> tuple[ShapeRead, bool]:
        """The shape with its number, and whether it was already sent."""
        # `_sent` keeps the objects alive, so ids are not reused.
        key = (id(mesh), id(material))
        before = key in self._sent
        if not before:
            self._sent[key] = ShapeRead(next(self._numbers), mesh, material)
        return self._sent[key], before


def pack_episode(episode: Episode, source_path: str | None, opened: int, sent: SentShapes) -> EpisodeRead:
    shapes, visuals, bare = [], [], episode.geometry
    if bare is not None:
        for visual in bare.visuals:
            shape, before = sent.sent(*sent.shapes.shared(visual.mesh, visual.material))
            shapes += [] if before else [shape]
            visuals.append(VisualRead(visual.name, shape.number, visual.bodies))
        bare = replace(bare, visuals=())
    cameras = [_camera(track) for track in episode.cameras]
    return EpisodeRead(
        opened, source_path, replace(episode, geometry=bare, cameras=[]), cameras, shapes, visuals
    )


def _camera(track: CameraTrack) -> CameraRead:
    counts: dict[Modality, int] = {modality: len(pictures) for modality, pictures in track.pictures.items()}
    return CameraRead(CameraJson.of(track.info), track.frame, track.pose, counts)


# --- in the server -----------------------------------------------------------------------------------


class KnownShapes:
    """Shapes that were received from readers and are shared between episodes."""

    def __init__(self) -> None:
        self._of: WeakKeyDictionary[
            SharedShapes, tuple[int, dict[tuple[int, int], tuple[Mesh, Material]]]
        ] = WeakKeyDictionary()
        self._numbers = itertools.count(1)

    def of(self, shapes: SharedShapes) -> tuple[int, dict[tuple[int, int], tuple[Mesh, Material]]]:
        """The number for `OpenEpisode.sharing`, and the received shapes by (process, number)."""
        if shapes not in self._of:
            self._of[shapes] = (next(self._numbers), {})
        return self._of[shapes]


def _pictures(modality: Modality, camera: int, count: int, fetch: FetchPicture) -> EncodedPictures:
    """Pictures of an episode that is open in a reader, which decodes them."""

    def one(number: int) -> bytes:
        blob = fetch(camera, modality, number, True).blob
        if blob is None:
            raise OSError("the reader returned no picture")
        return blob

    def decoded(number: int) -> NDArray:
        picture = fetch(camera, modality, number, False).array
        dtype, ndim = {"rgb": ("u1", 3), "depth": ("f4", 2), "segmentation": ("i4", 2)}[modality]
        if picture is None or picture.dtype != dtype or picture.ndim != ndim or not picture.size:
            raise OSError("the reader returned no picture")
        if picture.shape[0] * picture.shape[1] > MAX_PIXELS or (ndim == 3 and picture.shape[2] != 3):
            raise OSError(f"the reader returned a picture of shape {picture.shape}")
        return picture

    return EncodedPictures(modality, LazyPictures(count, one), decoded)


def unpack_episode(
    read: EpisodeRead,
    fetch: FetchPicture,
    process: int,
    shapes: SharedShapes,
    known: dict[tuple[int, int], tuple[Mesh, Material]],
) -> Episode:
    """Unpack and validate an episode: the file may be broken, and the reader compromised.

    The code that uses an episode relies on columns with a row per state, on faces whose vertices exist, and
    on a name for each action dimension.

    Args:
        process: number of the process that read the episode.
        known: shapes that were already received, by (process, number).

    Raises:
        InvalidEpisode: parts do not fit together.
    """
    episode = read.episode
    reward = _checked(episode.reward, "rewards", None)
    length = len(reward)
    geometry, poses = episode.geometry, episode.poses
    if geometry is not None:
        geometry = _geometry(geometry, read, process, shapes, known)
    if poses is not None:
        bodies = -1 if geometry is None else len(geometry.body_names)
        poses = _checked(poses, "poses", length + 1, bodies, 7).astype(np.float32, copy=False)
    broken_files = list(episode.broken_files)
    many = {
        name: dict(_rows(columns, length + 1, broken_files))
        for name, columns in (
            ("evaluate", episode.evaluate),
            ("env_states", episode.env_states),
            ("obs", episode.obs),
            ("batch", episode.batch),
        )
    }
    ends = {
        name: _checked(flags, name, length).astype(np.bool_, copy=False)
        for name, flags in (("terminated", episode.terminated), ("truncated", episode.truncated))
    }
    action = _checked(episode.action, "actions", length, len(episode.action_names))
    _require(sum(map(len, episode.texts.values())) <= MAX_TEXT_LINES, "too many entries that are not numbers")
    wrong = wrong_drawings(episode.drawn, length + 1)
    _require(wrong is None, str(wrong))
    return replace(
        episode,
        geometry=geometry,
        poses=poses,
        action=action.astype(np.float32, copy=False),
        reward=reward.astype(np.float32, copy=False),
        cameras=[_track(camera, number, fetch) for number, camera in enumerate(read.cameras)],
        broken_files=tuple(broken_files),
        **many,
        **ends,
    )


def _checked(array: NDArray, what: str, *shape: int | None, kinds: str = "biuf") -> NDArray:
    """`array`. Raises InvalidEpisode unless it has this shape (None: any size) and a dtype of these kinds."""
    fits = array.ndim == len(shape) and all(want in (None, size) for want, size in zip(shape, array.shape))
    shape_text = " x ".join("any" if size is None else str(size) for size in shape)
    _require(
        fits and array.dtype.kind in kinds,
        f"{what} of shape {array.shape} and type {array.dtype}, not {shape_text}",
    )
    return array


def _rows(
    held: dict[str, NDArray], states: int, broken_files: list[BrokenFile]
) -> Iterator[tuple[str, NDArray]]:
    """Entries with a row per state; other entries are left out and reported in `broken_files`."""
    for name, rows in held.items():
        if rows.ndim > 0 and len(rows) == states and rows.dtype.kind in "biuf":
            yield name, rows
        else:
            broken_files.append(
                BrokenFile(name, f"has shape {rows.shape} for {states} states, and is left out.")
            )


def _geometry(
    bare: SceneGeometry,
    read: EpisodeRead,
    process: int,
    shapes: SharedShapes,
    known: dict[tuple[int, int], tuple[Mesh, Material]],
) -> SceneGeometry:
    for shape in read.shapes:
        known[process, shape.number] = shapes.shared(_mesh(shape.mesh), _material(shape.material))
    bodies = len(bare.body_names)
    _require(
        len(bare.body_kinds) == len(bare.body_hidden) == bodies, "kinds for a different number of bodies"
    )
    visuals = []
    for visual in read.visuals:
        _require((process, visual.shape) in known, "a visual without a shape")
        bodies_of = _checked(visual.bodies, "bodies", None, kinds="iu")
        _require(
            bool(np.all((0 <= bodies_of) & (bodies_of < bodies))), "a visual of bodies that do not exist"
        )
        none = np.zeros(len(bodies_of), np.int32)
        visuals.append(
            Visual(visual.name, *known[process, visual.shape], none, bodies_of.astype(np.int32, copy=False))
        )
    return replace(bare, num_envs=1, visuals=tuple(visuals))


def _mesh(mesh: Mesh) -> Mesh:
    vertices = _checked(mesh.vertices, "vertices", None, 3, kinds="f").astype(np.float32, copy=False)
    faces = _checked(mesh.faces, "faces", None, 3, kinds="iu")
    _require(bool(np.all((0 <= faces) & (faces < len(vertices)))), "faces of vertices that do not exist")
    normals, uvs = (
        None
        if part is None
        else _checked(part, what, len(vertices), width, kinds="f").astype(np.float32, copy=False)
        for part, what, width in ((mesh.normals, "normals", 3), (mesh.uvs, "uvs", 2))
    )
    return Mesh(vertices, faces.astype(np.uint32, copy=False), normals, uvs)


def _material(material: Material) -> Material:
    if (texture := material.texture) is not None:
        _checked(texture, "a texture", None, None, 4)
        fits = texture.dtype == np.uint8 and 0 < texture.size <= 4 * MAX_PIXELS
        _require(fits, f"a texture of shape {texture.shape} and type {texture.dtype}")
    return material


def _track(read: CameraRead, number: int, fetch: FetchPicture) -> CameraTrack:
    info = read.camera.info()
    frame = _checked(read.frame, f"{info.name}: frames", None, kinds="iu").astype(np.int64, copy=False)
    pose = _checked(read.pose, f"{info.name}: poses", len(frame), 7).astype(np.float32, copy=False)
    _require(
        info.width > 0 and info.height > 0 and info.width * info.height <= MAX_PIXELS,
        f"{info.name}: pictures of {info.width} x {info.height}",
    )
    for count in read.pictures.values():
        _require(count == len(frame), f"{info.name}: {len(frame)} frames and {count} pictures")
    held = {m: _pictures(m, number, count, fetch) for m, count in read.pictures.items()}
    return CameraTrack(info, frame, pose, **held)


def _require(holds: bool, problem: str) -> None:
    if not holds:
        raise InvalidEpisode(f"it has {problem}")
