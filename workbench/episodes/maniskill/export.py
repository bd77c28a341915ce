"""Writes episodes as one file of demonstrations for ManiSkill's baselines: an ``.h5`` with ``traj_0`` ..., and a ``.json``."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from workbench.episodes.document import differences_from_source, json_text
from workbench.episodes.episode import Episode, read_whole
from workbench.episodes.maniskill.sensors import missing_pictures, observed_pictures, put_pictures
from workbench.episodes.maniskill.write import maniskill_json, put_columns
from workbench.episodes.row import UnreadableRecording
from workbench.machine.text import short_line

WORKBENCH_ID = "workbench_id"
"""Key in an episode's entry of the ``.json``; its value is the id of the recording."""
_FLAT = "state"
"""The observation mode in which ManiSkill returns one vector."""


class OtherDemonstration(ValueError):
    """An episode cannot be in the same file as the others; the message is a sentence."""


@dataclass
class Demonstrations:
    """Result of an export."""

    file: Path
    episodes: int = 0
    steps: int = 0
    left_out: int = 0
    """Number of episodes that `only_successes` left out."""
    not_fitting: list[str] = field(default_factory=list)
    """A sentence for each episode that was left out because it cannot be read or does not fit the first
    one."""
    lossy: bool = False
    """Whether colour pictures come from recordings, which keep them as JPEG."""
    incomplete: list[str] = field(default_factory=list)
    """A sentence for each episode whose recording lacks some of its observations."""


def export_maniskill(
    sources: Sequence[tuple[str, Callable[[], Episode]]],
    file: Path,
    only_successes: bool = False,
    only_fitting: bool = False,
    on_progress: Callable[[int, str], None] = lambda done, doing: None,
) -> Demonstrations:
    """Write these episodes to a new ``.h5`` and its ``.json``.

    Episodes are written one by one, so memory use does not grow with their number. Observations of the mode ``state`` are one
    vector (T + 1, D), and observed pictures are in ``obs/sensor_data``, as ManiSkill records them. The files
    have temporary names until they are complete.

    Args:
        sources: for each episode a name for messages, and a function that reads it.
        file: ends in ``.h5``; neither it nor its ``.json`` may exist.
        only_successes: leave out episodes that never reach success.
        only_fitting: leave out episodes that cannot be read or do not fit the first one.
        on_progress: called with the number of finished episodes, and the name of the current one.

    Raises:
        UnreadableRecording: an episode cannot be read completely.
        OtherDemonstration: an episode has no step, has another task, or was made with other options than the first one.
        ValueError: there is no episode to write, or `file` has another suffix.
        OSError: the files cannot be written.
    """
    file = Path(file).absolute()
    if file.suffix != ".h5":
        raise ValueError(f"{file.name}: the file of demonstrations must end in .h5")
    for path in (file, file.with_suffix(".json")):
        if path.exists():
            raise FileExistsError(f"{path} exists already; give a file that does not exist yet.")
    made = Demonstrations(file)
    parts = [file.parent / f".{file.stem}.{uuid.uuid4().hex[:8]}{suffix}" for suffix in (".json", ".h5")]
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with h5py.File(parts[1], "x") as written:
            document = _write_episodes(sources, written, made, only_successes, only_fitting, on_progress)
        if document is None:
            raise ValueError("\n".join(made.not_fitting) or "There is no episode to write.")
        with parts[0].open("x") as described:
            described.write(json_text(document, indent=2))
        for part in parts:
            os.rename(part, file.with_suffix(part.suffix))
    except OSError as error:
        if isinstance(error, FileExistsError) or error.errno is None:
            raise
        raise OSError(error.errno, f"Cannot write {file}: {os.strerror(error.errno)}.") from error
    finally:
        for part in parts:
            part.unlink(missing_ok=True)
    on_progress(len(sources), "done")
    return made


