"""The camera studio in a real session: placement, undo, reloads, edits of the file, and measurements."""

# pyright: reportOptionalMemberAccess=false, reportArgumentType=false, reportOptionalSubscript=false, reportOptionalOperand=false

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.drive.session import BASE, camera, in_studio, moved, start_over, step, wait_until
from workbench.app.session import Session
from workbench.cameras.commands import (
    CopyTask,
    DropCameraChange,
    PickPixel,
    PutMovedCamerasBack,
    RevertCameraChange,
    SaveCameraChange,
    StopMeasuring,
    UndoCamera,
    UsePlacement,
)
from workbench.cameras.events import (
    CameraChosen,
    CameraPlaced,
    ComparisonWanted,
    EditWanted,
    MeasureWanted,
    SheetWanted,
    SuggestionsWanted,
)
from workbench.cameras.view import EditRequest, StudioView
from workbench.envs.camera_data import CameraKey, CameraSettings, differences
from workbench.live.commands import PauseRun
from workbench.live.events import EnvsReset, FileOpened, MomentShown, PagesCounted
from workbench.live.messages import CameraRequest
from workbench.live.view import SessionView
from workbench.task.description import TaskOptions

pytestmark = pytest.mark.usefixtures("child_process")


@dataclass
class Copied:
    """A session's views of an installed task: the refused edit, the plan in a copy, and the checked copy."""

    folder: Path
    refused: SessionView
    planned: SessionView
    ended: SessionView
    named: str
    """The copied task, as a command line would name it."""


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Session, Copied]]:
    """A session that opened an installed task and then a copy of it.

    Its tests share one process, since compiling shaders in another takes 6 s.
    """
    folder = tmp_path_factory.mktemp("copied")
    (folder / "push_cube.py").write_text("somebody's own")
    options = TaskOptions(num_envs=2, env_kwargs={"obs_mode": "rgb"})
    with pytest.MonkeyPatch.context() as patch:
        # The copy is written to the session's start folder.
        patch.chdir(folder)
        session = Session("PushCube-v1", options, recordings=tmp_path_factory.mktemp("recordings"))
    try:
        wait_until(session, lambda view: view.task is not None, "the first load")
        there = replace(camera(session, BASE).now, position=(0.31, 0.02, 0.55))
        session.happen(CameraPlaced(BASE, there))
        session.happen(EditWanted(EditRequest("edit", BASE)))
        refused = wait_until(session, in_studio(lambda s: s.edit_state.stage == "refused"), "the refusal")
        session.do(CopyTask())
        planned = wait_until(
            session, in_studio(lambda s: s.edit_state.stage == "planned"), "the plan in the copy"
        )
        session.do(SaveCameraChange())
        ended = wait_until(
            session, in_studio(lambda s: s.edit_state.stage in ("checked", "mismatch")), "the check"
        )
        session.do(DropCameraChange())
        named = str(session.present_reference)
        yield session, Copied(folder, refused, planned, ended, named)
    finally:
        session.close()


@pytest.fixture(scope="module")
def studio_session(opened: tuple[Session, Copied], task_file: Path) -> Session:
    session, _ = opened
    text = task_file.read_text()
    # Small pictures: only the camera's pose matters.
    task_file.write_text(text.replace("512", "64"))
    session.do(PutMovedCamerasBack())
    session.happen(PagesCounted(1))
    session.happen(FileOpened(task_file, "PushCubeEnv"))
    wait_until(session, lambda view: view.task.file == str(task_file), "the example")
    session.change(cameras=(CameraRequest("base_camera", "sensor"), CameraRequest("render_camera", "human")))
    return session


@pytest.fixture
def session(studio_session: Session) -> Session:
    """Return the session paused, with every camera placed as in the file and one chosen."""
    studio_session.do(PauseRun())
    studio_session.happen(MomentShown(None))
    studio_session.do(PutMovedCamerasBack())
    wait_until(studio_session, lambda v: not v.playing and not moved(v), "rest")
    studio_session.happen(CameraChosen(BASE))
    return studio_session


