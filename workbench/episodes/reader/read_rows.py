"""Makes library rows from the files that share one name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from workbench.episodes import thumbnail
from workbench.episodes.document import (
    Document,
    EpisodeJson,
    WrongDocument,
    read_document,
    read_notes,
    wrong_size,
)
from workbench.episodes.episode import acted_by_text, parse_acted_by
from workbench.episodes.maniskill.safe_h5 import MAX_NODES, H5Dataset, RefusedH5, open_h5
from workbench.episodes.reader.scan import DATASET_KEY, NOTES, RecordingFiles, broken
from workbench.episodes.row import (
    Facts,
    LibraryEntry,
    RecordingKind,
    UnreadableRecording,
    boolean,
    clean_note,
    clean_tags,
    clean_text,
    integer,
    known_seed,
    total,
    unix_seconds,
)
from workbench.machine.files import NotARegularFile, open_regular_file
from workbench.machine.text import listed

MAX_EPISODES = 20_000
"""Maximum number of episodes of one file that are listed."""


def read_found(folder: Path, found: RecordingFiles, only_names: bool = False) -> list[LibraryEntry]:
    """The recordings in these files: none, one, or one per trajectory.

    A broken file becomes a row that states the problem. A ``.json`` that does not belong to a recording gives
    no row. The ``.json`` of a recording has all data of its row; only the rewards and pictures of ManiSkill's
    trajectories are in the ``.h5``. A lone ``.rrd`` must be read completely, which takes a tenth of a second
    or more.

    Args:
        only_names: skip what is slow: rewards and pictures of trajectories, and the content of a lone ``.rrd``.
    """
    try:
        entries = _read(folder, found, only_names)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RuntimeError, MemoryError) as error:
        # Untrusted files can raise anything, and one broken file must not hide the other recordings.
        entries = [_broken(found, f"cannot be read ({error})")]
    if NOTES in found.sizes:
        notes = read_notes(found.path(folder, NOTES))
        entries = [
            (facts if facts.kind == "workbench" else _with_notes(facts, notes), picture)
            for facts, picture in entries
        ]
    return entries


def _read(folder: Path, found: RecordingFiles, only_names: bool) -> list[LibraryEntry]:
    if found.key.split("/")[-2:] == DATASET_KEY and ".json" in found.sizes:
        return _lerobot_entries(folder, found)
    if ".json" in found.sizes:
        try:
            document = read_document(found.path(folder, ".json"))
        except WrongDocument as error:
            return [_broken(found, str(error))]
        if document.is_ours:
            return [_workbench_entry(found, document)]
        if document.is_maniskill:
            return _maniskill_entries(folder, found, document, only_names)
        if ".h5" in found.sizes:
            return [_broken(found, "names neither an env nor episodes")]
    elif ".h5" in found.sizes:
        name = Path(found.key).name
        return [
            broken(found, f"{name}.h5 needs {name}.json next to it, which names the env and the episodes.")
        ]
    if ".rrd" in found.sizes:
        return [(Facts("rrd only"), None) if only_names else _rrd_only(folder, found)]
    return []


def _broken(found: RecordingFiles, what: str) -> LibraryEntry:
    return broken(found, f"{Path(found.key).name}{next(iter(found.sizes))} {what}.")


def _with_notes(facts: Facts, notes: dict[str, tuple[tuple[str, ...], str]]) -> Facts:
    tags, note = notes.get(facts.trajectory or "", ((), ""))
    return replace(facts, tags=tags, note=note)


def _workbench_entry(found: RecordingFiles, document: Document) -> LibraryEntry:
    name = Path(found.key).name
    lost = [f"{name}{suffix}" for suffix in (".h5", ".rrd") if suffix not in found.sizes]
    problem = f"{' and '.join(lost)} {'is' if len(lost) == 1 else 'are'} missing." if lost else None
    try:
        written = document.description().files or {}
    except WrongDocument as error:
        written, problem = {}, problem or clean_text(f"{name}.json {error}.", 500)
    for suffix, size in found.sizes.items():
        # Compares sizes only, to list thousands of recordings without reading them. Opening a recording
        # compares checksums.
        if problem is None and (why := wrong_size(written, suffix, size)) is not None:
            problem = f"{name}{suffix} was cut short or changed: {why}."
    described = document.data["workbench"]
    facts = replace(_episode("workbench", described, found.times[".json"] / 1e9), problem=problem)
    return facts, thumbnail.from_description(described.get("thumbnail"))


def _episode(kind: RecordingKind, data: dict[str, Any], if_undated: float) -> Facts:
    """Facts of a workbench episode; its ``.json`` and ``.rrd`` use the same names."""
    made = data.get("env_kwargs")
    has_reward = not (isinstance(made, dict) and made.get("reward_mode") == "none")
    return Facts(
        kind,
        task=clean_text(data.get("task")),
        uid=clean_text(data.get("id"), 64),
        written=unix_seconds(data.get("written_at")) or if_undated,
        seed=known_seed(data.get("seed")),
        env_index=integer(data.get("env_index")),
        length=integer(data.get("length")),
        max_episode_steps=integer(data.get("max_episode_steps")),
        total_reward=total(data.get("return")) if has_reward else None,
        success=boolean(data.get("success")),
        success_once=boolean(data.get("success_once")),
        fail=boolean(data.get("fail")),
        control_mode=clean_text(data.get("control_mode")),
        acted_by=_acted_by(data.get("acted_by")),
        source_hash=clean_text(data.get("source_hash"), 64),
        tags=clean_tags(data.get("tags")),
        note=clean_note(data.get("note")),
        recovered=data.get("recovered") is True,
    )


def _acted_by(data: object) -> str:
    """Text of the sources of actions, from a list in a ``.json`` or a text in a ``.rrd``."""
    if not isinstance(data, list):
        return clean_text(data)
    try:
        return clean_text(acted_by_text(parse_acted_by(data)))
    except (TypeError, ValueError):
        return ""


def _maniskill_entries(
    folder: Path, found: RecordingFiles, document: Document, only_names: bool
) -> list[LibraryEntry]:
    """One row per episode of ManiSkill's ``RecordEpisode``, which also recorded ManiSkill's demonstrations."""
    name = Path(found.key).name
    written = found.newest / 1e9
    count = len(document.data["episodes"])
    try:
        task, problem = clean_text(document.env().env_id), None
    except WrongDocument as error:
        task, problem = "", clean_text(f"{name}.json {error}.", 500)
    if ".h5" not in found.sizes:
        if not task:
            return []  # another program's .json with "episodes"
        lost = f"{name}.h5, which {name}.json describes, is missing."
        return [(Facts("maniskill", task=task, written=written, problem=lost), None)]
    most = MAX_NODES if only_names else MAX_EPISODES
    data = [_episode_or_problem(document, number) for number in range(min(count, most))]
    names = [f"traj_{one.episode_id}" for one in data if isinstance(one, EpisodeJson)]
    totals, pictures, broken, others = _read_h5(found.path(folder, ".h5"), names, only_names)
    problem = problem or broken
    if not task and problem is None:
        problem = f"{name}.json does not name the env."
    entries: list[LibraryEntry] = []
    for one in data:
        if isinstance(one, str):
            why = problem or clean_text(f"{name}.json {one}.", 500)
            entries.append((Facts("maniskill", task=task, written=written, problem=why), None))
            continue
        trajectory = f"traj_{one.episode_id}"
        lost = None if problem or trajectory in totals else f"{name}.h5 has no {trajectory}."
        facts = Facts(
            "maniskill",
            task=task,
            trajectory=trajectory,
            copy_of=one.workbench_id or "",
            written=written,
            seed=known_seed(one.seed),
            length=integer(one.elapsed_steps),
            total_reward=totals.get(trajectory),
            success=boolean(one.success),
            fail=boolean(one.fail),
            control_mode=clean_text(one.control_mode),
            acted_by=clean_text(document.source_type),
            problem=problem or lost,
        )
        entries.append((facts, pictures.get(trajectory)))
    if others and len(names) == count:
        # The writer was killed before it wrote the .json.
        more = clean_text(f"{name}.json does not describe {listed(others)} of {name}.h5.", 500)
        entries.append((Facts("maniskill", task=task, written=written, problem=more), None))
    if count > most:
        more = f"{name}.json names {count:,} episodes; only the first {most:,} are listed."
        entries.append((Facts("maniskill", task=task, written=written, problem=more), None))
    return entries


def _episode_or_problem(document: Document, number: int) -> EpisodeJson | str:
    try:
        return document.episode(number)
    except WrongDocument as error:
        return str(error)


def _lerobot_entries(folder: Path, found: RecordingFiles) -> list[LibraryEntry]:
    """One row per episode of a LeRobot dataset; the key of its files ends in ``meta/info``."""
    # Imported late: Arrow starts threads, which must not exist at a fork.
    from workbench.episodes.lerobot.read import lerobot_rows

    written = found.newest / 1e9
    try:
        rows = lerobot_rows(found.path(folder, ".json").parents[1])
    except UnreadableRecording as error:
        return [(Facts("lerobot", written=written, problem=clean_text(str(error), 500)), None)]
    return [(replace(facts, written=written), None) for facts in rows]


def _read_h5(
    path: Path, described: list[str], only_names: bool
) -> tuple[dict[str, float | None], dict[str, bytes], str | None, list[str]]:
    """Sums of rewards (None if not recorded) and thumbnails of the trajectories in the ``.h5``, the file's problem, and the
    names of the trajectories that are not `described`."""
    totals: dict[str, float | None] = {}
    pictures: dict[str, bytes] = {}
    others: list[str] = []
    try:
        with open_h5(path) as file:
            others = sorted({name for name in file if name.startswith("traj_")} - {*described})
            for name in described:
                group = file.group(name)
                if group is None:
                    continue
                totals[name] = None
                if only_names:
                    continue
                rewards = group.get("rewards")
                if isinstance(rewards, H5Dataset) and rewards.is_numbers:
                    totals[name] = total(float(rewards.read().sum(dtype=np.float64)))
                if (picture := thumbnail.from_trajectory(group)) is not None:
                    pictures[name] = picture
    except RefusedH5 as error:
        return totals, pictures, f"{path.name} {error}.", others
    except NotARegularFile as error:
        return totals, pictures, f"{path.name} {error.strerror}.", others
    except (OSError, RuntimeError, KeyError, ValueError):
        return totals, pictures, f"{path.name} is damaged, or still being written.", others
    return totals, pictures, None, others


def _rrd_only(folder: Path, found: RecordingFiles) -> LibraryEntry:
    # Imported late: rerun takes half a second.
    from workbench.episodes.rerun.read import read_properties

    path = found.path(folder, ".rrd")
    try:
        open_regular_file(path).close()
        data = read_properties(path)
    except NotARegularFile as error:
        return _broken(found, str(error.strerror))
    except (OSError, ValueError, RuntimeError):
        return _broken(found, "is not a recording that rerun can read, or was cut short")
    episode = data.get("episode", {})
    if not episode:
        return _broken(found, "is a rerun recording, but not of an episode")
    return _episode("rrd only", episode, found.newest / 1e9), None
