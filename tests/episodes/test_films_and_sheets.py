"""Films, rendered scenes and contact sheets made from an episode."""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from numpy.typing import NDArray

from workbench.episodes.encoded_pictures import EncodedPictures, encode_jpeg
from workbench.episodes.episode import Episode
from workbench.episodes.films import (
    FilmEye,
    camera_of,
    contact_sheet,
    default_eye,
    frames,
    write_mp4,
)
from workbench.episodes.reader.read_episode import read_episode

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture(scope="module")
def episode(recorded: Any, tmp_path_factory: pytest.TempPathFactory) -> Episode:
    """An episode read back from its files."""
    return read_episode(recorded.episode.write(tmp_path_factory.mktemp("recordings")).json)


def shades(count: int, height: int = 48, width: int = 64) -> list[NDArray[np.uint8]]:
    return [np.full((height, width, 3), 20 * index, np.uint8) for index in range(count)]


def film(path: Path) -> tuple[dict[str, Any], list[NDArray[np.uint8]]]:
    """Return a film's metadata and its frames."""
    read = imageio_ffmpeg.read_frames(str(path))
    metadata: Any = next(read)
    width, height = metadata["size"]
    return metadata, [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in read]


def test_a_film_holds_every_frame_in_order_at_its_rate(tmp_path: Path) -> None:
    assert write_mp4(tmp_path / "a.mp4", shades(10), fps=20) == 10
    metadata, seen = film(tmp_path / "a.mp4")
    assert (metadata["fps"], metadata["size"], len(seen)) == (20, (64, 48), 10)
    for index, frame in enumerate(seen):
        assert abs(float(frame.mean()) - 20 * index) < 3


def test_a_film_that_a_frame_interrupts_raises_that_error_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="shape"):
        write_mp4(tmp_path / "a.mp4", [*shades(2), *shades(1, width=32)], fps=20)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_ends_a_film_with_a_message_and_leaves_no_file(tmp_path: Path) -> None:
    # In a subprocess: an unprivileged process cannot raise its file size limit again.
    noise = (
        "import numpy as np, sys, pathlib; from workbench.episodes.films import write_mp4\n"
        "rng = np.random.default_rng(0)\n"
        "frames = (rng.integers(0, 255, (240, 320, 3), np.uint8) for _ in range(60))\n"
        "try: write_mp4(pathlib.Path(sys.argv[1]), frames, 20)\n"
        "except OSError as error: print('said:', error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", noise, str(tmp_path / "big.mp4")],
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000)),
    )
    assert "said: The film could not be written" in done.stdout, done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_state_without_a_picture_shows_the_previous_picture(episode: Episode) -> None:
    camera = camera_of(episode, "base_camera")
    assert len(list(frames(episode, camera))) == episode.length + 1
    every_third = replace(camera, frame=np.array([0, 3, 6]), pose=camera.pose[:3], rgb=_pictures(shades(3)))
    seen = [round(float(picture.mean()) / 20) for picture in frames(episode, every_third)]
    assert seen == [0, 0, 0, 1, 1, 1, 2, 2, 2]


def test_the_recorded_scene_is_rendered_as_the_tasks_own_camera_saw_it(episode: Episode) -> None:
    """From the recorded pose of a camera, the rendered scene matches the camera's picture."""
    from workbench.pictures.render_recorded import RecordedScene

    camera = camera_of(episode, "base_camera")
    assert episode.geometry is not None and episode.poses is not None and camera.rgb is not None
    scene = RecordedScene(episode.geometry, 0, camera.info.width, camera.info.height, camera.info.fovy)
    for state in (0, episode.length):
        drawn = _is_coloured(scene.picture(episode.poses[state], camera.pose[state]))
        seen = _is_coloured(camera.rgb[state])
        # Lights and highlights differ; the outlines of table and robot do not.
        assert 0.2 < seen.mean() < 0.8 and (drawn == seen).mean() > 0.96
    absent = episode.poses[0].copy()
    absent[:] = np.nan
    nothing = scene.picture(absent, camera.pose[0])
    assert nothing.std(axis=(0, 1)).max() < 1


@pytest.mark.parametrize(
    "eye",
    [
        FilmEye((1.0, 2.0, 3.0), (0.0, 0.0, 0.0)),
        FilmEye((0.0, 0.0, 2.0), (0.0, 0.0, 0.0)),
        FilmEye((0.0, 0.0, -2.0), (0.0, 0.0, 1.0)),
    ],
)
def test_an_eye_looks_at_its_target(eye: FilmEye) -> None:
    w, x, y, z = eye.pose[3:].astype(float)
    assert abs(np.linalg.norm([w, x, y, z]) - 1) < 1e-6
    forward = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    wanted = np.subtract(eye.look_at, eye.position)
    assert np.allclose(forward, wanted / np.linalg.norm(wanted), atol=1e-5)


def test_the_default_eye_has_moving_bodies_in_view(episode: Episode) -> None:
    eye = default_eye(replace(episode, cameras=[]))
    assert episode.poses is not None
    to = episode.poses[:, :, :3].reshape(-1, 3) - np.array(eye.position)
    ahead = np.subtract(eye.look_at, eye.position)
    kinds = np.array(episode.geometry.body_kinds if episode.geometry else ())
    moving = np.tile(np.isin(kinds, ("link", "dynamic")), len(episode.poses))
    cosines = (to @ ahead / np.linalg.norm(to, axis=1) / np.linalg.norm(ahead))[moving]
    assert (np.arccos(np.clip(cosines, -1, 1)) < eye.fovy / 2).all()


def test_a_sheet_needs_pictures(episode: Episode) -> None:
    with pytest.raises(ValueError, match="no camera pictures"):
        contact_sheet(replace(episode, cameras=[]))


def _is_coloured(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Whether a pixel is coloured: wood is, robot and floor are grey."""
    return np.ptp(picture.astype(int), axis=2) > 45


def _pictures(pictures: Sequence[NDArray[np.uint8]]) -> EncodedPictures:
    return EncodedPictures("rgb", [encode_jpeg(picture) for picture in pictures])