def seen_from(key: CameraKey, settings: CameraSettings) -> Callable[[SessionView], bool]:
    """Return a predicate: the newest picture has the pose and size of `settings`."""

    def reached(view: SessionView) -> bool:
        picture = view.pictures.get(key)
        return (
            picture is not None
            and picture.rgb.shape == (settings.height, settings.width, 3)
            and np.allclose(picture.pose, [*settings.position, *settings.quaternion], atol=1e-6)
        )

    return reached


def test_invalid_placements_are_refused_with_a_reason_and_change_nothing(session: Session) -> None:
    start = camera(session, BASE).now
    session.happen(CameraPlaced(BASE, replace(start, near=5.0, far=1.0)))
    view = wait_until(session, in_studio(lambda s: "near must be" in s.problem), "the reason")
    assert not moved(view)
    session.happen(CameraPlaced(BASE, replace(start, shader_pack="nonsense")))
    view = wait_until(
        session, in_studio(lambda s: "there is no shader pack" in s.problem), "the worker's reason"
    )
    assert not moved(view)
    session.happen(CameraPlaced(("sensor", "nobody"), start))
    wait_until(session, in_studio(lambda s: "there is no sensor camera nobody" in s.problem), "the reason")


def test_a_placement_is_written_compared_and_reverted(session: Session, task_file: Path) -> None:
    saved = task_file.read_bytes()
    before = saved.replace(b"\n", b"\r\n")  # as a Windows editor saves it
    task_file.write_bytes(before)
    start = camera(session, BASE).now
    session.happen(CameraPlaced(BASE, replace(start, position=(0.31, 0.02, 0.55), fov=1.2)))
    session.happen(EditWanted(EditRequest("edit", BASE)))
    view = wait_until(session, in_studio(lambda s: s.edit_state.stage in ("planned", "refused")), "the plan")
    assert view.of(StudioView).edit_state.stage == "planned", view.of(StudioView).edit_state.message
    assert task_file.read_bytes() == before and "+" in view.of(StudioView).edit_state.edit.diff
    session.do(SaveCameraChange())
    view = wait_until(
        session, in_studio(lambda s: s.edit_state.stage in ("checked", "mismatch")), "the check"
    )
    assert view.of(StudioView).edit_state.stage == "checked", view.of(StudioView).edit_state.message
    assert view.reload.level == "cameras" and not moved(view)
    now = camera(session, BASE)
    assert now.now == now.info.settings and not differences(
        now.now, view.of(StudioView).edit_state.edit.settings
    )
    assert task_file.read_bytes() == view.of(StudioView).edit_state.edit.new_text.encode()
    session.do(RevertCameraChange())
    view = wait_until(
        session,
        in_studio(lambda s: s.edit_state.stage == "undone" and "loading it" not in s.edit_state.message),
        "the original file",
    )
    assert task_file.read_bytes() == before
    task_file.write_bytes(saved)
    # The revert also resets the placement, and one step of undo restores it.
    assert (
        not moved(view)
        and view.of(StudioView).camera(BASE).now == view.of(StudioView).camera(BASE).info.settings == start
    )
    assert view.of(StudioView).edit_state.message.endswith(
        "base_camera is where the file places it; Undo restores your placement."
    )
    wait_until(session, seen_from(BASE, start), "the camera where the file places it")
    assert view.of(StudioView).undo == "reverted the change of base_camera"
    session.do(UndoCamera())
    view = wait_until(session, lambda v: moved(v) == {BASE}, "the placement again")
    assert not differences(view.of(StudioView).camera(BASE).now, now.now)


