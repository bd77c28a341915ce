"""Recorded episodes as a LeRobot dataset and back. tests/sweeps/lerobot_loads.py loads a dataset with lerobot itself."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from workbench.episodes.episode import BrokenFile, Episode
from workbench.episodes.films import MAX_FRAMES, FilmPart
from workbench.episodes.lerobot.export import ExportOptions, export_lerobot
from workbench.episodes.lerobot.format import Choice, frames_of
from workbench.episodes.lerobot.read import lerobot_rows, read_lerobot
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.reader.reading import read_recording
from workbench.episodes.row import UnreadableRecording
from workbench.library.folder import Library, LibraryError

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture(scope="module")
def episode(recorded: Any, tmp_path_factory: pytest.TempPathFactory) -> Episode:
    read = read_episode(recorded.episode.write(tmp_path_factory.mktemp("recordings")).json)
    states = np.arange(read.length + 1, dtype=np.float32)
    obs = {
        "agent/qpos": np.outer(states, np.ones(9, np.float32)),
        "extra/goal": np.outer(states, [1.0, 2.0, 3.0]),
    }
    return replace(read, obs=obs)


@pytest.fixture
def succeeding(episode: Episode) -> Episode:
    succeeds = np.zeros(episode.length + 1, np.bool_)
    succeeds[-2] = True
    return replace(episode, evaluate={**episode.evaluate, "success": succeeds})


def shorter(episode: Episode, steps: int) -> Episode:
    """The episode's first `steps` steps."""
    return replace(
        episode,
        action=episode.action[:steps],
        reward=episode.reward[:steps],
        terminated=episode.terminated[:steps],
        truncated=episode.truncated[:steps],
        evaluate={key: values[: steps + 1] for key, values in episode.evaluate.items()},
        obs={key: values[: steps + 1] for key, values in episode.obs.items()},
    )


def export(folder: Path, *episodes: Episode, options: ExportOptions | None = None) -> Any:
    sources = [
        (f"episode {index}", lambda episode=episode: episode) for index, episode in enumerate(episodes)
    ]
    return export_lerobot(sources, folder, options or ExportOptions())


