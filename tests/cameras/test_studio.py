"""The camera studio in a real session: placement, undo, reloads, edits of the file, and measurements."""

# pyright: reportOptionalMemberAccess=false, reportArgumentType=false, reportOptionalSubscript=false, reportOptionalOperand=false

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.drive.session import BASE, camera, in_studio, moved, save, start_over, step, wait_until
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


LIMITED = """

def limited(configs):
    for config in configs:
        if config.fov < 0.1:
            raise ValueError("no lens at all")
        config.fov = max(config.fov, 0.3)
    return configs
"""
CALL = 'return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]'


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
        session.dispatch(CameraPlaced(BASE, there))
        session.dispatch(EditWanted(EditRequest("edit", BASE)))
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
    session.dispatch(PagesCounted(1))
    session.dispatch(FileOpened(task_file, "PushCubeEnv"))
    wait_until(session, lambda view: view.task.file == str(task_file), "the example")
    session.change(cameras=(CameraRequest("base_camera", "sensor"), CameraRequest("render_camera", "human")))
    return session


@pytest.fixture
def session(studio_session: Session) -> Session:
    """Return the session paused, with every camera placed as in the file and one chosen."""
    studio_session.do(PauseRun())
    studio_session.dispatch(MomentShown(None))
    studio_session.do(PutMovedCamerasBack())
    wait_until(studio_session, lambda v: not v.playing and not moved(v), "rest")
    studio_session.dispatch(CameraChosen(BASE))
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


def reached(session: Session, what: Callable[[StudioView], object], name: str) -> StudioView:
    return wait_until(session, in_studio(what), name).of(StudioView)


def test_a_placement_is_written_compared_and_reverted(session: Session, task_file: Path) -> None:
    saved = task_file.read_bytes()
    before = saved.replace(b"\n", b"\r\n")  # as a Windows editor saves it
    task_file.write_bytes(before)
    start = camera(session, BASE).now
    session.dispatch(CameraPlaced(BASE, replace(start, position=(0.31, 0.02, 0.55), fov=1.2)))
    session.dispatch(EditWanted(EditRequest("edit", BASE)))
    state = reached(session, lambda s: s.edit_state.stage in ("planned", "refused"), "the plan").edit_state
    assert state.stage == "planned", state.message
    assert task_file.read_bytes() == before and "+" in state.edit.diff
    session.do(SaveCameraChange())
    state = reached(session, lambda s: s.edit_state.stage in ("checked", "mismatch"), "the check").edit_state
    assert state.stage == "checked", state.message
    assert session.view().reload.level == "cameras" and not moved(session.view())
    now = camera(session, BASE)
    assert now.now == now.info.settings and not differences(now.now, state.edit.settings)
    assert task_file.read_bytes() == state.edit.new_text.encode()
    session.do(RevertCameraChange())
    studio = reached(
        session, lambda s: s.edit_state.stage == "undone" and not s.edit_state.loading, "the original file"
    )
    assert task_file.read_bytes() == before
    task_file.write_bytes(saved)
    # The revert also resets the placement, and one step of undo restores it.
    assert not moved(session.view()) and studio.camera(BASE).now == studio.camera(BASE).info.settings == start
    wait_until(session, seen_from(BASE, start), "the camera where the file places it")
    assert session.view().of(StudioView).undo == "reverted the change of base_camera"
    session.do(UndoCamera())
    view = wait_until(session, lambda v: moved(v) == {BASE}, "the placement again")
    assert not differences(view.of(StudioView).camera(BASE).now, now.now)


def test_a_change_that_the_hook_overrides_is_refused_before_it_is_written(
    session: Session, task_file: Path
) -> None:
    saved, now = task_file.read_text(), camera(session, BASE).now
    assert CALL in saved
    limiting = saved.replace(CALL, CALL.replace("return ", "return limited(") + ")") + LIMITED
    save(session, task_file, limiting)
    for fov, why in ((0.2, "does not give the camera the requested settings"), (0.05, "no lens at all")):
        session.dispatch(CameraPlaced(BASE, replace(now, fov=fov)))
        session.dispatch(EditWanted(EditRequest("edit", BASE)))
        state = reached(session, lambda s: s.edit_state.stage == "refused", "the refusal").edit_state
        assert why in state.message and f"fov={fov}" in state.snippet
        assert task_file.read_text() == limiting and camera(session, BASE).info.settings == now
        session.do(DropCameraChange())
    save(session, task_file, saved)


def settled(session: Session, ready: Callable[[StudioView], object], what: str) -> StudioView:
    """Wait until the studio's background work is done and `ready` holds; return the studio."""
    studio = reached(session, lambda s: s.progress is None and (ready(s) or s.problem), what)
    assert not studio.problem, studio.problem
    return studio


