"""The web viewer's files are stored once per version of rerun, completely or not at all."""

from __future__ import annotations

import gzip
from importlib.metadata import version
from pathlib import Path

import pytest

from workbench.episodes.rerun import viewer
from workbench.episodes.rerun.viewer import (
    has_screen,
    quiet_environment,
    viewer_file,
    viewer_is_cached,
    web_viewer_folder,
)


@pytest.fixture
def extracted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How often the files were taken from rerun's command, which is not started."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    times: list[int] = []

    def files() -> dict[str, bytes]:
        times.append(1)
        return {name: f"content of {name}".encode() for name in viewer.VIEWER_FILES}

    monkeypatch.setattr(viewer, "web_viewer_files", files)
    return times


def test_the_files_are_stored_once_for_this_version_of_rerun(extracted: list[int], tmp_path: Path) -> None:
    assert not viewer_is_cached()
    folder = web_viewer_folder()
    assert folder.is_relative_to(tmp_path) and version("rerun-sdk") in folder.parts
    assert viewer_is_cached() and web_viewer_folder() == folder and extracted == [1]
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        f"{name}.gz" for name in viewer.VIEWER_FILES
    )
    for name in viewer.VIEWER_FILES:
        path = viewer_file(name)
        assert path.parent == folder and gzip.decompress(path.read_bytes()) == f"content of {name}".encode()
    assert list(folder.parent.iterdir()) == [folder]


def test_files_that_cannot_be_stored_are_an_error_and_leave_nothing(
    extracted: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Path, content: bytes) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        with pytest.raises(RuntimeError, match="No space left"):
            web_viewer_folder()
    assert not viewer_is_cached() and not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not list(tmp_path.rglob(".making-*"))
    web_viewer_folder()
    assert viewer_is_cached()


def test_a_screen_is_one_of_x_or_of_wayland() -> None:
    assert has_screen({"DISPLAY": ":0"}) and has_screen({"WAYLAND_DISPLAY": "wayland-0"})
    assert not has_screen({}) and not has_screen({"DISPLAY": ""})


def test_the_users_choice_cannot_turn_statistics_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    monkeypatch.setenv("CI", "")
    environment = quiet_environment()
    assert environment["CI"] and "FORCE_RERUN_ANALYTICS" not in environment
