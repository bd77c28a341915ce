"""The texts that a recording holds, by names relative to the folder of the task's own file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePath

from workbench.authoring.task_content import source_hash
from workbench.recording.episode import EpisodeInfo


class NoText(ValueError):
    """The text of the task's own file is not among them."""


def below_one_folder(main: str, source: Mapping[str, str]) -> tuple[str, dict[str, str]]:
    """The name of the task's own file, and all texts by name. None of the names leads out of the folder: a recording is
    somebody else's file.

    Raises:
        NoText
    """
    names = {path: PurePath(path) for path in source}
    # As it was recorded every path is absolute; as it is read, as seen from the main file's folder.
    folder = PurePath(main).parent
    found: dict[str, str] = {}
    chosen = ""
    for path, pure in names.items():
        relative = pure.relative_to(folder) if pure.is_absolute() and pure.is_relative_to(folder) else pure
        if relative.is_absolute() or ".." in relative.parts or not relative.parts:
            relative = PurePath(pure.name)
        found[str(relative)] = source[path]
        if path == main or (pure.name == PurePath(main).name and not chosen):
            chosen = str(relative)
    if not chosen:
        raise NoText("this recording does not hold the text of its task's own file")
    return chosen, found


def version_of(info: EpisodeInfo) -> str:
    """`source_hash` of the text that a recording holds, and not what it says of it; empty where it holds none."""
    try:
        _, texts = below_one_folder(info.source_file or "", info.source)
    except NoText:
        return ""
    return source_hash(texts, Path())
