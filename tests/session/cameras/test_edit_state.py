"""Cameras added, copied, renamed and removed in the author's file; and changes that do not come to what they should."""

# pyright: reportOptionalMemberAccess=false, reportArgumentType=false, reportOptionalSubscript=false

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.drive.session import wait_until
from tests.session.studio import BASE, camera, moved, said
from workbench.authoring.camera_source.cameras import RunHooks
from workbench.core.camera_data import CameraKey, CameraSettings, differences
from workbench.jobs.task import TaskOptions
from workbench.session.cameras.edit_state import copy, plan
from workbench.session.cameras.view import EditRequest, EditState
from workbench.session.live.session import Session
from workbench.ui.cameras.write_to_file import edit_html

pytestmark = pytest.mark.usefixtures("child_process")

LIMITED = '''

def limited(configs):
    """Of its own mind, and of another once it is on the disk."""
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
    view = wait_until(session, said(lambda s: s.edit_state.stage in ("planned", "refused")), "the plan")
    assert view.studio.edit_state.stage == "planned", view.studio.edit_state.message
    return view.studio.edit_state


def written(session: Session, stage: str = "checked") -> EditState:
    planned(session)
    session.studio.file.write()
    ended = ("checked", "mismatch", "refused")
    view = wait_until(session, said(lambda s: s.edit_state.stage in ended), "the check")
    assert view.studio.edit_state.stage == stage, view.studio.edit_state.message
    return view.studio.edit_state


def there(session: Session, key: CameraKey) -> CameraSettings:
    found = camera(session, key).info.settings
    assert found is not None
    return found


def asking(session: Session) -> RunHooks:
    """The worker runs the hooks; what has to wait for it here is on the test's own thread."""
    return session.studio.file._run


def names(session: Session) -> list[str]:
    return [c.key[1] for c in session.view().studio.cameras if c.key[0] == "human"]


@pytest.mark.slow
def test_a_camera_is_added_moved_copied_renamed_and_removed_and_the_env_has_it_each_time(
    session: Session, task_file: Path
) -> None:
    studio, before = session.studio, task_file.read_text()
    new = replace(there(session, ("human", "render_camera")), position=(0.6, 0.0, 0.7), fov=0.9)
    studio.file.plan(EditRequest("add", ("human", "side"), new))
    assert written(session).message == f"side: added to {task_file.name} and verified."
    assert not differences(there(session, ("human", "side")), new, close=3e-4), "but for what is rounded"
    assert session.view().studio.selected == ("human", "side"), "one wants to place what one has added"
    # What is not written yet is in the copy, and stays with the original.
    away = replace(new, position=(0.61, 0.1, 0.7))
    studio.place(("human", "side"), away)
    studio.file.plan(EditRequest("duplicate", ("human", "side"), name="other"))
    assert "a copy of side" in written(session).message
    assert names(session) == ["render_camera", "side", "other"]
    assert ("human", "side") in moved(session.view())
    assert camera(session, ("human", "other")).now.position == away.position
    studio.file.plan(EditRequest("rename", ("human", "side"), name="front"))
    assert written(session).message == f"side: renamed to front in {task_file.name} and verified."
    assert names(session) == ["render_camera", "front", "other"]
    assert camera(session, ("human", "front")).now.position == away.position, "the placement is lost"
    for name in ("front", "other"):
        studio.file.plan(EditRequest("remove", ("human", name)))
        assert f"{name}: removed from" in written(session).message
    assert names(session) == ["render_camera"] and task_file.read_text().count(
        "CameraConfig("
    ) == before.count("CameraConfig(")
    studio.file.drop_plan()


@pytest.mark.slow
def test_a_camera_to_be_added_is_seen_before_and_what_is_left_for_another_plan_is_said(
    session: Session,
) -> None:
    studio = session.studio
    new = replace(there(session, ("human", "render_camera")), position=(0.5, 0.2, 0.6))
    studio.file.plan(EditRequest("add", ("human", "side"), new))
    plan = planned(session)
    assert plan.message.startswith("This adds side to")
    assert "drawing what it sees" in edit_html(replace(plan, picture=None, drawing=True), False)
    view = wait_until(session, said(lambda s: s.edit_state.picture is not None), "its picture")
    picture = view.studio.edit_state.picture
    assert "drawing what it sees" not in edit_html(view.studio.edit_state, False)
    assert picture.rgb.shape == (new.height, new.width, 3) and picture.rgb.std() > 5
    assert [c.key[1] for c in view.studio.cameras] == ["base_camera", "render_camera"], "it is there already"
    studio.place(BASE, replace(there(session, BASE), fov=0.9))
    studio.file.plan(EditRequest("edit", BASE))
    other = said(lambda s: (s.edit_state.what, s.edit_state.stage) == ("edit", "planned"))
    view = wait_until(session, other, "the other plan")
    assert view.studio.edit_state.message.startswith("side was not added. This changes base_camera in")
    assert view.studio.edit_state.picture is None
    studio.back_to_file(BASE)
    studio.file.drop_plan()


def test_changes_are_taken_back_one_after_the_other_also_when_a_plan_came_between(
    session: Session, task_file: Path
) -> None:
    studio, texts = session.studio, [task_file.read_text()]
    for fov in (0.9, 0.95):
        studio.place(BASE, replace(there(session, BASE), fov=fov))
        studio.file.plan(EditRequest("edit", BASE))
        written(session)
        texts.append(task_file.read_text())
    studio.file.plan(EditRequest("remove", BASE))
    planned(session)
    studio.file.drop_plan()
    wait_until(session, said(lambda s: s.edit_state.stage == "checked"), "the change that can be taken back")
    studio.file.undo_write()
    view = wait_until(
        session, said(lambda s: "Before it: base_camera" in s.edit_state.message), "the change before it"
    )
    # It can be reverted at once.
    assert view.studio.edit_state.stage == "checked"
    assert view.studio.edit_state.message.startswith(f"Edit reverted in {task_file.name}.")
    assert task_file.read_text() == texts[1]
    studio.file.undo_write()
    wait_until(
        session,
        said(lambda s: s.edit_state.stage == "undone" and not s.edit_state.loading),
        "the file of before",
    )
    assert task_file.read_text() == texts[0]
    studio.file.drop_plan()
    wait_until(session, said(lambda s: s.edit_state.stage == "none"), "nothing left")
    studio.back_to_file(BASE)


def test_an_inherited_camera_gets_a_hook_that_keeps_the_parents_others(
    session: Session, task_file: Path, tmp_path: Path
) -> None:
    file = tmp_path / "task.py"
    text = """from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.utils.registration import register_env


class Far(PushCubeEnv):
    @property
    def _default_sensor_configs(self):
        from mani_skill.sensors.camera import CameraConfig
        import sapien

        return [*super()._default_sensor_configs, CameraConfig("far", sapien.Pose(), 32, 32, 1.0, 0.01, 10)]


@register_env("InheritsACamera-v1", max_episode_steps=50, override=True)
class Inherits(PushCubeEnv):
    NEAR = 1
"""
    file.write_text(text)
    example = session.view().task
    session.versions.open_file(file, "Inherits")
    try:
        before = wait_until(session, lambda v: v.task.class_name == "Inherits", "the other task").task
        info = camera(session, BASE).info
        wanted = replace(info.settings, position=(0.4, 0.1, 0.9), fov=1.2)

        # A class with such a hook of its own is told whose the camera is, and gets the text for it.
        refused = plan(
            replace(before, class_name="Far"), info, EditRequest("edit", BASE, wanted), asking(session)
        )
        assert refused.stage == "refused" and "base_camera is made by PushCubeEnv" in refused.message
        assert "the _default_sensor_configs of Far (task.py) returns it" in refused.message
        assert refused.snippet.startswith("CameraConfig(")
        # An installed task is not written: the whole hook is there to be copied.
        installed = replace(before, source_files=(), file="/site-packages/their_task.py")
        refused = plan(installed, info, EditRequest("edit", BASE, wanted), asking(session))
        assert refused.stage == "refused" and "it is made by PushCubeEnv" in refused.message
        assert "def _default_sensor_configs(self):" in refused.snippet
        assert 'cameras["base_camera"] = CameraConfig(' in refused.snippet

        session.studio.place(BASE, wanted)
        session.studio.file.plan(EditRequest("edit", BASE))
        notes = planned(session).edit.notes
        assert "base_camera is made by PushCubeEnv, from which Inherits inherits" in notes[0]
        assert written(session).message == "base_camera: saved to task.py and verified."
        assert not differences(there(session, BASE), wanted, close=3e-4)
        task = session.view().task
        assert {c.key: c.settings for c in before.cameras if c.key != BASE} == {
            c.key: c.settings for c in task.cameras if c.key != BASE
        }
        # From now on it is the task's own, and changed where it stands.
        again = plan(
            task,
            camera(session, BASE).info,
            EditRequest("edit", BASE, replace(wanted, fov=0.8)),
            asking(session),
        )
        assert again.stage == "planned" and again.edit.diff.count("\n+ ") == 1, again.message
    finally:
        session.studio.back_to_file(BASE)
        session.studio.file.drop_plan()
        session.versions.open_file(task_file, example.class_name)
        wait_until(session, lambda v: v.task.file == str(task_file), "the example again")


def test_a_change_is_not_taken_back_out_of_a_file_that_moved_on(session: Session, task_file: Path) -> None:
    studio, before = session.studio, task_file.read_text()
    studio.place(BASE, replace(there(session, BASE), fov=0.9))
    studio.file.plan(EditRequest("edit", BASE))
    written(session)
    edited = task_file.read_text() + "# more\n"
    task_file.write_text(edited)
    studio.file.undo_write()
    view = wait_until(session, said(lambda s: s.edit_state.message.startswith("Not done")), "why not")
    assert "was edited since" in view.studio.edit_state.message and view.studio.edit_state.stage == "checked"
    assert task_file.read_text() == edited
    studio.file.drop_plan()
    task_file.write_text(before)
    wait_until(session, lambda v: v.studio.camera(BASE).info.settings.fov == 1.0, "the file of before")


def test_a_camera_that_comes_out_otherwise_is_an_error_and_is_taken_back(
    session: Session, task_file: Path
) -> None:
    studio, before = session.studio, task_file.read_text()
    studio.place(BASE, replace(there(session, BASE), fov=0.7))
    studio.file.plan(EditRequest("edit", BASE))
    message = written(session, "mismatch").message
    assert (
        "base_camera is not what was written (fov: 0.8, not 0.7)" in message
        and "Revert the change" in message
    )
    assert "fov=0.7" in task_file.read_text() and there(session, BASE).fov == 0.8
    studio.file.undo_write()
    wait_until(
        session,
        said(lambda s: s.edit_state.stage == "undone" and not s.edit_state.loading),
        "the file of before",
    )
    assert task_file.read_text() == before
    studio.back_to_file(BASE)
    studio.file.drop_plan()


@pytest.mark.parametrize(
    ("fov", "why"), [(0.2, "does not give the camera the requested settings"), (0.05, "no lens at all")]
)
def test_a_change_that_the_hook_itself_makes_another_of_is_refused_before_it_is_written(
    session: Session, task_file: Path, fov: float, why: str
) -> None:
    before = task_file.read_text()
    session.studio.place(BASE, replace(there(session, BASE), fov=fov))
    session.studio.file.plan(EditRequest("edit", BASE))
    view = wait_until(session, said(lambda s: s.edit_state.stage == "refused"), "the refusal")
    assert why in view.studio.edit_state.message and f"fov={fov}" in view.studio.edit_state.snippet
    assert task_file.read_text() == before and there(session, BASE).fov == 1.0
    session.studio.file.drop_plan()
    session.studio.back_to_file(BASE)


def test_what_the_constructor_sets_is_edited_there_and_the_batch_stands_as_it_stood(
    session: Session, task_file: Path
) -> None:
    before = task_file.read_text()
    call = "        super().__init__(*args,"
    text = before.replace(call, f"        self.eye = [0.45, 0, 0.6]\n{call}")
    text = text.replace("look_at(eye=[0.45, 0, 0.6],", "look_at(eye=self.eye,")
    assert text.count("self.eye") == 2
    task_file.write_text(text)
    # The first moment of its scene comes behind it.
    view = wait_until(
        session,
        lambda v: v.task.source[str(task_file)] == text and v.timeline.moments == 1,
        "the version with a constructor",
    )
    step = view.step
    wanted = replace(there(session, BASE), position=(0.45, 0.1, 0.7))
    session.studio.place(BASE, wanted)
    session.studio.file.plan(EditRequest("edit", BASE))
    planned(session)
    assert session.view().step is step, "asking moved the batch"
    assert written(session).message.startswith("base_camera: saved to")
    assert "self.eye = [0.45, 0.1, 0.7]" in task_file.read_text()
    assert there(session, BASE).position == pytest.approx((0.45, 0.1, 0.7), abs=1e-6)
    session.studio.file.drop_plan()
    task_file.write_text(before)
    wait_until(session, lambda v: v.task.source[str(task_file)] == before, "the file of before")
    session.studio.back_to_file(BASE)


def test_a_change_with_which_the_file_does_not_load_says_so_and_is_taken_back(
    session: Session, task_file: Path
) -> None:
    studio, before = session.studio, task_file.read_text()
    studio.place(BASE, replace(there(session, BASE), fov=0.4))
    studio.file.plan(EditRequest("edit", BASE))
    planned(session)
    studio.file.write()
    view = wait_until(session, said(lambda s: "does not load" in s.edit_state.message), "the failure")
    assert "revert it if that is the reason" in view.studio.edit_state.message
    assert view.problem is not None and "too narrow" in view.problem.message
    assert there(session, BASE).fov == 1.0, "the version before goes on"
    studio.file.undo_write()
    wait_until(session, lambda v: v.problem is None and v.studio.edit_state.stage == "undone", "it back")
    assert task_file.read_text() == before


def test_a_read_only_file_may_be_copied_and_one_with_modules_beside_it_may_not(
    session: Session, task_file: Path, tmp_path: Path
) -> None:
    task = session.view().task
    request = EditRequest("add", ("human", "side"), there(session, ("human", "render_camera")))
    assert not plan(task, None, request, asking(session)).can_copy, "it can be edited where it is"
    task_file.chmod(0o444)
    try:
        refused = plan(task, None, request, asking(session))
        assert refused.can_copy and "is read-only" in refused.message
        file, told = copy(task, tmp_path)
        assert file == tmp_path / task_file.name and "MyWorkbenchPushCube-v1" in told.message
        assert file.stat().st_mode & 0o200, "the copy is there to be edited"
        helper = tmp_path / "helper.py"
        helper.touch()
        with_helper = replace(task, source_files=(*task.source_files, str(helper)))
        assert not plan(with_helper, None, request, asking(session)).can_copy
        file, told = copy(replace(task, file=str(tmp_path / "gone.py")), tmp_path)
        assert file is None and told.message.startswith("Not copied: gone.py cannot be read")
    finally:
        task_file.chmod(0o644)
