"""One line of the library: what is known of a recording without opening it.

Rows are made from files that anybody may have written, edited or cut short, and from an index that another version
may have written. So every value is checked for its type on its way in, and what is of another type is treated as not
known. Texts are cut to a length that a table can bear.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

SourceKind = Literal["ours", "maniskill", "lerobot"]
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
    def kind(self) -> SourceKind:
        if self.part is None:
            return "ours"
        return "maniskill" if self.path.suffix == ".h5" else "lerobot"


RecordingKind = Literal["workbench", "maniskill", "rrd only", "lerobot"]
LONGEST_TAG = 40
LONGEST_NOTE = 1000
MOST_TAGS = 20


@dataclass(frozen=True)
class Facts:
    """What a file says of one recording in it. None is: not known."""

    kind: RecordingKind
    task: str = ""
    trajectory: str | None = None
    """Which one of the file, for a file with several (ManiSkill's), or of a LeRobot dataset."""
    uid: str = ""
    """The recording's own id; empty for files that have none."""
    written: float | None = None
    """Unix seconds."""
    seed: int | None = None
    env_index: int | None = None
    length: int | None = None
    """Actions."""
    total_reward: float | None = None
    success: bool | None = None
    """Of the last state; None for a task that knows no success."""
    success_once: bool | None = None
    fail: bool | None = None
    control_mode: str = ""
    acted_by: str = ""
    """What chose the actions, in words; empty where it is not known."""
    source_hash: str = ""
    """Empty where the task's source is not known."""
    tags: tuple[str, ...] = ()
    note: str = ""
    recovered: bool = False
    """It ends where its writer died."""
    problem: str | None = None
    """One sentence, where something is wrong with the files."""


LibraryEntry = tuple[Facts, bytes | None]
"""A recording and its thumbnail (jpeg)."""


@dataclass(frozen=True, kw_only=True)
class LibraryRow(Facts):
    """A recording in the table."""

    id: str
    """Letters, digits and ``-``; unique in its library, and the same for as long as the recording stays in it: a
    recording's own id, or one that is made of the place of a file that has none."""
    name: str
    """Of its files, with the folder below the library's and without suffix; and ``#traj_3`` of a file with several."""
    place: tuple[str, int]
    """Key of its files (`library_scan`), and which of the recordings in them it is."""
    paths: tuple[Path, ...]
    """Its files, the one to open it by first. All of them are what *delete* takes."""
    size: int
    """Bytes of `paths` together."""

    @property
    def source(self) -> Source:
        """What it is read from."""
        path = self.paths[0]
        if self.trajectory is not None:
            path = path.parents[1] if self.kind == "lerobot" else path.with_suffix(".h5")
        return Source(path, self.trajectory, self.id, self.name)

    @property
    def date(self) -> datetime.datetime | None:
        """When it was written, in UTC."""
        written = self.written
        return None if written is None else datetime.datetime.fromtimestamp(written, datetime.timezone.utc)


def clean_facts(facts: Facts) -> Facts:
    """`facts` as a table can bear them, of whichever process or version says them."""
    texts = ("task", "uid", "control_mode", "acted_by", "source_hash")
    wholes = ("seed", "env_index", "length")
    return replace(
        facts,
        **{name: clean_text(getattr(facts, name)) for name in texts},
        **{name: integer(getattr(facts, name)) for name in wholes},
        trajectory=None if facts.trajectory is None else clean_text(facts.trajectory),
        written=number(facts.written),
        total_reward=total(facts.total_reward),
        tags=clean_tags(facts.tags),
        note=clean_note(facts.note),
        problem=None if facts.problem is None else clean_text(facts.problem, 500),
    )


# --- values of any type, as what they should be or not at all ---------------------------------------


def clean_text(value: object, longest: int = 200) -> str:
    """One line of printable characters; empty for what is no text."""
    if not isinstance(value, str):
        return ""
    if len(value) <= longest and value.isprintable():
        return value.strip()
    return "".join(c if c.isprintable() else " " for c in value[: 2 * longest]).strip()[:longest]


def integer(value: object) -> int | None:
    """A whole number that fits 64 bits; lists of one number (a batched env's seed) are that number."""
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or not -(2**63) <= value < 2**63:
        return None
    return value


def number(value: object) -> float | None:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        as_float = float(value)
    except OverflowError:
        return None
    return as_float if math.isfinite(as_float) else None


def total(value: object) -> float | None:
    """A sum of rewards, NaN and infinite ones too."""
    if isinstance(value, float) and not math.isfinite(value):
        # One object, or a row would not equal itself when it is read again.
        return math.nan if math.isnan(value) else value
    return number(value)


def boolean(value: object) -> bool | None:
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    return value if isinstance(value, bool) else None


def unix_seconds(value: object) -> float | None:
    """Unix seconds of an ISO date; one without a zone is UTC."""
    if not isinstance(value, str):
        return None
    try:
        date = datetime.datetime.fromisoformat(value.replace("Z", "+00:00"))
        if date.tzinfo is None:
            date = date.replace(tzinfo=datetime.timezone.utc)
        seconds = date.timestamp()
    except (ValueError, OverflowError):
        return None
    # What a table can show as a date; 9999 with a zone is one that it cannot.
    return seconds if 0 <= seconds < 32503680000 else None


def clean_tags(values: object) -> tuple[str, ...]:
    """At most `MOST_TAGS` words, each once, in their order; a comma parts them where they are typed."""
    if not isinstance(values, Iterable) or isinstance(values, (str, bytes, Mapping)):
        return ()
    tags = (clean_text(value, LONGEST_TAG).replace(",", " ").strip() for value in values)
    return tuple(dict.fromkeys(tag for tag in tags if tag))[:MOST_TAGS]


def clean_note(value: object) -> str:
    return clean_text(value, LONGEST_NOTE)
