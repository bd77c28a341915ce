"""Texts, filters and order of the library's rows, as pure functions."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from workbench.episodes.row import LibraryRow, is_stopped
from workbench.library.job_status import JobStatus
from workbench.machine.text import number_text
from workbench.page.widgets.templates import counted, size

Column = Literal["task", "date", "seed", "steps", "return", "success", "version", "tags", "note", "name"]
COLUMNS: tuple[Column, ...] = ("task", "date", "seed", "steps", "return", "success")
"""Columns of a row's first line."""
SECOND_LINE: tuple[Column, ...] = ("name", "version", "tags", "note")
HINTS: dict[Column, str] = {
    "task": "Env id of the task",
    "date": "Time of the recording",
    "seed": "Seed of the reset that began the episode",
    "steps": "Control steps",
    "return": "Sum of the rewards",
    "success": "At the last step; 'once': only earlier; 'stopped': no success, and stopped before its end",
    "version": "Hash of the task's source; orange if the open task runs another version",
    "tags": "Tags",
    "note": "Note",
    "name": "Name of the recording's files",
}


@dataclass(frozen=True)
class OpenVersion:
    """Version of the open task."""

    task: str
    source_hash: str


Outcome = Literal["all", "success", "no success", "broken"]
MEANS: dict[Outcome, str] = {
    "all": "Every recording; a recording and its exports count as one",
    "success": "Success at the last step",
    "no success": "No success at the last step, including episodes that were stopped before their end",
    "broken": "Something is wrong with the files",
}
HASH_CHARACTERS = 7
"""Number of shown characters of a source hash."""
_DESCENDING_FIRST: tuple[Column, ...] = ("date", "steps", "return", "success")


def count_recordings(rows: Iterable[LibraryRow]) -> int:
    """Number of recordings in these rows; an export or a copy does not count in addition to its original."""
    return len({row.copy_of or row.uid or row.id for row in rows})


def has_outcome(row: LibraryRow, outcome: Outcome) -> bool:
    if outcome == "success":
        return row.success is True
    if outcome == "no success":
        return row.success is False
    if outcome == "broken":
        return row.problem is not None
    return True


def has_words(row: LibraryRow, words: Sequence[str]) -> bool:
    """Whether each of these lower-case words occurs in the row's task, tags, note, name, source hash, action
    source or problem; the word ``seed:3`` matches the seed."""
    searched = "\n".join(
        (row.task, *row.tags, row.note, row.name, row.source_hash, row.acted_by, row.problem or "")
    ).lower()
    return all(
        row.seed is not None and word == f"seed:{row.seed}" if word.startswith("seed:") else word in searched
        for word in words
    )


def chosen(
    rows: Iterable[LibraryRow], words: str = "", outcome: Outcome = "all", task: str | None = None
) -> list[LibraryRow]:
    """The rows that pass a filter.

    Args:
        words: words separated by spaces; each must occur.
        task: task of the recordings; None for all.
    """
    wanted = words.lower().split()
    return [
        row
        for row in rows
        if (task is None or row.task == task) and has_outcome(row, outcome) and has_words(row, wanted)
    ]


def none_like_that(words: str, outcome: Outcome, task: str | None) -> str:
    """The message for a filter that no row passes."""
    wanted = f" of {task}" if task is not None else ""
    kinds: dict[Outcome, str] = {
        "all": "recording",
        "success": "successful recording",
        "no success": "recording without success",
        "broken": "broken recording",
    }
    kind = kinds[outcome]
    words = words.strip()
    return f"No {kind}{wanted} contains \u201c{words}\u201d." if words else f"There is no {kind}{wanted}."


def begins_descending(column: Column) -> bool:
    """Whether the first press on a column sorts in descending order."""
    return column in _DESCENDING_FIRST


def ordered(rows: Iterable[LibraryRow], column: Column, descending: bool) -> list[LibraryRow]:
    """Sort rows. Rows without a value come last in both directions; rows with equal values are sorted newest
    first."""
    newest_first = sorted(rows, key=lambda row: (-(row.written or 0.0), row.name))
    known = [row for row in newest_first if _key(row, column) is not None]
    unknown = [row for row in newest_first if _key(row, column) is None]
    known.sort(key=lambda row: _key(row, column), reverse=descending)  # type: ignore[arg-type,return-value]
    return known + unknown


