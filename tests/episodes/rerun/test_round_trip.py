"""An episode read back from its files equals the episode that was written, number by number."""

from __future__ import annotations

import dataclasses
import io
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from PIL import Image
from rerun.chunk import RrdReader

from tests.drive.episodes import Made, Track
from tests.drive.equal import assert_equal
from tests.episodes.read_rrd import Column, read_rrd
from tests.episodes.verify_rrd import verify_rrd
from workbench.envs.camera_data import CameraInfo
from workbench.episodes.episode import Episode
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.rerun.entities import body_entities

Entities = dict[str, dict[str, Column]]


@pytest.fixture(scope="module")
def written(recorded: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Made, Path, Entities]:
    path = recorded.episode.write(tmp_path_factory.mktemp("recordings")).rrd
    return recorded.episode, path, read_rrd(path)


def assert_same(found: Episode, made: Made) -> None:
    """Assert that all arrays of `found` except meshes and pictures equal those of `made`, dtypes included."""
    for name in ("poses", "action", "reward", "terminated", "truncated"):
        assert_equal(getattr(found, name), getattr(made, name), name)
    for name in ("evaluate", "env_states", "obs"):
        assert_equal(
            dict(sorted(getattr(found, name).items())), dict(sorted(getattr(made, name).items())), name
        )


def scalars(entities: Entities, entity: str) -> tuple[NDArray, NDArray]:
    return every_step(entities[entity]["Scalars:scalars"])


def every_step(column: Column) -> tuple[NDArray, NDArray]:
    """The column with the unchanged rows added back, which the file leaves out."""
    assert column.steps is not None
    steps = np.arange(column.steps[0], column.steps[-1] + 1)
    return steps, np.stack(column.values)[np.searchsorted(column.steps, steps, side="right") - 1]


def test_rerun_itself_finds_nothing_wrong(child_process: None, written: tuple[Made, Path, Entities]) -> None:
    assert verify_rrd(written[1]) is None


def test_the_poses_of_every_body_are_written(written: tuple[Made, Path, Entities]) -> None:
    episode, _, entities = written
    moved = 0
    for body, entity in enumerate(body_entities(episode.geometry)):
        translation, quaternion = (
            entities[entity][f"Transform3D:{of}"] for of in ("translation", "quaternion")
        )
        expected = episode.poses[:, body]
        if (expected == expected[0]).all():
            assert translation.steps is None  # a body that never moved is written once
            expected = expected[:1]
            places, turns = np.stack(translation.values), np.stack(quaternion.values)
        else:
            (steps, places), (_, turns) = every_step(translation), every_step(quaternion)
            np.testing.assert_array_equal(steps, np.arange(len(episode.poses)))
            moved += 1
        np.testing.assert_array_equal(places[:, 0], expected[:, :3])
        np.testing.assert_array_equal(turns[:, 0, [3, 0, 1, 2]], expected[:, 3:])
    assert moved > 8, "the robot did not move, so this test compared nothing"


def test_the_whole_episode_is_read_back(written: tuple[Made, Path, Entities], recorded: Any) -> None:
    made, path, _ = written
    found = read_episode(path)
    assert_same(found, made)
    assert found.action_names == made.action_names and found.segmentation == made.segmentation
    source = {"task.py": "class Task: ...\n", "parts.py": "SIZE = 2\n"}
    assert found.info == dataclasses.replace(made.info, source=source, source_file="task.py")
    assert found.geometry is not None
    assert found.geometry.body_names == made.geometry.body_names
    assert found.geometry.body_hidden == made.geometry.body_hidden
    by_name = {visual.name: visual for visual in found.geometry.visuals}
    assert by_name.keys() == {visual.name for visual in made.geometry.visuals}
    for visual in made.geometry.visuals:
        again = by_name[visual.name]
        np.testing.assert_array_equal(again.mesh.vertices, visual.mesh.vertices)
        np.testing.assert_array_equal(again.mesh.faces, visual.mesh.faces)
        np.testing.assert_array_equal(np.sort(again.bodies), np.sort(visual.bodies))
        np.testing.assert_allclose(again.material.base_color, visual.material.base_color, rtol=1e-6)
    for track, again in zip(made.cameras, found.cameras, strict=True):
        assert again.info.key == track.info.key and again.info.mount == track.info.mount
        np.testing.assert_array_equal(again.info.intrinsic, track.info.intrinsic)
        np.testing.assert_array_equal(again.frame, track.frame)
        np.testing.assert_allclose(again.pose, track.pose, atol=1e-7)
        assert again.rgb is not None and again.depth is not None and again.segmentation is not None
        assert track.rgb is not None and track.segmentation is not None
        for state in track.frame:
            assert np.abs(again.rgb[state].astype(int) - track.rgb[state]).mean() < 6
            millimetres = np.rint(again.depth[state] * 1000).astype(int)
            np.testing.assert_array_equal(millimetres, recorded.depth_mm[track.info.name][state])
            np.testing.assert_array_equal(again.segmentation[state], track.segmentation[state])


