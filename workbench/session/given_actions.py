"""Actions that are known before: from a NumPy file, or demonstrations in ManiSkill's own ``.h5``.

A file of actions is a program for the robot, so it is done to its end: an episode of it does not stop at success or at
the time limit, as ManiSkill's ``replay_trajectory`` does not. A demonstration also says how its episode began (its
seed) and how it went (its env states), which is how a replay is put right where the same actions lead elsewhere:
another machine, another version, a batch that was seeded as one on a GPU.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from workbench.core.recorded_run import RecordedRun
from workbench.machine.regular_file import open_regular_file
from workbench.recording.reading import find_trajectories, read_recording
from workbench.session.step_back import run_of

MOST_BYTES = 2**30
"""Of a NumPy file, also unpacked: 20 million steps of a Panda."""
SUFFIXES = (".npy", ".npz", ".h5")


def read_given(path: Path) -> tuple[list[RecordedRun], dict[str, Any]]:
    """Read a file of actions: what each episode is to do, begun as its run did where that is known; and what of the env's
    keywords the file asks for, such as the control mode that its actions are of.

    ``.npy``: (T, A) for every episode, or (E, T, A), one for each. ``.npz``: an array (T, A) for each episode. ``.h5``:
    trajectories of ManiSkill, or a recording of the workbench.

    Raises:
        FileNotFoundError: it is not there.
        ValueError: it does not hold such; the message says what it holds.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    if path.suffix == ".h5":
        return _demonstrations(path)
    try:
        arrays = _arrays(path)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, NotImplementedError, zlib.error) as error:
        raise ValueError(f"{path} cannot be read as a NumPy file of numbers: {error}") from error
    if path.suffix == ".npy" and arrays[0].ndim == 3:
        arrays = list(arrays[0])
    for array in arrays:
        if array.ndim != 2 or array.shape[0] == 0 or array.dtype.kind not in "fiub":
            raise ValueError(
                f"{path} holds {array.dtype} of shape {array.shape}; actions are numbers of shape (steps, dimensions), in a "
                ".npy also (episodes, steps, dimensions)"
            )
    if not arrays:
        raise ValueError(f"{path} holds no array")
    names = [
        f"file {path.name}" + (f", its array {i}" if len(arrays) > 1 else "") for i in range(len(arrays))
    ]
    return [RecordedRun(name, -1, {}, _finite(path, array), {}) for name, array in zip(names, arrays)], {}


def _arrays(path: Path) -> list[NDArray]:
    """What a NumPy file holds. `np.load` would allocate what a header claims, before it looks whether it is there."""
    with open_regular_file(path, MOST_BYTES) as file:
        if path.suffix == ".npy":
            return [_array(file, path.stat().st_size)]
        with zipfile.ZipFile(file) as archive:
            if sum(member.file_size for member in archive.infolist()) > MOST_BYTES:
                raise ValueError("unpacked it is larger than any file of actions")
            found = []
            for member in archive.infolist():
                with archive.open(member) as opened:
                    found.append(_array(opened, member.file_size))
            return found


def _array(file: IO[bytes], size: int) -> NDArray:
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"it is of NumPy's format {version}")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(file)
    if dtype.hasobject:
        raise ValueError("it holds Python objects")
    length = math.prod(shape) * dtype.itemsize
    if length > size:
        raise ValueError(f"it says that it holds {length} bytes of {dtype}, and has {size}")
    content = file.read(length)
    return np.frombuffer(content, dtype, math.prod(shape)).reshape(shape, order="F" if fortran else "C")


def _demonstrations(path: Path) -> tuple[list[RecordedRun], dict[str, Any]]:
    runs, kwargs = list[RecordedRun](), dict[str, Any]()
    for name in find_trajectories(path):
        episode = read_recording("maniskill", path, name)
        if episode.length == 0:
            continue
        run = run_of(episode)
        runs.append(replace(run, name=f"file {path.name}, {name}", action=_finite(path, run.action)))
        given: Mapping[str, Any] = episode.info.env_kwargs
        kwargs = {key: given[key] for key in ("robot_uids", "control_mode") if given.get(key) is not None}
        if episode.info.control_mode is not None:
            kwargs["control_mode"] = episode.info.control_mode
    if not runs:
        raise ValueError(f"{path} holds no trajectory with actions")
    return runs, kwargs


def _finite(path: Path, actions: NDArray) -> NDArray[np.float32]:
    actions = np.asarray(actions, np.float32)
    if not np.isfinite(actions).all():
        raise ValueError(f"{path} holds actions that are NaN or infinite")
    return actions