def test_a_camera_removed_from_the_file_returns_at_its_placement(session: Session, task_file: Path) -> None:
    before = task_file.read_text()
    there = replace(camera(session, BASE).now, position=(0.2, 0.1, 0.7))
    session.happen(CameraPlaced(BASE, there))
    session.happen(EditWanted(EditRequest("remove", BASE)))
    view = wait_until(session, in_studio(lambda s: s.edit_state.stage in ("planned", "refused")), "the plan")
    assert view.of(StudioView).edit_state.stage == "planned", view.of(StudioView).edit_state.message
    session.do(SaveCameraChange())
    wait_until(session, in_studio(lambda s: s.edit_state.stage == "checked"), "the version without it")
    session.do(RevertCameraChange())
    wait_until(
        session,
        in_studio(lambda s: s.edit_state.stage == "undone" and "loading it" not in s.edit_state.message),
        "the original file",
    )
    assert task_file.read_text() == before
    assert moved(session.view()) == {BASE} and camera(session, BASE).now == there
    wait_until(session, seen_from(BASE, there), "the camera where it was placed")
    session.do(DropCameraChange())


def settled(session: Session, reached: Callable[[StudioView], bool], what: str) -> StudioView:
    """Wait until the studio's background work is done and `reached` holds; return the studio."""
    view = wait_until(
        session, in_studio(lambda s: s.progress is None and (reached(s) or bool(s.problem))), what
    )
    assert not view.of(StudioView).problem, view.of(StudioView).problem
    return view.of(StudioView)


def test_a_camera_is_measured_in_all_envs_and_its_report_is_stale_after_a_move(session: Session) -> None:
    session.happen(MeasureWanted("envs"))
    report = settled(session, lambda s: s.results.report_of == BASE, "the judgement").results.report
    assert sorted(report.envs) == [0, 1] and not session.view().of(StudioView).report_stale
    (cube,) = report.wanted_objects(("cube",))
    assert cube.summary().seen == 1.0
    session.happen(SheetWanted())
    sheet = settled(session, lambda s: len(s.results.sheet) == 2, "the pictures of all envs").results.sheet
    assert [p.env for p in sheet] == [report.envs[i] for i in report.worst_first()]
    # Point the camera at the sky.
    start = camera(session, BASE).now
    away = replace(start, quaternion=(0.7071067811865476, 0.0, -0.7071067811865476, 0.0))
    session.happen(CameraPlaced(BASE, away))
    assert session.view().of(StudioView).report_stale
    session.happen(MeasureWanted("envs"))
    studio = settled(session, lambda s: s.results.report is not report, "the report on the placement")
    assert (
        studio.results.report.wanted_objects(("cube",))[0].summary().seen == 0.0 and not studio.report_stale
    )
    session.happen(ComparisonWanted(start))
    pair = settled(session, lambda s: s.results.compared is not None, "the comparison").results.compared
    assert pair is not None
    here, there = pair
    assert np.allclose(here.pose[3:], away.quaternion) and np.allclose(there.pose[3:], start.quaternion)
    wait_until(session, seen_from(BASE, away), "the camera where it was placed, after the comparison")


def test_a_camera_is_measured_over_the_steps_of_the_shown_episode(session: Session) -> None:
    start_over(session, 0)
    step(session, 4)
    session.happen(MeasureWanted("steps"))
    studio = settled(session, lambda s: len(s.results.report_moments) == 5, "five moments")
    assert [moment.step for moment in studio.results.report_moments] == [0, 1, 2, 3, 4]
    assert {moment.env for moment in studio.results.report_moments} == {0} == set(studio.results.report.envs)
    (cube,) = studio.results.report.wanted_objects(("cube",))
    assert cube.summary().seen == 1.0
    session.happen(MomentShown(studio.results.report_moments[2].serial))
    assert session.view().step.elapsed_steps[0] == 2
    session.happen(MeasureWanted("steps", 2))
    moments = settled(
        session, lambda s: len(s.results.report_moments) == 2, "its ends"
    ).results.report_moments
    assert [moment.step for moment in moments] == [0, 4], (
        "the report covers the whole episode, even while one of its steps is shown"
    )
    session.happen(EnvsReset())
    wait_until(session, lambda v: not v.step.elapsed_steps.any() or v.timeline.shown is not None, "another")
    session.happen(MomentShown(None))
    session.happen(MeasureWanted("steps"))
    settled(session, lambda s: len(s.results.report_moments) == 1, "the new episode")


