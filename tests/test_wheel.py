"""The wheel is the program too: it carries its data and works where there is no clone.

Its dependencies are not downloaded again: the clean environment sees this one's site-packages through a
``.pth`` line. Editable installs do not come along, since Python reads ``.pth`` files only in a site
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

from tests.drive.waiting import until

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
    """The ``bin`` folder of an environment that holds the wheel and nothing of this clone."""
    venv = tmp_path_factory.mktemp("installed") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    pip = [sys.executable, "-m", "pip", "--python", str(venv / "bin" / "python")]
    subprocess.run([*pip, "install", "-q", "--no-deps", "--no-index", str(wheel)], check=True)
    (site_packages,) = venv.glob("lib/python*/site-packages")
    (site_packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return venv / "bin"


def test_web_assets_and_tasks_travel_in_the_wheel(wheel: Path) -> None:
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


def test_the_installed_command_is_not_the_clone(installed: Path, tmp_path: Path) -> None:
    where = "import workbench; print(workbench.__file__)"
    assert str(installed.parent) in _run([str(installed / "python"), "-c", where], tmp_path)
    said = _run([str(installed / "workbench"), "--help"], tmp_path)
    assert all(command in said for command in ("open", "record", "doctor"))


def test_a_file_elsewhere_opens_is_served_and_ends_with_ctrl_c(installed: Path, tmp_path: Path) -> None:
    (carried,) = installed.parent.glob("lib/python*/site-packages/workbench/_tasks/minimal.py")
    task = tmp_path / "my_task.py"
    shutil.copy(carried, task)
    log = tmp_path / "log.txt"
    with log.open("w") as output:
        process = subprocess.Popen(
            [str(installed / "workbench"), "open", str(task), "--num-envs", "1", "--port", "0"],
            cwd=tmp_path,
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
        # The token of the first address becomes a cookie, so the client must keep cookies as a browser does.
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


def _run(command: list[str], folder: Path) -> str:
    done = subprocess.run(
        command, cwd=folder, env=_clean_environment(), capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def _clean_environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
