"""A camera that cannot be rendered shows the reason, and everything else keeps working."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from pathlib import Path

import pytest

from tests.drive.render_device import RENDER_BACKEND
from tests.drive.session import TASKS, live_session, step, wait_until
from workbench.envs.camera_data import CameraKey
from workbench.live.events import PagesCounted
from workbench.live.messages import CameraRequest
from workbench.record.commands import StopRecording
from workbench.record.state import RecordingStatus, RecordingWanted

pytestmark = pytest.mark.usefixtures("child_process")

EXAMPLE = (TASKS / "push_cube.py").read_text()
CLASS = '@register_env("WorkbenchPushCube-v1", max_episode_steps=50)\n'
SENSOR: CameraKey = ("sensor", "base_camera")
HUMAN: CameraKey = ("human", "render_camera")
OWN_SHADER = """
from mani_skill.render import ShaderConfig

OWN = ShaderConfig("minimal", {"Color": ["rgb"], "No": ["depth"]}, {}, {"Color": lambda c: {"rgb": c[..., :3]}})


"""
HANGS = """
import ctypes

import sapien.render
from workbench.machine.processes.time_limit import end_after

end_after(3)
stock = sapien.render.RenderCameraComponent.get_picture


def get_picture(self, name):
    if self.width == 512:
        ctypes.PyDLL(None).sleep(1000)
    return stock(self, name)


sapien.render.RenderCameraComponent.get_picture = get_picture


"""


def task(folder: Path, code: str, old: str = "", new: str = "") -> Path:
    assert CLASS in EXAMPLE and old in EXAMPLE
    text = EXAMPLE.replace(CLASS, code.lstrip() + CLASS)
    file = folder / "task.py"
    file.write_text(text.replace(old, new) if old else text)
    return file


@pytest.mark.slow
def test_a_texture_that_the_shader_lacks_fails_its_camera(tmp_path: Path) -> None:
    file = task(
        tmp_path,
        OWN_SHADER,
        'CameraConfig("base_camera", ',
        'CameraConfig("base_camera", shader_config=OWN, ',
    )
    line = next(n for n, text in enumerate(file.read_text().splitlines(), 1) if "shader_config=OWN" in text)
    with live_session(file, tmp_path / "recordings", draw=True, render_backend=RENDER_BACKEND) as session:
        session.change(
            cameras=(CameraRequest(SENSOR[1], "sensor", ("depth",)), CameraRequest(HUMAN[1], "human"))
        )
        session.dispatch(PagesCounted(1))
        view = wait_until(session, lambda v: SENSOR in v.failed_cameras and HUMAN in v.pictures, "both")
        assert f"{file}:{line}" in view.failed_cameras[SENSOR] and [*view.failed_cameras] == [SENSOR]
        # The recording leaves this camera out.
        session.dispatch(RecordingWanted())
        step(session, 3)
        wait_until(session, lambda v: v.of(RecordingStatus).steps > 0, "recorded steps")
        session.do(StopRecording())
        view = wait_until(session, lambda v: v.of(RecordingStatus).episodes_written == 2, "the files")
        assert view.of(RecordingStatus).problem is None and view.problem is None
        # The textures that the shader has are still rendered.
        session.change(cameras=(CameraRequest(HUMAN[1], "human"),))
        session.change(
            cameras=(CameraRequest(SENSOR[1], "sensor", ("rgb",)), CameraRequest(HUMAN[1], "human"))
        )
        view = wait_until(session, lambda v: SENSOR in v.pictures, "its colours")
        assert not view.failed_cameras


@pytest.mark.slow
def test_a_picture_that_hangs_fails_its_camera(tmp_path: Path) -> None:
    file = task(tmp_path, HANGS)
    with live_session(file, tmp_path / "recordings", draw=True, render_backend=RENDER_BACKEND) as session:
        session.change(cameras=(CameraRequest(HUMAN[1], "human"),))
        session.dispatch(PagesCounted(1))
        view = wait_until(session, lambda v: HUMAN in v.failed_cameras, "the camera's failure")
        assert any(HUMAN[1] in line and str(file) in line for line in view.printed.texts)
        wait_until(session, lambda v: v.state == "paused", "the next worker")
        session.change(cameras=(CameraRequest(HUMAN[1], "human"), CameraRequest(SENSOR[1], "sensor")))
        view = wait_until(session, lambda v: SENSOR in v.pictures, "the other camera")
        assert [*view.failed_cameras] == [HUMAN]
        step(session)
