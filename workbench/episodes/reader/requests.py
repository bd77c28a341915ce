"""Requests to readers and to the fork server, and their answers."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import msgspec
from numpy.typing import NDArray

from workbench.envs.scene.shapes import Material, Mesh
from workbench.episodes.document import CameraJson
from workbench.episodes.encoded_pictures import Modality
from workbench.episodes.episode import Episode
from workbench.episodes.row import LibraryEntry, SourceKind
from workbench.episodes.sweep_results import SweepResults


class NewReader(msgspec.Struct, tag=True):
    """Fork a reader for these paths; sent with the reader's socket. Answered with the reader's process id."""

    paths: list[Path]
    writes: Path | None = None
    """Folder that the reader may write to; None for none."""


class GetExitCode(msgspec.Struct, tag=True):
    """Reap a reader that was killed or has ended. Answered with its exit code (`os.waitstatus_to_exitcode`)."""

    pid: int


class ReadRows(msgspec.Struct, frozen=True):
    """Read the library rows of the files that share one name; answered with `RowsRead`."""

    folder: Path
    key: bytes
    """Key as bytes, since it may be invalid UTF-8; with `sizes` and `times` it forms a `scan.RecordingFiles`."""
    sizes: dict[str, int]
    times: dict[str, int]
    only_names: bool = False
    """Skip what is slow to read; see `read_rows.read_found`."""


class OpenEpisode(msgspec.Struct, frozen=True):
    """Open an episode; answered with `EpisodeRead`. Its files stay open until `CloseEpisodes`."""

    kind: SourceKind
    path: Path
    part: str
    sharing: int
    """Episodes with the same number share shapes: each shape is sent once."""


class ReadPicture(msgspec.Struct, frozen=True):
    """Read a picture of an open episode; answered with `PictureRead`."""

    opened: int
    camera: int
    modality: Modality
    index: int
    encoded: bool
    """True returns the picture encoded, as `PictureRead.blob`; False returns it decoded, as
    `PictureRead.array`."""


class CloseEpisodes(msgspec.Struct, frozen=True):
    """Close episodes. Not answered."""

    opened: list[int]


class ReadStoreId(msgspec.Struct, frozen=True):
    """Read rerun's id of the recording in an ``.rrd``; answered with `StoreId`."""

    path: Path


class ReadSweep(msgspec.Struct, frozen=True):
    """Read the results of a sweep; answered with `SweepRead`."""

    path: Path


class Recover(msgspec.Struct, frozen=True):
    """Run `writing.finish_or_recover.recover` on a folder; answered with `Recovered`."""

    folder: Path


Request = ReadRows | OpenEpisode | ReadPicture | CloseEpisodes | ReadStoreId | ReadSweep | Recover


class RowsRead(msgspec.Struct, frozen=True):
    entries: list[LibraryEntry]


class CameraRead(msgspec.Struct, frozen=True):
    camera: CameraJson
    frame: NDArray
    pose: NDArray
    pictures: dict[Modality, int]
    """Number of pictures by modality."""


class ShapeRead(msgspec.Struct, frozen=True):
    """A mesh and a material, sent once."""

    number: int
    mesh: Mesh
    material: Material


class VisualRead(msgspec.Struct, frozen=True):
    name: str
    shape: int
    bodies: NDArray


class EpisodeRead(msgspec.Struct, frozen=True):
    opened: int
    source_path: str | None
    """Recorded path of the task's file."""
    episode: Episode
    """The episode without cameras, and without the visuals of its scene."""
    cameras: list[CameraRead]
    shapes: list[ShapeRead]
    visuals: list[VisualRead]


class PictureRead(msgspec.Struct, frozen=True):
    array: NDArray | None = None
    blob: bytes | None = None


class StoreId(msgspec.Struct, frozen=True):
    id: str


class SweepRead(msgspec.Struct, frozen=True):
    results: SweepResults


class Recovered(msgspec.Struct, frozen=True):
    made: list[str]
    """Names of the ``.rrd`` files of the recovered recordings."""


class ReadFailed(msgspec.Struct, frozen=True):
    """The request failed."""

    why: Literal["unreadable", "system", "gone"]
    """``unreadable``: the content is broken; ``system``: the system refuses the file; ``gone``: the episode is not open."""
    message: str


Answer = RowsRead | EpisodeRead | PictureRead | StoreId | SweepRead | Recovered | ReadFailed
