"""Films, parts of films, rendered scenes and contact sheets; the shade of most pictures tells their state and camera."""

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
from PIL import ImageDraw

from tests.drive.episodes import geometry_of, made, poses_of
from workbench.envs.camera_data import CameraInfo, CameraKind
from workbench.episodes.encoded_pictures import EncodedPictures, encode_jpeg
from workbench.episodes.episode import CameraTrack, Episode
from workbench.episodes.films import (
    CELL_PIXELS,
    MIN_SIDE_PIXELS,
    Encoding,
    FilmEye,
    FilmPart,
    camera_of,
    cameras_by_name,
    chosen_states,
    contact_sheet,
    default_eye,
    enlarged,
    film_frames,
    frames,
    scene_frames,
    write_mp4,
)
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.row import UnreadableRecording


def shades(*values: int, height: int = 48, width: int = 64) -> list[NDArray[np.uint8]]:
    return [np.full((height, width, 3), value, np.uint8) for value in values]


def camera(name: str, kind: CameraKind, frame: Sequence[int], first: int, width: int = 64) -> CameraTrack:
    """A camera whose picture of state k has the shade `first` + 10 k."""
    info = CameraInfo(name, kind, width, 48, 0.5, 0.01, 9.0, np.eye(3, dtype=np.float32), None, ("rgb",))
    pictures = shades(*(first + 10 * state for state in frame), width=width)
    pose = np.tile(np.array([1, 2, 3, np.sqrt(0.5), 0, 0, np.sqrt(0.5)], np.float32), (len(frame), 1))
    blobs = EncodedPictures("rgb", [encode_jpeg(picture) for picture in pictures])
    return CameraTrack(info, np.array(frame), pose, blobs)


def read(film: Path) -> list[NDArray[np.uint8]]:
    return list(film_frames(film, 0.0, 1000))