def _key(row: LibraryRow, column: Column) -> float | str | None:
    """The value that a row is sorted by; None for no value."""
    if column == "date":
        return row.written
    if column == "seed":
        return row.seed
    if column == "steps":
        return row.length
    if column == "return":
        known = row.total_reward
        return known if known is not None and math.isfinite(known) else None
    if column == "success":
        return {"success": 4.0, "once": 3.0, "stopped": 2.0, "no": 1.0, "fail": 0.0}.get(_outcome(row))
    texts = {"task": row.task, "version": row.source_hash, "note": row.note, "name": row.name}
    text = " ".join(sorted(row.tags)) if column == "tags" else texts[column]
    return text.lower() or None


def cells(row: LibraryRow, running: OpenVersion | None, now: datetime.datetime) -> dict[str, Any]:
    """The texts of a row's cells.

    Args:
        running: version of the open task; None if no task is open.
        now: present time, in the time zone of the shown dates.
    """
    when = None if row.date is None else row.date.astimezone(now.tzinfo)
    env = "" if row.env_index is None else f"env {row.env_index}"
    actions = f"actions: {row.acted_by}" if row.acted_by else ""
    about = (row.name, env, size(row.size), row.control_mode, actions, row.problem)
    return {
        "task": row.task or ("?" if row.problem else ""),
        "date": "" if when is None else _short_date(when, now),
        "when": "" if when is None else f"{when:%Y-%m-%d %H:%M:%S}",
        "total": "" if row.total_reward is None else number_text(row.total_reward),
        "outcome": _outcome(row),
        "version": row.source_hash[:HASH_CHARACTERS],
        "other_version": running is not None
        and bool(row.source_hash)
        and row.task == running.task
        and row.source_hash != running.source_hash,
        "about": ", ".join(part for part in about if part),
        "remark": _remark(row),
    }


def _remark(row: LibraryRow) -> str:
    if row.recovered:
        return "cut short"
    if row.kind == "workbench" or row.problem:
        return ""
    kind = {"maniskill": "ManiSkill", "rrd only": ".rrd only", "lerobot": "LeRobot"}.get(row.kind, row.kind)
    return f"{kind} export" if row.copy_of else kind


def _outcome(row: LibraryRow) -> str:
    if row.success:
        return "success"
    if row.fail:
        return "fail"
    if row.success is None:
        return ""
    if row.success_once:
        return "once"
    return "stopped" if is_stopped(row.length, row.max_episode_steps) else "no"


def _short_date(when: datetime.datetime, now: datetime.datetime) -> str:
    if when.date() == now.date():
        return f"{when:%H:%M:%S}"
    if when.year == now.year:
        return f"{when.day} {when:%b %H:%M}"
    return f"{when.day} {when:%b %Y}"


def in_words(rows: Sequence[LibraryRow]) -> str:
    """Numbers of recordings and files, and the files' size: ``3 recordings (9 files, 1.2 MB)``."""
    files = {path for row in rows for path in row.paths}
    by_files = {row.paths: row.size for row in rows}
    what, of = counted(len(rows), "recording"), counted(len(files), "file")
    return f"{what} ({of}, {size(sum(by_files.values()))})"


def job_text(job: JobStatus, now: float) -> str:
    """State of a job, to append to the line with its counts."""
    if job.is_silent(now):
        return ", ended without a final status: if it had --job, run the same command again to resume it"
    if job.state == "stopped":
        return ", stopped"
    if job.state == "failed":
        return ", ended with a failure"
    if job.state == "done":
        return ", done"
    rate = (
        f", {job.rate:.1f} a second"
        if job.rate >= 0.1
        else f", {60 * job.rate:.1f} a minute"
        if job.rate
        else ""
    )
    left = job.seconds_left
    if left is None:
        return rate or ", opening the task"
    minutes, hours = left / 60, left / 3600
    when = f"{left:.0f} s" if left < 100 else f"{minutes:.0f} min" if minutes < 100 else f"{hours:.0f} h"
    return f"{rate}, {when} left"
