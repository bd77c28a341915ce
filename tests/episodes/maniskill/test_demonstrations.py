"""Episodes written as one file of demonstrations, number by number, and read back as ManiSkill's own files are."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.drive.episodes import made
from tests.drive.equal import assert_equal
from workbench.envs.camera_data import CameraInfo, CameraKind
from workbench.episodes.encoded_pictures import EncodedPictures, encode
from workbench.episodes.episode import CameraTrack, Episode
from workbench.episodes.maniskill.export import Demonstrations, OtherDemonstration, export_maniskill
from workbench.episodes.maniskill.read import read_maniskill
from workbench.episodes.reader.read_rows import read_found
from workbench.episodes.reader.scan import scan_folder
from workbench.episodes.row import UnreadableRecording

HEIGHT, WIDTH = 6, 8


def camera_track(name: str, kind: CameraKind, states: int, first: int) -> CameraTrack:
    """A camera that turns at every second state and ends where it began; each picture tells its state, each pixel column differs."""
    turns = np.random.default_rng(first).normal(size=(states, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    pose = np.column_stack([np.arange(3 * states).reshape(states, 3) + first, turns]).astype(np.float32)
    pose[1::2] = pose[: states - states % 2 : 2]
    pose[-1] = pose[0]
    column = np.arange(WIDTH)
    numbers = first + 10 * np.arange(states)[:, None, None] + np.zeros((HEIGHT, 1), int) + column
    matrix = np.array([[9, 0, WIDTH / 2], [0, 7, HEIGHT / 2], [0, 0, 1]], np.float32)
    modalities = ("rgb", "depth", "segmentation")
    info = CameraInfo(name, kind, WIDTH, HEIGHT, 1.0, 0.01, 10.0, matrix, None, modalities)
    grey = np.repeat(numbers[..., None], 3, axis=3).astype(np.uint8)
    return CameraTrack(
        info,
        np.arange(states),
        pose,
        EncodedPictures("rgb", [encode("rgb", one) for one in grey]),
        EncodedPictures("depth", [encode("depth", one.astype(np.float32) / 100) for one in numbers]),
        EncodedPictures("segmentation", [encode("segmentation", one.astype(np.int32)) for one in numbers]),
    )


def episode_of(steps: int, seed: int, success_from: int | None = None, **kwargs: Any) -> Episode:
    """Each number of the episode tells its step and its seed."""
    states = np.arange(steps + 1, dtype=np.float32)
    episode = made(
        steps,
        success_from,
        seed,
        env_kwargs={"obs_mode": "state+rgb+depth+segmentation", "robot_uids": "panda", **kwargs},
        reset_options={"level": seed},
        max_episode_steps=70,
    )
    return replace(
        episode,
        action=np.outer(states[1:], [1.0, -1.0]).astype(np.float32) + seed,
        truncated=np.arange(steps) == steps - 2,
        env_states={"actors/cube": np.outer(states, np.arange(13)).astype(np.float32) + seed},
        obs={"agent/qpos": np.outer(states, [1, 2]), "extra/goal": states + seed},
        cameras=[
            camera_track("eye", "sensor", steps + 1, 10 + seed),
            camera_track("hand", "sensor", steps + 1, 60),
            camera_track("view", "human", steps + 1, 100),
        ],
    )


def export(file: Path, *episodes: Episode, **options: Any) -> Demonstrations:
    return export_maniskill(
        [(f"{k}", lambda one=one: one) for k, one in enumerate(episodes)], file, **options
    )


def test_every_number_of_each_episode_is_read_back(tmp_path: Path) -> None:
    given = [episode_of(4, 0), episode_of(6, 5, success_from=3)]
    progress: list[tuple[int, str]] = []
    done = export(tmp_path / "demos.h5", *given, on_progress=lambda *at: progress.append(at))
    assert (done.episodes, done.steps, done.left_out, done.not_fitting, done.incomplete) == (2, 10, 0, [], [])
    assert done.lossy and progress == [(0, "0"), (1, "1"), (2, "done")]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["demos.h5", "demos.json"]
    for number, episode in enumerate(given):
        read = read_maniskill(done.file, f"traj_{number}")
        for name in ("action", "reward", "terminated", "truncated", "env_states"):
            assert_equal(getattr(read, name), getattr(episode, name), name)
        np.testing.assert_array_equal(read.evaluate["success"][1:], episode.evaluate["success"][1:])
        assert not read.evaluate["success"][0] and read.action_names == ("action[0]", "action[1]")
        together = np.column_stack([episode.obs["agent/qpos"], episode.obs["extra/goal"]])
        assert read.obs.keys() == {"state"}
        np.testing.assert_array_equal(read.obs["state"], together)
        info, wanted = read.info, episode.info
        assert (info.task, info.seed, info.control_mode) == (wanted.task, wanted.seed, wanted.control_mode)
        assert (info.reset_options, info.max_episode_steps) == (wanted.reset_options, 70)
        assert info.env_kwargs == {"control_mode": wanted.control_mode, **wanted.env_kwargs}
        assert info.acted_by == ((0, "workbench"),)
        for track, original in zip(read.cameras, episode.cameras[:2], strict=True):
            name, size = original.info.name, (WIDTH, HEIGHT)
            assert (track.info.name, (track.info.width, track.info.height)) == (name, size)
            assert track.info.fovy == pytest.approx(2 * np.arctan(HEIGHT / 2 / 7))
            np.testing.assert_array_equal(track.info.intrinsic, original.info.intrinsic)
            np.testing.assert_array_equal(track.frame, original.frame)
            np.testing.assert_allclose(track.pose[:, :3], original.pose[:, :3])
            # A quaternion and its negative are one rotation.
            same = np.abs((track.pose[:, 3:] * original.pose[:, 3:]).sum(axis=1))
            np.testing.assert_allclose(same, 1, atol=1e-6)
            assert track.rgb and track.depth and track.segmentation
            assert original.rgb and original.depth and original.segmentation
            assert_equal((track.depth, track.segmentation), (original.depth, original.segmentation))
            assert len(track.rgb) == len(original.rgb)
            for at in range(len(original.rgb)):
                assert np.abs(track.rgb[at].astype(int) - original.rgb[at]).max() < 6


def test_camera_matrices_turn_points_as_opencv_and_opengl_do(tmp_path: Path) -> None:
    episode = episode_of(5, 1)
    done = export(tmp_path / "demos.h5", episode)
    with h5py.File(done.file) as file:
        for track in episode.cameras[:2]:
            held: Any = file[f"traj_0/obs/sensor_param/{track.info.name}"]
            for state, pose in enumerate(track.pose.astype(np.float64)):
                turn, place = Rotation.from_quat(pose[[4, 5, 6, 3]]).as_matrix(), pose[:3]
                # Points one metre ahead, to the left and above of a camera that looks along x.
                points = place + turn.T
                seen = points @ held["extrinsic_cv"][state][:, :3].T + held["extrinsic_cv"][state][:, 3]
                np.testing.assert_allclose(seen, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-4)
                world = held["cam2world_gl"][state]
                back = np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]]) @ world[:3, :3].T + world[:3, 3]
                np.testing.assert_allclose(back, points, atol=1e-4)
                np.testing.assert_array_equal(world[3], [0, 0, 0, 1])
                np.testing.assert_array_equal(held["intrinsic_cv"][state], track.info.intrinsic)


PICTURES = {"rgb", "depth", "segmentation"}


@pytest.mark.parametrize(
    ("mode", "plain", "pictures", "lacks"),
    [
        ("state", {"obs"}, set(), ""),
        ("state_dict", {"obs/agent/qpos", "obs/extra/goal"}, set(), ""),
        ("state_dict+depth", {"obs/agent/qpos", "obs/extra/goal"}, {"depth"}, ""),
        ("rgb+state", {"obs/state"}, {"rgb"}, ""),
        ("rgbd", {"obs/agent/qpos", "obs/extra/goal"}, {"rgb", "depth"}, ""),
        ("rgb+normal", {"obs/agent/qpos", "obs/extra/goal"}, {"rgb"}, "normal"),
        (None, {"obs/agent/qpos", "obs/extra/goal"}, PICTURES, ""),
    ],
)
def test_the_observation_mode_tells_which_observations_are_written(
    tmp_path: Path, mode: str | None, plain: set[str], pictures: set[str], lacks: str
) -> None:
    episode = episode_of(3, 1, obs_mode=mode)
    done = export(tmp_path / "demos.h5", episode)
    found: set[str] = set()
    with h5py.File(done.file) as file:
        trajectory: Any = file["traj_0"]
        trajectory.visititems(lambda name, node: found.add(name) if isinstance(node, h5py.Dataset) else None)
    held = {name for name in found if name.startswith("obs") and "sensor_param" not in name}
    assert held == plain | {f"obs/sensor_data/{name}/{m}" for name in ("eye", "hand") for m in pictures}
    assert done.lossy == ("rgb" in pictures)
    assert [lacks in sentence for sentence in done.incomplete] == ([True] if lacks else [])


def test_a_camera_without_a_picture_for_every_state_is_left_out_and_named(tmp_path: Path) -> None:
    episode = episode_of(3, 1)
    eye, hand, view = episode.cameras
    late = replace(eye, frame=eye.frame[1:], pose=eye.pose[1:])
    done = export(tmp_path / "a.h5", replace(episode, cameras=[late, replace(hand, depth=None), view]))
    (sentence,) = done.incomplete
    assert (
        "eye (3 pictures of 4 states)" in sentence and "depth of hand" in sentence and "view" not in sentence
    )
    (track,) = read_maniskill(done.file, "traj_0").cameras
    assert track.info.name == "hand" and track.depth is None and track.rgb is not None
    blind = export(tmp_path / "b.h5", replace(episode, cameras=[view]))
    assert len(blind.incomplete) == 1 and not blind.lossy
    assert read_maniskill(blind.file, "traj_0").cameras == []


def test_far_distances_and_large_ids_keep_to_the_numbers_of_the_format(tmp_path: Path) -> None:
    episode = episode_of(1, 1)
    far = np.full((HEIGHT, WIDTH), 50.0, np.float32)
    ids = np.full((HEIGHT, WIDTH), 70_000, np.int32)
    eye = replace(
        episode.cameras[0],
        depth=EncodedPictures("depth", [encode("depth", far)] * 2),
        segmentation=EncodedPictures("segmentation", [encode("segmentation", ids)] * 2),
    )
    done = export(tmp_path / "a.h5", replace(episode, cameras=[eye]))
    (track,) = read_maniskill(done.file, "traj_0").cameras
    assert track.depth and track.segmentation
    assert track.depth[0] == pytest.approx(32.767) and (track.segmentation[1] == 32_767).all()


def test_a_file_of_several_robots_without_rewards_and_with_distances_in_metres_is_read(
    tmp_path: Path,
) -> None:
    path = tmp_path / "theirs.h5"
    depth = np.linspace(0, 2, 4 * HEIGHT * WIDTH, dtype=np.float32).reshape(4, HEIGHT, WIDTH, 1)
    colours = np.full((4, HEIGHT, WIDTH, 4), 200, np.uint8)
    with h5py.File(path, "w") as file:
        for name, first in (("traj_3", 100), ("traj_7", 0)):
            group = file.create_group(name)
            group["actions/one"] = np.arange(6, dtype=np.float32).reshape(3, 2) + first
            group["actions/two"] = np.full((3, 1), 9, np.float32)
            group["terminated"], group["truncated"] = [False, False, True], [False, True, False]
            group["fail"] = [False, True, True]
            group["obs/sensor_data/eye/depth"], group["obs/sensor_data/eye/rgb"] = depth, colours
    made_with = {"sim_config": {"control_freq": 50}, "sim_backend": "gpu"}
    entries = [{"episode_id": 3, "episode_seed": 8}, {"episode_id": 7, "reset_kwargs": {"seed": [9]}}]
    document = {"env_info": {"env_id": "Two-v1", "env_kwargs": made_with}, "episodes": entries}
    path.with_suffix(".json").write_text(json.dumps(document))
    read = read_maniskill(path, "traj_7")
    assert (read.info.seed, read.info.control_dt, read.info.backend) == (9, 0.02, "gpu")
    assert (read.info.acted_by, read.info.reset_options) == ((), {})
    assert read.action.tolist() == [[0, 1, 9], [2, 3, 9], [4, 5, 9]]
    assert read.action_names == ("one[0]", "one[1]", "two[0]") and np.isnan(read.reward).all()
    assert read.evaluate["fail"].tolist() == [False, False, True, True] and "success" not in read.evaluate
    (track,) = read.cameras
    assert (
        track.depth and track.rgb and track.segmentation is None and track.info.modalities == ("depth", "rgb")
    )
    np.testing.assert_allclose(track.depth[2], depth[2, ..., 0], atol=1e-6)
    assert track.rgb[3].shape == (HEIGHT, WIDTH, 3) and (track.rgb[3] == 200).all()
    assert track.pose.tolist() == [[0, 0, 0, 1, 0, 0, 0]] * 4
    assert [facts.seed for facts, _ in read_found(tmp_path, scan_folder(tmp_path).found["theirs"])] == [8, 9]
    with pytest.raises(UnreadableRecording):
        read_maniskill(path, "traj_0")


def unreadable() -> Episode:
    raise UnreadableRecording("it was cut short")


def test_episodes_that_fail_or_do_not_fit_are_left_out_on_request(tmp_path: Path) -> None:
    once = episode_of(4, 2)
    once.evaluate["success"][2] = True  # and no longer in the last state
    never, always = episode_of(3, 1), episode_of(5, 3, success_from=0)
    other = episode_of(3, 4, success_from=0, robot_uids="fetch")
    sources: list[tuple[str, Callable[[], Episode]]] = [
        ("never", lambda: never),
        ("once", lambda: once),
        ("torn", unreadable),
        ("other", lambda: other),
        ("none", lambda: episode_of(0, 6)),
        ("always", lambda: always),
    ]
    done = export_maniskill(sources, tmp_path / "a.h5", only_successes=True, only_fitting=True)
    assert (done.episodes, done.steps, done.left_out) == (2, 9, 1)
    assert [sentence.split(":")[0] for sentence in done.not_fitting] == ["torn", "other", "none"]
    entries = json.loads((tmp_path / "a.json").read_text())["episodes"]
    assert [entry["episode_id"] for entry in entries] == [0, 1]
    assert [entry["workbench_id"] for entry in entries] == [once.info.id, always.info.id]
    assert [entry["success"] for entry in entries] == [False, True]
    assert [entry["elapsed_steps"] for entry in entries] == [4, 5]
    assert [read_maniskill(done.file, f"traj_{k}").length for k in range(2)] == [4, 5]
    for refused, error in ((sources[2], UnreadableRecording), (sources[3], OtherDemonstration)):
        with pytest.raises(error):
            export_maniskill([sources[1], refused], tmp_path / "b.h5")
    with pytest.raises(ValueError):
        export_maniskill(sources[:1], tmp_path / "b.h5", only_successes=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.h5", "a.json"]


def test_an_export_overwrites_no_file(tmp_path: Path) -> None:
    for name in ("a.h5", "b.json"):
        (tmp_path / name).write_text("mine")
        with pytest.raises(FileExistsError):
            export((tmp_path / name).with_suffix(".h5"), episode_of(2, 1))
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a.h5": "mine", "b.json": "mine"}


def test_the_library_lists_each_episode_with_its_own_numbers_and_last_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = [episode_of(4, 0), episode_of(6, 5, success_from=3)]
    given[1].evaluate["fail"] = np.arange(7) > 4
    given[0].evaluate["fail"] = np.zeros(5, bool)
    export(tmp_path / "demos.h5", *given)
    (found,) = scan_folder(tmp_path).found.values()
    rows = read_found(tmp_path, found)
    for number, ((facts, picture), episode) in enumerate(zip(rows, given, strict=True)):
        assert (facts.kind, facts.trajectory, facts.problem) == ("maniskill", f"traj_{number}", None)
        assert (facts.task, facts.seed, facts.length) == ("Push-v1", episode.info.seed, episode.length)
        assert (facts.success, facts.fail) == (number == 1, number == 1)
        assert facts.total_reward == episode.reward.sum() and facts.copy_of == episode.info.id
        assert (facts.control_mode, facts.acted_by) == (episode.info.control_mode, "workbench")
        assert facts.written == found.newest / 1e9 and picture is not None
        shade = np.asarray(Image.open(io.BytesIO(picture))).mean()
        assert shade == pytest.approx(10 + episode.info.seed + 10 * episode.length + (WIDTH - 1) / 2, abs=3)
    names = read_found(tmp_path, found, only_names=True)
    assert [(facts.total_reward, picture) for facts, picture in names] == [(None, None)] * 2
    with monkeypatch.context() as patch:
        patch.setattr("workbench.episodes.reader.read_rows.MAX_EPISODES", 1)
        (first, more) = [facts for facts, _ in read_found(tmp_path, found)]
    assert first.trajectory == "traj_0" and more.trajectory is None and more.problem is not None
    with h5py.File(tmp_path / "demos.h5", "a") as file:
        del file["traj_0"]
        file.create_group("traj_9")
    lost, whole, more = [facts.problem for facts, _ in read_found(tmp_path, found)]
    assert lost is not None and "traj_0" in lost and whole is None and more is not None and "traj_9" in more
