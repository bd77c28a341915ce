"""A recording is there, whole, under a name of its own, or it is not there at all."""

from __future__ import annotations

import dataclasses
import datetime
import errno
import os
import re
import resource
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import rerun as rr
from hypothesis import given
from hypothesis import strategies as st

from workbench.core.geometry import Mesh
from workbench.recording import layout, rrd
from workbench.recording.episode import Episode
from workbench.recording.read import read_rrd
from workbench.recording.rrd import RecordingError, episode_filename, write_rrd
from workbench.recording.verify import verify_rrd

Maker = Callable[..., Episode]


@pytest.fixture
def unprivileged(tmp_path: Path) -> Iterator[None]:
    """Not root, who may write anywhere."""
    if os.geteuid() != 0:
        yield
        return
    for folder in (tmp_path, *tmp_path.parents):
        if folder.stat().st_mode & 0o077 == 0:  # pytest's own, as many as there are processes of tests
            folder.chmod(0o755)
    os.chown(tmp_path, 65534, 65534)
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_missing_folders_are_made(make_episode: Maker, tmp_path: Path) -> None:
    path = write_rrd(make_episode(), tmp_path / "a" / "b" / "e.rrd")
    assert path == tmp_path / "a" / "b" / "e.rrd"
    assert os.listdir(path.parent) == ["e.rrd"]


def test_an_existing_file_is_never_written_over(make_episode: Maker, tmp_path: Path) -> None:
    (tmp_path / "e.rrd").write_text("mine")
    names = [write_rrd(make_episode(), tmp_path / "e.rrd").name for _ in range(2)]
    assert names == ["e_2.rrd", "e_3.rrd"]
    assert (tmp_path / "e.rrd").read_text() == "mine"


