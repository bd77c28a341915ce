"""A task that hides its cube in `evaluate`, on the page: pictures, the 3-D scene and a return to the past agree."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from pathlib import Path

import pytest

from tests.drive.render_device import RENDER_BACKEND
from tests.drive.session import draw_past, live_session, wait_until
from workbench.live.commands import Step
from workbench.live.events import MomentShown, PagesCounted
from workbench.live.messages import CameraRequest
from workbench.live.timeline_commands import ContinueFromHere
from workbench.live.view import SessionView

pytestmark = pytest.mark.usefixtures("child_process")

TASK = """
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.pose import Pose


@register_env("HidesItsCube-v1", max_episode_steps=50, override=True)
class HidesItsCube(PushCubeEnv):
    def evaluate(self):
        found = super().evaluate()
        pose = self.obj.pose.raw_pose.clone()
        pose[1:, 2] += 50.0
        self.obj.set_pose(Pose.create(pose))
        return found
"""
CAMERA = ("sensor", "base_camera")


@pytest.mark.slow
def test_the_pages_pictures_lack_a_cube_that_evaluate_hides(tmp_path: Path) -> None:
    file = tmp_path / "task.py"
    file.write_text(TASK)
    with live_session(file, tmp_path / "recordings", draw=True, render_backend=RENDER_BACKEND) as session:
        view = session.view()
        assert view.task is not None
        (cube,) = (number for number, name in view.task.segmentation.items() if name == "cube")
        column = view.task.geometry.body_names.index("cube")
        session.change(cameras=(CameraRequest(CAMERA[1], "sensor", ("rgb", "segmentation")),))
        session.dispatch(PagesCounted(1))

        def shows_cube(view: SessionView) -> bool:
            segmentation = view.pictures[CAMERA].segmentation
            assert segmentation is not None
            return bool((segmentation == cube).any())

        def drawn(view: SessionView, env: int) -> bool:
            return CAMERA in view.pictures and view.pictures[CAMERA].env == env

        for env, seen in ((0, True), (1, False), (0, True)):
            session.change(selected_env=env)
            step = session.view().step.elapsed_steps[0]
            session.do(Step())
            wait_until(session, lambda v, n=step: v.step.elapsed_steps[0] > n, "a step")
            view = wait_until(session, lambda v, env=env: drawn(v, env), "a picture")
            assert shows_cube(view) == seen
            assert (view.step.poses[:, column, 2] > 25).tolist() == [False, True]
        # A past moment, and continuing from it.
        session.change(selected_env=1)
        past = session.view().timeline.first
        session.dispatch(MomentShown(past))
        draw_past(session)
        view = wait_until(session, lambda v: v.timeline.shown == past and drawn(v, 1), "a picture of then")
        assert not shows_cube(view)
        last = view.timeline.last
        session.do(ContinueFromHere(scope="all"))
        view = wait_until(session, lambda v: v.timeline.last > last and drawn(v, 1), "a picture of now")
        assert view.timeline.shown is None and not shows_cube(view)
