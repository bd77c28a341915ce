"""Recorded episodes as a LeRobot dataset and back. tests/sweeps/lerobot_loads.py loads a dataset with lerobot itself."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.drive.episodes import made
from tests.drive.equal import assert_equal
from workbench.envs.camera_data import CameraInfo
from workbench.episodes.encoded_pictures import EncodedPictures, encode_jpeg
from workbench.episodes.episode import NO_SEED, BrokenFile, CameraTrack, Episode
from workbench.episodes.films import MAX_FRAMES, FilmPart
from workbench.episodes.lerobot.export import ExportOptions, export_lerobot
from workbench.episodes.lerobot.format import Choice, frames_of, picture_stats
from workbench.episodes.lerobot.read import lerobot_rows, read_lerobot
from workbench.episodes.reader.reading import read_recording
from workbench.episodes.row import UnreadableRecording
from workbench.library.folder import Library, LibraryError

pytestmark = pytest.mark.usefixtures("child_process")


STEPS = 8


def camera_track(name: str, height: int, width: int, first_shade: int, states: int) -> CameraTrack:
    """A camera whose picture of state k has the shade `first_shade` + 20 k, and a white row at the top."""
    matrix = np.eye(3, dtype=np.float32)
    info = CameraInfo(name, "sensor", width, height, 1.0, 0.01, 9.0, matrix, None, ("rgb",))
    shades = first_shade + 20 * np.arange(states, dtype=np.uint8)
    pictures = np.tile(shades[:, None, None, None], (1, height, width, 3))
    pictures[:, :2] = 255
    blobs = EncodedPictures("rgb", [encode_jpeg(picture) for picture in pictures])
    pose = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (states, 1))
    return CameraTrack(info, np.arange(states), pose, blobs)


def episode_of(steps: int, seed: int = 3) -> Episode:
    """Each number of the episode tells its step; the second camera has an odd size."""
    states = np.arange(steps + 1, dtype=np.float32)
    return replace(
        made(steps, seed=seed, source_hash=f"version {seed}", env_kwargs={"robot_uids": "panda"}),
        action=np.outer(states[1:], [0.5, -seed]).astype(np.float32),
        obs={
            "agent/qpos": np.outer(states, np.arange(1, 10, dtype=np.float32)),
            "extra/goal": np.outer(states, [1.0, 2.0, 3.0]),
        },
        cameras=[
            camera_track("base_camera", 32, 48, 10, steps + 1),
            camera_track("hand/eye", 33, 25, 40, steps + 1),
        ],
    )


@pytest.fixture(scope="module")
def episode() -> Episode:
    return episode_of(STEPS)


@pytest.fixture
def succeeding(episode: Episode) -> Episode:
    succeeds = np.zeros(episode.length + 1, np.bool_)
    succeeds[-2] = True
    return replace(episode, evaluate={**episode.evaluate, "success": succeeds})


def export(folder: Path, *episodes: Episode, options: ExportOptions | None = None) -> Any:
    sources = [(f"episode {index}", lambda one=one: one) for index, one in enumerate(episodes)]
    return export_lerobot(sources, folder, options or ExportOptions())


def edit_info(folder: Path, **changes: object) -> dict[str, Any]:
    """Replace these values in the dataset's info.json; returns those before."""
    path = folder / "meta/info.json"
    info = json.loads(path.read_text())
    path.write_text(json.dumps({**info, **changes}))
    return info


