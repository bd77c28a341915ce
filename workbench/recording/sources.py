"""Which recordings somebody means by naming files and folders, and how each of them is read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from workbench.recording.episode import Episode
from workbench.recording.json_file import read_json
from workbench.recording.lerobot_read import is_lerobot, lerobot_rows, read_lerobot
from workbench.recording.read_episode import UnreadableRecording, read_episode, read_maniskill, trajectories

_OURS = (".rrd", ".h5", ".json")


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
            return read_episode(self.path)
        if self.path.suffix == ".h5":
            return read_maniskill(self.path, self.part)
        return read_lerobot(self.path, int(self.part))


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
        some = list(_in_folder(path) if path.is_dir() else _in_file(path))
        if not some:
            raise ValueError(
                f"There is no recording in {path}: looked for are the .rrd, .h5 and .json of the workbench, .h5 with .json of "
                "ManiSkill, and LeRobot datasets."
            )
        found.update(dict.fromkeys(some))
    return tuple(found)


def _in_file(path: Path) -> Iterator[Source]:
    if path.suffix not in _OURS:
        return
    if path.suffix == ".rrd" or _is_ours(path.with_suffix(".json")):
        yield Source(path.with_suffix(".json") if path.with_suffix(".json").is_file() else path)
    elif path.with_suffix(".h5").is_file():
        try:
            names = trajectories(path.with_suffix(".h5"))
        except UnreadableRecording:
            return
        yield from (Source(path.with_suffix(".h5"), name) for name in names)


def _in_folder(folder: Path) -> Iterator[Source]:
    if is_lerobot(folder):
        yield from (Source(folder, str(row.index)) for row in lerobot_rows(folder))
        return
    for path in sorted(folder.iterdir()):
        # What is hidden is under way, an index, or thrown away.
        if path.name.startswith("."):
            continue
        if path.is_dir():
            yield from _in_folder(path)
        elif path.suffix == ".json" or (path.suffix == ".rrd" and not path.with_suffix(".json").exists()):
            yield from _in_file(path)


def _is_ours(path: Path) -> bool:
    try:
        said = read_json(path)
    except (OSError, ValueError):
        return False
    return isinstance(said, dict) and isinstance(said.get("workbench"), dict)
