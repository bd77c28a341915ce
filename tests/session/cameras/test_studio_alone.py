"""The camera studio without a worker: what it asks of one, what it says, and what becomes of its changes of a file."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from tests.drive.waiting import until
from tests.session.studio import BARE, FILE, INFO, KEY
from tests.ui.scenes import description, step_of, table_scene
from workbench.authoring.camera_source.disk import SourceEdit
from workbench.core.cameras.report import OfferedPlacement
from workbench.jobs.task import TaskDescription, TaskOptions
from workbench.machine.processes.wire import Call
from workbench.session.cameras.file_edits import FileEdits
from workbench.session.cameras.selection import StudioCameras
from workbench.session.cameras.studio import CameraStudio
from workbench.session.cameras.view import EditRequest, EditState, StudioView
from workbench.session.history.history import ShownMoment
from workbench.session.live.live_state import LiveState, SharedState
from workbench.session.live.timeline import TimeTravel
from workbench.session.live.versions import Versions
from workbench.session.process.askers import Asker, Background
from workbench.session.protocol.messages import Answer, Load, PlaceCamera, Placed, Request

MOVED = replace(FILE, position=(0.45, 0.3, 0.6))
GEOMETRY, POSES = table_scene(2)
TASK = description(GEOMETRY, (replace(INFO, settings=FILE),))


class Alone:
    """A studio, and what was asked of the worker that is not there."""

    def __init__(self) -> None:
        self.sent: list[Request] = []
        self.shared = SharedState(LiveState("push.py", TaskOptions(), 10**8))
        send = self.sent.append
        self.versions = Versions(self.shared, send, lambda: None, lambda: None)
        past = TimeTravel(self.shared, send, lambda: None)
        self.studio = CameraStudio(
            send,
            Asker(send),
            Background(),
            lambda: None,
            past,
            self.versions.running_load,
            self.versions.open_file,
        )
        self.step = step_of(POSES)
        self.studio.loaded(TASK, None)
        self.view()

    def view(self) -> StudioView:
        return self.studio.view(self.step, 1)

    def close(self) -> None:
        self.studio.close()
        self.versions.close()


@pytest.fixture
def one() -> Iterator[Alone]:
    one = Alone()
    yield one
    one.close()


def test_what_is_placed_is_asked_of_the_worker_and_what_stands_so_already_is_not(one: Alone) -> None:
    one.studio.place(KEY, MOVED)
    one.studio.place(KEY, MOVED)
    assert one.sent == [PlaceCamera(KEY, MOVED)] == list(one.studio.placed_cameras())
    one.studio.undo()
    one.studio.redo()
    one.studio.back_to_file(KEY)
    assert one.sent[1:] == [PlaceCamera(KEY, None), PlaceCamera(KEY, MOVED), PlaceCamera(KEY, None)]
    one.studio.place(("sensor", "nothing"), MOVED)
    assert len(one.sent) == 4 and "there is no sensor camera nothing" in one.view().problem


def test_one_that_could_not_be_placed_is_asked_for_where_it_stood(one: Alone) -> None:
    one.studio.place(KEY, MOVED)
    one.studio.placed(Placed(KEY, MOVED, None, why_not="it is far away"), TASK)
    assert one.sent == [PlaceCamera(KEY, MOVED), PlaceCamera(KEY, None)]
    assert one.view().problem == "base_camera could not be placed: it is far away."
    one.studio.placed(Placed(KEY, None, None, why_not="nor can this"), TASK)
    assert len(one.sent) == 2, "where the file says is asked for once"


def test_a_version_that_comes_in_ends_what_was_said_before_and_a_choice_of_what_is_gone(one: Alone) -> None:
    one.studio.select(KEY)
    one.studio.place(("sensor", "nothing"), MOVED)
    assert one.view().problem
    assert one.studio.loaded(TASK, "patched") == ()
    assert one.view().problem == "" and one.view().selected == KEY
    one.studio.place(KEY, MOVED)
    assert one.studio.loaded(TASK, "patched") == (KEY,), "the worker's is to stand there again"
    one.studio.loaded(description(GEOMETRY, ()), "patched")
    assert one.view().selected is None and one.view().cameras == ()


def test_every_suggestion_can_be_taken_and_none_that_is_not_there(one: Alone) -> None:
    best, other = (replace(BARE, position=(0.5, 0.1 * k, 0.7)) for k in range(2))
    seen: Any = None  # nobody looks at it here
    offers = tuple(OfferedPlacement(there, (0, 0, 0), 1.0, "", seen, seen) for there in (best, other))
    one.studio.take_suggestion(0)
    one.studio.reports._update(suggestions=offers, suggestions_of=KEY)
    for index in (-1, 2):
        one.studio.take_suggestion(index)
    assert one.sent == []
    for index, offered in enumerate((best, other)):
        one.studio.take_suggestion(index)
        assert one.sent[index] == PlaceCamera(KEY, replace(FILE, position=offered.position))


def test_a_report_is_stale_once_the_camera_was_moved_or_another_version_came(one: Alone) -> None:
    report = cast(Any, object())
    one.studio.reports._update(report=report, report_of=KEY, report_settings=FILE, outdated=False)
    assert not one.view().report_stale
    one.studio.place(KEY, MOVED)
    assert one.view().report_stale
    one.studio.undo()
    assert not one.view().report_stale
    one.studio.loaded(TASK, "cameras")
    assert not one.view().report_stale
    one.studio.loaded(TASK, "rebuilt")
    assert one.view().report_stale


def test_of_what_went_wrong_what_was_asked_last_is_said_first(one: Alone) -> None:
    one.studio.reports._update(problem="There is nothing to be seen.")
    assert one.view().problem == "There is nothing to be seen."
    one.studio.place(("sensor", "nothing"), MOVED)
    assert "there is no sensor camera nothing" in one.view().problem


def test_a_pose_is_not_pasted_into_a_camera_that_there_is_not(one: Alone) -> None:
    with pytest.raises(ValueError, match="no sensor camera nothing that can be placed"):
        one.studio.import_pose(("sensor", "nothing"), "", None, None)


# --- the file ----------------------------------------------------------------------------------------

TASK_TEXT = '''from mani_skill.utils.registration import register_env


@register_env("Alone-v1")
class PushEnv:
    """Nothing but a place."""
'''
PLANNED = EditRequest("edit", KEY, FILE)
ADDED = EditRequest("add", ("human", "side"), FILE)


class OfAFile:
    """A studio's file, without a worker that could load it."""

    def __init__(self, file: Path, folder: Path) -> None:
        self.file = file
        file.write_text(TASK_TEXT)
        self.cameras = StudioCameras()
        self.opened: list[tuple[Path, str]] = []
        self.task: TaskDescription = replace(TASK, file=str(file), source={str(file): TASK_TEXT})
        self.cameras.task = replace(self.task, source_files=(str(file),))
        self.notes = 0
        self.load: Load | None = None
        self.asked: list[Call] = []
        self.answers = True
        self.asker = Asker(self._hear)
        self.studio = FileEdits(
            self.cameras,
            self._notify,
            lambda file, name: self.opened.append((file, name)),
            self.asker,
            lambda: self.load,
            lambda: ShownMoment(0, 2, None),
        )
        self.studio.folder = folder
        folder.mkdir()

    def _notify(self) -> None:
        self.notes += 1

    def _hear(self, request: Request) -> None:
        assert isinstance(request, Call)
        self.asked.append(request)
        if self.answers:
            self.refuses(request)

    def refuses(self, call: Call) -> None:
        self.asker.take(Answer(call.number, why="nothing can be drawn here"))

    def waits_for_the_worker(self) -> Call:
        """A plan, which asks the worker what comes of it and gets no answer."""
        self.load, self.answers = Load(str(self.file), TaskOptions()), False
        self.studio.plan(ADDED)
        until(lambda: self.asked, "the worker being asked")
        return self.asked[0]

    def looks(self, request: EditRequest) -> None:
        with self.cameras.lock:
            """It was submitted whole."""
        self.studio._draw_new(request, FILE)

    def writes(self, request: EditRequest = PLANNED) -> EditState:
        edit = SourceEdit(str(self.file), TASK_TEXT, TASK_TEXT + "\n", (), FILE)
        self.studio.view = EditState("planned", request, edit)
        self.studio.write()
        until(lambda: self.studio.view.stage == "written", "the change in the file")
        assert self.file.read_text() == TASK_TEXT + "\n"
        return self.studio.view

    def copies(self, can: bool = True) -> None:
        self.studio.view = EditState("refused", PLANNED, can_copy=can)
        self.studio.copy_task()