def test_names_are_kept_apart_without_hard_links(
    make_episode: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    names = [write_rrd(make_episode(), tmp_path / "e.rrd").name for _ in range(2)]
    assert names == ["e.rrd", "e_2.rrd"]
    assert sorted(os.listdir(tmp_path)) == names
    assert verify_rrd(tmp_path / "e_2.rrd") is None


def test_threads_that_write_at_once_get_a_file_each(make_episode: Maker, tmp_path: Path) -> None:
    written: list[Path] = []
    threads = [
        threading.Thread(target=lambda n=n: written.append(write_rrd(make_episode(n), tmp_path / "e.rrd")))
        for n in range(1, 5)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    lengths = sorted(len(read_rrd(path)["/reward"]["Scalars:scalars"].values) for path in set(written))
    assert lengths == [1, 2, 3, 4]


def test_a_folder_without_permission_is_said(make_episode: Maker, tmp_path: Path, unprivileged: None) -> None:
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o555)
    with pytest.raises(RecordingError, match="locked may not be written to. Choose another folder"):
        write_rrd(make_episode(), folder / "e.rrd")
    assert os.listdir(folder) == []


def test_a_file_in_place_of_the_folder_is_said(make_episode: Maker, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="file is not a folder"):
        write_rrd(make_episode(), tmp_path / "file" / "e.rrd")


def test_a_name_that_is_too_long_is_said(make_episode: Maker, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="name is too long"):
        write_rrd(make_episode(), tmp_path / ("x" * 300 + ".rrd"))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("room", [0, 1000, 20_000])
def test_a_file_that_cannot_grow_is_not_left_behind(make_episode: Maker, tmp_path: Path, room: int) -> None:
    noise = np.random.default_rng(0).random((3, 2000)).astype(np.float32)
    episode = make_episode(action=noise, action_names=tuple(map(str, range(2000))))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # A write that fails half way, as on a full disk.
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        with pytest.raises(RecordingError, match=r"e\.rrd"):
            write_rrd(episode, tmp_path / "e.rrd")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert os.listdir(tmp_path) == []
    assert verify_rrd(write_rrd(episode, tmp_path / "e.rrd")) is None


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
@pytest.mark.parametrize("lost", [1, 100, 5000])
def test_a_file_that_was_cut_short_is_not_given_its_name(
    make_episode: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lost: int
) -> None:
    whole = rrd._write
    monkeypatch.setattr(rrd, "_write", lambda path, content: whole(path, content[:-lost]))
    with pytest.raises(RecordingError, match="could not be read back|not everything arrived"):
        write_rrd(make_episode(), tmp_path / "e.rrd")
    assert os.listdir(tmp_path) == []


def test_an_encoder_that_raises_leaves_nothing_behind(
    recorded: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = iter([b"first picture"])
    monkeypatch.setattr(layout, "encode_jpeg", lambda image: next(calls))
    with pytest.raises(StopIteration):
        write_rrd(recorded.episode, tmp_path / "e.rrd")
    assert os.listdir(tmp_path) == []


def test_rows_that_went_missing_are_noticed(
    make_episode: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    send = rr.RecordingStream.send_columns

    def lossy(self: rr.RecordingStream, entity: str, *args: Any, **kwargs: Any) -> None:
        if entity != "/reward":
            send(self, entity, *args, **kwargs)

    monkeypatch.setattr(rr.RecordingStream, "send_columns", lossy)
    with pytest.raises(RecordingError, match="/reward: 0 of 3 rows"):
        write_rrd(make_episode(), tmp_path / "e.rrd")
    assert os.listdir(tmp_path) == []


def test_what_rerun_refuses_is_an_error_out_of_strict_mode_too(make_episode: Maker, tmp_path: Path) -> None:
    rr.set_strict_mode(False)
    episode = make_episode()
    (visual,) = episode.geometry.visuals
    flat = Mesh(np.zeros((3, 2), dtype=np.float32), visual.mesh.faces)  # vertices without z
    episode.geometry = dataclasses.replace(
        episode.geometry, visuals=(dataclasses.replace(visual, mesh=flat),)
    )
    with pytest.raises(ValueError):
        write_rrd(episode, tmp_path / "e.rrd")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("reward", np.zeros(2, dtype=np.float32)),
        ("action", np.zeros((3, 2), dtype=np.float32)),
        ("poses", np.zeros((3, 2, 7), dtype=np.float32)),
        ("evaluate", {"success": np.zeros(3, dtype=bool)}),
    ],
)
def test_columns_that_do_not_fit_are_refused(
    make_episode: Maker, tmp_path: Path, field: str, value: Any
) -> None:
    with pytest.raises(ValueError, match=field):
        write_rrd(make_episode(**{field: value}), tmp_path / "e.rrd")
    assert os.listdir(tmp_path) == []


def test_writing_many_leaves_no_threads(make_episode: Maker, tmp_path: Path) -> None:
    process = psutil.Process()
    write_rrd(make_episode(), tmp_path / "e.rrd")
    before = process.num_threads()
    for _ in range(20):
        write_rrd(make_episode(), tmp_path / "e.rrd")
    assert process.num_threads() <= before
    assert len(os.listdir(tmp_path)) == 21


@given(task=st.text(max_size=200), seed=st.integers(-1, 2**31 - 1), env=st.integers(0, 5000))
def test_filenames_are_safe_anywhere(task: str, seed: int, env: int) -> None:
    info = dataclasses.replace(INFO, task=task, seed=seed, env_index=env)
    name = episode_filename(info)
    assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,150}\.rrd", name)


def test_filenames_sort_by_seed_then_env_then_time() -> None:
    noon = datetime.datetime(2026, 11, 21, 12, 0, 0)
    infos = [(2, 0), (2, 3), (2, 11), (10, 0), (100, 0)]
    names = [
        episode_filename(
            dataclasses.replace(INFO, seed=seed, env_index=env), noon + datetime.timedelta(seconds=s)
        )
        for seed, env in infos
        for s in (0, 70)
    ]
    assert names == sorted(names)
    assert names[0] == "PushCube-v1_seed0002_env00_2026-11-21T12-00-00.rrd"


INFO = rrd.EpisodeInfo("PushCube-v1", 0, 0, None, "", {}, 0.05, None, "cpu")
