"""Write an episode as ManiSkill's own trajectory: an ``.h5`` with the columns and a ``.json`` that says what they are of.

Whatever reads ManiSkill's demonstrations then reads ours: its replay, its datasets, the training code of half the field.
Names, types and shapes are those of ``mani_skill.utils.wrappers.record.RecordEpisode`` (3.0.1), one episode a file, ``traj_0``:

- ``actions`` (T, A) float32, ``rewards`` (T,) float32, ``terminated``, ``truncated``, and ``success`` and ``fail`` if the task has them,
  (T,) bool, ``env_states/{actors,articulations}/<name>`` (T + 1, D), ``obs/...`` (T + 1, ...).
- the ``.json``: ``env_info``, ``commit_info``, ``episodes`` and ``source_type`` as there; ``workbench`` besides (see `description`).

HDF5 writes into a `SafeFile`, which knows whether the disk took every byte, and opens it again at the end.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from workbench.recording.columns import EVALUATE, OBS, STATE
from workbench.recording.description import describe_beside
from workbench.recording.landing import SafeFile
from workbench.recording.survey import Piece, Survey

TRAJECTORY = "traj_0"
_WORTH_PACKING = 8 << 10
_CHUNK_BYTES = 256 << 10
_LEVEL = 1
"""Of zlib. Of numbers of a simulation level 4 takes away 1 % more, in a third more time."""
_MAKES_UTF8 = h5py.h5p.create(h5py.h5p.LINK_CREATE)
_MAKES_UTF8.set_char_encoding(h5py.h5t.CSET_UTF8)


class _Dataset:
    """A column on its way into the file, by HDF5's own calls: h5py's slices take longer than the numbers."""

    def __init__(
        self,
        parent: h5py.Group,
        name: str,
        shape: tuple[int, ...],
        dtype: np.dtype,
        column: str,
        from_state: int,
    ) -> None:
        self._column, self._from_state, self._dtype = column, from_state, dtype
        self._rows, self._row_shape = shape[0], shape[1:]
        space = h5py.h5s.create_simple(shape)
        kind = h5py.h5t.py_create(dtype, logical=True)
        self._dataset = h5py.h5d.create(
            parent.id, name.encode(), kind, space, _packing(shape, dtype), _MAKES_UTF8
        )

    def take(self, piece: Piece) -> None:
        skip = max(self._from_state - piece.first, 0)
        values = piece.columns[self._column][skip:]
        if self._dtype == np.bool_ and values.dtype != np.bool_:
            values = np.nan_to_num(values.astype(np.float64)) != 0
        values = np.ascontiguousarray(values, dtype=self._dtype)
        if not values.size:
            return
        everything = h5py.h5s.ALL
        if len(values) == self._rows:
            self._dataset.write(everything, everything, values)
            return
        begin = (piece.first + skip - self._from_state, *(0 for _ in self._row_shape))
        into = self._dataset.get_space()
        into.select_hyperslab(begin, values.shape)
        self._dataset.write(h5py.h5s.create_simple(values.shape), into, values)


def _packing(shape: tuple[int, ...], dtype: np.dtype) -> h5py.h5p.PropDCID:
    """How HDF5 is to keep a dataset: compressed where that saves more than the index of its chunks costs.

    ManiSkill compresses pictures alone. Whoever reads it does not notice, as long as a chunk fits HDF5's cache of 1 MB: row by row is how
    ManiSkill's replay reads.
    """
    packing = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    packing.set_obj_track_times(False)
    row = int(np.prod(shape[1:])) * dtype.itemsize
    if row * shape[0] >= _WORTH_PACKING:
        packing.set_chunk((min(max(_CHUNK_BYTES // row, 1), shape[0]), *shape[1:]))
        packing.set_shuffle()
        packing.set_deflate(_LEVEL)
    return packing


class H5Writer:
    """`take` the pieces of an episode in order. Made by `h5_writer`."""

    def __init__(self, file: h5py.File, survey: Survey) -> None:
        length = survey.length
        self.datasets: list[_Dataset] = []
        # What is in the file, so that h5py, which is slow to say, need not be asked.
        groups: dict[tuple[str, ...], h5py.Group] = {(): file.create_group(TRAJECTORY, track_order=True)}
        taken: set[tuple[str, ...]] = set()

        def add(path: str, column: str, from_state: int, dtype: Any = None) -> None:
            *folders, leaf = path.split("/")
            inside: tuple[str, ...] = ()
            while folders:
                folder = folders.pop(0)
                if (*inside, folder) in taken:  # something is called "a", and something "a/b"
                    leaf = "_".join([folder, *folders, leaf])
                    break
                if (*inside, folder) not in groups:
                    groups[(*inside, folder)] = groups[inside].create_group(folder, track_order=True)
                inside = (*inside, folder)
            while (*inside, leaf) in taken or (*inside, leaf) in groups:
                leaf += "_"
            taken.add((*inside, leaf))
            what = survey.columns[column]
            shape = (length + 1 - from_state, *what.shape)
            kind = np.dtype(dtype or what.dtype)
            self.datasets.append(_Dataset(groups[inside], leaf, shape, kind, column, from_state))

        for name in survey.named(OBS):
            add("/".join(["obs", *_parts(name)]), OBS + name, 0)
        add("actions", "action", 1, np.float32)
        add("terminated", "terminated", 1, np.bool_)
        add("truncated", "truncated", 1, np.bool_)
        for name in survey.flags:
            add(name, EVALUATE + name, 1, np.bool_)
        for name in survey.named(STATE):
            add("/".join(["env_states", *_parts(name)]), STATE + name, 0)
        add("rewards", "reward", 1, np.float32)

    def take(self, piece: Piece) -> None:
        for dataset in self.datasets:
            dataset.take(piece)


@contextmanager
def h5_writer(survey: Survey, path: Path) -> Iterator[H5Writer]:
    """Write the episode of `survey` to `path`, which must not exist; the file is whole when the block is left.

    Raises:
        OSError: it cannot be written.
        ValueError: two of its columns want one name.
    """
    safe = SafeFile(path)
    try:
        with h5py.File(safe, "w") as file:
            writer = H5Writer(file, survey)
            yield writer
        safe.finish()
        h5py.File(path, "r").close()  # refuses a file that is shorter than it says of itself
    except (OSError, RuntimeError) as error:
        raise (safe.error or error) from error
    finally:
        safe.close()


def write_json(survey: Survey, path: Path, folder: Path, files: Sequence[Path]) -> None:
    """Write what is to be said of the episode, and of its other `files`, to `path`; they will lie in `folder`. Raises OSError."""
    content = json.dumps(_document(survey, folder, files), indent=2, default=str).encode()
    with path.open("xb") as file:
        file.write(content)


def _document(survey: Survey, folder: Path, files: Sequence[Path]) -> dict[str, Any]:
    info = survey.info
    seed = info.seed if info.seed >= 0 else None
    episode: dict[str, Any] = {
        "episode_id": 0,
        "episode_seed": seed,
        "control_mode": info.control_mode,
        "elapsed_steps": survey.length,
        "reset_kwargs": {"options": info.reset_options, **({} if seed is None else {"seed": seed})},
    }
    for name, values in survey.flags.items():
        episode[name] = bool(values[-1])
    return {
        "env_info": {
            "env_id": info.task,
            "env_kwargs": {"control_mode": info.control_mode, **info.env_kwargs},
            "max_episode_steps": info.max_episode_steps,
        },
        "commit_info": None,
        "episodes": [episode],
        "source_type": "workbench",
        "source_desc": f"recorded with maniskill-workbench {info.versions.get('maniskill-workbench', '')}".strip(),
        "workbench": describe_beside(survey, folder, files),
    }


def _parts(name: str) -> list[str]:
    """Names of nested groups; HDF5 reads a dot as "here"."""
    return ["_" if part == "." else part for part in name.split("/") if part]