def test_rerun_shows_actions_and_success_by_their_names(written: tuple[Made, Path, Entities]) -> None:
    episode, _, entities = written
    steps, values = scalars(entities, "/action")
    np.testing.assert_array_equal(steps, np.arange(1, len(episode.poses)))
    np.testing.assert_array_equal(values, episode.action.astype(np.float64))
    assert entities["/action"]["SeriesLines:names"].values[0] == list(episode.action_names)
    np.testing.assert_array_equal(scalars(entities, "/episode/success")[1][:, 0], episode.evaluate["success"])


def test_unchanged_values_are_not_written_again(make_episode: Callable[..., Made], tmp_path: Path) -> None:
    episode = make_episode(
        9, evaluate={"success": np.arange(10) > 5, "level": np.array([0.0] * 4 + [np.nan] * 6)}
    )
    episode.poses[3:8, 1] = episode.poses[3, 1]
    entities, again = read_rrd(episode.write(tmp_path).rrd), read_episode(next(tmp_path.glob("*.json")))
    assert_same(again, episode)
    kept = {
        "/evaluate/success": [0, 5, 6, 9],  # the curve through these steps equals the curve through all
        "/evaluate/level": [0, 3, 4, 9],
        "/reward": [1, 9],
    }
    for entity, steps in kept.items():
        np.testing.assert_array_equal(entities[entity]["Scalars:scalars"].steps, steps)
    moved = entities["/world/robot/hand"]["Transform3D:translation"].steps
    np.testing.assert_array_equal(moved, [0, 1, 2, 3, 7, 8, 9])


def test_an_rrd_alone_holds_all_but_the_states(written: tuple[Made, Path, Entities], tmp_path: Path) -> None:
    made, path, _ = written
    alone = read_episode(Path(shutil.copy(path, tmp_path / "sent to me.rrd")))
    assert_same(dataclasses.replace(alone, env_states=made.env_states), made)
    assert alone.env_states == {}
    assert alone.info == read_episode(path).info


def test_sim_time_is_the_time_of_the_step_in_seconds(written: tuple[Made, Path, Entities]) -> None:
    chunks = RrdReader(written[1]).stream().to_chunks()
    (reward,) = [one for one in chunks if one.entity_path == "/reward" and not one.is_static]
    times = reward.to_record_batch().column("sim_time").cast("int64").to_pylist()
    assert times == [50_000_000 * step for step in range(1, 9)]


def test_events_name_their_states(make_episode: Callable[..., Made], tmp_path: Path) -> None:
    episode = make_episode(
        5,
        evaluate={
            "success": np.array([0, 0, 1, 1, 0, 1], dtype=bool),
            "fail": np.array([np.nan, 0, 0, 1, 1, 1], dtype=np.float32),
        },
        terminated=np.array([0, 1, 0, 0, 0], dtype=bool),
        truncated=np.array([0, 0, 0, 0, 1], dtype=bool),
    )
    log = read_rrd(episode.write(tmp_path).rrd)["/logs/events"]
    texts = [value[0] for value in log["TextLog:text"].values]
    assert sorted(zip(np.asarray(log["TextLog:text"].steps).tolist(), texts)) == [
        (0, "reset with seed 7"),
        (2, "success"),
        (2, "terminated"),
        (3, "fail"),
        (5, "success"),
        (5, "truncated"),
    ]


def test_only_visuals_of_this_env_are_written(make_episode: Callable[..., Made], tmp_path: Path) -> None:
    episode = make_episode()
    (visual,) = episode.geometry.visuals
    elsewhere = dataclasses.replace(visual, envs=np.array([0, 1], dtype=np.int32))
    episode.geometry = dataclasses.replace(episode.geometry, num_envs=2, visuals=(elsewhere,))
    episode.poses[:, 1] = np.nan
    for env in (0, 1):
        episode.info = dataclasses.replace(episode.info, env_index=env)
        entities = read_rrd(episode.write(tmp_path).rrd)
        assert ("/world/floor/0" in entities) == (env == 0)
        # Both envs lack body 1 (NaN throughout), so it gets neither pose nor mesh.
        assert not [entity for entity in entities if entity.startswith("/world/robot/hand")]


