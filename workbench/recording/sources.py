"""Which recordings somebody means by naming files, folders or rows of the library, and how each of them is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from workbench.core.geometry import SharedShapes
    from workbench.recording.episode import Episode

Kind = Literal["ours", "maniskill", "lerobot"]
"""Who made a recording: which of the three ways to read it."""


class UnreadableRecording(ValueError):
    """A file that is no recording, or a broken one; the message says what is wrong with it in a sentence."""


@dataclass(frozen=True)
class Source:
    """One recording, not read yet."""

    path: Path
    """A file of ours, ManiSkill's ``.h5``, or the folder of a LeRobot dataset."""
    part: str | None = None
    """Which of several: ``traj_3``, or the number of the dataset's episode."""
    id: str = ""
    """What the caller knows it by."""
    name: str = ""
    """For people."""

    @property
    def stem(self) -> str:
        """Of the names of what is made from it."""
        stem = self.path.name if self.kind == "lerobot" else self.path.stem
        return stem if self.part is None else f"{stem}_{self.part}"

    @property
    def kind(self) -> Kind:
        if self.part is None:
            return "ours"
        return "maniskill" if self.path.suffix == ".h5" else "lerobot"

    def read(self, shapes: SharedShapes | None = None, folder: Path | None = None) -> Episode:
        """The episode; arguments and errors as of `read_recording`."""
        # Not at the top: every worker knows sources, and few read one.
        from workbench.recording.reading import read_recording

        return read_recording(self.kind, self.path, self.part or "", shapes, folder)


def sources_among(paths: Sequence[Path]) -> tuple[Source, ...]:
    """The recordings that these files are, or that lie in these folders and the folders below them, by name, each once.

    Raises:
        FileNotFoundError: there is nothing at one of them.
        UnreadableRecording: a file is, or all folders together hold, no recording; the message says what is looked for.
    """
    from workbench.recording.reading import find_sources

    found: dict[str, Source] = {}
    for path in paths:
        path = Path(path)
        if not path.exists():
            raise FileNotFoundError(f"There is nothing at {path}: give recordings, or folders of them.")
        some = find_sources(path)
        if not some and not path.is_dir():
            raise _none_in([path])
        for source in some:
            found.setdefault(source.id, source)
    if not paths:
        raise UnreadableRecording("No recording is named: give recordings, or folders of them.")
    if not found:
        raise _none_in(paths)
    return tuple(found.values())


def _none_in(paths: Sequence[Path]) -> UnreadableRecording:
    return UnreadableRecording(
        f"There is no recording in {', '.join(map(str, paths))}: looked for are the .rrd, .h5 and .json of the workbench, "
        ".h5 with .json of ManiSkill, and LeRobot datasets."
    )
