"""Reads an ``.rrd`` as arrays, entity by entity."""

from __future__ import annotations

import json
import os
import threading
import warnings
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from rerun.chunk import Chunk, LazyStore, RrdReader
from rerun.error_utils import RerunWarning

from workbench.envs.camera_data import CameraInfo
from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, SharedShapes, Visual
from workbench.episodes.encoded_pictures import EncodedPictures, LazyPictures, Modality, decode, encode
from workbench.episodes.rerun.chunks import LOOK, STEP
from workbench.machine.files import open_regular_file

_PROPERTIES = "/__properties"
_ALL = ("+ /**", f"+ {_PROPERTIES}/**")
"""``/**`` does not include rerun's own entities."""

# Opening a truncated file raises an error, which this warning would repeat in the terminal.
warnings.filterwarnings("ignore", "RRD file has no footer", RerunWarning)


class RerunTable:
    """The content of an ``.rrd`` by entity and component.

    Rerun's query engine is an extra of 100 MB. But chunks are Arrow tables, so the columns that `write_rrd`
    wrote can be read without the engine. The file is read once, in pieces; pictures are not kept, but read
    again on access (`pictures`). Every recording of a scene has the scene's meshes, often as the same chunks:
    a mesh that was loaded from another recording is found by the chunk's id, and not decoded again.

    The file stays open while its pictures may be read, also after it is deleted.
    """

    def __init__(self, path: Path, shapes: SharedShapes | None = None) -> None:
        """
        Args:
            shapes: shapes to share with other recordings.

        Raises:
            OSError, ValueError, RuntimeError: `path` is not an ``.rrd``.
        """
        self._shapes = SharedShapes() if shapes is None else shapes
        self._timed: dict[tuple[str, str], list[tuple[NDArray[np.int64], pa.Array]]] = {}
        self._static: dict[tuple[str, str], pa.Array] = {}
        self._pictures: dict[tuple[str, str], list[_PictureChunk]] = {}
        self._static_chunks: dict[str, list[tuple[str, int]]] = {}
        """Id and size of the static chunks of each entity."""
        self.lost_pictures: tuple[str, ...] = ()
        """Entities whose pictures cannot be read because the file is damaged there."""
        self._file = OpenFile(path)
        try:
            for chunk in self._file.chunks(*_ALL):
                self._add(chunk)
        except (ValueError, RuntimeError):
            self._read_what_is_left()

    def _read_what_is_left(self) -> None:
        """Read the intact chunks of a damaged file: most chunks are pictures, and a damaged chunk must not
        make the other chunks unreadable."""
        for held in (self._timed, self._static, self._pictures, self._static_chunks):
            held.clear()
        pictures = self._file.entities_with(PICTURE_COMPONENTS.values())
        for chunk in self._file.chunks(*_ALL, *(f"- {entity}" for entity in pictures)):
            self._add(chunk)
        for entity in pictures:
            try:
                for chunk in self._file.chunks(f"+ {entity}"):
                    self._add(chunk)
            except (ValueError, RuntimeError):
                self.lost_pictures += (entity,)
                for component in PICTURE_COMPONENTS.values():
                    self._pictures.pop((entity, component), None)

    def _add(self, chunk: Chunk) -> None:
        batch = chunk.to_record_batch()
        entity = chunk.entity_path
        if chunk.is_static:
            self._static_chunks.setdefault(entity, []).append((chunk.id, batch.nbytes))
            for name, column in _data_of(batch):
                if len(column) and column[len(column) - 1].is_valid:
                    self._static[entity, name] = column[len(column) - 1].values
            return
        steps = _steps(batch)
        if steps is None:
            return
        for name, column in _data_of(batch):
            if name in PICTURE_COMPONENTS.values():
                # A copy, because Arrow's array would keep the pictures of the chunk in memory.
                self._pictures.setdefault((entity, name), []).append(_PictureChunk(chunk.id, steps.copy()))
            else:
                self._timed.setdefault((entity, name), []).append((steps, column))

    def property(self, name: str, component: str) -> Any:
        """A property's value; a list for several values, None if it is missing."""
        for (entity, key), values in self._static.items():
            if entity == f"{_PROPERTIES}/{name}" and key.rsplit(":", 1)[-1] == component:
                found = values.to_pylist()
                return found[0] if len(found) == 1 else found
        return None

    def scalars(self, entity: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Steps (R,) and numbers (R, K) of a batched ``Scalars``; see `rows_at`."""
        return self._rows(entity, "Scalars:scalars")

    def pose_rows(self, entity: str, frames: NDArray[np.int64], states: int) -> NDArray[np.float32]:
        """(len(frames), 7), translation and xyzw at the states `frames`."""
        return self._poses(entity, states)[frames]

    def poses(self, entities: Sequence[str], states: int) -> NDArray[np.float32]:
        """(states, len(entities), 7), position and wxyz; NaN for a missing entity."""
        poses = np.full((states, len(entities), 7), np.nan, dtype=np.float32)
        for body, entity in enumerate(entities):
            rows = self._poses(entity, states)
            poses[:, body, :3] = rows[:, :3]
            poses[:, body, 3:] = np.roll(rows[:, 3:], 1, axis=-1)
        return poses

    def _poses(self, entity: str, states: int) -> NDArray[np.float32]:
        poses = np.full((states, 7), np.nan, dtype=np.float32)
        for key, place in (("translation", slice(0, 3)), ("quaternion", slice(3, 7))):
            fixed = self._static.get((entity, f"Transform3D:{key}"))
            if fixed is not None:
                poses[:, place] = _plain(fixed).reshape(-1)
            else:
                steps, rows = self._rows(entity, f"Transform3D:{key}")
                if len(steps):
                    at = rows_at(steps, 0, states)
                    poses[at >= 0, place] = rows[at[at >= 0]]
        return poses

    def _rows(self, entity: str, component: str) -> tuple[NDArray[np.int64], NDArray]:
        """Steps (R,) and values (R, K) of a component with K numbers per row."""
        found = self._timed.get((entity, component), [])
        if not found:
            return np.zeros(0, np.int64), np.zeros((0, 0))
        steps = np.concatenate([steps for steps, _ in found])
        values = np.concatenate([_plain(column.flatten()).reshape(len(column), -1) for _, column in found])
        order = np.argsort(steps, kind="stable")
        return steps[order], values[order]

    def lists(self, entity: str, component: str) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray]:
        """Steps (R,) of the rows of a component, (R + 1,) index at which each row begins, and all plain values."""
        found = self._timed.get((entity, component), [])
        if not found:
            return np.zeros(0, np.int64), np.zeros(1, np.int64), np.zeros(0)
        steps = np.concatenate([steps for steps, _ in found])
        order = np.argsort(steps, kind="stable")
        column = pa.concat_arrays([column for _, column in found]).take(pa.array(order))
        counts = column.value_lengths().fill_null(0).to_numpy()
        return steps[order], np.cumsum([0, *counts], dtype=np.int64), _plain(column.flatten())

    def pictures(
        self, entity: str, modality: Modality, info: CameraInfo
    ) -> tuple[NDArray[np.int64], EncodedPictures] | None:
        """States and pictures of ``<camera>/<modality>``; None if there are none."""
        chunks = self._pictures.get((entity, PICTURE_COMPONENTS[modality]), [])
        if not chunks:
            return None
        return pictures_in(self._file, entity, chunks, modality, info.height, info.width)

    def geometry(self, bare: SceneGeometry, entities: Sequence[str]) -> SceneGeometry:
        """`bare` with the visuals of its bodies, which have these `entities`; shapes are shared with other
        recordings."""
        visuals: dict[str, tuple[Mesh, Material, list[int]]] = {}
        for body, entity in enumerate(entities):
            number = 0
            while (
                visual := self._visual_at(f"{entity}/{number}", f"{bare.body_names[body]}/{number}")
            ) is not None:
                name, mesh, material = visual
                visuals.setdefault(name, (mesh, material, []))[2].append(body)
                number += 1
        return replace(
            bare,
            visuals=tuple(
                Visual(name, mesh, material, np.zeros(len(bodies), np.int32), np.array(bodies, np.int32))
                for name, (mesh, material, bodies) in visuals.items()
            ),
        )

    def _visual_at(self, entity: str, default: str) -> tuple[str, Mesh, Material] | None:
        """Name (`default` if none is recorded), mesh and material of a visual; None if there is none."""
        chunks = self._static_chunks.get(entity, [])
        # Rerun's ids are unique; the size guards against manipulated files.
        mark = chunks[0] if len(chunks) == 1 else None
        if mark is not None and (known := self._shapes.known(mark)) is not None:
            return known
        mesh = self._mesh(entity)
        if mesh is None:
            return None
        name, material = self._look(entity, default)
        mesh, material = self._shapes.shared(mesh, material)
        if mark is not None and {(entity, LOOK), (entity, "visual")} & self._static.keys():
            self._shapes.learn(mark, name, mesh, material)
        return name, mesh, material

    def _mesh(self, entity: str) -> Mesh | None:
        vertices = self._static.get((entity, "Mesh3D:vertex_positions"))
        if vertices is None:
            return None
        held = {
            key: self._static.get((entity, f"Mesh3D:{component}"))
            for key, component in (("normals", "vertex_normals"), ("uvs", "vertex_texcoords"))
        }
        faces = self._static[entity, "Mesh3D:triangle_indices"]
        return Mesh(
            vertices=_plain(vertices).reshape(-1, 3),
            faces=_plain(faces).reshape(-1, 3),
            normals=None if held["normals"] is None else _plain(held["normals"]).reshape(-1, 3),
            uvs=None if held["uvs"] is None else _plain(held["uvs"]).reshape(-1, 2),
        )

    def _look(self, entity: str, default: str) -> tuple[str, Material]:
        """Name and material of a visual. Raises ValueError or TypeError."""
        texture = self._texture(entity)
        look = self._one(entity, LOOK, None)
        if look is not None:
            name, *numbers = json.loads(look)
            r, g, b, a, metallic, roughness = map(float, numbers)
            return str(name), Material((r, g, b, a), metallic, roughness, texture)
        # Files of older versions have one component for the name, and either one component for all numbers or
        # one for each number.
        name = str(self._one(entity, "visual", default))
        surface = self._static.get((entity, "surface"))
        if surface is not None:
            r, g, b, a, metallic, roughness = surface.to_pylist()
            return name, Material((r, g, b, a), metallic, roughness, texture)
        colors = self._static.get((entity, "base_color"))
        r, g, b, a = (1.0, 1.0, 1.0, 1.0) if colors is None else colors.to_pylist()
        material = Material(
            base_color=(r, g, b, a),
            metallic=float(self._one(entity, "metallic", 0.0)),
            roughness=float(self._one(entity, "roughness", 1.0)),
            texture=texture,
        )
        return name, material

    def _texture(self, entity: str) -> NDArray[np.uint8] | None:
        """The texture (H, W, 4)."""
        buffer = self._static.get((entity, "Mesh3D:albedo_texture_buffer"))
        if buffer is None:
            return None
        form = self._static[entity, "Mesh3D:albedo_texture_format"][0].as_py()
        rgb = _plain(buffer.flatten()).reshape(form["height"], form["width"], 3)
        rgb = self._full_texture(entity, rgb)
        return np.concatenate([rgb, np.full((*rgb.shape[:2], 1), 255, np.uint8)], axis=-1)

    def _full_texture(self, entity: str, shown: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The full-size texture (H, W, 3) of which rerun shows a small version; `shown` itself if there is none."""
        encoded = self._static.get((entity, "texture"))
        if encoded is None:
            return shown
        try:
            return decode("rgb", _plain(encoded).astype(np.uint8).tobytes())
        except (OSError, ValueError):
            return shown

    def _one(self, entity: str, component: str, default: Any) -> Any:
        values = self._static.get((entity, component))
        return default if values is None else values[0].as_py()


def rows_at(steps: NDArray[np.int64], first: int, states: int) -> NDArray[np.int64]:
    """(states - first,) index of the row that is valid at each state: the state's own row, else the last row
    before it, else -1.

    A file leaves out repeated rows (`chunks.changed_rows`).
    """
    return np.searchsorted(steps, np.arange(first, states), side="right") - 1


def _plain(values: pa.Array) -> NDArray:
    """The numbers in an array of numbers, of lists of numbers, or of bytes."""
    while pa.types.is_fixed_size_list(values.type) or pa.types.is_list(values.type):
        values = values.flatten()
    return values.to_numpy(zero_copy_only=False)


def read_properties(path: Path) -> dict[str, dict[str, Any]]:
    """The properties of the first recording in `path`, by name and component; several values are a list.

    The library of recordings reads only these from an ``.rrd`` without a ``.json``. A truncated file is read up to its end.

    Raises:
        ValueError: `path` holds no recording.
        OSError: `path` cannot be read.
    """
    found: dict[str, dict[str, Any]] = {}
    file = OpenFile(path)
    for chunk in RrdReader(file.path).stream():
        if not chunk.entity_path.startswith(_PROPERTIES):
            continue
        name = chunk.entity_path[len(_PROPERTIES) :].lstrip("/")
        batch = chunk.to_record_batch()
        for component, column in _data_of(batch) if batch.num_rows else ():
            if (value := column[batch.num_rows - 1].as_py()) is not None:
                key = component.rsplit(":", 1)[-1]
                found.setdefault(name, {})[key] = value[0] if len(value) == 1 else value
    return found


def store_id(path: Path) -> str:
    """Id by which messages to rerun's viewer (``viewer_control.proto``) name the recording in `path`.

    Raises ValueError, OSError or RuntimeError if there is none.
    """
    recordings = RrdReader(path).recordings()
    if not recordings:
        raise ValueError(f"{path.name} holds no recording")
    application = recordings[0].application_id.replace("\\", "\\\\").replace(":", "\\:")
    return f"Recording:{application}:{recordings[0].recording_id}"


def _data_of(batch: pa.RecordBatch) -> Iterator[tuple[str, pa.Array]]:
    """The columns of a chunk, except timelines and row ids."""
    for field, column in zip(batch.schema, batch.columns):
        if (field.metadata or {}).get(b"rerun:kind") == b"data":
            yield field.name, column


# --- pictures --------------------------------------------------------------------------------------

CACHE_BYTES = 64 << 20
"""Maximum size of the cache of decompressed chunks; the newest chunk is kept at any size."""
PICTURE_COMPONENTS: dict[Modality, str] = {
    "rgb": "EncodedImage:blob",
    "depth": "EncodedDepthImage:blob",
    "segmentation": "SegmentationImage:buffer",
}


@dataclass(frozen=True)
class _PictureChunk:
    id: str
    steps: NDArray[np.int64]
    """(R,) state index of each picture."""


class OpenFile:
    """An open ``.rrd``, usable from any thread."""

    def __init__(self, path: Path) -> None:
        """Raises OSError."""
        self.name, self._path = path.name, path
        with open_regular_file(path) as file:
            self._descriptor = os.dup(file.fileno())
        self._store: LazyStore | None = None

    @property
    def path(self) -> Path:
        """A path that rerun can open, valid while this object lives. Rerun opens only names in UTF-8; for any
        other name, the path is that of the file descriptor."""
        try:
            os.fspath(self._path).encode()
        except UnicodeEncodeError:
            return Path(f"/proc/self/fd/{self._descriptor}")
        return self._path

    def chunks(self, *content: str, is_static: bool | None = None) -> Iterator[Chunk]:
        """Read the chunks of these entities (in rerun's filter syntax), one after the other.

        Raises ValueError or RuntimeError if the file is not a complete ``.rrd``.
        """
        yield from self._opened().stream().filter(content=content, is_static=is_static)

    def entities_with(self, components: Iterable[str]) -> tuple[str, ...]:
        """Entities that have one of the components. Raises as `chunks` does."""
        columns, wanted = self._opened().schema().component_columns(), set(components)
        return tuple({column.entity_path: None for column in columns if column.component in wanted})

    def _opened(self) -> LazyStore:
        if self._store is None:
            self._store = RrdReader(self.path).store()
        return self._store

    def __del__(self) -> None:
        if hasattr(self, "_descriptor"):
            os.close(self._descriptor)

    def __reduce__(self) -> str:
        # In another process the descriptor would be a different file, which `__del__` would close.
        raise TypeError("An open recording cannot be sent to another process; send its path.")


class _ChunkCache:
    """Cache of the last used chunks of pictures, for all recordings of the process.

    An episode of ten thousand steps with four cameras is a few hundred megabytes, and a review may have sixty
    episodes open. A chunk is a few megabytes, and the next picture is usually in the same chunk.
    """

    def __init__(self) -> None:
        self._chunks: OrderedDict[tuple[int, str, str], tuple[OpenFile, pa.Array]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def rows(self, file: OpenFile, entity: str, chunk: str, component: str) -> pa.Array:
        """The rows of a component in the chunk with that id. Raises OSError."""
        # The cache keeps the file alive, so its id is not reused.
        key = (id(file), entity, chunk)
        with self._lock:
            if key in self._chunks:
                self._chunks.move_to_end(key)
                return self._chunks[key][1]
        rows = _read_rows(file, entity, chunk, component)
        with self._lock:
            if key not in self._chunks:
                self._chunks[key] = (file, rows)
                self._bytes += rows.nbytes
            while self._bytes > CACHE_BYTES and len(self._chunks) > 1:
                _, (_, gone) = self._chunks.popitem(last=False)
                self._bytes -= gone.nbytes
        return rows


_chunk_cache = _ChunkCache()


def _read_rows(file: OpenFile, entity: str, chunk: str, component: str) -> pa.Array:
    # Rerun's reader selects entities, not single chunks. To go through the 3,000 pictures of a camera takes
    # 10 ms (measured).
    try:
        for read in file.chunks(f"+ {entity}", is_static=False):
            if read.id == chunk:
                return read.to_record_batch().column(component)
    except (ValueError, RuntimeError) as error:
        raise OSError(f"{file.name} is damaged: {error}") from error
    raise OSError(f"{file.name} has changed since it was opened")


def pictures_in(
    file: OpenFile,
    entity: str,
    chunks: Sequence[_PictureChunk],
    modality: Modality,
    height: int,
    width: int,
) -> tuple[NDArray[np.int64], EncodedPictures]:
    """States (P,) of the pictures, ascending, and the pictures."""
    component = PICTURE_COMPONENTS[modality]
    states = np.concatenate([chunk.steps for chunk in chunks])
    order = np.argsort(states, kind="stable")
    begins = np.cumsum([0, *(len(chunk.steps) for chunk in chunks)])

    def one(number: int) -> bytes:
        place = int(order[number])
        part = int(np.searchsorted(begins, place, side="right")) - 1
        rows = _chunk_cache.rows(file, entity, chunks[part].id, component)
        content = rows[place - int(begins[part])].values[0].values.to_numpy().tobytes()
        if modality != "segmentation":
            return content
        # The file holds plain ids: encode them as in the journal.
        wide = len(content) == 4 * height * width
        ids = np.frombuffer(content, np.int32 if wide else np.uint16).reshape(height, width)
        return encode("segmentation", ids.astype(np.int32))

    return states[order], EncodedPictures(modality, LazyPictures(len(states), one))


def _steps(batch: pa.RecordBatch) -> NDArray[np.int64] | None:
    """(R,) state index of each row; None if the chunk has no such timeline."""
    index = batch.schema.get_field_index(STEP)
    return None if index < 0 else batch.column(index).cast(pa.int64(), safe=False).to_numpy()