EVALUATE = st.dictionaries(
    st.text(st.characters(exclude_categories=("Cs",)), max_size=8),
    st.tuples(
        st.sampled_from([np.dtype(bool), np.dtype(np.int32), np.dtype(np.float32), np.dtype(np.float64)]),
        st.sampled_from([(), (0,), (1,), (3,), (2, 2)]),
    ),
    max_size=4,
)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), steps=st.integers(0, 6), entries=EVALUATE, lost=st.integers(0, 9))
def test_any_episode_is_read_back(
    make_episode: Callable[..., Made], data: st.DataObject, steps: int, entries: Any, lost: int
) -> None:
    evaluate = {
        name: data.draw(hnp.arrays(dtype, (steps + 1, *shape)), label=name)
        for name, (dtype, shape) in entries.items()
    }
    episode = make_episode(steps, evaluate=evaluate)
    episode.poses[lost : lost + 2, 1] = np.nan
    episode.reward[:] = data.draw(hnp.arrays(np.float32, steps), label="reward")
    with tempfile.TemporaryDirectory() as folder:
        path = episode.write(Path(folder)).rrd
        entities, again = read_rrd(path), read_episode(path)
    assert_same(again, episode)
    if np.isnan(episode.poses[:, 1]).all():
        assert "/world/robot/hand" not in entities
    else:
        translation = entities["/world/robot/hand"]["Transform3D:translation"]
        poses = np.stack(translation.values) if translation.steps is None else every_step(translation)[1]
        held = np.broadcast_to(poses[:, 0], (steps + 1, 3))
        np.testing.assert_array_equal(held, episode.poses[:, 1, :3])
    if steps:
        np.testing.assert_array_equal(scalars(entities, "/reward")[1][:, 0], episode.reward)
    else:
        assert "Scalars:scalars" not in entities.get("/reward", {})
    drawn = [entity for entity in entities if entity.startswith("/evaluate/")]
    kept = {name: values for name, values in evaluate.items() if values[0].size}
    assert len(drawn) == len(kept)
    by_first_name = {entities[entity]["SeriesLines:names"].values[0][0]: entity for entity in drawn}
    for name, values in kept.items():
        first = name if values.ndim == 1 else f"{name}[{', '.join('0' * (values.ndim - 1))}]"
        read = scalars(entities, by_first_name[first])[1]
        np.testing.assert_array_equal(read, values.reshape(steps + 1, -1).astype(np.float64))


def test_cameras_with_equal_names_and_far_depths_are_read_back(
    make_episode: Callable[..., Made], tmp_path: Path
) -> None:
    def track(kind: Any, ids: NDArray[np.int32]) -> Track:
        info = CameraInfo("eye", kind, 2, 2, 1.0, 0.01, 100.0, np.eye(3, dtype=np.float32), None, ("depth",))
        pose = np.array([[0, 0, 0, 1, 0, 0, 0]], dtype=np.float32)
        depth = np.array([[[np.nan, np.inf], [-1.0, 70.0]]], dtype=np.float32)
        return Track(info, np.array([2]), pose, None, depth, ids)

    negative = np.array([[[-1, 0], [1, 70_000]]], dtype=np.int32)
    small = np.array([[[0, 0], [1, 65_535]]], dtype=np.int32)
    episode = make_episode(
        cameras=[track("human", negative), track("sensor", small)], segmentation={70_000: "far"}
    )
    entities = read_rrd(episode.write(tmp_path).rrd)
    depth = entities["/world/cameras/eye/depth"]["EncodedDepthImage:blob"]
    np.testing.assert_array_equal(depth.steps, [2])
    np.testing.assert_array_equal(
        np.asarray(Image.open(io.BytesIO(depth.values[0][0]))), [[0, 0], [0, 65535]]
    )
    for entity, dtype, ids in (("eye", np.uint16, small), ("eye_human", np.int32, negative)):
        buffer = entities[f"/world/cameras/{entity}/segmentation"]["SegmentationImage:buffer"].values[0][0]
        np.testing.assert_array_equal(np.frombuffer(buffer, dtype=dtype).reshape(1, 2, 2), ids)
