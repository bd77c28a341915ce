"""What a dead process left behind: journals become episodes, half-made files go.

A process that records may be killed at any moment: while it gathers, while it makes the files, and between two names of one
recording. Whatever it was at, its journal is there and its lock is gone, and that is all that has to be known. What is under way in a
process that lives is left alone.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from workbench.recording.episode.document import WrongDocument, read_document
from workbench.recording.episode.episode import EpisodeInfo
from workbench.recording.writing.episode_writer import SCENE_SUFFIX, tidy
from workbench.recording.writing.finish import (
    SUFFIXES,
    EpisodeFiles,
    episode_stem,
    make_files,
    temporary_files,
)
from workbench.recording.writing.from_journal import episode_in, read_header, recovered
from workbench.recording.writing.journal import FOLDER, JournalReader, claim, read_visuals
from workbench.recording.writing.publish import RecordingError, candidates, reason


def recover(folder: Path) -> list[EpisodeFiles]:
    """Make an episode of every journal in `folder` whose writer is dead; episodes of live writers are left alone.

    A journal without a control step is removed. Where one of several journals cannot be made an episode, the
    others are, and the error is raised then.

    Raises:
        RecordingError: files cannot be written, or the folder or a journal not read; the journals stay.
        MemoryError: for a journal; the others are done.
    """
    folder = Path(folder)
    if (folder / FOLDER).is_symlink():
        # Strays are removed there: another folder's files would be.
        raise RecordingError(f"Cannot recover what lies in {folder}: {FOLDER} is a link to another folder")
    made: list[EpisodeFiles] = []
    failed: Exception | None = None
    try:
        for journal in sorted((folder / FOLDER).glob("*.arrow")):
            try:
                if (files := _recover(journal, folder)) is not None:
                    made.append(files)
            except Exception as error:
                # Of any kind: nobody knows what lies there, and the others are whole.
                failed = error
        _remove_strays(folder)
        tidy(folder)
    except OSError as error:
        raise RecordingError(f"Cannot recover what lies in {folder}: {reason(error, folder)}") from error
    if isinstance(failed, RecordingError | MemoryError):
        raise failed
    if failed is not None:
        why = reason(failed, folder) if isinstance(failed, OSError) else f"{failed}."
        raise RecordingError(f"Cannot recover all that lies in {folder}: {why}") from failed
    return made


def _recover(journal: Path, folder: Path) -> EpisodeFiles | None:
    descriptor = claim(journal)
    if descriptor is None:
        return None
    try:
        files = None
        with contextlib.closing(JournalReader(journal)) as reader:
            header = read_header(reader, read_visuals(journal.with_suffix(SCENE_SUFFIX)))
            if header is not None and not _already_made(header.info, journal, folder):
                header = recovered(header)
                episode = episode_in(reader, header)
                if episode is not None and episode.length > 0:
                    files = make_files(journal, header, folder)
        journal.unlink(missing_ok=True)
        return files
    finally:
        os.close(descriptor)


def _already_made(info: EpisodeInfo, journal: Path, folder: Path) -> bool:
    """Whether the writer had come to its end; takes away what it had named of files that are not all there."""
    temporaries = dict(zip(SUFFIXES, temporary_files(journal)))
    for stem in _stems(folder, episode_stem(info)):
        if _id_of(folder / f"{stem}.json") == info.id:
            return True
        if (folder / f"{stem}.json").exists():
            continue
        for suffix, temporary in temporaries.items():
            path = folder / f"{stem}{suffix}"
            if path.exists() and temporary.exists() and os.path.samefile(path, temporary):
                path.unlink()
    return False


def _stems(folder: Path, stem: str) -> Iterator[str]:
    """Those of the names that the recording may have got which are taken."""
    for candidate in candidates(stem):
        if not any((folder / f"{candidate}{suffix}").exists() for suffix in SUFFIXES):
            return
        yield candidate


def _id_of(path: Path) -> str | None:
    try:
        return read_document(path).said["workbench"]["id"]
    except (OSError, WrongDocument, KeyError, TypeError):
        return None


def _remove_strays(folder: Path) -> None:
    """Files of a recording whose journal is gone: its writer died while it cleaned up."""
    for path in (folder / FOLDER).glob("*"):
        if path.suffix in (*SUFFIXES, SCENE_SUFFIX) and not path.with_suffix(".arrow").exists():
            path.unlink(missing_ok=True)
