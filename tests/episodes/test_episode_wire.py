"""An episode from the reader process arrives unchanged; an inconsistent one is an error with a message."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.drive.equal import assert_equal
from workbench.envs.camera_data import CameraInfo
from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, SharedShapes, Visual
from workbench.episodes.columns import MAX_TEXT_LINES, TextEntry
from workbench.episodes.drawings import MAX_DRAWING_BYTES, DrawingTrack
from workbench.episodes.encoded_pictures import EncodedPictures, Modality, encode
from workbench.episodes.episode import BrokenFile, CameraTrack, Episode, EpisodeInfo
from workbench.episodes.reader.episode_wire import (
    InvalidEpisode,
    KnownShapes,
    SentShapes,
    pack_episode,
    unpack_episode,
)
from workbench.episodes.reader.requests import EpisodeRead, PictureRead, RowsRead
from workbench.machine.processes.wire import Unpacker, pack_message

T, B = 3, 2
DOTS = DrawingTrack(
    "dots",
    "points",
    np.array([0, 2]),
    np.array([0, 2, 2]),
    np.ones((2, 3), np.float32),
    np.full((2, 3), 9, np.uint8),
    np.ones(2, np.float32),
    (),
)
PICTURES = EncodedPictures("rgb", [encode("rgb", np.full((4, 6, 3), 50 * k, np.uint8)) for k in range(T + 1)])


def an_episode() -> Episode:
    corner = Mesh(
        np.eye(3, dtype=np.float32),
        np.array([[0, 1, 2]], np.uint32),
        np.ones((3, 3), np.float32),
        np.ones((3, 2), np.float32),
    )
    red = Material((1.0, 0.0, 0.0, 1.0), 0.25, 0.75, np.full((2, 2, 4), 9, np.uint8))
    none = np.zeros(1, np.int32)
    visuals = tuple(Visual(f"box/{k}", corner, red, none, np.array([k], np.int32)) for k in range(B))
    lens = CameraInfo("eye", "sensor", 6, 4, 1.0, 0.01, 10.0, np.eye(3, dtype=np.float32), None, ("rgb",))
    track = CameraTrack(
        lens,
        np.arange(T + 1),
        np.arange((T + 1) * 7, dtype=np.float32).reshape(T + 1, 7),
        PICTURES,
    )
    return Episode(
        EpisodeInfo("Box-v1", 0, 3, None, "", {}, 0.05, None, "cpu", env_kwargs={"robot_uids": "panda"}),
        SceneGeometry(1, ("floor", "box"), ("static", "dynamic"), (False, False), visuals),
        {1: "box"},
        np.arange((T + 1) * B * 7, dtype=np.float32).reshape(T + 1, B, 7),
        np.ones((T, 2), np.float32),
        ("x", "y"),
        np.arange(T, dtype=np.float32),
        np.array([False, False, True]),
        np.zeros(T, np.bool_),
        {"success": np.array([False, False, False, True])},
        [track],
        {"actors/box": np.ones((T + 1, 13), np.float32)},
        {"": np.ones((T + 1, 5))},
        {"mean": np.ones(T + 1)},
        {"phase": ((0, TextEntry("str", "reach", False, True)), (2, None))},
        (DOTS,),
        (BrokenFile("a.h5", "is broken."),),
    )


def crossed(read: EpisodeRead) -> EpisodeRead:
    return Unpacker((EpisodeRead, RowsRead)).message(pack_message(read))


def fetched(camera: int, modality: Modality, index: int, encoded: bool) -> PictureRead:
    assert (camera, modality) == (0, "rgb") and 0 <= index <= T
    return PictureRead(blob=PICTURES.blob(index)) if encoded else PictureRead(PICTURES[index])


def here(read: EpisodeRead, known: dict | None = None, shapes: SharedShapes | None = None) -> Episode:
    return unpack_episode(crossed(read), fetched, 1, shapes or SharedShapes(), {} if known is None else known)


def test_an_episode_is_equal_after_the_transfer() -> None:
    there = an_episode()
    episode = here(pack_episode(there, None, 1, SentShapes()))
    assert_equal(episode, there)
    assert episode.drawn[0].at(3) is None
    assert episode.geometry is not None and episode.cameras[0].rgb is not None
    first, second = episode.geometry.visuals
    assert first.mesh is second.mesh, "a shape is sent once"
    assert episode.cameras[0].rgb.blob(-1) == PICTURES.blob(T)


def test_a_shape_is_sent_once_for_all_episodes_that_share_it() -> None:
    sent, shapes, (_, known) = SentShapes(), SharedShapes(), KnownShapes().of(SharedShapes())
    one, other = (pack_episode(an_episode(), None, number, sent) for number in (1, 2))
    assert (len(one.shapes), len(other.shapes)) == (1, 0)
    first, second = (here(read, known, shapes).geometry for read in (one, other))
    assert first is not None and second is not None
    assert first.visuals[0].mesh is second.visuals[0].mesh
    with pytest.raises(InvalidEpisode, match="a visual without a shape"):
        here(other)


def test_shared_shapes_look_like_the_given_ones_after_these_were_deleted() -> None:
    """Python gives the id of a deleted mesh to a later one."""
    shapes, material = SharedShapes(), Material((1, 1, 1, 1))
    for size in range(20):
        for _ in range(2):
            vertices = np.full((3, 3), size, np.float32)
            mesh, _ = shapes.shared(Mesh(vertices, np.zeros((1, 3), np.uint32)), material)
            np.testing.assert_array_equal(mesh.vertices, vertices)


def of_episode(**changes: Any) -> Callable[[EpisodeRead], EpisodeRead]:
    return lambda read: msgspec.structs.replace(read, episode=replace(read.episode, **changes))


def of_drawing(**changes: Any) -> Callable[[EpisodeRead], EpisodeRead]:
    return of_episode(drawn=(replace(DOTS, **changes),))


def of_scene(**changes: Any) -> Callable[[EpisodeRead], EpisodeRead]:
    def change(read: EpisodeRead) -> EpisodeRead:
        assert read.episode.geometry is not None
        return of_episode(geometry=replace(read.episode.geometry, **changes))(read)

    return change


def of_first(part: str, field: str = "", **changes: Any) -> Callable[[EpisodeRead], EpisodeRead]:
    """Change the first camera, shape or visual, or a field of it."""

    def change(read: EpisodeRead) -> EpisodeRead:
        first, *others = getattr(read, part)
        into = {field: replace(getattr(first, field), **changes)} if field else changes
        return msgspec.structs.replace(read, **{part: [msgspec.structs.replace(first, **into), *others]})

    return change


def numbers(*shape: int, kind: str = "f4") -> NDArray:
    return np.zeros(shape, kind)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (of_episode(reward=numbers(T, 1)), "rewards of shape"),
        (of_episode(poses=numbers(T + 1, B + 1, 7)), "poses of shape"),
        (of_episode(geometry=None), "poses of shape"),
        (of_episode(action=numbers(T, 3)), "actions of shape"),
        (of_episode(terminated=numbers(T + 1, kind="?")), "terminated of shape"),
        (of_episode(texts={"a": ((0, None),) * (MAX_TEXT_LINES + 1)}), "too many entries"),
        (of_episode(drawn=(DOTS, DOTS)), "two of one name"),
        (of_episode(drawn=tuple(replace(DOTS, name=str(k)) for k in range(600))), "600 drawings"),
        (of_drawing(data=numbers(2, 7)), "do not fit"),
        (of_drawing(data=numbers(2, 3) * np.nan), "do not fit"),
        (of_drawing(data=numbers(9000, 3), begins=np.array([0, 9000, 9000])), "do not fit"),
        (of_drawing(data=numbers(MAX_DRAWING_BYTES // 12 + 1, 3)), "32 MB"),
        (of_drawing(begins=np.array([0, 3, 2])), "do not fit"),
        (of_drawing(begins=np.array(0), states=np.array(0), data=np.array(0)), "do not fit"),
        (of_drawing(begins=np.array([0, 2])), "do not fit"),
        (of_drawing(begins=numbers(0, kind="i8"), states=numbers(0, kind="i8")), "do not fit"),
        (of_drawing(states=np.array([0, T + 1])), "do not fit"),
        (of_drawing(states=np.array([2, 0])), "do not fit"),
        (of_drawing(sizes=numbers(1)), "do not fit"),
        (of_drawing(colors=numbers(2, 4, kind="u1")), "do not fit"),
        (of_drawing(kind="text"), "do not fit"),
        (of_scene(body_kinds=("static",)), "different number of bodies"),
        (of_first("visuals", shape=10**9), "without a shape"),
        (of_first("visuals", bodies=np.array([B])), "bodies that do not exist"),
        (of_first("visuals", bodies=np.array([-1])), "bodies that do not exist"),
        (of_first("shapes", "mesh", vertices=numbers(3, 2)), "vertices of shape"),
        (of_first("shapes", "mesh", faces=np.array([[0, 1, 3]])), "vertices that do not exist"),
        (of_first("shapes", "mesh", normals=numbers(2, 3)), "normals of shape"),
        (of_first("shapes", "material", texture=numbers(2, 2, 3, kind="u1")), "a texture of shape"),
        (of_first("cameras", frame=numbers(T + 1)), "eye: frames of shape"),
        (of_first("cameras", pose=numbers(T, 7)), "eye: poses of shape"),
        (of_first("cameras", pictures={"rgb": T}), "4 frames and 3 pictures"),
        (of_first("cameras", pictures={"rgb": T + 2}), "4 frames and 5 pictures"),
        (of_first("shapes", "mesh", faces=numbers(1, 3)), "faces of shape"),
        (of_first("shapes", "mesh", faces=np.array([[0, 1, -1]])), "vertices that do not exist"),
        (of_first("shapes", "mesh", uvs=numbers(2, 2)), "uvs of shape"),
        (of_first("shapes", "material", texture=numbers(2, 2, 4)), "a texture of shape"),
        (of_scene(body_hidden=(False,)), "different number of bodies"),
    ],
)
def test_inconsistent_data_is_refused_with_a_message(
    change: Callable[[EpisodeRead], EpisodeRead], says: str
) -> None:
    with pytest.raises(InvalidEpisode, match=says):
        here(change(pack_episode(an_episode(), None, 1, SentShapes())))


@pytest.mark.parametrize(("width", "height"), [(0, 4), (6, -1), (5000, 5000)])
def test_a_camera_with_no_or_an_oversized_resolution_is_refused(width: int, height: int) -> None:
    read = pack_episode(an_episode(), None, 1, SentShapes())
    lens = msgspec.structs.replace(read.cameras[0].camera, width=width, height=height)
    with pytest.raises(InvalidEpisode, match=f"pictures of {width} x {height}"):
        here(of_first("cameras", camera=lens)(read))


@pytest.mark.parametrize("rows", [numbers(T), np.zeros((), np.float32), np.zeros(T + 1, "S2")])
def test_a_column_of_the_wrong_length_is_left_out_and_named(rows: NDArray) -> None:
    change = of_episode(obs={"odd": rows, "whole": numbers(T + 1, 2)})
    episode = here(change(pack_episode(an_episode(), None, 1, SentShapes())))
    assert list(episode.obs) == ["whole"]
    assert [broken.file for broken in episode.broken_files] == ["a.h5", "odd"]


@pytest.mark.parametrize(
    "picture",
    [None, numbers(4, 6, 3), *(numbers(*shape, kind="u1") for shape in ((4, 6), (0, 6, 3), (4, 6, 4)))],
)
def test_an_invalid_picture_is_refused_with_a_message(picture: NDArray | None) -> None:
    read = crossed(pack_episode(an_episode(), None, 1, SentShapes()))
    episode = unpack_episode(read, lambda *_: PictureRead(picture), 1, SharedShapes(), {})
    pictures = episode.cameras[0].rgb
    assert pictures is not None
    with pytest.raises(OSError, match="the reader returned"):
        pictures[0]
    with pytest.raises(OSError, match="no picture"):
        pictures.blob(0)