def test_a_camera_is_measured_in_all_envs_and_its_report_is_stale_after_a_move(session: Session) -> None:
    session.dispatch(MeasureWanted("envs"))
    report = settled(session, lambda s: s.results.report_of == BASE, "the judgement").results.report
    assert sorted(report.envs) == [0, 1] and not session.view().of(StudioView).report_stale
    (cube,) = report.wanted_objects(("cube",))
    assert cube.summary().seen == 1.0
    session.dispatch(SheetWanted())
    sheet = settled(session, lambda s: len(s.results.sheet) == 2, "the pictures of all envs").results.sheet
    assert [p.env for p in sheet] == [report.envs[i] for i in report.worst_first()]
    # Point the camera at the sky.
    start = camera(session, BASE).now
    away = replace(start, quaternion=(0.7071067811865476, 0.0, -0.7071067811865476, 0.0))
    session.dispatch(CameraPlaced(BASE, away))
    assert session.view().of(StudioView).report_stale
    session.dispatch(MeasureWanted("envs"))
    studio = settled(session, lambda s: s.results.report is not report, "the report on the placement")
    assert (
        studio.results.report.wanted_objects(("cube",))[0].summary().seen == 0.0 and not studio.report_stale
    )
    session.dispatch(ComparisonWanted(start))
    pair = settled(session, lambda s: s.results.compared is not None, "the comparison").results.compared
    assert pair is not None
    here, there = pair
    assert np.allclose(here.pose[3:], away.quaternion) and np.allclose(there.pose[3:], start.quaternion)
    wait_until(session, seen_from(BASE, away), "the camera where it was placed, after the comparison")


def test_a_camera_is_measured_over_the_steps_of_the_shown_episode(session: Session) -> None:
    start_over(session, 0)
    step(session, 4)
    session.dispatch(MeasureWanted("steps"))
    studio = settled(session, lambda s: len(s.results.report_moments) == 5, "five moments")
    assert [moment.step for moment in studio.results.report_moments] == [0, 1, 2, 3, 4]
    assert {moment.env for moment in studio.results.report_moments} == {0} == set(studio.results.report.envs)
    (cube,) = studio.results.report.wanted_objects(("cube",))
    assert cube.summary().seen == 1.0
    session.dispatch(MomentShown(studio.results.report_moments[2].serial))
    assert session.view().step.elapsed_steps[0] == 2
    session.dispatch(MeasureWanted("steps", 2))
    moments = settled(
        session, lambda s: len(s.results.report_moments) == 2, "its ends"
    ).results.report_moments
    assert [moment.step for moment in moments] == [0, 4], (
        "the report covers the whole episode, even while one of its steps is shown"
    )
    session.dispatch(EnvsReset())
    wait_until(session, lambda v: not v.step.elapsed_steps.any() or v.timeline.shown is not None, "another")
    session.dispatch(MomentShown(None))
    session.dispatch(MeasureWanted("steps"))
    settled(session, lambda s: len(s.results.report_moments) == 1, "the new episode")


def test_a_picked_pixel_returns_the_point_seen_there(session: Session) -> None:
    view = session.view()
    cube = view.step.poses[0, list(view.task.geometry.body_names).index("cube")]
    # From the side away from the robot, level with the cube.
    x, y, z = (float(v) for v in cube[:3])
    next_to_cube = replace(
        camera(session, BASE).now, position=(x + 0.4, y, z), quaternion=(0.0, 0.0, 0.0, 1.0)
    )
    session.dispatch(CameraPlaced(BASE, next_to_cube))
    session.do(PickPixel(x=0.5, y=0.5))
    picked = settled(session, lambda s: s.results.picked is not None, "the pixel").results.picked
    assert picked.body == "cube" and abs(picked.depth - 0.38) < 2e-3
    assert np.allclose(picked.point, [x + 0.02, y, z], atol=5e-3)


@pytest.mark.slow
def test_measuring_seeds_and_searching_run_in_a_separate_process(session: Session) -> None:
    session.dispatch(MeasureWanted("resets", 3))
    assert session.view().of(StudioView).progress is not None
    found = settled(session, lambda s: s.results.report_seeds == 3, "three seeds")
    assert (
        len(found.results.report.envs) == 3
        and found.results.report_of == BASE
        and not found.results.measuring
    )
    session.dispatch(SuggestionsWanted(("cube",), (0.2, -0.4, 0.3), (0.6, 0.4, 0.8), 2))
    offered = settled(session, lambda s: len(s.results.suggestions) > 0, "suggestions").results.suggestions
    assert offered[0].score >= offered[-1].score > 0 and "cube: in 2 of 2 envs" in offered[0].words
    session.do(UsePlacement(number=0))
    wait_until(session, lambda v: moved(v) == {BASE}, "the suggestion taken")
    session.dispatch(MeasureWanted("resets", 500))
    reached(session, lambda s: s.results.measuring and s.results.report, "what is known, as from before")
    reached(session, lambda s: s.progress is not None and s.progress.total == 500, "a long judgement")
    session.do(StopMeasuring())
    reached(session, lambda s: s.progress is None and not s.results.measuring, "its end")
    session.dispatch(SuggestionsWanted(("nothing",), (0.0, 0.0, 0.3), (0.1, 0.1, 0.4), 1))
    reached(session, lambda s: "'nothing' is not an object" in s.problem, "why not")


def test_an_installed_task_is_copied_and_the_placement_planned_in_the_copy(
    opened: tuple[Session, Copied],
) -> None:
    _, copied = opened
    refused, planned, ended = (
        view.of(StudioView).edit_state for view in (copied.refused, copied.planned, copied.ended)
    )
    assert refused.can_copy and "is installed" in refused.message
    view, file = copied.planned, copied.folder / "push_cube_2.py"
    assert view.task.file == str(file) == planned.edit.file
    assert view.task.env_id == "MyPushCube2-v1" and view.reload.level == "rebuilt"
    assert view.reload.reason == "push_cube_2.py was opened in place of PushCubeEnv"
    assert planned.message.startswith(f"This is your copy of the task, {file}. This changes")
    assert moved(view) == {BASE}, "the placement must be kept"
    assert copied.named.startswith(str(file)), "the command line must name the copy"
    assert ended.stage == "checked", ended.message
    assert (copied.folder / "push_cube.py").read_text() == "somebody's own"
