"""Applies and reverts edits of the author's files. An edit is refused if a file lacks the expected text."""

from __future__ import annotations

import difflib
import os
import stat
from dataclasses import dataclass
from pathlib import Path, PurePath

from workbench.envs.camera_data import CameraSettings
from workbench.machine.files import replace_file
from workbench.source.parsed import RefusedEdit
from workbench.task.library_names import LIBRARY_FOLDERS
from workbench.task.modules import read_exactly


@dataclass(frozen=True)
class FileChange:
    """Old and new text of one file."""

    file: str
    old_text: str
    new_text: str

    @property
    def name(self) -> str:
        return PurePath(self.file).name

    @property
    def diff(self) -> str:
        """Unified diff, with three lines of context."""
        lines = difflib.unified_diff(
            self.old_text.splitlines(), self.new_text.splitlines(), self.name, self.name, lineterm=""
        )
        return "\n".join(lines)


@dataclass(frozen=True)
class SourceEdit(FileChange):
    """A planned change of one of the author's files, and of `others` if constants of other modules change too.

    The author may save the same files in an editor meanwhile. So an edit is refused unless each file still
    has its `old_text`. A file is replaced by a rename, and keeps its line ends, encoding, byte order mark,
    permissions and symbolic links. All files are checked before the first is written; if writing a file
    fails, the files written before it are reverted.
    """

    notes: tuple[str, ...]
    """Sentences for the author about unexpected parts of the edit."""
    settings: CameraSettings | None
    """The camera's settings in the new text, rounded as written. None for a removed camera."""
    others: tuple[FileChange, ...] = ()
    """Changes of further files, applied and reverted together with this one."""

    @property
    def changes(self) -> tuple[FileChange, ...]:
        """Changes of all files, the main one first."""
        return (self, *self.others)

    @property
    def names(self) -> str:
        """Names of the files, for messages."""
        return " and ".join(change.name for change in self.changes)


def apply(edit: SourceEdit) -> None:
    """Write the edit. Raises RefusedEdit if it cannot be written; the files are then unchanged."""
    _replace_all(edit.changes, "since the change was shown")


def revert(edit: SourceEdit) -> None:
    """Undo an applied edit. Raises RefusedEdit if a file was changed since."""
    back = tuple(FileChange(change.file, change.new_text, change.old_text) for change in edit.changes)
    _replace_all(back, "since the change was written into it")


def check_own(path: str) -> None:
    """Raise `RefusedEdit` for a file of an installed package: the next installation would overwrite the edit."""
    if LIBRARY_FOLDERS & {*PurePath(path).parts}:
        raise RefusedEdit(
            f"{path} belongs to an installed package; copy the task into a folder of your own first"
        )


def why_not_writable(path: str) -> str | None:
    """Why an edit of this file would be refused, checked without writing; None if it may succeed."""
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
    # Check the mode here: a rename ignores the file's mode, and root ignores every mode.
    if not mode & 0o222 or not os.access(real, os.W_OK):
        return f"{path} is read-only"
    if not os.access(real.parent, os.W_OK):
        return f"the folder {real.parent} is read-only"
    return None


def _replace_all(changes: tuple[FileChange, ...], since: str) -> None:
    for change in changes if len(changes) > 1 else ():
        _replace_text(change.file, change.old_text, None, since)
    for done, change in enumerate(changes):
        try:
            _replace_text(change.file, change.old_text, change.new_text, since)
        except RefusedEdit as refused:
            left = [made.name for made in changes[:done] if not _reverted(made, since)]
            incomplete = f"; {' and '.join(left)} could not be restored: the change stays there"
            raise RefusedEdit(f"{refused.reason}{incomplete if left else ''}") from refused


def _reverted(change: FileChange, since: str) -> bool:
    try:
        _replace_text(change.file, change.new_text, change.old_text, since)
    except RefusedEdit:
        return False
    return True


def _replace_text(path: str, expected: str, new_text: str | None, since: str) -> None:
    """Replace the text `expected` of a file by `new_text`. If `new_text` is None, only check that the
    file has this text and can be written."""
    if (reason := why_not_writable(path)) is not None:
        raise RefusedEdit(reason)
    real = Path(path).resolve()
    try:
        raw, text, encoding = read_exactly(real)
        if text != expected:
            raise RefusedEdit(f"{real.name} was edited {since}, so it was not changed; try again")
        if new_text is not None and not replace_file(real, new_text.encode(encoding), raw):
            raise RefusedEdit(
                f"{real.name} was saved by another program just now, so it was not changed; try again"
            )
    except (UnicodeError, SyntaxError) as exc:
        raise RefusedEdit(f"{real.name} cannot be written in its encoding: {exc}") from exc
    except OSError as exc:
        raise RefusedEdit(f"{real.name} cannot be written: {exc.strerror}") from exc
