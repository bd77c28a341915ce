"""What a reader is asked for, and what it answers."""

from __future__ import annotations

from typing import Literal

import msgspec

from workbench.recording.document import CameraWords, SceneWords, TracksWords
from workbench.recording.encoded_pictures import Modality
from workbench.recording.episode import EpisodeInfo, Unread
from workbench.recording.library_row import Facts
from workbench.recording.reader.wire import ArrayRef
from workbench.recording.sources import Kind

PathBytes = bytes
"""A path as the system has it, which need not be text."""


class Rows(msgspec.Struct, frozen=True, tag=True):
    """The rows of the files of one name; answered by `RowsRead`."""

    folder: PathBytes
    key: PathBytes
    signature: str


class Open(msgspec.Struct, frozen=True, tag=True):
    """An episode; answered by `EpisodeRead`. Its files stay open until `Forget`."""

    kind: Kind
    path: PathBytes
    part: str
    sharing: int
    """Episodes that are asked for with the same number share their shapes: each is sent once."""


class PictureAt(msgspec.Struct, frozen=True, tag=True):
    """A picture of an episode that is open; answered by `PictureRead`."""

    opened: int
    camera: int
    modality: Modality
    index: int
    encoded: bool
    """As it is kept, not decoded."""


class Forget(msgspec.Struct, frozen=True, tag=True):
    """Episodes that are of no use any more. Not answered."""

    opened: list[int]


class Sources(msgspec.Struct, frozen=True, tag=True):
    """Which recordings a file is, or a folder holds; answered by `SourcesFound`."""

    path: PathBytes
    trajectories: bool = False
    """It is an ``.h5`` and is read as ManiSkill's, whatever lies beside it."""


class ForRerun(msgspec.Struct, frozen=True, tag=True):
    """What rerun's viewer is told of an ``.rrd``; answered by `ToldRerun`."""

    path: PathBytes


Request = Rows | Open | PictureAt | Forget | Sources | ForRerun
REQUESTS: msgspec.msgpack.Decoder[Request] = msgspec.msgpack.Decoder(Request)


class RowsRead(msgspec.Struct, frozen=True, tag=True):
    facts: list[Facts]
    thumbnails: list[bytes | None]


class CameraRead(msgspec.Struct, frozen=True):
    camera: CameraWords
    frame: ArrayRef
    pose: ArrayRef
    pictures: dict[Modality, int]
    """How many of each there are."""


class ShapeRead(msgspec.Struct, frozen=True):
    """A mesh and a material that were not sent before."""

    number: int
    vertices: ArrayRef
    faces: ArrayRef
    normals: ArrayRef | None
    uvs: ArrayRef | None
    base_color: tuple[float, float, float, float]
    metallic: float
    roughness: float
    texture: ArrayRef | None


class VisualRead(msgspec.Struct, frozen=True):
    name: str
    shape: int
    bodies: ArrayRef


class GeometryRead(msgspec.Struct, frozen=True):
    scene: SceneWords
    shapes: list[ShapeRead]
    visuals: list[VisualRead]


class EpisodeRead(msgspec.Struct, frozen=True, tag=True):
    opened: int
    info: EpisodeInfo
    source_path: str | None
    """Where the task's own file may be, as the recording says."""
    geometry: GeometryRead | None
    segmentation: dict[int, str]
    poses: ArrayRef | None
    action: ArrayRef
    action_names: list[str]
    reward: ArrayRef
    terminated: ArrayRef
    truncated: ArrayRef
    evaluate: dict[str, ArrayRef]
    cameras: list[CameraRead]
    env_states: dict[str, ArrayRef]
    obs: dict[str, ArrayRef]
    batch: dict[str, ArrayRef]
    texts: TracksWords
    unread: list[Unread]


class PictureRead(msgspec.Struct, frozen=True, tag=True):
    array: ArrayRef | None
    blob: bytes | None


class SourcesFound(msgspec.Struct, frozen=True, tag=True):
    sources: list[tuple[PathBytes, str | None, str, str]]
    """Path, part, id and name of each."""


class ToldRerun(msgspec.Struct, frozen=True, tag=True):
    store: str | None
    """What it calls the recording."""
    blueprint: bytes | None


class Failed(msgspec.Struct, frozen=True, tag=True):
    """It cannot be had."""

    why: Literal["unreadable", "system", "gone"]
    """The content is broken; the file cannot be got at; that episode is not open (any more)."""
    words: str


Answer = RowsRead | EpisodeRead | PictureRead | SourcesFound | ToldRerun | Failed
ANSWERS: msgspec.msgpack.Decoder[Answer] = msgspec.msgpack.Decoder(Answer)
