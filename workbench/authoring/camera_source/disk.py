"""An edit made on disk, or taken back: whole or not at all, and never over somebody else's newer text.

Where an edit is of two files, both are looked at before the first is written, and if the second then fails the first is
taken back.

The author has the same file open in an editor and saves when they like. So the file must still have the text that
the edit was planned on; it is replaced by a rename, which no reader sees half done; and what a text does not show
stays as it was: line ends, encoding, byte order mark, permissions, a link that leads to the file.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from workbench.authoring.camera_source.cameras import check_own
from workbench.authoring.camera_source.result import FileChange, Refusal, SourceEdit
from workbench.authoring.modules import read_exactly
from workbench.authoring.source.text import Refused
from workbench.machine.atomic_files import replace_file


def apply(edit: SourceEdit) -> Refusal | None:
    """Write the edit. None when it is done; the file is as it was when there is a reason why not."""
    return _exchange_all(edit.changes, "since the change was shown")


def revert(edit: SourceEdit) -> Refusal | None:
    """Take an applied edit back, as long as nothing else was changed in the file since."""
    back = tuple(FileChange(change.file, change.new_text, change.old_text) for change in edit.changes)
    return _exchange_all(back, "since the camera was written into it")


def not_writable(path: str) -> str | None:
    """Why an edit of this file would be refused, as far as can be told without trying."""
    try:
        real = Path(path).resolve(strict=True)
        check_own(str(real))
        mode = real.stat().st_mode
    except Refused as refused:
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


def _exchange_all(changes: tuple[FileChange, ...], since: str) -> Refusal | None:
    for change in changes if len(changes) > 1 else ():
        refusal = _exchange(change.file, change.old_text, None, since)
        if refusal is not None:
            return refusal
    done: list[FileChange] = []
    for change in changes:
        refusal = _exchange(change.file, change.old_text, change.new_text, since)
        if refusal is not None:
            left = [made.file for made in done if _exchange(made.file, made.new_text, made.old_text, since)]
            names = " and ".join(Path(path).name for path in left)
            told = f"; {names} could not be put back, and has the change without the other" if left else ""
            return Refusal(f"{refusal.reason}{told}")
        done.append(change)
    return None


def _exchange(path: str, expected: str, wanted: str | None, since: str) -> Refusal | None:
    """Put `wanted` in place of the text that is expected there; None only looks whether it could be."""
    reason = not_writable(path)
    if reason is not None:
        return Refusal(reason)
    real = Path(path).resolve()
    try:
        raw, text, encoding = read_exactly(real)
        if text != expected:
            return Refusal(f"{real.name} was edited {since}, so it is left as it is; ask again")
        if wanted is None:
            return None
        if not replace_file(real, wanted.encode(encoding), raw):
            return Refusal(
                f"{real.name} was saved by somebody else just now, so it is left as it is; ask again"
            )
    except (UnicodeError, SyntaxError) as exc:
        return Refusal(f"{real.name} cannot be written in its encoding: {exc}")
    except OSError as exc:
        return Refusal(f"{real.name} cannot be written: {exc.strerror}")
    return None
