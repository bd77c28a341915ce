"""Camera edits in the author's file that are reverted, refused, or do not have the requested effect."""

# pyright: reportOptionalMemberAccess=false, reportArgumentType=false, reportOptionalSubscript=false

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.drive.session import BASE, camera, in_studio, step, wait_until
from workbench.app.session import Session
from workbench.cameras import edit_jobs as file_edits
from workbench.cameras.commands import (
    DropCameraChange,
    PutMovedCamerasBack,
    RevertCameraChange,
    SaveCameraChange,
)
from workbench.cameras.events import CameraPlaced, EditWanted
from workbench.cameras.view import EditRequest, EditState, StudioView
from workbench.envs.camera_data import CameraKey, CameraSettings
from workbench.task.description import TaskOptions
from workbench.task.write_edits import SourceEdit

pytestmark = pytest.mark.usefixtures("child_process")

LIMITED = '''

def limited(configs):
    """Changes configs, and differently after an edit is saved to disk."""
    text = open(limited.__code__.co_filename).read()
    for config in configs:
        if config.fov < 0.1:
            raise ValueError("no lens at all")
        config.fov = max(config.fov, 0.3)
        if "fov=" + "0.4," in text:
            raise ValueError("too narrow")
        if "fov=" + "0.7," in text:
            config.fov = 0.8
    return configs
'''
CALL = 'return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]'


