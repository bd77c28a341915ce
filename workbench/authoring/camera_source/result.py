"""What comes of wanting a camera written into the author's file: an edit to be shown first, or the reason why not."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import PurePath

from workbench.core.camera_settings import CameraSettings


@dataclass(frozen=True)
class FileChange:
    """What one file says, and is to say."""

    file: str
    old_text: str
    new_text: str

    @property
    def name(self) -> str:
        return PurePath(self.file).name

    @property
    def diff(self) -> str:
        """As ``diff -u`` writes it, with three lines around each change."""
        lines = difflib.unified_diff(
            self.old_text.splitlines(), self.new_text.splitlines(), self.name, self.name, lineterm=""
        )
        return "\n".join(lines)


@dataclass(frozen=True)
class SourceEdit(FileChange):
    """A change of the author's files, not made yet: `workbench.authoring.camera_source.apply` makes it. It is about one
    of them; where a constant of another module is changed too, that is one of `others`."""

    notes: tuple[str, ...]
    """Sentences for the author: what was done otherwise than they may expect."""
    settings: CameraSettings | None
    """What the new text gives the camera, rounded as it is written. None for a camera that was removed."""
    others: tuple[FileChange, ...] = ()
    """Changes of further files, which are made and taken back along with it."""

    @property
    def changes(self) -> tuple[FileChange, ...]:
        """Of every file, the one that it is about first."""
        return (self, *self.others)

    @property
    def names(self) -> str:
        """Of the files, for a sentence."""
        return " and ".join(change.name for change in self.changes)


@dataclass(frozen=True)
class Refusal:
    """Why the file is left alone, and what the author can copy into it themselves."""

    reason: str
    snippet: str = ""
    """``CameraConfig(...)`` with the wanted settings; empty where there are none."""
