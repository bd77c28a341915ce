"""An episode that a reader has read, as it crosses to the server, and what is checked of it there.

Whoever shows an episode takes it for granted that its columns have a row a state, that faces name vertices that there
are, that an action has as many numbers as names. Here is where that is made sure of, for files that are broken as for
a reader that was taken over.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import overload
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from workbench.core.geometry import Material, Mesh, SceneGeometry, SharedShapes, Visual
from workbench.recording.document import CameraWords, SceneWords
from workbench.recording.encoded_pictures import MODALITIES, MOST_PIXELS, EncodedPictures, Modality
from workbench.recording.entry_texts import tracks_from, tracks_words
from workbench.recording.episode import CameraTrack, Episode, Unread
from workbench.recording.reader.requests import (
    CameraRead,
    EpisodeRead,
    GeometryRead,
    PictureRead,
    ShapeRead,
    VisualRead,
)
from workbench.recording.reader.wire import ArrayPacker, ArrayReader, ArrayRef, Garbled

FetchPicture = Callable[[int, Modality, int, bool], tuple[PictureRead, ArrayReader]]
"""Of a camera by its number: the picture of that number; encoded or not. Raises OSError."""


# --- in the reader -----------------------------------------------------------------------------------


class SentShapes:
    """Which shapes were sent to who asks for episodes with one number of `Open.sharing`."""

    _numbers = itertools.count()

    def __init__(self) -> None:
        self.shapes = SharedShapes()
        self._sent: dict[tuple[int, int], tuple[int, Mesh, Material]] = {}

    def number(self, mesh: Mesh, material: Material, arrays: ArrayPacker) -> tuple[int, ShapeRead | None]:
        """Its number, and the shape itself the first time."""
        # They are kept with their number, so their ids are nobody else's.
        key = (id(mesh), id(material))
        if key in self._sent:
            return self._sent[key][0], None
        number = next(self._numbers)
        self._sent[key] = (number, mesh, material)
        none = [
            None if part is None else arrays.ref(part) for part in (mesh.normals, mesh.uvs, material.texture)
        ]
        return number, ShapeRead(
            number,
            arrays.ref(mesh.vertices),
            arrays.ref(mesh.faces),
            none[0],
            none[1],
            material.base_color,
            material.metallic,
            material.roughness,
            none[2],
        )


def packed(
    episode: Episode, source_path: str | None, opened: int, sent: SentShapes
) -> tuple[EpisodeRead, ArrayPacker]:
    """Raises ValueError where a column holds no plain numbers."""
    arrays = ArrayPacker()
    many = {
        name: {key: arrays.ref(values) for key, values in held.items()}
        for name, held in (
            ("evaluate", episode.evaluate),
            ("env_states", episode.env_states),
            ("obs", episode.obs),
            ("batch", episode.batch),
        )
    }
    return EpisodeRead(
        opened=opened,
        info=episode.info,
        source_path=source_path,
        geometry=None if episode.geometry is None else _geometry(episode.geometry, arrays, sent),
        segmentation=episode.segmentation,
        poses=None if episode.poses is None else arrays.ref(episode.poses),
        action=arrays.ref(episode.action),
        action_names=[str(name) for name in episode.action_names],
        reward=arrays.ref(episode.reward),
        terminated=arrays.ref(episode.terminated),
        truncated=arrays.ref(episode.truncated),
        cameras=[_camera(track, arrays) for track in episode.cameras],
        texts=tracks_words(episode.texts),
        unread=list(episode.unread),
        **many,
    ), arrays


def _geometry(geometry: SceneGeometry, arrays: ArrayPacker, sent: SentShapes) -> GeometryRead:
    shapes, visuals = [], []
    for visual in geometry.visuals:
        number, shape = sent.number(*sent.shapes.shared(visual.mesh, visual.material), arrays)
        shapes += [] if shape is None else [shape]
        visuals.append(VisualRead(visual.name, number, arrays.ref(visual.bodies)))
    scene = SceneWords(geometry.body_names, geometry.body_kinds, geometry.body_hidden)
    return GeometryRead(scene, shapes, visuals)


def _camera(track: CameraTrack, arrays: ArrayPacker) -> CameraRead:
    held: dict[Modality, EncodedPictures | None] = {m: getattr(track, m) for m in MODALITIES}
    return CameraRead(
        camera=CameraWords.of(track.info),
        frame=arrays.ref(track.frame),
        pose=arrays.ref(track.pose),
        pictures={m: len(pictures) for m, pictures in held.items() if pictures is not None},
    )


# --- in the server -----------------------------------------------------------------------------------


class KnownShapes:
    """What readers have sent of shapes, for as long as those are shared."""

    def __init__(self) -> None:
        self._of: WeakKeyDictionary[
            SharedShapes, tuple[int, dict[tuple[int, int], tuple[Mesh, Material]]]
        ] = WeakKeyDictionary()
        self._numbers = itertools.count(1)

    def of(self, shapes: SharedShapes) -> tuple[int, dict[tuple[int, int], tuple[Mesh, Material]]]:
        """The number to ask with, and what came; by which process it came from, and its number there."""
        if shapes not in self._of:
            self._of[shapes] = (next(self._numbers), {})
        return self._of[shapes]


class PicturesRead(EncodedPictures):
    """Pictures of a recording that a reader has open, decoded there when one is asked for."""

    def __init__(self, modality: Modality, camera: int, count: int, fetch: FetchPicture) -> None:
        super().__init__(modality, _Blobs(modality, camera, count, fetch))

    def __getitem__(self, index: int) -> NDArray:
        blobs = self.blobs
        assert isinstance(blobs, _Blobs)
        return blobs.decoded(index)


class _Blobs(Sequence[bytes]):
    def __init__(self, modality: Modality, camera: int, count: int, fetch: FetchPicture) -> None:
        self._modality: Modality = modality
        self._camera, self._count, self._fetch = camera, count, fetch

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> bytes: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[bytes]: ...

    def __getitem__(self, index: int | slice) -> bytes | Sequence[bytes]:
        """Raises OSError where it cannot be read."""
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(self._count))]
        read, _ = self._fetch(self._camera, self._modality, range(self._count)[index], True)
        if read.blob is None:
            raise OSError("the reader gave no picture")
        return read.blob

    def decoded(self, index: int) -> NDArray:
        """As `EncodedPictures.__getitem__`."""
        read, arrays = self._fetch(self._camera, self._modality, range(self._count)[index], False)
        try:
            picture = None if read.array is None else arrays.array(read.array)
        except Garbled as error:
            raise OSError(f"the reader gave {error}") from error
        dtype, ndim = {"rgb": ("u1", 3), "depth": ("f4", 2), "segmentation": ("i4", 2)}[self._modality]
        if picture is None or picture.dtype != dtype or picture.ndim != ndim or not picture.size:
            raise OSError("the reader gave no picture")
        if picture.shape[0] * picture.shape[1] > MOST_PIXELS or (ndim == 3 and picture.shape[2] != 3):
            raise OSError(f"the reader gave a picture of shape {picture.shape}")
        return picture


def unpacked(
    read: EpisodeRead,
    arrays: ArrayReader,
    fetch: FetchPicture,
    process: int,
    shapes: SharedShapes,
    known: dict[tuple[int, int], tuple[Mesh, Material]],
) -> Episode:
    """
    Args:
        process: the number of the process that it came from.
        known: shapes that came before.

    Raises:
        Garbled: it does not fit together; the message says what of it.
    """
    names = tuple(read.action_names)
    reward = _column(arrays, read.reward, "the rewards")
    length = len(reward)
    action = arrays.array(read.action)
    _must(
        action.shape == (length, len(names)),
        f"{length} rewards, {len(names)} action names and actions of shape {action.shape}",
    )
    geometry = (
        None if read.geometry is None else _unpacked_geometry(read.geometry, arrays, process, shapes, known)
    )
    poses = None if read.poses is None else arrays.array(read.poses)
    if poses is not None:
        bodies = -1 if geometry is None else len(geometry.body_names)
        _must(
            poses.shape == (length + 1, bodies, 7),
            f"poses of shape {poses.shape} for {length + 1} states of {bodies} bodies",
        )
    ends = [
        _column(arrays, ref, name)
        for ref, name in ((read.terminated, "terminated"), (read.truncated, "truncated"))
    ]
    for end in ends:
        _must(len(end) == length, f"{len(end)} flags for {length} steps")
    unread = list(read.unread)
    many = [
        dict(_rows(arrays, held, length + 1, unread))
        for held in (read.evaluate, read.env_states, read.obs, read.batch)
    ]
    return Episode(
        info=read.info,
        geometry=geometry,
        segmentation=read.segmentation,
        poses=None if poses is None else poses.astype(np.float32, copy=False),
        action=action.astype(np.float32, copy=False),
        action_names=names,
        reward=reward.astype(np.float32, copy=False),
        terminated=ends[0].astype(np.bool_, copy=False),
        truncated=ends[1].astype(np.bool_, copy=False),
        evaluate=many[0],
        cameras=[_track(camera, number, arrays, fetch) for number, camera in enumerate(read.cameras)],
        env_states=many[1],
        obs=many[2],
        batch=many[3],
        texts=tracks_from(read.texts),
        unread=tuple(unread),
    )


def _column(arrays: ArrayReader, ref: ArrayRef, what: str) -> NDArray:
    column = arrays.array(ref)
    _must(column.ndim == 1, f"{what} of shape {column.shape}")
    return column


def _rows(
    arrays: ArrayReader, held: dict[str, ArrayRef], states: int, unread: list[Unread]
) -> Iterator[tuple[str, NDArray]]:
    """Those with a row a state; of others it is said that they are left out."""
    for name, ref in held.items():
        rows = arrays.array(ref)
        if rows.ndim > 0 and len(rows) == states:
            yield name, rows
        else:
            unread.append(Unread(name, f"has shape {rows.shape} for {states} states, and is left out."))


def _unpacked_geometry(
    read: GeometryRead,
    arrays: ArrayReader,
    process: int,
    shapes: SharedShapes,
    known: dict[tuple[int, int], tuple[Mesh, Material]],
) -> SceneGeometry:
    for shape in read.shapes:
        known[process, shape.number] = shapes.shared(*_shape(shape, arrays))
    scene = read.scene
    bodies = len(scene.body_names)
    _must(len(scene.body_kinds) == len(scene.body_hidden) == bodies, "kinds of other bodies than there are")
    visuals = []
    for visual in read.visuals:
        _must((process, visual.shape) in known, "a visual without a shape")
        worn = arrays.array(visual.bodies)
        _must(
            worn.ndim == 1 and worn.dtype.kind in "iu" and bool(np.all((0 <= worn) & (worn < bodies))),
            "a visual of bodies that are not there",
        )
        mesh, material = known[process, visual.shape]
        visuals.append(
            Visual(
                visual.name, mesh, material, np.zeros(len(worn), np.int32), worn.astype(np.int32, copy=False)
            )
        )
    return SceneGeometry(1, scene.body_names, scene.body_kinds, scene.body_hidden, tuple(visuals))


def _shape(read: ShapeRead, arrays: ArrayReader) -> tuple[Mesh, Material]:
    vertices, faces = arrays.array(read.vertices), arrays.array(read.faces)
    _must(
        vertices.ndim == 2 and vertices.shape[1] == 3 and vertices.dtype.kind == "f",
        f"vertices of shape {vertices.shape}",
    )
    _must(
        faces.ndim == 2
        and faces.shape[1] == 3
        and faces.dtype.kind in "iu"
        and bool(np.all((0 <= faces) & (faces < len(vertices)))),
        "faces of vertices that are not there",
    )
    further: list[NDArray | None] = []
    for ref, width in ((read.normals, 3), (read.uvs, 2)):
        part = None if ref is None else arrays.array(ref)
        _must(
            part is None or (part.shape == (len(vertices), width) and part.dtype.kind == "f"),
            "normals or uvs of other vertices",
        )
        further.append(None if part is None else part.astype(np.float32, copy=False))
    texture = None if read.texture is None else arrays.array(read.texture)
    if texture is not None:
        _must(
            texture.ndim == 3
            and texture.shape[2] == 4
            and texture.dtype == np.uint8
            and 0 < texture.size <= 4 * MOST_PIXELS,
            f"a texture of shape {texture.shape}",
        )
    mesh = Mesh(
        vertices.astype(np.float32, copy=False), faces.astype(np.uint32, copy=False), further[0], further[1]
    )
    return mesh, Material(read.base_color, read.metallic, read.roughness, texture)


def _track(read: CameraRead, number: int, arrays: ArrayReader, fetch: FetchPicture) -> CameraTrack:
    info, frame, pose = read.camera.info(), arrays.array(read.frame), arrays.array(read.pose)
    _must(frame.ndim == 1 and frame.dtype.kind in "iu", f"{info.name}: frames of shape {frame.shape}")
    _must(pose.shape == (len(frame), 7), f"{info.name}: {len(frame)} frames and poses of shape {pose.shape}")
    _must(
        info.width > 0 and info.height > 0 and info.width * info.height <= MOST_PIXELS,
        f"{info.name}: pictures of {info.width} x {info.height}",
    )
    for count in read.pictures.values():
        _must(count == len(frame), f"{info.name}: {len(frame)} frames and {count} pictures")
    held = {m: PicturesRead(m, number, count, fetch) for m, count in read.pictures.items()}
    return CameraTrack(
        info, frame.astype(np.int64, copy=False), pose.astype(np.float32, copy=False),
        held.get("rgb"), held.get("depth"), held.get("segmentation"),
    )  # fmt: skip


def _must(holds: bool, otherwise: str) -> None:
    if not holds:
        raise Garbled(f"it has {otherwise}")