@pytest.fixture(scope="module")
def session(task_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    text = task_file.read_text().replace("512", "64")
    assert CALL in text
    text = text.replace(CALL, CALL.replace("return ", "return limited(") + ")")
    task_file.write_text(text + LIMITED)
    options = TaskOptions(num_envs=1, env_kwargs={"obs_mode": "rgb"})
    session = Session(str(task_file), options, recordings=tmp_path_factory.mktemp("recordings"))
    wait_until(session, lambda view: view.task is not None, "the first load")
    yield session
    session.close()


def planned(session: Session) -> EditState:
    view = wait_until(session, in_studio(lambda s: s.edit_state.stage in ("planned", "refused")), "the plan")
    assert view.of(StudioView).edit_state.stage == "planned", view.of(StudioView).edit_state.message
    return view.of(StudioView).edit_state


def written(session: Session, stage: str = "checked") -> EditState:
    planned(session)
    session.do(SaveCameraChange())
    ended = ("checked", "mismatch", "refused")
    view = wait_until(session, in_studio(lambda s: s.edit_state.stage in ended), "the check")
    assert view.of(StudioView).edit_state.stage == stage, view.of(StudioView).edit_state.message
    return view.of(StudioView).edit_state


def settings_in_file(session: Session, key: CameraKey) -> CameraSettings:
    found = camera(session, key).info.settings
    assert found is not None
    return found


@pytest.mark.slow
def test_the_session_answers_while_an_edit_waits_for_the_disk(
    session: Session, task_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    resume, waiting, apply = threading.Event(), threading.Event(), file_edits.apply

    def apply_when_resumed(edit: SourceEdit) -> None:
        waiting.set()
        resume.wait(60)
        apply(edit)

    monkeypatch.setattr(file_edits, "apply", apply_when_resumed)
    session.happen(CameraPlaced(BASE, replace(settings_in_file(session, BASE), fov=1.05)))
    session.happen(EditWanted(EditRequest("edit", BASE)))
    planned(session)
    session.do(SaveCameraChange())
    try:
        assert waiting.wait(60)
        step(session)
        assert session.view().of(StudioView).edit_state.loading
    finally:
        resume.set()
    wait_until(session, in_studio(lambda s: s.edit_state.stage == "checked"), "the check")
    assert "1.05" in task_file.read_text()
    session.do(RevertCameraChange())
    wait_until(
        session,
        in_studio(lambda s: s.edit_state.stage == "undone" and not s.edit_state.loading),
        "the original file",
    )


@pytest.mark.slow
def test_changes_are_reverted_one_by_one_even_after_a_discarded_plan(
    session: Session, task_file: Path
) -> None:
    texts = [task_file.read_text()]
    for fov in (0.9, 0.95):
        session.happen(CameraPlaced(BASE, replace(settings_in_file(session, BASE), fov=fov)))
        session.happen(EditWanted(EditRequest("edit", BASE)))
        written(session)
        texts.append(task_file.read_text())
    session.happen(EditWanted(EditRequest("remove", BASE)))
    planned(session)
    session.do(DropCameraChange())
    wait_until(
        session, in_studio(lambda s: s.edit_state.stage == "checked"), "the change that can be reverted"
    )
    session.do(RevertCameraChange())
    view = wait_until(
        session,
        in_studio(lambda s: "The edit before it: base_camera" in s.edit_state.message),
        "the change before it",
    )
    # It can be reverted immediately.
    assert view.of(StudioView).edit_state.stage == "checked"
    assert view.of(StudioView).edit_state.message.startswith(f"Edit reverted in {task_file.name}.")
    assert task_file.read_text() == texts[1]
    session.do(RevertCameraChange())
    wait_until(
        session,
        in_studio(lambda s: s.edit_state.stage == "undone" and not s.edit_state.loading),
        "the original file",
    )
    assert task_file.read_text() == texts[0]
    session.do(DropCameraChange())
    wait_until(session, in_studio(lambda s: s.edit_state.stage == "none"), "nothing left")
    session.do(PutMovedCamerasBack())


@pytest.mark.slow
def test_a_change_is_not_reverted_in_a_file_that_was_edited_since(session: Session, task_file: Path) -> None:
    before = task_file.read_text()
    session.happen(CameraPlaced(BASE, replace(settings_in_file(session, BASE), fov=0.9)))
    session.happen(EditWanted(EditRequest("edit", BASE)))
    written(session)
    edited = task_file.read_text() + "# more\n"
    task_file.write_text(edited)
    session.do(RevertCameraChange())
    view = wait_until(
        session, in_studio(lambda s: s.edit_state.message.startswith("The file was not changed")), "why not"
    )
    assert (
        "was edited since" in view.of(StudioView).edit_state.message
        and view.of(StudioView).edit_state.stage == "checked"
    )
    assert task_file.read_text() == edited
    session.do(DropCameraChange())
    task_file.write_text(before)
    wait_until(session, lambda v: v.of(StudioView).camera(BASE).info.settings.fov == 1.0, "the original file")


def test_a_camera_that_differs_from_the_edit_is_an_error_and_can_be_reverted(
    session: Session, task_file: Path
) -> None:
    before = task_file.read_text()
    session.happen(CameraPlaced(BASE, replace(settings_in_file(session, BASE), fov=0.7)))
    session.happen(EditWanted(EditRequest("edit", BASE)))
    message = written(session, "mismatch").message
    assert (
        "base_camera is not what was written (fov: 0.8, not 0.7)" in message
        and "Revert the change" in message
    )
    assert "fov=0.7" in task_file.read_text() and settings_in_file(session, BASE).fov == 0.8
    session.do(RevertCameraChange())
    wait_until(
        session,
        in_studio(lambda s: s.edit_state.stage == "undone" and not s.edit_state.loading),
        "the original file",
    )
    assert task_file.read_text() == before
    session.do(PutMovedCamerasBack())
    session.do(DropCameraChange())


@pytest.mark.parametrize(
    ("fov", "why"), [(0.2, "does not give the camera the requested settings"), (0.05, "no lens at all")]
)
def test_a_change_that_the_hook_overrides_is_refused_before_it_is_written(
    session: Session, task_file: Path, fov: float, why: str
) -> None:
    before = task_file.read_text()
    session.happen(CameraPlaced(BASE, replace(settings_in_file(session, BASE), fov=fov)))
    session.happen(EditWanted(EditRequest("edit", BASE)))
    view = wait_until(session, in_studio(lambda s: s.edit_state.stage == "refused"), "the refusal")
    assert (
        why in view.of(StudioView).edit_state.message
        and f"fov={fov}" in view.of(StudioView).edit_state.snippet
    )
    assert task_file.read_text() == before and settings_in_file(session, BASE).fov == 1.0
    session.do(DropCameraChange())
    session.do(PutMovedCamerasBack())


@pytest.mark.slow
def test_a_change_that_breaks_loading_is_reported_and_can_be_reverted(
    session: Session, task_file: Path
) -> None:
    before = task_file.read_text()
    session.happen(CameraPlaced(BASE, replace(settings_in_file(session, BASE), fov=0.4)))
    session.happen(EditWanted(EditRequest("edit", BASE)))
    planned(session)
    session.do(SaveCameraChange())
    view = wait_until(session, in_studio(lambda s: "does not load" in s.edit_state.message), "the failure")
    assert "revert the change if it is the cause" in view.of(StudioView).edit_state.message
    assert view.problem is not None and "too narrow" in view.problem.message
    assert settings_in_file(session, BASE).fov == 1.0, "the previous version must keep running"
    session.do(RevertCameraChange())
    wait_until(
        session,
        lambda v: v.problem is None and v.of(StudioView).edit_state.stage == "undone",
        "the reverted file",
    )
    assert task_file.read_text() == before
