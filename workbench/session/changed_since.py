"""What of a task is another now than when an episode of it was recorded, by name: ``CUBE_HALF_SIZE, evaluate``.

Whoever goes live from a recording, or has it judged again, wants to know what there is to see before they look for it.
Lines would say too much (comments, layout, what was moved); so both texts are compared symbol by symbol, as a
save is, and what changed is named as its author calls it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path, PurePath

from workbench.authoring.modules import read_source
from workbench.authoring.two_versions import TwoVersions
from workbench.recording.episode import EpisodeInfo
from workbench.session.recorded_text import NoText, below_one_folder

MOST_NAMED = 4
LOOK_EVERY = 2.0
"""Seconds between two looks at the files."""


def changed_since(
    then_file: str | None, then: Mapping[str, str], now_file: str | None, now: Mapping[str, str]
) -> str:
    """The symbols that differ; empty where none does, or where that cannot be said.

    Args:
        then_file, now_file: of the task.
        then, now: texts by path, of that file and the modules beside it.
    """
    if then_file is None or now_file is None:
        return ""
    try:
        (old_main, old), (new_main, new) = below_one_folder(then_file, then), below_one_folder(now_file, now)
    except NoText:
        return ""
    # It may be called otherwise now, a copy say; it is the task all the same.
    old = {new_main if name == old_main else name: text for name, text in old.items()}
    if old == new:
        return ""
    try:
        changed = TwoVersions(old, new).changed
    except (SyntaxError, ValueError, RecursionError):
        return ""
    names = list(dict.fromkeys(_called(path, name, new_main) for path, name in changed))
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more


def changed_on_disk(info: EpisodeInfo) -> str:
    """The same of the file that a recording names, as it is now, and of those beside it that it was recorded with."""
    file = None if info.source_file is None else Path(info.source_file)
    if file is None or not file.is_absolute() or not file.is_file():
        return ""
    try:
        _, then = below_one_folder(info.source_file or "", info.source)
    except NoText:
        return ""
    now = {}
    for name in then:
        path = file.parent / name
        if path.is_file():
            try:
                now[str(path)] = read_source(path)
            except (OSError, SyntaxError):
                return ""
    return changed_since(info.source_file, info.source, str(file), now)


class ChangesOnDisk:
    """`changed_on_disk` for who asks many times a second."""

    def __init__(self, look_every: float = LOOK_EVERY) -> None:
        self._look_every = look_every
        self._known: tuple[str, float, str] | None = None

    def of(self, info: EpisodeInfo) -> str:
        now = time.monotonic()
        if self._known is None or self._known[0] != info.id or now - self._known[1] > self._look_every:
            self._known = info.id, now, changed_on_disk(info)
        return self._known[2]


def _called(path: str, name: str, main: str) -> str:
    short = name.rpartition(".")[2].strip("()")
    return short if path == main else f"{short} of {PurePath(path).name}"
