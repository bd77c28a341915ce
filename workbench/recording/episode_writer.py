"""An episode while it happens: rows go in, and three files come out at the end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from workbench.core.geometry import SceneGeometry
from workbench.core.pictures import CameraInfo
from workbench.recording.episode import EpisodeInfo
from workbench.recording.row import EpisodeRow


@dataclass(frozen=True)
class EpisodeFiles:
    rrd: Path
    h5: Path
    json: Path


class EpisodeWriter:
    """`append` rows (the first is the state after the reset), then `finish` or `discard`.

    It has one owner at a time, which may hand it to another thread for `finish`. `len()` is the number of control steps so far, `bytes_written` what lies
    in the journal.
    """

    def __init__(
        self,
        folder: Path,
        info: EpisodeInfo,
        geometry: SceneGeometry,
        segmentation: Mapping[int, str],
        action_names: Sequence[str],
        cameras: Sequence[CameraInfo],
    ) -> None:
        """`folder` is made if missing.

        Raises:
            RecordingError: nothing can be written there.
        """
        raise NotImplementedError

    @property
    def info(self) -> EpisodeInfo:
        raise NotImplementedError

    @property
    def bytes_written(self) -> int:
        raise NotImplementedError

    def __len__(self) -> int:
        raise NotImplementedError

    def append(self, row: EpisodeRow) -> None:
        """The next state.

        Raises:
            ValueError: `row` does not fit the episode; the episode is as it was.
            RecordingError: the journal cannot be written any more (also of an earlier row, since writing lags behind).
        """
        raise NotImplementedError

    def finish(self) -> EpisodeFiles:
        """Make the files of the episode so far.

        Raises:
            ValueError: there is no state yet.
            RecordingError: they cannot be written; the journal stays for `recover`, nothing else does.
        """
        raise NotImplementedError

    def discard(self) -> None:
        """Forget the episode: nothing of it stays on the disk."""
        raise NotImplementedError
