"""The steps of a batch, split into the episodes of envs that all differ, and read back from their files."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.drive.episodes import appended, made
from tests.drive.scenes import camera, description, table_scene
from tests.drive.session import moment
from tests.record.gathered import assert_rows, columns_of, pictures_of
from workbench.envs.camera_data import CameraInfo, CameraSettings
from workbench.envs.step_result import OtherEntry
from workbench.envs.task_drawings import Drawing
from workbench.episodes.episode import Episode
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.writing.episode_writer import EpisodeFiles
from workbench.record.gather import EpisodeFinisher, EpisodeGatherer, GatheredEpisode, episode_info
from workbench.task.description import Stepped

ENVS = 4
LENS = CameraSettings((0, 0, 1), (1, 0, 0, 0), 1.0, None, 8, 6, 0.01, 10.0, "default")


def data(number: int) -> dict[str, Any]:
    """Pictures and columns that differ for each moment and env."""
    return {"captured": pictures_of(number, reversed(range(ENVS))), "columns": columns_of(number, ENVS)}


@dataclass
class Batch:
    """A gatherer, the steps that it took, and the episodes that it gave."""

    folder: Path
    env_idx: Sequence[int] = range(ENVS)
    named: dict[str, Any] = field(default_factory=dict)
    camera: CameraInfo = field(default_factory=camera)
    number: int = 0
    taken: list[Stepped] = field(default_factory=list)
    ended: list[GatheredEpisode] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.elapsed = np.zeros(ENVS, np.int32)
        geometry, _ = table_scene(ENVS)
        self.task = description(geometry, (self.camera,))
        self.gatherer = EpisodeGatherer(self.task, self.env_idx, self.folder, self.ended.append, **self.named)

    def reset(self, *envs: int, to: int = 0, **more: Any) -> None:
        self.elapsed = self.elapsed.copy()
        self.elapsed[list(envs)] = to
        seeds = np.arange(ENVS) + 10 * self.number + 5
        self._take(tuple(envs), seeds=seeds, **more)

    def step(self, **more: Any) -> None:
        self.elapsed = self.elapsed + 1
        self._take((), **more)

    def _take(self, jumped: tuple[int, ...], **more: Any) -> None:
        stepped = moment(self.elapsed, jumped, number=self.number, **data(self.number), **more)
        self.number += 1
        self.taken.append(stepped)
        self.gatherer.take(stepped)

    def read(self) -> list[Episode]:
        """The ended episodes from their files."""
        return [read_episode(one.writer.finish().json) for one in self.ended]


def test_each_env_has_the_rows_of_its_own_episode(tmp_path: Path) -> None:
    batch = Batch(tmp_path, (3, 1, 0))
    batch.reset(0, 1, 2, 3)
    batch.step(reward=[1, 10, 100, 1000])
    batch.step(success=(1,))
    batch.step(truncated=(0,), reward=[9, 8, 7, 6])
    batch.reset(1, 0)
    batch.step(fail=(0,), success=(3,))
    batch.gatherer.finish()
    begins = {1: [(0, 3), (4, 6)], 0: [(0, 4), (4, 6)], 3: [(0, 4)]}
    # Env 3 goes on while others are reset: the reset of the others is no step.
    wanted = [(env, batch.taken[begin:end], begin) for env, all in begins.items() for begin, end in all]
    wanted = [one for one in wanted if one[0] != 3]
    three = [*batch.taken[:4], batch.taken[5]]
    read = batch.read()
    assert sorted((one.info.env_index, one.info.seed) for one in read) == sorted(
        [*((env, env + 10 * begin + 5) for env, _, begin in wanted), (3, 8)]
    )
    for env, taken, begin in [*wanted, (3, three, 0)]:
        (episode,) = [one for one in read if one.info.seed == env + 10 * begin + 5]
        assert_rows(episode, env, taken)
    results = {(one.env, one.seed): (one.steps, one.total_reward, one.success) for one in batch.ended}
    assert results == {
        (1, 6): (2, 10 + 2.0, True),
        (0, 5): (3, 1 + 2 + 9.0, False),
        (1, 46): (1, 1.0, False),
        (0, 45): (1, 1.0, False),
        (3, 8): (4, 1000 + 2 + 6 + 4.0, True),
    }


def test_other_entries_drawings_and_the_numbers_of_the_batch_are_those_of_the_env(tmp_path: Path) -> None:
    batch = Batch(tmp_path, (2, 0))
    points = np.arange(ENVS * 2 * 3, dtype=np.float32).reshape(ENVS, 2, 3)
    points[0, 1] = np.nan
    entries: dict[str, Any] = {
        "others": {
            "phase": OtherEntry("str", tuple(f"env {env}" for env in range(ENVS)), per_env=True),
            "mean": OtherEntry("float32 tensor of shape ()", numbers=np.array(0.25, np.float32)),
        },
        "drawn": {"goal": Drawing("points", points)},
    }
    take = batch.gatherer.take

    def with_entries(stepped: Stepped) -> None:
        take(replace(stepped, step=replace(stepped.step, **entries)))

    batch.gatherer.take = with_entries  # type: ignore[method-assign]
    batch.reset(0, 1, 2, 3)
    batch.step()
    batch.gatherer.finish()
    for episode in batch.read():
        env = episode.info.env_index
        for state in range(2):
            others = episode.other_entries_at(state)
            assert others["phase"].texts == (f"env {env}",)
            assert others["mean"].numbers == np.float32(0.25)
            goal = episode.drawings_at(state)["goal"].data
            np.testing.assert_array_equal(goal[0], points[env][: 1 if env == 0 else 2])


def test_an_env_that_jumps_into_an_episode_is_recorded_from_its_next_reset(tmp_path: Path) -> None:
    batch = Batch(tmp_path, (0, 1))
    batch.reset(0, 1)
    batch.step()
    batch.reset(1, to=7)
    assert [(one.env, one.steps) for one in batch.ended] == [(1, 1)]
    assert [one.env for one in batch.gatherer.under_way] == [0]
    batch.step()
    batch.reset(1)
    batch.reset(1)
    assert [one.steps for one in batch.gatherer.under_way] == [2, 0]
    assert len(batch.ended) == 1, "an episode without a step is dropped"
    batch.step()
    batch.gatherer.finish()
    assert [(one.env, one.steps) for one in batch.ended] == [(1, 1), (0, 3), (1, 1)]
    assert len(batch.read()) == 3
    assert not list(tmp_path.glob("**/*.journal*"))


def test_one_each_ends_with_the_next_episode_of_each_env(tmp_path: Path) -> None:
    batch = Batch(tmp_path, (2, 0), {"one_each": True})
    batch.step()
    batch.reset(0)
    batch.reset(0)
    assert batch.gatherer.env_idx == (2, 0), "an episode without a step does not count"
    batch.step(success=(0,))
    assert batch.gatherer.env_idx == (2,)
    batch.reset(0, 2)
    batch.step()
    batch.reset(0, 2)
    assert batch.gatherer.env_idx == () == batch.gatherer.under_way
    batch.step()
    assert [(one.env, one.steps) for one in batch.ended] == [(0, 1), (2, 1)]
    for one in batch.ended:
        one.writer.discard()


def test_a_step_that_also_resets_an_env_is_a_step_of_the_others_only(tmp_path: Path) -> None:
    batch = Batch(tmp_path, (0, 1))
    batch.reset(0, 1)
    batch.step()
    elapsed = np.array([2, 0, 2, 2], np.int32)
    both = moment(elapsed, (1,), number=2, seeds=np.arange(ENVS), **data(2))
    action = np.full((ENVS, 2), 0.5, np.float32)
    batch.gatherer.take(replace(both, step=replace(both.step, action=action)))
    assert [(one.env, one.steps) for one in batch.ended] == [(1, 1)]
    assert [(one.env, one.steps) for one in batch.gatherer.under_way] == [(0, 2), (1, 0)]
    batch.gatherer.finish()
    for one in batch.ended:
        one.writer.discard()


@pytest.mark.parametrize(("ends", "steps"), [("over", [1]), ("reset", [3])])
def test_an_episode_ends_at_its_end_or_at_the_reset(tmp_path: Path, ends: str, steps: list[int]) -> None:
    batch = Batch(tmp_path, (1, 2), {"ends": ends})
    batch.reset(1, 2)
    batch.step(fail=(1,), truncated=(2,))
    batch.step()
    batch.step(success=(0,), evaluate={"success": np.array([[True, True], [False, True]] * 2)})
    batch.reset(1, 2)
    assert [(one.env, one.steps) for one in batch.ended] == [
        (env, count) for env in (1, 2) for count in steps
    ]
    assert batch.ended[0].success is (ends == "reset")
    for env in (1, 2, 2):
        batch.gatherer.drop(env)
    assert batch.gatherer.env_idx == (1, 2) and not batch.gatherer.under_way
    batch.reset(1)
    batch.gatherer.finish()
    assert len(batch.ended) == 2
    for one in batch.ended:
        one.writer.discard()
    assert not list(tmp_path.iterdir())


def test_a_lost_step_is_an_error_and_the_states_before_it_are_kept(tmp_path: Path) -> None:
    batch = Batch(tmp_path, (0, 1))
    batch.reset(0, 1)
    batch.step()
    batch.elapsed[1] += 1
    with pytest.raises(ValueError, match="env 1"):
        batch.step()
    batch.gatherer.finish()
    assert {one.info.env_index: one.length for one in batch.read()} == {0: 2, 1: 1}


def test_an_episode_tells_how_it_was_reset_and_by_whom_it_was_acted(tmp_path: Path) -> None:
    batch = Batch(tmp_path, (0, 2))
    batch.gatherer.acted_by, batch.gatherer.next_id = "hold", "first"
    batch.gatherer.reset_options = {"level": 3}
    batch.reset(0)
    batch.gatherer.reset_options = {"level": 4}
    batch.reset(2)
    for by in ("", "sliders", "sliders", "random"):
        batch.step(acted_by=by or "hold")
    batch.gatherer.finish()
    first, second = batch.read()
    assert (first.info.id, first.info.reset_options) == ("first", {"level": 3})
    assert second.info.id not in ("first", "") and second.info.reset_options == {"level": 4}
    assert first.info.acted_by == ((0, "hold"), (1, "sliders"), (3, "random"))
    assert second.info.acted_by == first.info.acted_by


def test_an_episode_tells_from_which_state_on_a_camera_was_placed_by_hand(tmp_path: Path) -> None:
    batch = Batch(tmp_path, (0,), camera=replace(camera(), settings=LENS))
    placed = {camera().key: replace(LENS, fov=0.5)}
    batch.reset(0, placed=placed)
    for then in (placed, {}, {}, placed):
        batch.step(placed=then)
    batch.gatherer.finish()
    (episode,) = batch.read()
    assert [(one.state, one.used.fov, one.in_file.fov) for one in episode.info.moved_cameras] == [
        (0, 0.5, 1.0),
        (2, 1.0, 1.0),
        (4, 0.5, 1.0),
    ]


def test_the_info_is_that_of_the_task() -> None:
    task = replace(
        description(table_scene(2)[0]),
        file="/tasks/push.py",
        source={"/tasks/push.py": "x = 1\n"},
        source_hash="ab",
        backend="gpu",
        control_mode="pd_ee_delta_pose",
        control_dt=0.1,
        max_episode_steps=70,
        env_kwargs={"robot_uids": "panda"},
        pictures="fast",
    )
    info = episode_info(task, 1, 9, {"level": 3}, "zero")
    assert (info.task, info.env_index, info.seed) == (task.env_id, 1, 9)
    for name in ("source", "source_hash", "control_dt", "control_mode", "backend", "pictures"):
        assert getattr(info, name) == getattr(task, name), name
    assert (info.source_file, info.max_episode_steps) == (task.file, 70)
    assert (info.env_kwargs, info.reset_options) == ({"robot_uids": "panda"}, {"level": 3})
    assert info.acted_by == ((0, "zero"),) and not episode_info(task, 1, 9).acted_by


class Panic(BaseException):
    """Like a panic in rerun's Rust code: not an `Exception`."""