@pytest.mark.slow
@pytest.mark.parametrize(
    "limits", [{}, {"DATA_MB": 0, "VIDEO_MB": 0, "CHUNK_SIZE": 2}], ids=["one", "many files"]
)
def test_exported_episodes_are_read_back(
    episode: Episode, limits: dict[str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, limit in limits.items():
        monkeypatch.setattr(f"workbench.episodes.lerobot.format.{name}", limit)
    made = export(tmp_path / "set", shorter(episode, 5), shorter(episode, 4), episode)
    assert (made.episodes, made.frames) == (3, 9 + episode.length)
    files = [
        path.relative_to(tmp_path / "set/data").as_posix()
        for path in (tmp_path / "set/data").rglob("*.parquet")
    ]
    expected = ["chunk-000/file-000.parquet", "chunk-000/file-001.parquet", "chunk-001/file-000.parquet"]
    assert sorted(files) == expected[: 3 if limits else 1]
    first, second, third = lerobot_rows(tmp_path / "set")
    assert (first.length, second.length, third.length) == (5, 4, episode.length)
    assert third.seed == episode.info.seed
    assert third.total_reward == pytest.approx(float(episode.reward.sum()), rel=1e-5)
    read = read_lerobot(tmp_path / "set", 2)
    assert read.geometry is None and read.info.control_dt == pytest.approx(episode.info.control_dt)
    assert read.action_names == tuple(name.replace("/", ".") for name in episode.action_names)
    np.testing.assert_array_equal(read.action, episode.action)
    np.testing.assert_array_equal(read.reward, episode.reward)
    np.testing.assert_array_equal(read.obs["state"][:-1], episode.obs["agent/qpos"][:-1])
    assert np.isnan(read.obs["state"][-1]).all(), "a LeRobot dataset lacks the last state"
    cameras = {camera.info.name: camera for camera in episode.cameras}
    assert {camera.info.name for camera in read.cameras} == set(cameras)
    for camera in read.cameras:
        of = cameras[camera.info.name]
        assert camera.rgb is not None and of.rgb is not None and len(camera.rgb) == episode.length
        # Each frame is the picture of its own state, not of the state before or after.
        for state in range(episode.length):
            distances = [
                np.abs(camera.rgb[state].astype(int) - of.rgb[other].astype(int)).mean()
                for other in range(episode.length)
            ]
            assert int(np.argmin(distances)) == state


@pytest.mark.slow
def test_the_tables_follow_the_format(episode: Episode, succeeding: Episode, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    export(folder, episode, succeeding, options=ExportOptions(instruction="pick it up"))
    info = json.loads((folder / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["total_episodes"], info["splits"]) == (20, 2, {"train": "0:2"})
    assert info["features"]["action"]["shape"] == [episode.action.shape[1]]
    assert all("/" not in key for key in info["features"])
    rows = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    assert set(rows.column_names) == {key for key, of in info["features"].items() if of["dtype"] != "video"}
    assert rows["index"].to_pylist() == list(range(2 * episode.length))
    assert rows["frame_index"].to_pylist() == 2 * list(range(episode.length))
    assert rows["timestamp"].to_numpy() == pytest.approx(np.tile(np.arange(episode.length) / 20, 2))
    assert rows["next.success"].to_pylist()[-3:] == [False, True, False]
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    second = episodes[1]
    assert (second["dataset_from_index"], second["dataset_to_index"]) == (episode.length, 2 * episode.length)
    assert second["videos/observation.images.base_camera/from_timestamp"] == episode.length / 20
    assert second["tasks"] == ["pick it up"]
    stats = json.loads((folder / "meta/stats.json").read_text())
    both = np.concatenate([episode.action, episode.action])
    assert stats["action"]["mean"] == pytest.approx(both.mean(axis=0), abs=1e-6)
    assert stats["action"]["std"] == pytest.approx(both.std(axis=0), abs=1e-6)
    assert np.array(stats["observation.images.base_camera"]["mean"]).shape == (3, 1, 1)
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    assert tasks["__index_level_0__"].to_pylist() == ["pick it up"]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]


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
    assert frames.columns["observation.environment_state"].shape == (3, 9)
    assert frames.columns["action"].tolist() == episode.action[[0, 3, 6]].tolist()
    assert frames.columns["next.reward"].sum() == pytest.approx(episode.reward.sum(), rel=1e-5)
    with pytest.raises(ValueError, match="no observation 'agnet'; it has agent/qpos, extra/goal"):
        frames_of(episode, Choice(state=("agnet",)))
    with pytest.raises(ValueError, match="no camera 'x'"):
        frames_of(episode, Choice(cameras=("x",)))
    joints = frames_of(
        replace(episode, obs={}, env_states={"articulations/panda": np.zeros((episode.length + 1, 31))})
    )
    assert joints.columns["observation.state"].shape == (episode.length, 9)


def test_a_lower_rate_must_divide_the_control_rate(episode: Episode, tmp_path: Path) -> None:
    made = export(tmp_path / "set", episode, options=ExportOptions(fps=10))
    assert made.frames == episode.length // 2
    with pytest.raises(ValueError, match="not an integer multiple of 7"):
        export(tmp_path / "other", episode, options=ExportOptions(fps=7))


def test_incompatible_episodes_are_refused_and_no_file_is_left(episode: Episode, tmp_path: Path) -> None:
    narrow = replace(episode, action=episode.action[:, :2], action_names=episode.action_names[:2])
    with pytest.raises(
        ValueError,
        match=r"episode 1 does not fit into a dataset with episode 0: the shape of action is \[2\]",
    ):
        export(tmp_path / "set", episode, narrow)
    assert list(tmp_path.iterdir()) == []
    cut = replace(episode, broken_files=(BrokenFile("c.rrd", "was cut short."),))
    made = export(tmp_path / "rest", episode, narrow, cut, episode, options=ExportOptions(only_fitting=True))
    assert made.episodes == 2 and made.frames == 2 * episode.length
    assert made.not_fitting[0].startswith("episode 1 does not fit") and made.not_fitting[1:] == [
        "c.rrd was cut short."
    ]
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
    info = json.loads((folder / "meta/info.json").read_text())
    camera = next(key for key, feature in info["features"].items() if feature["dtype"] == "video")

    def write_info(change: dict[str, Any]) -> None:
        (folder / "meta/info.json").write_text(json.dumps({**info, **change}))

    # Python's own formatting could produce a gigabyte, or reveal attributes of an object.
    for pattern in ("data/{chunk_index:01000000000d}.parquet", "data/{chunk_index.__class__}.parquet"):
        write_info({"data_path": pattern})
        with pytest.raises(UnreadableRecording, match="cannot be read as a LeRobot dataset"):
            read_lerobot(folder, 0)
    huge = {**info["features"][camera], "shape": [100_000, 100_000, 3]}
    write_info({"features": {**info["features"], camera: huge}})
    with pytest.raises(UnreadableRecording, match="100000 x 100000"):
        read_lerobot(folder, 0)
    write_info({})
    os.mkfifo(folder / "data" / "chunk-000" / "file-001.parquet")
    assert lerobot_rows(folder)[0].length == episode.length
