"""Which recordings are meant by naming files, folders or rows of the library; and each of them read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from workbench.core.geometry import SharedShapes
from workbench.recording.episode import Episode
from workbench.recording.reading import find_sources, read_recording
from workbench.recording.source import Source, UnreadableRecording


def read_source(source: Source, shapes: SharedShapes | None = None, folder: Path | None = None) -> Episode:
    """The episode; arguments and errors as of `read_recording`."""
    return read_recording(source.kind, source.path, source.part or "", shapes, folder)


def sources_among(paths: Sequence[Path]) -> tuple[Source, ...]:
    """The recordings that these files are, or that lie in these folders and the folders below them, by name, each once.

    Raises:
        FileNotFoundError: there is nothing at one of them.
        UnreadableRecording: a file is, or all folders together hold, no recording; the message says what is looked for.
    """
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
