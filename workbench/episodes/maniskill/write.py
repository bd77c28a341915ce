"""Writes an episode as ManiSkill's trajectory: columns in an ``.h5``, metadata in a ``.json``."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from workbench.episodes.describe import describe_json
from workbench.episodes.document import json_text, with_checksum
from workbench.episodes.episode import Episode

TRAJECTORY = "traj_0"
_MIN_COMPRESSED_BYTES = 8 << 10
_CHUNK_BYTES = 256 << 10
_ZLIB_LEVEL = 1
"""Compression level of zlib. On numbers of a simulation, level 4 saves 1 % more and takes a third longer."""
_MAKES_UTF8 = h5py.h5p.create(h5py.h5p.LINK_CREATE)
_MAKES_UTF8.set_char_encoding(h5py.h5t.CSET_UTF8)
_ORDERED = h5py.h5p.create(h5py.h5p.GROUP_CREATE)
_ORDERED.set_link_creation_order(h5py.h5p.CRT_ORDER_TRACKED | h5py.h5p.CRT_ORDER_INDEXED)
_ORDERED.set_obj_track_times(False)


def write_h5(episode: Episode, path: Path) -> None:
    """Write `episode` to `path`, which must not exist.

    Names, types and shapes are those of ``mani_skill.utils.wrappers.record.RecordEpisode`` (3.0.1), so
    programs that read ManiSkill's demonstrations can read the file. The only episode is ``traj_0``, with
    ``actions`` (T, A) float32; ``rewards`` (T,) float32; ``terminated``, ``truncated``, and if the task has
    them ``success`` and ``fail``, each (T,) bool; ``env_states/{actors,articulations}/<name>`` (T + 1, D);
    ``obs/...`` (T + 1, ...).

    Raises:
        OSError: it cannot be written.
        ValueError: HDF5 refuses a column.
    """
    # Written in memory, because HDF5 leaves files half open on a disk error.
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        put_columns(episode, file.create_group(TRAJECTORY, track_order=True))
    with path.open("xb") as file:
        file.write(content.getbuffer())
    h5py.File(path, "r").close()  # raises for a truncated file


def put_columns(episode: Episode, trajectory: h5py.Group) -> None:
    """Write the columns of an episode into its group, in the format of `write_h5`."""
    # Groups in the file by name: looking them up with h5py is slow.
    groups: dict[tuple[str, ...], h5py.h5g.GroupID] = {(): trajectory.id}
    taken: set[tuple[str, ...]] = set()

    def add(path: str, values: NDArray) -> None:
        *folders, leaf = path.split("/")
        inside: tuple[str, ...] = ()
        while folders:
            folder = folders.pop(0)
            if (*inside, folder) in taken:  # one column is called "a", another "a/b"
                leaf = "_".join([folder, *folders, leaf])
                break
            if (*inside, folder) not in groups:
                parent = groups[inside]
                groups[(*inside, folder)] = h5py.h5g.create(parent, folder.encode(), _MAKES_UTF8, _ORDERED)
            inside = (*inside, folder)
        while (*inside, leaf) in taken or (*inside, leaf) in groups:
            leaf += "_"
        taken.add((*inside, leaf))
        _put(groups[inside], leaf, values)

    for name, values in episode.obs.items():
        add("/".join(["obs", *_parts(name)]), values)
    add("actions", episode.action)
    add("terminated", episode.terminated)
    add("truncated", episode.truncated)
    for name, flags in episode.flags.items():
        add(name, flags[1:])
    for name, values in episode.env_states.items():
        add("/".join(["env_states", *_parts(name)]), values)
    add("rewards", episode.reward)


def _put(parent: h5py.h5g.GroupID, name: str, values: NDArray) -> None:
    """Write a dataset with HDF5's low-level calls: h5py's high-level calls take longer than writing the numbers."""
    kind, space = _kind(values.dtype), h5py.h5s.create_simple(values.shape)
    row = math.prod(values.shape[1:]) * values.dtype.itemsize
    packing = _packed(values.shape, row) if row * values.shape[0] >= _MIN_COMPRESSED_BYTES else _PLAIN
    dataset = h5py.h5d.create(parent, name.encode(), kind, space, packing, _MAKES_UTF8)
    if values.size:
        # Pass the type: without it, h5py would create the type again, which takes longer than writing.
        dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, np.ascontiguousarray(values), kind)


@cache
def _kind(dtype: np.dtype) -> h5py.h5t.TypeID:
    return h5py.h5t.py_create(dtype, logical=True)


def _plain() -> h5py.h5p.PropDCID:
    packing = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    packing.set_obj_track_times(False)
    return packing


_PLAIN = _plain()


def _packed(shape: tuple[int, ...], row: int) -> h5py.h5p.PropDCID:
    """Compressed storage layout of a dataset whose rows have `row` bytes. For a dataset smaller than
    `_MIN_COMPRESSED_BYTES`, use `_PLAIN`: the index of its chunks would cost more than the compression saves.

    A chunk must fit HDF5's cache of 1 MB, because ManiSkill's replay reads row by row.
    """
    packing = _plain()
    packing.set_chunk((min(max(_CHUNK_BYTES // row, 1), shape[0]), *shape[1:]))
    packing.set_shuffle()
    packing.set_deflate(_ZLIB_LEVEL)
    return packing


def write_json(episode: Episode, path: Path, folder: Path, files: Sequence[Path], sealed: bool) -> None:
    """Write ManiSkill's metadata of the episode to `path`, and the workbench's own under the key
    ``workbench``. Raises OSError.

    Args:
        folder: folder of the recording.
        files: the other two files of the recording.
        sealed: add this installation's seal.
    """
    described = describe_json(episode, folder, files, sealed)
    content = with_checksum(json_text({**maniskill_json(episode), "workbench": described}, indent=2).encode())
    with path.open("xb") as file:
        file.write(content)


def maniskill_json(episode: Episode) -> dict[str, Any]:
    """ManiSkill's metadata of a file with this episode as ``traj_0``."""
    info = episode.info
    seed = info.seed if info.seed >= 0 else None
    entry: dict[str, Any] = {
        "episode_id": 0,
        "episode_seed": seed,
        "control_mode": info.control_mode,
        "elapsed_steps": episode.length,
        "reset_kwargs": {"options": info.reset_options, **({} if seed is None else {"seed": seed})},
    }
    for name, values in episode.flags.items():
        entry[name] = bool(values[-1])
    return {
        "env_info": {
            "env_id": info.task,
            "env_kwargs": {"control_mode": info.control_mode, **info.env_kwargs},
            "max_episode_steps": info.max_episode_steps,
        },
        "commit_info": None,
        "episodes": [entry],
        "source_type": "workbench",
        "source_desc": f"recorded with maniskill-workbench {info.versions.get('maniskill-workbench', '')}".strip(),
    }


def _parts(name: str) -> list[str]:
    """Names of the nested groups; ``.`` becomes ``_``, because HDF5 reads it as the current group."""
    return ["_" if part == "." else part for part in name.split("/") if part]