@pytest.fixture
def written(tmp_path: Path) -> Iterator[OfAFile]:
    made = OfAFile(tmp_path / "push.py", tmp_path / "copies")
    yield made
    made.studio.close()


def test_what_is_written_or_refused_is_told_to_the_page(written: OfAFile) -> None:
    written.writes()
    until(lambda: written.notes == 1, "the page being told")
    written.file.write_text("edited\n")
    written.studio.undo_write()
    until(lambda: written.notes == 2, "the page being told again")
    assert written.studio.view.stage == "written"
    assert written.studio.view.message.startswith("Not done: push.py was edited since")


def test_that_there_is_no_picture_of_a_camera_to_be_added_is_said(written: OfAFile) -> None:
    written.studio._run_later(written.looks, ADDED)
    until(lambda: written.notes, "the page being told")
    said = "There is no picture of the new camera: nothing can be drawn here."
    assert written.cameras.problem == said and written.studio.view.picture is None


def test_a_task_that_may_be_copied_is_copied_and_what_was_written_to_the_other_file_is_past(
    written: OfAFile,
) -> None:
    written.writes()
    written.copies()
    until(lambda: written.opened, "the copy being opened")
    copy = written.studio.folder / "push.py"
    assert written.opened == [(copy, "PushEnv")] and copy.is_file()
    written.studio.drop_plan()
    assert written.studio.view.stage == "none", "nothing of another file can be taken back"


