"""Episodes that are saved from the history: each file equals what was played, whatever fails or was edited."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.drive.background import ScriptedBackground
from tests.drive.scenes import camera as scene_camera
from tests.drive.session import (
    BASE,
    FakeWorkerSession,
    fake_worker_session,
    hold_saving,
    moments_of,
    seek,
)
from tests.drive.waiting import until
from tests.record.gathered import assert_rows, columns_of, pictures_of
from workbench.envs.camera_data import CameraSettings, Picture
from workbench.episodes.episode import Episode
from workbench.episodes.reader.read_episode import read_episode
from workbench.live.messages import PlaceCamera, Reset
from workbench.live.process.background_jobs import JobFailed
from workbench.machine.loop import do
from workbench.record.gather import EpisodeFinisher
from workbench.record.questions import Captured, CaptureMoment
from workbench.record.save_past import PastSaver
from workbench.record.saving_state import (
    BeginSaving,
    EpisodesSaved,
    SaveFailed,
    SaveProgressed,
    SaveRequest,
    request_of,
)
from workbench.record.state import EpisodeEnded
from workbench.task.description import Stepped
from workbench.task.problem import Problem

ENVS = 3
SETTINGS = CameraSettings((0, 0, 1), (1, 0, 0, 0), 1.0, None, 8, 6, 0.01, 10.0, "default")
PLACED = (PlaceCamera(BASE, SETTINGS),)


class Saver:
    """A `PastSaver`, its events, and the process that renders the moments again."""

    def __init__(self, fake: FakeWorkerSession, folder: Path) -> None:
        self.fake, self.folder = fake, folder
        self.lost: set[int] = set()
        """Envs whose reset alone gives another first state."""
        self.process = ScriptedBackground(self.answer)
        self.finisher = EpisodeFinisher()
        self.events: list[Any] = []
        self.saver = PastSaver(folder, self.finisher, self.process, self.events.append)  # type: ignore[arg-type]
        self.job = 0

    def answer(self, question: Any) -> Any:
        if isinstance(question, Reset):
            assert question.env_idx is not None
            (env,) = question.env_idx
            first = next(one for one in moments_of(self.fake.session) if one.seeds is not None)
            first = first.step
            poses = first.poses.copy()
            poses[[one for one in range(ENVS) if one != env]] = 9.0  # all others are elsewhere
            poses[env, 1, 2] += 1e-3 * (env in self.lost)
            return replace(first, poses=poses)
        assert isinstance(question, CaptureMoment)
        return Captured(*redrawn(number_of(question), question.env_idx, question.pictures))

    def save(self, what: SaveRequest | str, placed: tuple[PlaceCamera, ...] = ()) -> Any:
        """The event with which the job ends."""
        assert not isinstance(what, str)
        self.job += 1
        self.events.clear()
        do(lambda: self.saver.begin(BeginSaving(self.job, what), placed))
        (ended,) = until(
            lambda: [one for one in self.events if isinstance(one, (EpisodesSaved, SaveFailed))], "the end"
        )
        assert ended.job == self.job
        return ended

    def written(self) -> dict[int, Episode]:
        """The episodes in the folder by env."""
        found = [read_episode(file) for file in self.folder.glob("*.json")]
        assert len({one.info.env_index for one in found}) == len(found)
        return {one.info.env_index: one for one in found}


def number_of(question: CaptureMoment) -> int:
    found = re.search(rb"body (\d+)", question.snapshot)
    assert found is not None
    return int(found[1])


def redrawn(number: int, env_idx: Any, pictures: bool = True) -> tuple[dict[str, Any], tuple[Picture, ...]]:
    """The columns and pictures that the process gives for the moment with this number."""
    return columns_of(number, ENVS), pictures_of(number, env_idx) if pictures else ()


def as_recorded(fake: FakeWorkerSession, serials: list[int]) -> list[Stepped]:
    """What a live recording would have taken at these moments of the history."""
    found = {one.serial: one for one in moments_of(fake.session)}
    taken = []
    for serial in serials:
        one = found[serial]
        columns, pictures = redrawn(one.number, range(ENVS))
        taken.append(Stepped(one.as_recorded, one.jumped, pictures, columns=columns))
    return taken


@pytest.fixture
def fake(tmp_path: Path) -> Iterator[FakeWorkerSession]:
    with fake_worker_session(tmp_path / "session", num_envs=ENVS) as fake:
        hold_saving(fake.session)
        fake.load(cameras=(replace(scene_camera(), settings=replace(SETTINGS, fov=0.5)),))
        fake.reset(seeds=np.array([5, 6, 7]))
        fake.step(acted_by="hold", reward=[1, 2, 3])
        fake.step(acted_by="random", success=(1,), reward=[4, 5, 6])
        fake.step(acted_by="random", reward=[7, 8, 9])
        yield fake


@pytest.fixture
def saver(fake: FakeWorkerSession, tmp_path: Path) -> Iterator[Saver]:
    saver = Saver(fake, tmp_path / "saved")
    yield saver
    saver.saver.close()
    saver.finisher.close()


def wanted(fake: FakeWorkerSession, *given: Any, **named: Any) -> SaveRequest | str:
    return fake.session.look(lambda run: request_of(run, *given, **named))


def test_each_env_is_saved_as_it_was_played(fake: FakeWorkerSession, saver: Saver) -> None:
    saver.lost = {2}
    what = wanted(fake, None)
    ended = saver.save(what, PLACED)
    assert isinstance(ended, EpisodesSaved) and not isinstance(what, str)
    last = fake.view.timeline.last
    serials = {env: list(range(last - 3, last + (env != 1))) for env in range(ENVS)}
    written = saver.written()
    assert {env: one.info.seed for env, one in written.items()} == {0: 5, 1: 6, 2: -1}
    for env, episode in written.items():
        assert_rows(episode, env, as_recorded(fake, serials[env]))
        assert episode.info.acted_by == ((0, "hold"), (1, "random"))
        (moved,) = episode.info.moved_cameras
        assert (moved.state, moved.name, moved.used) == (0, "base_camera", SETTINGS)
        assert not episode.info.observed_by
    asked = saver.process.of(CaptureMoment)
    assert [one.env_idx for one in asked] == [(0, 1, 2), (0, 1, 2), (0, 1, 2), (0, 2)]
    assert [(one.env_idx, one.seed) for one in saver.process.of(Reset)] == [((0,), 5), ((1,), 6), ((2,), 7)]
    assert saver.process.ensured == [(what.load, PLACED, None)]
    assert saver.events.count(EpisodeEnded(live=False)) == ENVS
    progress = [one.progress.done for one in saver.events if isinstance(one, SaveProgressed)]
    assert {one.job for one in saver.events if isinstance(one, SaveProgressed)} == {1}
    assert {0, 1, 2, 3} <= set(progress)
    for number in (ENVS, 3 + 2 + 3, 2, 1):  # episodes, steps, not ended, without a seed
        assert re.search(rf"\b{number}\b", ended.message), ended.message


def test_a_failure_leaves_no_file_and_the_next_job_saves_all(fake: FakeWorkerSession, saver: Saver) -> None:
    problem = Problem("observe", "KeyError: 'goal'", "push.py", 31, "x", "")
    for failure, words in (
        (JobFailed("the process died"), "died"),
        (JobFailed("no", problem), "KeyError.*31"),
    ):
        saver.process.asked = []

        def fails(question: Any, failure: JobFailed = failure) -> Any:
            ends = isinstance(question, CaptureMoment) and len(saver.process.of(CaptureMoment)) == 3
            return failure if ends else saver.answer(question)

        saver.process.answer = fails
        ended = saver.save(wanted(fake, None))
        assert isinstance(ended, SaveFailed) and re.search(words, ended.why)
        until(lambda: not list(saver.folder.iterdir()), "no file of the failed job")
        assert not saver.finisher.finished.count
        saver.process.answer = saver.answer
    assert isinstance(saver.save(wanted(fake, (2, 0))), EpisodesSaved)
    assert set(saver.written()) == {0, 2}


def test_a_stopped_job_writes_nothing_and_tells_nothing_more(fake: FakeWorkerSession, saver: Saver) -> None:
    answer = saver.answer

    def stops(question: Any) -> Any:
        if isinstance(question, CaptureMoment) and len(saver.process.of(CaptureMoment)) == 2:
            saver.saver.end()
            saver.events.append(SaveFailed(1, "stopped here"))
        return answer(question)

    saver.process.answer = stops
    saver.save(wanted(fake, None))
    until(lambda: not list(saver.folder.iterdir()), "no file of the stopped job")
    assert isinstance(saver.events[-1], SaveFailed) and saver.events[-1].why == "stopped here"


def test_an_episode_of_an_earlier_version_has_its_source(fake: FakeWorkerSession, saver: Saver) -> None:
    old = fake.view.task
    assert old is not None
    wider = replace(SETTINGS, fov=0.75)
    fake.load(
        "patched",
        source={"push.py": "new"},
        source_hash="1" * 12,
        cameras=(replace(scene_camera(), settings=wider),),
    )
    fake.reset()
    fake.step()
    ended = saver.save(wanted(fake, (0,), before=True))
    assert isinstance(ended, EpisodesSaved)
    (earlier,) = saver.written().values()
    now = fake.view.task
    assert now is not None
    assert (earlier.info.source_hash, earlier.info.observed_by) == (old.source_hash, now.source_hash)
    assert list(earlier.info.source.values()) == list(old.source.values())
    (camera,) = earlier.info.moved_cameras
    assert (camera.used.fov, camera.in_file.fov) == (0.75, 0.5), (
        "its source has another camera than its pictures"
    )


def test_an_env_that_went_back_is_saved_along_its_own_past(fake: FakeWorkerSession, saver: Saver) -> None:
    """Env 0 continues from the second moment of env 2."""
    origin = fake.view.timeline.last - 2
    fake.back((0,), (2,), origin)
    fake.step(acted_by="sliders")
    last = fake.view.timeline.last
    assert isinstance(saver.save(wanted(fake, (0,))), EpisodesSaved)
    (episode,) = saver.written().values()
    assert episode.poses is not None and episode.info.env_index == 0 and episode.info.seed == 7
    found = {one.serial: one.step for one in moments_of(fake.session)}
    rows = [(origin - 1, 2), (origin, 2), (last, 0)]
    np.testing.assert_array_equal(episode.poses, [found[serial].poses[env] for serial, env in rows])
    np.testing.assert_array_equal(
        episode.action,
        [found[serial].action[env] for serial, env in rows[1:]],  # type: ignore[index]
    )
    assert episode.info.acted_by == ((0, "hold"), (1, "sliders"))
    (track,) = episode.cameras
    assert track.rgb is not None and track.pose[:, 0].tolist() == [2, 2, 0], "pictures are of the other env"
    assert [one.env_idx for one in saver.process.of(CaptureMoment)] == [(2,), (2,), (0,)]


def test_the_episode_of_the_shown_moment_is_saved(fake: FakeWorkerSession) -> None:
    first = fake.view.timeline.last - 3
    fake.reset(seeds=np.array([15, 16, 17]))
    fake.step()
    assert isinstance(wanted(fake, (1,)), SaveRequest)
    seek(fake.session, first + 1)
    what = wanted(fake, (1,))
    assert isinstance(what, SaveRequest) and [one.seed for one in what.episodes] == [6]
    assert what.episodes[0].succeeded and what.episodes[0].ended
    before = wanted(fake, (1,), before=True)
    assert isinstance(before, str) or before.episodes[0].seed != 6
