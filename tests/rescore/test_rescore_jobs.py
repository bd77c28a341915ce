"""Jobs that rescore: the history a few moments at a time, and recordings group by group, whatever fails."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.drive.background import ScriptedBackground
from tests.drive.episodes import made, write
from tests.drive.session import FakeWorkerSession, fake_worker_session, history_of, moments_of
from tests.drive.waiting import until
from workbench.episodes.row import Source
from workbench.live.messages import Load
from workbench.live.process.background_jobs import JobFailed
from workbench.live.timeline_commands import StopRescoring
from workbench.machine.loop import do
from workbench.page.command import Refused
from workbench.rescore.past_jobs import PastRescorer
from workbench.rescore.past_scores import RescoredPast
from workbench.rescore.recording_jobs import Rescorer, group_episodes, rescore_options, with_renderer
from workbench.rescore.state import BeginRescoring, EndRescoring, RescoreView, RescoringUpdate
from workbench.rescore.verdict import Rescore, Rescored, RescoredMoments, RescoreMoments, Verdict
from workbench.task.description import TaskOptions
from workbench.task.problem import Problem
from workbench.trust.clearance import CodeToRun, NotCleared

ENVS = 3
PROBLEM = Problem("reward", "KeyError: 'goal'", "push.py", 31, "x", "")
LOAD = Load("push.py", TaskOptions(ENVS))


# --- the history ------------------------------------------------------------------------------------


class Past:
    """A `PastRescorer` of a history with two batches of episodes, the updates, and the process."""

    def __init__(self, fake: FakeWorkerSession) -> None:
        self.fake = fake
        self.process = ScriptedBackground(self.answer, ENVS)
        self.updates: list[RescoringUpdate] = []
        self.rescorer = PastRescorer(self.process, self.updates.append)  # type: ignore[arg-type]
        self.scale: tuple[float, ...] = (1, 2, 3)
        """Factor of each env's new rewards."""
        self.raises_after = -1
        """Number of the results before the new code raises; negative: it does not."""
        self.at = 0

    def past(self, seen: int | None = None) -> RescoredPast:
        return do(lambda: RescoredPast(history_of(self.fake.session), seen))

    def answer(self, question: Any) -> RescoredMoments:
        assert isinstance(question, RescoreMoments)
        recorded = {one.number: one for one in moments_of(self.fake.session)}
        steps = []
        for wanted in question.moments:
            if wanted.snapshot is not None:
                found = re.search(rb"body (\d+)", wanted.snapshot)
                assert found is not None
                self.at = int(found[1])
            else:
                self.at += 1
            if self.raises_after == 0:
                return RescoredMoments(tuple(steps), {}, PROBLEM)
            self.raises_after -= 1
            step = recorded[self.at].step
            assert wanted.action is None or np.array_equal(wanted.action, step.action)  # type: ignore[arg-type]
            steps.append(replace(step, reward=step.reward * np.array(self.scale, np.float32)))
        return RescoredMoments(tuple(steps), {"cube": "it has no state"})

    def rescore(self, number: int, past: RescoredPast, ends: str) -> RescoreView:
        """The last view of this job."""
        effect = BeginRescoring(number, RescoreView("loading", total=past.steps), LOAD, past)
        do(lambda: self.rescorer.perform(effect))
        return until(
            lambda: next((u.view for u in self.updates if u.job == number and u.view.state == ends), None),
            ends,
        )


@pytest.fixture
def past(tmp_path: Path) -> Iterator[Past]:
    with fake_worker_session(tmp_path, num_envs=ENVS) as fake:
        fake.load()
        for steps in (4, 3):
            fake.reset()
            fake.step(steps, reward=[1, 2, 3])
        past = Past(fake)
        yield past
        past.rescorer.close()


