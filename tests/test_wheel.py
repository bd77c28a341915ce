"""The wheel contains its data files and works without a clone.

Its dependencies are not downloaded again: the clean environment uses this one's site-packages through a
``.pth`` line. Editable installs are not visible there, because Python reads ``.pth`` files only in a site
folder, not in a folder that such a line adds.
"""

from __future__ import annotations

import http.cookiejar
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import urllib.request
from pathlib import Path
from zipfile import ZipFile

import psutil
import pytest
from packaging.utils import canonicalize_name

from tests.drive.waiting import until
from workbench.machine.maniskill_installed import installed_maniskills

pytestmark = pytest.mark.usefixtures("child_process")

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    (built,) = folder.glob("maniskill_workbench-*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ``bin`` folder of an environment with the wheel and without this clone."""
    venv = tmp_path_factory.mktemp("installed") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    pip = [sys.executable, "-m", "pip", "--python", str(venv / "bin" / "python")]
    subprocess.run([*pip, "install", "-q", "--no-deps", "--no-index", str(wheel)], check=True)
    (site_packages,) = venv.glob("lib/python*/site-packages")
    (site_packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return venv / "bin"


@pytest.mark.slow
def test_the_wheel_contains_web_assets_and_tasks(wheel: Path) -> None:
    carried = set(ZipFile(wheel).namelist())
    wanted = {
        f"workbench/{name}/{path.relative_to(ROOT / folder).as_posix()}"
        for folder, name in (("web_assets", "_web_assets"), ("tasks", "_tasks"))
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert "workbench/_tasks/push_cube.py" in wanted
    assert wanted <= carried
    assert not [name for name in carried if name.startswith("tests/") or "__pycache__" in name]


@pytest.mark.slow
def test_the_installed_command_is_not_the_clone(installed: Path, tmp_path: Path) -> None:
    where = "import workbench; print(workbench.__file__)"
    assert str(installed.parent) in _run([str(installed / "python"), "-c", where], tmp_path)
    output = _run([str(installed / "workbench"), "--help"], tmp_path)
    assert all(command in output for command in ("open", "record", "doctor"))
    # In a clone README is not part of the package.
    assert "The first ten minutes" in _run([str(installed / "workbench"), "help", "overview"], tmp_path)


@pytest.mark.slow
def test_a_file_elsewhere_opens_is_served_and_ends_with_ctrl_c(installed: Path, tmp_path: Path) -> None:
    (carried,) = installed.parent.glob("lib/python*/site-packages/workbench/_tasks/minimal.py")
    shutil.copy(carried, tmp_path / "my_task.py")
    _opens(installed, str(tmp_path / "my_task.py"), tmp_path)


@pytest.mark.slow
def test_installed_into_a_labs_environment_no_version_changes_and_its_task_opens(
    wheel: Path, tmp_path: Path
) -> None:
    """The lab's packages pin their ManiSkill version. Without an index pip cannot install another version of anything and
    would report that."""
    ((name, version),) = installed_maniskills().items()
    lab = tmp_path / "lab"
    (lab / "lab_tasks").mkdir(parents=True)
    (lab / "pyproject.toml").write_text(LAB_PROJECT.format(pin=f"{name}=={version}"))
    (lab / "lab_tasks" / "__init__.py").touch()
    (lab / "lab_tasks" / "envs.py").write_text(LAB_TASK)
    binaries = _environment(tmp_path, but=("maniskill_workbench",))
    pip = [str(binaries / "python"), "-m", "pip"]
    install = [*pip, "install", "-q", "--no-index", "--no-build-isolation"]
    _run([*install, str(lab)], tmp_path)
    before = _versions(pip, tmp_path)
    assert before["lab-tasks"] == "1.0" and before[canonicalize_name(name)] == version
    assert "maniskill-workbench" not in before
    _run([*install, str(wheel)], tmp_path)
    after = _versions(pip, tmp_path)
    assert after.pop("maniskill-workbench") and after == before
    away = tmp_path / "away"
    away.mkdir()
    _opens(binaries, "lab_tasks.envs:LabPush", away)


@pytest.mark.slow
def test_without_maniskill_it_prints_what_to_type(wheel: Path, tmp_path: Path) -> None:
    """In an environment with all packages of this one except ManiSkill."""
    binaries = _environment(tmp_path, but=("maniskill_workbench", "mani_skill"))
    _run([str(binaries / "python"), "-m", "pip", "install", "-q", "--no-index", str(wheel)], tmp_path)
    workbench = str(binaries / "workbench")
    output = _run([workbench, "open", "PickCube-v1"], tmp_path, code=2)
    first, second = output.splitlines()
    assert first.startswith("workbench open needs ManiSkill") and str(binaries.parent) in first
    assert second.startswith(f"Type: {binaries}/python -m pip install 'mani_skill")
    output = _run([str(binaries / "python"), "-c", "import workbench; workbench.make"], tmp_path, code=1)
    assert "workbench.make needs ManiSkill" in output and "gym_env" not in output


LAB_PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "lab-tasks"
version = "1.0"
dependencies = ["{pin}"]
"""
LAB_TASK = """
from mani_skill.envs.tasks import PushCubeEnv
from mani_skill.utils.registration import register_env


@register_env("LabPush-v1", max_episode_steps=50)
class LabPush(PushCubeEnv):
    goal_radius = 0.15
"""


def _environment(folder: Path, but: tuple[str, ...]) -> Path:
    """The ``bin`` folder of a new environment with this one's packages, except (`but`) those whose names start with these."""
    venv, packages = folder / "venv", folder / "packages"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    packages.mkdir()
    for path in Path(sysconfig.get_path("purelib")).iterdir():
        if not path.name.startswith(but):
            (packages / path.name).symlink_to(path)
    (site_packages,) = venv.glob("lib/python*/site-packages")
    (site_packages / "packages.pth").write_text(f"{packages}\n")
    return venv / "bin"


def _versions(pip: list[str], folder: Path) -> dict[str, str]:
    """Version of each package that pip finds, by name."""
    lines = _run([*pip, "list", "--format=freeze"], folder).splitlines()
    return {canonicalize_name(line.split("==")[0]): line.split("==")[1] for line in lines}


def _opens(binaries: Path, task: str, folder: Path) -> None:
    """Check that the task opens in this folder, its page answers, and Ctrl-C ends all processes."""
    log = folder / "log.txt"
    with log.open("w") as output:
        process = subprocess.Popen(
            [str(binaries / "workbench"), "open", task, "--num-envs", "1", "--port", "0"],
            cwd=folder,
            env=_clean_environment(),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    family = [psutil.Process(process.pid)]
    try:

        def printed(pattern: str) -> re.Match[str] | None:
            assert process.poll() is None, f"ended with {process.returncode}:\n{log.read_text()}"
            return re.search(pattern, log.read_text())

        address = until(lambda: printed(r"http://\S+"), "the address", 60, seen=log.read_text)[0]
        # The token in the first address becomes a cookie, so the client must store cookies as a browser does.
        client = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(http.cookiejar.CookieJar()))
        with client.open(address, timeout=20) as answer:
            assert answer.status == 200
            assert b"<html" in answer.read().lower()
        until(lambda: printed(r"loaded "), "the task", 120, seen=log.read_text)
        family += family[0].children(recursive=True)
        process.send_signal(signal.SIGINT)
        process.wait(timeout=10)
        _, alive = psutil.wait_procs(family[1:], timeout=5)
        assert not alive, f"left behind: {alive}"
        assert process.returncode == 0, log.read_text()
    finally:
        for member in family:
            if member.is_running():
                member.kill()
        process.wait()


def _run(command: list[str], folder: Path, code: int = 0) -> str:
    """Output of the command: stdout, or stderr if it is expected to fail with `code`."""
    done = subprocess.run(
        command, cwd=folder, env=_clean_environment(), capture_output=True, text=True, timeout=60
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stderr if code else done.stdout


def _clean_environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
