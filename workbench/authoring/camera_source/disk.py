"""An edit of the author's files: shown, made on disk, taken back. Whole or not at all, and never over newer text.

Where an edit is of two files, both are looked at before the first is written, and if the second then fails the first is
taken back.

The author has the same file open in an editor and saves when they like. So the file must still have the text that
the edit was planned on; it is replaced by a rename, which no reader sees half done; and what a text does not show
stays as it was: line ends, encoding, byte order mark, permissions, a link that leads to the file.
"""

from __future__ import annotations

import difflib
import os
import stat
from dataclasses import dataclass
from pathlib import Path, PurePath

from workbench.authoring.loading.library_names import LIBRARY_FOLDERS
from workbench.authoring.loading.modules import read_exactly
from workbench.authoring.source.text import RefusedEdit
from workbench.core.camera_data import CameraSettings
from workbench.machine.files import replace_file


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
    """A change of the author's files, not made yet. It is about one of them; where a constant of another module is
    changed too, that is one of `others`."""

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


def apply(edit: SourceEdit) -> None:
    """Write the edit. Raises RefusedEdit where it cannot be done; the file is as it was then."""
    _exchange_all(edit.changes, "since the change was shown")


def revert(edit: SourceEdit) -> None:
    """Take an applied edit back. Raises RefusedEdit where something else was changed in the file since, too."""
    back = tuple(FileChange(change.file, change.new_text, change.old_text) for change in edit.changes)
    _exchange_all(back, "since the camera was written into it")


def check_own(path: str) -> None:
    """Raises `RefusedEdit` for a file of an installed package: the next installation would take the change away."""
    if LIBRARY_FOLDERS & {*PurePath(path).parts}:
        raise RefusedEdit(
            f"{path} belongs to an installed package; copy the task into a folder of your own first"
        )


def not_writable(path: str) -> str | None:
    """Why an edit of this file would be refused, as far as can be told without trying."""
    try:
        real = Path(path).resolve(strict=True)
        check_own(str(real))
        mode = real.stat().st_mode
    except RefusedEdit as refused:
        return refused.reason
    except OSError as exc:
        return f"{path} cannot be read: {exc.strerror}"
    if not stat.S_ISREG(mode):
        return f"{path} is not an ordinary file"
    # To a rename the file's own mode is nothing, and to root neither is any other: so it is asked for here.
    if not mode & 0o222 or not os.access(real, os.W_OK):
        return f"{path} is read-only"
    if not os.access(real.parent, os.W_OK):
        return f"the folder {real.parent} is read-only"
    return None


def _exchange_all(changes: tuple[FileChange, ...], since: str) -> None:
    for change in changes if len(changes) > 1 else ():
        _exchange(change.file, change.old_text, None, since)
    for done, change in enumerate(changes):
        try:
            _exchange(change.file, change.old_text, change.new_text, since)
        except RefusedEdit as refused:
            left = [made.name for made in changes[:done] if not _taken_back(made, since)]
            told = f"; {' and '.join(left)} could not be put back, and has the change without the other"
            raise RefusedEdit(f"{refused.reason}{told if left else ''}") from refused


def _taken_back(change: FileChange, since: str) -> bool:
    try:
        _exchange(change.file, change.new_text, change.old_text, since)
    except RefusedEdit:
        return False
    return True


def _exchange(path: str, expected: str, wanted: str | None, since: str) -> None:
    """Put `wanted` in place of the text that is expected there; None only looks whether it could be."""
    if (reason := not_writable(path)) is not None:
        raise RefusedEdit(reason)
    real = Path(path).resolve()
    try:
        raw, text, encoding = read_exactly(real)
        if text != expected:
            raise RefusedEdit(f"{real.name} was edited {since}, so it is left as it is; ask again")
        if wanted is not None and not replace_file(real, wanted.encode(encoding), raw):
            raise RefusedEdit(
                f"{real.name} was saved by somebody else just now, so it is left as it is; ask again"
            )
    except (UnicodeError, SyntaxError) as exc:
        raise RefusedEdit(f"{real.name} cannot be written in its encoding: {exc}") from exc
    except OSError as exc:
        raise RefusedEdit(f"{real.name} cannot be written: {exc.strerror}") from exc
