"""A file of actions is read only as far as it is one."""

from __future__ import annotations

import io
import os
from itertools import product
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.drive.episodes import made, write
from workbench.actions.choose import read_actions


def npy(shape: tuple[int, ...], content: bytes, dtype: str = "<f8") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
    return file.getvalue() + content


@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_are_as_numpy_writes_them(tmp_path: Path, order: str) -> None:
    one = np.asarray(np.arange(12.0).reshape(4, 3), order=order)  # type: ignore[call-overload]
    np.save(tmp_path / "a.npy", one)
    np.savez_compressed(tmp_path / "b.npz", one, 2 * one)
    for name, wanted in (("a.npy", [one]), ("b.npz", [one, 2 * one])):
        assert [run.action.tolist() for run in read_actions(tmp_path / name)[0]] == [
            array.tolist() for array in wanted
        ]


def test_an_episode_of_each_array_begins_where_the_env_likes(tmp_path: Path) -> None:
    three = np.arange(24.0).reshape(2, 4, 3)
    np.save(tmp_path / "a.npy", three)
    runs, asked = read_actions(tmp_path / "a.npy")
    assert [run.name for run in runs] == ["file a.npy, its array 0", "file a.npy, its array 1"]
    assert [run.action.tolist() for run in runs] == three.tolist() and asked == {}
    assert [(run.seed, dict(run.env_states)) for run in runs] == 2 * [(-1, {})]


NO_ACTIONS = [
    np.zeros((0, 3)),
    np.zeros(3),
    np.zeros((2, 4, 3, 1)),
    np.array([["a"]]),
    np.zeros((2, 3), complex),
    np.array([[0, np.nan]]),
    np.array([[0, np.inf]]),
]


@pytest.mark.parametrize(
    ("name", "array"),
    [*product(("a.npy", "a.npz"), NO_ACTIONS), ("a.npz", np.zeros((2, 4, 3)))],
)
def test_what_is_no_list_of_actions_is_refused(tmp_path: Path, name: str, array: np.ndarray) -> None:
    (np.save if name == "a.npy" else np.savez)(tmp_path / name, array)
    with pytest.raises(ValueError, match=name):
        read_actions(tmp_path / name)


def test_a_recording_is_done_again_from_its_seed_and_one_without_actions_is_refused(
    child_process: None, tmp_path: Path
) -> None:
    h5py.File(tmp_path / "empty.h5", "w").close()
    with pytest.raises(ValueError, match="empty.h5"):
        read_actions(tmp_path / "empty.h5")
    recording = write(tmp_path, made(4, seed=8), pictures=False)
    ((run,), asked) = read_actions(recording.with_suffix(".h5"))
    assert run.seed == 8 and run.action.tolist() == [[0.5, 0.5]] * 4
    assert asked == {"control_mode": "pd_joint_delta_pos"}


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.npy", npy((10**12, 7), b"x" * 100), "claims 56000000000000 bytes"),
        ("a.npy", npy((2, 2), b"x" * 8), "cannot be read as a NumPy file"),
        ("a.npy", npy((1, 1), b"x" * 8, "|O"), "Python objects"),
        ("a.npy", b"other", "cannot be read as a NumPy file"),
        ("a.npz", b"other", "cannot be read as a NumPy file"),
    ],
)
def test_what_claims_more_than_it_has_is_refused_in_a_sentence(
    tmp_path: Path, name: str, content: bytes, says: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=says):
        read_actions(tmp_path / name)


def test_what_is_no_file_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.npy")
    (tmp_path / "b.npz").symlink_to("/dev/zero")
    for name in ("a.npy", "b.npz"):
        with pytest.raises(FileNotFoundError):
            read_actions(tmp_path / name)