def test_each_env_is_rescored_and_the_progress_and_the_differences_are_shown(past: Past) -> None:
    held = past.past()
    view = past.rescore(1, held, "done")
    steps = {(verdict.of.env, verdict.returns): verdict.length for verdict in view.verdicts if verdict.length}
    assert steps == {
        (0, (4.0, 4.0)): 4,
        (0, (3.0, 3.0)): 3,
        (1, (8.0, 16.0)): 4,
        (1, (6.0, 12.0)): 3,
        (2, (12.0, 36.0)): 4,
        (2, (9.0, 27.0)): 3,
    }
    assert (view.done, view.steps, view.total) == (7, 7, 7) and view.names[0] == "reward"
    assert view.differing_names == {"reward"} and len(view.warnings) == 1 and "cube" in view.warnings[0]
    seen = [update.view.done for update in past.updates if update.view.state == "rescoring"]
    assert seen == sorted(seen) and len(set(seen)) > 2
    assert {update.job for update in past.updates} == {1}
    assert set(past.process.priorities) == {"low"}
    assert past.process.ensured == [(LOAD, (), replace(LOAD, level="rebuilt"))]


def test_the_new_code_is_tried_at_a_recorded_start_and_the_shown_run_is_first(past: Past) -> None:
    first, *_ = moments_of(past.fake.session)
    past.rescore(1, past.past(seen=first.serial + 2), "done")
    numbers = [re.search(rb"body (\d+)", one.moments[0].snapshot or b"") for one in past.process.asked]
    starts = [int(found[1]) for found in numbers if found is not None]
    # The first answer only puts the envs there, before the version is loaded.
    assert starts[0] == starts[1] < starts[-1], "the run of the first moments is replayed first"
    assert len(past.process.asked[0].moments) == 1
    asked = len(past.process.asked)
    past.rescore(2, past.past(), "done")
    assert len(past.process.ensured) == 1, "the version is loaded already"
    again = [re.search(rb"body (\d+)", one.moments[0].snapshot or b"") for one in past.process.asked[asked:]]
    assert [int(found[1]) for found in again if found is not None][0] == starts[-1], "the newest run is first"


def test_code_that_raises_ends_the_job_with_what_is_known_and_the_next_one_works(past: Past) -> None:
    past.raises_after = 1 + 4  # one to put the envs at a start, then the reset and three steps
    view = past.rescore(1, past.past(), "failed")
    assert (view.problem, view.done) == (PROBLEM, 3) and view.why
    known = {verdict.of.env: verdict.returns for verdict in view.verdicts if verdict.length}
    assert known == {0: (3.0, 3.0), 1: (6.0, 12.0), 2: (9.0, 27.0)}
    past.raises_after, past.scale = -1, (1, 1, 1)
    view = past.rescore(2, past.past(), "done")
    assert view.problem is None and not view.differing_names
    assert not any(verdict.differs for verdict in view.verdicts)


def test_code_that_does_not_load_and_other_bodies_are_reported(past: Past) -> None:
    async def fails(*_: Any, **__: Any) -> int:
        raise JobFailed("inner", PROBLEM)

    ensure, past.process.ensure = past.process.ensure, fails  # type: ignore[method-assign]
    view = past.rescore(1, past.past(), "failed")
    assert view.problem == PROBLEM and view.why not in ("", "inner")
    past.process.ensure = ensure  # type: ignore[method-assign]
    answer = past.answer

    def other_bodies(question: Any) -> RescoredMoments:
        answered = answer(question)
        return replace(answered, steps=tuple(replace(s, poses=s.poses[:, :2]) for s in answered.steps))

    past.process.answer = other_bodies
    assert "bodies" in past.rescore(2, past.past(), "failed").why


def test_a_stopped_job_tells_nothing_more(past: Past) -> None:
    answer = past.answer

    def stops(question: Any) -> RescoredMoments:
        if len(past.process.asked) == 3:
            past.rescorer.perform(EndRescoring())
            past.updates.clear()
        return answer(question)

    past.process.answer = stops
    held = past.past()
    effect = BeginRescoring(1, RescoreView("loading", total=held.steps), LOAD, held)
    do(lambda: past.rescorer.perform(effect))
    until(lambda: len(past.process.asked) >= 3, "the stop")
    do(lambda: None)
    assert not past.updates and len(past.process.asked) == 3


# --- recordings -------------------------------------------------------------------------------------