def _write_episodes(
    sources: Sequence[tuple[str, Callable[[], Episode]]],
    written: h5py.File,
    made: Demonstrations,
    only_successes: bool,
    only_fitting: bool,
    on_progress: Callable[[int, str], None],
) -> dict[str, Any] | None:
    """Write each episode into a group of `written`, and count the episodes in `made`; returns the content of
    the ``.json``, or None if no episode was written. See `export_maniskill`."""
    document: dict[str, Any] | None = None
    first: dict[str, Any] | None = None
    for number, (name, read) in enumerate(sources):
        on_progress(number, name)
        try:
            episode, shape = _read_fitting(name, read, first)
        except (OtherDemonstration, UnreadableRecording) as error:
            if not only_fitting:
                raise
            made.not_fitting.append(str(error))
            continue
        success = episode.flags.get("success")
        if only_successes and (success is None or not success.any()):
            made.left_out += 1
            continue
        entry = maniskill_json(episode)
        if document is None:
            document, first = {**entry, "episodes": []}, shape
        trajectory = written.create_group(f"traj_{made.episodes}", track_order=True)
        put_columns(_flat(episode), trajectory)
        put_pictures(episode, trajectory)
        # An episode without a scene is from a file of ManiSkill, which keeps pictures without loss.
        made.lossy |= episode.geometry is not None and any("rgb" in m for m in shape["pictures"].values())
        if missing := missing_pictures(episode):
            made.incomplete.append(f"{name}: the recording lacks some observations: {missing}.")
        document["episodes"].append(
            {
                **entry["episodes"][0],
                "episode_id": made.episodes,
                WORKBENCH_ID: episode.info.id,
                **differences_from_source(episode.info),
            }
        )
        made.episodes, made.steps = made.episodes + 1, made.steps + episode.length
    return document


def _read_fitting(
    name: str, read: Callable[[], Episode], first: dict[str, Any] | None
) -> tuple[Episode, dict[str, Any]]:
    """Read an episode; returns it with its `_shape`.

    Args:
        first: `_shape` of the first episode of the file; None if this is the first one.

    Raises:
        UnreadableRecording: the episode cannot be read completely.
        OtherDemonstration: the episode has no step, or differs from the first one.
    """
    episode = read_whole(name, read)
    if episode.length == 0:
        raise OtherDemonstration(f"{name}: it has no step")
    shape = _shape(episode)
    if first is not None and (other := _difference(first, shape)):
        raise OtherDemonstration(f"{name}: {other}")
    return episode, shape


def _shape(episode: Episode) -> dict[str, Any]:
    """Values that must be the same for all episodes of a file, by name for messages."""
    info = episode.info
    return {
        "task": info.task,
        "control mode": info.control_mode,
        "arguments of the env": dict(info.env_kwargs),
        "number of action dimensions": episode.action.shape[1],
        "observations": {name: values.shape[1:] for name, values in episode.obs.items()},
        "pictures": observed_pictures(episode),
    }


def _difference(first: dict[str, Any], other: dict[str, Any]) -> str:
    """The difference of an episode from the first one, as a sentence; empty if there is none."""
    for what, wanted in first.items():
        if other[what] != wanted:
            found, expected = short_line(repr(other[what]), 300), short_line(repr(wanted), 300)
            return f"its {what}: {found}; in the first recording: {expected}"
    return ""


def _flat(episode: Episode) -> Episode:
    """The episode with its state observations joined into one vector, if its `obs_mode` contains ``state``;
    else `episode` itself."""
    mode = episode.info.env_kwargs.get("obs_mode")
    if not episode.obs or not isinstance(mode, str) or _FLAT not in mode.split("+"):
        return episode
    count = episode.length + 1
    rows = [np.asarray(values, np.float32).reshape(count, -1) for values in episode.obs.values()]
    # In a mode with pictures, the observation is a dict: the vector is its entry `_FLAT`.
    return replace(episode, obs={"" if mode == _FLAT else _FLAT: np.concatenate(rows, axis=1)})