@pytest.mark.parametrize("exact", [False, True])
def test_a_film_holds_every_frame_in_order_at_its_rate_and_pads_an_odd_size_only_on_request(
    child_process: None, tmp_path: Path, exact: bool
) -> None:
    pictures = shades(*range(0, 201, 20), height=33, width=25)
    encoding = Encoding(exact_size=exact, key_every=2)
    assert write_mp4(tmp_path / "a.mp4", pictures, 12.5, encoding, "made of task") == len(pictures)
    found = read(tmp_path / "a.mp4")
    assert {frame.shape for frame in found} == {(33, 25, 3) if exact else (34, 26, 3)}
    for frame, picture in zip(found, pictures, strict=True):
        assert np.abs(frame.astype(int) - picture[0, 0]).max() < 12, "its border is no black line"
    metadata = next(imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4")))
    assert metadata["fps"] == 12.5 and b"made of task" in (tmp_path / "a.mp4").read_bytes()


@pytest.mark.parametrize(("first", "count"), [(0, 3), (3, 4), (9, 1)])
def test_a_part_of_a_film_holds_its_own_frames(
    child_process: None, tmp_path: Path, first: int, count: int
) -> None:
    write_mp4(tmp_path / "a.mp4", shades(*range(20, 220, 20)), fps=20)
    part = FilmPart(tmp_path / "a.mp4", first / 20, count, 20.0)
    found = [np.frombuffer(part.one(number), np.uint8) for number in range(count)]
    expected = [encode_jpeg(one) for one in read(tmp_path / "a.mp4")[first : first + count]]
    assert [one.tobytes() for one in found] == expected and len(set(expected)) == count
    with pytest.raises(UnreadableRecording):
        FilmPart(tmp_path / "a.mp4", first / 20, 10 - first + 1, 20.0).one(0)


@pytest.mark.parametrize(
    ("pictures", "why"),
    [([], None), ([*shades(0, 20), *shades(40, width=32)], "shape")],
    ids=["none", "shape"],
)
def test_a_film_without_a_frame_or_with_one_of_another_shape_is_refused_and_leaves_no_file(
    child_process: None, tmp_path: Path, pictures: list[NDArray[np.uint8]], why: str | None
) -> None:
    with pytest.raises(ValueError, match=why):
        write_mp4(tmp_path / "a.mp4", pictures, fps=20)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_ends_a_film_with_a_message_and_leaves_no_file(
    child_process: None, tmp_path: Path
) -> None:
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


def test_a_state_without_a_picture_shows_the_previous_picture() -> None:
    every_third = camera("eye", "sensor", [0, 3, 6], 0)
    seen = [round(float(picture.mean()) / 10) for picture in frames(made(8), every_third)]
    assert seen == [0, 0, 0, 3, 3, 3, 6, 6, 6]


def test_small_pictures_are_enlarged_pixel_by_pixel() -> None:
    picture = np.arange(100 * 150 * 3).reshape(100, 150, 3).astype(np.uint8)
    large = enlarged(picture)
    assert large.shape == (300, 450, 3)
    np.testing.assert_array_equal(large[2::3, ::3], picture)
    assert enlarged(large) is large
    assert min(enlarged(picture[:40]).shape[:2]) >= MIN_SIDE_PIXELS


def test_cameras_are_named_sensors_first_and_those_without_pictures_are_left_out() -> None:
    eye, view = camera("eye", "sensor", [0], 0), camera("eye", "human", [0], 9)
    blind = replace(camera("blind", "sensor", [0], 0), rgb=None)
    named = cameras_by_name(replace(made(1), cameras=[view, blind, eye]))
    assert list(named) == ["eye", "eye_human"] and list(named.values()) == [eye, view]


@pytest.mark.parametrize(
    ("steps", "columns", "success", "fail", "chosen"),
    [
        (30, 4, None, None, [0, 10, 20, 30]),
        (30, 4, 14, None, [0, 14, 20, 30]),
        (30, 4, 29, None, [0, 10, 29, 30]),
        (30, 4, 1, 16, [0, 1, 16, 30]),
        (30, 4, 30, 0, [0, 10, 20, 30]),
        (30, 2, 14, None, [0, 30]),
        (2, 8, None, None, [0, 1, 2]),
    ],
)
def test_a_sheet_shows_evenly_spaced_states_and_the_first_success_and_fail(
    steps: int, columns: int, success: int | None, fail: int | None, chosen: list[int]
) -> None:
    at = {"success": success, "fail": fail}
    flags = {name: np.arange(steps + 1) >= first for name, first in at.items() if first is not None}
    assert chosen_states(replace(made(steps), evaluate=flags), columns) == chosen


def test_each_cell_of_a_sheet_is_the_picture_of_its_camera_and_state() -> None:
    first = camera("eye", "sensor", range(7), 10)
    second = camera("view", "human", [0, 2, 4, 6], 150, width=32)
    ends = np.arange(7) >= 4
    plain = replace(made(6), cameras=[second, first], evaluate={})
    sheets = [
        np.asarray(contact_sheet(replace(plain, evaluate=flags), columns=4))
        for flags in ({}, {"success": ends}, {"fail": ends})
    ]
    for pixels in sheets:
        grey = np.ptp(pixels.astype(int), axis=2) < 12
        for shade in (10, 30, 50, 70, 150, 170, 190, 210):
            rows, columns = np.nonzero((np.abs(pixels[..., 0].astype(int) - shade) < 4) & grey)
            cell = (shade - (10 if shade < 100 else 150)) // 20
            inside = (columns > 8 + cell * (CELL_PIXELS + 8) - 2) & (columns < (cell + 1) * (CELL_PIXELS + 8))
            upper = rows < pixels.shape[0] / 2
            mine = inside & (upper == (shade < 100))
            assert mine.sum() > 5000, (shade, mine.sum())
    green, red = (
        [int(((p[..., one].astype(int) - p[..., other]) > 60).sum()) for p in sheets]
        for one, other in ((1, 0), (0, 1))
    )
    assert green[1] > 20 and green[0] == green[2] == 0 and red[2] > 20 and red[0] == red[1] == 0


def test_a_sheet_needs_pictures() -> None:
    with pytest.raises(ValueError, match="no camera pictures"):
        contact_sheet(made(1))


def test_the_texts_of_a_sheet_tell_step_time_and_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    draw = ImageDraw.ImageDraw.text

    def text(self: ImageDraw.ImageDraw, xy: tuple[float, float], text: str, **how: Any) -> None:
        written.append(text)
        draw(self, xy, text, **how)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", text)
    plain = replace(
        made(6, seed=0, control_dt=0.04), cameras=[camera("eye", "sensor", range(7), 10)], evaluate={}
    )
    contact_sheet(plain, columns=4)
    title, name, *labels = written
    assert {"Push-v1", "seed", "0", "6", "21.00"} <= set(title.split()) and "success" not in title
    assert name == "eye"
    assert [" ".join(label.split()[1:3]) for label in labels] == ["0 0.00", "2 0.08", "4 0.16", "6 0.24"]
    for ends, last in ((np.arange(7) >= 4, "success"), (np.arange(7) == 4, "no success")):
        written.clear()
        contact_sheet(replace(plain, evaluate={"success": ends}), columns=4)
        assert written[0].endswith(f"   {last}")
        assert [k for k, label in enumerate(written[2:]) if "success" in label] == [2]
    written.clear()
    contact_sheet(replace(plain, info=replace(plain.info, seed=-1)), columns=4)
    assert "seed" not in written[0]


def test_a_recorded_camera_for_people_films_the_scene_from_its_place() -> None:
    episode = replace(made(2), cameras=[camera("eye", "sensor", [0], 0), camera("view", "human", [0], 9)])
    eye = default_eye(episode)
    assert eye.position == (1, 2, 3) and eye.fovy == 0.5
    # The camera is turned to the left by 90 degrees.
    np.testing.assert_allclose(np.subtract(eye.look_at, eye.position), [0, 1, 0], atol=1e-6)
    other = default_eye(replace(episode, cameras=episode.cameras[:1]))
    assert other.position != (1, 2, 3) and other.fovy != 0.5


def test_small_scenes_are_filmed_from_a_little_distance() -> None:
    eye = default_eye(made(1))
    assert 0.5 < np.linalg.norm(np.subtract(eye.position, eye.look_at)) < 3
    np.testing.assert_allclose(eye.look_at, [0.005, 0, 0.26], atol=1e-6)


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


@pytest.fixture(scope="module")
def episode(recorded: Any, tmp_path_factory: pytest.TempPathFactory) -> Episode:
    """An episode read back from its files."""
    return read_episode(recorded.episode.write(tmp_path_factory.mktemp("recordings")).json)


def test_the_default_eye_has_moving_bodies_in_view(episode: Episode) -> None:
    eye = default_eye(replace(episode, cameras=[]))
    assert episode.poses is not None
    to = episode.poses[:, :, :3].reshape(-1, 3) - np.array(eye.position)
    ahead = np.subtract(eye.look_at, eye.position)
    kinds = np.array(episode.geometry.body_kinds if episode.geometry else ())
    moving = np.tile(np.isin(kinds, ("link", "dynamic")), len(episode.poses))
    cosines = (to @ ahead / np.linalg.norm(to, axis=1) / np.linalg.norm(ahead))[moving]
    assert (np.arccos(np.clip(cosines, -1, 1)) < eye.fovy / 2).all()


def test_the_recorded_scene_is_rendered_as_the_tasks_own_camera_saw_it(episode: Episode) -> None:
    """From the recorded pose of a camera, the rendered scene matches the camera's picture."""
    from workbench.pictures.render_recorded import RecordedScene

    camera = camera_of(episode, "base_camera")
    assert episode.geometry is not None and episode.poses is not None and camera.rgb is not None
    scene = RecordedScene(episode.geometry, 0, camera.info.width, camera.info.height, camera.info.fovy)
    for state in (0, episode.length):
        drawn = is_coloured(scene.picture(episode.poses[state], camera.pose[state]))
        seen = is_coloured(camera.rgb[state])
        # Lights and highlights differ; the outlines of table and robot do not.
        assert 0.2 < seen.mean() < 0.8 and (drawn == seen).mean() > 0.96
    absent = episode.poses[0].copy()
    absent[:] = np.nan
    nothing = scene.picture(absent, camera.pose[0])
    assert nothing.std(axis=(0, 1)).max() < 1


def is_coloured(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Whether a pixel is coloured: wood is, robot and floor are grey."""
    return np.ptp(picture.astype(int), axis=2) > 45


def test_the_film_of_the_scene_shows_the_bodies_of_its_own_env_at_each_state(
    renderer: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.episodes.films.SIZE_PIXELS", (192, 144))
    episode = made(1, speed=0.4, env_index=1)
    scene = geometry_of(episode)
    cube = scene.visuals[-1]
    of_env = replace(cube, envs=np.ones_like(cube.envs))
    episode.geometry = replace(scene, num_envs=2, visuals=(*scene.visuals[:-1], of_env))
    poses_of(episode)[:, 3, 2] += 0.5

    def red(of: Episode) -> list[NDArray[np.intp]]:
        frames = [frame.astype(int) for frame in scene_frames(of)]
        assert all(frame.shape == (144, 192, 3) for frame in frames)
        return [np.nonzero(frame[..., 0] - frame[..., 1:].max(axis=2) > 60)[1] for frame in frames]

    first, last = red(episode)
    assert len(first) > 5 and len(last) > 5 and abs(first.mean() - last.mean()) > 10
    assert [len(one) for one in red(replace(episode, info=replace(episode.info, env_index=0)))] == [0, 0]
    with pytest.raises(ValueError):
        next(scene_frames(replace(episode, geometry=None)))
