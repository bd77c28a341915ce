"""Converts journals to the files of recordings: at the end of an episode, or after its writer died."""

from __future__ import annotations

import contextlib
import datetime
import errno
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from workbench.episodes.document import WrongDocument, read_document
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.maniskill.write import write_h5, write_json
from workbench.episodes.rerun.write import write_rrd
from workbench.episodes.writing.from_journal import Header, episode_in, mark_recovered, read_header
from workbench.episodes.writing.journal import (
    FOLDER,
    SCENE_SUFFIX,
    JournalReader,
    claim,
    read_visuals,
    remove_empty_folder,
)
from workbench.episodes.writing.publish import RecordingError, candidates, publish, reason, sync_files

SUFFIXES = (".rrd", ".h5", ".json")
DAMAGED_SUFFIX = ".damaged"
"""Suffix of a damaged journal, which is kept but never read."""


@dataclass(frozen=True)
class EpisodeFiles:
    """The files of one recording; a recording without a .json does not exist."""

    rrd: Path
    h5: Path
    json: Path
    solved_at: int | None
    """First step with success; see `Episode.solved_at`."""
    means: Mapping[str, float]
    """Mean of each entry of ``evaluate()``; see `Episode.means`."""


def make_files(
    journal: Path, header: Header, folder: Path, states: int | None = None, again: bool = False
) -> EpisodeFiles:
    """Write the episode in `journal` to `folder`; the journal stays.

    Args:
        states: number of states that the journal must have; None for any.
        again: whether another process may have begun to make the files, and died; files that it published are
            used.

    Raises:
        RecordingError: the files cannot be written; none of them exists then.
        ValueError: the journal holds no state, or rerun refuses a value.
    """
    temporaries = temporary_files(journal)
    try:
        with contextlib.closing(JournalReader(journal)) as reader:
            episode = episode_in(reader, header)
            if episode is None:
                raise ValueError("the episode has no state yet: its first row is the state after the reset.")
            if states is not None and episode.length + 1 != states:
                there = f"only {episode.length + 1} of {states} states"
                raise OSError(errno.EIO, f"{there} could be read back from {journal.name}")
            if again and (stem := _already_made(header.info, journal, folder)) is not None:
                rrd, h5, json = (folder / f"{stem}{suffix}" for suffix in SUFFIXES)
                return EpisodeFiles(rrd, h5, json, episode.solved_at, episode.means)
            for path in temporaries:
                path.unlink(missing_ok=True)
            rrd, h5, json = temporaries
            write_h5(episode, h5)
            write_rrd(episode, rrd)
            write_json(episode, json, folder, (rrd, h5), header.made_here)
        sync_files(temporaries)
        rrd, h5, json = publish(temporaries, folder, episode_stem(header.info))
        return EpisodeFiles(rrd, h5, json, episode.solved_at, episode.means)
    except OSError as error:
        why = error if isinstance(error, RecordingError) else reason(error, folder)
        raise RecordingError(
            f"Cannot write the recording of {header.info.task} to {folder}: {why}"
        ) from error
    finally:
        for path in temporaries:
            # Files that cannot be deleted are left to `recover`: an error here must not hide the one above.
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


def temporary_files(journal: Path) -> tuple[Path, ...]:
    """Paths of an episode's files until they are complete."""
    return tuple(journal.with_suffix(suffix) for suffix in SUFFIXES)


def episode_stem(info: EpisodeInfo) -> str:
    """``PushCube-v1_seed0003_env03_2026-11-21T08-15-30``: task, seed, env, local time of the recording.

    An unknown seed (below 0) gives ``noseed``. Contains only letters, digits and ``_ -``: ManiSkill's replay cuts a name at a
    dot. Two episodes of the same second get the same stem; `publish` makes it unique.
    """
    when = datetime.datetime.fromisoformat(info.written_at).astimezone()
    return f"{stem_begin(info.task, info.seed)}{info.env_index:02d}_{when:%Y-%m-%dT%H-%M-%S}"


def stem_begin(task: str, seed: int) -> str:
    """Common beginning of the file stems of all episodes of a task with one seed."""
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", task).strip("-_")[:80] or "task"
    return f"{name}_{f'seed{seed:04d}' if seed >= 0 else 'noseed'}_env"


def remove_episode(folder: Path, task: str, seed: int, id: str) -> None:
    """Delete all traces of the episode with this id: its files, and the journal of a writer that died.

    Raises OSError.
    """
    for path in folder.glob(f"{stem_begin(task, seed)}*.json"):
        if _id_of(path) == id:
            for suffix in (".json", ".h5", ".rrd"):  # the .json first: without it there is no episode
                path.with_suffix(suffix).unlink(missing_ok=True)
    for path in (folder / FOLDER).glob(f"{id}.*"):
        path.unlink(missing_ok=True)


