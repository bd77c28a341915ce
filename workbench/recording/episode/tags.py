"""Tags and notes of recordings: where they are kept, so that they are there when the recording is.

They are the only thing in a library that a person typed, and the index is thrown away without asking. So they lie with
the recordings. A recording of ours has its description in its ``.json``, which has to be moved with it or it is no
recording; tags and note are two entries of that description (``workbench.tags``, ``workbench.note``), and go wherever
it goes. This is the one thing about a recording that changes after it was written: the file is made anew beside the
old one and takes its place in one step, and everything else in it stays.

Files of others are not ours to write into (ManiSkill's recorder writes its ``.json`` anew after each episode, and a
bare ``.rrd`` cannot be changed). Theirs lie in ``NAME.notes`` beside them, by trajectory, which ``mv NAME.*``
takes along.
"""

from __future__ import annotations

import json
from pathlib import Path

from workbench.machine.files import open_regular_file, replace_file
from workbench.recording.episode.document import Document, read_json
from workbench.recording.episode.row import clean_note, clean_tags

MOST_NOTES_BYTES = 16 << 20
"""Of a ``.notes``, and of the ``.json`` of a recording of ours, which holds its task's source and one small picture."""
_NOTES = "workbench_notes"


def read_notes(path: Path) -> dict[str, tuple[tuple[str, ...], str]]:
    """Tags and note of each trajectory ("" where the file has no trajectories) in a ``.notes``; what is not
    one holds none."""
    try:
        return _notes(path)
    except (OSError, ValueError):
        return {}


def write_notes(path: Path, trajectory: str | None, tags: tuple[str, ...], note: str) -> None:
    """Put tags and note of one trajectory into a ``.notes``; without any left, the file goes.

    Raises:
        OSError: the file cannot be read, or the folder not written to.
        ValueError: there is something else in the file, which is not written over. The message is a sentence's end.
    """
    try:
        entries = _notes(path)
    except FileNotFoundError:
        entries = {}
    entries.pop(trajectory or "", None)
    if tags or note:
        entries[trajectory or ""] = (tags, note)
    if not entries:
        path.unlink(missing_ok=True)
        return
    plain = {name: {"tags": list(tags), "note": note} for name, (tags, note) in sorted(entries.items())}
    replace_file(path, json.dumps({_NOTES: plain}, indent=2, ensure_ascii=False).encode())


def _notes(path: Path) -> dict[str, tuple[tuple[str, ...], str]]:
    """Raises OSError, ValueError."""
    try:
        entries = read_json(path, MOST_NOTES_BYTES)[_NOTES]
        return {
            str(name): (clean_tags(entry.get("tags")), clean_note(entry.get("note")))
            for name, entry in entries.items()
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path.name} holds no notes that this version can read: move it away") from error


def write_into_description(path: Path, tags: tuple[str, ...], note: str) -> None:
    """Put tags and note into the ``.json`` of a recording of ours.

    Raises:
        OSError: it cannot be read or written.
        ValueError: it is no recording of ours. The message is the end of a sentence.
    """
    described = read_json(path, MOST_NOTES_BYTES)
    if not isinstance(described, dict) or not Document(described).is_ours:
        raise ValueError("is not a recording of the workbench")
    described["workbench"] |= {"tags": list(tags), "note": note}
    # Indented as what was read: these files are looked at.
    with open_regular_file(path) as file:
        indent = 2 if b"\n" in file.read(4) else None
    replace_file(path, json.dumps(described, indent=indent).encode())