def test_a_copy_that_cannot_be_made_leaves_what_was_written_to_be_taken_back(written: OfAFile) -> None:
    made = written.writes()
    written.file.unlink()
    written.copies()
    until(lambda: written.studio.view.message.startswith("Not copied"), "why not")
    assert written.opened == []
    written.studio.drop_plan()
    assert written.studio.view == made


def test_what_need_not_be_copied_is_not(written: OfAFile) -> None:
    written.copies(can=False)
    written.studio.close()
    assert written.opened == [] and not any(written.studio.folder.iterdir())


def test_what_is_asked_for_after_the_end_is_not_begun(written: OfAFile) -> None:
    written.studio.close()
    written.studio.plan(PLANNED)
    written.studio.write()
    assert written.studio.view == EditState()


def test_the_end_ends_what_waits_for_the_worker_and_waits_until_that_is_told(written: OfAFile) -> None:
    asked, stages = written.waits_for_the_worker(), list[str]()

    def close() -> None:
        written.studio.close()
        stages.append(written.studio.view.stage)

    closing = threading.Thread(target=close)
    closing.start()
    try:
        until(lambda: stages, "the end, without an answer of the worker", seconds=10)
    finally:
        written.refuses(asked)
        closing.join()
    assert stages == ["refused"]
    assert "the task did not answer" in written.studio.view.message


def test_what_is_not_begun_at_the_end_is_left(written: OfAFile) -> None:
    written.waits_for_the_worker()
    written.studio.plan(PLANNED)
    written.studio.close()
    assert written.studio.view.request == ADDED


def test_what_was_refused_is_planned_in_the_copy_when_that_is_loaded_and_only_once(written: OfAFile) -> None:
    studio = written.studio
    written.copies()
    until(lambda: written.opened, "the copy being opened")
    copy = str(written.opened[0][0])
    for file in (str(written.file), copy):
        assert studio.view.stage == "none", "the wish waits for the copy"
        with written.cameras.lock:
            written.cameras.task = replace(written.task, file=file, source_files=(file,))
            studio.plan_in_copy(written.cameras.task)
    until(lambda: studio.view.stage == "refused", "the answer in the copy")
    assert studio.view.request == PLANNED
    assert studio.view.message.startswith(f"This is your copy of the task, {copy}.")
    until(lambda: written.notes == 3, "the page being told: of the copy, the wish and the answer")
    with written.cameras.lock:
        studio.plan_in_copy(written.cameras.task)
    studio.plan(ADDED)
    until(lambda: studio.view.request == ADDED and studio.view.stage == "refused", "the next answer")
    assert written.notes <= 5, "a plan that nobody asked for"


def test_a_removed_camera_that_comes_back_stands_where_it_was_placed(written: OfAFile) -> None:
    placed = written.cameras.placements.placed
    placed[KEY] = MOVED
    written.writes(EditRequest("remove", KEY, MOVED))
    without = replace(written.task, cameras=(), source={str(written.file): TASK_TEXT + "\n"})
    with written.cameras.lock:
        assert written.studio.loaded(without) == {KEY}
        placed.clear()  # the camera is gone
    assert written.studio.view.stage == "checked"
    written.studio.undo_write()
    until(lambda: written.studio.view.stage == "undone", "the file as it was")
    with written.cameras.lock:
        assert written.studio.loaded(written.task) == {KEY}
    assert placed == {KEY: MOVED}
