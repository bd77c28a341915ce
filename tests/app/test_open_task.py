"""Opening a listed task instead of the open one, with scripted workers and without a browser."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.drive.panels import Panels
from tests.drive.scenes import camera as camera_info
from tests.drive.scripted import scripted
from tests.drive.session import camera, hold_saving, moved, wait_until
from tests.drive.waiting import until
from workbench.app.open_task import Choices
from workbench.app.server import App
from workbench.app.session import KeptWork, Session
from workbench.cameras.commands import UndoCamera
from workbench.cameras.events import CameraChosen, CameraPlaced
from workbench.cameras.view import StudioView
from workbench.envs.camera_data import CameraKey, CameraSettings
from workbench.live.commands import Step
from workbench.live.process.background_jobs import JobProgress
from workbench.machine.loop import do, result_of
from workbench.page.door.gated_server import GatedServer
from workbench.record.saving_state import EpisodesSaved, SaveProgressed, SaveWanted
from workbench.start.catalogue import Entry, Section
from workbench.start.recents import RecentTasks
from workbench.start.registered import RegisteredTasks
from workbench.task.description import TaskOptions
from workbench.task.reference import TaskName
from workbench.trust.consent_dialog import ALWAYS, DO_NOT, ONCE

TASK = "@register_env('Push-v1')\nclass Push(BaseEnv): pass\n"
CAMERA: CameraKey = ("sensor", "base_camera")
LENS = CameraSettings((0, 0, 0), (1, 0, 0, 0), 1.0, None, 8, 6, 0.01, 10.0, "minimal")


class Desk:
    """A workbench started in ``work``, with a task file there and a recently opened one elsewhere."""

    def __init__(
        self, app: App, opened: list[tuple[TaskName, TaskOptions]], folder: Path, notices: list[str]
    ) -> None:
        self.app, self.opened, self.folder = app, opened, folder
        self.notices = notices
        """Messages of the sessions for the terminal."""
        self.panels = Panels(app.shared.server)
        self.panels.come_to(app.shared.visitors)
        self.catalogue = app.open_task.catalogue
        self.catalogue.refresh()
        until(lambda: self.rows(Section.FOLDER), "the files of the folder")

    def rows(self, section: Section) -> list[Entry]:
        return [one for one in self.catalogue.view().entries if one.section is section]

    def row(self, name: str) -> Entry:
        return next(one for one in self.catalogue.view().entries if one.name == name)

    def choose(self, name: str) -> None:
        number = self.row(name).number
        do(lambda: self.app.open_task.choose(number))

    def session_of(self, name: str) -> Session:
        """Wait until the open session is that of this file; return it."""
        until(
            lambda: self.app.shared.home is not None and str(self.app.shared.home.reference).endswith(name),
            f"the session of {name}",
            seen=lambda: self.opened,
        )
        session = self.app.shared.home
        assert session is not None and session is self.app.shared.session
        wait_until(session, lambda view: view.task is not None, "the task")
        return session

    def idle(self) -> None:
        until(lambda: not self.app.open_task.doing(), "the end of the opening")


@pytest.fixture
def desk(tmp_path: Path, gated_server: GatedServer, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    for name in ("work/push.py", "work/pull.py", "elsewhere/other.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(TASK)
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setattr(
        RegisteredTasks, "start", lambda self: None
    )  # otherwise a process lists ManiSkill's tasks
    recents = RecentTasks(lambda: tmp_path / "state")
    recents.add(str(tmp_path / "elsewhere/other.py"), TaskOptions(3, env_kwargs={"size": 2}))
    recents.add(str(tmp_path / "elsewhere/gone.py"), TaskOptions())
    opened: list[tuple[TaskName, TaskOptions]] = []
    notices: list[str] = []

    def make(task: TaskName, options: TaskOptions, kept: KeptWork | None = None) -> Session:
        opened.append((task, options if kept is None else kept.options))
        worker = scripted(2, info=replace(camera_info(), settings=LENS))
        return Session(
            task,
            options,
            recordings=tmp_path / "kept",
            make_worker=worker,
            kept=kept,
            on_notice=notices.append,
        )

    app = App(
        gated_server,
        tmp_path / "recordings",
        make,
        TaskOptions(),
        choices=Choices(recents, make, TaskOptions(5)),
    )
    app.shared.pages.start("start")
    yield Desk(app, opened, tmp_path, notices)
    app.close()


def test_a_file_of_the_folder_opens_without_a_question_with_the_options_of_the_run(desk: Desk) -> None:
    desk.choose("push.py")
    session = desk.session_of("push.py")
    assert desk.opened == [(str(desk.folder / "work/push.py"), TaskOptions(5))]
    until(lambda: desk.app.shared.pages.shown == "live", "the page")
    desk.choose("push.py")
    desk.idle()
    assert desk.app.shared.home is session, "an open task is not opened again"


@pytest.mark.thorough
def test_a_reopened_task_has_its_selections_and_camera_edits(desk: Desk) -> None:
    desk.choose("push.py")
    first = desk.session_of("push.py")
    until(lambda: desk.app.shared.pages.shown == "live", "the page")
    first.change(selected_env=1, speed=2.0)
    now = camera(first, CAMERA).now
    assert now is not None
    placed = replace(now, position=(1.0, 2.0, 3.0))
    first.dispatch(CameraPlaced(CAMERA, placed))
    first.dispatch(CameraChosen(CAMERA))
    desk.choose("pull.py")
    second = desk.session_of("pull.py")
    assert not moved(second.view()) and second.view().selected_env == 0
    desk.idle()
    desk.choose("push.py")
    again = desk.session_of("push.py")
    assert again is not first
    assert moved(again.view()) == {CAMERA}
    now = camera(again, CAMERA).now
    assert now is not None and now.position == (1.0, 2.0, 3.0)
    view = again.view()
    assert (view.selected_env, view.settings.speed, view.of(StudioView).selected) == (1, 2.0, CAMERA)
    again.do(UndoCamera())
    assert not moved(again.view()), "the undo history is kept too"


def test_a_task_whose_episode_is_being_saved_is_closed_when_the_episode_is_saved(desk: Desk) -> None:
    desk.choose("push.py")
    first = desk.session_of("push.py")
    hold_saving(first)
    first.do(Step())
    wait_until(first, lambda view: view.timeline.moments == 2, "a step")
    first.dispatch(SaveWanted((0,)))
    first.dispatch(SaveProgressed(1, JobProgress("rendering again", 120, 290)))
    desk.choose("pull.py")
    desk.session_of("pull.py")
    until(lambda: "120 of 290" in desk.app.open_task.doing(), "the progress on the page")
    first.dispatch(EpisodesSaved(1, "saved"))
    desk.idle()
    assert first.saving().unsaved == 0 and desk.app.shared.sessions == {desk.app.shared.home}


def test_the_end_of_the_program_does_not_wait_for_an_episode_that_is_being_saved(desk: Desk) -> None:
    desk.choose("push.py")
    first = desk.session_of("push.py")
    hold_saving(first)
    first.do(Step())
    wait_until(first, lambda view: view.timeline.moments == 2, "a step")
    first.dispatch(SaveWanted((0,)))
    desk.choose("pull.py")
    until(lambda: "saving 1 episode" in desk.app.open_task.doing(), "the saving")
    desk.app.finish_saving(0.0)
    desk.app.close()
    assert any("1 episode" in notice for notice in desk.notices)


@pytest.mark.thorough
def test_a_file_from_elsewhere_asks_once_and_a_refusal_changes_nothing(desk: Desk) -> None:
    desk.choose("push.py")
    first = desk.session_of("push.py")
    until(lambda: desk.app.shared.pages.shown == "live", "the page")
    desk.choose("other.py")
    asked = until(lambda: desk.panels.html("wb-trust"), "the question")
    assert TASK.splitlines()[1] in asked and "outside of the folder" in asked
    desk.panels.press(DO_NOT)
    desk.idle()
    assert desk.app.shared.home is first and len(desk.opened) == 1
    desk.choose("other.py")
    until(lambda: desk.panels.shows(ONCE), "the question again")
    desk.panels.press(ONCE)
    desk.session_of("other.py")
    assert desk.opened[-1][1] == TaskOptions(3, env_kwargs={"size": 2}), "with the options of the last time"
    assert desk.app.open_task.is_open(desk.row("other.py"))
    assert not desk.app.open_task.is_open(desk.row("push.py"))
    desk.choose("push.py")
    desk.session_of("push.py")
    desk.choose("other.py")
    desk.session_of("other.py")


def test_another_choice_withdraws_the_question_and_the_last_choice_wins(desk: Desk) -> None:
    desk.choose("other.py")
    until(lambda: desk.panels.shows(ALWAYS), "the question")
    desk.choose("push.py")
    desk.choose("pull.py")
    desk.session_of("pull.py")
    until(lambda: not desk.panels.shows(ALWAYS), "the end of the question")
    assert [str(task) for task, _ in desk.opened if str(task).endswith("other.py")] == []


def test_a_missing_file_is_reported_and_nothing_is_opened(desk: Desk) -> None:
    assert desk.row("gone.py").gone
    desk.choose("gone.py")
    file = desk.folder / "work/push.py"
    row = desk.row("push.py")
    file.unlink()
    do(lambda: desk.app.open_task.choose(row.number))
    desk.idle()
    until(lambda: [one.name for one in desk.rows(Section.FOLDER)] == ["pull.py"], "the list without it")
    assert desk.opened == [] and desk.app.shared.session is None


def test_the_recordings_have_a_row_and_a_task_can_be_opened_from_there(
    child_process: None, desk: Desk
) -> None:
    (recordings,) = desk.rows(Section.RECORDINGS)
    do(lambda: desk.app.open_task.choose(recordings.number))
    until(lambda: desk.app.shared.pages.shown == "review", "the page")
    desk.choose("push.py")
    desk.session_of("push.py")
    until(lambda: desk.app.shared.pages.shown == "live", "the page")


def test_a_new_task_is_written_to_the_start_folder_and_opened(desk: Desk) -> None:
    for name in ("push", "../elsewhere/mine", "class"):
        with pytest.raises(ValueError):
            result_of(desk.app.open_task.create(name, "minimal"))
    result_of(desk.app.open_task.create("stack_two", "tabletop"))
    desk.session_of("stack_two.py")
    assert "class StackTwoEnv" in (desk.folder / "work" / "stack_two.py").read_text()
    assert desk.row("stack_two.py").section is Section.FOLDER