@pytest.mark.parametrize("error", [OSError, Panic])
def test_the_finisher_counts_what_is_written_and_tells_of_each(
    tmp_path: Path, error: type[BaseException]
) -> None:
    batch = Batch(tmp_path, (0, 1))
    batch.reset(0, 1)
    batch.step()
    batch.gatherer.finish()
    changes: list[tuple[int, str | None]] = []
    then: list[Path] = []

    def refuse_second(files: Any) -> None:
        then.append(files.json)
        if len(then) == 2:
            raise error("no network")

    finisher = EpisodeFinisher(
        lambda: changes.append((finisher.finished.count, finisher.finished.problem)), then=refuse_second
    )
    one, two = [finisher.finish(episode) for episode in batch.ended]
    files = one.result(60)
    assert not isinstance(files, str) and files.json == then[0]
    assert isinstance(two.result(60), str) and "no network" in str(two.result())
    finisher.close()
    assert [count for count, _ in changes] == [1, 1] and changes[0][1] is None
    assert changes[1][1] == two.result() and finisher.waiting == 0
    size = sum(file.stat().st_size for file in (files.rrd, files.h5, files.json))
    assert (finisher.finished.bytes_written, finisher.finished.last) == (size, files)


def test_the_error_of_one_episode_is_not_lost_when_the_next_is_written(tmp_path: Path) -> None:
    folders = (tmp_path / "gone", tmp_path / "there")
    episodes = [
        GatheredEpisode(appended(folder, made(3), pictures=False), env=env, seed=0)
        for env, folder in enumerate(folders)
    ]
    shutil.rmtree(folders[0])
    finisher = EpisodeFinisher()
    lost, kept = (finisher.finish(episode).result(60) for episode in episodes)
    finisher.close()
    assert isinstance(lost, str) and "env 0" in lost and "gone" in lost
    assert isinstance(kept, EpisodeFiles) and kept.rrd.is_file()