# --- after the writer died ---------------------------------------------------------------------


def recover(folder: Path) -> list[EpisodeFiles]:
    """Recover recordings from all journals in `folder` whose writer is dead (the journal's lock is free).

    A writer may die while recording, while making files, or between publishing two files of one recording;
    its journal exists in each case. A journal without a control step is deleted; a damaged journal is kept
    under another name. If one journal fails, the error is raised after the other journals are done.

    Raises:
        RecordingError: files cannot be written, the folder cannot be read, or a journal cannot be read
            completely; the journals stay.
        MemoryError: a journal needs too much memory; the other journals are done.
    """
    folder = Path(folder)
    if (folder / FOLDER).is_symlink():
        # Refuse the link: `_remove_strays` would delete files of another folder.
        raise RecordingError(
            f"Cannot recover the recordings in {folder}: {FOLDER} is a link to another folder"
        )
    made: list[EpisodeFiles] = []
    failed: Exception | None = None
    try:
        for journal in sorted((folder / FOLDER).glob("*.arrow")):
            try:
                made += _recover(journal, folder)
            except Exception as error:
                # Catches every error: a broken journal must not prevent the recovery of other journals.
                failed = error
        _remove_strays(folder)
        remove_empty_folder(folder)
    except OSError as error:
        raise RecordingError(f"Cannot recover the recordings in {folder}: {reason(error, folder)}") from error
    if isinstance(failed, RecordingError | MemoryError):
        raise failed
    if failed is not None:
        why = reason(failed, folder) if isinstance(failed, OSError) else f"{failed}."
        raise RecordingError(f"Cannot recover all recordings in {folder}: {why}") from failed
    return made


def _recover(journal: Path, folder: Path) -> list[EpisodeFiles]:
    """Recover one journal; of a damaged journal, the states before the damage. Raises as `recover` does."""
    descriptor = claim(journal)
    if descriptor is None:
        return []
    try:
        files: list[EpisodeFiles] = []
        with contextlib.closing(JournalReader(journal)) as reader:
            header = read_header(reader, read_visuals(journal.with_suffix(SCENE_SUFFIX)))
            if header is not None and _already_made(header.info, journal, folder) is None:
                header = mark_recovered(header)
                episode = episode_in(reader, header)
                if episode is not None and episode.length > 0:
                    files.append(make_files(journal, header, folder))
            lost = reader.lost_bytes()
        if not lost:
            journal.unlink(missing_ok=True)
            return files
        aside = journal.with_suffix(DAMAGED_SUFFIX)
        os.rename(journal, aside)
        before = f"The steps before are in {files[0].json.name}. " if files else ""
        raise RecordingError(
            f"A journal in {folder} is damaged, and {lost} bytes of it cannot be read. {before}The whole journal is kept in "
            f"{FOLDER}/{aside.name}."
        )
    finally:
        os.close(descriptor)


def _already_made(info: EpisodeInfo, journal: Path, folder: Path) -> str | None:
    """The stem of the episode's files, if the writer published all of them. Else deletes those that it
    published, and returns None."""
    temporaries = dict(zip(SUFFIXES, temporary_files(journal)))
    for stem in _stems(folder, episode_stem(info)):
        if _id_of(folder / f"{stem}.json") == info.id:
            return stem
        if (folder / f"{stem}.json").exists():
            continue
        for suffix, temporary in temporaries.items():
            path = folder / f"{stem}{suffix}"
            if path.exists() and temporary.exists() and os.path.samefile(path, temporary):
                path.unlink()
    return None


def _stems(folder: Path, stem: str) -> Iterator[str]:
    """Candidates for the recording's stem that are in use."""
    for candidate in candidates(stem):
        if not any((folder / f"{candidate}{suffix}").exists() for suffix in SUFFIXES):
            return
        yield candidate


def _id_of(path: Path) -> str | None:
    try:
        return read_document(path).data["workbench"]["id"]
    except (OSError, WrongDocument, KeyError, TypeError):
        return None


def _remove_strays(folder: Path) -> None:
    """Delete temporary files without a journal, left by a writer that died during its cleanup."""
    for path in (folder / FOLDER).glob("*"):
        journals = (path.with_suffix(suffix) for suffix in (".arrow", DAMAGED_SUFFIX))
        if path.suffix in (*SUFFIXES, SCENE_SUFFIX) and not any(one.exists() for one in journals):
            path.unlink(missing_ok=True)
