"""Where a recording is (`Source`), and its row in the library."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

SourceKind = Literal["workbench", "maniskill", "lerobot"]
"""The reader that opens a recording."""


class UnreadableRecording(ValueError):
    """A broken recording, or a file that is not a recording; the message is a sentence with the reason."""


@dataclass(frozen=True)
class Source:
    """Location of a recording."""

    path: Path
    """A file of a workbench recording, ManiSkill's ``.h5``, or the folder of a LeRobot dataset."""
    part: str | None = None
    """Which of several recordings in `path`: a name such as ``traj_3`` in ManiSkill's ``.h5``, or the number
    of an episode in a LeRobot dataset. None for a workbench recording."""
    id: str = ""
    """Id that the caller uses for the recording."""
    name: str = ""
    """Name to show."""
    problem: str | None = None
    """A sentence, if the recording is too damaged to be read at all."""

    @property
    def stem(self) -> str:
        """Stem for the names of files that are exported from it."""
        stem = self.path.name if self.kind == "lerobot" else self.path.stem
        return stem if self.part is None else f"{stem}_{self.part}"

    @property
    def kind(self) -> SourceKind:
        if self.part is None:
            return "workbench"
        return "maniskill" if self.path.suffix == ".h5" else "lerobot"


RecordingKind = Literal["workbench", "maniskill", "rrd only", "lerobot"]
MAX_TAG_CHARACTERS = 40
MAX_NOTE_CHARACTERS = 1000
MAX_TAGS = 20


@dataclass(frozen=True)
class Facts:
    """Metadata of a recording from its file. None means unknown."""

    kind: RecordingKind
    task: str = ""
    trajectory: str | None = None
    """Name of the recording within ManiSkill's file or a LeRobot dataset, which may hold several; None for
    other recordings."""
    uid: str = ""
    """The recording's own id; empty if it has none."""
    copy_of: str = ""
    """Id of the recording that this one was exported from; empty if unknown or not exported."""
    written: float | None = None
    """Unix seconds."""
    seed: int | None = None
    env_index: int | None = None
    length: int | None = None
    """Number of control steps."""
    max_episode_steps: int | None = None
    """The task's time limit in control steps, if known."""
    total_reward: float | None = None
    success: bool | None = None
    """Success in the last state; None for a task without success."""
    success_once: bool | None = None
    fail: bool | None = None
    control_mode: str = ""
    acted_by: str = ""
    """Source of the actions; empty if unknown."""
    source_hash: str = ""
    """Hash of the task's source; empty if unknown."""
    tags: tuple[str, ...] = ()
    note: str = ""
    recovered: bool = False
    """Whether the recording ends early, because its writer was killed."""
    problem: str | None = None
    """A sentence, if the files have a problem."""


LibraryEntry = tuple[Facts, bytes | None]
"""A recording and its thumbnail (JPEG)."""


@dataclass(frozen=True, kw_only=True)
class LibraryRow(Facts):
    """A recording in the table."""

    id: str
    """Letters, digits and ``-``; unique in its library and constant while the recording stays there: the recording's own id,
    or an id derived from its path."""
    name: str
    """Path below the library's folder without suffix; for a file with several recordings, ``#traj_3`` or the
    like is appended."""
    place: tuple[str, int]
    """Key of its files (`scan.RecordingFiles.key`), and its number among the recordings in these files."""
    paths: tuple[Path, ...]
    """Its files. The first is the one to open; *Delete* removes all of them."""
    size: int
    """Total size of `paths` in bytes."""

    @property
    def source(self) -> Source:
        """Source to read it from."""
        path = self.paths[0]
        if self.trajectory is not None:
            path = path.parents[1] if self.kind == "lerobot" else path.with_suffix(".h5")
        return Source(path, self.trajectory, self.id, self.name)

    @property
    def date(self) -> datetime.datetime | None:
        """When it was written, in UTC."""
        written = self.written
        return None if written is None else datetime.datetime.fromtimestamp(written, datetime.timezone.utc)


def is_stopped(length: int | None, max_episode_steps: int | None) -> bool:
    """Whether an episode without success was ended before the task's time limit, so that its outcome is unknown."""
    return length is not None and max_episode_steps is not None and length < max_episode_steps


def clean_facts(facts: Facts) -> Facts:
    """`facts` with valid types and bounded lengths: they come from a confined reader or an older index, which are untrusted."""
    texts = ("task", "uid", "copy_of", "control_mode", "acted_by", "source_hash")
    wholes = ("env_index", "length")
    return replace(
        facts,
        seed=known_seed(facts.seed),
        **{name: clean_text(getattr(facts, name)) for name in texts},
        **{name: integer(getattr(facts, name)) for name in wholes},
        trajectory=None if facts.trajectory is None else clean_text(facts.trajectory),
        written=number(facts.written),
        total_reward=total(facts.total_reward),
        tags=clean_tags(facts.tags),
        note=clean_note(facts.note),
        problem=None if facts.problem is None else clean_text(facts.problem, 500),
    )


# --- values from untrusted files: converted, or None if they have another type ----------------------


def clean_text(value: object, longest: int = 200) -> str:
    """A string as one line of printable characters, cut to `longest`; empty if `value` is not a string."""
    if not isinstance(value, str):
        return ""
    if len(value) <= longest and value.isprintable():
        return value.strip()
    return "".join(c if c.isprintable() else " " for c in value[: 2 * longest]).strip()[:longest]


def integer(value: object) -> int | None:
    """A 64-bit integer; a list with one item (the seed of a batched env) counts as that item."""
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or not -(2**63) <= value < 2**63:
        return None
    return value


def known_seed(value: object) -> int | None:
    """A seed; None for a negative one, which stands for an unknown seed."""
    seed = integer(value)
    return None if seed is None or seed < 0 else seed


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
    """A sum of rewards, which may be NaN or infinite."""
    if isinstance(value, float) and not math.isfinite(value):
        # Always the same NaN object: NaN != NaN, so two rows count as equal only if they hold the same
        # object.
        return math.nan if math.isnan(value) else value
    return number(value)


def boolean(value: object) -> bool | None:
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    return value if isinstance(value, bool) else None


def unix_seconds(value: object) -> float | None:
    """Unix seconds of an ISO date; a date without a time zone is in UTC."""
    if not isinstance(value, str):
        return None
    try:
        date = datetime.datetime.fromisoformat(value.replace("Z", "+00:00"))
        if date.tzinfo is None:
            date = date.replace(tzinfo=datetime.timezone.utc)
        seconds = date.timestamp()
    except (ValueError, OverflowError):
        return None
    # Up to the year 3000, because a date in 9999 can overflow in another time zone.
    return seconds if 0 <= seconds < 32503680000 else None


def clean_tags(values: object) -> tuple[str, ...]:
    """At most `MAX_TAGS` distinct tags, in order; a comma in a tag becomes a space, because commas separate
    typed tags."""
    if not isinstance(values, Iterable) or isinstance(values, (str, bytes, Mapping)):
        return ()
    tags = (clean_text(value, MAX_TAG_CHARACTERS).replace(",", " ").strip() for value in values)
    return tuple(dict.fromkeys(tag for tag in tags if tag))[:MAX_TAGS]


def clean_note(value: object) -> str:
    return clean_text(value, MAX_NOTE_CHARACTERS)