def test_a_picked_pixel_returns_the_point_seen_there(session: Session) -> None:
    view = session.view()
    cube = view.step.poses[0, list(view.task.geometry.body_names).index("cube")]
    # From the side away from the robot, level with the cube.
    x, y, z = (float(v) for v in cube[:3])
    next_to_cube = replace(
        camera(session, BASE).now, position=(x + 0.4, y, z), quaternion=(0.0, 0.0, 0.0, 1.0)
    )
    session.happen(CameraPlaced(BASE, next_to_cube))
    session.do(PickPixel(x=0.5, y=0.5))
    picked = settled(session, lambda s: s.results.picked is not None, "the pixel").results.picked
    assert picked.body == "cube" and abs(picked.depth - 0.38) < 2e-3
    assert np.allclose(picked.point, [x + 0.02, y, z], atol=5e-3)


@pytest.mark.slow
def test_measuring_seeds_and_searching_run_in_a_separate_process(session: Session) -> None:
    session.happen(MeasureWanted("resets", 3))
    assert session.view().of(StudioView).progress is not None
    found = settled(session, lambda s: s.results.report_seeds == 3, "three seeds")
    assert (
        len(found.results.report.envs) == 3
        and found.results.report_of == BASE
        and not found.results.measuring
    )
    session.happen(SuggestionsWanted(("cube",), (0.2, -0.4, 0.3), (0.6, 0.4, 0.8), 2))
    offered = settled(session, lambda s: len(s.results.suggestions) > 0, "suggestions").results.suggestions
    assert offered[0].score >= offered[-1].score > 0 and "cube: in 2 of 2 envs" in offered[0].words
    session.do(UsePlacement(number=0))
    wait_until(session, lambda v: moved(v) == {BASE}, "the suggestion taken")
    session.happen(MeasureWanted("resets", 500))
    wait_until(
        session,
        in_studio(lambda s: s.results.measuring and s.results.report is not None),
        "what is known, as from before",
    )
    wait_until(
        session, in_studio(lambda s: s.progress is not None and s.progress.total == 500), "a long judgement"
    )
    session.do(StopMeasuring())
    wait_until(session, in_studio(lambda s: s.progress is None and not s.results.measuring), "its end")
    session.happen(SuggestionsWanted(("nothing",), (0.0, 0.0, 0.3), (0.1, 0.1, 0.4), 1))
    wait_until(session, in_studio(lambda s: "'nothing' is not an object" in s.problem), "why not")


def test_an_installed_task_is_copied_and_the_placement_planned_in_the_copy(
    opened: tuple[Session, Copied],
) -> None:
    _, copied = opened
    view = copied.refused
    assert (
        view.of(StudioView).edit_state.can_copy and "is installed" in view.of(StudioView).edit_state.message
    )
    view, file = copied.planned, copied.folder / "push_cube_2.py"
    assert view.task.file == str(file) == view.of(StudioView).edit_state.edit.file
    assert view.task.env_id == "MyPushCube2-v1" and view.reload.level == "rebuilt"
    assert view.reload.reason == "push_cube_2.py was opened in place of PushCubeEnv"
    assert view.of(StudioView).edit_state.message.startswith(
        f"This is your copy of the task, {file}. This changes"
    )
    assert moved(view) == {BASE}, "the placement must be kept"
    assert copied.named.startswith(str(file)), "the command line must name the copy"
    view = copied.ended
    assert view.of(StudioView).edit_state.stage == "checked", view.of(StudioView).edit_state.message
    assert (copied.folder / "push_cube.py").read_text() == "somebody's own"
