"""The jobs of the studio: which questions are asked of which process, and what becomes of the answers."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from tests.cameras.studio_runs import MOVED, SETTINGS, runs
from tests.drive.session import BASE
from tests.drive.waiting import until
from workbench.cameras import edit_jobs
from workbench.cameras import events as of
from workbench.cameras.apply import StudioJobs
from workbench.cameras.questions import DrawCamera, MeasureCamera, SuggestCameras
from workbench.cameras.report_jobs import FIRST_SEED, MAX_ENVS, pick_pixel
from workbench.cameras.view import EditRequest, EditState, MeasuredMoment
from workbench.envs.camera_data import Picture
from workbench.live.history.moments import ShownMoment
from workbench.live.messages import Load, Reset
from workbench.live.process.background_jobs import JobFailed
from workbench.machine.loop import do
from workbench.pictures.camera_conventions import compose, make_pose, quaternion_from_rpy
from workbench.pictures.camera_report import CameraReport, DepthReport, SearchSpace
from workbench.task.write_edits import SourceEdit

Answered = TypeVar("Answered")


class Preempted(Exception):
    """Another job needs the process."""


def report(env: int) -> CameraReport:
    nothing = np.zeros(1, np.float32)
    depth = DepthReport(np.zeros((1, 40), np.int64), nothing, nothing, nothing, nothing)
    return CameraReport(BASE, (8, 6), (8, 6), (env,), (), depth, 1, 1.0)


@dataclass
class Asker:
    """A worker that answers at once."""

    num_envs: int = 3
    asked: list[Any] = field(default_factory=list)
    fails_at: int = -1
    error: type[Exception] = JobFailed
    loads: list[Load] = field(default_factory=list)
    never: bool = False

    async def ask(self, question: Any, on_progress: Callable[..., None] = lambda *_: None) -> Any:
        if len(self.asked) == self.fails_at:
            self.fails_at = -1
            raise self.error("it failed")
        self.asked.append(question)
        if self.never:
            await asyncio.Event().wait()
        match question:
            case MeasureCamera(env=env):
                return report(env)
            case DrawCamera(key=(kind, name), env=env):
                depth, ids = np.full((6, 8), 2.0, np.float32), np.full((6, 8), 3, np.int32)
                pose = make_pose((float(env), 0, 0), (1, 0, 0, 0)).astype(np.float32)
                return Picture(name, kind, env, pose, None, depth, ids)
            case SuggestCameras():
                on_progress(2, 5, None)
                return ()

    async def ensure(self, job: object, load: Load) -> int:
        self.loads.append(load)
        return self.num_envs

    async def in_turns(self, job: object, work: Callable[[], Awaitable[Answered]]) -> Answered:
        while True:
            try:
                return await work()
            except Preempted:
                self.asked.append(Reset(None, 1))  # the other job leaves the envs elsewhere


class Desk:
    def __init__(self, live: Asker | None = None, background: Asker | None = None) -> None:
        self.live, self.background = live or Asker(), background or Asker()
        self.happened: list[Any] = []
        self.progress: list[tuple[str, int, int]] = []
        self.jobs = StudioJobs(self.live, self.background, self._changed, self.happened.append)  # type: ignore[arg-type]

    def _changed(self) -> None:
        if (now := self.jobs.progress) is not None:
            self.progress.append((now.what, now.done, now.total))

    def event(self, effect: Any) -> Any:
        """The only event that the effect leads to."""
        do(lambda: self.jobs.perform(effect))
        until(lambda: self.happened, "the event")
        (event,) = self.happened
        self.happened.clear()
        return event

    def performs(self, effect: Any) -> list[Any]:
        """What happens until the job has ended."""
        do(lambda: self.jobs.perform(effect))
        until(lambda: do(lambda: self.jobs.progress) is None, "the end of the job")
        happened = self.happened[:]
        self.happened.clear()
        return happened


def reports(happened: list[Any]) -> list[of.ReportMade]:
    """The reports, between the beginning and the end of the measurement."""
    assert happened[0] == of.Measuring(True) and of.Measuring(False) in happened
    return [one for one in happened if isinstance(one, of.ReportMade)]


POSES = np.arange(2 * 4 * 7, dtype=np.float32).reshape(2, 4, 7)
QUESTION = MeasureCamera(BASE, None, 0)


def test_cases_are_measured_one_after_another_with_partial_reports() -> None:
    desk = Desk()
    moments = [MeasuredMoment(serial, 1, step) for serial, step in ((7, 0), (8, 1), (9, 2))]
    cases = tuple((1, POSES[0] + n, moment) for n, moment in enumerate(moments))
    first, last = reports(desk.performs(of.MeasureLive("measuring", QUESTION, MOVED, cases, 2)))
    assert [(one.env, one.poses.flat[0]) for one in desk.live.asked] == [(1, 0.0), (1, 1.0), (1, 2.0)]
    assert (first.moments, last.moments) == (tuple(moments[:2]), tuple(moments))
    assert [len(one.report.envs) for one in (first, last)] == [2, 3]
    assert (last.of, last.settings, last.seeds) == (BASE, MOVED, 0) and desk.background.asked == []
    assert [(done, total) for _, done, total in desk.progress[-3:]] == [(0, 3), (1, 3), (2, 3)]
    envs = tuple((env, None, None) for env in range(3))
    (again,) = reports(desk.performs(of.MeasureLive("measuring", QUESTION, MOVED, envs, 3)))
    assert again.report.envs == (0, 1, 2) and again.moments == ()


def test_a_failed_measurement_is_told_and_ends_it() -> None:
    desk = Desk(Asker(fails_at=1))
    cases = tuple((env, None, None) for env in range(3))
    for _ in range(2):
        happened = desk.performs(of.MeasureLive("measuring", QUESTION, MOVED, cases, 1))
        assert reports(happened)[-1].report.envs in ((0,), (0, 1, 2))
        if happened[-1] != of.Measuring(False):
            assert happened[-2:] == [of.Measuring(False), of.WorkFailed("live", "it failed")]
    assert len(desk.live.asked) == 4


def load(num_envs: int, **kwargs: object) -> Load:
    found = runs()[0].running_load()
    assert found is not None
    return replace(found, options=replace(found.options, num_envs=num_envs, env_kwargs=kwargs))


def test_every_seed_is_measured_once_in_its_own_env_even_after_an_interruption() -> None:
    for interrupted in range(-1, 8):
        desk = Desk(background=Asker(num_envs=2, fails_at=interrupted, error=Preempted))
        made = reports(desk.performs(of.MeasureSeeds("measuring", QUESTION, SETTINGS, load(2), 5)))
        assert [(one.seeds, one.report.envs) for one in made] == [
            (2, (0, 1)),
            (4, (0, 1, 0, 1)),
            (5, (0, 1, 0, 1, 0)),
        ]
        # The seed of each measured env, from the last reset before the question.
        seeds, base = [], 0
        for question in desk.background.asked:
            if isinstance(question, Reset):
                assert question.env_idx is None and question.seed is not None
                base = question.seed
            else:
                seeds.append(base + question.env)
        assert seeds == [FIRST_SEED + number for number in range(5)], interrupted
    assert desk.live.asked == []


@pytest.mark.parametrize(
    ("given", "mode"),
    [
        ({}, None),
        ({"obs_mode": "rgb"}, "state"),
        ({"obs_mode": "state_dict"}, "state_dict"),
        ({"obs_mode": "none"}, "none"),
    ],
)
def test_the_background_has_few_envs_that_observe_no_pictures(
    given: dict[str, Any], mode: str | None
) -> None:
    desk = Desk()
    for num_envs in (2, MAX_ENVS + 5):
        wanted = load(num_envs, size=0.5, **given)
        desk.performs(of.MeasureSeeds("measuring", QUESTION, SETTINGS, wanted, 1))
        options = desk.background.loads[-1].options
        assert options.num_envs == min(num_envs, MAX_ENVS)
        assert options.env_kwargs == {"size": 0.5} | ({} if mode is None else {"obs_mode": mode})
        assert wanted.options.env_kwargs == {"size": 0.5, **given}, "the load of the session is unchanged"


def test_placements_are_searched_in_freshly_reset_envs() -> None:
    desk = Desk()
    space = SearchSpace(("cube",), (0, 0, 0), (1, 1, 1), SETTINGS)
    for seeds, envs in ((2, (0, 1)), (9, (0, 1, 2)), (0, (0,))):
        desk.background.asked.clear()
        (found,) = desk.performs(of.Suggest("searching", space, load(3), seeds))
        assert found == of.SuggestionsFound((), ("cube",))
        assert desk.background.asked == [Reset(None, FIRST_SEED), SuggestCameras(space, envs)]
    assert ("searching", 2, 5) in desk.progress


MOMENT = ShownMoment(1, 2, POSES)


def test_two_placements_are_drawn_at_the_shown_moment() -> None:
    desk = Desk()
    (compared,) = desk.performs(of.Compare(BASE, MOVED, MOMENT))
    assert [(one.settings, one.env, one.poses.flat[0]) for one in desk.live.asked] == [
        (None, 1, 28.0),
        (MOVED, 1, 28.0),
    ]
    assert (compared.now.env, compared.other.env) == (1, 1) and compared.now is not compared.other


def test_all_envs_are_drawn_in_the_given_order_each_at_its_own_poses() -> None:
    desk = Desk()
    drawn = desk.performs(of.DrawEnvs(BASE, (1, 0), MOMENT))
    assert [one.picture.env for one in drawn] == [1, 0]
    assert [(one.env, one.poses.flat[0], one.settings) for one in desk.live.asked] == [
        (1, 28.0, None),
        (0, 0.0, None),
    ]


def test_a_pixel_is_probed_in_depth_and_segmentation_of_the_shown_env() -> None:
    desk, info = Desk(), runs()[0].task.cameras[1]  # type: ignore[union-attr]
    (picked,) = desk.performs(of.Pick(info, 0.99, 0.0, MOMENT, {3: "cube"}))
    (question,) = desk.live.asked
    assert (question.key, question.env, question.poses.flat[0]) == (info.key, 1, 28.0)
    assert set(question.modalities) == {"depth", "segmentation"}
    assert (picked.picked.body, picked.picked.pixel, picked.picked.env) == ("cube", (7, 0), 1)


def test_a_probed_pixel_is_the_one_under_the_pointer_and_its_point_is_where_it_was_seen() -> None:
    info = runs()[0].task.cameras[1]  # type: ignore[union-attr]
    k = np.array([[100.0, 0, 3.0], [0, 50.0, 2.0], [0, 0, 1]], np.float32)
    info = replace(info, intrinsic=k)
    pose = make_pose((1, 2, 3), quaternion_from_rpy(10, 20, 130)).astype(np.float32)
    depth = np.zeros((6, 8), np.float32)
    depth[4, 6] = 2.0
    ids = np.zeros((6, 8), np.int32)
    ids[4, 6] = 9
    picture = Picture(info.name, info.kind, 2, pose, None, depth, ids)
    picked = pick_pixel(info, picture, 6.4 / 8, 4.7 / 6, {9: "cube"})
    assert (picked.pixel, picked.body, picked.depth, picked.env) == ((6, 4), "cube", 2.0, 2)
    # OpenCV: right and down of the pixel's centre, from the optical centre.
    right, down = (6.5 - 3) / 100 * 2, (4.5 - 2) / 50 * 2
    assert picked.point is not None
    np.testing.assert_allclose(picked.point, compose(pose, [2, -right, -down, 1, 0, 0, 0])[:3], atol=1e-5)
    beside = pick_pixel(info, picture, 5.9 / 8, 4.7 / 6, {9: "cube"})
    assert (beside.pixel, beside.body, beside.depth, beside.point) == ((5, 4), None, None, None)
    for u, v, pixel in ((0.0, 0.0, (0, 0)), (1.0, 1.0, (7, 5)), (-3.0, 9.0, (0, 5))):
        assert pick_pixel(info, picture, u, v, {}).pixel == pixel


def test_a_preview_and_a_new_cameras_picture_are_asked_of_the_worker_that_plays() -> None:
    desk = Desk()
    question = DrawCamera(BASE, SETTINGS, 2, scale=0.5)
    assert desk.event(of.DrawPreview(question)).picture.env == 2 and desk.live.asked == [question]
    request = EditRequest("add", BASE, SETTINGS)
    drawn = desk.event(of.DrawNewCamera(request, question))
    assert drawn.request == request and drawn.picture.env == 2
    desk.live.fails_at = len(desk.live.asked)
    do(lambda: desk.jobs.perform(of.DrawNewCamera(request, question)))
    until(lambda: len(desk.happened) == 2, "the failure")
    assert desk.happened == [of.NewCameraDrawn(request, None), of.WorkFailed("new camera", "it failed")]


def test_stopped_jobs_of_a_lane_end_and_the_other_lanes_go_on() -> None:
    desk = Desk(Asker(never=True), Asker(never=True))
    cases = tuple((env, None, None) for env in range(3))
    do(lambda: desk.jobs.perform(of.MeasureLive("a measurement", QUESTION, MOVED, cases, 1)))
    until(lambda: desk.live.asked, "the question")
    do(lambda: desk.jobs.perform(of.MeasureSeeds("seeds", QUESTION, MOVED, load(2), 3)))
    until(lambda: desk.background.asked, "the question")
    assert (found := desk.jobs.progress) is not None and found.what == "seeds"
    do(lambda: desk.jobs.perform(of.StopJobs(("background", "preview"))))
    assert (found := desk.jobs.progress) is not None and found.what == "a measurement"
    until(lambda: desk.happened.count(of.Measuring(False)) == 1, "the end of the first")
    do(lambda: desk.jobs.perform(of.StopJobs(("live",))))
    assert desk.jobs.progress is None
    until(lambda: desk.happened.count(of.Measuring(False)) == 2, "the end of the other")
    assert not [one for one in desk.happened if isinstance(one, of.WorkFailed)]


# --- the author's file --------------------------------------------------------------------------------


def test_a_change_is_written_reverted_and_refused_in_a_file_that_was_edited_since(tmp_path: Path) -> None:
    desk, file = Desk(), tmp_path / "push.py"
    file.write_text("old")
    edit = SourceEdit(str(file), "old", "new", (), SETTINGS)

    for _ in range(2):
        assert desk.event(of.ChangeFile(edit, False)) == of.FileChanged() and file.read_text() == "new"
        assert desk.event(of.ChangeFile(edit, True)) == of.FileChanged() and file.read_text() == "old"
    file.write_text("edited")
    for revert in (False, True):
        assert (
            isinstance(desk.event(of.ChangeFile(edit, revert)), of.FileNotChanged)
            and file.read_text() == "edited"
        )


def test_the_session_goes_on_while_a_change_waits_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    desk, waiting, resume = Desk(), threading.Event(), threading.Event()
    monkeypatch.setattr(edit_jobs, "apply", lambda edit: (waiting.set(), resume.wait(60)))
    do(lambda: desk.jobs.perform(of.ChangeFile(SourceEdit("push.py", "old", "new", (), None), False)))
    assert waiting.wait(60)
    try:
        do(lambda: None)
        assert desk.happened == []
    finally:
        resume.set()
    until(lambda: desk.happened == [of.FileChanged()], "the end of the edit")


def test_a_plan_needs_the_hooks_of_the_running_version_and_none_begins_while_closing(tmp_path: Path) -> None:
    task, file = runs()[0].task, tmp_path / "push.py"
    assert task is not None
    file.write_text("class PushEnv:\n    pass\n")
    task = replace(task, file=str(file), source_files=(str(file),), source={str(file): file.read_text()})
    request = EditRequest("add", ("sensor", "new"), SETTINGS)
    desk = Desk(Asker(fails_at=0))

    def found(load: Load | None) -> EditState:
        event = desk.event(of.FindPlan(request, task, None, load))
        assert isinstance(event, of.PlanFound) and event.request == request
        return event.state

    running = runs()[0].running_load()
    state = found(running)
    assert state.stage == "refused" and "it failed" in state.message
    assert found(None).stage == "refused" and desk.live.asked == []
    desk.jobs.close()
    assert desk.happened == [of.StudioClosed()]


def test_a_bug_in_an_edit_is_told_and_the_copy_of_a_task_is_opened(tmp_path: Path) -> None:
    desk, task = Desk(), runs()[0].task
    assert task is not None
    broken: Any = None
    assert isinstance(desk.event(of.ChangeFile(broken, False)), of.EditFailed)
    copied = desk.event(of.CopyToFolder(replace(task, file=None), tmp_path))
    assert copied.file is None and copied.state.stage == "refused" and [*tmp_path.iterdir()] == []
