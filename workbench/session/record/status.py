"""How keeping and recording stand, for the page. Apart from what records, which the page need not import."""

from __future__ import annotations

from dataclasses import dataclass, field

from workbench.session.process.job_lane import JobProgress


@dataclass(frozen=True)
class KeepStatus:
    said: str = ""
    """What came of the last one, once it has ended."""
    failed: bool = False
    """`said` is why it did not go well."""
    progress: JobProgress | None = None
    """In moments; None while nothing is kept."""


@dataclass(frozen=True)
class RecordingStatus:
    """What is recorded now, and what came of it."""

    active: bool = False
    env_idx: tuple[int, ...] = ()
    waiting: int = 0
    """Envs of these whose episode has not begun: their next reset is waited for."""
    steps: int = 0
    """Steps captured of the episodes under way."""
    bytes_written: int = 0
    """Of this session's episodes, those under way too."""
    episodes_written: int = 0
    being_written: int = 0
    """Episodes that are over, and whose files are being made."""
    recovered: tuple[str, ...] = ()
    """Episodes that an earlier server left half written, and that were mended at the start: their .rrd files."""
    folder: str = ""
    last_file: str | None = None
    problem: str | None = None
    """Why the recording ended, or the last file could not be written."""
    keeping: KeepStatus = field(default_factory=KeepStatus)
