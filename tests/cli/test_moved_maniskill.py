"""`workbench open` with another ManiSkill version: a copy of the installed one with renamed members."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from importlib.metadata import distribution
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.drive.waiting import until
from workbench.machine.versions import maniskill

pytestmark = pytest.mark.usefixtures("child_process")


def copy_of_maniskill(folder: Path, renamed: dict[str, str]) -> None:
    """Write ManiSkill 9.9.9 into `folder`, with these words renamed in its code; other files are linked."""
    spec, installed = find_spec("mani_skill"), maniskill()
    assert spec is not None and spec.submodule_search_locations and installed is not None

    def copy(source: Path, target: Path) -> None:
        target.mkdir()
        for entry in source.iterdir():
            if entry.is_dir() and entry.name not in ("assets", "__pycache__"):
                copy(entry, target / entry.name)
            elif entry.suffix == ".py":
                text = entry.read_text()
                for old, new in renamed.items():
                    text = text.replace(old, new)
                (target / entry.name).write_text(text)
            elif entry.name != "__pycache__":
                (target / entry.name).symlink_to(entry)

    copy(Path(spec.submodule_search_locations[0]), folder / "mani_skill")
    name, version = installed
    metadata = distribution(name).read_text("METADATA")
    assert metadata is not None
    info = folder / f"{name.replace('-', '_')}-9.9.9.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(metadata.replace(f"Version: {version}", "Version: 9.9.9"))


def printed_by_open(folder: Path, end: str) -> str:
    """The output of ``workbench open`` with this folder first on the path, until it contains `end`."""
    log = folder / "log.txt"
    with log.open("w") as output:
        process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "workbench.cli.main",
                "open",
                "PickCube-v1",
                "--num-envs",
                "2",
                "--port",
                "0",
            ]
            + ["--no-spare", "--env", "render_backend=none"],
            env={**os.environ, "PYTHONPATH": str(folder)},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        until(lambda: end in log.read_text(), f"{end!r}", 90, seen=log.read_text)
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(timeout=20)
    return log.read_text()


@pytest.mark.slow
def test_moved_names_are_listed_with_what_they_disable_and_the_task_opens(tmp_path: Path) -> None:
    moved = {"_cached_local_pose": "_cached_local", "_hidden_objects": "_concealed_objects"}
    copy_of_maniskill(tmp_path, moved)
    printed = printed_by_open(tmp_path, "The tested versions")
    assert "loaded PickCube-v1" in printed
    assert "placing cameras (needs RenderCamera._cached_local_pose)" in printed
    assert "(needs BaseEnv._hidden_objects)" in printed
    installed = maniskill()
    assert installed is not None
    assert f"Not tested with the workbench: {installed[0]} 9.9.9" in printed
    assert f"pip install {installed[0]}=={installed[1]}" in printed


@pytest.mark.slow
def test_a_maniskill_that_cannot_be_imported_is_named_with_the_tested_versions(tmp_path: Path) -> None:
    copy_of_maniskill(tmp_path, {"class RenderCamera": "class CameraOfAnotherYear"})
    printed = printed_by_open(tmp_path, "The tested versions")
    assert "cannot import name 'RenderCamera'" in printed and "9.9.9" in printed and "loaded" not in printed