def source(file: Path) -> Source:
    return Source(file, None, file.stem, file.stem)


class Cleared:
    """Stands in for `Clearances`: `refused` names tasks whose code may not run."""

    def __init__(self) -> None:
        self.refused: dict[str, str] = {}

    def clear_all(self, codes: Sequence[CodeToRun], stopped: Callable[[], bool]) -> list[Any]:
        return [
            NotCleared(self.refused[code.info.task]) if code.info.task in self.refused else code.reference
            for code in codes
        ]


class Recordings:
    """A `Rescorer` of recordings of three tasks, whose process gives each a result of its own."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.files = [
            source(write(folder / task, made(3, task=task, seed=seed), pictures=False))
            for task, seed in (("A-v1", 1), ("B-v1", 2), ("A-v1", 3), ("C-v1", 4))
        ]
        self.parts: list[Rescored] = []
        self.process = ScriptedBackground(
            lambda question: Rescored((), 0, self.raises.get(self.task(question)))
        )
        ask = self.process.ask

        async def asks(question: Rescore, on_part: Callable[[int, int, Any], None]) -> Any:
            if self.stops == self.task(question):
                self.rescorer.do(StopRescoring())
            if self.task(question) not in self.unopened:
                on_part(0, 0, Rescored((), 0))
                for file in question.files[: self.most]:
                    on_part(0, 0, Rescored((Verdict(file, task=self.task(question), length=3),), 3))
            return await ask(question)

        self.process.ask = asks  # type: ignore[assignment, method-assign]
        monkeypatch.setattr("workbench.rescore.recording_jobs.Background", lambda: self.process)
        self.cleared = Cleared()
        self.raises: dict[str, Problem] = {}
        self.unopened: set[str] = set()
        self.stops, self.most = "", 9
        self.rescorer = Rescorer(self.cleared)  # type: ignore[arg-type]

    def task(self, question: Rescore) -> str:
        """The task of a question, by the folder of its first file."""
        return question.files[0].path.parent.name

    def rescore(self, ends: str, **named: Any) -> RescoreView:
        serial = self.rescorer.view.serial
        self.rescorer.start(self.files, **named)
        return until(
            lambda: v if (v := self.rescorer.view).state == ends and v.serial > serial else None, ends
        )


@pytest.fixture
def recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Recordings]:
    recordings = Recordings(tmp_path, monkeypatch)
    yield recordings
    recordings.rescorer.close()


def test_each_task_is_rescored_in_its_own_process_turn_and_counted(recordings: Recordings) -> None:
    for _ in range(2):
        recordings.process.asked.clear()
        view = recordings.rescore("done", use_env_states=True)
        assert [verdict.of.name for verdict in view.verdicts] == [
            recordings.files[k].name for k in (0, 2, 1, 3)
        ]
        assert (view.done, view.total, view.steps, view.unit) == (4, 4, 12, "episodes")
        asked = recordings.process.of(Rescore)
        assert [[file.name for file in one.files] for one in asked] == [
            [recordings.files[k].name for k in rows] for rows in ((0, 2), (1,), (3,))
        ]
        assert [one.options.num_envs for one in asked] == [2, 1, 1] and all(
            one.use_env_states for one in asked
        )
        assert all("render_backend" not in one.or_else.env_kwargs for one in asked)
        assert len([note for note in view.notes if "-v1" in note]) == 3
    assert recordings.process.ended == 2, "no code of a recording stays loaded"


@pytest.mark.usefixtures("child_process")
def test_a_task_that_fails_is_a_row_and_the_others_are_rescored(recordings: Recordings) -> None:
    recordings.cleared.refused = {"B-v1": "not trusted"}
    recordings.raises = {"A-v1": PROBLEM}
    recordings.most = 1
    view = recordings.rescore("done")
    found = {verdict.of.name: verdict.why_not for verdict in view.verdicts}
    assert set(found) == {file.name for file in recordings.files} and view.done == 4
    first, second, third, fourth = (found[file.name] for file in recordings.files)
    assert not first and not fourth, "it was rescored before its task raised"
    assert second == "not trusted" and PROBLEM.message in third
    recordings.cleared.refused = {}
    recordings.raises = dict.fromkeys(("A-v1", "B-v1", "C-v1"), PROBLEM)
    recordings.unopened = {"A-v1", "B-v1", "C-v1"}
    view = recordings.rescore("failed")
    assert view.problem == PROBLEM and len(view.verdicts) == 4 and recordings.process.ended == 2
    assert view.why not in third, "that its code cannot be opened is another reason"
    recordings.files[0].path.write_text("{")
    recordings.files[0].path.with_suffix(".rrd").unlink()
    recordings.files[0].path.with_suffix(".h5").unlink()
    recordings.raises, recordings.unopened = {}, set()
    broken, *whole = recordings.rescore("done").verdicts
    assert broken.of == recordings.files[0] and broken.damaged and broken.why_not
    assert [verdict.of for verdict in whole] == [recordings.files[at] for at in (1, 2, 3)]
    assert not any(verdict.why_not for verdict in whole)


def test_a_stopped_rescoring_keeps_its_rows_and_goes_no_further(recordings: Recordings) -> None:
    with pytest.raises(Refused):
        recordings.rescorer.do(StopRescoring())
    recordings.stops = "B-v1"
    view = recordings.rescore("stopped")
    assert len(view.verdicts) == 2
    until(lambda: recordings.process.ended, "the end of the process")
    assert [recordings.task(one) for one in recordings.process.of(Rescore)] == ["A-v1"]
    recordings.stops = ""
    assert len(recordings.rescore("done").verdicts) == 4


@pytest.mark.usefixtures("child_process")
def test_recordings_that_one_env_can_rescore_are_a_group(tmp_path: Path) -> None:
    def recorded(name: str, **info: Any) -> Source:
        return source(write(tmp_path / name, made(2, **info), pictures=False))

    plain = {"env_kwargs": {"obs_mode": "state"}}
    files = [
        recorded("a", **plain),
        recorded("b", env_kwargs={"obs_mode": "state", "robot_uids": "panda"}),
        recorded("c", **plain),
        recorded("d", task="Other-v1", **plain),
        recorded("e", env_kwargs={"obs_mode": "rgb"}),
        recorded("f", **plain, source={"push.py": "reward = 2\n"}),
        recorded("g", **plain, source={}),
    ]
    (tmp_path / "broken.json").write_text("{")
    files.append(source(tmp_path / "broken.json"))
    folders = [file.path.parent.name for file in files]

    def groups(*given: Any, **named: Any) -> tuple[list[str], list[str]]:
        found, broken = group_episodes(files, *given, **named)
        names = [[folders[files.index(file)] for file in group.files] for group in found]
        assert all(group.options.num_envs == min(given[0], len(group.files)) for group in found)
        return ["".join(one) for one in names], [folders[files.index(one.of)] for one in broken]

    # An image mode without pictures is the state.
    assert groups(2) == (["acefg", "b", "d"], [tmp_path.name])
    assert groups(16, recorded_source=True) == (["ace", "b", "d", "f"], ["g", tmp_path.name])
    found, broken = group_episodes(files, 9, task="Mine-v1")
    assert {group.reference for group in found} == {"Mine-v1"} and broken[0].damaged
    found, broken = group_episodes(files, 9, recorded_source=True)
    assert not broken[0].damaged and broken[0].task == "Push-v1" and all(one.recorded_source for one in found)


def test_recordings_are_rescored_without_pictures() -> None:
    kwargs = {"obs_mode": "rgb", "robot_uids": "panda"}
    options, note = rescore_options(TaskOptions(2, env_kwargs=kwargs))
    assert options.env_kwargs == {"obs_mode": "state", "robot_uids": "panda", "render_backend": "none"}
    assert "rgb" in note and kwargs["obs_mode"] == "rgb"
    for mode in ("state", "state_dict", "none", None):
        of = {} if mode is None else {"obs_mode": mode}
        options, note = rescore_options(TaskOptions(env_kwargs=of))
        assert options.env_kwargs == {**of, "render_backend": "none"} and not note
        assert with_renderer(options).env_kwargs == of
