"""HDF5 files that point to other files, or claim more data than they hold, are refused."""

from __future__ import annotations

import fcntl
import os
import re
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.episodes.foreign_h5 import write
from workbench.episodes.maniskill.safe_h5 import MAX_DEPTH
from workbench.episodes.reader.read_episode import read_maniskill
from workbench.episodes.reader.read_rows import read_found
from workbench.episodes.reader.scan import scan_folder
from workbench.episodes.row import UnreadableRecording

SECRET = b"the secret of another file, thirty-two bytes and more of it......"


def beside(group: h5py.Group, name: str) -> str:
    return os.fspath(Path(group.file.filename).with_name(name))


def external_link(group: h5py.Group) -> None:
    group["obs"] = h5py.ExternalLink(beside(group, "other.h5"), "/secret")


def external_storage(group: h5py.Group) -> None:
    secret = [(beside(group, "secret.txt"), 0, 32)]
    group.create_dataset("obs", shape=(4, 8), dtype=np.uint8, external=secret)


def virtual(group: h5py.Group) -> None:
    layout = h5py.VirtualLayout(shape=(4, 8), dtype=np.uint8)
    layout[:] = h5py.VirtualSource(beside(group, "other.h5"), "secret", shape=(4, 8))
    group.create_virtual_dataset("obs", layout)


def soft_link_out(group: h5py.Group) -> None:
    group["way"] = h5py.ExternalLink(beside(group, "other.h5"), "/")
    group["obs"] = h5py.SoftLink("/traj_0/way/secret")


def two_gigabytes(group: h5py.Group) -> None:
    del group["rewards"]
    group.create_dataset("rewards", shape=(1 << 29,), dtype=np.float32, chunks=(1 << 20,), compression="gzip")


def huge_chunks(group: h5py.Group) -> None:
    del group["rewards"]
    group.create_dataset("rewards", shape=(3,), maxshape=(None,), dtype=np.float32, chunks=(1 << 29,))


def circle(group: h5py.Group) -> None:
    group["obs/again"] = group


def strange_filter(group: h5py.Group) -> None:
    creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    creation.set_chunk((4, 8))
    creation.set_filter(32015, h5py.h5z.FLAG_OPTIONAL, (3,))
    space = h5py.h5s.create_simple((4, 8))
    h5py.h5d.create(group.id, b"obs", h5py.h5t.NATIVE_FLOAT, space, dcpl=creation)


def words(group: h5py.Group) -> None:
    del group["actions"]
    group["actions"] = np.array([["a"], ["b"], ["c"]], dtype="S1")


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (external_link, "traj_0/obs in another file (an external link)"),
        (external_storage, "traj_0/obs stored in another file (external storage)"),
        (virtual, "traj_0/obs composed of other files (a virtual dataset)"),
        (soft_link_out, "traj_0/way in another file (an external link)"),
        (two_gigabytes, "claims 2,147,483,648 bytes of numbers for traj_0/rewards"),
        (huge_chunks, "claims chunks of 2,147,483,648 bytes for traj_0/rewards"),
        (circle, f"groups more than {MAX_DEPTH} deep"),
        (strange_filter, "compressed with a filter that does not come with h5py (32015)"),
        (words, ""),
    ],
)
def test_links_out_of_the_file_and_oversized_claims_are_refused(
    spoil: Callable[[h5py.Group], None], says: str, tmp_path: Path
) -> None:
    (tmp_path / "secret.txt").write_bytes(SECRET)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["secret"] = np.frombuffer(SECRET[:32], np.uint8).reshape(4, 8)
    path = write(tmp_path, spoil)
    tracemalloc.start()
    try:
        with pytest.raises(UnreadableRecording, match=rf"^(traj_0 of )?theirs\.h5 .*{re.escape(says)}"):
            read_maniskill(path, "traj_0")
        ((facts, _),) = read_found(tmp_path, scan_folder(tmp_path).found["theirs"])
        if spoil in (two_gigabytes, huge_chunks):
            assert facts.problem is not None and says in facts.problem
        # The claimed size was never allocated.
        assert tracemalloc.get_traced_memory()[1] < 50 << 20
    finally:
        tracemalloc.stop()


def test_soft_links_and_compressed_datasets_within_the_file_are_read(tmp_path: Path) -> None:
    def spoil(group: h5py.Group) -> None:
        values = np.zeros((4, 3000), np.float32)
        group.create_dataset("obs/state", data=values, compression="gzip", compression_opts=9, shuffle=True)
        group.create_dataset("obs/fast", data=values, compression="lzf", fletcher32=True)
        group["obs/same"] = h5py.SoftLink("state")
        group["obs/rooted"] = h5py.SoftLink("/traj_0/obs/state")
        group["obs/word"] = np.bytes_(b"what is no number is left out")
        group.create_dataset("obs/empty", shape=(4, 0), dtype=np.float32)

    path = write(tmp_path, spoil)
    described = path.with_suffix(".json")
    kwargs = '"env_kwargs": {"sim_config": {"control_freq": 50}}, "env_id"'
    described.write_text(described.read_text().replace('"env_id"', kwargs))
    with path.open() as recorder:
        fcntl.flock(recorder, fcntl.LOCK_EX)  # as HDF5 holds it while a recorder has the file open
        read = read_maniskill(path, "traj_0")
    assert read.info.control_dt == 0.02
    shapes = {name: values.shape for name, values in read.obs.items()}
    assert shapes == {"empty": (4, 0), **dict.fromkeys(("fast", "rooted", "same", "state"), (4, 3000))}
    assert read.reward.tolist() == [1, 1, 1]


def test_one_dataset_under_many_names_is_read_in_bounded_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.episodes.maniskill.safe_h5.MAX_BYTES", 1 << 20)

    def spoil(group: h5py.Group) -> None:
        group["obs/0"] = np.arange(30_000, dtype=np.float32)
        for name in range(1, 50):
            group[f"obs/{name}"] = group["obs/0"]

    with pytest.raises(UnreadableRecording, match="GB of numbers"):
        read_maniskill(write(tmp_path, spoil), "traj_0")


PLUGINS = """
import ctypes, os, re
before = dict(os.environ)
import workbench.episodes.maniskill.safe_h5
assert dict(os.environ) == before
(hdf5,) = set(re.findall(r"/.*libhdf5[-.].*", open("/proc/self/maps").read()))
state = ctypes.c_uint(99)
assert ctypes.CDLL(hdf5).H5PLget_loading_state(ctypes.byref(state)) == 0
print(state.value)
"""


def test_no_plugin_is_loaded_and_the_environment_stays(child_process: None) -> None:
    """A file may name a filter. Workers inherit the environment, and a worker whose environment differs is not forked."""
    environment = {name: value for name, value in os.environ.items() if name != "HDF5_PLUGIN_PRELOAD"}
    printed = subprocess.run(
        [sys.executable, "-c", PLUGINS], capture_output=True, text=True, env=environment, check=True
    )
    assert printed.stdout == "0\n"
