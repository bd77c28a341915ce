"""Archives hold recordings and nothing else, and a stopped film leaves no partial file."""

from __future__ import annotations

import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.drive.episodes import Made, Track, made, write
from tests.drive.scenes import camera
from tests.drive.waiting import until
from workbench.episodes.reader.reading import find_all_sources, read_recording
from workbench.episodes.row import Source
from workbench.share.make import MakeRequest, Making, make

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture
def making() -> Iterator[Making]:
    making = Making()
    yield making
    making.close()


@pytest.mark.slow
def test_stopping_leaves_no_partial_file(
    make_episode: Callable[..., Made], making: Making, tmp_path: Path
) -> None:
    count, size = 201, 256
    rgb = np.random.default_rng(0).integers(0, 255, (count, size, size, 3), np.uint8)
    poses = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (count, 1))
    track = Track(replace(camera("eye"), width=size, height=size), np.arange(count), poses, rgb)
    make_episode(count - 1, cameras=[track]).write(tmp_path)
    making.start(MakeRequest("film", find_all_sources([tmp_path]) * 20, tmp_path / "films", "eye"))
    until(lambda: making.view().done > 0.01 and "eye" in making.view().doing, "the film", seen=making.view)
    making.stop()
    until(lambda: not making.view().running, "the end")
    assert (making.view().problem, making.view().made) == ("", ())
    assert not [path for path in (tmp_path / "films").iterdir() if path.suffix != ".mp4"]


def test_an_archive_has_each_file_once_and_no_target_of_a_link(tmp_path: Path) -> None:
    first = write(tmp_path / "kept", made(3), pictures=False)
    (tmp_path / "secret.h5").write_text("of somebody")
    for name in ("other.json", "other.rrd"):
        shutil.copy(first.with_suffix(Path(name).suffix), first.with_name(name))
    first.with_name("other.h5").symlink_to(tmp_path / "secret.h5")
    sources = (Source(first), Source(first.with_name("other.json")), Source(first))
    archive_of = make(MakeRequest("zip", sources, tmp_path))
    assert archive_of.paths[0].name == f"{first.stem}_and_2_more.zip"
    with zipfile.ZipFile(archive_of.paths[0]) as archive:
        names = archive.namelist()
    assert sorted(names) == sorted(
        [f"{first.stem}{suffix}" for suffix in (".json", ".h5", ".rrd")] + ["other.json", "other.rrd"]
    )


def test_an_unpacked_archive_has_the_recordings_of_one_name_in_two_folders(tmp_path: Path) -> None:
    old = write(tmp_path / "kept" / "before", made(3, seed=1))
    shutil.copytree(old.parent, tmp_path / "kept" / "after")
    os.utime(old.with_suffix(".rrd"), (0, 0))  # 1970
    sources = tuple(Source(path) for path in sorted((tmp_path / "kept").rglob("*.json")))
    (path,) = make(MakeRequest("zip", sources, tmp_path)).paths
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path / "elsewhere")
    for name in ("before", "after"):
        (again,) = find_all_sources([tmp_path / "elsewhere" / name])
        read = read_recording(again)
        assert read.info.id == read_recording(Source(old)).info.id and read.length == 3
        assert not read.broken_files
