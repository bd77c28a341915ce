"""Which recordings somebody means by naming files and folders, and how each of them is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from workbench.recording.episode import Episode
from workbench.recording.reading import find_sources, read_recording


@dataclass(frozen=True)
class Source:
    """One recording, not read yet."""

    path: Path
    """A file of ours, ManiSkill's ``.h5``, or the folder of a LeRobot dataset."""
    part: str | None = None
    """Which of several: ``traj_3``, or the number of the dataset's episode."""

    @property
    def name(self) -> str:
        """For people, and for what is made from it."""
        stem = self.path.name if self.path.is_dir() else self.path.stem
        return stem if self.part is None else f"{stem}_{self.part}"

    def read(self) -> Episode:
        """The episode. Raises `UnreadableRecording` where it cannot be read."""
        if self.part is None:
            return read_recording("ours", self.path)
        return read_recording("maniskill" if self.path.suffix == ".h5" else "lerobot", self.path, self.part)


def sources_among(paths: Sequence[Path]) -> tuple[Source, ...]:
    """The recordings that these files are, or that lie in these folders and the folders below them, by name.

    Raises:
        FileNotFoundError: there is nothing at one of them.
        ValueError: one of them is, or holds, no recording; the message says what is looked for.
    """
    found: dict[Source, None] = {}
    for path in paths:
        path = Path(path)
        if not path.exists():
            raise FileNotFoundError(f"There is nothing at {path}: give recordings, or folders of them.")
        some = [Source(*found) for found in find_sources(path)]
        if not some:
            raise ValueError(
                f"There is no recording in {path}: looked for are the .rrd, .h5 and .json of the workbench, .h5 with .json of "
                "ManiSkill, and LeRobot datasets."
            )
        found.update(dict.fromkeys(some))
    return tuple(found)
