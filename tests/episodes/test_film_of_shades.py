"""Films, parts of films and contact sheets of pictures whose shade tells their state and camera."""

from __future__ import annotations

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
    FilmPart,
    cameras_by_name,
    chosen_states,
    contact_sheet,
    default_eye,
    enlarged,
    film_frames,
    scene_frames,
    write_mp4,
)
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
@pytest.mark.usefixtures("child_process")
def test_a_film_of_an_odd_size_is_padded_or_keeps_its_size(tmp_path: Path, exact: bool) -> None:
    picture = np.full((33, 25, 3), 200, np.uint8)
    encoding = Encoding(exact_size=exact, key_every=2)
    assert write_mp4(tmp_path / "a.mp4", [picture] * 5, 12.5, encoding, "made of task") == 5
    found = read(tmp_path / "a.mp4")
    assert len(found) == 5 and found[0].shape == ((33, 25, 3) if exact else (34, 26, 3))
    assert np.abs(found[4].astype(int) - 200).max() < 12, "its border is no black line"
    metadata = next(imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4")))
    assert metadata["fps"] == 12.5 and b"made of task" in (tmp_path / "a.mp4").read_bytes()


@pytest.mark.parametrize(("first", "count"), [(0, 3), (3, 4), (9, 1)])
@pytest.mark.usefixtures("child_process")
def test_a_part_of_a_film_holds_its_own_frames(tmp_path: Path, first: int, count: int) -> None:
    write_mp4(tmp_path / "a.mp4", shades(*range(20, 220, 20)), fps=20)
    part = FilmPart(tmp_path / "a.mp4", first / 20, count, 20.0)
    found = [np.frombuffer(part.one(number), np.uint8) for number in range(count)]
    expected = [encode_jpeg(one) for one in read(tmp_path / "a.mp4")[first : first + count]]
    assert [one.tobytes() for one in found] == expected and len(set(expected)) == count
    with pytest.raises(UnreadableRecording):
        FilmPart(tmp_path / "a.mp4", first / 20, 10 - first + 1, 20.0).one(0)


def test_a_film_without_a_frame_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        write_mp4(tmp_path / "a.mp4", [], fps=20)
    assert list(tmp_path.iterdir()) == []


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
    assert name == "eye" and [label.split()[1:3] for label in labels] == [
        ["0", "0.00"],
        ["2", "0.08"],
        ["4", "0.16"],
        ["6", "0.24"],
    ]
    for ends, last in ((np.arange(7) >= 4, "success"), (np.arange(7) == 4, "no success")):
        written.clear()
        contact_sheet(replace(plain, evaluate={"success": ends}), columns=4)
        assert written[0].endswith(f"   {last}") and ["success" in label for label in written[2:]] == [
            False,
            False,
            True,
            False,
        ]
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
