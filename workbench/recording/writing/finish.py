"""From a journal to the three files of an episode: the one way in which recordings come to be.

The writer that comes to its end and the process that finds a dead writer's journal do the same, so what is recovered
is as good as what was never in danger.
"""

from __future__ import annotations

import contextlib
import datetime
import errno
import re
from dataclasses import dataclass
from pathlib import Path

from workbench.recording.episode.episode import EpisodeInfo
from workbench.recording.maniskill.write import write_h5, write_json
from workbench.recording.rerun.write import write_rrd
from workbench.recording.writing.from_journal import Header, episode_in
from workbench.recording.writing.journal import JournalReader
from workbench.recording.writing.publish import RecordingError, make_last, publish, reason

SUFFIXES = (".rrd", ".h5", ".json")


@dataclass(frozen=True)
class EpisodeFiles:
    """The files of one recording; without the .json the other two are not one."""

    rrd: Path
    h5: Path
    json: Path


def make_files(journal: Path, header: Header, folder: Path, states: int | None = None) -> EpisodeFiles:
    """Write the episode in `journal` to `folder`; the journal stays. `states` is how many it must hold, if that is known.

    Raises:
        RecordingError: the files cannot be written; none of them is there then.
        ValueError: the journal holds no state, or what rerun refuses.
    """
    temporaries = temporary_files(journal)
    try:
        with contextlib.closing(JournalReader(journal)) as reader:
            episode = episode_in(reader, header)
            if episode is None:
                raise ValueError("the episode has no state yet: its first row is the state after the reset.")
            if states is not None and episode.length + 1 != states:
                there = f"{episode.length + 1} of {states} states"
                raise OSError(errno.EIO, f"{there} can be read back from {journal.name}")
            for path in temporaries:
                path.unlink(missing_ok=True)
            rrd, h5, json = temporaries
            write_h5(episode, h5)
            write_rrd(episode, rrd)
            write_json(episode, json, folder, (rrd, h5), header.made_here)
        make_last(temporaries)
        return EpisodeFiles(*publish(temporaries, folder, episode_stem(header.info)))
    except OSError as error:
        why = error if isinstance(error, RecordingError) else reason(error, folder)
        raise RecordingError(
            f"Cannot write the recording of {header.info.task} to {folder}: {why}"
        ) from error
    finally:
        for path in temporaries:
            # What stays is taken away by `recover`; the files are there, or it is to be told why they are not.
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


def temporary_files(journal: Path) -> tuple[Path, ...]:
    """What the files of an episode are called until they are whole."""
    return tuple(journal.with_suffix(suffix) for suffix in SUFFIXES)


def episode_stem(info: EpisodeInfo) -> str:
    """``PushCube-v1_seed0003_env03_2026-11-21T08-15-30``: task, seed, env, local time of the recording.

    A seed below 0 says that it is not known, and the name then says ``noseed``. Only letters, digits and ``_ -`` (a dot would end the
    name for ManiSkill's replay); sorts by task, then seed, then env, then time. Two episodes of one second get the same, which `publish` keeps apart.
    """
    when = datetime.datetime.fromisoformat(info.written_at).astimezone()
    task = re.sub(r"[^A-Za-z0-9_-]+", "-", info.task).strip("-_")[:80] or "task"
    seed = f"seed{info.seed:04d}" if info.seed >= 0 else "noseed"
    return f"{task}_{seed}_env{info.env_index:02d}_{when:%Y-%m-%dT%H-%M-%S}"
