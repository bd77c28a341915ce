"""Films and archives are made from recordings in a subprocess: it reports progress, can be stopped, and leaves no partial file."""

from __future__ import annotations

import os
import shutil
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.drive.episodes import Made, Track
from tests.drive.waiting import until
from workbench.envs.camera_data import CameraInfo
from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, Visual
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.reader.reading import find_all_sources, read_recording
from workbench.episodes.row import Source
from workbench.share.make import MakeRequest, Making, MakingView, make

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one recording of 200 steps and one camera."""
    folder = tmp_path_factory.mktemp("recordings")
    steps, size = 200, 256
    poses = np.zeros((steps + 1, 1, 7), np.float32)
    poses[:, 0, 0], poses[..., 3] = np.linspace(0, 1, steps + 1), 1
    triangle = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.uint32))
    zero = np.zeros(1, np.int32)
    camera = CameraInfo(
        "eye", "sensor", size, size, 1.0, 0.01, 10.0, np.eye(3, dtype=np.float32), None, ("rgb",)
    )
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 255, (steps + 1, size, size, 3), np.uint8)
    Made(
        info=EpisodeInfo("Made-v1", 0, 7, None, "", {}, 0.05, None, "cpu"),
        geometry=SceneGeometry(
            1,
            ("cube",),
            ("dynamic",),
            (False,),
            (Visual("cube", triangle, Material((1, 0, 0, 1)), zero, zero),),
        ),
        segmentation={},
        poses=poses,
        action=np.zeros((steps, 1), np.float32),
        action_names=("grip",),
        reward=np.ones(steps, np.float32),
        terminated=np.zeros(steps, np.bool_),
        truncated=np.zeros(steps, np.bool_),
        evaluate={"success": np.zeros(steps + 1, np.bool_)},
        cameras=[Track(camera, np.arange(steps + 1), np.tile(poses[0, 0], (steps + 1, 1)), rgb)],
    ).write(folder)
    return folder


class MakingProbe:
    """A `Making`, with a way to wait for its view."""

    def __init__(self) -> None:
        self.making = Making()

    def wait(self, reached: Callable[[MakingView], bool]) -> MakingView:
        until(lambda: reached(self.making.view()), "the expected view", seen=self.making.view)
        return self.making.view()


@pytest.mark.slow
def test_stopping_leaves_no_partial_file(recordings: Path, tmp_path: Path) -> None:
    probe = MakingProbe()
    probe.making.start(MakeRequest("film", find_all_sources([recordings]) * 20, tmp_path / "films", "eye"))
    probe.wait(lambda view: view.done > 0.01 and "eye" in view.doing)
    probe.making.stop()
    view = probe.wait(lambda view: not view.running)
    assert (view.problem, view.made) == ("", ())
    assert not [path for path in (tmp_path / "films").iterdir() if path.suffix != ".mp4"]


@pytest.mark.slow
def test_an_unpacked_archive_equals_the_recording(recordings: Path, tmp_path: Path) -> None:
    (source,) = find_all_sources([recordings])
    made = make(MakeRequest("zip", (source,), tmp_path))
    assert made.words == "3 files of 1 recording" and made.paths == (tmp_path / f"{source.stem}.zip",)
    with zipfile.ZipFile(made.paths[0]) as archive:
        archive.extractall(tmp_path / "elsewhere")
    (again,) = find_all_sources([tmp_path / "elsewhere"])
    before, after = read_recording(source), read_recording(again)
    assert after.info.id == before.info.id and after.length == before.length and not after.broken_files


@pytest.mark.slow
def test_downloads_of_one_name_are_kept_apart_until_the_end(recordings: Path, tmp_path: Path) -> None:
    probe = MakingProbe()
    wanted = MakeRequest("zip", find_all_sources([recordings]), tmp_path)
    assert probe.making.start(wanted, download=True) and not probe.making.start(wanted), "one at a time"
    probe.wait(lambda view: not view.running)
    probe.making.start(wanted, download=True)
    view = probe.wait(lambda view: len(view.made) == 2)
    (second,), (first,) = (made.paths for made in view.made)
    assert first.name == second.name and first != second and not list(tmp_path.iterdir())
    assert view.made[0].sizes == (second.stat().st_size,) and first.exists()
    probe.making.close()
    assert not first.exists() and not second.exists()


def test_closing_waits_for_work_in_progress_but_not_forever(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.share.make.END_SECONDS", 0.1)
    probe, go_on = MakingProbe(), threading.Event()
    monkeypatch.setattr(
        "workbench.share.make.Processes", lambda count: SimpleNamespace(run=lambda *work: go_on.wait(60))
    )
    probe.making.start(MakeRequest("zip", find_all_sources([recordings]), tmp_path))
    probe.making.close()
    assert probe.making.view().running, "the hanging work still runs"
    go_on.set()
    view = probe.wait(lambda view: not view.running)
    assert (view.problem, view.made) == ("", ())


def test_an_archive_has_each_file_once_and_no_target_of_a_link(recordings: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(recordings, tmp_path / "copy"))
    (tmp_path / "secret.h5").write_text("of somebody")
    for name in ("other.json", "other.rrd"):
        shutil.copy(next(folder.glob(f"*{Path(name).suffix}")), folder / name)
    (folder / "other.h5").symlink_to(tmp_path / "secret.h5")
    first = next(folder.glob("Made*.json"))
    sources = (Source(first), Source(folder / "other.json"), Source(first))
    made = make(MakeRequest("zip", sources, tmp_path))
    assert made.paths[0].name == f"{first.stem}_and_2_more.zip"
    with zipfile.ZipFile(made.paths[0]) as archive:
        names = archive.namelist()
    assert sorted(names) == sorted(
        [f"{first.stem}{suffix}" for suffix in (".json", ".h5", ".rrd")] + ["other.json", "other.rrd"]
    )


def test_an_archive_keeps_recordings_of_one_name_in_two_folders_apart(
    recordings: Path, tmp_path: Path
) -> None:
    for name in ("before", "after"):
        shutil.copytree(recordings, tmp_path / "kept" / name)
    (old,) = (tmp_path / "kept" / "before").glob("*.rrd")
    os.utime(old, (0, 0))  # 1970
    sources = tuple(Source(path) for path in sorted((tmp_path / "kept").rglob("*.json")))
    made = make(MakeRequest("zip", sources, tmp_path))
    with zipfile.ZipFile(made.paths[0]) as archive:
        archive.extractall(tmp_path / "elsewhere")
    for name in ("before", "after"):
        (again,) = find_all_sources([tmp_path / "elsewhere" / name])
        assert not read_recording(again).broken_files