@pytest.mark.parametrize(
    "limits", [{}, {"DATA_MB": 0, "VIDEO_MB": 0, "CHUNK_SIZE": 2}], ids=["one", "many files"]
)
def test_exported_episodes_are_read_back(
    limits: dict[str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, limit in limits.items():
        monkeypatch.setattr(f"workbench.episodes.lerobot.format.{name}", limit)
    given = [episode_of(5, seed=4), episode_of(4, seed=0), episode_of(STEPS)]
    given[1].info = replace(given[1].info, task="Pull-v1")
    given[1].evaluate["success"][2] = True
    done = export(tmp_path / "set", *given)
    assert (done.episodes, done.frames, done.notes) == (3, 9 + STEPS, [])
    data = tmp_path / "set/data"
    files = sorted(path.relative_to(data).with_suffix("").as_posix() for path in data.rglob("*.parquet"))
    assert files == ["chunk-000/file-000", "chunk-000/file-001", "chunk-001/file-000"][: 3 if limits else 1]
    for index, (row, episode) in enumerate(zip(lerobot_rows(tmp_path / "set"), given, strict=True)):
        assert (row.trajectory, row.length, row.seed) == (str(index), episode.length, episode.info.seed)
        assert (row.task, row.copy_of, row.success) == (episode.info.task, episode.info.id, index == 1)
        assert row.total_reward == episode.reward.sum()
        read = read_lerobot(tmp_path / "set", index)
        assert (read.geometry, read.poses, read.length) == (None, None, episode.length)
        for name in ("task", "seed", "source_hash", "control_dt"):
            assert getattr(read.info, name) == getattr(episode.info, name), name
        assert read.info.id == f"set-{index}" and read.action_names == ("arm.joint1", "gripper")
        for name in ("action", "reward", "terminated"):
            assert_equal(getattr(read, name), getattr(episode, name), name)
        assert not read.truncated.any()
        np.testing.assert_array_equal(read.evaluate["success"], episode.evaluate["success"])
        np.testing.assert_array_equal(read.obs["state"][:-1], episode.obs["agent/qpos"][:-1])
        assert np.isnan(read.obs["state"][-1]).all(), "a LeRobot dataset lacks the last state"
        for camera, (name, height, width, first) in zip(
            read.cameras, [("base_camera", 32, 48, 10), ("hand_eye", 33, 25, 40)], strict=True
        ):
            assert camera.info.key == ("sensor", name) and camera.rgb is not None
            assert camera.frame.tolist() == list(range(episode.length)) and len(camera.rgb) == episode.length
            for state in range(episode.length):
                picture = camera.rgb[state]
                assert picture.shape == (height, width, 3) == (camera.info.height, camera.info.width, 3)
                # Each frame is the picture of its own state, not of the state before or after.
                assert picture[8:].mean() == pytest.approx(first + 20 * state, abs=4)
    table = pq.read_table(data).sort_by("index")
    assert table["task_index"].to_pylist() == [0] * 5 + [1] * 4 + [0] * STEPS
    assert pq.read_table(tmp_path / "set/meta/tasks.parquet")["task_index"].to_pylist() == [0, 1]
    with pytest.raises(UnreadableRecording, match="no episode 3"):
        read_lerobot(tmp_path / "set", 3)


def test_the_tables_follow_the_format(episode: Episode, succeeding: Episode, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    short = episode_of(4)
    given = (short, succeeding, episode)
    export(folder, *given, options=ExportOptions(instruction="pick it up"))
    info = edit_info(folder)
    assert (info["codebase_version"], info["robot_type"]) == ("v3.0", "panda")
    assert (info["fps"], info["total_episodes"], info["splits"]) == (20, 3, {"train": "0:3"})
    assert (info["total_frames"], info["total_tasks"]) == (4 + 2 * STEPS, 1)
    assert info["features"]["action"]["shape"] == [2] and all("/" not in key for key in info["features"])
    for name, size in (("base_camera", [32, 48]), ("hand_eye", [33, 25])):
        feature = info["features"][f"observation.images.{name}"]
        assert feature["shape"] == [*size, 3] and feature["names"] == ["height", "width", "channels"]
        film = feature["info"]
        assert [film["video.height"], film["video.width"], film["video.fps"]] == [*size, 20]
    rows = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    assert set(rows.column_names) == {key for key, of in info["features"].items() if of["dtype"] != "video"}
    lengths = [4, STEPS, STEPS]
    assert rows["index"].to_pylist() == list(range(sum(lengths)))
    assert rows["frame_index"].to_pylist() == [frame for length in lengths for frame in range(length)]
    assert rows["episode_index"].to_pylist() == np.repeat(range(3), lengths).tolist()
    assert rows["timestamp"].to_pylist() == pytest.approx([f / 20 for n in lengths for f in range(n)])
    assert rows["next.success"].to_pylist()[4 + STEPS - 3 : 4 + STEPS] == [False, True, False]
    assert [len(rows["observation.state"][k]) for k in range(3)] == [9] * 3
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    ends = np.cumsum([0, *lengths])
    for index, row in enumerate(episodes):
        begin, end = ends[index : index + 2].tolist()
        assert (row["episode_index"], row["length"], row["tasks"]) == (index, end - begin, ["pick it up"])
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (begin, end)
        for name in ("base_camera", "hand_eye"):
            film = f"videos/observation.images.{name}"
            assert (row[f"{film}/from_timestamp"], row[f"{film}/to_timestamp"]) == (begin / 20, end / 20)
        np.testing.assert_allclose(row["stats/action/mean"], given[index].action.mean(axis=0))
    stats = json.loads((folder / "meta/stats.json").read_text())
    together = np.concatenate([one.action for one in given]).astype(np.float64)
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(stats["action"][name], getattr(together, name)(axis=0), atol=1e-6)
    assert stats["action"]["count"] == [sum(lengths)]
    assert np.all(np.array(stats["action"]["q10"]) <= stats["action"]["q90"])
    shades = np.concatenate([10 + 20 * np.arange(length) for length in lengths])
    of_pictures = stats["observation.images.base_camera"]
    assert np.array(of_pictures["mean"]).shape == (3, 1, 1) and of_pictures["count"] == [sum(lengths)]
    mean = shades.mean() / 255 * 15 / 16 + 1 / 16  # a sixteenth of each picture is white
    assert np.ravel(of_pictures["mean"]) == pytest.approx([mean] * 3, abs=0.02)
    assert np.ravel(of_pictures["max"]) == pytest.approx([1] * 3, abs=0.03)
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    assert tasks["__index_level_0__"].to_pylist() == ["pick it up"] and tasks["task_index"].to_pylist() == [0]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]
    ours = json.loads((folder / "meta/workbench.json").read_text())["episodes"]
    assert [one["id"] for one in ours] == [one.info.id for one in given]


def test_only_successes_are_exported_on_request(
    episode: Episode, succeeding: Episode, tmp_path: Path
) -> None:
    only = ExportOptions(only_successes=True)
    made = export(tmp_path / "set", episode, succeeding, options=only)
    assert (made.episodes, made.left_out) == (1, 1)
    (row,) = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    # LeRobot finds an episode's rows, its films and its own row by these.
    parts = ("data", "meta/episodes", *(key.rpartition("/")[0] for key in row if key.startswith("videos/")))
    places = {f"{part}/{index}": 0 for part in parts for index in ("chunk_index", "file_index")}
    assert row.items() >= places.items() and len(places) > 4
    with pytest.raises(ValueError, match="none of them reaches success"):
        export(tmp_path / "none", episode, options=only)
    assert not (tmp_path / "none").exists()


def test_the_exported_features_can_be_chosen(episode: Episode) -> None:
    frames = frames_of(episode, Choice(state=("extra",), environment=("agent/qpos",), cameras=(), every=3))
    assert frames.names["observation.state"] == ["extra.goal.0", "extra.goal.1", "extra.goal.2"]
    assert frames.columns["observation.state"][:, 2].tolist() == [0, 9, 18]
    environment = frames.columns["observation.environment_state"]
    np.testing.assert_array_equal(environment, episode.obs["agent/qpos"][[0, 3, 6]])
    assert frames.columns["action"].tolist() == episode.action[[0, 3, 6]].tolist()
    assert frames.columns["next.reward"].tolist() == [[1 + 2 + 3], [4 + 5 + 6], [7 + 8]]
    # A frame tells what happened in its own step and in the skipped ones after it.
    happened = replace(
        episode,
        evaluate={"success": np.arange(STEPS + 1) == 3},
        terminated=np.arange(STEPS) == 4,
        truncated=np.arange(STEPS) == 7,
    )
    some = frames_of(happened, Choice(every=3))
    assert some.columns["next.success"].tolist() == [[True], [False], [False]]
    assert some.columns["next.done"].tolist() == [[False], [True], [True]]
    assert [round(float(one[8:].mean() - 40) / 20) for one in some.pictures("hand/eye")] == [0, 3, 6]
    rare = replace(episode.cameras[1], frame=np.array([0, 5, 6, 7, 8, 9, 10, 11, 12]))
    late = frames_of(replace(episode, cameras=[rare]), Choice(every=3))
    assert [round(float(one[8:].mean() - 40) / 20) for one in late.pictures("hand/eye")] == [0, 0, 2]
    with pytest.raises(ValueError, match="no observation 'agnet'; it has agent/qpos, extra/goal"):
        frames_of(episode, Choice(state=("agnet",)))
    with pytest.raises(ValueError, match="no camera 'x'"):
        frames_of(episode, Choice(cameras=("x",)))
    # Root pose and velocities (13 numbers), then positions and velocities of 9 joints.
    arm = np.arange((STEPS + 1) * 31).reshape(STEPS + 1, 31)
    joints = frames_of(replace(episode, obs={}, env_states={"articulations/panda": arm}))
    np.testing.assert_array_equal(joints.columns["observation.state"], arm[:-1, 13:22])
    goal = replace(episode, obs={"": np.ones((STEPS + 1, 2), np.float32), "one": np.zeros(STEPS + 1)})
    assert frames_of(goal).names["observation.state"] == ["state.0", "state.1", "one"]


def test_a_lower_rate_must_divide_the_control_rate(episode: Episode, tmp_path: Path) -> None:
    half = ExportOptions(fps=10)
    progress: list[tuple[int, str]] = []
    sources = [(name, lambda: episode) for name in ("first", "second")]
    done = export_lerobot(sources, tmp_path / "set", half, lambda *at: progress.append(at))
    assert done.frames == STEPS and progress == [(0, "first"), (1, "second"), (2, "done")]
    assert read_lerobot(tmp_path / "set", 1).info.control_dt == 0.1
    with pytest.raises(ValueError, match="not an integer multiple of 7"):
        export(tmp_path / "other", episode, options=ExportOptions(fps=7))
    slower = replace(episode, info=replace(episode.info, control_dt=0.1))
    with pytest.raises(ValueError, match="frame rate"):
        export(tmp_path / "other", episode, slower)
    odd = replace(episode, info=replace(episode.info, control_dt=1 / 30.3))
    (note,) = export(tmp_path / "odd", odd, odd).notes
    assert "30.300 per second is written as 30" in note
    with pytest.raises(FileExistsError):
        export(tmp_path / "odd", episode)
    assert len(lerobot_rows(tmp_path / "odd")) == 2


def test_a_dataset_of_another_program_is_read(episode: Episode, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    export(folder, episode_of(4), episode)
    (folder / "meta/workbench.json").unlink()
    features = edit_info(folder)["features"]
    channels_first = {"shape": [3, 32, 48], "names": ["channels", "height", "width"]}
    features["observation.images.base_camera"] |= channels_first
    features["action"]["names"] = {"motors": ["shoulder", "gripper"]}
    for name in ("next.reward", "next.success"):
        del features[name]
    info = edit_info(folder, features=features) | {"features": features}
    read = read_lerobot(folder, 1)
    assert read.action_names == ("shoulder", "gripper") and read.info.seed == NO_SEED
    assert (read.cameras[0].info.height, read.cameras[0].info.width) == (32, 48)
    assert read.evaluate == {} and read.reward.tolist() == [0] * STEPS
    row = lerobot_rows(folder)[1]
    assert (row.total_reward, row.success, row.seed, row.length) == (None, None, None, STEPS)
    features["action"]["names"] = ["too few"]
    edit_info(folder, features=features)
    assert read_lerobot(folder, 1).action_names == ("action[0]", "action[1]")
    # Files that could be read if they were not outside of the dataset.
    shutil.copyfile(folder / "data/chunk-000/file-000.parquet", tmp_path / "other.parquet")
    shutil.copyfile(next(folder.rglob("*.mp4")), tmp_path / "other.mp4")
    for change in (
        {"codebase_version": "v2.1"},
        {"fps": 0},
        {"features": []},
        {"data_path": "../other.parquet"},
        {"video_path": "../other.mp4"},
        {"data_path": str(tmp_path / "other.parquet")},
    ):
        edit_info(folder, **{**info, **change})
        with pytest.raises(UnreadableRecording, match="set"):
            read_lerobot(folder, 1)


def test_incompatible_episodes_are_refused_and_no_file_is_left(episode: Episode, tmp_path: Path) -> None:
    narrow = replace(episode, action=episode.action[:, :1], action_names=episode.action_names[:1])
    why = r"episode 1 does not fit into a dataset with episode 0: the shape of action is \[1\]"
    with pytest.raises(ValueError, match=why):
        export(tmp_path / "set", episode, narrow)
    assert list(tmp_path.iterdir()) == []
    cut = replace(episode, broken_files=(BrokenFile("c.rrd", "was cut short."),))
    made = export(tmp_path / "rest", episode, narrow, cut, episode, options=ExportOptions(only_fitting=True))
    assert made.episodes == 2 and made.frames == 2 * episode.length
    first, second = made.not_fitting
    assert first.startswith("episode 1 does not fit") and second == "c.rrd was cut short."
    assert len(read_lerobot(tmp_path / "rest", 1).reward) == episode.length


def test_a_dataset_has_one_library_row_per_episode(
    episode: Episode, succeeding: Episode, tmp_path: Path
) -> None:
    export(tmp_path / "sets" / "push", episode, succeeding)
    library = Library(tmp_path)
    try:
        library.refresh()
        first, second = library.view().rows
        assert (first.name, first.kind, first.success) == ("sets/push#0", "lerobot", False)
        assert (second.success, second.length, second.seed) == (True, episode.length, episode.info.seed)
        assert second.problem is None
        np.testing.assert_array_equal(read_recording(second.source).action, episode.action)
        with pytest.raises(LibraryError, match="delete the folder"):
            library.delete([first.id, second.id])
        assert len(lerobot_rows(tmp_path / "sets" / "push")) == 2
    finally:
        library.close()


def test_a_large_picture_is_thinned_for_its_statistics_as_in_lerobot() -> None:
    row = np.arange(600, dtype=np.uint16) % 251
    picture = np.broadcast_to(row[:, None, None], (600, 30, 3)).astype(np.uint8)
    stats = picture_stats([picture, picture])
    assert np.ravel(stats["mean"]) == pytest.approx([picture[::4].mean() / 255] * 3) and stats["count"] == [2]
    assert np.ravel(stats["max"]) == pytest.approx([picture[::4].max() / 255] * 3)


def test_a_playlist_as_video_reads_no_other_file(episode: Episode, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    export(folder, episode)
    (film, *_) = sorted(folder.glob("videos/**/*.mp4"))
    other = tmp_path / "other.mp4"
    shutil.copyfile(film, other)
    playlists = (
        f"ffconcat version 1.0\nfile {other}\n",
        f"#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\nfile:{other}\n#EXT-X-ENDLIST\n",
    )
    for playlist in playlists:
        film.write_text(playlist)
        pictures = read_lerobot(folder, 0).cameras[0].rgb
        assert pictures is not None
        with pytest.raises(UnreadableRecording, match="cannot be read"):
            pictures[0]


@pytest.mark.parametrize(
    ("begin", "count", "fps"),
    [(-0.1, 3, 20), (1e9, 3, 20), (np.nan, 3, 20), (0, -1, 20), (0, MAX_FRAMES + 1, 20)]
    + [(0, 3, fps) for fps in (0, -20, 1e6, np.inf, np.nan)],
)
def test_claims_of_a_part_of_a_film_are_bounded(begin: float, count: int, fps: float) -> None:
    FilmPart(Path("film.mp4"), 0.0, 3, 20.0)
    with pytest.raises(ValueError, match=r"film\.mp4"):
        FilmPart(Path("film.mp4"), begin, count, fps)


def test_claims_of_a_dataset_are_bounded(episode: Episode, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    export(folder, episode)
    info = edit_info(folder)
    camera = next(key for key, feature in info["features"].items() if feature["dtype"] == "video")
    # Python's own formatting could produce a gigabyte, or reveal attributes of an object.
    for pattern in ("data/{chunk_index:01000000000d}.parquet", "data/{chunk_index.__class__}.parquet"):
        edit_info(folder, data_path=pattern)
        with pytest.raises(UnreadableRecording, match="cannot be read as a LeRobot dataset"):
            read_lerobot(folder, 0)
    huge = {**info["features"][camera], "shape": [100_000, 100_000, 3]}
    edit_info(folder, data_path=info["data_path"], features={**info["features"], camera: huge})
    with pytest.raises(UnreadableRecording, match="100000 x 100000"):
        read_lerobot(folder, 0)
    edit_info(folder, features=info["features"])
    os.mkfifo(folder / "data" / "chunk-000" / "file-001.parquet")
    assert lerobot_rows(folder)[0].length == episode.length


def test_rewards_that_are_stored_as_lists_of_one_number_are_summed(
    tmp_path: Path, succeeding: Episode
) -> None:
    """LeRobot itself reads these, and datasets of other programs have them."""
    export(tmp_path / "set", succeeding)
    path = tmp_path / "set/data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    column = table.schema.get_field_index("next.reward")
    for kind in (pa.list_(pa.float32()), pa.list_(pa.float32(), 1)):
        lists = pa.array([[number] for number in table["next.reward"].to_pylist()], kind)
        pq.write_table(table.set_column(column, "next.reward", lists), path)
        (row,) = lerobot_rows(tmp_path / "set")
        assert row.total_reward == pytest.approx(succeeding.reward.sum())
