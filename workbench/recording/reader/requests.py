"""What a reader is asked for, and what it answers; and what the nursery that makes readers is asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import msgspec
from numpy.typing import NDArray

from workbench.core.scene.shapes import Material, Mesh
from workbench.recording.episode.document import CameraJson
from workbench.recording.episode.encoded_pictures import Modality
from workbench.recording.episode.episode import Episode
from workbench.recording.episode.row import LibraryEntry, Source, SourceKind


class NewReader(msgspec.Struct, tag=True):
    """Fork one that reads below these paths; its socket comes along. Answered by its process id."""

    paths: list[Path]
    episodes: bool
    """It will read whole episodes: import what that needs at once."""
    writes: Path | None = None
    """Below which it may write too."""


class Ended(msgspec.Struct, tag=True):
    """That reader was ended, or has ended. Answered by its exit status as `os.waitstatus_to_exitcode` gives it."""

    pid: int


class ReadRows(msgspec.Struct, frozen=True):
    """The rows of the files of one name; answered by `RowsRead`."""

    folder: Path
    key: bytes
    """As the system has it, which need not be text; with `sizes` and `times` a `library_scan.Found`."""
    sizes: dict[str, int]
    times: dict[str, int]


class OpenEpisode(msgspec.Struct, frozen=True):
    """An episode; answered by `EpisodeRead`. Its files stay open until `CloseEpisodes`."""

    kind: SourceKind
    path: Path
    part: str
    sharing: int
    """Episodes that are asked for with the same number share their shapes: each is sent once."""


class ReadPicture(msgspec.Struct, frozen=True):
    """A picture of an episode that is open; answered by `PictureRead`."""

    opened: int
    camera: int
    modality: Modality
    index: int
    encoded: bool
    """As it is kept, not decoded."""


class CloseEpisodes(msgspec.Struct, frozen=True):
    """Episodes that are of no use any more. Not answered."""

    opened: list[int]


class FindSources(msgspec.Struct, frozen=True):
    """Which recordings a file is, or a folder holds; answered by `SourcesFound`."""

    path: Path
    trajectories: bool = False
    """It is an ``.h5`` and is read as ManiSkill's, whatever lies beside it."""


class ReadRerunInfo(msgspec.Struct, frozen=True):
    """What rerun's viewer is told of an ``.rrd``; answered by `ToldRerun`."""

    path: Path


class Recover(msgspec.Struct, frozen=True):
    """Make episodes of what dead writers left in a folder (`recover`); answered by `Recovered`."""

    folder: Path


Request = ReadRows | OpenEpisode | ReadPicture | CloseEpisodes | FindSources | ReadRerunInfo | Recover


class RowsRead(msgspec.Struct, frozen=True):
    entries: list[LibraryEntry]


class CameraRead(msgspec.Struct, frozen=True):
    camera: CameraJson
    frame: NDArray
    pose: NDArray
    pictures: dict[Modality, int]
    """How many of each there are."""


class ShapeRead(msgspec.Struct, frozen=True):
    """A mesh and a material that were not sent before."""

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
    """Where the task's own file may be, as the recording says."""
    episode: Episode
    """Without its cameras, and without the visuals of its scene."""
    cameras: list[CameraRead]
    shapes: list[ShapeRead]
    visuals: list[VisualRead]


class PictureRead(msgspec.Struct, frozen=True):
    array: NDArray | None = None
    blob: bytes | None = None


class SourcesFound(msgspec.Struct, frozen=True):
    sources: list[Source]


class RerunInfo(msgspec.Struct, frozen=True):
    store: str | None
    """What it calls the recording."""
    blueprint: bytes | None


class Recovered(msgspec.Struct, frozen=True):
    made: list[str]
    """Names of their ``.rrd``."""


class ReadFailed(msgspec.Struct, frozen=True):
    """It cannot be had."""

    why: Literal["unreadable", "system", "gone"]
    """The content is broken; the file cannot be got at; that episode is not open (any more)."""
    message: str


Answer = RowsRead | EpisodeRead | PictureRead | SourcesFound | RerunInfo | Recovered | ReadFailed
