"""No file in the working directory of a command is executed, whatever its name."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import websockets.sync.client

from tests.drive.tabs import camera_message, handshake, messages_in

pytestmark = pytest.mark.usefixtures("child_process")

TASK = Path(__file__).parents[1] / "tasks" / "minimal.py"
COMMAND = Path(sys.executable).with_name("workbench")
IMPORTED_FIRST = "pathlib json random queue subprocess socket logging tyro rich msgspec".split()
PLANTED = [
    *IMPORTED_FIRST,
    *"numpy torch multiprocessing h5py sapien mani_skill viser trimesh imageio_ffmpeg".split(),
    *"workbench sitecustomize usercustomize pyarrow PIL select pickle psutil".split(),
]
ENVIRONMENT = {**os.environ, "COLUMNS": "200", "PYTHONUNBUFFERED": "1"}


def plant(folder: Path, *names: str) -> None:
    """Write files that leave a mark when they run, and break a program that imports them."""
    for name in names:
        (folder / f"{name}.py").write_text(
            "from os import open, O_CREAT\n"
            f"open({str(folder / f'ran_{name}')!r}, O_CREAT)\n"
            "raise ImportError('a file in the current folder ran')\n"
        )


def ran(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("ran_*"))


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [str(COMMAND), *arguments],
        cwd=folder,
        env=ENVIRONMENT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@contextmanager
def page(folder: Path, *arguments: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """The page's address, and its process, whose later output can be read."""
    process = start(folder, *arguments, "--port", "0")
    assert process.stdout is not None
    try:
        output = []
        for line in process.stdout:
            output.append(line)
            if line.startswith("  page "):
                break
        else:
            raise AssertionError("".join(output))
        yield line.split()[-1], process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=30)
        finally:
            process.kill()
            process.stdout.close()


def await_on_page(url: str, text: str) -> None:
    """Wait until the page receives a message that contains `text`."""
    address, options = handshake(url)
    deadline = time.monotonic() + 90
    with websockets.sync.client.connect(address, **options) as tab:
        tab.send(camera_message())
        while time.monotonic() < deadline:
            frame = tab.recv(timeout=90)
            assert isinstance(frame, bytes)
            if text in str(messages_in(frame)):
                return
    raise AssertionError(f"{text!r} did not arrive")


def finished(process: subprocess.Popen[str]) -> str:
    output, _ = process.communicate(timeout=200)
    assert process.returncode == 0, output
    return output


@pytest.mark.slow
def test_no_command_runs_files_of_the_current_folder(tmp_path: Path) -> None:
    """The task is there too: modules next to it are found, except those named like a library."""
    plant(tmp_path, *PLANTED)
    (tmp_path / "beside.py").write_text("SIZE = 1\n")
    task = tmp_path / "minimal.py"
    task.write_text(
        TASK.read_text() + "\nimport beside\nimport numpy, json\nassert numpy.zeros and json.dumps\n"
    )
    plain = ("--env", "render_backend=none")
    recording = start(
        tmp_path, "record", "minimal.py", "--episodes", "2", "--max-steps", "3", "--workers", "2",
        "--no-pictures", "--num-envs", "2", "--out", "recordings", *plain,
    )  # fmt: skip
    doctor = start(tmp_path, "doctor")
    output = finished(recording)
    assert output.count("numpy.py has the name of a library") == 1
    assert "packages" in doctor.communicate(timeout=200)[0]
    episodes = sorted((tmp_path / "recordings").glob("*.json"))
    assert len(episodes) == 2
    with page(tmp_path, "review", ".") as (url, _):
        await_on_page(url, episodes[0].stem)
    finished(start(tmp_path, "share", str(episodes[0].with_suffix(".rrd")), "--html", "--out", "made"))
    with page(tmp_path, "open", "minimal.py", "--num-envs", "2", *plain) as (url, process):
        await_on_page(url, "json.py has the name of a library")
        assert process.stdout is not None
        output = ""
        for line in process.stdout:
            output += line
            assert "failed" not in line
            if "numpy.py has the name of a library" in line:
                break
        assert "\nloaded" in f"\n{output}"
    assert ran(tmp_path) == []


def test_python_m_does_not_use_the_current_folder_either(tmp_path: Path) -> None:
    """As far as possible: imports that Python itself makes to find the module run before our code."""
    plant(tmp_path, *IMPORTED_FIRST)
    done = subprocess.run(
        [sys.executable, "-m", "workbench.cli.main", "view", "--help"],
        cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert ran(tmp_path) == []
