"""A ray-traced camera on a machine without ray tracing: each command works, and names the camera's line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.drive.commands import exit_code
from workbench.envs.backends import why_no_ray_tracing

pytestmark = pytest.mark.usefixtures("renderer")

TEXT = (Path(__file__).parents[2] / "tasks" / "push_cube.py").read_text()
CAMERA = 'CameraConfig("render_camera", pose=pose, width=512, height=512,'


@pytest.fixture
def traced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, int]:
    """The task file, and the line of its camera."""
    if why_no_ray_tracing() is None:
        pytest.skip("this machine traces rays")
    monkeypatch.chdir(tmp_path)
    assert CAMERA in TEXT
    text = TEXT.replace(
        CAMERA, 'CameraConfig("render_camera", pose=pose, shader_pack="rt", width=64, height=64,'
    )
    text = text.replace("WorkbenchPushCube-v1", "TracedPushCube-v1")
    file = tmp_path / "traced.py"
    file.write_text(text)
    return file, next(n for n, line in enumerate(text.splitlines(), 1) if 'shader_pack="rt"' in line)


def test_a_ray_traced_camera_is_recorded_and_the_recording_says_how(
    traced: tuple[Path, int], capsys: pytest.CaptureFixture[str]
) -> None:
    file, line = traced
    assert exit_code("record", file, "--episodes", "1", "--max-steps", "2") == 0
    assert f"{file}:{line}" in capsys.readouterr().err
    (description,) = file.parent.glob("recordings/*.json")
    cameras = json.loads(description.read_text())["workbench"]["cameras"]
    assert {camera["name"]: camera["replaced_shader"] for camera in cameras} == {
        "base_camera": "",
        "render_camera": "rt",
    }


def test_the_check_of_a_ray_traced_camera_ends_with_a_finding(
    traced: tuple[Path, int], capsys: pytest.CaptureFixture[str]
) -> None:
    file, line = traced
    rules = "ray-traced,camera-sees,hidden-goal"
    assert exit_code("check", file, "--select", rules, "--seeds", "2", "--workers", "1", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    (finding,) = [each for each in report["findings"] if each["rule"] == "ray-traced"]
    assert (finding["file"], finding["line"]) == (file.name, line)
