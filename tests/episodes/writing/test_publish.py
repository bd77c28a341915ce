"""The files of an episode get their final names together and durably, or none does, whatever system call fails."""

from __future__ import annotations

import errno
import os
import shutil
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.episodes.refused_calls import descriptors, left_open, refused
from workbench.episodes.writing.publish import RecordingError, publish, reason, sync_files, try_folder

SUFFIXES = (".rrd", ".h5", ".json")


def made(folder: Path) -> list[Path]:
    """Write three finished files under their temporary names."""
    (folder / "made").mkdir(parents=True)
    paths = [folder / "made" / f"id{suffix}" for suffix in SUFFIXES]
    for path in paths:
        path.write_text(path.suffix)
    return paths


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.is_file())


@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_disk_error_of_any_file_is_raised(tmp_path: Path, at: int) -> None:
    paths = made(tmp_path)
    before, threads = descriptors(), threading.active_count()
    with refused(at, ("fsync",)) as calls, pytest.raises(OSError) as error:
        sync_files(paths)
    assert error.value.errno == errno.EIO
    assert sorted(calls) == ["fsync id.h5", "fsync id.json", "fsync id.rrd"]
    assert left_open(before) == [] and threading.active_count() <= threads
    sync_files(paths)


@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_name_taken_meanwhile_undoes_the_other_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    paths, link, done = made(tmp_path), os.link, []

    def raced(source: Path, target: Path) -> None:
        done.append(target)
        if len(done) == at:
            target.write_text("of another")
        link(source, target)

    monkeypatch.setattr(os, "link", raced)
    found = publish(paths, tmp_path, "episode")
    assert [path.name for path in found] == [f"episode_2{suffix}" for suffix in SUFFIXES]
    (others,) = set(names(tmp_path)) - {path.name for path in found}
    assert others == f"episode{SUFFIXES[at - 1]}" and (tmp_path / others).read_text() == "of another"


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("then", [0, errno.EROFS])
def test_whatever_call_fails_all_three_have_names_or_none_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool, then: int
) -> None:
    """This holds too where the folder cannot be synced, and on a file system without hard links."""

    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    if not links:
        monkeypatch.setattr(os, "link", refuse)
    paths = made(tmp_path / "0")
    with refused() as calls:
        publish(paths, tmp_path / "0", "episode")
    assert len(calls) > 3 and calls[-1].startswith("fsync")
    for at, call in enumerate(calls, 1):
        folder = tmp_path / str(at)
        paths, before = made(folder), descriptors()
        with refused(at, then=then), pytest.raises(OSError) as error:
            publish(paths, folder, "episode")
        assert error.value.errno == errno.EIO, call
        assert left_open(before) == [], call
        if not then:
            assert names(folder) == [], call
        if links:
            assert all(path.exists() for path in paths), call


def test_each_kind_of_disk_error_has_advice_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def why(number: int) -> str:
        return reason(OSError(number, os.strerror(number)), tmp_path)

    alike = [
        (errno.ENOSPC, errno.EDQUOT),
        (errno.EACCES, errno.EPERM, errno.EROFS),
        (errno.ENOTDIR, errno.EEXIST),
        (errno.ENAMETOOLONG,),
        (errno.EFBIG,),
        (errno.ENOENT,),
        (errno.EIO,),
    ]
    told = [{why(number) for number in numbers} for numbers in alike]
    assert all(len(texts) == 1 for texts in told) and len(set.union(*told)) == len(alike)
    assert why(errno.EIO) == f"{os.strerror(errno.EIO)}." and str(tmp_path) in why(errno.ENOENT)
    full = why(errno.ENOSPC)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    assert why(errno.EIO) == full, "a full disk may show in another way"


def test_a_folder_is_tried_before_a_recording_without_making_it(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    try_folder(tmp_path / "new" / "deeper")
    try_folder(tmp_path)
    for refused_folder in (tmp_path / "file", tmp_path / "file" / "below", tmp_path / os.fsdecode(b"\xff")):
        with pytest.raises(RecordingError):
            try_folder(refused_folder)
    assert names(tmp_path) == ["file"] and len(list(tmp_path.iterdir())) == 1
